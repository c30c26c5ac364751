//! Memory that a camera's driver writes images to, and that leaves as images without being copied.
#![expect(unsafe_code, reason = "memory that Aravis fills")]

use crate::image::GrayImage;
use aravis::Buffer;
use std::collections::HashMap;
use std::sync::{Mutex, PoisonError};

/// Spare memory beyond what is lent.
const MAX_SPARE: usize = 64;

/// Lends memory to Aravis as buffers of one size.
///
/// Buffers borrow their memory, which stays here until [`take`](Self::take) hands it out as an image or
/// the pool is dropped. A stream must be gone before the pool that it has buffers of.
#[derive(Debug)]
pub(super) struct Pool {
    bytes: usize,
    inner: Mutex<Inner>,
}

#[derive(Debug, Default)]
struct Inner {
    /// By address.
    lent: HashMap<usize, Vec<u8>>,
    spare: Vec<Vec<u8>>,
}

impl Pool {
    pub(super) fn new(bytes: usize) -> Self {
        Self {
            bytes,
            inner: Mutex::default(),
        }
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, Inner> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A buffer over memory of the pool.
    pub(super) fn lend(&self) -> Buffer {
        let mut inner = self.lock();
        let mut memory = inner.spare.pop().unwrap_or_default();
        memory.resize(self.bytes, 0);
        let start = memory.as_mut_ptr();
        inner.lent.insert(start as usize, memory);
        // SAFETY: the memory is `bytes` long and stays where it is, untouched, in `lent`, until the
        // buffer comes back from the stream (`take`) or the pool is dropped, which the owner of both
        // does after the stream.
        unsafe { Buffer::new_preallocated_borrowed(start, self.bytes) }
    }

    /// Whether the buffer's memory is still lent to it.
    pub(super) fn owns(&self, buffer: &Buffer) -> bool {
        self.lock().lent.contains_key(&(buffer.data().0 as usize))
    }

    /// The memory of a buffer that came back from the stream; the buffer must not be used again.
    pub(super) fn take(&self, buffer: &Buffer) -> Option<Vec<u8>> {
        self.lock().lent.remove(&(buffer.data().0 as usize))
    }

    /// Reads what a buffer that came back from the stream holds.
    pub(super) fn with_bytes<R>(
        &self,
        buffer: &Buffer,
        read: impl FnOnce(&[u8]) -> R,
    ) -> Option<R> {
        let inner = self.lock();
        let memory = inner.lent.get(&(buffer.data().0 as usize))?;
        Some(read(memory))
    }

    /// An image to be filled.
    pub(super) fn spare_image(&self) -> GrayImage {
        let memory = self.lock().spare.pop().unwrap_or_default();
        let length = memory.len() as u32;
        GrayImage::from_vec(length, 1, memory).unwrap_or_default()
    }

    /// Takes back an image's memory.
    pub(super) fn recycle(&self, image: GrayImage) {
        let mut inner = self.lock();
        if inner.spare.len() < MAX_SPARE {
            inner.spare.push(image.into_vec());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn memory_leaves_as_an_image_and_is_lent_again() {
        let pool = Pool::new(12);
        let buffer = pool.lend();
        assert!(pool.owns(&buffer));
        let (start, _) = buffer.data();
        let pixels = pool.take(&buffer).expect("lent");
        assert_eq!(pixels.as_ptr(), start.cast_const());
        assert!(!pool.owns(&buffer));
        assert!(pool.take(&buffer).is_none());
        pool.recycle(GrayImage::from_vec(4, 3, pixels).expect("of that size"));
        assert_eq!(pool.lend().data().0, start);
    }
}
