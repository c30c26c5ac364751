//! One camera: its frames out, one after the other, with what was lost on the way.
//!
//! A [`FrameSource`] is one camera, whatever drives it: files, a simulation, Aravis or V4L2. The
//! contract is the same for all, and one suite of tests holds each of them to it:
//!
//! * numbers rise, and by more than one exactly where frames were lost;
//! * stamps rise, and images have the size that was agreed on;
//! * [`next`](FrameSource::next) comes back within its patience (and a little for the copying);
//! * a source that was stopped can be started again; dropping one frees the camera;
//! * an error is the end of the stream: close, wait, open anew.

use crate::image::GrayImage;
use std::time::Duration;

/// One camera's image with when it was taken.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Frame {
    /// The camera's own count of its frames, those that were lost included; where it begins is
    /// arbitrary. Does not wrap.
    pub number: u64,
    /// When it was taken, by the source's [`clock`](FrameSource::clock), ns.
    pub stamp_ns: i64,
    /// When the first of it arrived, CLOCK_MONOTONIC, ns.
    pub arrived_ns: i64,
    /// The image, raw.
    pub image: GrayImage,
}

/// Whose clock stamps a camera's frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Clock {
    /// The camera's own: counts from anywhere, drifts, may wrap.
    Own,
    /// One that both cameras share, such as PTP's or a recording's.
    Shared,
    /// This host's CLOCK_MONOTONIC.
    Host,
}

/// Why a frame that the camera took is not there.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Loss {
    /// A gap in the camera's own numbers.
    Skipped,
    /// Parts of it did not arrive.
    Incomplete,
    /// It did not arrive in time.
    TimedOut,
    /// There was no buffer to put it in.
    Underrun,
    /// It arrived, but damaged or undecodable.
    Unreadable,
    /// It arrived with another size or pixel format than agreed on.
    WrongFormat,
}

impl Loss {
    /// Every kind.
    pub const ALL: [Self; 6] = [
        Self::Skipped,
        Self::Incomplete,
        Self::TimedOut,
        Self::Underrun,
        Self::Unreadable,
        Self::WrongFormat,
    ];

    /// A word for tables and logs.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Skipped => "skipped",
            Self::Incomplete => "incomplete",
            Self::TimedOut => "timed_out",
            Self::Underrun => "underrun",
            Self::Unreadable => "unreadable",
            Self::WrongFormat => "wrong_format",
        }
    }

    /// Whether it was lost between camera and host, rather than unusable on arrival.
    #[must_use]
    pub fn is_in_transport(self) -> bool {
        !matches!(self, Self::Unreadable | Self::WrongFormat)
    }
}

/// Lost frames, counted by kind.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Losses([u64; Loss::ALL.len()]);

impl Losses {
    /// Counts some.
    pub fn add(&mut self, kind: Loss, frames: u64) {
        self.0[kind as usize] += frames;
    }

    /// How many of one kind.
    #[must_use]
    pub fn of(&self, kind: Loss) -> u64 {
        self.0[kind as usize]
    }

    /// How many were lost between camera and host.
    #[must_use]
    pub fn in_transport(&self) -> u64 {
        let kinds = Loss::ALL.into_iter().filter(|kind| kind.is_in_transport());
        kinds.map(|kind| self.of(kind)).sum()
    }

    /// How many arrived but were unusable.
    #[must_use]
    pub fn unusable(&self) -> u64 {
        self.0.iter().sum::<u64>() - self.in_transport()
    }

    /// Each kind with its count.
    pub fn iter(&self) -> impl Iterator<Item = (Loss, u64)> + '_ {
        Loss::ALL.into_iter().map(|kind| (kind, self.of(kind)))
    }
}

/// What a camera has to say.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum CameraEvent {
    /// A frame.
    Frame(Frame),
    /// Frames were lost.
    Lost {
        /// How.
        kind: Loss,
        /// How many.
        frames: u64,
    },
    /// Nothing within the time given.
    Quiet,
    /// There will be no more: the recording is over.
    End,
}

/// Why a camera cannot be used, in one sentence.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CameraError {
    /// It is not there.
    #[error("{0}")]
    Absent(String),
    /// Another program holds it.
    #[error("{0}")]
    Busy(String),
    /// It cannot do what the configuration or the rig asks for; trying again does not help.
    #[error("{0}")]
    Unsuitable(String),
    /// It went away, or fell silent, while it was in use.
    #[error("{0}")]
    Gone(String),
    /// Anything else.
    #[error("{0}")]
    Failed(String),
}

impl CameraError {
    /// Whether the configuration has to change, rather than the world.
    #[must_use]
    pub fn is_permanent(&self) -> bool {
        matches!(self, Self::Unsuitable(_))
    }

    /// The same, said of what is named.
    pub(super) fn of(self, name: &str) -> Self {
        let named = |text: String| format!("{name}: {text}");
        match self {
            Self::Absent(text) => Self::Absent(named(text)),
            Self::Busy(text) => Self::Busy(named(text)),
            Self::Unsuitable(text) => Self::Unsuitable(named(text)),
            Self::Gone(text) => Self::Gone(named(text)),
            Self::Failed(text) => Self::Failed(named(text)),
        }
    }
}

/// One camera; the module's documentation has the contract.
pub trait FrameSource: Send {
    /// Width and height of its images, px.
    fn size_px(&self) -> (u32, u32);

    /// Which camera it is: what tells it from any other of its kind.
    fn identity(&self) -> String;

    /// Whose clock stamps its frames.
    fn clock(&self) -> Clock;

    /// Begins to take frames. Does nothing if it does so already.
    ///
    /// # Errors
    /// The camera is gone or refuses.
    fn start(&mut self) -> Result<(), CameraError>;

    /// The next event; [`CameraEvent::Quiet`] if there is none within `patience`, or if the source is
    /// stopped.
    ///
    /// # Errors
    /// The camera is gone. Nothing but dropping makes sense then.
    fn next(&mut self, patience: Duration) -> Result<CameraEvent, CameraError>;

    /// Stops taking frames; those that wait are forgotten. Does nothing if it has stopped already.
    fn stop(&mut self);

    /// Takes back an image that is done with, so that its memory can be filled again.
    fn recycle(&mut self, image: GrayImage) {
        drop(image);
    }
}

/// This host's CLOCK_MONOTONIC, ns.
#[must_use]
pub fn monotonic_ns() -> i64 {
    nanoseconds(rustix::time::clock_gettime(
        rustix::time::ClockId::Monotonic,
    ))
}

/// This host's CLOCK_REALTIME, ns.
#[must_use]
pub fn realtime_ns() -> i64 {
    nanoseconds(rustix::time::clock_gettime(rustix::time::ClockId::Realtime))
}

/// How far this host's CLOCK_REALTIME is ahead of its CLOCK_MONOTONIC, ns. Of a few readings the one
/// that took the least time: a thread that is interrupted between two clocks compares different times.
#[must_use]
pub fn realtime_ahead_ns() -> i64 {
    let readings = (0..4).map(|_| {
        let before_ns = monotonic_ns();
        let realtime_ns = realtime_ns();
        let took_ns = monotonic_ns() - before_ns;
        (took_ns, realtime_ns - (before_ns + took_ns / 2))
    });
    let quickest = readings.min_by_key(|(took_ns, _)| *took_ns);
    quickest.map_or(0, |(_, ahead_ns)| ahead_ns)
}

fn nanoseconds(t: rustix::time::Timespec) -> i64 {
    t.tv_sec * 1_000_000_000 + t.tv_nsec
}

/// A camera's counter of few bits, made one that does not wrap.
#[cfg(any(feature = "aravis", feature = "v4l", test))]
#[derive(Clone, Copy, Debug)]
pub(crate) struct Unwrapped {
    bits: u32,
    /// GigE Vision skips 0 when its counter wraps.
    skips_zero: bool,
    last: Option<(u64, u64)>,
}

#[cfg(any(feature = "aravis", feature = "v4l", test))]
impl Unwrapped {
    pub(crate) fn new(bits: u32, skips_zero: bool) -> Self {
        Self {
            bits,
            skips_zero,
            last: None,
        }
    }

    /// The whole count, and how many were skipped since the last call. A counter that goes back began
    /// anew: it goes on by one.
    pub(crate) fn next(&mut self, raw: u64) -> (u64, u64) {
        let Some((last_raw, last)) = self.last else {
            self.last = Some((raw, raw));
            return (raw, 0);
        };
        let modulus = 1_u128 << self.bits;
        let mut ahead = ((u128::from(raw) + modulus - u128::from(last_raw)) % modulus) as u64;
        if self.skips_zero && raw < last_raw && ahead > 1 {
            ahead -= 1;
        }
        // More than half the range ahead is a step back, and not to move is one, too.
        if ahead == 0 || u128::from(ahead) > modulus / 2 {
            ahead = 1;
        }
        self.last = Some((raw, last + ahead));
        (last + ahead, ahead - 1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_counter_of_few_bits_goes_on_where_it_wraps() {
        let mut count = Unwrapped::new(16, true);
        let seen: Vec<_> = [65_533, 65_534, 65_535, 1, 2, 5]
            .map(|raw| count.next(raw))
            .into();
        assert_eq!(
            seen,
            [
                (65_533, 0),
                (65_534, 0),
                (65_535, 0),
                (65_536, 0),
                (65_537, 0),
                (65_540, 2)
            ]
        );
        let mut plain = Unwrapped::new(32, false);
        assert_eq!(plain.next(u64::from(u32::MAX)), (u64::from(u32::MAX), 0));
        assert_eq!(plain.next(0), (1 << 32, 0));
        assert_eq!(plain.next(3), ((1 << 32) + 3, 2));
    }

    #[test]
    fn a_counter_that_begins_anew_goes_on_by_one() {
        let mut count = Unwrapped::new(64, false);
        assert_eq!(count.next(1000), (1000, 0));
        assert_eq!(count.next(0), (1001, 0));
        assert_eq!(count.next(1), (1002, 0));
        assert_eq!(count.next(1), (1003, 0), "one that stands still, too");
    }

    #[test]
    fn losses_are_told_apart_by_where_they_happen() {
        let mut losses = Losses::default();
        for (n, kind) in (1..).zip(Loss::ALL) {
            losses.add(kind, n);
        }
        assert_eq!(losses.in_transport(), 1 + 2 + 3 + 4);
        assert_eq!(losses.unusable(), 5 + 6);
        assert_eq!(losses.of(Loss::Underrun), 4);
    }
}
