//! The window of keyframes as an estimator of tracked points: every pair is a keyframe.

use super::estimator::{FrameEstimate, FrameEstimator, TrackedSight};
use crate::estimation::Settings;
use crate::estimation::sources::{BySources, RigErrors};
use crate::estimation::window::{Seen, Window};
use crate::geometry::StereoRig;
use nalgebra::{Isometry3, Matrix6, Vector2};

/// The estimator that the pipeline runs, on points instead of images.
pub struct WindowOdometry {
    window: Window,
    errors: RigErrors,
    pairs: u64,
    predicted: Isometry3<f64>,
    known: Vec<Seen>,
    weights: Vec<f64>,
    inliers: Vec<u32>,
    agreed: Vec<Seen>,
    new: Vec<Seen>,
}

/// The first pair is the origin; its covariance only has to be positive definite.
const ORIGIN_VARIANCE: f64 = 1e-16;

impl WindowOdometry {
    /// An odometry that begins with the next pair.
    #[must_use]
    pub fn new(rig: &StereoRig, settings: &Settings) -> Self {
        Self {
            window: Window::new(rig.clone(), settings.clone()),
            errors: RigErrors::of(rig, settings),
            pairs: 0,
            predicted: Isometry3::identity(),
            known: Vec::new(),
            weights: Vec::new(),
            inliers: Vec::new(),
            agreed: Vec::new(),
            new: Vec::new(),
        }
    }
}

impl FrameEstimator for WindowOdometry {
    fn observe(&mut self, sights: &[TrackedSight]) -> Option<FrameEstimate> {
        self.known.clear();
        self.new.clear();
        for s in sights {
            let seen = Seen {
                id: s.id,
                measurement: s.measurement,
                relief_px: Vector2::zeros(),
            };
            match self.window.landmark(s.id) {
                Some(_) => self.known.push(seen),
                None => self.new.push(seen),
            }
        }
        self.pairs += 1;
        if self.pairs == 1 {
            let cov = Matrix6::identity() * ORIGIN_VARIANCE;
            self.window
                .begin_at(&Isometry3::identity(), &cov, &BySources::zeros());
            self.window.promote(&self.new);
            return Some(FrameEstimate {
                prev_from_now: Isometry3::identity(),
                cov_motion: cov,
                odom_from_camera: Isometry3::identity(),
                cov_pose: cov,
            });
        }
        self.weights.clear();
        self.weights.resize(self.known.len(), 1.0);
        let newest_from_now = self.window.consent(
            &self.known,
            &self.weights,
            &self.predicted,
            self.pairs,
            &mut self.inliers,
        )?;
        self.agreed.clear();
        let agreed = self.inliers.iter().map(|&i| self.known[i as usize]);
        self.agreed.extend(agreed);
        self.window.add(&newest_from_now, &self.agreed);
        let tracked = self.window.adjust(1.0)?;
        self.window.settle();
        self.window.promote(&self.new);
        self.predicted = tracked.motion.prev_from_now;
        let total = |cov: &Matrix6<f64>, by: &BySources| self.errors.apart(cov, by).total();
        Some(FrameEstimate {
            prev_from_now: tracked.motion.prev_from_now,
            cov_motion: total(&tracked.motion.cov_right, &tracked.motion_by_sources),
            odom_from_camera: tracked.odom_from_now,
            cov_pose: total(&tracked.cov_pose_right, &tracked.pose_by_sources),
        })
    }
}
