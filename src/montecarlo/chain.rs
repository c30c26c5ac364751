//! Two-frame motions chained to a pose, with the correlation that shared pixels give them.

use super::estimator::{FrameEstimate, FrameEstimator, TrackedSight};
use crate::estimation::bundle::TrackedPoint;
use crate::estimation::influence::Influence;
use crate::estimation::two_frame::{Estimator, TwoFrame, TwoFrameMotion};
use crate::estimation::{Model, inverse_depth};
use crate::geometry::StereoRig;
use crate::uncertainty::compounding;
use nalgebra::{Isometry3, Matrix6, Vector3, Vector4};

/// The odometry of the thesis with any of its estimators: each motion from two pairs, poses by
/// chaining.
pub struct TwoFrameChain<'a> {
    rig: &'a StereoRig,
    two_frame: TwoFrame,
    cross_terms: bool,
    before: Vec<(TrackedSight, Option<Vector3<f64>>)>,
    place: Option<FrameEstimate>,
    last: Option<LastMotion>,
    ids: Vec<u64>,
    points: Vec<TrackedPoint>,
}

/// What the last motion owes to the pixels of its present view.
struct LastMotion {
    /// Rising ids with their influence and the σ of the pixels.
    tracks: Vec<(u64, Influence, Vector4<f64>)>,
    variance_factor: f64,
}

impl<'a> TwoFrameChain<'a> {
    /// A chain that begins with the next pair. Without `cross_terms`, motions are taken as
    /// independent of each other, as the thesis does.
    #[must_use]
    pub fn new(
        rig: &'a StereoRig,
        estimator: Estimator,
        model: Model,
        gate_sigma2: f64,
        cross_terms: bool,
    ) -> Self {
        Self {
            rig,
            two_frame: TwoFrame::new(estimator, model, gate_sigma2),
            cross_terms,
            before: Vec::new(),
            place: None,
            last: None,
            ids: Vec::new(),
            points: Vec::new(),
        }
    }

    /// Tracks from the pair before to this one.
    fn find_tracks(&mut self, sights: &[TrackedSight]) {
        self.ids.clear();
        self.points.clear();
        let mut before = self.before.iter().peekable();
        for now in sights {
            while before.next_if(|(sight, _)| sight.id < now.id).is_some() {}
            let Some((prev, y)) = before.next_if(|(sight, _)| sight.id == now.id) else {
                continue;
            };
            if let Some(inverse_depth) = *y {
                self.ids.push(now.id);
                self.points.push(TrackedPoint {
                    prev: prev.measurement,
                    now: now.measurement,
                    inverse_depth,
                });
            }
        }
    }

    /// `Cov(δm_last, δm)`: from the pixels that both motions used (theory §4).
    fn covariance_with_last(&self, motion: &TwoFrameMotion) -> Matrix6<f64> {
        let Some(last) = self.last.as_ref().filter(|_| self.cross_terms) else {
            return Matrix6::zeros();
        };
        let mut cross = Matrix6::zeros();
        let mut earlier = last.tracks.iter().peekable();
        for (track, influence) in motion.tracks.iter().zip(&motion.influences) {
            let id = self.ids[*track as usize];
            while earlier.next_if(|(other, ..)| *other < id).is_some() {}
            if let Some((_, before, sigma_px)) = earlier.next_if(|(other, ..)| *other == id) {
                cross += before.covariance_with_next(sigma_px, influence);
            }
        }
        cross * (last.variance_factor * motion.variance_factor).sqrt()
    }

    fn advance(&mut self, place: &FrameEstimate, motion: &TwoFrameMotion) -> FrameEstimate {
        let prev_from_now = motion.estimate.prev_from_now;
        let cov_motion = motion.estimate.cov_right * motion.variance_factor;
        let cross = self.covariance_with_last(motion);
        let mut odom_from_camera = place.odom_from_camera * prev_from_now;
        odom_from_camera.rotation.renormalize();
        let tracks = motion.tracks.iter().zip(&motion.influences);
        self.last = Some(LastMotion {
            tracks: tracks
                .map(|(&i, influence)| {
                    let i = i as usize;
                    (self.ids[i], *influence, self.points[i].now.sigma_px)
                })
                .collect(),
            variance_factor: motion.variance_factor,
        });
        FrameEstimate {
            prev_from_now,
            cov_motion,
            odom_from_camera,
            cov_pose: compounding::chain_correlated(
                &place.cov_pose,
                &prev_from_now,
                &cov_motion,
                &cross,
            ),
        }
    }
}

impl FrameEstimator for TwoFrameChain<'_> {
    fn observe(&mut self, sights: &[TrackedSight]) -> Option<FrameEstimate> {
        let estimate = match self.place {
            None => FrameEstimate {
                prev_from_now: Isometry3::identity(),
                cov_motion: Matrix6::zeros(),
                odom_from_camera: Isometry3::identity(),
                cov_pose: Matrix6::zeros(),
            },
            Some(place) => {
                self.find_tracks(sights);
                // A robot goes on as it did.
                let guess = place.prev_from_now;
                let motion = self.two_frame.estimate(self.rig, &guess, &self.points)?;
                self.advance(&place, &motion)
            }
        };
        self.before.clear();
        self.before.extend(
            sights
                .iter()
                .map(|sight| (*sight, inverse_depth(self.rig, &sight.measurement))),
        );
        self.place = Some(estimate);
        Some(estimate)
    }
}
