//! Where a raw pixel would lie if the rig were rectified: of points only, no image is resampled.
//!
//! In these coordinates a left and a right sight of one point share their row, and differ in the
//! column by the disparity. They serve to search for matches and to tell near from far; estimates
//! are made in raw pixels.

use super::{Camera, StereoRig};
use nalgebra::{Matrix3, Rotation3, Vector2, Vector3};

/// The rotations that bring both cameras of a rig to a common image plane along the baseline.
#[derive(Clone, Debug)]
pub struct Rectification {
    left: Camera,
    right: Camera,
    common_from_left: Rotation3<f64>,
    common_from_right: Rotation3<f64>,
    focal_px: f64,
    baseline_m: f64,
}

impl Rectification {
    /// The rectification of a rig. `None` if the baseline is zero or lies along the view.
    #[must_use]
    pub fn new(rig: &StereoRig) -> Option<Self> {
        let left_from_right = rig.right_from_left.inverse();
        // x runs from the left camera's centre to the right one's; z is the mean view made
        // perpendicular to it.
        let baseline = left_from_right.translation.vector;
        let x = baseline.try_normalize(1e-12)?;
        let view = Vector3::z() + left_from_right.rotation * Vector3::z();
        let z = (view - x * view.dot(&x)).try_normalize(1e-6)?;
        let y = z.cross(&x);
        let common_from_left =
            Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[x, y, z]).transpose());
        let common_from_right = common_from_left * left_from_right.rotation.to_rotation_matrix();
        let focal_px = 0.25 * (rig.left.focal_px.sum() + rig.right.focal_px.sum());
        Some(Self {
            left: rig.left.clone(),
            right: rig.right.clone(),
            common_from_left,
            common_from_right,
            focal_px,
            baseline_m: baseline.norm(),
        })
    }

    /// The focal length of the rectified plane, px.
    #[must_use]
    pub fn focal_px(&self) -> f64 {
        self.focal_px
    }

    /// Turns directions of the left camera into the common frame.
    #[must_use]
    pub fn common_from_left(&self) -> &Rotation3<f64> {
        &self.common_from_left
    }

    /// Turns directions of the right camera into the common frame.
    #[must_use]
    pub fn common_from_right(&self) -> &Rotation3<f64> {
        &self.common_from_right
    }

    /// The disparity, px, of a point `depth_m` in front of the rectified plane's origin.
    #[must_use]
    pub fn disparity_px(&self, depth_m: f64) -> f64 {
        self.focal_px * self.baseline_m / depth_m
    }

    /// The depth, m, that belongs to a disparity above 0.
    #[must_use]
    pub fn depth_m(&self, disparity_px: f64) -> f64 {
        self.focal_px * self.baseline_m / disparity_px
    }

    /// A raw pixel of the left camera on the rectified plane, px from the plane's own origin.
    #[must_use]
    pub fn left(&self, raw_px: &Vector2<f64>) -> Option<Vector2<f64>> {
        self.rectify(&self.left, &self.common_from_left, raw_px)
    }

    /// A raw pixel of the right camera on the rectified plane, px from the plane's own origin.
    #[must_use]
    pub fn right(&self, raw_px: &Vector2<f64>) -> Option<Vector2<f64>> {
        self.rectify(&self.right, &self.common_from_right, raw_px)
    }

    /// The raw pixel of the right camera that lies at `rectified_px`: the reverse of [`right`](Self::right).
    #[must_use]
    pub fn raw_right(&self, rectified_px: &Vector2<f64>) -> Option<Vector2<f64>> {
        let ray = Vector3::new(rectified_px.x, rectified_px.y, self.focal_px);
        let point = self.common_from_right.inverse_transform_vector(&ray);
        self.right.project(&point.into())
    }

    fn rectify(
        &self,
        camera: &Camera,
        common_from_camera: &Rotation3<f64>,
        raw_px: &Vector2<f64>,
    ) -> Option<Vector2<f64>> {
        let ray = common_from_camera * camera.ray(raw_px)?;
        (ray.z > 1e-3).then(|| Vector2::new(ray.x, ray.y) * (self.focal_px / ray.z))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::parse_rig;
    use nalgebra::Point3;
    use proptest::prelude::*;

    const TOED_AND_ROLLED: &str = r#"
        [left]
        width = 1280
        height = 960
        focal = [1771.63666, 1768.21228]
        principal_point = [626.3761, 486.9874]
        distortion = { model = "radtan", coefficients = [-0.25, 0.10, 0.0005, -0.0003, 0.0] }
        [right]
        width = 1280
        height = 960
        focal = [1765.87472, 1762.3608]
        principal_point = [600.39562, 492.79666]
        distortion = { model = "radtan", coefficients = [-0.24, 0.09, -0.0002, 0.0001, 0.0] }
        [right_from_left]
        translation_m = [-0.3857, -0.0072, 0.0001]
        rotation_vector_rad = [0.04046, 0.01616, 0.01419]
    "#;

    proptest! {
        #[test]
        fn both_sights_of_a_point_share_their_row_and_differ_by_its_disparity(
            x in -0.25..0.25_f64, y in -0.2..0.2_f64, z in 1.5..80.0_f64
        ) {
            let rig = parse_rig(TOED_AND_ROLLED).expect("valid");
            let rectification = Rectification::new(&rig).expect("has a baseline");
            let point = Point3::new(x * z, y * z, z);
            let seen = rig.project(&point).expect("in front");
            let left = rectification.left(&Vector2::new(seen[0], seen[1])).expect("inside");
            let right = rectification.right(&Vector2::new(seen[2], seen[3])).expect("inside");
            prop_assert!((left.y - right.y).abs() < 1e-8);
            let depth = (rectification.common_from_left * point.coords).z;
            prop_assert!((left.x - right.x - rectification.disparity_px(depth)).abs() < 1e-8);
            let raw = rectification.raw_right(&right).expect("in front");
            prop_assert!((raw - seen.fixed_rows::<2>(2)).norm() < 1e-8);
        }

        #[test]
        fn rig_jacobian_matches_central_differences(
            x in -0.25..0.25_f64, y in -0.2..0.2_f64, z in 1.5..80.0_f64
        ) {
            let rig = parse_rig(TOED_AND_ROLLED).expect("valid");
            let point = Point3::new(x * z, y * z, z);
            let (_, jacobian) = rig.project_with_jacobian(&point).expect("in front");
            let step = 1e-5 * z;
            for j in 0..3 {
                let mut d = Vector3::zeros();
                d[j] = step;
                let plus = rig.project(&(point + d)).expect("in front");
                let minus = rig.project(&(point - d)).expect("in front");
                let numeric = (plus - minus) / (2.0 * step);
                prop_assert!((numeric - jacobian.column(j)).norm() < 1e-6 * jacobian.norm());
            }
        }
    }
}
