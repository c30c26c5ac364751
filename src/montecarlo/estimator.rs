//! What the odometry stage tries out: one pair's tracked sights after the other in, poses with
//! covariances out.

use crate::estimation::StereoMeasurement;
use nalgebra::{Isometry3, Matrix6};

/// A feature seen by both cameras.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrackedSight {
    /// The feature: the same in every pair that sees it.
    pub id: u64,
    /// Where both cameras saw it, raw px, with the σ that the estimator is told.
    pub measurement: StereoMeasurement,
}

/// What an estimator says after a pair. Covariances are of right perturbations, `T · Exp(ξ)`,
/// ξ = (translation, rotation): m², m·rad, rad².
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FrameEstimate {
    /// The motion since the pair before.
    pub prev_from_now: Isometry3<f64>,
    /// Its covariance.
    pub cov_motion: Matrix6<f64>,
    /// The pose in the first pair's frame.
    pub odom_from_camera: Isometry3<f64>,
    /// Its covariance; that of the first pair is zero.
    pub cov_pose: Matrix6<f64>,
}

/// An odometry of tracked points.
pub trait FrameEstimator {
    /// Takes the next pair's sights, with rising ids; the first pair is the origin.
    ///
    /// `None` where no motion could be estimated: the run ends there.
    fn observe(&mut self, sights: &[TrackedSight]) -> Option<FrameEstimate>;
}
