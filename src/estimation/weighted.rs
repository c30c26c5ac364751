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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimation::synthetic::{random, rig};
    use crate::estimation::{MotionModel, Plane};
    use nalgebra::{Isometry2, Point3, Vector2};
    use rand_distr::{Distribution, StandardNormal};
    use rand_xoshiro::Xoshiro256PlusPlus;

    fn normal3(rng: &mut Xoshiro256PlusPlus) -> Vector3<f64> {
        Vector3::from_fn(|_, _| StandardNormal.sample(rng))
    }

    /// Points with covariances as a rig has them: long along the view where `isotropic` is false.
    fn cloud(count: usize, isotropic: bool, rng: &mut Xoshiro256PlusPlus) -> Vec<Landmark> {
        (0..count)
            .map(|i| {
                let n = normal3(rng);
                let z = 8.0 + 2.0 * n.z;
                let ray = Vector3::new(0.3 * n.x, 0.2 * n.y, 1.0);
                let sigma = 0.004 * (1.0 + (i % 3) as f64);
                let depth = if isotropic { 0.0 } else { 0.05 };
                Landmark {
                    point: Point3::from(ray * z),
                    cov_m2: Matrix3::identity() * (sigma * sigma)
                        + ray * ray.transpose() * (depth * depth),
                }
            })
            .collect()
    }

    fn moved(cloud: &[Landmark], prev_from_now: &Isometry3<f64>) -> Vec<Landmark> {
        let r = *prev_from_now.rotation.to_rotation_matrix().matrix();
        let one = |l: &Landmark| Landmark {
            point: prev_from_now * l.point,
            cov_m2: r * l.cov_m2 * r.transpose(),
        };
        cloud.iter().map(one).collect()
    }

    fn disturbed(l: &Landmark, rng: &mut Xoshiro256PlusPlus) -> Landmark {
        let root = l.cov_m2.cholesky().expect("definite").l();
        Landmark {
            point: l.point + root * normal3(rng),
            cov_m2: l.cov_m2,
        }
    }

    fn truth() -> Isometry3<f64> {
        Plane::of(&rig()).lift(&Isometry2::new(Vector2::new(0.5, 0.1), 0.1))
    }

    fn models() -> [Model; 2] {
        [MotionModel::Se3.of(&rig()), MotionModel::Planar.of(&rig())]
    }

    #[test]
    fn gradient_matches_central_differences_with_residuals_of_their_own() {
        // Equal in all directions, so that the weights do not move with the motion.
        let mut rng = random(31);
        let now = cloud(8, true, &mut rng);
        let pairs: Vec<(Landmark, Landmark)> = moved(&now, &truth())
            .iter()
            .zip(&now)
            .map(|(prev, now)| {
                let far = |l: &Landmark, rng: &mut Xoshiro256PlusPlus| Landmark {
                    point: l.point + normal3(rng) * 0.2,
                    ..*l
                };
                (far(prev, &mut rng), far(now, &mut rng))
            })
            .collect();
        for model in models() {
            let solve = |pairs: &[(Landmark, Landmark)]| {
                align(&model, pairs).expect("spread").prev_from_now
            };
            let base = solve(&pairs);
            let exact = derivative(&model, &base, &pairs).expect("definite");
            for (i, (by_prev, by_now)) in exact.iter().enumerate() {
                for axis in 0..3 {
                    for (side, by) in [by_prev, by_now].into_iter().enumerate() {
                        let step = 1e-5;
                        let mut numeric = Vector6::zeros();
                        for sign in [1.0, -1.0] {
                            let mut other = pairs.clone();
                            let l = if side == 0 {
                                &mut other[i].0
                            } else {
                                &mut other[i].1
                            };
                            l.point[axis] += sign * step;
                            let change = base.inverse() * solve(&other);
                            numeric += se3::log(&change) * (sign / (2.0 * step));
                        }
                        let gap = (numeric - by.column(axis)).norm();
                        assert!(
                            gap < 1e-6 * by.norm().max(1e-2),
                            "{model:?} {i} {axis} {side} {gap}"
                        );
                    }
                }
            }
        }
    }

    #[test]
    fn covariance_holds_against_monte_carlo() {
        const RUNS: usize = 1000;
        let mut rng = random(32);
        let now = cloud(30, false, &mut rng);
        let prev = moved(&now, &truth());
        for model in models() {
            let mut sum = 0.0;
            for _ in 0..RUNS {
                let pairs: Vec<_> = prev
                    .iter()
                    .zip(&now)
                    .map(|(p, n)| (disturbed(p, &mut rng), disturbed(n, &mut rng)))
                    .collect();
                let found = align(&model, &pairs).expect("spread");
                let error = se3::log(&(truth().inverse() * found.prev_from_now));
                sum += model.nees(&error, &found.cov_right).expect("definite");
            }
            let freedom = model.degrees_of_freedom();
            let anees = sum / (RUNS * freedom) as f64;
            let (low, high) = crate::uncertainty::consistency::anees_interval(freedom, RUNS, 0.997);
            assert!(
                (low..high).contains(&anees),
                "{model:?}: {anees} {low} {high}"
            );
        }
    }

    #[test]
    fn weights_are_worth_it() {
        let mut rng = random(33);
        let now = cloud(30, false, &mut rng);
        let prev = moved(&now, &truth());
        let (mut weighted, mut plain) = (0.0, 0.0);
        for _ in 0..50 {
            let pairs: Vec<_> = prev
                .iter()
                .zip(&now)
                .map(|(p, n)| (disturbed(p, &mut rng), disturbed(n, &mut rng)))
                .collect();
            let error = |found: &Isometry3<f64>| {
                (found.translation.vector - truth().translation.vector).norm_squared()
            };
            weighted += error(&align(&Model::Se3, &pairs).expect("spread").prev_from_now);
            let points = pairs.iter().map(|(p, n)| (p.point, n.point));
            plain += error(&closed_form::align(points).expect("spread"));
        }
        assert!(weighted < 0.3 * plain, "{weighted} {plain}");
    }
}
