//! Estimates and images in, a recording on the disk out, without the pipeline waiting for PNGs.

use super::McapWriter;
use crate::capture::StereoPair;
use crate::estimation::{Odometry, TrackedFeature};
use crate::geometry::StereoRig;
use crate::output::background::{Background, Entry, WhenBehind, Worker};
use crate::output::message::Latencies;
use std::fs::File;
use std::io::{self, BufWriter};
use std::path::Path;

/// Writes a recording on a thread of its own.
pub struct McapRecorder(Background);

impl McapRecorder {
    /// Creates or empties a file and starts the thread. With `waits`, every image is written, however
    /// long that takes; without, images are left out while the writer is behind.
    ///
    /// # Errors
    /// The file cannot be created, or the system refuses a thread.
    pub fn create(path: &Path, rig: &StereoRig, waits: bool) -> io::Result<Self> {
        let writer = McapWriter::new(BufWriter::new(File::create(path)?), rig)?;
        let when_behind = match waits {
            true => WhenBehind::Wait,
            false => WhenBehind::LeaveOutImages,
        };
        Ok(Self(Background::start("mcap", writer, when_behind)?))
    }

    /// Hands over one pair's estimate, the features that it rests on, and the images where there are any.
    ///
    /// # Errors
    /// The file cannot be written any more.
    pub fn add(
        &mut self,
        estimate: &Odometry,
        tracked: impl Iterator<Item = TrackedFeature>,
        pair: Option<&StereoPair>,
    ) -> io::Result<()> {
        self.0.add(estimate, Latencies::default(), tracked, pair)
    }

    /// Pairs whose images were left out because the writer was behind.
    #[must_use]
    pub fn left_out(&self) -> u64 {
        self.0.left_out()
    }

    /// Writes what is still under way and ends the file.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn finish(mut self) -> io::Result<()> {
        self.0.end()
    }
}

impl Worker for McapWriter<BufWriter<File>> {
    fn work(&mut self, entry: &Entry) -> io::Result<()> {
        match &entry.estimate {
            Some(estimate) => self.add(estimate, &entry.features, entry.images()),
            None => Ok(()),
        }
    }

    fn finish(self) -> io::Result<()> {
        Self::finish(self)
    }
}
