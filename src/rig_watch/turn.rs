//! A small turn of the right camera about its own optical centre: what it does to pixels.
//!
//! A direction m that the camera saw is seen at `Exp(r) m` when it has turned by −r, as a rig whose
//! `right_from_left` is `Exp(r) R` has; r about the right camera's axes, rad. How far things are does not matter.

use crate::geometry::{Camera, Rectification, so3};
use nalgebra::{Matrix2x3, Point3, RowVector3, Vector2, Vector3};

/// The derivative of a raw pixel of a camera by its turn, px/rad. `None` where the pixel has no ray.
#[must_use]
pub fn px_by_turn(camera: &Camera, px: &Vector2<f64>) -> Option<Matrix2x3<f64>> {
    let ray: Vector3<f64> = camera.unproject(px)?.push(1.0);
    let (_, by_point) = camera.project_with_jacobian(&Point3::from(ray))?;
    Some(by_point * -so3::hat(&ray))
}

/// The derivative of the rectified row of a right sight by the turn, px/rad; `rectified_px` is where it lies
/// on the rectified plane.
#[must_use]
pub fn row_by_turn(rectification: &Rectification, rectified_px: &Vector2<f64>) -> RowVector3<f64> {
    let focal_px = rectification.focal_px();
    let (x, y) = (rectified_px.x / focal_px, rectified_px.y / focal_px);
    let by_common = RowVector3::new(-(1.0 + y * y), x * y, x) * focal_px;
    by_common * rectification.common_from_right().matrix()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{StereoRig, parse_rig};
    use proptest::prelude::*;

    fn rig() -> StereoRig {
        parse_rig(
            "left = { width = 1280, height = 960, focal = [1771.6, 1768.2], principal_point = [626.4, 487.0], distortion = { model = \"radtan\", coefficients = [-0.25, 0.1, 0.0005, -0.0003, 0.0] } }
             right = { width = 1280, height = 960, focal = [1765.9, 1762.4], principal_point = [600.4, 492.8], distortion = { model = \"radtan\", coefficients = [-0.24, 0.09, -0.0002, 0.0001, 0.0] } }
             right_from_left = { translation_m = [-0.3857, -0.0072, 0.0001], rotation_vector_rad = [0.04046, 0.01616, 0.01419] }",
        )
        .expect("valid")
    }

    proptest! {
        #[test]
        fn derivatives_are_the_central_differences(x in -0.3..0.3_f64, y in -0.25..0.25_f64) {
            let rig = rig();
            let rectification = Rectification::new(&rig).expect("has a baseline");
            let ray = Vector3::new(x, y, 1.0);
            let px = rig.right.project(&Point3::from(ray)).expect("in front");
            let by_px = px_by_turn(&rig.right, &px).expect("has a ray");
            let by_row = row_by_turn(&rectification, &rectification.right(&px).expect("inside"));
            let h = 1e-6;
            for axis in 0..3 {
                let turned = |by: f64| {
                    let mut r = Vector3::zeros();
                    r[axis] = by;
                    rig.right.project(&Point3::from(so3::exp(&r) * ray)).expect("in front")
                };
                let (plus, minus) = (turned(h), turned(-h));
                let numeric = (plus - minus) / (2.0 * h);
                prop_assert!((numeric - by_px.column(axis)).norm() < 1e-5 * by_px.norm());
                let row = |px: &Vector2<f64>| rectification.right(px).expect("inside").y;
                let numeric = (row(&plus) - row(&minus)) / (2.0 * h);
                prop_assert!((numeric - by_row[axis]).abs() < 1e-4 * by_row.norm());
            }
        }
    }
}
