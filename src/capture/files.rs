//! One side of a recording in; its frames out as a camera would hand them out.

use super::camera::{CameraError, CameraEvent, Clock, Frame, FrameSource, Loss, monotonic_ns};
use super::dataset::{Dataset, ImageFiles, PairFiles};
use super::{Side, decode::Decoder};
use crate::image::GrayImage;
use std::path::PathBuf;
use std::time::Duration;

/// One camera of a [`Dataset`]. A frame comes when it is due by its stamp; one that is missing or
/// unreadable is lost.
#[derive(Debug)]
pub struct FileCamera {
    pairs: Vec<PairFiles>,
    side: Side,
    size_px: (u32, u32),
    identity: String,
    decoder: Decoder,
    next: usize,
    started_ns: Option<i64>,
    spare: Vec<GrayImage>,
}

impl FileCamera {
    /// The camera of one side of a recording, which begins with the first frame.
    ///
    /// # Errors
    /// The images are not as large as the rig says.
    pub fn open(dataset: &Dataset, side: Side, name: &str) -> Result<Self, CameraError> {
        let camera = Self::new(dataset, side, name);
        let first = (0..camera.pairs.len()).find_map(|at| camera.file(at));
        let size = first.and_then(|file| Decoder::default().size_px(file).ok());
        match size {
            Some(size) if size != camera.size_px => Err(CameraError::Unsuitable(format!(
                "{name}: has images of {}×{} px, but the rig's have {}×{}",
                size.0, size.1, camera.size_px.0, camera.size_px.1
            ))),
            _ => Ok(camera),
        }
    }

    fn new(dataset: &Dataset, side: Side, name: &str) -> Self {
        let camera = match side {
            Side::Left => &dataset.rig.left,
            Side::Right => &dataset.rig.right,
        };
        Self {
            pairs: dataset.pairs.clone(),
            side,
            size_px: (camera.width, camera.height),
            identity: format!("{name} ({} recording)", dataset.layout),
            decoder: Decoder::new(dataset.settings.white_level),
            next: 0,
            started_ns: None,
            spare: Vec::new(),
        }
    }

    fn file(&self, at: usize) -> Option<&PathBuf> {
        match (&self.pairs[at].images, self.side) {
            (ImageFiles::Both { left, .. }, Side::Left) => Some(left),
            (ImageFiles::Both { right, .. }, Side::Right) => Some(right),
            (ImageFiles::Unpaired { .. }, _) => None,
        }
    }
}

impl FrameSource for FileCamera {
    fn size_px(&self) -> (u32, u32) {
        self.size_px
    }

    fn identity(&self) -> String {
        self.identity.clone()
    }

    fn clock(&self) -> Clock {
        Clock::Shared
    }

    fn start(&mut self) -> Result<(), CameraError> {
        if self.started_ns.is_none() {
            let stamp_ns = self
                .pairs
                .get(self.next)
                .map_or(0, |pair| pair.timestamp_ns);
            self.started_ns = Some(monotonic_ns() - stamp_ns);
        }
        Ok(())
    }

    fn next(&mut self, patience: Duration) -> Result<CameraEvent, CameraError> {
        let Some(started_ns) = self.started_ns else {
            std::thread::sleep(patience);
            return Ok(CameraEvent::Quiet);
        };
        let Some(pair) = self.pairs.get(self.next) else {
            return Ok(CameraEvent::End);
        };
        let stamp_ns = pair.timestamp_ns;
        let due_ns = started_ns + stamp_ns;
        let wait_ns = u64::try_from(due_ns - monotonic_ns()).unwrap_or(0);
        std::thread::sleep(Duration::from_nanos(wait_ns).min(patience));
        if monotonic_ns() < due_ns {
            return Ok(CameraEvent::Quiet);
        }
        let at = self.next;
        self.next += 1;
        let lost = |kind| Ok(CameraEvent::Lost { kind, frames: 1 });
        let Some(file) = self.file(at).cloned() else {
            return lost(Loss::Skipped);
        };
        let mut image = self.spare.pop().unwrap_or_default();
        match self.decoder.decode(&file, Some(self.size_px), &mut image) {
            Ok(()) => Ok(CameraEvent::Frame(Frame {
                number: at as u64,
                stamp_ns,
                arrived_ns: monotonic_ns(),
                image,
            })),
            Err(_) => lost(Loss::Unreadable),
        }
    }

    fn stop(&mut self) {
        self.started_ns = None;
    }

    fn recycle(&mut self, image: GrayImage) {
        self.spare.push(image);
    }
}
