//! Estimates, features and images in, to be worked on behind the pipeline's back: on a thread of its own, by
//! way of a queue.

use super::message::Latencies;
use crate::capture::StereoPair;
use crate::estimation::{Odometry, TrackedFeature};
use crate::image::GrayImage;
use crossbeam_channel::{Receiver, Sender, TrySendError, bounded};
use std::io;
use std::thread::JoinHandle;

/// Pairs on their way.
const QUEUE: usize = 8;

/// What is known of one pair.
#[derive(Default)]
pub(super) struct Entry {
    pub(super) estimate: Option<Odometry>,
    pub(super) latencies: Latencies,
    pub(super) features: Vec<TrackedFeature>,
    images: [GrayImage; 2],
    has_images: bool,
}

impl Entry {
    /// The images, where there are any.
    pub(super) fn images(&self) -> Option<[&GrayImage; 2]> {
        self.has_images.then(|| self.images.each_ref())
    }
}

/// Who works on pairs.
pub(super) trait Worker: Send + 'static {
    /// Works on one.
    ///
    /// # Errors
    /// It cannot go on.
    fn work(&mut self, entry: &Entry) -> io::Result<()>;

    /// Ends the work.
    ///
    /// # Errors
    /// What was under way is lost.
    fn finish(self) -> io::Result<()>;
}

/// What becomes of a pair for which the worker has no time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum WhenBehind {
    /// It is waited for.
    Wait,
    /// Its images are left out, and counted.
    LeaveOutImages,
    /// It is left out, and counted.
    LeaveOut,
}

/// The pipeline's end.
pub(super) struct Background {
    /// `None` once it is being ended, which is what stops the thread.
    to_worker: Option<Sender<Entry>>,
    spare: Receiver<Entry>,
    thread: Option<JoinHandle<io::Result<()>>>,
    when_behind: WhenBehind,
    left_out: u64,
}

impl Background {
    /// Starts the thread.
    pub(super) fn start(
        name: &str,
        worker: impl Worker,
        when_behind: WhenBehind,
    ) -> io::Result<Self> {
        let (to_worker, entries) = bounded(QUEUE);
        let (give_back, spare) = bounded(QUEUE);
        let thread = std::thread::Builder::new()
            .name(name.to_owned())
            .spawn(move || run(worker, &entries, &give_back))?;
        Ok(Self {
            to_worker: Some(to_worker),
            spare,
            thread: Some(thread),
            when_behind,
            left_out: 0,
        })
    }

    /// Hands over one pair's estimate, how long it took, the features that it rests on, and the images where
    /// there are any.
    ///
    /// # Errors
    /// Why the worker has ended.
    pub(super) fn add(
        &mut self,
        estimate: &Odometry,
        latencies: Latencies,
        tracked: impl Iterator<Item = TrackedFeature>,
        pair: Option<&StereoPair>,
    ) -> io::Result<()> {
        let Some(to_worker) = &self.to_worker else {
            return Ok(());
        };
        if self.when_behind == WhenBehind::LeaveOut && to_worker.is_full() {
            self.left_out += 1;
            return Ok(());
        }
        let is_behind = to_worker.len() >= QUEUE / 2;
        let taken = pair.filter(|_| self.when_behind == WhenBehind::Wait || !is_behind);
        if self.when_behind == WhenBehind::LeaveOutImages {
            self.left_out += u64::from(pair.is_some() && taken.is_none());
        }
        let mut entry = self.spare.try_recv().unwrap_or_default();
        entry.estimate = Some(estimate.clone());
        entry.latencies = latencies;
        entry.features.clear();
        entry.features.extend(tracked);
        entry.has_images = taken.is_some();
        if let Some(pair) = taken {
            for (kept, image) in entry.images.iter_mut().zip([&pair.left, &pair.right]) {
                kept.reshape(image.width(), image.height());
                kept.pixels_mut().copy_from_slice(image.pixels());
            }
        }
        let sent = match self.when_behind {
            WhenBehind::LeaveOut => match to_worker.try_send(entry) {
                Err(TrySendError::Disconnected(_)) => Err(()),
                _ => Ok(()),
            },
            _ => to_worker.send(entry).map_err(drop),
        };
        match sent {
            Ok(()) => Ok(()),
            Err(()) => self.end(),
        }
    }

    /// How much was left out because the worker was behind.
    pub(super) fn left_out(&self) -> u64 {
        self.left_out
    }

    /// Waits until all is done that is under way.
    ///
    /// # Errors
    /// The worker's.
    pub(super) fn end(&mut self) -> io::Result<()> {
        self.to_worker = None;
        let Some(thread) = self.thread.take() else {
            return Ok(());
        };
        thread
            .join()
            .unwrap_or_else(|_| Err(io::Error::other("the thread that works on it has failed")))
    }
}

impl Drop for Background {
    /// Whoever drops it has another failure to report.
    fn drop(&mut self) {
        let _ = self.end();
    }
}

fn run(
    mut worker: impl Worker,
    entries: &Receiver<Entry>,
    give_back: &Sender<Entry>,
) -> io::Result<()> {
    for entry in entries {
        worker.work(&entry)?;
        // A full pool has no use for one more.
        let _ = give_back.try_send(entry);
    }
    worker.finish()
}
