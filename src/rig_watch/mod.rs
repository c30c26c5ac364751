//! The watch on the rig: what both cameras see in, whether one has turned against the other since
//! it was calibrated, and by how much, out.
//!
//! | module | does |
//! |---|---|
//! | [`turn`] | what a small turn of the right camera does to pixels |
//! | `rows` | stereo matches of one pair: by how much they miss their row |
//! | `step` | landmarks of the window: by how much the right image has jumped since they were met |
//! | `alarm` | small deviations, summed over pairs until they are none by chance |
//! | `filter` | the slow state: calibration's own errors, and the turn since the start |
//!
//! **What can be told.** A right camera that has turned about its axes by r, pitch, yaw and roll,
//! moves the rectified row of a point at (X, Y) by `f (−(1 + Y²) r₁ + X Y r₂ + X r₃)` and its column by
//! `f ((1 + X²) r₂ − X Y r₁ − Y r₃)` (rotation of the image plane: Hartley and Zisserman, *Multiple
//! View Geometry*, §8.4). Rows should not differ from left to right at all: pitch and roll show in every
//! pair. Yaw shows in rows by a term of second order only; what it does to columns is a change of disparity,
//! which any one pair takes for another depth. Yet when it happens all of a sudden, landmarks that
//! were known before are all too near or too far at once, whatever way the robot takes: such a step
//! is measured as well as the others. A yaw that creeps is left to the window, whose constant
//! along the baseline shows in how the world shrinks or grows.
//!
//! **What it is tested against.** The state is what the calibration was wrong by from the start (a
//! quadratic of the position, its prior what the rig states of itself) and the turn since (a random
//! walk). Two tests: whether the former is more than was stated, and whether the latter is more than
//! its own uncertainty.

mod alarm;
mod filter;
mod rows;
mod settings;
mod step;
#[cfg(test)]
mod tests;
pub mod turn;

pub use settings::Settings;

use crate::estimation::{self, StereoMeasurement};
use crate::geometry::{Rectification, StereoRig};
use crate::uncertainty::consistency::chi2_quantile;
use alarm::Alarm;
use filter::{Filter, STATICS, YAW};
use nalgebra::{Isometry3, Matrix3, Vector3, Vector4};
use rows::Rows;
use step::{Spread, Step};

const NS_TO_S: f64 = 1e-9;
/// Fewest matches or landmarks that say anything.
const LEAST: usize = 30;
/// How far a rig may have turned at one blow, 1 σ.
const BLOW_RAD: f64 = 2e-3;
/// Pairs after a blow for which landmarks, which follow it, are not asked about another one.
const PAIRS_OF_REST: u32 = 20;
/// Pairs at the start that tell how the rig was when it was calibrated.
const PAIRS_TO_LEARN: u32 = 10;
/// A yaw is known where its σ is below this; otherwise the camera is taken not to have turned that way.
const KNOWN_YAW_RAD: f64 = 1e-4;
/// What is but suspicious, beyond the middle of what chance shows, is not learnt as the calibration's own error.
const SUSPICIOUS: f64 = 0.5;

/// How the rig is.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct RigState {
    /// By how much the right camera has turned since the start, about its own axes: pitch, yaw, roll, rad.
    pub turn_rad: [f64; 3],
    /// 1 σ of that.
    pub sigma_rad: [f64; 3],
    /// Whether the turn is more than its uncertainty: it was, at some pair.
    pub has_moved: bool,
    /// Whether the images miss each other by more than the rig's stated uncertainty: never where it states none.
    pub misfits: bool,
}

/// The watch.
#[derive(Clone, Debug)]
pub struct RigWatch {
    settings: Settings,
    rig: StereoRig,
    rectification: Rectification,
    filter: Filter,
    rows: Rows,
    rows_alarm: Alarm<3>,
    step: Step,
    step_alarm: Alarm<1>,
    spread: Spread,
    limits: Limits,
    last_ns: Option<i64>,
    /// The turn that measurements are corrected for at present.
    applied_rad: Vector3<f64>,
    /// The yaw before the last blow.
    yaw_before_rad: f64,
    pairs_since_blow: u32,
    /// Pairs from which what calibration missed is yet to be learnt before anything is called a blow.
    pairs_to_learn: u32,
    has_moved: bool,
    misfits: bool,
}

/// Values of χ² beyond which something is no chance.
#[derive(Clone, Copy, Debug)]
struct Limits {
    turn: f64,
    yaw: f64,
    statics: f64,
    suspicious: f64,
}

impl RigWatch {
    /// The watch on one rig. `None` if it is switched off, or no rows exist since the cameras stand in line with
    /// their view.
    #[must_use]
    pub fn new(
        rig: &StereoRig,
        settings: &Settings,
        estimation: &estimation::Settings,
    ) -> Option<Self> {
        if !settings.enabled {
            return None;
        }
        let rectification = Rectification::new(rig)?;
        let chance = 1.0 - settings.false_alarm;
        Some(Self {
            filter: Filter::new(rows::prior(rig, &rectification, estimation)),
            settings: settings.clone(),
            rig: rig.clone(),
            rectification,
            rows: Rows::default(),
            rows_alarm: Alarm::new(STATICS, &[1.0, 4.0, 16.0, 64.0]),
            step: Step::default(),
            step_alarm: Alarm::new(STATICS + YAW, &[1.0, 4.0]),
            spread: Spread::default(),
            limits: Limits {
                turn: chi2_quantile(chance, 3.0),
                yaw: chi2_quantile(chance, 1.0),
                // What nobody has stated cannot be contradicted.
                statics: match rig.uncertainty {
                    Some(_) => chi2_quantile(chance, STATICS as f64),
                    None => f64::INFINITY,
                },
                suspicious: chi2_quantile(SUSPICIOUS, 3.0),
            },
            last_ns: None,
            applied_rad: Vector3::zeros(),
            yaw_before_rad: 0.0,
            pairs_since_blow: PAIRS_OF_REST + 1,
            pairs_to_learn: PAIRS_TO_LEARN,
            has_moved: false,
            misfits: false,
        })
    }

    /// Forgets the sights of the pair before.
    pub fn begin_sights(&mut self) {
        self.rows.begin();
        self.step.begin();
    }

    /// Takes note of a stereo sight, corrected for what [`displacement`](Self::displacement) says.
    pub fn see(&mut self, sight: &StereoMeasurement) {
        let mut raw = *sight;
        raw.px += self.displacement(&sight.px);
        self.rows.add(&self.rig, &self.rectification, &raw);
    }

    /// Takes note of where a landmark is seen now: `expected` is (x, y, ρ) in the newest frame with its
    /// covariance, `seen` corrected by all that is known of the rig.
    pub fn see_landmark(
        &mut self,
        now_from_newest: &Isometry3<f64>,
        expected: &(Vector3<f64>, Matrix3<f64>),
        seen: &StereoMeasurement,
    ) {
        self.step.add(&self.rig, now_from_newest, expected, seen);
    }

    /// Concludes what the sights of a pair say: by how much more measurements are to be corrected from now on,
    /// those of this pair included, if by anything; a turn, rad.
    pub fn conclude_sights(&mut self, timestamp_ns: i64) -> Option<Vector3<f64>> {
        let dt_s = self
            .last_ns
            .map_or(0.0, |last| (timestamp_ns - last) as f64 * NS_TO_S);
        self.last_ns = Some(timestamp_ns);
        self.pairs_since_blow = self.pairs_since_blow.saturating_add(1);
        self.filter.walk(self.settings.walk_rad, dt_s);
        let before_rad = self.applied_rad;
        self.conclude();
        self.judge();
        let more_rad = self.applied_rad - before_rad;
        (more_rad != Vector3::zeros()).then_some(more_rad)
    }

    fn conclude(&mut self) {
        let rows = self.rows.say(&self.filter);
        let mut step = self.step.say();
        let mut is_suspicious = false;
        let mut is_blow = false;
        if rows.is_some() && self.pairs_to_learn > 0 {
            // As it is at first, so it was calibrated.
            self.pairs_to_learn -= 1;
        } else if let Some(rows) = &rows {
            let doubt = self.rows_alarm.add(rows, &self.filter);
            is_suspicious = doubt > self.limits.suspicious;
            is_blow = doubt > self.limits.turn;
        }
        if let Some(step) = &mut step {
            let squared = step.yaw_squared();
            step.scale(1.0 / self.spread.factor());
            if self.pairs_since_blow > PAIRS_OF_REST {
                let is_jump = self.step_alarm.add(step, &self.filter) > self.limits.yaw;
                is_blow |= is_jump;
                if !is_jump {
                    self.spread.take(squared);
                }
            }
        }
        if is_blow {
            // It leaves the state where it is, so that the equations hold.
            self.blow();
        }
        let then = self.filter.state;
        if is_blow && let Some(step) = &step {
            // Later, landmarks will have followed.
            self.filter.update(step);
        }
        if let Some(mut rows) = rows.filter(|_| is_blow || !is_suspicious) {
            rows.count_from(&(self.filter.state - then));
            self.filter.update(&rows);
        }
    }

    /// The camera may have turned at once: what was known of its turn holds no more.
    fn blow(&mut self) {
        self.yaw_before_rad = self.filter.turn_rad().y;
        self.pairs_since_blow = 0;
        self.filter.open(BLOW_RAD);
        self.rows_alarm.clear();
        self.step_alarm.clear();
    }

    fn judge(&mut self) {
        self.has_moved |= self.filter.turn_nees() > self.limits.turn;
        self.misfits |= self.filter.statics_nees() > self.limits.statics;
        if self.settings.refine && self.has_moved {
            let (turn_rad, cov) = (self.filter.turn_rad(), self.filter.turn_cov());
            let unknown_yaw = cov[(YAW, YAW)] > KNOWN_YAW_RAD * KNOWN_YAW_RAD;
            let given_yaw =
                cov.column(YAW) * ((self.yaw_before_rad - turn_rad.y) / cov[(YAW, YAW)]);
            self.applied_rad = if unknown_yaw {
                turn_rad + given_yaw
            } else {
                turn_rad
            };
        }
    }

    /// By how much the turn displaces what the right camera sees at (ul, vl, ur, vr), px, where measurements
    /// are to be corrected for it; zero otherwise.
    #[must_use]
    pub fn displacement(&self, px: &Vector4<f64>) -> Vector4<f64> {
        if self.applied_rad == Vector3::zeros() {
            return Vector4::zeros();
        }
        self.displacement_by(&self.applied_rad, px)
    }

    /// The same of a turn that is given, rad.
    #[must_use]
    pub fn displacement_by(&self, turn_rad: &Vector3<f64>, px: &Vector4<f64>) -> Vector4<f64> {
        let right_px = px.fixed_rows::<2>(2).into_owned();
        turn::px_by_turn(&self.rig.right, &right_px).map_or_else(Vector4::zeros, |by| {
            let moved = by * turn_rad;
            Vector4::new(0.0, 0.0, moved.x, moved.y)
        })
    }

    /// By how much a blow may displace what the right camera sees, 1 σ, px.
    #[must_use]
    pub fn blow_px(&self) -> f64 {
        BLOW_RAD * self.rectification.focal_px()
    }

    /// How the rig is.
    #[must_use]
    pub fn state(&self) -> RigState {
        RigState {
            turn_rad: self.filter.turn_rad().into(),
            sigma_rad: self
                .filter
                .turn_cov()
                .diagonal()
                .map(|v| v.max(0.0).sqrt())
                .into(),
            has_moved: self.has_moved,
            misfits: self.misfits,
        }
    }
}
