//! Tracks and the motion estimated from them in; how much each pixel moved that estimate out.
//!
//! To first order the error of an estimated motion (right perturbation) is
//! `δm = Σ Pᵢ δzᵢ(before) + Qᵢ δzᵢ(now)` over its tracks (theory §4). From `P` and `Q` follow the
//! motion's covariance, its correlation with the motions before and after, which share pixels with
//! it, and what an error of the rig's calibration or of its synchronisation does to it, for that is
//! a common displacement of pixels. Those of the bundle adjustment come from
//! [`Reprojection`](super::reprojection::Reprojection).

use super::bundle::TrackedPoint;
use super::model::Model;
use super::{Landmark, closed_form, weighted};
use crate::geometry::product::product_transposed;
use crate::geometry::{StereoRig, se3};
use nalgebra::{Isometry3, Matrix3x4, Matrix4, Matrix6, Matrix6x4, Vector4};

/// By how much a motion moves with the pixels of one of its tracks: m/px, rad/px.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Influence {
    /// With (ul, vl, ur, vr) of the earlier pair: `P`.
    pub by_prev: Matrix6x4<f64>,
    /// With those of this pair: `Q`.
    pub by_now: Matrix6x4<f64>,
    /// The robust weight that each coordinate of the earlier pair had, 1 for all but outliers: one
    /// of weight w counts as a measurement of variance σ² / w.
    pub weight_prev: Vector4<f64>,
    /// That of this pair.
    pub weight_now: Vector4<f64>,
}

impl Influence {
    /// The same by pixels in units of their σ.
    #[must_use]
    pub fn whitened(&self, point: &TrackedPoint) -> Self {
        let mut scaled = *self;
        for i in 0..4 {
            let prev = point.prev.sigma_px[i] / self.weight_prev[i].sqrt();
            let now = point.now.sigma_px[i] / self.weight_now[i].sqrt();
            scaled.by_prev.column_mut(i).scale_mut(prev);
            scaled.by_now.column_mut(i).scale_mut(now);
        }
        scaled
    }

    /// What the noise of one track contributes to the motion's covariance, the two pairs' being
    /// independent.
    #[must_use]
    pub fn covariance(&self, point: &TrackedPoint) -> Matrix6<f64> {
        let by = self.whitened(point);
        product_transposed(&by.by_prev, &by.by_prev) + product_transposed(&by.by_now, &by.by_now)
    }
}

/// Both triangulated points of a track with their derivatives by their pixels, where depth is
/// certain enough for first order.
#[derive(Clone, Copy, Debug)]
pub struct Triangulated {
    /// The point in the earlier left camera.
    pub prev: Landmark,
    /// The point in the left camera now.
    pub now: Landmark,
    prev_by_px: Matrix3x4<f64>,
    now_by_px: Matrix3x4<f64>,
}

impl Triangulated {
    /// Triangulates both views of a track. `None` where sights do not meet, or depth is so
    /// uncertain that its error is not Gaussian.
    #[must_use]
    pub fn new(rig: &StereoRig, p: &TrackedPoint) -> Option<Self> {
        let (prev, now) = (
            super::triangulate(rig, &p.prev)?,
            super::triangulate(rig, &p.now)?,
        );
        if !(prev.is_first_order() && now.is_first_order()) {
            return None;
        }
        let by_px = |landmark: &Landmark, sigma_px: &Vector4<f64>| {
            let (_, jacobian) = rig.project_with_jacobian(&landmark.point)?;
            let info = Matrix4::from_diagonal(&sigma_px.map(|s| 1.0 / (s * s)));
            Some(landmark.cov_m2 * jacobian.transpose() * info)
        };
        Some(Self {
            prev_by_px: by_px(&prev, &p.prev.sigma_px)?,
            now_by_px: by_px(&now, &p.now.sigma_px)?,
            prev,
            now,
        })
    }
}

/// The influences on the closed form (thesis 3.29, carried on to the pixels), one a track, in order, into `out`.
///
/// `None` where the motion is not determined.
pub fn of_closed_form(
    model: &Model,
    prev_from_now: &Isometry3<f64>,
    tracks: &[Triangulated],
    out: &mut Vec<Influence>,
) -> Option<()> {
    let now_from_prev = prev_from_now.inverse();
    let carried = |t: &Triangulated| (now_from_prev * t.prev.point).coords;
    let hessian: Matrix6<f64> = tracks
        .iter()
        .map(|t| closed_form::hessian_of_point(&t.now.point.coords, &carried(t)))
        .sum();
    let inverse = model.inverse(&hessian)?;
    let rotation = now_from_prev.rotation.to_rotation_matrix();
    out.clear();
    out.extend(tracks.iter().map(|t| {
        let by_now = closed_form::mixed_by_now(&carried(t));
        let by_prev = closed_form::mixed_by_prev(&t.now.point.coords, rotation.matrix());
        Influence {
            by_prev: -inverse * by_prev * t.prev_by_px,
            by_now: -inverse * by_now * t.now_by_px,
            weight_prev: Vector4::repeat(1.0),
            weight_now: Vector4::repeat(1.0),
        }
    }));
    Some(())
}

/// The influences on the weighted alignment, one a track, in order, into `out`.
///
/// `None` where the motion is not determined.
pub fn of_weighted(
    model: &Model,
    prev_from_now: &Isometry3<f64>,
    tracks: &[Triangulated],
    out: &mut Vec<Influence>,
) -> Option<()> {
    let pairs: Vec<(Landmark, Landmark)> = tracks.iter().map(|t| (t.prev, t.now)).collect();
    let derivative = weighted::derivative(model, prev_from_now, &pairs)?;
    out.clear();
    out.extend(
        tracks
            .iter()
            .zip(&derivative)
            .map(|(t, (by_prev, by_now))| Influence {
                by_prev: by_prev * t.prev_by_px,
                by_now: by_now * t.now_by_px,
                weight_prev: Vector4::repeat(1.0),
                weight_now: Vector4::repeat(1.0),
            }),
    );
    Some(())
}

/// The motion's covariance, summed over its tracks.
#[must_use]
pub fn covariance(influences: &[Influence], points: &[TrackedPoint]) -> Matrix6<f64> {
    let sum = influences
        .iter()
        .zip(points)
        .map(|(influence, p)| influence.covariance(p))
        .sum();
    se3::symmetric(&sum)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimation::synthetic::{random, rig, tracks};
    use crate::estimation::two_frame::{Estimator, TwoFrame};
    use crate::estimation::{MotionModel, Plane};
    use nalgebra::{Isometry2, Vector2, Vector6};

    const ESTIMATORS: [Estimator; 3] = [Estimator::Svd, Estimator::Weighted, Estimator::Bundle];

    /// A motion in the plane serves both models.
    fn planar_step(rig: &StereoRig) -> Isometry3<f64> {
        Plane::of(rig).lift(&Isometry2::new(Vector2::new(0.3, -0.04), 0.05))
    }

    #[test]
    fn influences_are_the_derivatives_of_the_estimate() {
        let rig = rig();
        let truth = planar_step(&rig);
        let points = tracks(&rig, &truth, 12, [2.0, 8.0], 0.0, &mut random(21));
        for model in [MotionModel::Se3, MotionModel::Planar] {
            for estimator in ESTIMATORS {
                let mut two_frame = TwoFrame::new(estimator, model.of(&rig), 1e6);
                let mut solve = |points: &[TrackedPoint]| {
                    two_frame
                        .estimate(&rig, &truth, points)
                        .expect("determined")
                };
                let base = solve(&points);
                assert_eq!(base.tracks.len(), points.len());
                for (i, influence) in base.influences.iter().enumerate().step_by(4) {
                    for j in 0..8 {
                        let step = 1e-2;
                        let mut numeric = Vector6::zeros();
                        for sign in [1.0, -1.0] {
                            let mut moved = points.clone();
                            let m = if j < 4 {
                                &mut moved[i].prev
                            } else {
                                &mut moved[i].now
                            };
                            m.px[j % 4] += sign * step;
                            let found = solve(&moved).estimate.prev_from_now;
                            let change = base.estimate.prev_from_now.inverse() * found;
                            numeric += se3::log(&change) * (sign / (2.0 * step));
                        }
                        let by = if j < 4 {
                            &influence.by_prev
                        } else {
                            &influence.by_now
                        };
                        let exact = by.column(j % 4);
                        // Central differences leave the third order: (1e-2 px)² of some 1e-2.
                        let scale = influence.by_now.norm();
                        assert!(
                            (numeric - exact).norm() < 1e-5 * scale,
                            "{estimator:?} {model:?} {i} {j} {numeric} {exact}"
                        );
                    }
                }
            }
        }
    }

    #[test]
    fn the_covariance_is_the_sum_over_the_pixels() {
        let rig = rig();
        let truth = planar_step(&rig);
        let points = tracks(&rig, &truth, 40, [2.0, 30.0], 0.0, &mut random(22));
        for model in [MotionModel::Se3, MotionModel::Planar] {
            let mut two_frame = TwoFrame::new(Estimator::Bundle, model.of(&rig), 1e6);
            let found = two_frame
                .estimate(&rig, &truth, &points)
                .expect("determined");
            let summed = covariance(&found.influences, &points);
            let stated = found.estimate.cov_right;
            // For the most likely motion, (JᵀWJ)⁻¹ and J⁺ Σ J⁺ᵀ are the same.
            assert!((summed - stated).norm() < 1e-9 * stated.norm());
        }
    }
}
