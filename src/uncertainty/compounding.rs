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

/// The largest σ of a rotation, rad, up to which first order describes a pose: its sine, by which
/// positions ahead are displaced, then has a variance within 4 % of the angle's.
pub const FIRST_ORDER_LIMIT_RAD: f64 = 0.2;

/// Whether first order still holds for a pose's covariance: beyond, errors of position bend into the
/// shape of a banana, which no ellipsoid covers.
#[must_use]
pub fn is_first_order(cov_pose: &Matrix6<f64>) -> bool {
    let rotation = cov_pose.fixed_view::<3, 3>(3, 3).into_owned();
    let largest = rotation.symmetric_eigenvalues().max();
    largest <= FIRST_ORDER_LIMIT_RAD * FIRST_ORDER_LIMIT_RAD
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::uncertainty::consistency::{anees_interval, nees};
    use nalgebra::{SMatrix, Vector6};
    use rand::{RngExt, SeedableRng};
    use rand_distr::StandardNormal;
    use rand_xoshiro::Xoshiro256PlusPlus;

    fn motion() -> Isometry3<f64> {
        se3::exp(&Vector6::new(0.02, -0.01, 0.3, 0.01, -0.05, 0.002))
    }

    /// Noise of each pair that acts on the motion before it (by `q`) and the one after it (by `p`).
    fn shares() -> [Matrix6<f64>; 2] {
        let q = Matrix6::from_fn(|i, j| {
            1e-3 * (f64::from(u8::from(i == j)) + 0.3 * ((i * j) as f64).sin())
        });
        [q, -q * 0.8 + Matrix6::identity() * 2e-4]
    }

    #[test]
    fn correlated_motions_are_covered_against_monte_carlo() {
        const RUNS: usize = 2000;
        const STEPS: usize = 40;
        let [q, p] = shares();
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(5);
        let own = q * q.transpose() + p * p.transpose();
        let cross = q * p.transpose();
        let mut cov = Matrix6::zeros();
        let mut independent = Matrix6::zeros();
        for k in 0..STEPS {
            let shared = if k == 0 { Matrix6::zeros() } else { cross };
            cov = chain_correlated(&cov, &motion(), &own, &shared);
            independent = chain(&independent, &motion(), &own);
        }
        let truth = (0..STEPS).fold(Isometry3::identity(), |pose, _| pose * motion());
        let (mut with, mut without) = (0.0, 0.0);
        for _ in 0..RUNS {
            let mut draw =
                || SMatrix::<f64, 6, 1>::from_fn(|_, _| rng.sample::<f64, _>(StandardNormal));
            let mut before = draw();
            let mut pose = Isometry3::identity();
            for _ in 0..STEPS {
                let now = draw();
                pose *= motion() * se3::exp(&(p * before + q * now));
                before = now;
            }
            let error = se3::log(&(truth.inverse() * pose));
            with += nees(&error, &cov).expect("definite") / (6 * RUNS) as f64;
            without += nees(&error, &independent).expect("definite") / (6 * RUNS) as f64;
        }
        let (low, high) = anees_interval(6, RUNS, 0.997);
        assert!((low..high).contains(&with), "{with} {low} {high}");
        assert!(without < 0.5, "{without}");
    }

    #[test]
    fn the_limit_of_first_order_is_one_of_rotation() {
        let mut cov = Matrix6::identity() * 0.01;
        cov[(0, 0)] = 1e6;
        assert!(is_first_order(&cov));
        cov[(4, 4)] = 0.05;
        assert!(!is_first_order(&cov));
    }
}
