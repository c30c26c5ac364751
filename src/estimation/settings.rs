//! How motion is estimated.

use super::MotionModel;
use super::two_frame::Estimator;
use crate::settings::SettingError;
use serde::{Deserialize, Serialize};
use std::ops::RangeInclusive;

/// Which estimator.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Method {
    /// Closed form on triangulated points, as the thesis has it: simple, and coarse.
    Svd,
    /// Triangulated points, each weighted by its own covariance.
    Weighted,
    /// Two-frame stereo bundle adjustment in the images.
    Bundle,
    /// Bundle adjustment over a window of keyframes, of landmarks that are tracked to a fraction of
    /// a pixel.
    #[default]
    Window,
}

impl Method {
    /// The estimator of motions between two pairs; `None` for the window.
    #[must_use]
    pub fn of_two_frames(self) -> Option<Estimator> {
        match self {
            Self::Svd => Some(Estimator::Svd),
            Self::Weighted => Some(Estimator::Weighted),
            Self::Bundle => Some(Estimator::Bundle),
            Self::Window => None,
        }
    }
}

/// How motion is estimated.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// The estimator: "svd", "weighted", "bundle" or "window". Default "window": "bundle", from pair
    /// to pair, is half as good, "weighted" gathers a bias, and the closed form "svd" is a hundred
    /// times coarser on distant points.
    pub method: Method,
    /// What motions are possible: "se3", any, or "planar", those of a robot on flat ground: the plane
    /// is that of the rig's mounting, else that of a camera which looks straight ahead. Default
    /// "se3": few floors are flat.
    pub model: MotionModel,
    /// How far flat ground may fail to be flat, for the planar model: 1 σ of heave from keyframe to
    /// keyframe, or from pair to pair. Pairs that leave the plane by more are degraded. m, 1e-5 to 1,
    /// default 0.005: a threshold between two rooms.
    pub flat_sigma_m: f64,
    /// The same of roll and of pitch. rad, 1e-5 to 1, default 0.005: what suspension does.
    pub flat_sigma_rad: f64,
    /// Tracks that must agree for a motion to count as measured. 3 to 1000, default 12: below, one
    /// wrong track can lead the estimate.
    pub min_inliers: u32,
    /// Tracks that must agree for a motion to be called good. 3 to 10000, default 30.
    pub good_inliers: u32,
    /// Samples that consensus may draw. 10 to 100000, default 500: finds a consensus of a quarter
    /// of the tracks with 99.9 %.
    pub max_samples: u32,
    /// Largest squared residual of a track that counts. σ², 1 to 100, default 20: of Gaussian ones
    /// (five degrees of freedom) 0.1 % are larger.
    pub gate_sigma2: f64,
    /// Seed of consensus. Any, default 1: the same seed gives the same bits.
    pub seed: u64,
    /// Keyframes in the window. 2 to 20, default 14: fewer lose what a landmark that is seen in many of them tells,
    /// more gain little.
    pub keyframes: u32,
    /// Landmarks that are tracked at once. 20 to 5000, default 300: more cost time and gain little.
    pub max_landmarks: u32,
    /// A pair becomes a keyframe when fewer of the last keyframe's landmarks are still seen. Share,
    /// 0 to 1, default 0.7.
    pub keyframe_survival: f64,
    /// The same when landmarks have moved farther than this since the last keyframe (median). Share
    /// of the image's width, 0 to 1, default 0.015: what moves less says little of depth.
    pub keyframe_parallax: f64,
    /// By how much calibration may leave the right image displaced, 1 σ of each coefficient of a
    /// quadratic, where the rig does not state its own uncertainty: the window estimates it along
    /// with the motion. px, 0 to 10, default 0.3: what published recordings show; 0 takes the
    /// calibration as exact.
    pub calibration_sigma_px: f64,
    /// Whether the rig's uncertainty, stated or supposed, goes into the covariance of pose and motion.
    /// Default true: an error of the rig does not average out.
    pub consider_calibration: bool,
    /// Whether a known time between a pair's exposures is compensated, and its uncertainty and that
    /// of time stamps go into covariances. Default true.
    pub consider_synchronisation: bool,
    /// 1 σ of a pair's time stamp, which makes velocities uncertain. s, 0 to 1, default 0.0001: what a
    /// computer's clock tells of a camera's.
    pub timestamp_sigma_s: f64,
    /// The fastest that the robot can be: a motion that is faster was not its own, and the pair is lost (by the
    /// estimators from pair to pair: degraded). m/s, 0.001 to 1000, default none.
    pub max_speed_m_s: Option<f64>,
    /// The same of its turn rate. rad/s, 0.001 to 1000, default none.
    pub max_turn_rad_s: Option<f64>,
    /// How many of a camera's last images are remembered: a pair with one that is the same to the byte, or of
    /// which a quarter is, is refused, for the camera or its driver is frozen. 0 to 64, default 8; 0 takes
    /// whatever comes.
    pub repeats: u32,
    /// Pairs without a measured motion that are bridged before the odometry frame begins anew. 0 to
    /// 10000, default 20.
    pub max_bridged: u32,
    /// How much a robot's velocity may change while it is bridged, 1 σ. m/s², above 0 to 1000,
    /// default 2.
    pub acceleration_m_s2: f64,
    /// The same for its turn rate. rad/s², above 0 to 1000, default 2.
    pub angular_acceleration_rad_s2: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            method: Method::Window,
            model: MotionModel::Se3,
            flat_sigma_m: 0.005,
            flat_sigma_rad: 0.005,
            min_inliers: 12,
            good_inliers: 30,
            max_samples: 500,
            gate_sigma2: 20.0,
            seed: 1,
            keyframes: 14,
            calibration_sigma_px: 0.3,
            consider_calibration: true,
            consider_synchronisation: true,
            timestamp_sigma_s: 1e-4,
            max_landmarks: 300,
            keyframe_survival: 0.7,
            keyframe_parallax: 0.015,
            max_speed_m_s: None,
            max_turn_rad_s: None,
            repeats: 8,
            max_bridged: 20,
            acceleration_m_s2: 2.0,
            angular_acceleration_rad_s2: 2.0,
        }
    }
}

/// Keyframes that a window can have.
pub const KEYFRAMES: RangeInclusive<u32> = 2..=20;

impl Settings {
    /// Refuses values out of range.
    ///
    /// # Errors
    /// The first setting out of range.
    pub fn check(&self) -> Result<(), SettingError> {
        SettingError::unless_in("min_inliers", self.min_inliers, 3..=1000)?;
        SettingError::unless_in("good_inliers", self.good_inliers, 3..=10_000)?;
        SettingError::unless_in("max_samples", self.max_samples, 10..=100_000)?;
        SettingError::unless_in("gate_sigma2", self.gate_sigma2, 1.0..=100.0)?;
        SettingError::unless_in("keyframes", self.keyframes, KEYFRAMES)?;
        SettingError::unless_in("max_landmarks", self.max_landmarks, 20..=5000)?;
        SettingError::unless_in("keyframe_survival", self.keyframe_survival, 0.0..=1.0)?;
        SettingError::unless_in("keyframe_parallax", self.keyframe_parallax, 0.0..=1.0)?;
        SettingError::unless_in(
            "calibration_sigma_px",
            self.calibration_sigma_px,
            0.0..=10.0,
        )?;
        SettingError::unless_in("flat_sigma_m", self.flat_sigma_m, 1e-5..=1.0)?;
        SettingError::unless_in("flat_sigma_rad", self.flat_sigma_rad, 1e-5..=1.0)?;
        SettingError::unless_in("timestamp_sigma_s", self.timestamp_sigma_s, 0.0..=1.0)?;
        for (key, limit) in [
            ("max_speed_m_s", self.max_speed_m_s),
            ("max_turn_rad_s", self.max_turn_rad_s),
        ] {
            if let Some(limit) = limit {
                SettingError::unless_in(key, limit, 0.001..=1000.0)?;
            }
        }
        SettingError::unless_in("repeats", self.repeats, 0..=64)?;
        SettingError::unless_in("max_bridged", self.max_bridged, 0..=10_000)?;
        SettingError::unless_in("acceleration_m_s2", self.acceleration_m_s2, 1e-6..=1000.0)?;
        SettingError::unless_in(
            "angular_acceleration_rad_s2",
            self.angular_acceleration_rad_s2,
            1e-6..=1000.0,
        )
    }
}
