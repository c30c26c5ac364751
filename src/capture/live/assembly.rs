//! Frames of two cameras in, as they come; events for the stages out, with everything counted.

use super::journal::{Entry, Fate, Journal};
use super::queue::{Delivery, Queue};
use super::spares::Spares;
use super::status::{CameraStatus, CaptureInstant, State};
use super::times::Times;
use crate::capture::camera::{Clock, Frame, FrameSource, Loss, monotonic_ns};
use crate::capture::pairing::{Candidate, PairBy, Paired, Pairer, Skew, WhyUnmatched};
use crate::capture::settings::Settings;
use crate::capture::{PairEvent, Side, StereoPair, Unusable};
use crate::image::GrayImage;
use std::collections::VecDeque;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Without a pair for this long, the stages are told so.
pub(super) const SILENCE: Duration = Duration::from_millis(200);
/// The same before the first pair, when there is nothing to bridge yet.
const FIRST_SILENCE: Duration = Duration::from_secs(1);
/// Capture times of the last pairs that can be asked for.
const TIMES_KEPT: usize = 256;

/// What becomes of frames.
#[derive(Debug)]
pub(super) struct Assembly {
    pub(super) times: Times,
    pub(super) ready: Queue,
    pub(super) spares: Spares,
    pub(super) journal: Journal,
    pub(super) cameras: [CameraStatus; 2],
    pub(super) captured: VecDeque<(u64, CaptureInstant)>,
    pub(super) pairs: u64,
    pub(super) dropped: u64,
    /// Time between pairs, as it usually is, ns.
    pub(super) usual_period_ns: i64,
    pub(super) last_event: Instant,
    pub(super) ended: [bool; 2],
    pub(super) is_over: bool,
    pairer: Pairer<Waiting>,
    pair_by: PairBy,
    sigma_transit_ns: f64,
    next_sequence: u64,
    last_pair_ns: Option<i64>,
}

/// An image that waits for its partner.
#[derive(Debug)]
struct Waiting {
    image: GrayImage,
    stamp_ns: i64,
    host_ns: i64,
    arrived_ns: i64,
}

impl Assembly {
    pub(super) fn new(
        settings: &Settings,
        delivery: Delivery,
        sources: [&dyn FrameSource; 2],
    ) -> Self {
        Self {
            times: Times::new(settings, sources.map(|source| source.clock())),
            ready: Queue::new(delivery),
            spares: Spares::new(sources.map(|source| source.size_px())),
            journal: Journal::new(delivery.keeps_journal),
            cameras: sources.map(|source| CameraStatus {
                identity: source.identity().into(),
                ..CameraStatus::default()
            }),
            captured: VecDeque::with_capacity(TIMES_KEPT + 1),
            pairs: 0,
            dropped: 0,
            usual_period_ns: 0,
            last_event: Instant::now(),
            ended: [false; 2],
            is_over: false,
            pairer: Pairer::new(settings.pair_by, settings.tolerance_ns()),
            pair_by: settings.pair_by,
            sigma_transit_ns: settings.sigma_transit_s * 1e9,
            next_sequence: 0,
            last_pair_ns: None,
        }
    }

    /// A camera was opened anew: its counts and its clock began anew.
    pub(super) fn reopen(&mut self, side: Side, clock: Clock) {
        self.times.reopen(side, clock);
        self.pairer.reopen(side);
        self.drain();
        let status = &mut self.cameras[side as usize];
        status.reconnects += 1;
        status.state = State::Opening;
        status.cause = Arc::default();
    }

    /// Frames of a camera did not arrive, or not in one piece.
    pub(super) fn lose(&mut self, side: Side, kind: Loss, frames: u64) {
        self.cameras[side as usize].losses.add(kind, frames);
        self.journal.note_nameless(side, Fate::Lost(kind, frames));
    }

    /// A camera sent a frame.
    pub(super) fn take(&mut self, side: Side, frame: Frame) {
        let status = &mut self.cameras[side as usize];
        let taken = self.times.of(side, &frame, status);
        status.state = State::Streaming;
        status.cause = Arc::default();
        status.frames += 1;
        status.last_arrived_ns = frame.arrived_ns;
        let candidate = Candidate {
            number: frame.number,
            stamp_ns: taken.common_ns,
            sigma_ns: taken.sigma_ns,
            item: Waiting {
                image: frame.image,
                stamp_ns: frame.stamp_ns,
                host_ns: taken.host_ns,
                arrived_ns: frame.arrived_ns,
            },
        };
        self.pairer.push(side, candidate);
        self.drain();
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
        let skew = if self.times.are_shared() || self.pair_by == PairBy::Trigger {
            skew
        } else {
            Skew {
                sigma_ns: skew.sigma_ns.hypot(self.sigma_transit_ns),
                ..skew
            }
        };
        for (side, frame) in [(Side::Left, &left), (Side::Right, &right)] {
            self.journal
                .note(entry(side, frame, Fate::Paired(sequence)));
        }
        if let Some(last_ns) = self.last_pair_ns.replace(left.item.host_ns) {
            let period_ns = (left.item.host_ns - last_ns).max(0);
            // A gap is not a period.
            self.usual_period_ns = match self.usual_period_ns {
                0 => period_ns,
                usual_ns => period_ns.min(2 * usual_ns),
            };
        }
        let timestamp_ns = self.times.of_row(left.item.stamp_ns, left.item.host_ns);
        let instant = CaptureInstant {
            monotonic_ns: left.item.host_ns,
            complete_ns: monotonic_ns(),
        };
        self.captured.push_back((sequence, instant));
        if self.captured.len() > TIMES_KEPT {
            self.captured.pop_front();
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
        self.journal.note(entry(side, &frame, Fate::Unmatched(why)));
        self.cameras[side as usize].unmatched.add(&why);
        if side == Side::Left && self.pairs > 0 {
            let timestamp_ns = self.times.of_row(frame.item.stamp_ns, frame.item.host_ns);
            let why = format!("the left frame {} has no partner: {why}", frame.number);
            let event = self.unusable(timestamp_ns, why);
            self.queue(event);
        }
        self.spares.give(side, frame.item.image);
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

    fn queue(&mut self, event: PairEvent) {
        if let Some(pair) = self.ready.push(event) {
            self.dropped += 1;
            for side in [Side::Left, Side::Right] {
                self.journal
                    .note_nameless(side, Fate::Dropped(pair.sequence));
            }
            self.recycle(pair);
        }
    }

    /// The event that there has been none for long.
    pub(super) fn silence(&mut self, settings: &Settings) -> Option<PairEvent> {
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
        let timestamp_ns = self
            .times
            .of_silent_row(monotonic_ns(), silent.as_nanos() as i64);
        let states = self.cameras.each_ref().map(|camera| camera.state.as_str());
        let why = format!(
            "no pair for {:.1} s: the left camera is {}, the right one {}",
            silent.as_secs_f64(),
            states[0],
            states[1]
        );
        Some(self.unusable(timestamp_ns, why))
    }

    pub(super) fn recycle(&mut self, pair: StereoPair) {
        self.spares.give(Side::Left, pair.left);
        self.spares.give(Side::Right, pair.right);
    }
}

fn entry(side: Side, frame: &Candidate<Waiting>, fate: Fate) -> Entry {
    Entry {
        side,
        number: Some(frame.number),
        stamp_ns: Some(frame.item.stamp_ns),
        host_ns: Some(frame.item.host_ns),
        arrived_ns: Some(frame.item.arrived_ns),
        fate,
    }
}
