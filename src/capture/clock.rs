//! A camera's stamps and when its frames arrived in; the same instants in the host's clock out, with
//! their uncertainty.
//!
//! A frame arrives a little after it was taken: by a least delay, which is always the same, and by
//! whatever held it up this time, which is never negative. So the points (stamp, arrival) lie above a
//! line, whose slope is the ratio of the clocks and whose offset is theirs plus the least delay; the
//! lower envelope of the points (`envelope`) finds it.

use super::envelope::{Envelope, LowerLine};
use std::collections::VecDeque;

/// Most frames that a fit rests on.
const MAX_SAMPLES: usize = 1024;
/// Longest time that a fit looks back, ns: oscillators warm up and cool down within minutes.
const MAX_AGE_NS: i64 = 60_000_000_000;
/// A frame cannot arrive before it was taken: one this much too early shows a step of the clock.
const EARLY_NS: f64 = 20e6;
/// Frames that arrive this late, one after the other, show a step back.
const LATE_NS: f64 = 100e6;
/// How many late ones, over how long, are a step rather than a hold-up.
const LATE_FRAMES: usize = 5;
const LATE_SPAN_NS: i64 = 200_000_000;
/// How near to a whole number of wraps a step back must be, ns.
const WRAP_TOLERANCE_NS: i64 = 20_000_000;
/// After what cameras' clocks wrap, ns: 128 s (IIDC's cycle time, which Flea cameras have), 32 bits of
/// nanoseconds, of 8 ns ticks, of microseconds.
const WRAPS_NS: [i64; 4] = [128_000_000_000, 1 << 32, (1 << 32) * 8, (1 << 32) * 1000];

/// What the clock did.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ClockEvent {
    /// It wrapped, as clocks of few bits do; nothing is lost.
    Wrapped {
        /// After how long, ns.
        modulus_ns: i64,
    },
    /// It was set, or the camera restarted: the fit begins anew.
    Stepped {
        /// By how much, ns; positive is ahead.
        by_ns: i64,
    },
}

/// A stamp in the host's clock.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mapped {
    /// CLOCK_MONOTONIC, ns. Later than the truth by the least delay, which cannot be seen.
    pub host_ns: i64,
    /// 1 σ of it, ns, the least delay apart.
    pub sigma_ns: f64,
    /// What happened to the camera's clock, if anything.
    pub event: Option<ClockEvent>,
}

/// How a camera's clock stands to the host's, as it is known at the last frame.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct ClockEstimate {
    /// The host's CLOCK_MONOTONIC less the camera's clock, and the least delay, ns.
    pub offset_ns: i64,
    /// 1 σ of it, ns, the least delay apart.
    pub sigma_offset_ns: f64,
    /// How much faster the host's clock runs, millionths.
    pub drift_ppm: f64,
    /// 1 σ of it, millionths.
    pub sigma_drift_ppm: f64,
}

/// Follows one camera's clock.
#[derive(Clone, Debug, Default)]
pub struct ClockMap {
    samples: VecDeque<Sample>,
    fit: Option<Fit>,
    /// What wraps have added, ns.
    unwrapped_ns: i64,
    late: Vec<Sample>,
    envelope: Envelope,
    /// Mapped stamps rise, whatever the fit does.
    last_host_ns: Option<i64>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
struct Sample {
    camera_ns: i64,
    arrived_ns: i64,
}

/// `host = camera + offset + drift · (camera − camera_ref)`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fit {
    camera_ref_ns: i64,
    host_ref_ns: i64,
    /// What is beyond `host_ref − camera_ref`, by the time after the reference.
    line: LowerLine,
}

impl Fit {
    fn at(&self, camera_ns: i64) -> (i64, f64) {
        let x = (camera_ns - self.camera_ref_ns) as f64;
        let beyond = self.line.height_ns + self.line.slope * x;
        let host_ns = self.host_ref_ns + (camera_ns - self.camera_ref_ns) + beyond.round() as i64;
        let away = self.line.sigma_slope * (x - self.line.centre_ns);
        (host_ns, self.line.sigma_height_ns.hypot(away))
    }

    /// How much faster the host's clock runs, as a ratio less one.
    #[must_use]
    pub fn drift(&self) -> f64 {
        self.line.slope
    }

    /// 1 σ of the drift.
    #[must_use]
    pub fn sigma_drift(&self) -> f64 {
        self.line.sigma_slope
    }
}

impl ClockMap {
    /// Nothing known yet.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// The fit so far.
    #[must_use]
    pub fn fit(&self) -> Option<&Fit> {
        self.fit.as_ref()
    }

    /// What is known at the last frame.
    #[must_use]
    pub fn estimate(&self) -> Option<ClockEstimate> {
        let (fit, last) = (self.fit.as_ref()?, self.samples.back()?);
        let (host_ns, sigma_offset_ns) = fit.at(last.camera_ns);
        Some(ClockEstimate {
            offset_ns: host_ns - (last.camera_ns - self.unwrapped_ns),
            sigma_offset_ns,
            drift_ppm: fit.drift() * 1e6,
            sigma_drift_ppm: fit.sigma_drift() * 1e6,
        })
    }

    /// Takes note of a frame and says when it was taken.
    pub fn map(&mut self, camera_ns: i64, arrived_ns: i64) -> Mapped {
        let mut event = None;
        let mut sample = Sample {
            camera_ns: camera_ns.saturating_add(self.unwrapped_ns),
            arrived_ns,
        };
        if let Some(&last) = self.samples.back() {
            if sample.camera_ns <= last.camera_ns {
                event = Some(self.step_back(&last, &mut sample));
            } else if let Some(by_ns) = self.step_by(&sample) {
                self.begin_anew();
                event = Some(ClockEvent::Stepped { by_ns });
            }
        }
        if self.late.is_empty() || self.fit.is_none() {
            self.samples.push_back(sample);
            self.forget_old();
            self.refit();
        }
        let (host_ns, sigma_ns) = match &self.fit {
            Some(fit) => fit.at(sample.camera_ns),
            None => (arrived_ns, f64::INFINITY),
        };
        // A line that has just been corrected must not turn two frames round.
        let host_ns = match self.last_host_ns {
            Some(last) if event.is_none() => host_ns.max(last + 1),
            _ => host_ns,
        };
        self.last_host_ns = Some(host_ns);
        Mapped {
            host_ns,
            sigma_ns,
            event,
        }
    }

    /// The clock went back: by a wrap, which is undone, or because it began anew.
    fn step_back(&mut self, last: &Sample, sample: &mut Sample) -> ClockEvent {
        let elapsed_ns = sample.arrived_ns - last.arrived_ns;
        let missing_ns = elapsed_ns - (sample.camera_ns - last.camera_ns);
        let wrap = |modulus_ns: i64| {
            let times = (missing_ns + modulus_ns / 2).div_euclid(modulus_ns);
            let off_ns = (missing_ns - times * modulus_ns).abs();
            (times >= 1 && off_ns < WRAP_TOLERANCE_NS).then_some((times, modulus_ns))
        };
        // One wrap of a long clock rather than many of a short one.
        let wrapped = WRAPS_NS.into_iter().filter_map(wrap).min();
        match wrapped {
            Some((times, modulus_ns)) if sample.camera_ns + times * modulus_ns > last.camera_ns => {
                self.unwrapped_ns += times * modulus_ns;
                sample.camera_ns += times * modulus_ns;
                ClockEvent::Wrapped { modulus_ns }
            }
            _ => {
                self.begin_anew();
                ClockEvent::Stepped { by_ns: -missing_ns }
            }
        }
    }

    /// Whether the clock was set, and by how much.
    fn step_by(&mut self, sample: &Sample) -> Option<i64> {
        let (expected_ns, sigma_ns) = self.fit.as_ref()?.at(sample.camera_ns);
        let delay_ns = (sample.arrived_ns - expected_ns) as f64;
        if delay_ns < -(EARLY_NS + 10.0 * sigma_ns) {
            return Some(-(delay_ns as i64));
        }
        if delay_ns < LATE_NS + 10.0 * sigma_ns {
            self.late.clear();
            return None;
        }
        self.late.push(*sample);
        let first = self.late.first()?;
        let has_lasted = self.late.len() >= LATE_FRAMES
            && sample.arrived_ns - first.arrived_ns >= LATE_SPAN_NS
            && sample.camera_ns - first.camera_ns >= LATE_SPAN_NS;
        has_lasted.then_some(-(delay_ns as i64))
    }

    fn begin_anew(&mut self) {
        self.samples.clear();
        self.late.clear();
        self.fit = None;
        self.last_host_ns = None;
    }

    fn forget_old(&mut self) {
        let Some(newest_ns) = self.samples.back().map(|s| s.arrived_ns) else {
            return;
        };
        let is_old = |s: &Sample| newest_ns - s.arrived_ns > MAX_AGE_NS;
        while self.samples.len() > MAX_SAMPLES || self.samples.front().is_some_and(is_old) {
            self.samples.pop_front();
        }
    }

    /// The line below all samples that is nearest to them.
    fn refit(&mut self) {
        let Some(&Sample {
            camera_ns,
            arrived_ns,
        }) = self.samples.back()
        else {
            return;
        };
        let points = self.samples.iter().map(|s| {
            let x = s.camera_ns - camera_ns;
            (x as f64, ((s.arrived_ns - arrived_ns) - x) as f64)
        });
        self.fit = self.envelope.fit(points).map(|line| Fit {
            camera_ref_ns: camera_ns,
            host_ref_ns: arrived_ns,
            line,
        });
    }
}

#[cfg(test)]
#[path = "clock_tests.rs"]
mod tests;
