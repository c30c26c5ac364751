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

use super::camera::{CameraError, Clock, Frame, Loss, Losses, monotonic_ns, realtime_ns};
use super::clock::{ClockEstimate, ClockEvent, ClockMap};
use super::pairing::{Candidate, PairBy, Paired, Pairer, Skew, WhyUnmatched};
use super::settings::{Clocks, Settings, Stamps};
use super::supervisor::{Opener, Supervisor, open_patiently};
use super::{PairEvent, PairSource, Side, StereoPair, Unusable};
use crate::image::GrayImage;
use std::collections::VecDeque;
use std::sync::atomic::{AtomicI64, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// 1 σ of stamps by a clock that both cameras share, ns.
const SIGMA_SHARED_NS: f64 = 1_000.0;
/// 1 σ of the kernel's stamps: how late an interrupt may be, ns.
const SIGMA_HOST_NS: f64 = 100_000.0;
/// Without a pair for this long, the stages are told so.
const SILENCE: Duration = Duration::from_millis(200);
/// The same before the first pair, when there is nothing to bridge yet.
const FIRST_SILENCE: Duration = Duration::from_secs(1);
/// Capture times of the last pairs that can be asked for.
const TIMES_KEPT: usize = 256;
/// Entries of a journal that nobody reads.
const JOURNAL_KEPT: usize = 100_000;

/// What a camera is doing.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum State {
    /// Being opened; no frame yet.
    #[default]
    Opening,
    /// Sending frames.
    Streaming,
    /// Open, but silent for too long.
    Stalled,
    /// Gone; it is opened anew as soon as it is back.
    Lost,
}

impl State {
    /// The word of logs and summaries.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Opening => "opening",
            Self::Streaming => "streaming",
            Self::Stalled => "stalled",
            Self::Lost => "lost",
        }
    }
}

/// What is known about one camera. Counters never fall.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CameraStatus {
    /// Which camera it is.
    pub identity: String,
    /// What it is doing.
    pub state: State,
    /// Why, where it is not streaming.
    pub cause: String,
    /// Frames received.
    pub frames: u64,
    /// Times that it was opened anew.
    pub reconnects: u64,
    /// When the last frame arrived, CLOCK_MONOTONIC, ns; 0 before the first.
    pub last_arrived_ns: i64,
    /// When its thread last looked at it, CLOCK_MONOTONIC, ns: a thread that hangs does not.
    pub last_look_ns: i64,
    /// Frames that were lost, by kind.
    pub losses: Losses,
    /// Frames without a partner.
    pub unmatched: u64,
    /// Times that its clock was set or began anew.
    pub clock_steps: u64,
    /// How its clock stands to the host's, where it has one of its own.
    pub clock: Option<ClockEstimate>,
}

/// What is known about both cameras and their pairs. Counters never fall.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Snapshot {
    /// Left, right.
    pub cameras: [CameraStatus; 2],
    /// Pairs that the cameras gave.
    pub pairs: u64,
    /// Pairs dropped because the stages were late.
    pub dropped: u64,
    /// Pairs that wait for the stages.
    pub waiting: usize,
    /// Time between two pairs, as it usually is, ns; 0 while it is not known.
    pub period_ns: i64,
}

/// When a pair was taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CaptureInstant {
    /// The left image's time, CLOCK_MONOTONIC, ns.
    pub monotonic_ns: i64,
    /// When the pair was complete, CLOCK_MONOTONIC, ns.
    pub complete_ns: i64,
}

/// Which pair is dropped when the queue is full.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Overflow {
    /// The one that waited longest: the stages want what is fresh.
    Oldest,
    /// The one that comes: a recording wants no holes where it need not have any.
    Newest,
}

/// What became of one frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fate {
    /// It is in the pair of this number.
    Paired(u64),
    /// It was, but the pair was dropped because nobody took it in time.
    Dropped(u64),
    /// It has no partner.
    Unmatched(WhyUnmatched),
    /// It did not arrive, or not in one piece: that many frames.
    Lost(Loss, u64),
}

/// One line of the journal.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Entry {
    /// Whose frame.
    pub side: Side,
    /// The camera's own number; `None` for frames that never arrived.
    pub number: Option<u64>,
    /// The camera's own stamp, ns.
    pub stamp_ns: Option<i64>,
    /// The same in the host's CLOCK_MONOTONIC, ns.
    pub host_ns: Option<i64>,
    /// What became of it.
    pub fate: Fate,
}

/// How pairs are handed on.
#[derive(Clone, Copy, Debug)]
pub struct Delivery {
    /// Pairs that may wait.
    pub queue: usize,
    /// Which one goes when there are more.
    pub overflow: Overflow,
    /// Whether the fate of every frame is written down.
    pub keeps_journal: bool,
}

/// Two cameras as a source of pairs.
#[derive(Debug)]
pub struct LiveSource {
    shared: Arc<Shared>,
    threads: Vec<JoinHandle<()>>,
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
        let clocks = sources.each_ref().map(|source| source.clock());
        let shared = Arc::new(Shared::new(settings.clone(), delivery, identities, clocks));
        let mut live = Self {
            shared: Arc::clone(&shared),
            threads: Vec::new(),
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
    let named = |text: String| format!("camera.{}: {text}", name_of(side));
    match error {
        CameraError::Absent(text) => CameraError::Absent(named(text)),
        CameraError::Busy(text) => CameraError::Busy(named(text)),
        CameraError::Unsuitable(text) => CameraError::Unsuitable(named(text)),
        CameraError::Gone(text) => CameraError::Gone(named(text)),
        CameraError::Failed(text) => CameraError::Failed(named(text)),
    }
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
        let mut inner = self.shared.lock();
        loop {
            if inner.is_over {
                return None;
            }
            if let Some(event) = inner.ready.pop_front() {
                inner.last_event = Instant::now();
                return Some(event);
            }
            if inner.ended == [true; 2] {
                return None;
            }
            if let Some(event) = inner.silence(&self.shared.settings) {
                return Some(event);
            }
            inner = self.shared.wait(inner, SILENCE / 4);
        }
    }

    fn recycle(&mut self, pair: StereoPair) {
        self.shared.lock().recycle(pair.left, pair.right);
    }
}

impl Monitor {
    /// How the cameras are.
    #[must_use]
    pub fn snapshot(&self) -> Snapshot {
        let inner = self.0.lock();
        let mut cameras = inner.cameras.clone();
        let looks = self.0.looks_ns.iter().zip(&inner.clocks);
        for (camera, (look_ns, clock)) in cameras.iter_mut().zip(looks) {
            camera.last_look_ns = look_ns.load(Ordering::Relaxed);
            camera.clock = clock.estimate();
        }
        Snapshot {
            cameras,
            pairs: inner.pairs,
            dropped: inner.dropped,
            waiting: inner.waiting(),
            period_ns: inner.usual_period_ns,
        }
    }

    /// When a pair of the recent past was taken.
    #[must_use]
    pub fn captured(&self, sequence: u64) -> Option<CaptureInstant> {
        let inner = self.0.lock();
        let found = inner.times.iter().rev().find(|(of, _)| *of == sequence);
        found.map(|(_, instant)| *instant)
    }

    /// What became of frames since the last call, if a journal is kept.
    #[must_use]
    pub fn take_journal(&self) -> Vec<Entry> {
        std::mem::take(&mut self.0.lock().journal).into()
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

/// What the threads share.
#[derive(Debug)]
pub(super) struct Shared {
    settings: Settings,
    inner: Mutex<Inner>,
    changed: Condvar,
    /// When each camera's thread last showed itself, CLOCK_MONOTONIC.
    looks_ns: [AtomicI64; 2],
}

#[derive(Debug)]
struct Inner {
    delivery: Delivery,
    stamps: Stamps,
    pair_by: PairBy,
    sigma_transit_ns: f64,
    /// The settings say that the clocks are.
    are_kept_together: bool,
    source_clocks: [Clock; 2],
    clocks: [ClockMap; 2],
    pairer: Pairer<Waiting>,
    ready: VecDeque<PairEvent>,
    spare: [Vec<GrayImage>; 2],
    cameras: [CameraStatus; 2],
    times: VecDeque<(u64, CaptureInstant)>,
    journal: VecDeque<Entry>,
    next_sequence: u64,
    pairs: u64,
    dropped: u64,
    /// CLOCK_REALTIME less CLOCK_MONOTONIC when the run began, ns.
    realtime_offset_ns: i64,
    last_stamp_ns: Option<i64>,
    /// Time between pairs, as it usually is, and when the last was taken, ns.
    usual_period_ns: i64,
    last_pair_ns: Option<i64>,
    last_event: Instant,
    ended: [bool; 2],
    is_over: bool,
}

/// An image that waits for its partner.
#[derive(Debug)]
struct Waiting {
    image: GrayImage,
    stamp_ns: i64,
    host_ns: i64,
}

impl Shared {
    fn new(
        settings: Settings,
        delivery: Delivery,
        identities: [String; 2],
        source_clocks: [Clock; 2],
    ) -> Self {
        let inner = Inner {
            delivery,
            stamps: settings.stamps,
            pair_by: settings.pair_by,
            sigma_transit_ns: settings.sigma_transit_s * 1e9,
            are_kept_together: settings.clocks == Clocks::Shared,
            source_clocks,
            clocks: Default::default(),
            pairer: Pairer::new(settings.pair_by, settings.tolerance_ns()),
            ready: VecDeque::new(),
            spare: Default::default(),
            cameras: identities.map(|identity| CameraStatus {
                identity,
                ..CameraStatus::default()
            }),
            times: VecDeque::new(),
            journal: VecDeque::new(),
            next_sequence: 0,
            pairs: 0,
            dropped: 0,
            realtime_offset_ns: realtime_ns() - monotonic_ns(),
            last_stamp_ns: None,
            usual_period_ns: 0,
            last_pair_ns: None,
            last_event: Instant::now(),
            ended: [false; 2],
            is_over: false,
        };
        Self {
            settings,
            inner: Mutex::new(inner),
            changed: Condvar::new(),
            looks_ns: [(); 2].map(|()| AtomicI64::new(monotonic_ns())),
        }
    }

    fn lock(&self) -> MutexGuard<'_, Inner> {
        // What a panicking thread leaves behind is whole: each change is a few assignments.
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn wait<'a>(&self, inner: MutexGuard<'a, Inner>, time: Duration) -> MutexGuard<'a, Inner> {
        let waited = self.changed.wait_timeout(inner, time);
        waited.map_or_else(|e| e.into_inner().0, |(inner, _)| inner)
    }

    /// A camera's thread shows itself, and is told whether the run is over.
    pub(super) fn look(&self, side: Side) -> bool {
        self.looks_ns[side as usize].store(monotonic_ns(), Ordering::Relaxed);
        self.lock().is_over
    }

    fn stop(&self) {
        self.lock().is_over = true;
        self.changed.notify_all();
    }

    /// Waits; true if the run ended meanwhile.
    pub(super) fn waits_out(&self, time: Duration) -> bool {
        let deadline = Instant::now() + time;
        let mut inner = self.lock();
        while !inner.is_over {
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return false;
            }
            inner = self.wait(inner, left);
        }
        true
    }

    pub(super) fn frames(&self, side: Side) -> u64 {
        self.lock().cameras[side as usize].frames
    }

    pub(super) fn take_spare(&self, side: Side) -> Option<GrayImage> {
        self.lock().spare[side as usize].pop()
    }

    pub(super) fn end(&self, side: Side) {
        let mut inner = self.lock();
        inner.ended[side as usize] = true;
        self.changed.notify_all();
    }

    pub(super) fn set_state(&self, side: Side, state: State, cause: &str) {
        let camera = name_of(side);
        let mut inner = self.lock();
        let status = &mut inner.cameras[side as usize];
        let is_new = status.state != state || status.cause != cause;
        status.state = state;
        cause.clone_into(&mut status.cause);
        drop(inner);
        if is_new {
            let state = state.as_str();
            tracing::warn!(
                camera,
                state,
                cause,
                "the {camera} camera is {state}: {cause}"
            );
        }
    }

    /// A camera was opened anew: its counts and its clock began anew.
    pub(super) fn reopened(&self, side: Side, clock: Clock) {
        let mut inner = self.lock();
        inner.source_clocks[side as usize] = clock;
        inner.clocks[side as usize] = ClockMap::new();
        inner.pairer.reopen(side);
        inner.drain();
        let status = &mut inner.cameras[side as usize];
        status.reconnects += 1;
        status.state = State::Opening;
        status.cause.clear();
        drop(inner);
        let camera = name_of(side);
        tracing::info!(camera, "the {camera} camera was opened anew");
    }

    pub(super) fn lost(&self, side: Side, kind: Loss, frames: u64) {
        let mut inner = self.lock();
        inner.cameras[side as usize].losses.add(kind, frames);
        inner.note(Entry {
            side,
            number: None,
            stamp_ns: None,
            host_ns: None,
            fate: Fate::Lost(kind, frames),
        });
    }

    pub(super) fn frame(&self, side: Side, frame: Frame) {
        let mut inner = self.lock();
        let was = inner.cameras[side as usize].state;
        inner.take(side, frame);
        drop(inner);
        self.changed.notify_all();
        if was != State::Streaming {
            let camera = name_of(side);
            tracing::info!(camera, "the {camera} camera streams");
        }
    }
}

impl Inner {
    fn take(&mut self, side: Side, frame: Frame) {
        let at = side as usize;
        let (host_ns, sigma_ns) = self.in_host_time(side, &frame);
        let status = &mut self.cameras[at];
        status.state = State::Streaming;
        status.cause.clear();
        status.frames += 1;
        status.last_arrived_ns = frame.arrived_ns;
        let (stamp_ns, sigma_ns) = if self.has_shared_clock() {
            (frame.stamp_ns, SIGMA_SHARED_NS)
        } else {
            (host_ns, sigma_ns)
        };
        let candidate = Candidate {
            number: frame.number,
            stamp_ns,
            sigma_ns,
            item: Waiting {
                image: frame.image,
                stamp_ns: frame.stamp_ns,
                host_ns,
            },
        };
        self.pairer.push(side, candidate);
        self.drain();
    }

    fn has_shared_clock(&self) -> bool {
        self.are_kept_together || self.source_clocks == [Clock::Shared; 2]
    }

    /// When a frame was taken by CLOCK_MONOTONIC, with its 1 σ.
    fn in_host_time(&mut self, side: Side, frame: &Frame) -> (i64, f64) {
        let at = side as usize;
        if self.source_clocks[at] == Clock::Host {
            return (frame.stamp_ns, SIGMA_HOST_NS);
        }
        let mapped = self.clocks[at].map(frame.stamp_ns, frame.arrived_ns);
        match mapped.event {
            Some(ClockEvent::Stepped { by_ns }) => {
                self.cameras[at].clock_steps += 1;
                let camera = name_of(side);
                tracing::warn!(camera, by_ns, "the {camera} camera's clock was set");
            }
            Some(ClockEvent::Wrapped { modulus_ns }) => {
                tracing::debug!(
                    camera = name_of(side),
                    modulus_ns,
                    "the camera's clock wrapped"
                );
            }
            None => {}
        }
        (mapped.host_ns, mapped.sigma_ns)
    }

    /// Hands on what the pairer has decided.
    fn drain(&mut self) {
        while let Some(paired) = self.pairer.pop() {
            match paired {
                Paired::Pair { left, right, skew } => self.pair(left, right, skew),
                Paired::Unmatched { side, frame, why } => self.unmatched(side, frame, why),
            }
        }
    }

    fn pair(&mut self, left: Candidate<Waiting>, right: Candidate<Waiting>, skew: Skew) {
        let sequence = self.next_sequence;
        self.next_sequence += 1;
        self.pairs += 1;
        let skew = if self.has_shared_clock() || self.pair_by == PairBy::Trigger {
            skew
        } else {
            Skew {
                sigma_ns: skew.sigma_ns.hypot(self.sigma_transit_ns),
                ..skew
            }
        };
        for (side, frame) in [(Side::Left, &left), (Side::Right, &right)] {
            self.note(entry(side, frame, Fate::Paired(sequence)));
        }
        if let Some(last_ns) = self.last_pair_ns.replace(left.item.host_ns) {
            let period_ns = (left.item.host_ns - last_ns).max(0);
            // A gap is not a period.
            self.usual_period_ns = match self.usual_period_ns {
                0 => period_ns,
                usual_ns => period_ns.min(2 * usual_ns),
            };
        }
        let timestamp_ns = self.row_stamp(left.item.stamp_ns, left.item.host_ns);
        let instant = CaptureInstant {
            monotonic_ns: left.item.host_ns,
            complete_ns: monotonic_ns(),
        };
        self.times.push_back((sequence, instant));
        if self.times.len() > TIMES_KEPT {
            self.times.pop_front();
        }
        self.queue(PairEvent::Pair(StereoPair {
            sequence,
            timestamp_ns,
            skew,
            left: left.item.image,
            right: right.item.image,
        }));
    }

    /// A left frame without a partner costs its pair, for it is the reference; a right one costs
    /// nothing but the frame. Before the first pair there is nothing that could be missed.
    fn unmatched(&mut self, side: Side, frame: Candidate<Waiting>, why: WhyUnmatched) {
        self.note(entry(side, &frame, Fate::Unmatched(why)));
        self.cameras[side as usize].unmatched += 1;
        if side == Side::Left && self.pairs > 0 {
            let timestamp_ns = self.row_stamp(frame.item.stamp_ns, frame.item.host_ns);
            let why = format!("the left frame {} has no partner: {why}", frame.number);
            let event = self.unusable(timestamp_ns, why);
            self.queue(event);
        }
        self.spare[side as usize].push(frame.item.image);
    }

    fn unusable(&mut self, timestamp_ns: i64, why: String) -> PairEvent {
        let sequence = self.next_sequence;
        self.next_sequence += 1;
        PairEvent::Unusable(Unusable {
            sequence,
            timestamp_ns: Some(timestamp_ns),
            why,
        })
    }

    /// The stamp of a row; it rises whatever clocks do.
    fn row_stamp(&mut self, camera_ns: i64, host_ns: i64) -> i64 {
        let stamp_ns = match self.stamps {
            Stamps::Host => host_ns + self.realtime_offset_ns,
            Stamps::Camera => camera_ns,
        };
        let stamp_ns = match self.last_stamp_ns {
            Some(last_ns) => stamp_ns.max(last_ns + 1),
            None => stamp_ns,
        };
        self.last_stamp_ns = Some(stamp_ns);
        stamp_ns
    }

    /// Pairs that wait for the stages.
    fn waiting(&self) -> usize {
        self.ready.iter().filter(|event| is_pair(event)).count()
    }

    fn queue(&mut self, event: PairEvent) {
        if !is_pair(&event) {
            // Of events without images one is enough.
            if self.ready.back().is_some_and(|last| !is_pair(last)) {
                self.ready.pop_back();
            }
            self.ready.push_back(event);
            return;
        }
        if self.waiting() < self.delivery.queue {
            self.ready.push_back(event);
            return;
        }
        let dropped = match self.delivery.overflow {
            Overflow::Newest => Some(event),
            Overflow::Oldest => {
                self.ready.push_back(event);
                let oldest = self.ready.iter().position(is_pair);
                oldest.and_then(|at| self.ready.remove(at))
            }
        };
        if let Some(PairEvent::Pair(pair)) = dropped {
            self.dropped += 1;
            for side in [Side::Left, Side::Right] {
                self.note(Entry {
                    side,
                    number: None,
                    stamp_ns: None,
                    host_ns: None,
                    fate: Fate::Dropped(pair.sequence),
                });
            }
            self.recycle(pair.left, pair.right);
        }
    }

    /// The event that there has been none for long.
    fn silence(&mut self, settings: &Settings) -> Option<PairEvent> {
        let patience = if self.next_sequence == 0 {
            FIRST_SILENCE.max(settings.stall())
        } else {
            SILENCE.max(Duration::from_nanos(3 * self.usual_period_ns as u64))
        };
        let silent = self.last_event.elapsed();
        if silent < patience {
            return None;
        }
        self.last_event = Instant::now();
        let now_ns = monotonic_ns();
        let timestamp_ns = match (self.stamps, self.last_stamp_ns) {
            (Stamps::Camera, Some(last_ns)) => {
                let beyond_ns = last_ns + silent.as_nanos() as i64;
                self.row_stamp(beyond_ns, now_ns)
            }
            _ => self.row_stamp(now_ns, now_ns),
        };
        let states = self.cameras.each_ref().map(|camera| camera.state.as_str());
        let why = format!(
            "no pair for {:.1} s: the left camera is {}, the right one {}",
            silent.as_secs_f64(),
            states[0],
            states[1]
        );
        Some(self.unusable(timestamp_ns, why))
    }

    fn recycle(&mut self, left: GrayImage, right: GrayImage) {
        for (spare, image) in self.spare.iter_mut().zip([left, right]) {
            // More than are ever under way would only be memory.
            if spare.len() < 64 {
                spare.push(image);
            }
        }
    }

    fn note(&mut self, entry: Entry) {
        if self.delivery.keeps_journal && self.journal.len() < JOURNAL_KEPT {
            self.journal.push_back(entry);
        }
    }
}

fn is_pair(event: &PairEvent) -> bool {
    matches!(event, PairEvent::Pair(_))
}

fn entry(side: Side, frame: &Candidate<Waiting>, fate: Fate) -> Entry {
    Entry {
        side,
        number: Some(frame.number),
        stamp_ns: Some(frame.item.stamp_ns),
        host_ns: Some(frame.item.host_ns),
        fate,
    }
}

#[cfg(test)]
#[path = "live_tests.rs"]
mod tests;
