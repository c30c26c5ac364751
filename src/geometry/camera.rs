//! One camera: a pinhole with lens distortion, from points to raw pixels and back.

use super::Distortion;
use super::product::product;
use nalgebra::{Matrix2, Matrix2x3, Point3, Vector2, Vector3};

/// A calibrated camera. Pixels are raw: distorted, unrectified, centres at integers.
#[derive(Clone, Debug, PartialEq)]
pub struct Camera {
    /// Image width, px.
    pub width: u32,
    /// Image height, px.
    pub height: u32,
    /// Focal lengths in x and y, px.
    pub focal_px: Vector2<f64>,
    /// Where the optical axis meets the image, px.
    pub principal_point_px: Vector2<f64>,
    distortion: Distortion,
    max_radius: f64,
}

/// Points nearer than this to the camera's plane, m, are not projected.
const MIN_DEPTH_M: f64 = 1e-6;

impl Camera {
    /// A camera with its lens.
    #[must_use]
    pub fn new(
        width: u32,
        height: u32,
        focal_px: Vector2<f64>,
        principal_point_px: Vector2<f64>,
        distortion: Distortion,
    ) -> Self {
        let max_radius = distortion.max_radius();
        Self {
            width,
            height,
            focal_px,
            principal_point_px,
            distortion,
            max_radius,
        }
    }

    /// The lens.
    #[must_use]
    pub fn distortion(&self) -> &Distortion {
        &self.distortion
    }

    /// The pixel at which `point` (m, camera frame) is seen, inside the image or not.
    ///
    /// `None` behind the camera and where the distortion model folds back.
    #[must_use]
    #[inline]
    pub fn project(&self, point: &Point3<f64>) -> Option<Vector2<f64>> {
        let normalised = self.normalise(point)?;
        let distorted = self.distortion.distort(&normalised);
        Some(distorted.component_mul(&self.focal_px) + self.principal_point_px)
    }

    /// [`project`](Self::project) with the derivative of the pixel by the point, px/m.
    #[must_use]
    #[inline]
    pub fn project_with_jacobian(
        &self,
        point: &Point3<f64>,
    ) -> Option<(Vector2<f64>, Matrix2x3<f64>)> {
        let normalised = self.normalise(point)?;
        let (distorted, by_normalised) = self.distortion.distort_with_jacobian(&normalised);
        let inv_z = 1.0 / point.z;
        let scale = self.focal_px * inv_z;
        let by_ray = [
            by_normalised.column(0).into_owned(),
            by_normalised.column(1).into_owned(),
            -product(&by_normalised, &normalised),
        ];
        Some((
            distorted.component_mul(&self.focal_px) + self.principal_point_px,
            Matrix2x3::from_columns(&by_ray.map(|by| by.component_mul(&scale))),
        ))
    }

    /// The rays through pixels that are spread evenly over the image, five across and five down, row by
    /// row; left out where the lens' model has no inverse.
    pub fn spread_rays(&self) -> impl Iterator<Item = Vector2<f64>> + '_ {
        const GRID: u32 = 5;
        let share = |n: u32| (f64::from(n) + 0.5) / f64::from(GRID);
        (0..GRID * GRID).filter_map(move |i| {
            self.unproject(&Vector2::new(
                share(i % GRID) * f64::from(self.width),
                share(i / GRID) * f64::from(self.height),
            ))
        })
    }

    /// The position on the normalised plane (z = 1) that is seen at `pixel`, undistorted.
    ///
    /// `None` where the distortion model has no inverse.
    #[must_use]
    pub fn unproject(&self, pixel: &Vector2<f64>) -> Option<Vector2<f64>> {
        let distorted = (pixel - self.principal_point_px).component_div(&self.focal_px);
        self.distortion.undistort(&distorted, self.max_radius)
    }

    /// [`unproject`](Self::unproject) with the derivative of the position by the pixel, 1/px.
    #[must_use]
    pub fn unproject_with_jacobian(
        &self,
        pixel: &Vector2<f64>,
    ) -> Option<(Vector2<f64>, Matrix2<f64>)> {
        let normalised = self.unproject(pixel)?;
        let (_, by_normalised) = self.distortion.distort_with_jacobian(&normalised);
        let jacobian = (Matrix2::from_diagonal(&self.focal_px) * by_normalised).try_inverse()?;
        Some((normalised, jacobian))
    }

    /// The direction (camera frame, not normalised, z = 1) that is seen at `pixel`.
    #[must_use]
    pub fn ray(&self, pixel: &Vector2<f64>) -> Option<Vector3<f64>> {
        self.unproject(pixel).map(|n| n.push(1.0))
    }

    /// Whether a pixel lies in the image, at least `margin_px` from its border pixels' centres.
    #[must_use]
    pub fn contains(&self, pixel: &Vector2<f64>, margin_px: f64) -> bool {
        pixel.x >= margin_px
            && pixel.y >= margin_px
            && pixel.x <= f64::from(self.width) - 1.0 - margin_px
            && pixel.y <= f64::from(self.height) - 1.0 - margin_px
    }

    #[inline]
    fn normalise(&self, point: &Point3<f64>) -> Option<Vector2<f64>> {
        if point.z.is_nan() || point.z < MIN_DEPTH_M {
            return None;
        }
        let normalised = Vector2::new(point.x / point.z, point.y / point.z);
        (normalised.norm_squared() <= self.max_radius * self.max_radius).then_some(normalised)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// A pinhole, OpenCV's three usual lengths of radtan, and a fisheye.
    fn cameras() -> Vec<Camera> {
        let lenses = [
            Distortion::None,
            Distortion::Radtan([-0.28, 0.07, 0.0002, -0.00002, 0.0, 0.0, 0.0, 0.0]),
            Distortion::Radtan([-0.25, 0.10, 0.0005, -0.0003, -0.02, 0.0, 0.0, 0.0]),
            Distortion::Radtan([0.3, 0.05, 0.0005, -0.0003, 0.01, 0.55, 0.12, 0.02]),
            Distortion::Equidistant([-0.013, 0.02, -0.012, 0.0025]),
        ];
        lenses
            .into_iter()
            .map(|lens| {
                Camera::new(
                    752,
                    480,
                    Vector2::new(458.654, 457.296),
                    Vector2::new(367.215, 248.375),
                    lens,
                )
            })
            .collect()
    }

    proptest! {
        #[test]
        fn unproject_undoes_project(x in 0.0..751.0_f64, y in 0.0..479.0_f64, z in 0.1..50.0_f64) {
            for camera in cameras() {
                let pixel = Vector2::new(x, y);
                let ray = camera.ray(&pixel).expect("inside the image");
                let seen = camera.project(&Point3::from(ray * z)).expect("in front");
                prop_assert!((seen - pixel).norm() < 1e-7, "{camera:?} {pixel} {seen}");
            }
        }

        #[test]
        fn projection_jacobian_matches_central_differences(
            x in -0.7..0.7_f64, y in -0.45..0.45_f64, z in 0.5..20.0_f64
        ) {
            for camera in cameras() {
                let point = Point3::new(x * z, y * z, z);
                let (_, jacobian) = camera.project_with_jacobian(&point).expect("in front");
                let step = 1e-5 * z;
                for j in 0..3 {
                    let mut d = Vector3::zeros();
                    d[j] = step;
                    let plus = camera.project(&(point + d)).expect("in front");
                    let minus = camera.project(&(point - d)).expect("in front");
                    let numeric = (plus - minus) / (2.0 * step);
                    prop_assert!((numeric - jacobian.column(j)).norm() < 1e-6 * jacobian.norm());
                }
            }
        }

        #[test]
        fn unprojection_jacobian_matches_central_differences(
            x in 1.0..750.0_f64, y in 1.0..478.0_f64
        ) {
            for camera in cameras() {
                let pixel = Vector2::new(x, y);
                let (_, jacobian) = camera.unproject_with_jacobian(&pixel).expect("inside");
                let step = 1e-3;
                for j in 0..2 {
                    let mut d = Vector2::zeros();
                    d[j] = step;
                    let plus = camera.unproject(&(pixel + d)).expect("inside");
                    let minus = camera.unproject(&(pixel - d)).expect("inside");
                    let numeric = (plus - minus) / (2.0 * step);
                    prop_assert!((numeric - jacobian.column(j)).norm() < 1e-6 * jacobian.norm());
                }
            }
        }
    }

    #[test]
    fn equidistant_small_radius_joins_smoothly() {
        let lens = Distortion::Equidistant([-0.3, 0.2, -0.1, 0.05]);
        let at = |r: f64| lens.distort(&Vector2::new(r, 0.0)).x / r;
        assert!((at(1e-4 - 1e-12) - at(1e-4 + 1e-12)).abs() < 1e-15);
    }

    #[test]
    fn a_point_beyond_the_fold_is_not_imaged() {
        // With k1 = −0.25 the radial polynomial turns back at r = 1.15.
        let camera = Camera::new(
            640,
            480,
            Vector2::new(400.0, 400.0),
            Vector2::new(320.0, 240.0),
            Distortion::Radtan([-0.25, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]),
        );
        assert!(camera.project(&Point3::new(1.1, 0.0, 1.0)).is_some());
        assert!(camera.project(&Point3::new(1.9, 0.0, 1.0)).is_none());
        assert!(camera.project(&Point3::new(0.0, 0.0, -1.0)).is_none());
        assert!(camera.project(&Point3::new(0.0, 0.0, f64::NAN)).is_none());
    }

    #[test]
    fn the_top_left_pixel_has_its_centre_at_zero() {
        let camera = &cameras()[0];
        assert!(camera.contains(&Vector2::new(0.0, 0.0), 0.0));
        assert!(camera.contains(&Vector2::new(751.0, 479.0), 0.0));
        assert!(!camera.contains(&Vector2::new(751.1, 479.0), 0.0));
        assert!(!camera.contains(&Vector2::new(-0.1, 0.0), 0.0));
    }
}
