//! Rigid motions in a plane: exponential, logarithm and adjoint, with twists ordered x, y, θ.

use nalgebra::{Isometry2, Matrix2, Matrix3, Vector2, Vector3};

/// Below this angle, rad, sine ratios come from their power series.
const SERIES_BELOW_RAD: f64 = 1e-3;

/// The motion along the twist (m, m, rad).
#[must_use]
pub fn exp(xi: &Vector3<f64>) -> Isometry2<f64> {
    let theta = xi.z;
    let (sine, versine) = if theta.abs() < SERIES_BELOW_RAD {
        let t2 = theta * theta;
        (1.0 - t2 / 6.0, theta * (0.5 - t2 / 24.0))
    } else {
        (theta.sin() / theta, (1.0 - theta.cos()) / theta)
    };
    Isometry2::new(Matrix2::new(sine, -versine, versine, sine) * xi.xy(), theta)
}

/// The twist (m, m, rad) whose motion is `a_from_b`; its angle lies within ±π.
#[must_use]
pub fn log(a_from_b: &Isometry2<f64>) -> Vector3<f64> {
    let theta = a_from_b.rotation.angle();
    let half = 0.5 * theta;
    let cotangent = if theta.abs() < SERIES_BELOW_RAD {
        1.0 - half * half / 3.0
    } else {
        half / half.tan()
    };
    let rho: Vector2<f64> =
        Matrix2::new(cotangent, half, -half, cotangent) * a_from_b.translation.vector;
    Vector3::new(rho.x, rho.y, theta)
}

/// The adjoint: `a_from_b · exp(xi) = exp(adjoint(a_from_b) · xi) · a_from_b`.
#[must_use]
pub fn adjoint(a_from_b: &Isometry2<f64>) -> Matrix3<f64> {
    let (sin, cos) = a_from_b.rotation.angle().sin_cos();
    let t = a_from_b.translation.vector;
    Matrix3::new(cos, -sin, t.y, sin, cos, -t.x, 0.0, 0.0, 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn any_twist() -> impl Strategy<Value = Vector3<f64>> {
        (prop::array::uniform3(-1.0..1.0_f64), -8.0..0.4_f64)
            .prop_map(|(v, exponent)| Vector3::from(v) * 10_f64.powf(exponent))
    }

    proptest! {
        #[test]
        fn log_undoes_exp(xi in any_twist()) {
            prop_assert!((log(&exp(&xi)) - xi).norm() <= 1e-12 * xi.norm().max(1.0));
        }

        #[test]
        fn adjoint_moves_a_perturbation_to_the_other_side(a in any_twist(), b in any_twist()) {
            let t = exp(&a);
            let left = t * exp(&b);
            let right = exp(&(adjoint(&t) * b)) * t;
            prop_assert!((left.to_homogeneous() - right.to_homogeneous()).norm() < 1e-12 * (1.0 + b.norm()).powi(2));
        }

        #[test]
        fn the_adjoint_keeps_products_and_inverses(a in any_twist(), b in any_twist()) {
            let (s, t) = (exp(&a), exp(&b));
            let product = adjoint(&s) * adjoint(&t);
            prop_assert!((adjoint(&(s * t)) - product).norm() < 1e-13 * product.norm());
            let whole = adjoint(&s) * adjoint(&s.inverse());
            prop_assert!((whole - Matrix3::identity()).norm() < 1e-13 * adjoint(&s).norm_squared());
        }

        #[test]
        fn exp_of_the_opposite_is_the_inverse(xi in any_twist()) {
            let gap = exp(&-xi).to_homogeneous() - exp(&xi).inverse().to_homogeneous();
            prop_assert!(gap.norm() < 1e-12 * (1.0 + xi.norm()));
        }

        #[test]
        fn exp_of_a_sum_along_one_twist_is_the_product(xi in any_twist(), s in 0.0..1.0_f64) {
            let product = exp(&(xi * s)) * exp(&(xi * (1.0 - s)));
            prop_assert!((product.to_homogeneous() - exp(&xi).to_homogeneous()).norm() < 1e-12);
        }
    }
}
