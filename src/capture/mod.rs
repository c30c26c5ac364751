//! Capture: cameras, real or from files, in; time-stamped stereo pairs out.
//!
//! A [`PairSource`] hands out one [`PairEvent`] after the other until its recording ends. What goes
//! wrong with one pair is an event, not the end of the run.
//!
//! Recordings are read pair by pair ([`ReadAhead`]); two cameras become one in [`LiveSource`]:
//!
//! | module | does |
//! |---|---|
//! | [`camera`] | what one camera is: the trait that files, a simulation, `aravis` and `v4l2` keep to |
//! | [`pixels`] | raw pixels to grey |
//! | [`clock`] | a camera's stamps to the host's clock |
//! | [`pairing`] | frames to pairs |
//! | [`live`] | both cameras to pairs, through all that may happen to them |
//! | [`recorder`] | pairs to a recording |
//! | [`settings`], [`drivers`] | which cameras, and how they are opened |

#[cfg(feature = "aravis")]
pub mod aravis;
pub mod camera;
pub mod clock;
pub mod dataset;
pub mod decode;
mod decode_error;
pub mod drivers;
mod envelope;
pub(crate) mod euroc;
mod euroc_frames;
pub mod files;
mod jpeg;
pub(crate) mod kitti;
pub mod live;
#[cfg(feature = "mcap")]
pub mod mcap;
mod own;
pub mod pace;
pub mod pairing;
pub mod pixels;
pub mod read_ahead;
pub mod recorder;
pub mod settings;
mod supervisor;
pub(crate) mod text;
#[cfg(feature = "v4l")]
pub mod v4l2;
pub(crate) mod yaml;

pub use dataset::{Dataset, DatasetError, Layout};
pub use live::LiveSource;
pub use pace::Realtime;
pub use pairing::Skew;
pub use read_ahead::ReadAhead;
pub use supervisor::Opener;

use crate::image::GrayImage;

/// Stamps that are read lie below, ns, about 146 years either way, so that differences of two fit as well.
pub(crate) const MAX_STAMP_NS: i64 = 1 << 62;

/// Which of the two cameras.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Side {
    /// The left camera, whose frame is the reference.
    Left,
    /// The right camera.
    Right,
}

/// Two images taken at the same instant, raw: neither undistorted nor rectified.
#[derive(Clone, Debug, PartialEq)]
pub struct StereoPair {
    /// The number of the pair in its recording, counted from 0, unusable pairs included.
    pub sequence: u64,
    /// When the left image was taken, ns, in the recording's own clock.
    pub timestamp_ns: i64,
    /// How far apart in time the two were taken; none in a recording.
    pub skew: Skew,
    /// The left camera's image.
    pub left: GrayImage,
    /// The right camera's image.
    pub right: GrayImage,
}

/// Why a pair could not be handed on.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Unusable {
    /// The number of the pair in its recording.
    pub sequence: u64,
    /// When it was taken, ns, where that is known.
    pub timestamp_ns: Option<i64>,
    /// One sentence with the file's name and the cause.
    pub why: String,
}

/// What a source hands out.
#[derive(Clone, Debug, PartialEq)]
pub enum PairEvent {
    /// A pair, ready for the stages.
    Pair(StereoPair),
    /// A pair that had to be skipped, and why.
    Unusable(Unusable),
}

/// Something that hands out stereo pairs in order.
pub trait PairSource: Send {
    /// The next event; `None` after the last. Blocks until there is one.
    fn next_event(&mut self) -> Option<PairEvent>;

    /// How many events there will be in all, where that is known.
    fn len_hint(&self) -> Option<u64> {
        None
    }

    /// Whether pairs come whether or not anybody is ready for them, so that one that waits in the pipeline is
    /// worth less than the one that comes after it.
    fn is_live(&self) -> bool {
        false
    }

    /// Says before the first event how many pairs the consumer will hold at once, so that memory for
    /// them is taken now rather than when there are as many for the first time.
    ///
    /// Nobody has to call it; a source without a pool has no use for it.
    fn make_room(&mut self, pairs_held: usize) {
        let _ = pairs_held;
    }

    /// Takes back a pair that is done with, so that its buffers can be filled again.
    ///
    /// Nobody has to call it; a source without a pool drops the pair.
    fn recycle(&mut self, pair: StereoPair) {
        drop(pair);
    }
}

impl PairEvent {
    /// The number of the pair in its recording.
    #[must_use]
    pub fn sequence(&self) -> u64 {
        match self {
            Self::Pair(pair) => pair.sequence,
            Self::Unusable(unusable) => unusable.sequence,
        }
    }

    /// When it was taken, ns, where that is known.
    #[must_use]
    pub fn timestamp_ns(&self) -> Option<i64> {
        match self {
            Self::Pair(pair) => Some(pair.timestamp_ns),
            Self::Unusable(unusable) => unusable.timestamp_ns,
        }
    }
}
