//! A motion with its tracks in; what an error of the rig's calibration, or of its synchronisation,
//! does to that motion out.
//!
//! To an estimator such an error is a displacement of every pixel: `h(x, c + δc) − h(x, c)`. How
//! pixels move a motion is known ([`Influence`]); so `δm = Σ (Pᵢ ∂h/∂c before + Qᵢ ∂h/∂c now) δc`,
//! which is `(JᵀWJ)⁻¹ JᵀW ∂h/∂c` with the points marginalised.

use super::bundle::TrackedPoint;
use super::influence::Influence;
use super::sight::{Sight, Viewpoint};
use crate::geometry::rig_parameters::{
    CAMERA_PARAMETERS, EXTRINSICS, RIG_PARAMETERS, pixel_by_parameters,
};
use crate::geometry::{StereoRig, product::product, so3};
use crate::uncertainty::consider::Sensitivity;
use nalgebra::{Isometry3, SMatrix, Vector3, Vector4, Vector6};

/// By how much the sight (ul, vl, ur, vr), px, of the point `y` = (x, y, ρ) from where a rig has gone
/// moves with each parameter of the rig, the point and the motion staying.
///
/// `None` where a camera cannot see the point.
#[must_use]
pub fn sight_by_rig(
    rig: &StereoRig,
    from: &Viewpoint,
    y: &Vector3<f64>,
) -> Option<SMatrix<f64, 4, RIG_PARAMETERS>> {
    Some(seen_by_rig(rig, from, y, &from.linearise(rig, y)?))
}

/// [`sight_by_rig`] of a sight that has been linearised.
#[must_use]
pub fn seen_by_rig(
    rig: &StereoRig,
    from: &Viewpoint,
    y: &Vector3<f64>,
    seen: &Sight,
) -> SMatrix<f64, 4, RIG_PARAMETERS> {
    let [left, right] = from.of_cameras(y);
    let turned = right - rig.right_from_left.translation.vector * y.z;
    let mut by = SMatrix::<f64, 4, RIG_PARAMETERS>::zeros();
    by.fixed_view_mut::<2, CAMERA_PARAMETERS>(0, 0)
        .copy_from(&pixel_by_parameters(&rig.left, &(left.xy() / left.z)));
    by.fixed_view_mut::<2, CAMERA_PARAMETERS>(2, CAMERA_PARAMETERS)
        .copy_from(&pixel_by_parameters(&rig.right, &(right.xy() / right.z)));
    by.fixed_view_mut::<2, 3>(2, EXTRINSICS)
        .copy_from(&(seen.right_by_ray * y.z));
    // exp(r) turns the point before the baseline is added.
    by.fixed_view_mut::<2, 3>(2, EXTRINSICS + 3)
        .copy_from(&product(&seen.right_by_ray, &-so3::hat(&turned)));
    by
}

/// By how much the same sight moves, px/s, with the time by which the right image is exposed after
/// the left one, the rig moving with `twist` (camera frame, m/s and rad/s).
///
/// `None` where a camera cannot see the point.
#[must_use]
pub fn sight_by_skew(
    rig: &StereoRig,
    from: &Viewpoint,
    y: &Vector3<f64>,
    twist: &Vector6<f64>,
) -> Option<Vector4<f64>> {
    Some(seen_by_skew(&from.linearise(rig, y)?, twist))
}

/// [`sight_by_skew`] of a sight that has been linearised.
#[must_use]
pub fn seen_by_skew(seen: &Sight, twist: &Vector6<f64>) -> Vector4<f64> {
    let mut by = product(&seen.by_motion, twist);
    by[0] = 0.0;
    by[1] = 0.0;
    by
}

/// The derivative of a motion by the rig's parameters, and by the skew of its exposures, s.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct MotionSensitivity {
    /// By the rig's parameters, in the order of [`rig_parameters`](crate::geometry::rig_parameters).
    pub by_rig: Sensitivity<RIG_PARAMETERS>,
    /// By the time that the right image is exposed after the left one, s.
    pub by_skew: Sensitivity<1>,
}

impl MotionSensitivity {
    /// That of the pose after one more motion.
    #[must_use]
    pub fn chain(&self, prev_from_now: &Isometry3<f64>, motion: &Self) -> Self {
        Self {
            by_rig: self.by_rig.chain(prev_from_now, &motion.by_rig),
            by_skew: self.by_skew.chain(prev_from_now, &motion.by_skew),
        }
    }
}

/// How a motion moves with the rig's errors. `tracks` are those that it rests on with what their
/// pixels do to it; twists are the camera's velocities at the earlier pair and now, m/s and rad/s.
///
/// `None` where a camera cannot see a point.
#[must_use]
pub fn of_motion<'a>(
    rig: &StereoRig,
    prev_from_now: &Isometry3<f64>,
    tracks: impl Iterator<Item = (&'a TrackedPoint, &'a Influence)>,
    twist_prev: &Vector6<f64>,
    twist_now: &Vector6<f64>,
) -> Option<MotionSensitivity> {
    let before = Viewpoint::unmoved(rig);
    let now = Viewpoint::new(rig, &prev_from_now.inverse());
    let mut by_rig = SMatrix::<f64, 6, RIG_PARAMETERS>::zeros();
    let mut by_skew = Vector6::zeros();
    for (point, influence) in tracks {
        let y = &point.inverse_depth;
        for (from, influence, twist) in [
            (&before, &influence.by_prev, twist_prev),
            (&now, &influence.by_now, twist_now),
        ] {
            let seen = from.linearise(rig, y)?;
            by_rig += product(influence, &seen_by_rig(rig, from, y, &seen));
            by_skew += influence * seen_by_skew(&seen, twist);
        }
    }
    Some(MotionSensitivity {
        by_rig: Sensitivity::new(by_rig),
        by_skew: Sensitivity::new(SMatrix::from(by_skew)),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimation::two_frame::{Estimator, TwoFrame};
    use crate::estimation::{Model, seen_at, synthetic};
    use crate::geometry::rig_parameters::RigVector;
    use crate::geometry::{parse_rig, se3};
    use proptest::prelude::*;

    fn rig() -> StereoRig {
        parse_rig(
            "left = { width = 640, height = 480, focal = [885.8, 884.1], principal_point = [313.2, 243.5], distortion = { model = \"radtan\", coefficients = [-0.25, 0.1, 0.0005, -0.0003, 0.01, 0.02, 0.03, 0.01] } }
             right = { width = 640, height = 480, focal = [882.9, 881.2], principal_point = [300.2, 246.4], distortion = { model = \"equidistant\", coefficients = [-0.01, 0.02, -0.01, 0.002] } }
             right_from_left = { translation_m = [-0.3857, -0.0072, 0.0001], rotation_vector_rad = [0.04046, 0.01616, 0.01419] }",
        )
        .expect("valid")
    }

    /// Exact sights of some points by another rig than the estimator knows, the right images exposed
    /// `skew_s` late.
    fn seen_by(
        truth: &StereoRig,
        prev_from_now: &Isometry3<f64>,
        points: &[TrackedPoint],
        skew_s: f64,
    ) -> Vec<TrackedPoint> {
        let late = se3::exp(&(twist() * skew_s));
        let sight = |prev_from_camera: &Isometry3<f64>, y: &Vector3<f64>| {
            let left = seen_at(truth, &prev_from_camera.inverse(), y).expect("in front");
            let right = seen_at(truth, &(prev_from_camera * late).inverse(), y).expect("in front");
            Vector4::new(left[0], left[1], right[2], right[3])
        };
        let mut seen = points.to_vec();
        for p in &mut seen {
            p.prev.px = sight(&Isometry3::identity(), &p.inverse_depth);
            p.now.px = sight(prev_from_now, &p.inverse_depth);
        }
        seen
    }

    fn twist() -> Vector6<f64> {
        Vector6::new(0.3, -0.1, 3.0, 0.1, 0.4, -0.05)
    }

    #[test]
    fn motions_move_with_the_rig_and_the_skew_as_central_differences_say() {
        let rig = synthetic::rig();
        let step = synthetic::step();
        let points = synthetic::tracks(
            &rig,
            &step,
            25,
            [2.0, 10.0],
            0.0,
            &mut synthetic::random(61),
        );
        for estimator in [Estimator::Bundle, Estimator::Svd, Estimator::Weighted] {
            let mut two_frame = TwoFrame::new(estimator, Model::Se3, 1e9);
            let mut solve = |points: &[TrackedPoint]| {
                two_frame.estimate(&rig, &step, points).expect("determined")
            };
            let base = solve(&seen_by(&rig, &step, &points, 0.0));
            assert_eq!(base.tracks.len(), points.len());
            let exact = of_motion(
                &rig,
                &step,
                points.iter().zip(&base.influences),
                &twist(),
                &twist(),
            )
            .expect("in front");
            let log =
                |found: &Isometry3<f64>| se3::log(&(base.estimate.prev_from_now.inverse() * found));
            let mut check =
                |what: String, by: Vector6<f64>, h: f64, at: &dyn Fn(f64) -> Vec<TrackedPoint>| {
                    let plus = log(&solve(&at(h)).estimate.prev_from_now);
                    let minus = log(&solve(&at(-h)).estimate.prev_from_now);
                    let numeric = (plus - minus) / (2.0 * h);
                    let gap = (numeric - by).norm();
                    assert!(
                        gap < 1e-5 * (by.norm() + 1e-4 / h * 1e-3),
                        "{estimator:?} {what}: {numeric} {by}"
                    );
                };
            for (name, j) in rig.parameter_names() {
                let h = if j < EXTRINSICS && j % CAMERA_PARAMETERS < 4 {
                    1e-2
                } else {
                    1e-5
                };
                let by = exact.by_rig.by_parameters().column(j).into_owned();
                check(name, by, h, &|error: f64| {
                    let mut c = RigVector::zeros();
                    c[j] = error;
                    seen_by(&rig.with_error(&c), &step, &points, 0.0)
                });
            }
            let by = exact.by_skew.by_parameters().column(0).into_owned();
            check("skew".to_owned(), by, 1e-5, &|skew| {
                seen_by(&rig, &step, &points, skew)
            });
        }
    }

    proptest! {
        #[test]
        fn sights_move_with_the_rig_as_central_differences_say(
            x in -0.3..0.3_f64, v in -0.25..0.25_f64, rho in 0.0..0.5_f64,
            xi in prop::array::uniform6(-0.1..0.1_f64),
        ) {
            let rig = rig();
            let now_from_prev = se3::exp(&Vector6::from(xi));
            let y = Vector3::new(x, v, rho);
            let exact = sight_by_rig(&rig, &Viewpoint::new(&rig, &now_from_prev), &y).expect("in front");
            for j in 0..RIG_PARAMETERS {
                // Pixels hardly notice 1e-4 of a focal length, and much of a coefficient.
                let step = if j < EXTRINSICS && j % CAMERA_PARAMETERS < 4 { 1e-2 } else { 1e-5 };
                let at = |sign: f64| {
                    let mut error = RigVector::zeros();
                    error[j] = sign * step;
                    seen_at(&rig.with_error(&error), &now_from_prev, &y).expect("in front")
                };
                let numeric = (at(1.0) - at(-1.0)) / (2.0 * step);
                let scale = exact.column(j).norm().max(1e-2);
                prop_assert!((numeric - exact.column(j)).norm() < 1e-6 * scale, "{j} {numeric} {}", exact.column(j));
            }
        }

        #[test]
        fn sights_move_with_the_skew_as_central_differences_say(
            x in -0.3..0.3_f64, v in -0.25..0.25_f64, rho in 0.0..0.5_f64,
            twist in prop::array::uniform6(-1.0..1.0_f64),
        ) {
            let rig = rig();
            let prev_from_now = se3::exp(&Vector6::new(0.1, 0.0, 0.2, 0.0, 0.05, 0.0));
            let (y, twist) = (Vector3::new(x, v, rho), Vector6::from(twist));
            let from = Viewpoint::new(&rig, &prev_from_now.inverse());
            let exact = sight_by_skew(&rig, &from, &y, &twist).expect("in front");
            let h = 1e-5;
            let at = |dt: f64| {
                let later = prev_from_now * se3::exp(&(twist * dt));
                let left = seen_at(&rig, &prev_from_now.inverse(), &y).expect("in front");
                let right = seen_at(&rig, &later.inverse(), &y).expect("in front");
                Vector4::new(left[0], left[1], right[2], right[3])
            };
            let numeric = (at(h) - at(-h)) / (2.0 * h);
            prop_assert!((numeric - exact).norm() < 1e-6 * (1.0 + exact.norm()));
        }
    }
}
