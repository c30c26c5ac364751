//! Odometry of the left camera in, odometry of the robot's base out.
//!
//! With `X = base_from_camera` every transform `T` of the camera becomes `X T X⁻¹`: the odometry
//! frame is then the base's own frame at the start, as REP-105 wants it, and no longer the camera's.

use crate::estimation::{ErrorBudget, Odometry};
use crate::geometry::{se3, so3};
use nalgebra::{Isometry3, Matrix3, Matrix6};

/// The same estimate for the robot's base instead of the camera.
///
/// Covariances are carried over to first order; see [`fixed_axes_jacobian`].
#[must_use]
pub fn in_base_frame(camera: &Odometry, base_from_camera: &Isometry3<f64>) -> Odometry {
    let conjugate = |t: &Isometry3<f64>| base_from_camera * t * base_from_camera.inverse();
    let odom_from_base = conjugate(&camera.odom_from_camera);
    let prev_from_now = conjugate(&camera.prev_from_now);
    let by_pose = fixed_axes_jacobian(&odom_from_base, base_from_camera);
    let by_motion = fixed_axes_jacobian(&prev_from_now, base_from_camera);
    let by_twist = se3::adjoint(base_from_camera);
    Odometry {
        odom_from_camera: odom_from_base,
        cov_pose: carry(&by_pose, &camera.cov_pose),
        prev_from_now,
        cov_motion: carry(&by_motion, &camera.cov_motion),
        twist: by_twist * camera.twist,
        cov_twist: carry(&by_twist, &camera.cov_twist),
        budget: ErrorBudget {
            detection: carry(&by_pose, &camera.budget.detection),
            calibration: carry(&by_pose, &camera.budget.calibration),
            synchronisation: carry(&by_pose, &camera.budget.synchronisation),
            bridging: carry(&by_pose, &camera.budget.bridging),
        },
        ..camera.clone()
    }
}

/// Derivative of the fixed-axes error of `T' = X T X⁻¹` by that of `T`, at `T'`.
///
/// With `R' = Rx R Rxᵀ` and `t' = Rx t + tx − R' tx`: an error φ of R turns R' by φ' = Rx φ, and so
/// moves t' by `Rx δt − φ' × R' tx`, which is `Rx δt + hat(R' tx) Rx φ`.
#[must_use]
pub fn fixed_axes_jacobian(
    conjugated: &Isometry3<f64>,
    base_from_camera: &Isometry3<f64>,
) -> Matrix6<f64> {
    let rotation = base_from_camera.rotation.to_rotation_matrix();
    let rx: &Matrix3<f64> = rotation.matrix();
    let lever = conjugated.rotation * base_from_camera.translation.vector;
    let mut jacobian = Matrix6::zeros();
    jacobian.fixed_view_mut::<3, 3>(0, 0).copy_from(rx);
    jacobian.fixed_view_mut::<3, 3>(3, 3).copy_from(rx);
    jacobian
        .fixed_view_mut::<3, 3>(0, 3)
        .copy_from(&(so3::hat(&lever) * rx));
    jacobian
}

fn carry(jacobian: &Matrix6<f64>, cov: &Matrix6<f64>) -> Matrix6<f64> {
    se3::symmetric(&(jacobian * cov * jacobian.transpose()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::output::row::tests::any_odometry;
    use nalgebra::{Translation3, UnitQuaternion, Vector3, Vector6};
    use proptest::prelude::*;
    use rand::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};
    use rand_xoshiro::Xoshiro256PlusPlus;

    /// A camera that looks forward from the front left of a robot.
    fn mounting() -> Isometry3<f64> {
        Isometry3::from_parts(
            Translation3::new(0.4, 0.19, 0.8),
            UnitQuaternion::from_euler_angles(-1.57, 0.1, -1.5),
        )
    }

    /// The error whose fixed-axes vector is `e`, applied to `truth`.
    fn disturbed(truth: &Isometry3<f64>, e: &Vector6<f64>) -> Isometry3<f64> {
        Isometry3::from_parts(
            Translation3::from(truth.translation.vector + se3::translation_of(e)),
            so3::exp(&se3::rotation_of(e)) * truth.rotation,
        )
    }

    proptest! {
        #[test]
        fn jacobian_is_the_derivative_of_the_conjugation(odometry in any_odometry()) {
            let x = mounting();
            let t = odometry.odom_from_camera;
            let conjugated = x * t * x.inverse();
            let step = 1e-6;
            let mut numeric = Matrix6::zeros();
            for j in 0..6 {
                let mut e = Vector6::zeros();
                e[j] = step;
                let error = |e: Vector6<f64>| {
                    se3::error_fixed_axes(&(x * disturbed(&t, &e) * x.inverse()), &conjugated)
                };
                numeric.set_column(j, &((error(e) - error(-e)) / (2.0 * step)));
            }
            let analytic = fixed_axes_jacobian(&conjugated, &x);
            prop_assert!((numeric - analytic).norm() < 1e-7, "{numeric} {analytic}");
        }

        #[test]
        fn twist_of_the_base_moves_the_base_as_the_camera_moves(odometry in any_odometry()) {
            let x = mounting();
            let base = in_base_frame(&odometry, &x);
            let dt = 0.03;
            let camera_moves = odometry.odom_from_camera * se3::exp(&(odometry.twist * dt));
            let base_moves = base.odom_from_camera * se3::exp(&(base.twist * dt));
            let expected = x * camera_moves * x.inverse();
            let error = base_moves.to_matrix() - expected.to_matrix();
            prop_assert!(error.norm() < 1e-9 * (1.0 + expected.translation.vector.norm()));
        }
    }

    /// 20 000 sampled poses, carried over one by one, have the covariance that was carried over.
    #[test]
    fn carried_covariance_is_that_of_carried_samples() {
        let samples = 20_000_u32;
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(20_260_101);
        let x = mounting();
        let truth = Isometry3::new(Vector3::new(3.0, -1.0, 12.0), Vector3::new(0.3, -0.7, 0.2));
        let sigmas = Vector6::new(0.02, 0.01, 0.03, 0.004, 0.006, 0.002);
        let mut factor = Matrix6::from_diagonal(&sigmas);
        factor[(4, 0)] = 0.003;
        factor[(2, 1)] = -0.008;
        let cov_camera = factor * factor.transpose();
        let conjugated = x * truth * x.inverse();
        let expected = carry(&fixed_axes_jacobian(&conjugated, &x), &cov_camera);
        let whiten = expected.cholesky().unwrap().l().try_inverse().unwrap();

        let mut sum_whitened = Matrix6::zeros();
        for _ in 0..samples {
            let z = Vector6::from_fn(|_, _| StandardNormal.sample(&mut rng));
            let sample = x * disturbed(&truth, &(factor * z)) * x.inverse();
            let w = whiten * se3::error_fixed_axes(&sample, &conjugated);
            sum_whitened += w * w.transpose();
        }
        // Whitened, the sample covariance is the identity; its entries scatter by √(2/n) on the
        // diagonal and √(1/n) beside it. Five of those for 21 entries: a false alarm in 80 000.
        let n = f64::from(samples);
        let error = sum_whitened / n - Matrix6::identity();
        for i in 0..6 {
            for j in 0..6 {
                let sigma = (if i == j { 2.0 / n } else { 1.0 / n }).sqrt();
                assert!(error[(i, j)].abs() < 5.0 * sigma, "{i} {j} {error}");
            }
        }
    }

    #[test]
    fn no_mounting_offset_leaves_the_numbers_alone() {
        let odometry = crate::output::row::tests::sample_odometry(3);
        let same = in_base_frame(&odometry, &Isometry3::identity());
        assert!((same.cov_pose - odometry.cov_pose).norm() < 1e-15);
        assert!((same.twist - odometry.twist).norm() < 1e-15);
    }
}
