//! The tracks between two pairs in; the motion by any of the estimators on offer out, with what its
//! error owes to each pixel.

use super::bundle::TrackedPoint;
use super::closed_form::{self, MotionEstimate};
use super::influence::{self, Influence, Triangulated};
use super::model::Model;
use super::reprojection::{Adjusted, Reprojection};
use super::{planar, weighted};
use crate::geometry::StereoRig;
use nalgebra::Isometry3;
use serde::{Deserialize, Serialize};

/// Which estimator of the motion between two pairs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Estimator {
    /// Closed form on triangulated points, as the thesis has it: simple, and coarse.
    Svd,
    /// Triangulated points weighted by their own covariances.
    Weighted,
    /// Reprojection bundle adjustment in the images.
    #[default]
    Bundle,
}

/// A motion with all that its covariance follows from.
#[derive(Clone, Debug)]
pub struct TwoFrameMotion {
    /// The motion, its covariance for a variance factor of 1.
    pub estimate: MotionEstimate,
    /// A-posteriori variance factor of the residuals in the images at `reprojected`.
    pub variance_factor: f64,
    /// The motion that reprojects the tracks best; the estimate itself for the bundle adjustment.
    pub reprojected: Isometry3<f64>,
    /// Indices of the tracks that it rests on, ascending.
    pub tracks: Vec<u32>,
    /// What each of these tracks' pixels do to the motion, in the same order.
    pub influences: Vec<Influence>,
}

/// Rounds of adjusting and judging the residuals again.
const ROUNDS: usize = 3;

/// Estimates motions; keeps its working memory from pair to pair.
#[derive(Debug)]
pub struct TwoFrame {
    estimator: Estimator,
    model: Model,
    /// Largest squared residual of a track that counts, σ².
    gate_sigma2: f64,
    adjuster: Reprojection,
    kept: Vec<TrackedPoint>,
}

impl TwoFrame {
    /// An estimator; tracks whose squared residual (five degrees of freedom) is above
    /// `gate_sigma2`, times the variance factor, do not count.
    #[must_use]
    pub fn new(estimator: Estimator, model: Model, gate_sigma2: f64) -> Self {
        Self {
            estimator,
            model,
            gate_sigma2,
            adjuster: Reprojection::default(),
            kept: Vec::new(),
        }
    }

    /// The motion between two pairs, sought from `guess` on. Points are left at their optimum where
    /// the adjustment kept them.
    ///
    /// Whatever the estimator, tracks are judged and the variance factor is taken in the images at
    /// the *best* motion: residuals at the closed form's own would count its errors as noise, and
    /// so once more.
    ///
    /// `None` if too few tracks agree or the motion is not determined by them.
    pub fn estimate(
        &mut self,
        rig: &StereoRig,
        guess: &Isometry3<f64>,
        points: &[TrackedPoint],
    ) -> Option<TwoFrameMotion> {
        let mut tracks: Vec<u32> = (0..points.len() as u32).collect();
        self.kept.clear();
        self.kept.extend_from_slice(points);
        let adjusted = self.adjust_and_judge(rig, guess, &mut tracks)?;
        let mut influences = Vec::with_capacity(tracks.len());
        let estimate = match self.estimator {
            Estimator::Bundle => {
                influences.extend(self.adjuster.influences(&adjusted.cov_right));
                MotionEstimate {
                    prev_from_now: adjusted.prev_from_now,
                    cov_right: adjusted.cov_right,
                }
            }
            Estimator::Svd | Estimator::Weighted => {
                self.on_triangulated(rig, &mut tracks, &mut influences)?
            }
        };
        Some(TwoFrameMotion {
            estimate,
            variance_factor: adjusted.variance_factor,
            reprojected: adjusted.prev_from_now,
            tracks,
            influences,
        })
    }

    /// The estimators on points, over the tracks whose points have a depth that is certain enough.
    fn on_triangulated(
        &mut self,
        rig: &StereoRig,
        tracks: &mut Vec<u32>,
        influences: &mut Vec<Influence>,
    ) -> Option<MotionEstimate> {
        let points: Vec<_> = self
            .kept
            .iter()
            .map(|p| Triangulated::new(rig, p))
            .collect();
        retain_by(tracks, |i| points[i].is_some());
        retain_by(&mut self.kept, |i| points[i].is_some());
        let points: Vec<Triangulated> = points.into_iter().flatten().collect();
        let model = &self.model;
        let prev_from_now = if self.estimator == Estimator::Svd {
            let pairs = points.iter().map(|t| (t.prev.point, t.now.point));
            let motion = match model {
                Model::Se3 => closed_form::align(pairs)?,
                Model::Planar(plane) => plane.lift(&planar::align(plane, pairs)?),
            };
            influence::of_closed_form(model, &motion, &points, influences)?;
            motion
        } else {
            let pairs: Vec<_> = points.iter().map(|t| (t.prev, t.now)).collect();
            let motion = weighted::align(model, &pairs)?.prev_from_now;
            influence::of_weighted(model, &motion, &points, influences)?;
            motion
        };
        Some(MotionEstimate {
            prev_from_now,
            cov_right: influence::covariance(influences, &self.kept),
        })
    }

    /// Adjusts, drops tracks whose residuals are too large, and adjusts again until none is.
    fn adjust_and_judge(
        &mut self,
        rig: &StereoRig,
        guess: &Isometry3<f64>,
        tracks: &mut Vec<u32>,
    ) -> Option<Adjusted> {
        let mut adjusted = self.adjust(rig, guess)?;
        for _ in 1..ROUNDS {
            let limit = self.gate_sigma2 * adjusted.robust_factor;
            let residuals = self.adjuster.squared_residuals();
            let agrees: Vec<bool> = residuals.map(|squares| squares <= limit).collect();
            if agrees.iter().all(|&yes| yes) {
                break;
            }
            retain_by(tracks, |i| agrees[i]);
            retain_by(&mut self.kept, |i| agrees[i]);
            adjusted = self.adjust(rig, &adjusted.prev_from_now)?;
        }
        Some(adjusted)
    }

    fn adjust(&mut self, rig: &StereoRig, start: &Isometry3<f64>) -> Option<Adjusted> {
        self.adjuster
            .adjust(rig, &self.model, start, &mut self.kept)
    }
}

/// Keeps the elements whose place satisfies `keep`.
fn retain_by<T>(items: &mut Vec<T>, keep: impl Fn(usize) -> bool) {
    let mut place = 0;
    items.retain(|_| {
        place += 1;
        keep(place - 1)
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimation::synthetic::{random, rig, step, tracks};
    use crate::estimation::{MotionModel, inverse_depth};
    use nalgebra::{Point3, Vector2, Vector4, Vector6};
    use rand::RngExt;
    use rand_xoshiro::Xoshiro256PlusPlus;

    /// Tracks of points that need not determine a motion: all far, on a line, on a plane, in one
    /// spot, or anywhere.
    fn any_tracks(kind: usize, rng: &mut Xoshiro256PlusPlus) -> Vec<TrackedPoint> {
        let rig = rig();
        let count = rng.random_range(3..12);
        let (u, v) = (rng.random_range(80.0..560.0), rng.random_range(60.0..420.0));
        let mut found = Vec::new();
        for i in 0..40 {
            if found.len() == count {
                break;
            }
            let at = f64::from(i) / 40.0;
            let (px, z) = match kind {
                0 => (
                    Vector2::new(rng.random_range(0.0..640.0), rng.random_range(0.0..480.0)),
                    rng.random_range(500.0..5000.0),
                ),
                1 => (Vector2::new(u, v), 2.0 + 30.0 * at),
                2 => (
                    Vector2::new(rng.random_range(0.0..640.0), rng.random_range(0.0..480.0)),
                    8.0,
                ),
                3 => (Vector2::new(u + at, v - at), 5.0 + 1e-3 * at),
                _ => (
                    Vector2::new(rng.random_range(0.0..640.0), rng.random_range(0.0..480.0)),
                    rng.random_range(1.0..60.0),
                ),
            };
            let prev = Point3::from(rig.left.ray(&px).expect("inside") * z);
            let mut measure = |p: &Point3<f64>| {
                let noise = Vector4::from_fn(|_, _| rng.random_range(-0.8..0.8));
                Some(crate::estimation::StereoMeasurement {
                    px: rig.project(p)? + noise,
                    sigma_px: Vector4::repeat(0.5),
                })
            };
            let (Some(prev), Some(now)) = (measure(&prev), measure(&(step().inverse() * prev)))
            else {
                continue;
            };
            if let Some(inverse_depth) = inverse_depth(&rig, &prev) {
                found.push(TrackedPoint {
                    prev,
                    now,
                    inverse_depth,
                });
            }
        }
        found
    }

    #[test]
    fn every_covariance_is_one_under_ten_thousand_configurations() {
        let rig = rig();
        let mut rng = random(51);
        let (mut given, mut refused) = (0, 0);
        for i in 0..10_000 {
            let estimator = [Estimator::Bundle, Estimator::Svd, Estimator::Weighted][i % 3];
            let model = [MotionModel::Se3, MotionModel::Planar][(i / 3) % 2].of(&rig);
            let points = any_tracks((i / 6) % 5, &mut rng);
            match TwoFrame::new(estimator, model, 1e6).estimate(&rig, &step(), &points) {
                Some(found) => {
                    given += 1;
                    let nees = model.nees(&Vector6::repeat(1e-3), &found.estimate.cov_right);
                    assert!(
                        nees.is_some(),
                        "{i} {estimator:?} {}",
                        found.estimate.cov_right
                    );
                }
                None => refused += 1,
            }
        }
        assert!(
            given > 2000 && refused > 500,
            "{given} given, {refused} refused"
        );
    }

    #[test]
    fn outliers_do_not_count() {
        let rig = rig();
        let mut points = tracks(&rig, &step(), 60, [2.0, 40.0], 0.5, &mut random(52));
        for i in [5, 17, 40] {
            points[i].now.px[0] += 30.0;
            points[i].now.px[2] += 30.0;
        }
        for estimator in [Estimator::Bundle, Estimator::Svd, Estimator::Weighted] {
            let found = TwoFrame::new(estimator, Model::Se3, 20.0)
                .estimate(&rig, &step(), &points)
                .expect("determined");
            assert!(
                [5, 17, 40].iter().all(|i| !found.tracks.contains(i)),
                "{estimator:?}"
            );
            // Distant points have no certain depth, and only the adjustment can use them.
            let least = if estimator == Estimator::Bundle {
                54
            } else {
                20
            };
            assert!(
                found.tracks.len() >= least,
                "{estimator:?} {}",
                found.tracks.len()
            );
            assert_eq!(found.tracks.len(), found.influences.len());
            assert!(
                (0.6..1.5).contains(&found.variance_factor),
                "{}",
                found.variance_factor
            );
        }
    }
}
