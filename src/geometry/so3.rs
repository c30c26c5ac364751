//! Rotations: exponential, logarithm and the Jacobians between them, exact at every angle.
//!
//! Formulas as in Barfoot, *State Estimation for Robotics*, chapter 7. Coefficients that lose
//! digits by cancellation are summed as their power series below one radian, where both forms agree
//! to the last bits, so that nothing jumps at a threshold.

use nalgebra::{Matrix3, Quaternion, UnitQuaternion, Vector3};

/// Below this angle, rad, coefficients come from their power series.
const SERIES_BELOW_RAD: f64 = 1.0;

/// The matrix of the cross product: `hat(a) * b = a × b`.
#[must_use]
pub fn hat(a: &Vector3<f64>) -> Matrix3<f64> {
    a.cross_matrix()
}

/// The rotation by `|phi|` rad about `phi`.
#[must_use]
pub fn exp(phi: &Vector3<f64>) -> UnitQuaternion<f64> {
    let half = 0.5 * phi.norm();
    // sin(x)/x needs no series: it keeps its digits down to the smallest x that is not zero.
    let sinc = if half > 0.0 { half.sin() / half } else { 1.0 };
    UnitQuaternion::new_normalize(Quaternion::from_parts(half.cos(), phi * (0.5 * sinc)))
}

/// The rotation vector of `rotation`, rad, of length at most π.
#[must_use]
pub fn log(rotation: &UnitQuaternion<f64>) -> Vector3<f64> {
    let mut w = rotation.w;
    let mut v = rotation.imag();
    if w < 0.0 {
        w = -w;
        v = -v;
    }
    let sin_half = v.norm();
    if sin_half > 0.0 {
        v * (2.0 * sin_half.atan2(w) / sin_half)
    } else {
        Vector3::zeros()
    }
}

/// Left Jacobian: `exp(phi + d) ≈ exp(J d) exp(phi)`.
#[must_use]
pub fn left_jacobian(phi: &Vector3<f64>) -> Matrix3<f64> {
    let theta = phi.norm();
    let hat_phi = hat(phi);
    Matrix3::identity() + hat_phi * versine_ratio(theta) + hat_phi * hat_phi * sine_gap_ratio(theta)
}

/// Inverse of [`left_jacobian`], for angles below 2π.
#[must_use]
pub fn left_jacobian_inverse(phi: &Vector3<f64>) -> Matrix3<f64> {
    let theta = phi.norm();
    let hat_phi = hat(phi);
    Matrix3::identity() - hat_phi * 0.5 + hat_phi * hat_phi * cotangent_gap_ratio(theta)
}

/// `(1 − cos θ) / θ²`.
fn versine_ratio(theta: f64) -> f64 {
    let half = 0.5 * theta;
    let sinc = if half > 0.0 { half.sin() / half } else { 1.0 };
    0.5 * sinc * sinc
}

/// `(θ − sin θ) / θ³`.
fn sine_gap_ratio(theta: f64) -> f64 {
    if theta < SERIES_BELOW_RAD {
        // Σ (−1)ⁿ θ²ⁿ / (2n+3)!
        alternating_series(theta, 1.0 / 6.0, |n| {
            1.0 / ((2.0 * n + 2.0) * (2.0 * n + 3.0))
        })
    } else {
        (theta - theta.sin()) / (theta * theta * theta)
    }
}

/// `(1 − (θ/2) cot(θ/2)) / θ²`.
fn cotangent_gap_ratio(theta: f64) -> f64 {
    let versine = versine_ratio(theta);
    if theta < SERIES_BELOW_RAD {
        // (2b − a)/θ² with a = sin θ/θ, b = (1 − cos θ)/θ²: Σ (−1)ⁿ 2(n+1) θ²ⁿ / (2n+4)!
        let gap = alternating_series(theta, 2.0 / 24.0, |n| {
            (n + 1.0) / (n * (2.0 * n + 3.0) * (2.0 * n + 4.0))
        });
        gap / (2.0 * versine)
    } else {
        let sinc = theta.sin() / theta;
        (2.0 * versine - sinc) / (2.0 * versine * theta * theta)
    }
}

/// `Σ (−1)ⁿ cₙ θ²ⁿ` with `c₀ = first` and `cₙ = cₙ₋₁ ratio(n)`: ten terms, enough below one radian.
fn alternating_series(theta: f64, first: f64, ratio: impl Fn(f64) -> f64) -> f64 {
    let mut term = first;
    let mut sum = first;
    for n in 1..10 {
        term *= -theta * theta * ratio(f64::from(n));
        sum += term;
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn any_vector(max: f64) -> impl Strategy<Value = Vector3<f64>> {
        // Lengths over many orders of magnitude: small angles are where such code breaks.
        (prop::array::uniform3(-1.0..1.0_f64), -12.0..0.0_f64).prop_map(move |(v, exponent)| {
            let v = Vector3::from(v);
            v * (max / v.norm().max(1.0)) * 10_f64.powf(exponent)
        })
    }

    proptest! {
        #[test]
        fn log_undoes_exp(phi in any_vector(3.1)) {
            let back = log(&exp(&phi));
            prop_assert!((back - phi).norm() <= 4e-15 * phi.norm().max(1.0), "{phi} {back}");
        }

        #[test]
        fn exp_of_the_opposite_is_the_inverse(phi in any_vector(3.1)) {
            let gap = exp(&-phi).coords - exp(&phi).inverse().coords;
            prop_assert!(gap.norm() < 1e-15);
        }

        /// J(−φ) is the Jacobian of the other side, R(φ)ᵀ J(φ).
        #[test]
        fn the_jacobian_of_the_opposite_is_that_of_the_other_side(phi in any_vector(3.1)) {
            let other = exp(&phi).to_rotation_matrix().into_inner().transpose() * left_jacobian(&phi);
            prop_assert!((left_jacobian(&-phi) - other).norm() < 1e-14);
        }

        #[test]
        fn inverse_jacobian_is_the_inverse(phi in any_vector(3.1)) {
            let product = left_jacobian(&phi) * left_jacobian_inverse(&phi);
            prop_assert!((product - Matrix3::identity()).norm() < 1e-14);
        }

        #[test]
        fn left_jacobian_is_the_derivative_of_exp(phi in any_vector(3.1)) {
            let step = 1e-6;
            let mut numeric = Matrix3::zeros();
            for j in 0..3 {
                let mut d = Vector3::zeros();
                d[j] = step;
                let plus = log(&(exp(&(phi + d)) * exp(&phi).inverse()));
                let minus = log(&(exp(&(phi - d)) * exp(&phi).inverse()));
                numeric.set_column(j, &((plus - minus) / (2.0 * step)));
            }
            prop_assert!((numeric - left_jacobian(&phi)).norm() < 1e-8);
        }
    }

    #[test]
    fn series_and_closed_form_meet_at_the_threshold() {
        let (below, above) = (SERIES_BELOW_RAD - 1e-15, SERIES_BELOW_RAD);
        assert!((sine_gap_ratio(below) - sine_gap_ratio(above)).abs() < 1e-15);
        assert!((cotangent_gap_ratio(below) - cotangent_gap_ratio(above)).abs() < 2e-15);
    }
}
