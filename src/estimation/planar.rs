//! Motion on flat ground, the thesis' (x, y, θ): closed form on triangulated points, and least
//! squares in the images.
//!
//! Both take a [`Model`], so that what holds for a plane is the special case that it is.

use super::bundle::{Adjustment, TrackedPoint};
use super::closed_form::MotionEstimate;
use super::influence::{self, LinearTrack};
use super::model::{Model, Plane};
use crate::geometry::{StereoRig, se3};
use nalgebra::{Isometry2, Isometry3, Matrix6, Point3, Rotation2, Vector2, Vector6};

/// The planar motion with the least sum of squared distances, `now` onto `prev` (thesis 2.7 in the
/// plane). Pairs are (earlier, now), in the left camera's frame.
///
/// `None` below two points or where all lie in one.
#[must_use]
pub fn align(
    plane: &Plane,
    points: impl Iterator<Item = (Point3<f64>, Point3<f64>)> + Clone,
) -> Option<Isometry2<f64>> {
    let pairs =
        points.map(|(prev, now)| (plane.in_plane(&prev.coords), plane.in_plane(&now.coords)));
    let mut count = 0.0;
    let (mut mean_prev, mut mean_now) = (Vector2::zeros(), Vector2::zeros());
    for (prev, now) in pairs.clone() {
        mean_prev += prev;
        mean_now += now;
        count += 1.0;
    }
    if count < 2.0 {
        return None;
    }
    mean_prev /= count;
    mean_now /= count;
    let (mut cos, mut sin, mut spread) = (0.0, 0.0, 0.0);
    for (prev, now) in pairs {
        let (a, b) = (now - mean_now, prev - mean_prev);
        cos += a.dot(&b);
        sin += a.perp(&b);
        spread += a.norm() * b.norm();
    }
    if cos.hypot(sin) <= 1e-12 * spread || spread == 0.0 {
        return None;
    }
    let rotation = Rotation2::new(sin.atan2(cos));
    Some(Isometry2::new(
        mean_prev - rotation * mean_now,
        rotation.angle(),
    ))
}

/// Levenberg–Marquardt iterations at most.
const MAX_ITERATIONS: usize = 25;
/// A step this short, m and rad, ends the search.
const SMALL_STEP: f64 = 1e-10;

/// Two-frame bundle adjustment within a model: as [`Adjuster::adjust`](super::bundle::Adjuster::adjust), but the motion stays
/// in the plane where the model is one. The points are left at their optimum.
///
/// `None` with fewer than three tracks, or if the motion is not determined by them.
#[must_use]
pub fn adjust(
    rig: &StereoRig,
    model: &Model,
    prev_from_now: &Isometry3<f64>,
    points: &mut [TrackedPoint],
) -> Option<Adjustment> {
    if points.len() < 3 {
        return None;
    }
    let mut motion = model.constrain(prev_from_now);
    let mut cost = total_cost(rig, &motion, points)?;
    let mut scale = 1.0;
    let mut iterations = 0;
    while iterations < MAX_ITERATIONS && scale > 1e-4 {
        iterations += 1;
        let (step, steps) = gauss_newton(rig, model, &motion, points)?;
        let candidate = motion * se3::exp(&(step * scale));
        let mut moved = points.to_vec();
        for (p, by) in moved.iter_mut().zip(&steps) {
            p.inverse_depth += by * scale;
        }
        match total_cost(rig, &candidate, &moved) {
            Some(next) if next <= cost * (1.0 + 1e-12) => {
                points.copy_from_slice(&moved);
                motion = candidate;
                cost = next;
                scale = 1.0;
                if step.norm() <= SMALL_STEP {
                    break;
                }
            }
            // A full step that overshoots is taken in part.
            _ => scale *= 0.3,
        }
    }
    let mut influences = Vec::with_capacity(points.len());
    let cov_right = influence::of_bundle(rig, model, &motion, points, &mut influences)?;
    let freedom = 5 * points.len() - model.degrees_of_freedom();
    Some(Adjustment {
        motion: MotionEstimate {
            prev_from_now: motion,
            cov_right,
        },
        variance_factor: cost / freedom as f64,
        iterations,
    })
}

/// Squared residuals, in σ², those beyond Huber's limit by their robust weight.
fn total_cost(
    rig: &StereoRig,
    prev_from_now: &Isometry3<f64>,
    points: &[TrackedPoint],
) -> Option<f64> {
    let now_from_prev = prev_from_now.inverse();
    points
        .iter()
        .map(|p| LinearTrack::new(rig, &now_from_prev, p).map(|t| t.weighted_squares()))
        .sum()
}

/// The step of the motion and those of the points.
fn gauss_newton(
    rig: &StereoRig,
    model: &Model,
    motion: &Isometry3<f64>,
    points: &[TrackedPoint],
) -> Option<(Vector6<f64>, Vec<nalgebra::Vector3<f64>>)> {
    let now_from_prev = motion.inverse();
    let mut info = Matrix6::zeros();
    let mut gradient = Vector6::zeros();
    let mut reduced = Vec::with_capacity(points.len());
    for p in points {
        let (track_info, track_gradient, step) =
            LinearTrack::new(rig, &now_from_prev, p)?.reduced()?;
        info += track_info;
        gradient += track_gradient;
        reduced.push(step);
    }
    let step = model.inverse(&info)? * gradient;
    let steps = reduced
        .iter()
        .map(|point| point.alone + point.by_motion * step)
        .collect();
    Some((step, steps))
}
