//! Estimates and images in, a recording on the disk out, without the pipeline waiting for PNGs.

use super::McapWriter;
use crate::capture::StereoPair;
use crate::estimation::Odometry;
use crate::geometry::StereoRig;
use crate::image::GrayImage;
use crossbeam_channel::{Receiver, Sender, bounded};
use std::fs::File;
use std::io::{self, BufWriter};
use std::path::Path;
use std::thread::JoinHandle;

/// Estimates on their way to the disk.
const QUEUE: usize = 8;

/// Writes a recording on a thread of its own.
pub struct McapRecorder {
    /// `None` once it is being ended, which is what stops the thread.
    to_writer: Option<Sender<Entry>>,
    spare: Receiver<[GrayImage; 2]>,
    thread: Option<JoinHandle<io::Result<()>>>,
    waits: bool,
    left_out: u64,
}

struct Entry {
    estimate: Odometry,
    images: Option<[GrayImage; 2]>,
}

impl McapRecorder {
    /// Creates or empties a file and starts the thread. With `waits`, every image is written, however
    /// long that takes; without, images are left out while the writer is behind.
    ///
    /// # Errors
    /// The file cannot be created, or the system refuses a thread.
    pub fn create(path: &Path, rig: &StereoRig, waits: bool) -> io::Result<Self> {
        let writer = McapWriter::new(BufWriter::new(File::create(path)?), rig)?;
        let (to_writer, entries) = bounded(QUEUE);
        let (give_back, spare) = bounded(QUEUE);
        let thread = std::thread::Builder::new()
            .name("mcap".to_owned())
            .spawn(move || write(writer, &entries, &give_back))?;
        Ok(Self {
            to_writer: Some(to_writer),
            spare,
            thread: Some(thread),
            waits,
            left_out: 0,
        })
    }

    /// Hands one pair's estimate over, and its images where there are any.
    ///
    /// # Errors
    /// The file cannot be written any more.
    pub fn add(&mut self, estimate: &Odometry, pair: Option<&StereoPair>) -> io::Result<()> {
        let Some(to_writer) = &self.to_writer else {
            return Ok(());
        };
        let is_behind = to_writer.len() >= QUEUE / 2;
        let images = pair.filter(|_| self.waits || !is_behind).map(|pair| {
            let mut images = self.spare.try_recv().unwrap_or_default();
            for (kept, image) in images.iter_mut().zip([&pair.left, &pair.right]) {
                kept.reshape(image.width(), image.height());
                kept.pixels_mut().copy_from_slice(image.pixels());
            }
            images
        });
        self.left_out += u64::from(pair.is_some() && images.is_none());
        let entry = Entry {
            estimate: estimate.clone(),
            images,
        };
        if to_writer.send(entry).is_err() {
            return self.end();
        }
        Ok(())
    }

    /// Pairs whose images were left out because the writer was behind.
    #[must_use]
    pub fn left_out(&self) -> u64 {
        self.left_out
    }

    /// Writes what is still under way and ends the file.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn finish(mut self) -> io::Result<()> {
        self.end()
    }

    fn end(&mut self) -> io::Result<()> {
        self.to_writer = None;
        let Some(thread) = self.thread.take() else {
            return Ok(());
        };
        thread
            .join()
            .unwrap_or_else(|_| Err(io::Error::other("the thread that writes it has failed")))
    }
}

impl Drop for McapRecorder {
    /// Whoever drops it has another failure to report.
    fn drop(&mut self) {
        let _ = self.end();
    }
}

fn write(
    mut writer: McapWriter<BufWriter<File>>,
    entries: &Receiver<Entry>,
    give_back: &Sender<[GrayImage; 2]>,
) -> io::Result<()> {
    for entry in entries {
        let images = entry.images.as_ref().map(<[GrayImage; 2]>::each_ref);
        writer.add(&entry.estimate, images)?;
        if let Some(images) = entry.images {
            // A full pool has no use for one more.
            let _ = give_back.try_send(images);
        }
    }
    writer.finish()
}
