//! Two cameras in; stereo pairs out as they come, and what must be known about the cameras meanwhile.
//!
//! ```text
//! camera ─ supervisor (a thread) ─ clock ─┐
//!                                         ├─ pairing ─ a short queue ─ next_event
//! camera ─ supervisor (a thread) ─ clock ─┘
//! ```
//!
//! Nothing here waits for the stages: when they are late, pairs wait in a queue of few, whose oldest is
//! dropped and counted. While a camera is away, an event without images tells so several times a
//! second, so that the estimate is bridged and published all the same.

mod assembly;
mod journal;
mod queue;
mod shared;
mod spares;
mod status;
mod times;

pub use journal::{Entry, Fate};
pub use queue::{Delivery, Overflow};
pub(super) use shared::Shared;
pub use status::{CameraStatus, CaptureInstant, Snapshot, State};

use super::camera::{CameraError, Clock, FrameSource};
use super::pairing::MAX_WAITING;
use super::settings::Settings;
use super::supervisor::{Opener, Supervisor, open_patiently};
use super::{PairEvent, PairSource, Side, StereoPair};
use assembly::SILENCE;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Two cameras as a source of pairs.
#[derive(Debug)]
pub struct LiveSource {
    shared: Arc<Shared>,
    threads: Vec<JoinHandle<()>>,
    delivery: Delivery,
}

/// Looks at the cameras while somebody else has the [`LiveSource`], and ends its run.
#[derive(Clone, Debug)]
pub struct Monitor(Arc<Shared>);

impl LiveSource {
    /// Opens both cameras, waiting for them as long as `settings` say, and starts them.
    ///
    /// `is_over` is asked while waiting whether there is any use in it still.
    ///
    /// # Errors
    /// A camera cannot be opened; or both are the same. The message names the side.
    pub fn open(
        settings: &Settings,
        openers: [Opener; 2],
        delivery: Delivery,
        is_over: impl Fn() -> bool + Sync,
    ) -> Result<Self, CameraError> {
        let [left, right] = std::thread::scope(|scope| {
            let waiting = openers.each_ref().map(|opener| {
                scope.spawn(|| open_patiently(opener, settings.patience(), &is_over))
            });
            waiting.map(|thread| {
                thread
                    .join()
                    .unwrap_or_else(|_| Err(CameraError::Failed("its driver panicked".to_owned())))
            })
        });
        let sources = [
            left.map_err(|e| of_side(Side::Left, e))?,
            right.map_err(|e| of_side(Side::Right, e))?,
        ];
        let identities = sources.each_ref().map(|source| source.identity());
        let is_file = sources[0].clock() == Clock::Shared;
        if identities[0] == identities[1] && !is_file {
            return Err(CameraError::Unsuitable(format!(
                "camera.left and camera.right are the same camera: {}",
                identities[0]
            )));
        }
        let shared = Shared::new(
            settings.clone(),
            delivery,
            sources
                .each_ref()
                .map(|source| &**source as &dyn FrameSource),
        );
        let shared = Arc::new(shared);
        let mut live = Self {
            shared: Arc::clone(&shared),
            threads: Vec::new(),
            delivery,
        };
        let sides = [Side::Left, Side::Right].into_iter();
        for ((side, source), opener) in sides.zip(sources).zip(openers) {
            let supervisor = Supervisor {
                side,
                opener,
                shared: Arc::clone(&shared),
                settings: settings.clone(),
            };
            let thread = std::thread::Builder::new()
                .name(format!("camera-{}", name_of(side)))
                .spawn(move || supervisor.run(source))
                .map_err(|e| CameraError::Failed(format!("a thread cannot be started: {e}")))?;
            live.threads.push(thread);
        }
        Ok(live)
    }

    /// A handle for others.
    #[must_use]
    pub fn monitor(&self) -> Monitor {
        Monitor(Arc::clone(&self.shared))
    }
}

fn of_side(side: Side, error: CameraError) -> CameraError {
    error.of(&format!("camera.{}", name_of(side)))
}

/// `left` or `right`.
#[must_use]
pub fn name_of(side: Side) -> &'static str {
    match side {
        Side::Left => "left",
        Side::Right => "right",
    }
}

impl Drop for LiveSource {
    fn drop(&mut self) {
        self.shared.stop();
        for thread in self.threads.drain(..) {
            // A panic in it has been reported already.
            let _ = thread.join();
        }
    }
}

impl PairSource for LiveSource {
    fn next_event(&mut self) -> Option<PairEvent> {
        let mut assembly = self.shared.lock();
        loop {
            if assembly.is_over {
                return None;
            }
            if let Some(event) = assembly.ready.pop() {
                assembly.last_event = Instant::now();
                return Some(event);
            }
            if assembly.ended == [true; 2] {
                return None;
            }
            if let Some(event) = assembly.silence(&self.shared.settings) {
                return Some(event);
            }
            assembly = self.shared.wait(assembly, SILENCE / 4);
        }
    }

    fn is_live(&self) -> bool {
        self.delivery.overflow == Overflow::Oldest
    }

    /// As many images as can be under way: with the consumer, in the queue, and in the pairer.
    fn make_room(&mut self, pairs_held: usize) {
        let count = pairs_held + self.delivery.queue + MAX_WAITING;
        self.shared.lock().spares.grow(count);
    }

    fn recycle(&mut self, pair: StereoPair) {
        self.shared.lock().recycle(pair);
    }
}

impl Monitor {
    /// How the cameras are.
    #[must_use]
    pub fn snapshot(&self) -> Snapshot {
        let assembly = self.0.lock();
        let mut cameras = assembly.cameras.clone();
        let looks = self.0.looks_ns.iter().zip(assembly.times.maps());
        for (camera, (look_ns, clock)) in cameras.iter_mut().zip(looks) {
            camera.last_look_ns = look_ns.load(Ordering::Relaxed);
            camera.clock = clock.estimate();
        }
        Snapshot {
            cameras,
            pairs: assembly.pairs,
            dropped: assembly.dropped,
            waiting: assembly.ready.pairs(),
            period_ns: assembly.usual_period_ns,
        }
    }

    /// When a pair of the recent past was taken.
    #[must_use]
    pub fn captured(&self, sequence: u64) -> Option<CaptureInstant> {
        let assembly = self.0.lock();
        let found = assembly
            .captured
            .iter()
            .rev()
            .find(|(of, _)| *of == sequence);
        found.map(|(_, instant)| *instant)
    }

    /// What became of frames since the last call, if a journal is kept.
    #[must_use]
    pub fn take_journal(&self) -> Vec<Entry> {
        self.0.lock().journal.take()
    }

    /// Waits; true if the run ended meanwhile.
    #[must_use]
    pub fn waits_out(&self, time: Duration) -> bool {
        self.0.waits_out(time)
    }

    /// Ends the run: the source has no more events.
    pub fn stop(&self) {
        self.0.stop();
    }
}

#[cfg(test)]
mod tests;
