//! What is known about two cameras and their pairs, for whoever asks.

use crate::capture::camera::Losses;
use crate::capture::clock::ClockEstimate;
use crate::capture::pairing::Unmatched;
use std::sync::Arc;

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
    /// Which camera it is. Shared, as `cause` is, so that a snapshot allocates nothing.
    pub identity: Arc<str>,
    /// What it is doing.
    pub state: State,
    /// Why, where it is not streaming.
    pub cause: Arc<str>,
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
    /// Frames without a partner, by reason.
    pub unmatched: Unmatched,
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
