//! From motions to the pose: the covariance of a chain of motions (thesis §3.4).

use crate::geometry::se3;
use nalgebra::{Isometry3, Matrix6};

/// The covariance of `pose · motion` from those of the pose and of the motion, all of right
/// perturbations (`T · Exp(ξ)`), to first order, the two errors being independent:
/// `A Σ Aᵀ + Σ_m` with `A = Ad(motion⁻¹)`.
#[must_use]
pub fn chain(
    cov_pose: &Matrix6<f64>,
    prev_from_now: &Isometry3<f64>,
    cov_motion: &Matrix6<f64>,
) -> Matrix6<f64> {
    se3::symmetric(&(carry(cov_pose, prev_from_now) + cov_motion))
}

/// The part of [`chain`] that the earlier pose brings: `A Σ Aᵀ`.
#[must_use]
pub fn carry(cov_pose: &Matrix6<f64>, prev_from_now: &Isometry3<f64>) -> Matrix6<f64> {
    let ad = se3::adjoint(&prev_from_now.inverse());
    se3::symmetric(&(ad * cov_pose * ad.transpose()))
}

/// [`chain`] where the motion's error is correlated with the pose's: `A Σ Aᵀ + Σ_m + A X + Xᵀ Aᵀ`
/// with `cross` = X = `Cov(δ_pose, δ_motion)`.
///
/// Consecutive motions share the pixels of the pair between them, once as the present view and once
/// as the previous one: then X is negative where it counts, and without it the pose's covariance is
/// several times too large.
#[must_use]
pub fn chain_correlated(
    cov_pose: &Matrix6<f64>,
    prev_from_now: &Isometry3<f64>,
    cov_motion: &Matrix6<f64>,
    cross: &Matrix6<f64>,
) -> Matrix6<f64> {
    let shared = se3::adjoint(&prev_from_now.inverse()) * cross;
    chain(cov_pose, prev_from_now, cov_motion) + shared + shared.transpose()
}
