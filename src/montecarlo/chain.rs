//! Two-frame motions chained to a pose, with the correlation that shared pixels give them.

use super::Correlation;
use super::estimator::{FrameEstimate, FrameEstimator, TrackedSight};
use crate::estimation::bundle::TrackedPoint;
use crate::estimation::influence::Influence;
use crate::estimation::track_noise::{self, TrackNoise, TrackNoiseMeter, TrackResidual};
use crate::estimation::two_frame::{Estimator, TwoFrame, TwoFrameMotion};
use crate::estimation::{Model, calibration, inverse_depth};
use crate::geometry::rig_parameters::{RIG_PARAMETERS, RigCovariance};
use crate::geometry::{StereoRig, se3};
use crate::uncertainty::compounding;
use crate::uncertainty::consider::Sensitivity;
use nalgebra::{Isometry3, Matrix6, Vector3, Vector6};

/// The odometry of the thesis with any of its estimators: each motion from two pairs, poses by
/// chaining.
pub struct TwoFrameChain<'a> {
    rig: &'a StereoRig,
    two_frame: TwoFrame,
    correlation: Correlation,
    meter: TrackNoiseMeter,
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

/// The tracks of the last motion, with rising ids.
struct LastMotion {
    tracks: Vec<LastTrack>,
    variance_factor: f64,
}

/// What a track's pixels, in units of their σ, did to the last motion, and what was left of them.
struct LastTrack {
    id: u64,
    influence: Influence,
    residual: Option<TrackResidual>,
}

impl<'a> TwoFrameChain<'a> {
    /// A chain that begins with the next pair.
    #[must_use]
    pub fn new(
        rig: &'a StereoRig,
        estimator: Estimator,
        model: Model,
        gate_sigma2: f64,
        correlation: Correlation,
    ) -> Self {
        Self {
            rig,
            two_frame: TwoFrame::new(estimator, model, gate_sigma2),
            correlation,
            meter: TrackNoiseMeter::new(&TrackNoise::of_detector(1.0)),
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

    /// The tracks of a motion, whitened, with their residuals where these are to be measured.
    fn tracks_of(&self, motion: &TwoFrameMotion) -> LastMotion {
        let measured = self.correlation == Correlation::Measured;
        let tracks = motion.tracks.iter().zip(&motion.influences);
        let prev_from_now = motion.reprojected;
        LastMotion {
            tracks: tracks
                .map(|(&i, influence)| {
                    let point = &self.points[i as usize];
                    let residual = measured
                        .then(|| TrackResidual::new(self.rig, &prev_from_now, point))
                        .flatten();
                    LastTrack {
                        id: self.ids[i as usize],
                        influence: track_noise::whitened(influence, point),
                        residual,
                    }
                })
                .collect(),
            variance_factor: motion.variance_factor,
        }
    }

    /// Covariance of the motion, and `Cov(δm_last, δm)`: from the pixels that both motions used
    /// (theory §4).
    fn covariances(
        &mut self,
        motion: &TwoFrameMotion,
        now: &LastMotion,
    ) -> (Matrix6<f64>, Matrix6<f64>) {
        let plain = motion.estimate.cov_right * motion.variance_factor;
        match self.correlation {
            Correlation::Independent => (plain, Matrix6::zeros()),
            Correlation::Shared => {
                let factor = self.last.as_ref().map_or(1.0, |last| last.variance_factor);
                let factor = (factor * now.variance_factor).sqrt();
                (plain, self.shared(now, &TrackNoise::of_detector(factor)))
            }
            Correlation::Measured => {
                self.meter.age();
                for (before, track) in with_before(self.last.as_ref(), now) {
                    if let Some(residual) = &track.residual {
                        let before = before.and_then(|before| before.residual.as_ref());
                        self.meter.observe(before, residual);
                    }
                }
                let noise = self.meter.noise();
                let own = now
                    .tracks
                    .iter()
                    .map(|t| noise.covariance(&t.influence))
                    .sum();
                (se3::symmetric(&own), self.shared(now, &noise))
            }
        }
    }

    fn shared(&self, now: &LastMotion, noise: &TrackNoise) -> Matrix6<f64> {
        with_before(self.last.as_ref(), now)
            .filter_map(|(before, track)| {
                Some(noise.covariance_with_next(&before?.influence, &track.influence))
            })
            .sum()
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
        let tracks = self.tracks_of(motion);
        let (cov_motion, cross) = self.covariances(motion, &tracks);
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
        self.last = Some(tracks);
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

/// The tracks of a motion, each with what it was in the motion before.
fn with_before<'t>(
    last: Option<&'t LastMotion>,
    now: &'t LastMotion,
) -> impl Iterator<Item = (Option<&'t LastTrack>, &'t LastTrack)> {
    let mut earlier = last.map_or(&[][..], |last| &last.tracks).iter().peekable();
    now.tracks.iter().map(move |track| {
        while earlier.next_if(|other| other.id < track.id).is_some() {}
        (earlier.next_if(|other| other.id == track.id), track)
    })
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
