//! Rigid motions: exponential, logarithm and adjoint, with twists ordered translation, rotation.
//!
//! Formulas as in Barfoot, *State Estimation for Robotics*, chapter 7.

use super::so3;
use nalgebra::{Isometry3, Matrix3, Matrix6, Translation3, Vector3, Vector6};

/// The translation part of a twist.
#[must_use]
pub fn translation_of(xi: &Vector6<f64>) -> Vector3<f64> {
    xi.fixed_rows::<3>(0).into_owned()
}

/// The rotation part of a twist.
#[must_use]
pub fn rotation_of(xi: &Vector6<f64>) -> Vector3<f64> {
    xi.fixed_rows::<3>(3).into_owned()
}

/// A twist from its translation and rotation parts.
#[must_use]
pub fn twist(translation: &Vector3<f64>, rotation: &Vector3<f64>) -> Vector6<f64> {
    let mut xi = Vector6::zeros();
    xi.fixed_rows_mut::<3>(0).copy_from(translation);
    xi.fixed_rows_mut::<3>(3).copy_from(rotation);
    xi
}

/// The motion along the twist `xi` (m, rad).
#[must_use]
pub fn exp(xi: &Vector6<f64>) -> Isometry3<f64> {
    let phi = rotation_of(xi);
    Isometry3::from_parts(
        Translation3::from(so3::left_jacobian(&phi) * translation_of(xi)),
        so3::exp(&phi),
    )
}

/// The twist (m, rad) whose motion is `a_from_b`.
#[must_use]
pub fn log(a_from_b: &Isometry3<f64>) -> Vector6<f64> {
    let phi = so3::log(&a_from_b.rotation);
    twist(
        &(so3::left_jacobian_inverse(&phi) * a_from_b.translation.vector),
        &phi,
    )
}

/// The adjoint: `a_from_b · exp(xi) = exp(adjoint(a_from_b) · xi) · a_from_b`.
#[must_use]
pub fn adjoint(a_from_b: &Isometry3<f64>) -> Matrix6<f64> {
    let rotation = a_from_b.rotation.to_rotation_matrix();
    let r = rotation.matrix();
    let mut ad = Matrix6::zeros();
    ad.fixed_view_mut::<3, 3>(0, 0).copy_from(r);
    ad.fixed_view_mut::<3, 3>(3, 3).copy_from(r);
    ad.fixed_view_mut::<3, 3>(0, 3)
        .copy_from(&(so3::hat(&a_from_b.translation.vector) * r));
    ad
}

/// The small adjoint: `ad(a) b` is the Lie bracket of two twists.
#[must_use]
pub fn small_adjoint(xi: &Vector6<f64>) -> Matrix6<f64> {
    let hat_phi = so3::hat(&rotation_of(xi));
    let mut ad = Matrix6::zeros();
    ad.fixed_view_mut::<3, 3>(0, 0).copy_from(&hat_phi);
    ad.fixed_view_mut::<3, 3>(3, 3).copy_from(&hat_phi);
    ad.fixed_view_mut::<3, 3>(0, 3)
        .copy_from(&so3::hat(&translation_of(xi)));
    ad
}

/// Inverse of the right Jacobian, for twists that are not long: `log(exp(xi) exp(d)) ≈ xi + J⁻¹ d`.
///
/// Summed as the Bernoulli series of the small adjoint up to the tenth power: its next term is below
/// 1e-11 for twists of length 0.7, far beyond what lies between two frames.
#[must_use]
pub fn right_jacobian_inverse(xi: &Vector6<f64>) -> Matrix6<f64> {
    let ad = small_adjoint(xi);
    let ad2 = ad * ad;
    let ad4 = ad2 * ad2;
    let ad6 = ad4 * ad2;
    Matrix6::identity() + ad * 0.5 + ad2 / 12.0 - ad4 / 720.0 + ad6 / 30_240.0
        - ad4 * ad4 / 1_209_600.0
        + ad6 * ad4 / 47_900_160.0
}

/// Turns the covariance of a right perturbation, `T_est = T · exp(ξ)`, into that of the error
/// `[t_est − t ; Log(R_est Rᵀ)]` about the fixed axes of the frame that `T` maps into.
#[must_use]
pub fn cov_fixed_axes_from_right(a_from_b: &Isometry3<f64>, cov: &Matrix6<f64>) -> Matrix6<f64> {
    let rotate = block_rotation(a_from_b);
    symmetric(&(rotate * cov * rotate.transpose()))
}

/// The inverse of [`cov_fixed_axes_from_right`].
#[must_use]
pub fn cov_right_from_fixed_axes(a_from_b: &Isometry3<f64>, cov: &Matrix6<f64>) -> Matrix6<f64> {
    let rotate = block_rotation(a_from_b);
    symmetric(&(rotate.transpose() * cov * rotate))
}

/// The error `[t_est − t ; Log(R_est Rᵀ)]` of an estimate, to which fixed-axes covariances belong.
#[must_use]
pub fn error_fixed_axes(estimate: &Isometry3<f64>, truth: &Isometry3<f64>) -> Vector6<f64> {
    twist(
        &(estimate.translation.vector - truth.translation.vector),
        &so3::log(&(estimate.rotation * truth.rotation.inverse())),
    )
}

/// Takes out what rounding did to the quaternion's length.
#[must_use]
pub fn renormalised(mut a_from_b: Isometry3<f64>) -> Isometry3<f64> {
    a_from_b.rotation.renormalize();
    a_from_b
}

/// The mean of a matrix and its transpose: takes out what rounding broke.
#[must_use]
pub fn symmetric(m: &Matrix6<f64>) -> Matrix6<f64> {
    (m + m.transpose()) * 0.5
}

fn block_rotation(a_from_b: &Isometry3<f64>) -> Matrix6<f64> {
    let rotation = a_from_b.rotation.to_rotation_matrix();
    let r: &Matrix3<f64> = rotation.matrix();
    let mut block = Matrix6::zeros();
    block.fixed_view_mut::<3, 3>(0, 0).copy_from(r);
    block.fixed_view_mut::<3, 3>(3, 3).copy_from(r);
    block
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn any_twist() -> impl Strategy<Value = Vector6<f64>> {
        (prop::array::uniform6(-1.0..1.0_f64), -8.0..0.2_f64)
            .prop_map(|(v, exponent)| Vector6::from(v) * 10_f64.powf(exponent))
    }

    proptest! {
        #[test]
        fn log_undoes_exp(xi in any_twist()) {
            prop_assert!((log(&exp(&xi)) - xi).norm() <= 1e-14 * xi.norm().max(1.0));
        }

        #[test]
        fn adjoint_moves_a_perturbation_to_the_other_side(a in any_twist(), b in any_twist()) {
            let t = exp(&a);
            let left = t * exp(&b);
            let right = exp(&(adjoint(&t) * b)) * t;
            prop_assert!((left.to_matrix() - right.to_matrix()).norm() < 1e-13 * (1.0 + b.norm()).powi(3));
        }

        #[test]
        fn exp_of_a_sum_along_one_twist_is_the_product(xi in any_twist(), s in 0.0..1.0_f64) {
            let product = exp(&(xi * s)) * exp(&(xi * (1.0 - s)));
            prop_assert!((product.to_matrix() - exp(&xi).to_matrix()).norm() < 1e-13);
        }

        #[test]
        fn the_adjoint_keeps_products_and_inverses(a in any_twist(), b in any_twist()) {
            let (s, t) = (exp(&a), exp(&b));
            let product = adjoint(&s) * adjoint(&t);
            prop_assert!((adjoint(&(s * t)) - product).norm() < 1e-13 * product.norm());
            let whole = adjoint(&s) * adjoint(&s.inverse());
            prop_assert!((whole - Matrix6::identity()).norm() < 1e-13 * adjoint(&s).norm_squared());
        }

        #[test]
        fn exp_of_the_opposite_is_the_inverse(xi in any_twist()) {
            let gap = exp(&-xi).to_matrix() - exp(&xi).inverse().to_matrix();
            prop_assert!(gap.norm() < 1e-14 * (1.0 + xi.norm()));
        }

        #[test]
        fn motions_form_a_group(a in any_twist(), b in any_twist(), c in any_twist()) {
            let (r, s, t) = (exp(&a), exp(&b), exp(&c));
            let gap = ((r * s) * t).to_matrix() - (r * (s * t)).to_matrix();
            prop_assert!(gap.norm() < 1e-13 * (1.0 + a.norm() + b.norm() + c.norm()));
            let back = (t.inverse() * (t * r)).to_matrix() - r.to_matrix();
            prop_assert!(back.norm() < 1e-13 * (1.0 + a.norm() + c.norm()));
        }

        #[test]
        fn a_covariance_changes_axes_there_and_back_and_stays_one(
            a in any_twist(),
            root in prop::collection::vec(-1.0..1.0_f64, 36),
        ) {
            let t = exp(&a);
            let root = Matrix6::from_column_slice(&root);
            let cov = root * root.transpose() + Matrix6::identity() * 1e-3;
            let fixed = cov_fixed_axes_from_right(&t, &cov);
            prop_assert!(symmetric(&fixed).cholesky().is_some());
            let back = cov_right_from_fixed_axes(&t, &fixed);
            prop_assert!((back - cov).norm() < 1e-13 * cov.norm());
        }

        #[test]
        fn right_jacobian_inverse_is_the_derivative_of_log(a in any_twist()) {
            let xi = a * (0.7 / a.norm().max(0.7));
            let exact = right_jacobian_inverse(&xi);
            let step = 1e-6;
            for j in 0..6 {
                let mut d = Vector6::zeros();
                d[j] = step;
                let numeric = (log(&(exp(&xi) * exp(&d))) - log(&(exp(&xi) * exp(&-d)))) / (2.0 * step);
                prop_assert!((numeric - exact.column(j)).norm() < 1e-7);
            }
        }

        #[test]
        fn fixed_axes_error_is_the_rotated_right_perturbation(a in any_twist(), d in any_twist()) {
            let truth = exp(&a);
            let small = d * (1e-6 / d.norm().max(1e-9));
            let error = error_fixed_axes(&(truth * exp(&small)), &truth);
            let predicted = block_rotation(&truth) * small;
            prop_assert!((error - predicted).norm() < 1e-11);
        }
    }
}
