//! Odometry: one motion after the other in, the pose with its covariance out (thesis §2.5, §3.4).
//!
//! Motions are measured against a *reference* pair, the last one whose motion was measured. Where
//! a motion cannot be measured the pose is bridged by the last velocity, with a covariance that
//! grows by what the robot's velocity may have changed; once the reference is recognised again the
//! bridge is forgotten.

use super::closed_form::MotionEstimate;
use super::sources::{BySources, Exposure, RigErrors};
use super::standing::Standing;
use super::start::Start;
use super::window::Tracked;
use super::{Axes, Counts, ErrorBudget, FLAT_LIMIT, MeasuredMotion, Odometry, Settings, Status};
use crate::geometry::se3;
use crate::uncertainty::{compounding, consider};
use nalgebra::{Isometry3, Matrix6, Vector6};
use std::time::Instant;

/// The origin is a pose by definition; its covariance only has to be positive definite: (1 µm)²,
/// (1 µrad)².
const ORIGIN_VARIANCE: f64 = 1e-12;
/// 1 σ of a velocity that nothing is known about: m/s and rad/s.
const UNKNOWN_SPEED_M_S: f64 = 10.0;
const UNKNOWN_TURN_RAD_S: f64 = 3.0;
const NS_PER_S: f64 = 1e9;

/// Which pair an odometry row belongs to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PairStamp {
    /// The number of the pair in its recording.
    pub sequence: u64,
    /// When its left image was taken, ns.
    pub timestamp_ns: i64,
}

/// Where a robot stands and how sure that is, all of right perturbations.
#[derive(Clone, Copy, Debug)]
pub struct Place {
    /// The pose.
    pub odom_from_camera: Isometry3<f64>,
    /// Covariance by the pixels' noise and, if one was estimated, by the warp's prior.
    pub cov: Matrix6<f64>,
    /// What each source of error does to it.
    pub by_sources: BySources,
    timestamp_ns: i64,
    bridging: Matrix6<f64>,
}

/// A velocity in the camera frame with its covariance, per second.
#[derive(Clone, Copy, Debug)]
struct Velocity {
    twist: Vector6<f64>,
    cov: Matrix6<f64>,
}

/// Chains motions to a pose.
#[derive(Clone, Debug)]
pub struct Odometer {
    settings: Settings,
    errors: RigErrors,
    epoch: u32,
    /// Where it begins, if not at the origin.
    start: Option<Start>,
    reference: Place,
    last: Place,
    /// From the reference to the last row: what bridging has added since.
    reference_from_last: MotionEstimate,
    velocity: Velocity,
    bridged: u32,
    tracked_in_epoch: bool,
    variance_factor: f64,
    standing: Standing,
}

impl Odometer {
    /// Begins at the origin with the first pair.
    #[must_use]
    pub fn new(settings: Settings, errors: RigErrors, stamp: PairStamp) -> Self {
        let origin = Place {
            odom_from_camera: Isometry3::identity(),
            timestamp_ns: stamp.timestamp_ns,
            cov: Matrix6::identity() * ORIGIN_VARIANCE,
            by_sources: BySources::zeros(),
            bridging: Matrix6::zeros(),
        };
        Self {
            standing: Standing::new(settings.good_inliers),
            settings,
            errors,
            epoch: 0,
            start: None,
            reference: origin,
            last: origin,
            reference_from_last: no_motion(),
            velocity: unknown_velocity(),
            bridged: 0,
            tracked_in_epoch: false,
            variance_factor: 1.0,
        }
    }

    /// Continues the frame of an earlier run, if there is one, as its epoch `epoch`. How far the robot may have
    /// moved meanwhile counts as bridged.
    #[must_use]
    pub fn continuing(mut self, epoch: u32, start: Option<Start>) -> Self {
        self.epoch = epoch;
        self.start = start;
        self
    }

    /// The variance factor to expect of the next motion.
    #[must_use]
    pub fn expected_variance_factor(&self) -> f64 {
        self.variance_factor
    }

    /// Whether a velocity has been measured, so that [`predict`](Self::predict) means something.
    #[must_use]
    pub fn has_velocity(&self) -> bool {
        self.tracked_in_epoch
    }

    /// The motion since the reference that the last velocity leads to expect: `reference_from_now`.
    #[must_use]
    pub fn predict(&self, timestamp_ns: i64) -> Isometry3<f64> {
        let since_last =
            self.velocity.twist * seconds_between(self.last.timestamp_ns, timestamp_ns);
        self.reference_from_last.prev_from_now * se3::exp(&since_last)
    }

    /// The row of the pair with which the odometer began, or with which it begins anew because
    /// nothing has been tracked yet.
    pub fn begin(&mut self, stamp: PairStamp, counts: Counts) -> Odometry {
        self.reference.timestamp_ns = stamp.timestamp_ns;
        if let Some(start) = &self.start {
            self.reference.odom_from_camera = start.odom_from_camera;
            self.reference.bridging = start.cov_right(Instant::now());
        }
        self.last = self.reference;
        self.reference_from_last = no_motion();
        self.bridged = 0;
        let motion = MotionEstimate {
            cov_right: Matrix6::identity() * ORIGIN_VARIANCE,
            ..no_motion()
        };
        self.standing.begin();
        self.row(
            stamp,
            Status::Initializing,
            &motion,
            counts,
            Noise::as_stated(),
        )
    }

    /// Whether a robot can have moved so since the reference, as far as the settings tell. `reference_from_now` is the
    /// motion.
    #[must_use]
    pub fn is_possible(&self, reference_from_now: &Isometry3<f64>, timestamp_ns: i64) -> bool {
        let dt_s = seconds_between(self.reference.timestamp_ns, timestamp_ns);
        let is_within = |moved: f64, limit: Option<f64>| {
            limit.is_none_or(|a_second| dt_s <= 0.0 || moved <= a_second * dt_s)
        };
        is_within(
            reference_from_now.translation.vector.norm(),
            self.settings.max_speed_m_s,
        ) && is_within(
            reference_from_now.rotation.angle(),
            self.settings.max_turn_rad_s,
        )
    }

    /// Whether any motion has been measured since the odometry frame began.
    #[must_use]
    pub fn has_tracked(&self) -> bool {
        self.tracked_in_epoch
    }

    /// The row of a pair whose motion `reference_from_now` was measured; the pair becomes the
    /// reference. `cov_chained` is what the noise of all motions up to now makes of the pose's
    /// covariance, their correlation included.
    pub fn advance(
        &mut self,
        stamp: PairStamp,
        measured: &MeasuredMotion,
        cov_chained: &Matrix6<f64>,
        counts: Counts,
    ) -> Odometry {
        let reference_from_now = measured.estimate.prev_from_now;
        let carry = se3::adjoint(&reference_from_now.inverse());
        let now = Place {
            odom_from_camera: se3::renormalised(
                self.reference.odom_from_camera * reference_from_now,
            ),
            timestamp_ns: stamp.timestamp_ns,
            cov: *cov_chained,
            by_sources: carry * self.reference.by_sources + measured.by_sources,
            bridging: compounding::carry(&self.reference.bridging, &reference_from_now),
        };
        self.go_on(stamp, now, measured, counts)
    }

    /// Makes `now` the reference and the last row.
    fn go_on(
        &mut self,
        stamp: PairStamp,
        now: Place,
        measured: &MeasuredMotion,
        counts: Counts,
    ) -> Odometry {
        let cov_right = self
            .errors
            .apart(&measured.estimate.cov_right, &measured.by_sources)
            .total();
        let since_last = self.since_last_row(&MotionEstimate {
            prev_from_now: measured.estimate.prev_from_now,
            cov_right,
        });
        let dt_s = seconds_between(self.last.timestamp_ns, stamp.timestamp_ns);
        self.velocity = velocity_of(&since_last, dt_s, self.sigma_stamp_s());
        let noise = Noise {
            variance_factor: measured.variance_factor,
            innovation_ratio: innovation_ratio(measured.variance_factor, self.variance_factor),
        };
        self.variance_factor = 0.8 * self.variance_factor + 0.2 * measured.variance_factor;
        let is_possible = self.is_possible(&measured.estimate.prev_from_now, stamp.timestamp_ns);
        self.tracked_in_epoch = true;
        self.bridged = 0;
        self.reference = now;
        self.last = now;
        self.reference_from_last = no_motion();
        let is_flat = measured.departure.is_none_or(|d| d <= FLAT_LIMIT);
        let is_determined = Axes::left_open_by(&cov_right).is_empty();
        let is_plausible = is_flat && is_possible && is_determined;
        let status = self
            .standing
            .measured(measured.inliers, noise.innovation_ratio, is_plausible);
        self.row(stamp, status, &since_last, counts, noise)
    }

    /// The row of a pair whose pose the window knows; the pair becomes the reference.
    pub fn arrive(&mut self, stamp: PairStamp, tracked: &Tracked, counts: Counts) -> Odometry {
        let place = Place {
            odom_from_camera: tracked.odom_from_now,
            timestamp_ns: stamp.timestamp_ns,
            cov: tracked.cov_pose_right,
            by_sources: tracked.pose_by_sources,
            bridging: compounding::carry(&self.reference.bridging, &tracked.motion.prev_from_now),
        };
        let measured = MeasuredMotion {
            estimate: tracked.motion,
            by_sources: tracked.motion_by_sources,
            variance_factor: tracked.variance_factor,
            inliers: tracked.inliers,
            departure: tracked.departure,
        };
        self.go_on(stamp, place, &measured, counts)
    }

    /// Where the last row stands, and how sure that is, bridges left out.
    #[must_use]
    pub fn last_place(&self) -> &Place {
        &self.last
    }

    /// How the images of a pair were taken whose right one came `skew_s` late (1 σ `sigma_skew_s`):
    /// the camera moving as it did last. Without a velocity, or where skew is not to be considered,
    /// as if at the same instant.
    #[must_use]
    pub fn exposure(&self, skew_s: f64, sigma_skew_s: f64) -> Exposure {
        if !self.settings.consider_synchronisation || !self.tracked_in_epoch {
            return Exposure::default();
        }
        Exposure {
            twist: self.velocity.twist,
            skew_s,
            sigma_skew_s,
        }
    }

    /// 1 σ of a time stamp as far as it is to be considered, s.
    fn sigma_stamp_s(&self) -> f64 {
        if self.settings.consider_synchronisation {
            self.settings.timestamp_sigma_s
        } else {
            0.0
        }
    }

    /// The row of a pair whose motion could not be measured: the pose goes on with the last
    /// velocity.
    pub fn bridge(&mut self, stamp: PairStamp, counts: Counts) -> Odometry {
        let dt_s = seconds_between(self.last.timestamp_ns, stamp.timestamp_ns);
        let motion = MotionEstimate {
            prev_from_now: se3::exp(&(self.velocity.twist * dt_s)),
            cov_right: self.bridge_growth(stamp.timestamp_ns),
        };
        let step = &motion.prev_from_now;
        self.last = Place {
            odom_from_camera: se3::renormalised(self.last.odom_from_camera * step),
            timestamp_ns: stamp.timestamp_ns,
            cov: compounding::carry(&self.last.cov, step),
            by_sources: se3::adjoint(&step.inverse()) * self.last.by_sources,
            bridging: compounding::chain(&self.last.bridging, step, &motion.cov_right),
        };
        self.reference_from_last = MotionEstimate {
            prev_from_now: self.reference_from_last.prev_from_now * step,
            cov_right: compounding::chain(
                &self.reference_from_last.cov_right,
                step,
                &motion.cov_right,
            ),
        };
        self.bridged += 1;
        self.standing.lost();
        let noise = Noise {
            variance_factor: self.variance_factor,
            innovation_ratio: f64::NAN,
        };
        self.row(stamp, Status::Lost, &motion, counts, noise)
    }

    /// Whether the reference has been out of sight for so long that the frame should begin anew.
    #[must_use]
    pub fn should_begin_anew(&self) -> bool {
        self.bridged >= self.settings.max_bridged
    }

    /// Begins a new epoch where the last row stands: the pose goes on, but the link to what came
    /// before is bridged, not measured.
    pub fn begin_anew(&mut self, stamp: PairStamp, counts: Counts) -> Odometry {
        let mut row = self.bridge(stamp, counts);
        self.epoch += 1;
        self.reference = self.last;
        self.reference_from_last = no_motion();
        self.velocity = unknown_velocity();
        self.bridged = 0;
        self.tracked_in_epoch = false;
        // The pose that the new epoch begins with is the bridged one.
        self.start = None;
        self.standing.begin();
        row.epoch = self.epoch;
        row.status = Status::Initializing;
        row
    }

    /// By how much one more bridged row widens the pose. Over the time T since the last
    /// measurement, velocity contributes σ_v T and its change ½ a T²: not independent from row to
    /// row, so that each adds the difference of the totals.
    fn bridge_growth(&self, timestamp_ns: i64) -> Matrix6<f64> {
        let total = |to_ns: i64| {
            let t = seconds_between(self.reference.timestamp_ns, to_ns);
            let (a, alpha) = (
                0.5 * self.settings.acceleration_m_s2 * t * t,
                0.5 * self.settings.angular_acceleration_rad_s2 * t * t,
            );
            let change = Vector6::new(a, a, a, alpha, alpha, alpha);
            self.velocity.cov * (t * t) + Matrix6::from_diagonal(&change.component_mul(&change))
        };
        // A stamp that goes backwards takes nothing back of what is unknown.
        let last_ns = self.last.timestamp_ns;
        let growth = total(timestamp_ns.max(last_ns)) - total(last_ns);
        se3::symmetric(&growth) + Matrix6::identity() * ORIGIN_VARIANCE
    }

    /// The motion since the last row, from the motion since the reference.
    fn since_last_row(&self, reference_from_now: &MotionEstimate) -> MotionEstimate {
        if self.bridged == 0 {
            return *reference_from_now;
        }
        let last_from_reference = self.reference_from_last.prev_from_now.inverse();
        let last_from_now = last_from_reference * reference_from_now.prev_from_now;
        // The bridge's error stands to the left of the motion: carried over by the adjoint.
        MotionEstimate {
            prev_from_now: last_from_now,
            cov_right: compounding::chain(
                &self.reference_from_last.cov_right,
                &last_from_now,
                &reference_from_now.cov_right,
            ),
        }
    }

    fn row(
        &self,
        stamp: PairStamp,
        status: Status,
        motion: &MotionEstimate,
        counts: Counts,
        noise: Noise,
    ) -> Odometry {
        let pose = &self.last.odom_from_camera;
        let parts = self.errors.apart(&self.last.cov, &self.last.by_sources);
        let in_odom = |cov: &Matrix6<f64>| se3::cov_fixed_axes_from_right(pose, cov);
        let budget = ErrorBudget {
            detection: in_odom(&parts.detection),
            calibration: in_odom(&parts.calibration),
            synchronisation: in_odom(&parts.synchronisation),
            bridging: in_odom(&self.last.bridging),
        };
        Odometry {
            sequence: stamp.sequence,
            timestamp_ns: stamp.timestamp_ns,
            epoch: self.epoch,
            status,
            odom_from_camera: *pose,
            cov_pose: budget.total(),
            prev_from_now: motion.prev_from_now,
            cov_motion: se3::cov_fixed_axes_from_right(&motion.prev_from_now, &motion.cov_right),
            twist: self.velocity.twist,
            cov_twist: self.velocity.cov,
            budget,
            counts,
            variance_factor: noise.variance_factor,
            innovation_ratio: noise.innovation_ratio,
        }
    }
}

/// What a pair's residuals say of the noise model.
#[derive(Clone, Copy, Debug)]
struct Noise {
    variance_factor: f64,
    innovation_ratio: f64,
}

impl Noise {
    /// Of a pair without residuals, with which an odometry begins.
    fn as_stated() -> Self {
        Self {
            variance_factor: 1.0,
            innovation_ratio: f64::NAN,
        }
    }
}

/// Normalised innovations squared that a noise model is rejected at: residuals of twice the σ that
/// the pairs before lead to expect.
const IMPLAUSIBLE_FACTOR: f64 = 4.0;

/// A pair's normalised innovations squared over what they are rejected at. A quarter is par; below a
/// half the noise model is plausible, above 1 it is not.
fn innovation_ratio(variance_factor: f64, expected: f64) -> f64 {
    variance_factor / (IMPLAUSIBLE_FACTOR * expected)
}

fn no_motion() -> MotionEstimate {
    MotionEstimate {
        prev_from_now: Isometry3::identity(),
        cov_right: Matrix6::zeros(),
    }
}

fn unknown_velocity() -> Velocity {
    let (v, w) = (UNKNOWN_SPEED_M_S, UNKNOWN_TURN_RAD_S);
    let sigma = Vector6::new(v, v, v, w, w, w);
    Velocity {
        twist: Vector6::zeros(),
        cov: Matrix6::from_diagonal(&sigma.component_mul(&sigma)),
    }
}

/// The mean velocity over a motion, its covariance that of the motion and of the two stamps.
fn velocity_of(motion: &MotionEstimate, dt_s: f64, sigma_stamp_s: f64) -> Velocity {
    if dt_s <= 0.0 {
        return unknown_velocity();
    }
    let xi = se3::log(&motion.prev_from_now);
    let by_right = se3::right_jacobian_inverse(&xi) / dt_s;
    let twist = xi / dt_s;
    let of_motion = by_right * motion.cov_right * by_right.transpose();
    Velocity {
        twist,
        cov: se3::symmetric(&of_motion) + consider::of_interval(&twist, dt_s, sigma_stamp_s),
    }
}

/// Time from one stamp to a later one, s; 0 where the clock went backwards.
fn seconds_between(from_ns: i64, to_ns: i64) -> f64 {
    (to_ns.saturating_sub(from_ns).max(0)) as f64 / NS_PER_S
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::StereoRig;
    use crate::simulation;
    use proptest::prelude::*;

    fn odometer() -> Odometer {
        let rig: StereoRig = simulation::thesis_rig();
        let settings = Settings::default();
        let errors = RigErrors::of(&rig, &settings);
        Odometer::new(settings, errors, stamp(0))
    }

    fn stamp(timestamp_ms: i64) -> PairStamp {
        PairStamp {
            sequence: 0,
            timestamp_ns: timestamp_ms * 1_000_000,
        }
    }

    fn measured() -> MeasuredMotion {
        MeasuredMotion {
            estimate: MotionEstimate {
                prev_from_now: se3::exp(&Vector6::new(0.0, 0.0, 0.1, 0.0, 0.01, 0.0)),
                cov_right: Matrix6::identity() * 1e-6,
            },
            by_sources: BySources::zeros(),
            variance_factor: 1.0,
            inliers: 100,
            departure: None,
        }
    }

    #[test]
    fn what_the_images_leave_open_degrades_the_pair_and_is_told() {
        let mut odometer = odometer();
        let cov_chained = Matrix6::identity() * 1e-6;
        let row = odometer.begin(stamp(0), Counts::default());
        assert_eq!(row.undetermined(), Axes::NONE);
        let mut measured = measured();
        let row = odometer.advance(stamp(100), &measured, &cov_chained, Counts::default());
        assert_eq!(
            (row.status, row.undetermined()),
            (Status::Tracking, Axes::NONE)
        );
        measured.estimate.cov_right[(2, 2)] = 0.04;
        let row = odometer.advance(stamp(200), &measured, &cov_chained, Counts::default());
        let open: Vec<_> = row.undetermined().names().collect();
        assert_eq!((row.status, open), (Status::Degraded, vec!["z"]));
        let row = odometer.bridge(stamp(300), Counts::default());
        assert_eq!((row.status, row.undetermined()), (Status::Lost, Axes::ALL));
    }

    proptest! {
        /// Whether stamps rise, stand still or fall, pairs are measured or bridged.
        #[test]
        fn covariances_are_covariances_whatever_the_stamps(
            rows in proptest::collection::vec((-300_i64..900, any::<bool>()), 1..20),
        ) {
            let mut odometer = odometer();
            odometer.begin(stamp(0), Counts::default());
            let mut cov_chained = Matrix6::identity() * ORIGIN_VARIANCE;
            for (timestamp_ms, is_measured) in rows {
                let row = if is_measured {
                    cov_chained += Matrix6::identity() * 1e-6;
                    odometer.advance(stamp(timestamp_ms), &measured(), &cov_chained, Counts::default())
                } else {
                    odometer.bridge(stamp(timestamp_ms), Counts::default())
                };
                for cov in [row.cov_pose, row.cov_motion, row.cov_twist] {
                    prop_assert!(cov.cholesky().is_some(), "{row:?}");
                }
            }
        }
    }
}
