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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::se2;
    use crate::simulation::thesis_rig;
    use nalgebra::Vector3;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn an_exact_motion_is_found(
            xi in prop::array::uniform3(-1.5..1.5_f64),
            cloud in prop::collection::vec(prop::array::uniform3(-3.0..3.0_f64), 2..15),
        ) {
            let plane = Plane::of(&thesis_rig());
            let now: Vec<Point3<f64>> = cloud.iter().map(|p| Point3::new(p[0], p[1], 6.0 + p[2])).collect();
            let spread = now.iter().map(|p| (p - now[0]).xz().norm()).fold(0.0, f64::max);
            prop_assume!(spread > 0.1);
            let truth = se2::exp(&Vector3::from(xi));
            let lifted = plane.lift(&truth);
            let found = align(&plane, now.iter().map(|p| (lifted * p, *p))).expect("spread");
            prop_assert!((found.to_homogeneous() - truth.to_homogeneous()).norm() < 1e-9);
        }
    }

    #[test]
    fn what_lies_in_one_place_is_refused() {
        let plane = Plane::of(&thesis_rig());
        // Apart in height only: the same place on the ground.
        let pairs = [0.0, 1.0, 2.0].map(|y| (Point3::new(1.0, y, 5.0), Point3::new(1.0, y, 4.0)));
        assert!(align(&plane, pairs.iter().copied()).is_none());
        assert!(align(&plane, pairs[..1].iter().copied()).is_none());
    }
}
