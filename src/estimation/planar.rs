//! Motion on flat ground in closed form: two clouds of the same points in, the thesis' (x, y, θ)
//! out.
//!
//! Its covariance by the implicit function theorem is that of the general closed form within the
//! plane: see [`influence::of_closed_form`](super::influence::of_closed_form). Least squares in the
//! images are [`Reprojection`](super::reprojection::Reprojection) with a planar
//! [`Model`](super::Model).

use super::model::Plane;
use nalgebra::{Isometry2, Point3, Rotation2, Vector2};

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
