//! Estimation: matched features in, motion and pose with covariance out.

pub mod bundle;
pub mod calibration;
pub mod closed_form;
pub mod consensus;
mod determinacy;
pub mod influence;
mod model;
mod motion;
pub mod motion_chain;
mod odometer;
pub mod planar;
pub mod reprojection;
mod settings;
mod sight;
pub mod sources;
mod standing;
mod start;
#[cfg(test)]
mod synthetic;
pub mod track_noise;
mod tracked_feature;
mod triangulation;
pub mod two_frame;
pub mod weighted;
pub mod window;

pub use determinacy::Axes;
pub use model::{FLAT_LIMIT, Model, MotionModel, Plane};
pub use motion::{MeasuredMotion, MotionMeter, Tracks as MotionTracks};
pub use odometer::{Odometer, PairStamp, Place};
pub use settings::{KEYFRAMES, Method, Settings};
pub use sight::{Sight, Viewpoint, inverse_depth, linearise as linearise_sight, seen_at};
pub use start::Start;
pub use tracked_feature::TrackedFeature;
pub use triangulation::{Landmark, StereoMeasurement, triangulate, triangulate_linear};

use nalgebra::{Isometry3, Matrix6, Vector6};

/// How far an estimate can be trusted.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Status {
    /// The first pair of an epoch: a pose by definition, no motion yet.
    Initializing,
    /// The motion was measured.
    Tracking,
    /// The motion was measured, from fewer or worse features than it should be.
    Degraded,
    /// The motion was not measured: the pose is bridged by the last velocity.
    Lost,
}

impl Status {
    /// The word used in CSV, JSON and logs.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Initializing => "initializing",
            Self::Tracking => "tracking",
            Self::Degraded => "degraded",
            Self::Lost => "lost",
        }
    }
}

/// How many of what one pair had.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Keypoints of the left image.
    pub keypoints_left: u32,
    /// Keypoints of the right image.
    pub keypoints_right: u32,
    /// Left–right matches.
    pub stereo_matches: u32,
    /// What was seen before and is found again: stereo matches of the pair before, or landmarks of the
    /// window.
    pub tracks: u32,
    /// Tracks that the estimate rests on.
    pub inliers: u32,
}

/// The published covariance by source; the parts sum to the whole.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ErrorBudget {
    /// From the detection of keypoints.
    pub detection: Matrix6<f64>,
    /// From the calibration of the rig.
    pub calibration: Matrix6<f64>,
    /// From images that were not taken at the same instant.
    pub synchronisation: Matrix6<f64>,
    /// From motions that had to be bridged because they could not be measured.
    pub bridging: Matrix6<f64>,
}

impl ErrorBudget {
    /// The parts with their names, in the order of the fields.
    #[must_use]
    pub fn parts(&self) -> [(&'static str, &Matrix6<f64>); 4] {
        [
            ("detection", &self.detection),
            ("calibration", &self.calibration),
            ("synchronisation", &self.synchronisation),
            ("bridging", &self.bridging),
        ]
    }

    /// The whole.
    #[must_use]
    pub fn total(&self) -> Matrix6<f64> {
        self.detection + self.calibration + self.synchronisation + self.bridging
    }
}

/// σ of a rotation beyond which positions that hang on it bend: errors are then no ellipsoid, rad.
const FIRST_ORDER_RAD: f64 = 0.2;

/// Pose, motion and velocity after one stereo pair, each with its covariance.
///
/// Covariances are ordered x, y, z, rx, ry, rz (m², m·rad, rad²). Those of `odom_from_camera` and
/// `prev_from_now` hold the error `[t_est − t ; Log(R_est Rᵀ)]`: translation in, and rotation about
/// the fixed axes of, the frame named first. The twist's is in the camera frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Odometry {
    /// The number of the pair in its recording.
    pub sequence: u64,
    /// When the left image was taken, ns.
    pub timestamp_ns: i64,
    /// Rises whenever the odometry frame begins anew.
    pub epoch: u32,
    /// How far this estimate can be trusted.
    pub status: Status,
    /// Pose: maps a point of the left camera now into the odometry frame, m.
    pub odom_from_camera: Isometry3<f64>,
    /// Covariance of the pose.
    pub cov_pose: Matrix6<f64>,
    /// Motion since the pair before: maps a point of the left camera now into the left camera then.
    pub prev_from_now: Isometry3<f64>,
    /// Covariance of the motion.
    pub cov_motion: Matrix6<f64>,
    /// Velocity in the camera frame: m/s then rad/s.
    pub twist: Vector6<f64>,
    /// Covariance of the velocity.
    pub cov_twist: Matrix6<f64>,
    /// The pose's covariance by source.
    pub budget: ErrorBudget,
    /// What the estimate rests on.
    pub counts: Counts,
    /// A-posteriori variance factor: 1 when residuals are as large as the noise model says.
    pub variance_factor: f64,
    /// Normalised innovations squared of the pair over what the noise model would be rejected at:
    /// below 0.5 it is fine, above 1 it does not hold. Not a number where nothing was measured.
    pub innovation_ratio: f64,
}

impl Odometry {
    /// Whether the pose's covariance describes its error: false once the rotation's σ about any
    /// axis is above 0.2 rad, for then positions err along an arc that no ellipsoid covers.
    #[must_use]
    pub fn is_first_order(&self) -> bool {
        is_first_order(&self.cov_pose)
    }

    /// The axes of the motion that the images leave open: all of them where it was bridged.
    #[must_use]
    pub fn undetermined(&self) -> Axes {
        match self.status {
            Status::Lost => Axes::ALL,
            _ => Axes::left_open_by(&self.cov_motion),
        }
    }
}

/// [`Odometry::is_first_order`] of a covariance.
#[must_use]
pub fn is_first_order(cov_pose: &Matrix6<f64>) -> bool {
    let limit = FIRST_ORDER_RAD * FIRST_ORDER_RAD;
    (3..6).all(|axis| cov_pose[(axis, axis)] <= limit)
}
