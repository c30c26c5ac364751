//! A camera of the kernel's Video4Linux in; its frames out.
//!
//! What a driver says that it has set is checked: many change format and size without a word.

mod configure;
mod stream;

use super::camera::{
    CameraError, CameraEvent, Clock, Frame, FrameSource, Loss, Unwrapped, monotonic_ns,
};
use super::pixels::Converter;
use super::settings::CameraSettings;
use crate::image::GrayImage;
use configure::Configured;
use serde::Serialize;
use std::collections::VecDeque;
use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;
use stream::{MappedStream, Taken};
use v4l::Device;
use v4l::capability::Flags as Capability;
use v4l::video::Capture;

/// How old a stamp of the kernel may be before it is no stamp of this host's clock, ns.
const MAX_AGE_NS: i64 = 10_000_000_000;
/// Bits of the kernel's frame numbers.
const NUMBER_BITS: u32 = 32;

/// One camera, opened and set up.
pub struct V4l2Camera {
    stream: Option<MappedStream>,
    device: Device,
    identity: String,
    configured: Configured,
    buffers: u32,
    converter: Converter,
    numbers: Unwrapped,
    pending: VecDeque<CameraEvent>,
    spare: Vec<GrayImage>,
}

impl std::fmt::Debug for V4l2Camera {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("V4l2Camera")
            .field("identity", &self.identity)
            .finish_non_exhaustive()
    }
}

impl V4l2Camera {
    /// Opens the device that `settings` name and sets it up for images of `size_px`.
    ///
    /// # Errors
    /// It is absent, held by another program, or cannot do what is asked for.
    pub fn open(settings: &CameraSettings, size_px: (u32, u32)) -> Result<Self, CameraError> {
        let path = Path::new(&settings.id);
        let device =
            Device::with_path(path).map_err(|e| of_io(&settings.id, "cannot be opened", &e))?;
        let caps = device
            .query_caps()
            .map_err(|_| CameraError::Unsuitable(format!("{}: is no video device", settings.id)))?;
        let needed = Capability::VIDEO_CAPTURE | Capability::STREAMING;
        if !caps.capabilities.contains(needed) {
            return Err(CameraError::Unsuitable(format!(
                "{}: {} is no camera that streams",
                settings.id, caps.card
            )));
        }
        let identity = format!("{} {}", caps.card, caps.bus);
        let configured = configure::apply(&device, settings, size_px)?;
        let mut camera = Self {
            stream: None,
            converter: Converter::new(
                configured.layout,
                size_px,
                configured.stride,
                settings.white_level,
            ),
            device,
            identity,
            configured,
            buffers: settings.buffers as u32,
            numbers: Unwrapped::new(NUMBER_BITS, false),
            pending: VecDeque::new(),
            spare: Vec::new(),
        };
        // Whoever maps the buffers first has the camera: found out now rather than at the start.
        camera.stream = Some(camera.map(&settings.id)?);
        Ok(camera)
    }

    fn map(&self, name: &str) -> Result<MappedStream, CameraError> {
        MappedStream::map(&self.device, self.buffers).map_err(|e| of_io(name, "cannot stream", &e))
    }

    fn gone(&self, what: &str, error: &io::Error) -> CameraError {
        CameraError::Gone(format!("{}: {what}: {error}", self.identity))
    }

    /// Takes one buffer apart; what it says goes to `pending`.
    fn take(&mut self, taken: &Taken, index: usize) {
        let now_ns = monotonic_ns();
        let (number, skipped) = self.numbers.next(u64::from(taken.sequence));
        if skipped > 0 {
            self.pending.push_back(CameraEvent::Lost {
                kind: Loss::Skipped,
                frames: skipped,
            });
        }
        let mut image = self.spare.pop().unwrap_or_default();
        let raw = self
            .stream
            .as_ref()
            .and_then(|s| s.bytes(index, taken.bytes));
        let is_whole = !taken.is_damaged
            && raw.is_some_and(|raw| self.converter.convert(raw, &mut image).is_ok());
        if !is_whole {
            self.spare.push(image);
            self.pending.push_back(CameraEvent::Lost {
                kind: Loss::Unreadable,
                frames: 1,
            });
            return;
        }
        // Some drivers stamp by another clock, or not at all.
        let is_plausible =
            taken.is_monotonic && (0..MAX_AGE_NS).contains(&(now_ns - taken.stamp_ns));
        self.pending.push_back(CameraEvent::Frame(Frame {
            number,
            stamp_ns: if is_plausible { taken.stamp_ns } else { now_ns },
            arrived_ns: now_ns,
            image,
        }));
    }
}

/// A failure of the system as one of a camera.
fn of_io(name: &str, what: &str, error: &io::Error) -> CameraError {
    const EBUSY: i32 = 16;
    const ENODEV: i32 = 19;
    const ENXIO: i32 = 6;
    match error.raw_os_error() {
        Some(EBUSY) => CameraError::Busy(format!("{name}: another program holds it")),
        Some(ENODEV | ENXIO) => CameraError::Absent(format!("{name}: there is no such camera")),
        _ if error.kind() == io::ErrorKind::NotFound => {
            CameraError::Absent(format!("{name}: there is no such camera"))
        }
        _ => CameraError::Failed(format!("{name}: {what}: {error}")),
    }
}

impl FrameSource for V4l2Camera {
    fn size_px(&self) -> (u32, u32) {
        self.configured.size_px
    }

    fn identity(&self) -> String {
        self.identity.clone()
    }

    fn clock(&self) -> Clock {
        Clock::Host
    }

    fn start(&mut self) -> Result<(), CameraError> {
        if self.stream.is_none() {
            self.stream = Some(self.map(&self.identity)?);
        }
        self.numbers = Unwrapped::new(NUMBER_BITS, false);
        let started = self.stream.as_mut().map_or(Ok(()), MappedStream::start);
        started.map_err(|e| self.gone("cannot be started", &e))
    }

    fn next(&mut self, patience: Duration) -> Result<CameraEvent, CameraError> {
        if let Some(event) = self.pending.pop_front() {
            return Ok(event);
        }
        let Some(stream) = self.stream.as_mut().filter(|stream| stream.is_running()) else {
            std::thread::sleep(patience);
            return Ok(CameraEvent::Quiet);
        };
        let dequeued = stream.dequeue(patience);
        let Some((index, taken)) = dequeued.map_err(|e| self.gone("sends no more frames", &e))?
        else {
            return Ok(CameraEvent::Quiet);
        };
        self.take(&taken, index);
        let queued = self.stream.as_mut().map_or(Ok(()), |s| s.queue(index));
        queued.map_err(|e| self.gone("takes no more buffers", &e))?;
        Ok(self.pending.pop_front().unwrap_or(CameraEvent::Quiet))
    }

    fn stop(&mut self) {
        // Unmapped, too: buffers that wait would be as old as the stop.
        self.stream = None;
        self.pending.clear();
    }

    fn recycle(&mut self, image: GrayImage) {
        self.spare.push(image);
    }
}

/// A video device that captures.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Found {
    /// Where it is.
    pub device: PathBuf,
    /// What it is.
    pub card: String,
    /// Its driver.
    pub driver: String,
    /// Where on which bus it is.
    pub bus: String,
    /// Its pixel formats.
    pub pixel_formats: Vec<String>,
}

impl Found {
    /// A line for people.
    #[must_use]
    pub fn text(&self) -> String {
        format!(
            "{}  v4l2  {}, {} at {}, formats {}\n",
            self.device.display(),
            self.card,
            self.driver,
            self.bus,
            self.pixel_formats.join(", ")
        )
    }
}

/// All video devices that capture, in order.
#[must_use]
pub fn list() -> Vec<Found> {
    let entries = std::fs::read_dir("/dev").into_iter().flatten().flatten();
    let mut paths: Vec<PathBuf> = entries
        .map(|entry| entry.path())
        .filter(|path| number_of(path).is_some())
        .collect();
    paths.sort_by_key(|path| number_of(path));
    paths.iter().filter_map(|path| look(path)).collect()
}

/// The number in `/dev/videoN`.
fn number_of(path: &Path) -> Option<u32> {
    let name = path.file_name()?.to_str()?;
    name.strip_prefix("video")?.parse().ok()
}

fn look(path: &Path) -> Option<Found> {
    let device = Device::with_path(path).ok()?;
    let caps = device.query_caps().ok()?;
    if !caps.capabilities.contains(Capability::VIDEO_CAPTURE) {
        return None;
    }
    let formats = device.enum_formats().unwrap_or_default();
    Some(Found {
        device: path.to_owned(),
        card: caps.card,
        driver: caps.driver,
        bus: caps.bus,
        pixel_formats: formats.iter().map(|f| f.fourcc.to_string()).collect(),
    })
}
