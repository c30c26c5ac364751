//! The threads: a source of pairs in, odometry rows out, in order.
//!
//! ```text
//! source ─ feeder ─┬─ feature worker 1 ─┬─ method (the caller's thread) ─ deliver
//!                  └─ feature worker n ─┘
//! ```
//!
//! Workers take images, left and right alike, as they come; rows leave in the order of the pairs,
//! and what is in them does not depend on how many workers there are. A fixed number of pairs is
//! under way at once, or fewer where a live source is too fast ([`super::overlap`]): their buffers go round,
//! so that nothing is allocated after the first few.

use super::method::{Described, DescribedPair, Method, StepError};
use super::overlap::Overlap;
use crate::capture::{PairEvent, PairSource, Side, Skew, StereoPair, Unusable};
use crate::estimation::{Odometry, PairStamp};
use crate::features::Extractor;
use crate::image::GrayImage;
use crate::queue::{bounded, prepare_thread};
use crate::rig_watch::RigState;
use crate::settings::SettingError;
use crossbeam_channel::{Receiver, Sender};
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;
use std::ops::ControlFlow;
use std::time::{Duration, Instant};

/// How the work is spread over threads.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// Threads that find features. 0 to 64, default 0: as many as the machine has processors. The
    /// results do not depend on it.
    pub workers: usize,
}

impl Settings {
    /// Refuses values out of range.
    ///
    /// # Errors
    /// The first setting out of range.
    pub fn check(&self) -> Result<(), SettingError> {
        SettingError::unless_in("workers", self.workers, 0..=64)
    }

    /// The number of feature workers on this machine.
    #[must_use]
    pub fn worker_count(&self) -> usize {
        if self.workers > 0 {
            return self.workers;
        }
        std::thread::available_parallelism().map_or(2, std::num::NonZero::get)
    }
}

/// How long one pair took, stage by stage.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct StageLatencies {
    /// The slower image's detection and description.
    pub features: Duration,
    /// Left–right and over time.
    pub matching: Duration,
    /// Triangulation to pose.
    pub estimation: Duration,
    /// From the pair's arrival to its row.
    pub total: Duration,
}

/// One pair's row, ready to be published.
pub struct Delivery<'a> {
    /// The estimate.
    pub odometry: &'a Odometry,
    /// How long it took; zero for a pair that was not usable.
    pub latencies: StageLatencies,
    /// Why the pair was not usable, where it was not.
    pub unusable: Option<Fault<'a>>,
    /// The images, where there are both.
    pub pair: Option<&'a StereoPair>,
    /// How the rig is, where it is watched.
    pub rig: Option<RigState>,
    /// The method as the pair has left it, for its [tracked features](Method::tracked).
    pub method: &'a Method,
}

/// Why a pair could not be used, and who found out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Fault<'a> {
    /// The stage that it got no further than.
    pub stage: Stage,
    /// The reason, for a person.
    pub why: &'a str,
}

/// The stages that a pair may fail in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// Its images never came, or cannot be read.
    Capture,
    /// No features could be looked for.
    Features,
    /// An image is one that the camera has shown before.
    Repeats,
    /// Its features could not be matched.
    Matching,
}

/// Why a run ended early.
#[derive(Debug, thiserror::Error)]
pub enum PipelineError<E> {
    /// The receiver of rows gave up.
    #[error("{0}")]
    Deliver(E),
    /// A thread could not be started.
    #[error("a thread cannot be started: {0}")]
    Thread(std::io::Error),
    /// A thread ended before its work did.
    #[error("a feature worker ended unexpectedly: this is a fault of the program")]
    Worker,
}

/// Pairs under way at once, beyond one a worker: no thread ever waits for another's buffers.
const SLACK_PAIRS: usize = 2;

/// How many pairs may be under way at once. Of live ones only as many as are worked on, one by the method and
/// the others by two workers each: when the stages are late, pairs wait with the source, which drops the
/// stalest, and not in here, where each that waits makes all that follow later.
fn pairs_under_way(is_live: bool, workers: usize) -> usize {
    if is_live {
        1 + workers.div_ceil(2)
    } else {
        workers + SLACK_PAIRS
    }
}

/// Carries every pair of `source` through `method` and hands each row to `deliver`, in order,
/// until the source ends or `deliver` breaks off. No pair is dropped here.
///
/// `extractors` holds one for each feature worker, all alike.
///
/// # Errors
/// What `deliver` failed with, or the system's refusal of a thread.
pub fn run<S: PairSource, E>(
    mut source: S,
    extractors: Vec<Box<dyn Extractor>>,
    method: &mut Method,
    mut deliver: impl FnMut(Delivery<'_>) -> Result<ControlFlow<()>, E>,
) -> Result<(), PipelineError<E>> {
    prepare_thread();
    let under_way = pairs_under_way(source.is_live(), extractors.len());
    let wants_right = method.wants_right_features();
    source.make_room(under_way);
    let (jobs_in, jobs) = bounded::<Job>(2 * under_way);
    let (done_in, done) = bounded::<Done>(2 * under_way + extractors.len() + 1);
    let (spare_in, spare) = bounded::<Spare>(under_way);
    for _ in 0..under_way {
        // The queue has room for exactly these.
        let _ = spare_in.send(Spare::default());
    }
    std::thread::scope(|scope| {
        for (n, extractor) in extractors.into_iter().enumerate() {
            let (jobs, done) = (jobs.clone(), done_in.clone());
            std::thread::Builder::new()
                .name(format!("features-{n}"))
                .spawn_scoped(scope, move || work(extractor, wants_right, &jobs, &done))
                .map_err(PipelineError::Thread)?;
        }
        std::thread::Builder::new()
            .name("feeder".to_owned())
            .spawn_scoped(scope, move || {
                feed(source, under_way, &spare, &jobs_in, &done_in);
            })
            .map_err(PipelineError::Thread)?;
        // Whatever ends this loop drops its ends of the queues, which ends the threads.
        drop(jobs);
        let pending = VecDeque::with_capacity(under_way);
        collect(&done, spare_in, pending, method, &mut deliver)
    })
}

/// Buffers that go round.
#[derive(Default)]
struct Spare {
    used: Option<StereoPair>,
    left: Described,
    right: Described,
}

/// One image to find features in.
struct Job {
    ticket: u64,
    stamp: PairStamp,
    skew: Skew,
    arrived: Instant,
    side: Side,
    image: GrayImage,
    described: Described,
}

/// What comes back: tickets count the source's events.
#[expect(
    clippy::large_enum_variant,
    reason = "a queue of few; boxes would be allocated for every image"
)]
enum Done {
    Side {
        job: Job,
        took: Duration,
        failed: Option<String>,
    },
    Unusable {
        ticket: u64,
        unusable: Unusable,
        buffers: Spare,
    },
    WorkerDied,
}

/// Buffers that are not in use, of those that go round.
struct Spares<'a> {
    coming_back: &'a Receiver<Spare>,
    /// Held back, so that fewer pairs are under way.
    held: Vec<Spare>,
    all: usize,
}

impl Spares<'_> {
    /// Those for one more pair, as soon as it is one of `under_way` at most; `None` when the run is over.
    fn take<S: PairSource>(&mut self, under_way: usize, source: &mut S) -> Option<Spare> {
        loop {
            if self.held.len() > self.all - under_way {
                return self.held.pop();
            }
            let mut buffers = self.coming_back.recv().ok()?;
            if let Some(pair) = buffers.used.take() {
                source.recycle(pair);
            }
            self.held.push(buffers);
        }
    }
}

/// Reads the source as fast as buffers come back; a live one with fewer of them where it is too fast.
fn feed<S: PairSource>(
    mut source: S,
    under_way: usize,
    spare: &Receiver<Spare>,
    jobs: &Sender<Job>,
    done: &Sender<Done>,
) {
    let mut ticket = 0;
    let mut spares = Spares {
        coming_back: spare,
        held: Vec::with_capacity(under_way),
        all: under_way,
    };
    let mut overlap = Overlap::new(under_way);
    let (is_live, began) = (source.is_live(), Instant::now());
    prepare_thread();
    while let Some(buffers) = spares.take(overlap.under_way(), &mut source) {
        let asked = Instant::now();
        let sent = match source.next_event() {
            None => return,
            Some(PairEvent::Unusable(unusable)) => done
                .send(Done::Unusable {
                    ticket,
                    unusable,
                    buffers,
                })
                .is_ok(),
            Some(PairEvent::Pair(pair)) => {
                let arrived = Instant::now();
                let waited = arrived.duration_since(asked);
                if is_live && overlap.take(pair.sequence, arrived.duration_since(began), waited) {
                    let under_way = overlap.under_way();
                    tracing::info!(under_way, "pairs under way at once, for how fast they come");
                }
                let stamp = PairStamp {
                    sequence: pair.sequence,
                    timestamp_ns: pair.timestamp_ns,
                };
                let skew = pair.skew;
                let job = |side, image, described| Job {
                    ticket,
                    stamp,
                    skew,
                    arrived,
                    side,
                    image,
                    described,
                };
                let left = job(Side::Left, pair.left, buffers.left);
                let right = job(Side::Right, pair.right, buffers.right);
                jobs.send(left).is_ok() && jobs.send(right).is_ok()
            }
        };
        if !sent {
            return;
        }
        ticket += 1;
    }
}

/// Finds features until there are no more images; in right ones only where they are wanted.
fn work(
    mut extractor: Box<dyn Extractor>,
    wants_right: bool,
    jobs: &Receiver<Job>,
    done: &Sender<Done>,
) {
    /// Tells the collector if the worker dies, so that it does not wait for ever.
    struct Alarm<'a>(&'a Sender<Done>);
    impl Drop for Alarm<'_> {
        fn drop(&mut self) {
            if std::thread::panicking() {
                let _ = self.0.send(Done::WorkerDied);
            }
        }
    }
    let _alarm = Alarm(done);
    prepare_thread();
    while let Ok(mut job) = jobs.recv() {
        let started = Instant::now();
        let result = if job.side == Side::Left || wants_right {
            extractor.extract(&job.image, &mut job.described.features)
        } else {
            Ok(())
        };
        job.described.take(&job.image);
        let side = Done::Side {
            took: started.elapsed(),
            failed: result.err().map(|e| e.to_string()),
            job,
        };
        if done.send(side).is_err() {
            return;
        }
    }
}

/// One event on its way, complete once both sides are there.
enum Pending {
    Waiting,
    Half(Half),
    Pair { left: Half, right: Half },
    Unusable { unusable: Unusable, buffers: Spare },
}

/// One described image.
struct Half {
    job: Job,
    took: Duration,
    failed: Option<String>,
}

/// Puts events back in order and steps the method through them. `pending` is empty, with room for
/// all that are under way.
fn collect<E>(
    done: &Receiver<Done>,
    spare: Sender<Spare>,
    mut pending: VecDeque<Pending>,
    method: &mut Method,
    deliver: &mut impl FnMut(Delivery<'_>) -> Result<ControlFlow<()>, E>,
) -> Result<(), PipelineError<E>> {
    let mut first_ticket = 0;
    let mut described = DescribedPair::default();
    let slot = |pending: &mut VecDeque<Pending>, first: u64, ticket: u64| -> usize {
        let at = (ticket - first) as usize;
        while pending.len() <= at {
            pending.push_back(Pending::Waiting);
        }
        at
    };
    while let Ok(message) = done.recv() {
        match message {
            Done::WorkerDied => return Err(PipelineError::Worker),
            Done::Unusable {
                ticket,
                unusable,
                buffers,
            } => {
                let at = slot(&mut pending, first_ticket, ticket);
                pending[at] = Pending::Unusable { unusable, buffers };
            }
            Done::Side { job, took, failed } => {
                let at = slot(&mut pending, first_ticket, job.ticket);
                let half = Half { job, took, failed };
                pending[at] = match std::mem::replace(&mut pending[at], Pending::Waiting) {
                    Pending::Half(other) if other.job.side == Side::Left => Pending::Pair {
                        left: other,
                        right: half,
                    },
                    Pending::Half(other) => Pending::Pair {
                        left: half,
                        right: other,
                    },
                    _ => Pending::Half(half),
                };
            }
        }
        while let Some(Pending::Pair { .. } | Pending::Unusable { .. }) = pending.front() {
            let event = pending.pop_front();
            first_ticket += 1;
            let Some(outcome) = event.and_then(|event| step(event, method, &mut described)) else {
                continue;
            };
            let delivery = Delivery {
                odometry: &outcome.odometry,
                latencies: outcome.latencies,
                unusable: outcome
                    .fault
                    .as_ref()
                    .map(|(stage, why)| Fault { stage: *stage, why }),
                pair: outcome.buffers.used.as_ref(),
                rig: method.rig_state(),
                method,
            };
            if deliver(delivery)
                .map_err(PipelineError::Deliver)?
                .is_break()
            {
                return Ok(());
            }
            // The feeder may be gone already, having read the source to its end.
            let _ = spare.send(outcome.buffers);
        }
    }
    Ok(())
}

/// What one event came to, and its buffers.
struct Outcome {
    odometry: Odometry,
    latencies: StageLatencies,
    fault: Option<(Stage, String)>,
    buffers: Spare,
}

fn stage_of(error: &StepError) -> Stage {
    match error {
        StepError::Repeated(_) => Stage::Repeats,
        StepError::Match(_) => Stage::Matching,
    }
}

/// Takes one complete event through the method. `described` only lends its memory.
fn step(event: Pending, method: &mut Method, described: &mut DescribedPair) -> Option<Outcome> {
    match event {
        Pending::Waiting | Pending::Half(_) => None,
        Pending::Unusable { unusable, buffers } => {
            let stamp = PairStamp {
                sequence: unusable.sequence,
                timestamp_ns: unusable.timestamp_ns.unwrap_or(described.timestamp_ns),
            };
            Some(Outcome {
                odometry: method.skip(stamp),
                latencies: StageLatencies::default(),
                fault: Some((Stage::Capture, unusable.why)),
                buffers,
            })
        }
        Pending::Pair { left, right } => {
            let stamp = left.job.stamp;
            *described = DescribedPair {
                sequence: stamp.sequence,
                timestamp_ns: stamp.timestamp_ns,
                skew: left.job.skew,
                left: left.job.described,
                right: right.job.described,
            };
            let stepped = match left.failed.or(right.failed) {
                Some(why) => Err((Stage::Features, why)),
                None => method
                    .step(described)
                    .map_err(|e| (stage_of(&e), e.to_string())),
            };
            let (odometry, fault) = match stepped {
                Ok(odometry) => (odometry, None),
                Err(fault) => (method.skip(stamp), Some(fault)),
            };
            let times = method.times();
            Some(Outcome {
                odometry,
                latencies: StageLatencies {
                    features: left.took.max(right.took),
                    matching: times.matching,
                    estimation: times.estimation,
                    total: left.job.arrived.elapsed(),
                },
                fault,
                buffers: Spare {
                    used: Some(StereoPair {
                        sequence: stamp.sequence,
                        timestamp_ns: stamp.timestamp_ns,
                        skew: left.job.skew,
                        left: left.job.image,
                        right: right.job.image,
                    }),
                    left: std::mem::take(&mut described.left),
                    right: std::mem::take(&mut described.right),
                },
            })
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::features;
    use crate::simulation::{
        SceneName, Settings as Simulated, Simulation, TrajectoryName, small_rig,
    };
    use std::convert::Infallible;
    use std::sync::Arc;
    use std::sync::atomic::{AtomicU64, Ordering};

    /// A source that always has one more pair, `came` after the last one, and counts those that it was asked for.
    struct Eager {
        pair: StereoPair,
        is_live: bool,
        came: u64,
        asked_for: Arc<AtomicU64>,
    }

    impl PairSource for Eager {
        fn next_event(&mut self) -> Option<PairEvent> {
            let sequence = self.came * self.asked_for.fetch_add(1, Ordering::SeqCst);
            Some(PairEvent::Pair(StereoPair {
                sequence,
                timestamp_ns: 100_000_000 * sequence as i64,
                ..self.pair.clone()
            }))
        }

        fn is_live(&self) -> bool {
            self.is_live
        }
    }

    /// The numbers of pairs under way when a row comes, of 40 rows of which each takes its time.
    fn under_way(is_live: bool, workers: usize, came: u64) -> Vec<u64> {
        let (scene, way) = (SceneName::Room, TrajectoryName::LoopRoom);
        let simulation = Simulation::new(scene, way, small_rig(), Simulated::default());
        let simulation = simulation.expect("fits");
        let asked_for = Arc::new(AtomicU64::new(0));
        let source = Eager {
            pair: simulation.pair(0).0,
            is_live,
            came,
            asked_for: Arc::clone(&asked_for),
        };
        let mut settings = features::Settings::default();
        settings.surf.budget = 50;
        let extractors = (0..workers).map(|_| features::extractor(&settings).expect("valid"));
        let mut method = Method::new(small_rig(), Default::default(), Default::default())
            .expect("has a baseline");
        let mut under_way = Vec::new();
        let run = run(source, extractors.collect(), &mut method, |_| {
            // Long enough for all others to take what they may.
            std::thread::sleep(Duration::from_millis(20));
            under_way.push(asked_for.load(Ordering::SeqCst) - under_way.len() as u64);
            Ok::<_, Infallible>(if under_way.len() < 40 {
                ControlFlow::Continue(())
            } else {
                ControlFlow::Break(())
            })
        });
        assert!(run.is_ok());
        under_way
    }

    #[test]
    fn live_pairs_wait_with_their_source_and_recorded_ones_in_the_pipeline() {
        // The one whose row it is, and one in which features are looked for.
        assert_eq!(under_way(true, 2, 1).into_iter().max(), Some(2));
        assert_eq!(under_way(true, 4, 1).into_iter().max(), Some(3));
        assert_eq!(under_way(false, 2, 1).into_iter().max(), Some(4));
    }

    #[test]
    fn of_live_pairs_that_come_twice_as_fast_as_they_are_handled_one_is_under_way() {
        let live = under_way(true, 2, 2);
        assert_eq!(live[..10].iter().max(), Some(&2));
        assert!(live[24..].iter().all(|n| *n == 1), "{live:?}");
        // Whatever the numbers of recorded ones are, they are in no hurry.
        assert_eq!(under_way(false, 2, 2)[24..].iter().max(), Some(&4));
    }
}
