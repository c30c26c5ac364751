//! Closed-form motion: two clouds of the same points in, the rigid motion between them out, with
//! its covariance by the implicit function theorem over all points (thesis §2.4, §3.3, corrected).
//!
//! Cost (thesis 2.7): `C = Σ ‖R pᵢ + T − p'ᵢ‖²` with `p` in the left camera now, `p'` in the left
//! camera before; so `(R, T)` is `prev_from_now`.

use super::Landmark;
use crate::geometry::so3;
use crate::uncertainty::{derivative_of_minimiser, propagate};
use nalgebra::{
    Isometry3, Matrix3, Matrix6, Point3, Rotation3, SMatrix, Translation3, UnitQuaternion, Vector3,
};

/// A motion with the covariance of its right perturbation, `T · Exp(ξ)`, ξ = (translation, rotation).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MotionEstimate {
    /// Maps a point of the left camera now into the left camera before.
    pub prev_from_now: Isometry3<f64>,
    /// Covariance of the right perturbation, m², m·rad, rad².
    pub cov_right: Matrix6<f64>,
}

/// The rigid motion with the least sum of squared distances, `now` onto `prev` (Arun et al. 1987,
/// with Umeyama's determinant: without it noisy, nearly flat clouds come out mirrored).
///
/// `None` below three points or where they lie on one line.
#[must_use]
pub fn align(
    points: impl Iterator<Item = (Point3<f64>, Point3<f64>)> + Clone,
) -> Option<Isometry3<f64>> {
    let mut count = 0.0;
    let (mut mean_prev, mut mean_now) = (Vector3::zeros(), Vector3::zeros());
    for (prev, now) in points.clone() {
        mean_prev += prev.coords;
        mean_now += now.coords;
        count += 1.0;
    }
    if count < 3.0 {
        return None;
    }
    mean_prev /= count;
    mean_now /= count;
    let mut correlation = Matrix3::zeros();
    for (prev, now) in points {
        correlation += (prev.coords - mean_prev) * (now.coords - mean_now).transpose();
    }
    let svd = correlation.svd(true, true);
    let (u, v_t) = (svd.u?, svd.v_t?);
    // Two directions must be measured; the third follows from handedness.
    if svd.singular_values[1] <= 1e-12 * svd.singular_values[0] {
        return None;
    }
    let handedness =
        Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, (u * v_t).determinant().signum()));
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(
        u * handedness * v_t,
    ));
    Some(Isometry3::from_parts(
        Translation3::from(mean_prev - rotation * mean_now),
        rotation,
    ))
}

/// [`align`] with the covariance that the points' own covariances give it:
/// `Σ_M = ∇ blockdiag(Σ_p1 … Σ_pn, Σ_p'1 … Σ_p'n) ∇ᵀ` (thesis 3.29, 3.30).
///
/// `None` as for [`align`].
#[must_use]
pub fn align_with_covariance(
    landmarks: impl Iterator<Item = (Landmark, Landmark)> + Clone,
) -> Option<MotionEstimate> {
    let prev_from_now = align(landmarks.clone().map(|(prev, now)| (prev.point, now.point)))?;
    let now_from_prev = prev_from_now.inverse();
    let hessian: Matrix6<f64> = landmarks
        .clone()
        .map(|(prev, now)| {
            hessian_of_point(&now.point.coords, &(now_from_prev * prev.point).coords)
        })
        .sum();
    let rotation = now_from_prev.rotation.to_rotation_matrix();
    let mut cov_right = Matrix6::zeros();
    for (prev, now) in landmarks {
        let p = now.point.coords;
        let q = (now_from_prev * prev.point).coords;
        let by_now = derivative_of_minimiser(&hessian, &mixed_by_now(&q))?;
        let by_prev = derivative_of_minimiser(&hessian, &mixed_by_prev(&p, rotation.matrix()))?;
        cov_right += propagate(&by_now, &now.cov_m2) + propagate(&by_prev, &prev.cov_m2);
    }
    Some(MotionEstimate {
        prev_from_now,
        cov_right,
    })
}

/// One point's part of `∂²C/∂ξ²`, second-order terms of the rotation included. With `q` the
/// earlier point carried into the current frame and `e = p − q`, the point's cost is
/// `‖exp(φ) p + ρ − q‖²`.
pub(super) fn hessian_of_point(p: &Vector3<f64>, q: &Vector3<f64>) -> Matrix6<f64> {
    let e = p - q;
    let hat_p = so3::hat(p);
    let mut hessian = Matrix6::zeros();
    hessian
        .fixed_view_mut::<3, 3>(0, 0)
        .copy_from(&(Matrix3::identity() * 2.0));
    hessian
        .fixed_view_mut::<3, 3>(0, 3)
        .copy_from(&(hat_p * -2.0));
    hessian
        .fixed_view_mut::<3, 3>(3, 0)
        .copy_from(&(hat_p * 2.0));
    // eᵀ(φ × (φ × p)) = φᵀ [½(e pᵀ + p eᵀ) − (e·p) I] φ
    let curvature = e * p.transpose() + p * e.transpose() - Matrix3::identity() * (2.0 * e.dot(p));
    hessian
        .fixed_view_mut::<3, 3>(3, 3)
        .copy_from(&(hat_p.transpose() * hat_p * 2.0 + curvature));
    hessian
}

/// `∂²C/∂ξ∂p` of one point.
pub(super) fn mixed_by_now(q: &Vector3<f64>) -> SMatrix<f64, 6, 3> {
    let mut mixed = SMatrix::<f64, 6, 3>::zeros();
    mixed
        .fixed_view_mut::<3, 3>(0, 0)
        .copy_from(&(Matrix3::identity() * 2.0));
    mixed
        .fixed_view_mut::<3, 3>(3, 0)
        .copy_from(&(so3::hat(q) * 2.0));
    mixed
}

/// `∂²C/∂ξ∂p'` of one point; `rotation` is that of `now_from_prev`.
pub(super) fn mixed_by_prev(p: &Vector3<f64>, rotation: &Matrix3<f64>) -> SMatrix<f64, 6, 3> {
    let mut mixed = SMatrix::<f64, 6, 3>::zeros();
    mixed
        .fixed_view_mut::<3, 3>(0, 0)
        .copy_from(&(rotation * -2.0));
    mixed
        .fixed_view_mut::<3, 3>(3, 0)
        .copy_from(&(so3::hat(p) * rotation * -2.0));
    mixed
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::se3;
    use nalgebra::Vector6;
    use proptest::prelude::*;
    use rand::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};
    use rand_xoshiro::Xoshiro256PlusPlus;

    fn cloud(count: usize, seed: u64) -> Vec<Landmark> {
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
        let mut normal = move || -> f64 { StandardNormal.sample(&mut rng) };
        (0..count)
            .map(|_| {
                let point = Point3::new(normal(), normal(), 6.0 + normal());
                let root = Matrix3::from_fn(|_, _| 0.01 * normal());
                Landmark {
                    point,
                    cov_m2: root * root.transpose() + Matrix3::identity() * 1e-4,
                }
            })
            .collect()
    }

    fn disturbed(landmark: &Landmark, rng: &mut Xoshiro256PlusPlus) -> Landmark {
        let root = landmark.cov_m2.cholesky().expect("positive definite").l();
        let unit = Vector3::from_fn(|_, _| StandardNormal.sample(rng));
        Landmark {
            point: landmark.point + root * unit,
            cov_m2: landmark.cov_m2,
        }
    }

    fn moved(cloud: &[Landmark], a_from_b: &Isometry3<f64>) -> Vec<Landmark> {
        let r = *a_from_b.rotation.to_rotation_matrix().matrix();
        cloud
            .iter()
            .map(|l| Landmark {
                point: a_from_b * l.point,
                cov_m2: r * l.cov_m2 * r.transpose(),
            })
            .collect()
    }

    proptest! {
        #[test]
        fn an_exact_motion_is_found(xi in prop::array::uniform6(-1.5..1.5_f64), seed: u64, count in 3_usize..20) {
            let now = cloud(count, seed);
            let prev_from_now = se3::exp(&Vector6::from(xi));
            let prev = moved(&now, &prev_from_now);
            let found = align(prev.iter().zip(&now).map(|(a, b)| (a.point, b.point))).expect("spread");
            prop_assert!((found.to_matrix() - prev_from_now.to_matrix()).norm() < 1e-8);
        }

        #[test]
        fn noisy_flat_samples_are_never_mirrored(seed: u64) {
            let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
            let flat = |rng: &mut Xoshiro256PlusPlus| {
                let mut n = || -> f64 { StandardNormal.sample(rng) };
                Point3::new(n(), n(), 5.0 + 1e-3 * n())
            };
            let pairs: Vec<_> = (0..4).map(|_| {
                let p = flat(&mut rng);
                (p, Point3::new(p.x, p.y, 10.0 - p.z))
            }).collect();
            let found = align(pairs.iter().copied()).expect("spread");
            let r = found.rotation.to_rotation_matrix();
            prop_assert!((r.matrix().determinant() - 1.0).abs() < 1e-9);
        }
    }

    #[test]
    fn gradient_matches_central_differences() {
        // Clouds that do not fit exactly, so that the residuals' own terms count.
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(3);
        let now: Vec<Landmark> = cloud(7, 4)
            .iter()
            .map(|l| Landmark {
                cov_m2: l.cov_m2 * 900.0,
                ..disturbed(l, &mut rng)
            })
            .collect();
        let truth = se3::exp(&Vector6::new(0.2, -0.1, 0.4, 0.05, -0.1, 0.02));
        let prev: Vec<Landmark> = moved(&cloud(7, 4), &truth)
            .iter()
            .map(|l| {
                disturbed(
                    &Landmark {
                        cov_m2: l.cov_m2 * 900.0,
                        ..*l
                    },
                    &mut rng,
                )
            })
            .collect();
        let solve = |prev: &[Landmark], now: &[Landmark]| {
            align(prev.iter().zip(now).map(|(a, b)| (a.point, b.point))).expect("spread")
        };
        let base = solve(&prev, &now);
        let step = 1e-5;
        for i in 0..7 {
            for axis in 0..3 {
                for side in 0..2 {
                    let mut numeric = Vector6::zeros();
                    for sign in [1.0, -1.0] {
                        let (mut p, mut n) = (prev.clone(), now.clone());
                        let cloud = if side == 0 { &mut p } else { &mut n };
                        cloud[i].point[axis] += sign * step;
                        let change = base.inverse() * solve(&p, &n);
                        numeric += se3::log(&change) * (sign / (2.0 * step));
                    }
                    // All noise in this one coordinate: Σ_M is the outer product of its derivative.
                    let silent = |cloud: &[Landmark]| -> Vec<Landmark> {
                        cloud
                            .iter()
                            .map(|l| Landmark {
                                cov_m2: Matrix3::zeros(),
                                ..*l
                            })
                            .collect()
                    };
                    let (mut p, mut n) = (silent(&prev), silent(&now));
                    let cloud = if side == 0 { &mut p } else { &mut n };
                    cloud[i].cov_m2[(axis, axis)] = 1.0;
                    let cov = align_with_covariance(p.iter().copied().zip(n.iter().copied()))
                        .expect("spread")
                        .cov_right;
                    let expected = numeric * numeric.transpose();
                    assert!(
                        (cov - expected).norm() < 1e-6 * expected.norm().max(1e-3),
                        "{i} {axis} {side}\n{cov}{expected}"
                    );
                }
            }
        }
    }

    #[test]
    fn covariance_holds_against_monte_carlo() {
        const RUNS: usize = 3000;
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(5);
        let now = cloud(30, 6);
        let truth = se3::exp(&Vector6::new(0.1, 0.0, 0.5, 0.0, 0.1, 0.0));
        let prev = moved(&now, &truth);
        let mut nees = 0.0;
        for _ in 0..RUNS {
            let p: Vec<_> = prev.iter().map(|l| disturbed(l, &mut rng)).collect();
            let n: Vec<_> = now.iter().map(|l| disturbed(l, &mut rng)).collect();
            let estimate = align_with_covariance(p.into_iter().zip(n)).expect("spread");
            let error = se3::log(&(truth.inverse() * estimate.prev_from_now));
            let solved = estimate
                .cov_right
                .cholesky()
                .expect("positive definite")
                .solve(&error);
            nees += error.dot(&solved) / (6 * RUNS) as f64;
        }
        // χ²(18000)/18000 within 3.2 % is 3 σ.
        assert!((0.968..1.032).contains(&nees), "ANEES/6 {nees}");
    }
}
