//! Frames' own stamps in; the same in clocks that can be compared, and the stamps of rows, out.

use super::name_of;
use super::status::CameraStatus;
use crate::capture::Side;
use crate::capture::camera::{Clock, Frame, realtime_ahead_ns};
use crate::capture::clock::{ClockEvent, ClockMap};
use crate::capture::settings::{Clocks, Settings, Stamps};

/// 1 σ of stamps by a clock that both cameras share, ns.
const SIGMA_SHARED_NS: f64 = 1_000.0;
/// 1 σ of the kernel's stamps: how late an interrupt may be, ns.
const SIGMA_HOST_NS: f64 = 100_000.0;

/// When a frame was taken.
#[derive(Clone, Copy, Debug)]
pub(super) struct Taken {
    /// CLOCK_MONOTONIC, ns.
    pub(super) host_ns: i64,
    /// In the clock by which frames of both cameras are compared, ns, with its 1 σ.
    pub(super) common_ns: i64,
    pub(super) sigma_ns: f64,
}

/// Keeps two cameras' times.
#[derive(Debug)]
pub(super) struct Times {
    stamps: Stamps,
    /// The settings say that the clocks are.
    are_kept_together: bool,
    sources: [Clock; 2],
    maps: [ClockMap; 2],
    /// CLOCK_REALTIME less CLOCK_MONOTONIC when the run began, ns.
    realtime_ahead_ns: i64,
    last_row_ns: Option<i64>,
}

impl Times {
    pub(super) fn new(settings: &Settings, sources: [Clock; 2]) -> Self {
        Self {
            stamps: settings.stamps,
            are_kept_together: settings.clocks == Clocks::Shared,
            sources,
            maps: Default::default(),
            realtime_ahead_ns: realtime_ahead_ns(),
            last_row_ns: None,
        }
    }

    /// How the cameras' clocks stand to the host's.
    pub(super) fn maps(&self) -> &[ClockMap; 2] {
        &self.maps
    }

    /// Whether the stamps of both cameras are by one clock.
    pub(super) fn are_shared(&self) -> bool {
        self.are_kept_together || self.sources == [Clock::Shared; 2]
    }

    /// A camera was opened anew, and its clock began anew.
    pub(super) fn reopen(&mut self, side: Side, source: Clock) {
        self.sources[side as usize] = source;
        self.maps[side as usize] = ClockMap::new();
    }

    /// When a frame was taken; what its clock did is counted in `status`.
    pub(super) fn of(&mut self, side: Side, frame: &Frame, status: &mut CameraStatus) -> Taken {
        let (host_ns, sigma_ns) = self.in_host_time(side, frame, status);
        let (common_ns, sigma_ns) = if self.are_shared() {
            (frame.stamp_ns, SIGMA_SHARED_NS)
        } else {
            (host_ns, sigma_ns)
        };
        Taken {
            host_ns,
            common_ns,
            sigma_ns,
        }
    }

    fn in_host_time(&mut self, side: Side, frame: &Frame, status: &mut CameraStatus) -> (i64, f64) {
        if self.sources[side as usize] == Clock::Host {
            return (frame.stamp_ns, SIGMA_HOST_NS);
        }
        let camera = name_of(side);
        let mapped = self.maps[side as usize].map(frame.stamp_ns, frame.arrived_ns);
        match mapped.event {
            Some(ClockEvent::Stepped { by_ns }) => {
                status.clock_steps += 1;
                tracing::warn!(camera, by_ns, "the {camera} camera's clock was set");
            }
            Some(ClockEvent::Wrapped { modulus_ns }) => {
                tracing::debug!(camera, modulus_ns, "the camera's clock wrapped");
            }
            None => {}
        }
        (mapped.host_ns, mapped.sigma_ns)
    }

    /// The stamp of a row; it rises whatever clocks do.
    pub(super) fn of_row(&mut self, camera_ns: i64, host_ns: i64) -> i64 {
        let stamp_ns = match self.stamps {
            Stamps::Host => host_ns + self.realtime_ahead_ns,
            Stamps::Camera => camera_ns,
        };
        let stamp_ns = match self.last_row_ns {
            Some(last_ns) => stamp_ns.max(last_ns + 1),
            None => stamp_ns,
        };
        self.last_row_ns = Some(stamp_ns);
        stamp_ns
    }

    /// The stamp of a row without a frame, `now_ns` (CLOCK_MONOTONIC), so long after the last row.
    pub(super) fn of_silent_row(&mut self, now_ns: i64, since_last_ns: i64) -> i64 {
        let camera_ns = self.last_row_ns.map(|last_ns| last_ns + since_last_ns);
        self.of_row(camera_ns.unwrap_or(now_ns), now_ns)
    }
}
