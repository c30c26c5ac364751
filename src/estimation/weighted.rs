//! Weighted alignment: two clouds of the same points with their covariances in, the rigid motion
//! between them out, each distance weighted by its own uncertainty (the thesis' future work).
//!
//! Cost: `C = ½ Σ eᵢᵀ Wᵢ eᵢ` with `eᵢ = pᵢ − M⁻¹ p'ᵢ` in the present frame and
//! `Wᵢ = (Σ_pᵢ + Rᵀ Σ_p'ᵢ R)⁻¹`. Depth noise of distant points then hardly counts. What remains is
//! a bias of second order, for a point that noise brought nearer claims to be more certain too: it
//! adds up along a path, so that bundle adjustment is the better choice over many motions.

use super::Landmark;
use super::closed_form::{self, MotionEstimate};
use super::model::Model;
use crate::geometry::{se3, so3};
use crate::uncertainty::propagate;
use nalgebra::{Isometry3, Matrix3, Matrix6, SMatrix, Vector3, Vector6};

/// Times that the weights are brought up to date with the rotation.
const REWEIGHTINGS: usize = 3;
/// Gauss–Newton steps on fixed weights; it converges in three or four.
const MAX_STEPS: usize = 12;

/// The motion with the least weighted distances within `model`, with its covariance by the implicit
/// function theorem. Pairs are (earlier, now).
///
/// `None` below three pairs, or where they do not determine the motion.
#[must_use]
pub fn align(model: &Model, landmarks: &[(Landmark, Landmark)]) -> Option<MotionEstimate> {
    let points = landmarks.iter().map(|(prev, now)| (prev.point, now.point));
    let mut prev_from_now = model.constrain(&closed_form::align(points)?);
    for _ in 0..REWEIGHTINGS {
        let weights = weights(&prev_from_now, landmarks)?;
        prev_from_now = minimise(model, &prev_from_now, landmarks, &weights)?;
    }
    let mut cov_right = Matrix6::zeros();
    let derivative = derivative(model, &prev_from_now, landmarks)?;
    for ((prev, now), (by_prev, by_now)) in landmarks.iter().zip(&derivative) {
        cov_right += propagate(by_prev, &prev.cov_m2) + propagate(by_now, &now.cov_m2);
    }
    Some(MotionEstimate {
        prev_from_now,
        cov_right: se3::symmetric(&cov_right),
    })
}

/// The derivative of the aligned motion (right perturbation) by the earlier and the present point
/// of each pair, at fixed weights: `−H⁻¹ ∂²C/∂ξ∂p`, residuals' own terms included.
pub(super) fn derivative(
    model: &Model,
    prev_from_now: &Isometry3<f64>,
    landmarks: &[(Landmark, Landmark)],
) -> Option<Vec<(SMatrix<f64, 6, 3>, SMatrix<f64, 6, 3>)>> {
    let now_from_prev = prev_from_now.inverse();
    let weights = weights(prev_from_now, landmarks)?;
    let mut hessian = Matrix6::zeros();
    for ((prev, now), weight) in landmarks.iter().zip(&weights) {
        let p = now.point.coords;
        let pull = weight * (p - (now_from_prev * prev.point).coords);
        let jacobian = by_twist(&p);
        hessian += jacobian.transpose() * weight * jacobian;
        // ½ eᵀW(φ × (φ × p)) twice differentiated by φ.
        let curvature = (pull * p.transpose() + p * pull.transpose()) * 0.5
            - Matrix3::identity() * pull.dot(&p);
        let mut turning = hessian.fixed_view_mut::<3, 3>(3, 3);
        turning += curvature;
    }
    let inverse = model.inverse(&hessian)?;
    let rotation = now_from_prev.rotation.to_rotation_matrix();
    let by_points = |((prev, now), weight): (&(Landmark, Landmark), &Matrix3<f64>)| {
        let p = now.point.coords;
        let pull = weight * (p - (now_from_prev * prev.point).coords);
        let mut by_now = by_twist(&p).transpose() * weight;
        let by_prev = by_now * rotation.matrix();
        let mut turning = by_now.fixed_view_mut::<3, 3>(3, 0);
        turning -= so3::hat(&pull);
        (inverse * by_prev, -inverse * by_now)
    };
    Some(landmarks.iter().zip(&weights).map(by_points).collect())
}

/// Inverse covariances of the gaps, in the present frame.
fn weights(
    prev_from_now: &Isometry3<f64>,
    landmarks: &[(Landmark, Landmark)],
) -> Option<Vec<Matrix3<f64>>> {
    let rotation = prev_from_now.rotation.to_rotation_matrix();
    let r = rotation.matrix();
    landmarks
        .iter()
        .map(|(prev, now)| {
            let cov = now.cov_m2 + r.transpose() * prev.cov_m2 * r;
            let weight = cov.cholesky()?.inverse();
            Some((weight + weight.transpose()) * 0.5)
        })
        .collect()
}

/// Gauss–Newton with weights that stay.
fn minimise(
    model: &Model,
    start: &Isometry3<f64>,
    landmarks: &[(Landmark, Landmark)],
    weights: &[Matrix3<f64>],
) -> Option<Isometry3<f64>> {
    let mut prev_from_now = *start;
    for _ in 0..MAX_STEPS {
        let now_from_prev = prev_from_now.inverse();
        let mut info = Matrix6::zeros();
        let mut gradient = Vector6::zeros();
        for ((prev, now), weight) in landmarks.iter().zip(weights) {
            let p = now.point.coords;
            let gap = p - (now_from_prev * prev.point).coords;
            let jacobian = by_twist(&p);
            let weighted = jacobian.transpose() * weight;
            info += weighted * jacobian;
            gradient += weighted * gap;
        }
        let step = -(model.inverse(&info)? * gradient);
        prev_from_now *= se3::exp(&step);
        if step.norm() <= 1e-13 {
            break;
        }
    }
    Some(prev_from_now)
}

/// The derivative of a gap by a right perturbation of the motion: the present point moves as
/// `exp(ξ) p`.
fn by_twist(p: &Vector3<f64>) -> SMatrix<f64, 3, 6> {
    let mut jacobian = SMatrix::<f64, 3, 6>::zeros();
    jacobian
        .fixed_view_mut::<3, 3>(0, 0)
        .copy_from(&Matrix3::identity());
    jacobian
        .fixed_view_mut::<3, 3>(0, 3)
        .copy_from(&-so3::hat(p));
    jacobian
}
