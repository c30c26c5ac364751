//! Planar poses (the thesis' x, y, θ): covariances of motions in, that of the pose out (thesis
//! §3.4, corrected).
//!
//! Two forms of the same: right perturbations, `T · exp(ξ)`, in the robot's own axes; and the errors
//! of x, y and θ themselves, along the fixed axes, as the thesis writes it.

use crate::geometry::se2;
use nalgebra::{Isometry2, Matrix3};

/// The covariance of `pose · motion` (right perturbations), the two errors being independent.
#[must_use]
pub fn chain(
    cov_pose: &Matrix3<f64>,
    prev_from_now: &Isometry2<f64>,
    cov_motion: &Matrix3<f64>,
) -> Matrix3<f64> {
    chain_correlated(cov_pose, prev_from_now, cov_motion, &Matrix3::zeros())
}

/// [`chain`] where the errors are correlated: `cross` is `Cov(δ_pose, δ_motion)`.
#[must_use]
pub fn chain_correlated(
    cov_pose: &Matrix3<f64>,
    prev_from_now: &Isometry2<f64>,
    cov_motion: &Matrix3<f64>,
    cross: &Matrix3<f64>,
) -> Matrix3<f64> {
    let ad = se2::adjoint(&prev_from_now.inverse());
    let shared = ad * cross;
    symmetric(&(ad * cov_pose * ad.transpose() + cov_motion + shared + shared.transpose()))
}

/// The same in fixed axes, thesis 3.34: `Σ ← J₁ Σ J₁ᵀ + J₂ Σ_m J₂ᵀ`, with J₁ the derivative of
/// x + dx cos θ − dy sin θ, y + dx sin θ + dy cos θ, θ + dθ by (x, y, θ) and J₂ that by
/// (dx, dy, dθ); θ is the heading *before* the motion.
#[must_use]
pub fn chain_fixed_axes(
    odom_from_prev: &Isometry2<f64>,
    cov_pose: &Matrix3<f64>,
    prev_from_now: &Isometry2<f64>,
    cov_motion: &Matrix3<f64>,
) -> Matrix3<f64> {
    let (sin, cos) = odom_from_prev.rotation.angle().sin_cos();
    let d = prev_from_now.translation.vector;
    let by_pose = Matrix3::new(
        1.0,
        0.0,
        -d.x * sin - d.y * cos,
        0.0,
        1.0,
        d.x * cos - d.y * sin,
        0.0,
        0.0,
        1.0,
    );
    let by_motion = rotation(odom_from_prev);
    symmetric(
        &(by_pose * cov_pose * by_pose.transpose()
            + by_motion * cov_motion * by_motion.transpose()),
    )
}

/// Turns the covariance of a right perturbation into that of the errors of x, y and θ.
#[must_use]
pub fn fixed_axes_from_right(a_from_b: &Isometry2<f64>, cov: &Matrix3<f64>) -> Matrix3<f64> {
    let turn = rotation(a_from_b);
    symmetric(&(turn * cov * turn.transpose()))
}

fn rotation(a_from_b: &Isometry2<f64>) -> Matrix3<f64> {
    let (sin, cos) = a_from_b.rotation.angle().sin_cos();
    Matrix3::new(cos, -sin, 0.0, sin, cos, 0.0, 0.0, 0.0, 1.0)
}

fn symmetric(m: &Matrix3<f64>) -> Matrix3<f64> {
    (m + m.transpose()) * 0.5
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimation::Plane;
    use crate::geometry::se3;
    use crate::simulation::thesis_rig;
    use crate::uncertainty::{compounding, consistency};
    use nalgebra::Vector3;
    use proptest::prelude::*;
    use rand::{RngExt, SeedableRng};
    use rand_distr::StandardNormal;
    use rand_xoshiro::Xoshiro256PlusPlus;

    fn motion_of(k: usize) -> (Isometry2<f64>, Matrix3<f64>) {
        let k = k as f64;
        let motion = se2::exp(&Vector3::new(
            0.3 + 0.01 * k.sin(),
            0.02 * k.cos(),
            0.1 * (0.3 * k).sin(),
        ));
        let root = Matrix3::new(2e-3, 0.0, 0.0, 5e-4, 1e-3, 0.0, -1e-4, 3e-4, 8e-4)
            * (1.0 + 0.2 * k.sin());
        (motion, root * root.transpose())
    }

    #[test]
    fn both_forms_and_the_lift_to_space_agree_along_a_path() {
        let plane = Plane::of(&thesis_rig());
        let basis = plane.basis();
        let mut pose = Isometry2::identity();
        let (mut right, mut fixed) = (Matrix3::zeros(), Matrix3::zeros());
        let mut space = nalgebra::Matrix6::zeros();
        for k in 0..60 {
            let (motion, cov) = motion_of(k);
            let cov_fixed = fixed_axes_from_right(&motion, &cov);
            fixed = chain_fixed_axes(&pose, &fixed, &motion, &cov_fixed);
            right = chain(&right, &motion, &cov);
            space = compounding::chain(
                &space,
                &plane.lift(&motion),
                &(basis * cov * basis.transpose()),
            );
            pose *= motion;
        }
        let turned = fixed_axes_from_right(&pose, &right);
        assert!((turned - fixed).norm() < 1e-12 * fixed.norm().max(1e-3));
        let reduced = basis.transpose() * space * basis;
        assert!((reduced - right).norm() < 1e-12 * right.norm().max(1e-3));
        assert!((space - basis * right * basis.transpose()).norm() < 1e-15);
        // And the lift of the path is the path of the lifts.
        let lifted = se3::log(&plane.lift(&pose));
        assert!(
            (plane.project(&se3::exp(&lifted)).to_homogeneous() - pose.to_homogeneous()).norm()
                < 1e-12
        );
    }

    #[test]
    fn a_path_is_covered_against_monte_carlo() {
        const RUNS: usize = 2000;
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(9);
        let (mut cov, mut truth) = (Matrix3::zeros(), Isometry2::identity());
        for k in 0..40 {
            let (motion, own) = motion_of(k);
            cov = chain(&cov, &motion, &own);
            truth *= motion;
        }
        let mut anees = 0.0;
        for _ in 0..RUNS {
            let mut pose = Isometry2::identity();
            for k in 0..40 {
                let (motion, own) = motion_of(k);
                let unit = Vector3::from_fn(|_, _| rng.sample::<f64, _>(StandardNormal));
                pose *= motion * se2::exp(&(own.cholesky().expect("definite").l() * unit));
            }
            let error = se2::log(&(truth.inverse() * pose));
            anees += consistency::nees(&error, &cov).expect("definite") / (3 * RUNS) as f64;
        }
        let (low, high) = consistency::anees_interval(3, RUNS, 0.997);
        assert!((low..high).contains(&anees), "{anees} {low} {high}");
    }

    proptest! {
        #[test]
        fn the_thesis_jacobians_match_central_differences(
            a in prop::array::uniform3(-2.0..2.0_f64), b in prop::array::uniform3(-1.0..1.0_f64), j in 0_usize..6
        ) {
            let at = |a: &Vector3<f64>, b: &Vector3<f64>| {
                let pose = Isometry2::new(a.xy(), a.z) * Isometry2::new(b.xy(), b.z);
                Vector3::new(pose.translation.x, pose.translation.y, a.z + b.z)
            };
            let (a, b) = (Vector3::from(a), Vector3::from(b));
            let mut d = nalgebra::Vector6::zeros();
            d[j] = 1e-6;
            let (da, db) = (d.fixed_rows::<3>(0).into_owned(), d.fixed_rows::<3>(3).into_owned());
            let numeric = (at(&(a + da), &(b + db)) - at(&(a - da), &(b - db))) / 2e-6;
            let unit = |i: usize| Matrix3::from_diagonal(&Vector3::ith(i, 1.0));
            let (pose, motion) = (Isometry2::new(a.xy(), a.z), Isometry2::new(b.xy(), b.z));
            let cov = if j < 3 {
                chain_fixed_axes(&pose, &unit(j), &motion, &Matrix3::zeros())
            } else {
                chain_fixed_axes(&pose, &Matrix3::zeros(), &motion, &unit(j - 3))
            };
            prop_assert!((cov - numeric * numeric.transpose()).norm() < 1e-6 * (1.0 + cov.norm()));
        }
    }
}
