//! Two-frame motions chained to a pose, with the correlation that shared pixels give them.

use super::estimator::{FrameEstimate, FrameEstimator, TrackedSight};
use crate::estimation::bundle::TrackedPoint;
use crate::estimation::influence::Influence;
use crate::estimation::two_frame::{Estimator, TwoFrame, TwoFrameMotion};
use crate::estimation::{Model, calibration, inverse_depth};
use crate::geometry::StereoRig;
use crate::geometry::rig_parameters::{RIG_PARAMETERS, RigCovariance};
use crate::uncertainty::compounding;
use crate::uncertainty::consider::Sensitivity;
use nalgebra::{Isometry3, Matrix6, Vector3, Vector4, Vector6};

/// The odometry of the thesis with any of its estimators: each motion from two pairs, poses by
/// chaining.
pub struct TwoFrameChain<'a> {
    rig: &'a StereoRig,
    two_frame: TwoFrame,
    cross_terms: bool,
    considered: Option<Box<RigCovariance>>,
    before: Vec<(TrackedSight, Option<Vector3<f64>>)>,
    place: Option<Place>,
    last: Option<LastMotion>,
    ids: Vec<u64>,
    points: Vec<TrackedPoint>,
}

/// Where the chain has come to.
#[derive(Clone, Copy)]
struct Place {
    prev_from_now: Isometry3<f64>,
    odom_from_camera: Isometry3<f64>,
    /// Covariance of the pose from the pixels' noise alone.
    measurement: Matrix6<f64>,
    by_rig: Sensitivity<RIG_PARAMETERS>,
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
            considered: None,
            before: Vec::new(),
            place: None,
            last: None,
            ids: Vec::new(),
            points: Vec::new(),
        }
    }

    /// The same chain, its covariances accounting for an uncertain rig (theory §5).
    #[must_use]
    pub fn considering(mut self, covariance: RigCovariance) -> Self {
        self.considered = Some(Box::new(covariance));
        self
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

    /// The derivative of a motion by the rig's parameters, where the rig is uncertain at all.
    fn by_rig(&self, motion: &TwoFrameMotion) -> Option<Sensitivity<RIG_PARAMETERS>> {
        if self.considered.is_none() {
            return Some(Sensitivity::default());
        }
        let tracks = motion.tracks.iter().map(|&i| &self.points[i as usize]);
        let at_rest = Vector6::zeros();
        let sensitivity = calibration::of_motion(
            self.rig,
            &motion.estimate.prev_from_now,
            tracks.zip(&motion.influences),
            &at_rest,
            &at_rest,
        )?;
        Some(sensitivity.by_rig)
    }

    fn advance(&mut self, place: &Place, motion: &TwoFrameMotion) -> Option<FrameEstimate> {
        let prev_from_now = motion.estimate.prev_from_now;
        let cov_motion = motion.estimate.cov_right * motion.variance_factor;
        let cross = self.covariance_with_last(motion);
        let mut odom_from_camera = place.odom_from_camera * prev_from_now;
        odom_from_camera.rotation.renormalize();
        let by_rig = self.by_rig(motion)?;
        let next = Place {
            prev_from_now,
            odom_from_camera,
            measurement: compounding::chain_correlated(
                &place.measurement,
                &prev_from_now,
                &cov_motion,
                &cross,
            ),
            by_rig: place.by_rig.chain(&prev_from_now, &by_rig),
        };
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
        self.place = Some(next);
        let calibration = |by: &Sensitivity<RIG_PARAMETERS>| {
            let considered = self.considered.as_ref();
            considered.map_or_else(Matrix6::zeros, |covariance| by.covariance(covariance))
        };
        Some(FrameEstimate {
            prev_from_now,
            cov_motion: cov_motion + calibration(&by_rig),
            odom_from_camera,
            cov_pose: next.measurement + calibration(&next.by_rig),
        })
    }

    /// The first pair: the origin.
    fn begin(&mut self) -> FrameEstimate {
        let identity = Isometry3::identity();
        self.place = Some(Place {
            prev_from_now: identity,
            odom_from_camera: identity,
            measurement: Matrix6::zeros(),
            by_rig: Sensitivity::default(),
        });
        FrameEstimate {
            prev_from_now: identity,
            cov_motion: Matrix6::zeros(),
            odom_from_camera: identity,
            cov_pose: Matrix6::zeros(),
        }
    }
}

impl FrameEstimator for TwoFrameChain<'_> {
    fn observe(&mut self, sights: &[TrackedSight]) -> Option<FrameEstimate> {
        let estimate = match self.place {
            None => self.begin(),
            Some(place) => {
                self.find_tracks(sights);
                // A robot goes on as it did.
                let guess = place.prev_from_now;
                let motion = self.two_frame.estimate(self.rig, &guess, &self.points)?;
                self.advance(&place, &motion)?
            }
        };
        self.before.clear();
        self.before.extend(
            sights
                .iter()
                .map(|sight| (*sight, inverse_depth(self.rig, &sight.measurement))),
        );
        Some(estimate)
    }
}
