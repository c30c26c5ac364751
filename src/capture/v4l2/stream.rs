//! A video device in; its buffers, mapped into this process, one after the other out.
#![expect(unsafe_code, reason = "calls of the kernel, and memory shared with it")]

use std::io;
use std::sync::Arc;
use std::time::Duration;
use v4l::buffer::{Flags, Type};
use v4l::device::{Device, Handle};
use v4l::memory::Memory;
use v4l::v4l_sys::{v4l2_buffer, v4l2_requestbuffers};
use v4l::v4l2::{self, vidioc};

/// `POLLIN`, and what stands for a device that is gone.
const POLLIN: i16 = 1;
const PROT_READ: i32 = 1;
const MAP_SHARED: i32 = 1;

/// What the kernel says of a filled buffer.
#[derive(Clone, Copy, Debug)]
pub(super) struct Taken {
    pub(super) sequence: u32,
    /// By CLOCK_MONOTONIC, if `is_monotonic`, ns.
    pub(super) stamp_ns: i64,
    pub(super) is_monotonic: bool,
    pub(super) is_damaged: bool,
    pub(super) bytes: usize,
}

/// Buffers shared with the kernel. Dropping it stops the stream and gives them back.
pub(super) struct MappedStream {
    handle: Arc<Handle>,
    maps: Vec<Map>,
    is_running: bool,
}

/// One buffer, mapped to be read.
struct Map {
    start: *mut std::ffi::c_void,
    bytes: usize,
}

// SAFETY: the memory belongs to the stream alone, which is used by one thread at a time.
unsafe impl Send for Map {}

impl Drop for Map {
    fn drop(&mut self) {
        // SAFETY: it was mapped with this length, and no reference into it outlives the stream. That it
        // fails is impossible then, and would only leave it mapped.
        let _ = unsafe { v4l2::munmap(self.start, self.bytes) };
    }
}

fn described(index: usize) -> v4l2_buffer {
    // SAFETY: a plain C struct, for which zeros are a valid value.
    let zeroed: v4l2_buffer = unsafe { std::mem::zeroed() };
    v4l2_buffer {
        index: index as u32,
        type_: Type::VideoCapture as u32,
        memory: Memory::Mmap as u32,
        ..zeroed
    }
}

impl MappedStream {
    /// Has the kernel make `count` buffers, or as many as it likes, and maps them.
    pub(super) fn map(device: &Device, count: u32) -> io::Result<Self> {
        let mut stream = Self {
            handle: device.handle(),
            maps: Vec::new(),
            is_running: false,
        };
        let made = stream.request(count)?;
        for index in 0..made as usize {
            let mut buffer = described(index);
            stream.call(vidioc::VIDIOC_QUERYBUF, &mut buffer)?;
            let bytes = buffer.length as usize;
            // SAFETY: the kernel has just said that the buffer is there, with this offset and length.
            let start = unsafe {
                v4l2::mmap(
                    std::ptr::null_mut(),
                    bytes,
                    PROT_READ,
                    MAP_SHARED,
                    stream.handle.fd(),
                    buffer.m.offset.into(),
                )?
            };
            stream.maps.push(Map { start, bytes });
        }
        Ok(stream)
    }

    fn request(&self, count: u32) -> io::Result<u32> {
        // SAFETY: a plain C struct, for which zeros are a valid value.
        let zeroed: v4l2_requestbuffers = unsafe { std::mem::zeroed() };
        let mut request = v4l2_requestbuffers {
            count,
            type_: Type::VideoCapture as u32,
            memory: Memory::Mmap as u32,
            ..zeroed
        };
        self.call(vidioc::VIDIOC_REQBUFS, &mut request)?;
        Ok(request.count)
    }

    fn call<T>(&self, request: vidioc::_IOC_TYPE, argument: &mut T) -> io::Result<()> {
        let argument: *mut T = argument;
        // SAFETY: each caller passes the struct that the request takes, which lives during the call.
        unsafe { v4l2::ioctl(self.handle.fd(), request, argument.cast()) }
    }

    pub(super) fn is_running(&self) -> bool {
        self.is_running
    }

    /// Begins to fill buffers.
    pub(super) fn start(&mut self) -> io::Result<()> {
        if self.is_running {
            return Ok(());
        }
        for index in 0..self.maps.len() {
            self.queue(index)?;
        }
        let mut kind = Type::VideoCapture as u32;
        self.call(vidioc::VIDIOC_STREAMON, &mut kind)?;
        self.is_running = true;
        Ok(())
    }

    /// Lets the kernel fill a buffer.
    pub(super) fn queue(&mut self, index: usize) -> io::Result<()> {
        self.call(vidioc::VIDIOC_QBUF, &mut described(index))
    }

    /// The next filled buffer; `None` if there is none within `patience`.
    pub(super) fn dequeue(&mut self, patience: Duration) -> io::Result<Option<(usize, Taken)>> {
        let patience_ms = i32::try_from(patience.as_millis()).unwrap_or(i32::MAX);
        match self.handle.poll(POLLIN, patience_ms) {
            Ok(0) => return Ok(None),
            Ok(_) => {}
            Err(e) if e.kind() == io::ErrorKind::Interrupted => return Ok(None),
            Err(e) => return Err(e),
        }
        let mut buffer = described(0);
        self.call(vidioc::VIDIOC_DQBUF, &mut buffer)?;
        let flags = Flags::from(buffer.flags);
        let taken = Taken {
            sequence: buffer.sequence,
            stamp_ns: buffer.timestamp.tv_sec * 1_000_000_000 + buffer.timestamp.tv_usec * 1000,
            is_monotonic: flags & Flags::TIMESTAMP_MASK == Flags::TIMESTAMP_MONOTONIC,
            is_damaged: flags.contains(Flags::ERROR),
            bytes: buffer.bytesused as usize,
        };
        Ok(Some((buffer.index as usize, taken)))
    }

    /// What a buffer that was dequeued, and not yet queued again, holds.
    pub(super) fn bytes(&self, index: usize, used: usize) -> Option<&[u8]> {
        let map = self.maps.get(index)?;
        // SAFETY: mapped with this length; the kernel does not write to a buffer that is dequeued.
        let all = unsafe { std::slice::from_raw_parts(map.start.cast::<u8>(), map.bytes) };
        all.get(..used)
    }
}

impl Drop for MappedStream {
    fn drop(&mut self) {
        // A device that is gone can be told nothing, and needs to be told nothing.
        let mut kind = Type::VideoCapture as u32;
        let _ = self.call(vidioc::VIDIOC_STREAMOFF, &mut kind);
        self.maps.clear();
        let _ = self.request(0);
    }
}
