//! A GigE Vision or USB3 Vision camera in, by way of Aravis; its frames out.
//!
//! [`discovery`] finds cameras, `configure` sets them up, `pool` lends the memory that they write
//! to: eight-bit grey images leave without having been copied.

mod action;
mod configure;
pub mod discovery;
mod pool;

use super::camera::{
    CameraError, CameraEvent, Clock, Frame, FrameSource, Loss, Unwrapped, monotonic_ns,
    realtime_ahead_ns,
};
use super::pixels::{Converter, PixelLayout};
use super::settings::{CameraSettings, Trigger};
use crate::image::GrayImage;
use action::Actions;
use aravis::prelude::*;
use aravis::{Buffer, BufferStatus, Camera, Stream};
use configure::Configured;
use glib::prelude::Cast;
use pool::Pool;
use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Socket buffer of a GigE Vision stream without a packet socket, bytes: three images.
const SOCKET_BUFFER_BYTES: i32 = 4 << 20;
/// How long parts of a frame are waited for, µs.
const FRAME_RETENTION_US: u32 = 100_000;
/// Numbers of GigE Vision frames have 16 bits, unless a larger one is seen.
const SHORT_NUMBER_BITS: u32 = 16;

/// One camera, opened and set up.
pub struct AravisCamera {
    // The order matters: the stream's thread writes to the pool's memory until the stream is gone.
    stream: Option<Stream>,
    pool: Pool,
    camera: Camera,
    identity: String,
    configured: Configured,
    converter: Converter,
    /// Images are used as they are, without conversion.
    is_plain: bool,
    numbers: Unwrapped,
    is_long_numbered: bool,
    control_lost: Arc<AtomicBool>,
    pending: VecDeque<CameraEvent>,
    underruns: u64,
    pacer: Option<Pacer>,
    actions: Option<Actions>,
}

impl std::fmt::Debug for AravisCamera {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("AravisCamera")
            .field("identity", &self.identity)
            .finish_non_exhaustive()
    }
}

impl AravisCamera {
    /// Opens the camera that `settings` name and sets it up for images of `size_px`.
    ///
    /// # Errors
    /// It is absent, held by another program, or cannot do what is asked for.
    pub fn open(settings: &CameraSettings, size_px: (u32, u32)) -> Result<Self, CameraError> {
        let (camera, found) = discovery::open(&settings.id)?;
        let identity = found.identity();
        let named = |e: CameraError| e.of(&identity);
        let configured = configure::apply(&camera, settings, size_px).map_err(named)?;
        let control_lost = Arc::new(AtomicBool::new(false));
        if let Some(device) = camera.device() {
            let flag = Arc::clone(&control_lost);
            device.connect_control_lost(move |_| flag.store(true, Ordering::Relaxed));
        }
        let layout = configured.layout;
        let is_plain = layout == PixelLayout::Mono8
            && configured.payload == size_px.0 as usize * size_px.1 as usize;
        let actions = match settings.trigger {
            Trigger::Action => Some(Actions::new(&camera, &found.address).map_err(named)?),
            _ => None,
        };
        let pacer = match (settings.trigger, settings.frame_rate_hz) {
            (Trigger::Software | Trigger::Action, Some(rate_hz)) => Some(Pacer::new(rate_hz)),
            _ => None,
        };
        Ok(Self {
            stream: None,
            pool: Pool::new(configured.payload),
            identity: identity.clone(),
            converter: Converter::new(layout, size_px, 0, settings.white_level),
            is_plain,
            configured,
            numbers: Unwrapped::new(SHORT_NUMBER_BITS, true),
            is_long_numbered: camera.is_uv_device(),
            camera,
            control_lost,
            pending: VecDeque::new(),
            underruns: 0,
            pacer,
            actions,
        })
    }

    fn create_stream(&self) -> Result<Stream, CameraError> {
        let stream = self
            .camera
            .create_stream()
            .map_err(|e| self.failed("cannot stream", &e))?;
        if let Some(gv) = stream.downcast_ref::<aravis::GvStream>() {
            gv.set_socket_buffer(aravis::GvStreamSocketBuffer::Fixed);
            gv.set_socket_buffer_size(SOCKET_BUFFER_BYTES);
            gv.set_frame_retention(FRAME_RETENTION_US);
        }
        for _ in 0..self.configured.buffers {
            stream.push_buffer(self.pool.lend());
        }
        Ok(stream)
    }

    fn failed(&self, what: &str, error: &glib::Error) -> CameraError {
        CameraError::Gone(format!("{}: {what}: {}", self.identity, error.message()))
    }

    /// Triggers, if it is time; how long until it is time again.
    fn trigger(&mut self) -> Result<Option<Duration>, CameraError> {
        let Some(pacer) = &mut self.pacer else {
            return Ok(None);
        };
        if let Some(tick_ns) = pacer.due() {
            let triggered = match &mut self.actions {
                Some(actions) => actions.schedule(tick_ns),
                None => self.camera.software_trigger().map_err(|e| e.to_string()),
            };
            triggered.map_err(|e| {
                CameraError::Gone(format!("{}: cannot be triggered: {e}", self.identity))
            })?;
        }
        Ok(Some(pacer.until_next()))
    }

    /// Takes one buffer of the stream apart; what it says goes to `pending`.
    fn take(&mut self, buffer: Buffer) {
        let status = buffer.status();
        if matches!(status, BufferStatus::Cleared | BufferStatus::Aborted) {
            self.give_back(&buffer);
            return;
        }
        let number = self.count(buffer.frame_id());
        let arrived_ns = arrival_ns(&buffer);
        let stamp_ns = i64::try_from(buffer.timestamp()).unwrap_or(i64::MAX);
        let image = match status {
            BufferStatus::Success => self.image(&buffer),
            BufferStatus::Timeout => Err(Loss::TimedOut),
            BufferStatus::PayloadNotSupported | BufferStatus::SizeMismatch => {
                Err(Loss::WrongFormat)
            }
            _ => Err(Loss::Incomplete),
        };
        self.give_back(&buffer);
        self.pending.push_back(match image {
            Ok(image) => CameraEvent::Frame(Frame {
                number,
                stamp_ns,
                arrived_ns,
                image,
            }),
            Err(kind) => CameraEvent::Lost { kind, frames: 1 },
        });
    }

    /// The frame's whole number; a gap before it is a loss.
    fn count(&mut self, raw: u64) -> u64 {
        if raw >= 1 << SHORT_NUMBER_BITS && !self.is_long_numbered {
            self.is_long_numbered = true;
            self.numbers = Unwrapped::new(64, false);
        }
        let (number, skipped) = self.numbers.next(raw);
        let underruns = match &self.stream {
            Some(stream) => stream.statistics().2,
            None => self.underruns,
        };
        let starved = underruns.saturating_sub(self.underruns).min(skipped);
        self.underruns = underruns;
        for (kind, frames) in [
            (Loss::Underrun, starved),
            (Loss::Skipped, skipped - starved),
        ] {
            if frames > 0 {
                self.pending.push_back(CameraEvent::Lost { kind, frames });
            }
        }
        number
    }

    fn image(&mut self, buffer: &Buffer) -> Result<GrayImage, Loss> {
        let (width, height) = self.configured.size_px;
        let has_size =
            (buffer.image_width(), buffer.image_height()) == (width as i32, height as i32);
        if !has_size || buffer.image_pixel_format() != self.configured.format {
            return Err(Loss::WrongFormat);
        }
        if self.is_plain {
            let pixels = self.pool.take(buffer).ok_or(Loss::Unreadable)?;
            return GrayImage::from_vec(width, height, pixels).ok_or(Loss::WrongFormat);
        }
        let mut image = self.pool.spare_image();
        let converter = &mut self.converter;
        let converted = self
            .pool
            .with_bytes(buffer, |raw| converter.convert(raw, &mut image));
        match converted {
            Some(Ok(())) => Ok(image),
            _ => Err(Loss::Unreadable),
        }
    }

    /// Lets the stream have a buffer again: this one, or another if its memory has left.
    fn give_back(&self, buffer: &Buffer) {
        if let Some(stream) = &self.stream {
            if self.pool.owns(buffer) {
                stream.push_buffer(buffer.clone());
            } else {
                stream.push_buffer(self.pool.lend());
            }
        }
    }
}

/// When a buffer's first packet arrived, CLOCK_MONOTONIC, ns. Aravis says so by CLOCK_REALTIME.
fn arrival_ns(buffer: &Buffer) -> i64 {
    let now_ns = monotonic_ns();
    let system_ns = i64::try_from(buffer.system_timestamp()).unwrap_or(0);
    let arrived_ns = system_ns - realtime_ahead_ns();
    // Beyond ten seconds the clock was set in between, or there is no such time.
    if (0..10_000_000_000).contains(&(now_ns - arrived_ns)) {
        arrived_ns
    } else {
        now_ns
    }
}

impl FrameSource for AravisCamera {
    fn size_px(&self) -> (u32, u32) {
        self.configured.size_px
    }

    fn identity(&self) -> String {
        self.identity.clone()
    }

    fn clock(&self) -> Clock {
        self.configured.clock
    }

    fn start(&mut self) -> Result<(), CameraError> {
        if self.stream.is_some() {
            return Ok(());
        }
        self.stream = Some(self.create_stream()?);
        self.underruns = 0;
        self.numbers = Unwrapped::new(
            if self.is_long_numbered {
                64
            } else {
                SHORT_NUMBER_BITS
            },
            !self.is_long_numbered,
        );
        if let Err(e) = self.camera.start_acquisition() {
            self.stream = None;
            return Err(self.failed("cannot be started", &e));
        }
        Ok(())
    }

    fn next(&mut self, patience: Duration) -> Result<CameraEvent, CameraError> {
        let deadline = Instant::now() + patience;
        loop {
            if let Some(event) = self.pending.pop_front() {
                return Ok(event);
            }
            if self.control_lost.load(Ordering::Relaxed) {
                return Err(CameraError::Gone(format!(
                    "{}: control was lost: it was unplugged or switched off",
                    self.identity
                )));
            }
            let until_trigger = self.trigger()?;
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Ok(CameraEvent::Quiet);
            }
            let wait = until_trigger.map_or(left, |t| t.min(left));
            let Some(stream) = &self.stream else {
                std::thread::sleep(left);
                return Ok(CameraEvent::Quiet);
            };
            let wait_us = u64::try_from(wait.as_micros()).unwrap_or(u64::MAX).max(1);
            if let Some(buffer) = stream.timeout_pop_buffer(wait_us) {
                self.take(buffer);
            }
        }
    }

    fn stop(&mut self) {
        if self.stream.is_some() {
            // A camera that is gone cannot be told to stop.
            let _ = self.camera.stop_acquisition();
            self.stream = None;
            self.pending.clear();
        }
    }

    fn recycle(&mut self, image: GrayImage) {
        self.pool.recycle(image);
    }
}

impl Drop for AravisCamera {
    fn drop(&mut self) {
        self.stop();
    }
}

/// Ticks at whole multiples of a period of CLOCK_MONOTONIC: the same for every camera of this host.
#[derive(Debug)]
struct Pacer {
    period_ns: i64,
    next_ns: i64,
}

impl Pacer {
    fn new(rate_hz: f64) -> Self {
        let period_ns = (1e9 / rate_hz).round() as i64;
        Self {
            period_ns,
            next_ns: (monotonic_ns() / period_ns + 2) * period_ns,
        }
    }

    /// The tick that is due; ticks that were missed are left out.
    fn due(&mut self) -> Option<i64> {
        let now_ns = monotonic_ns();
        if now_ns < self.next_ns {
            return None;
        }
        let tick_ns = now_ns / self.period_ns * self.period_ns;
        self.next_ns = tick_ns + self.period_ns;
        Some(tick_ns)
    }

    fn until_next(&self) -> Duration {
        Duration::from_nanos(u64::try_from(self.next_ns - monotonic_ns()).unwrap_or(0))
    }
}
