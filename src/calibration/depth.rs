//! A rig's covariance in, the error of depths that it leads to out.
//!
//! A point's pixels stay where they were measured; where the rig is in error, the point is triangulated elsewhere. With
//! `f(point, rig)` the four pixels, `dpoint = −(Jₚᵀ Jₚ)⁻¹ Jₚᵀ Jᵣ drig`.

use crate::geometry::StereoRig;
use crate::geometry::rig_parameters::{
    CAMERA_PARAMETERS, EXTRINSICS, RIG_PARAMETERS, RigCovariance, pixel_by_parameters,
};
use crate::geometry::so3;
use nalgebra::{Point3, SMatrix, Vector2, Vector3};

/// The error of a depth.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct DepthError {
    /// The depth, m.
    pub depth_m: f64,
    /// 1 σ from the rig's parameters, m.
    pub sigma_rig_m: f64,
    /// 1 σ from measuring pixels to a tenth, m, for comparison.
    pub sigma_tenth_px_m: f64,
}

/// The error of the depth of a point in the middle of the left image. `None` where the right camera does not see it.
#[must_use]
pub fn depth_error(
    rig: &StereoRig,
    covariance: &RigCovariance,
    depth_m: f64,
) -> Option<DepthError> {
    let middle = Vector2::new(
        f64::from(rig.left.width) - 1.0,
        f64::from(rig.left.height) - 1.0,
    ) * 0.5;
    let point = Point3::from(rig.left.ray(&middle)? * depth_m);
    let (px, by_point) = rig.project_with_jacobian(&point)?;
    rig.right
        .contains(&px.fixed_rows::<2>(2).into(), 0.0)
        .then_some(())?;
    let by_rig = by_rig(rig, &point)?;
    let towards = (by_point.transpose() * by_point).try_inverse()? * by_point.transpose();
    let row = towards.row(2).into_owned();
    let along = row * by_rig;
    Some(DepthError {
        depth_m,
        sigma_rig_m: (along * covariance * along.transpose())[0].max(0.0).sqrt(),
        sigma_tenth_px_m: 0.1 * row.norm(),
    })
}

/// By how much a point's four pixels move with the rig's slots.
fn by_rig(rig: &StereoRig, point: &Point3<f64>) -> Option<SMatrix<f64, 4, RIG_PARAMETERS>> {
    let in_right = rig.right_from_left * point;
    let (_, by_right_point) = rig.right.project_with_jacobian(&in_right)?;
    let on_plane = |p: &Point3<f64>| Vector2::new(p.x / p.z, p.y / p.z);
    let mut by = SMatrix::<f64, 4, RIG_PARAMETERS>::zeros();
    by.fixed_view_mut::<2, CAMERA_PARAMETERS>(0, 0)
        .copy_from(&pixel_by_parameters(&rig.left, &on_plane(point)));
    by.fixed_view_mut::<2, CAMERA_PARAMETERS>(2, CAMERA_PARAMETERS)
        .copy_from(&pixel_by_parameters(&rig.right, &on_plane(&in_right)));
    let turned: Vector3<f64> = rig.right_from_left.rotation * point.coords;
    by.fixed_view_mut::<2, 3>(2, EXTRINSICS)
        .copy_from(&by_right_point);
    by.fixed_view_mut::<2, 3>(2, EXTRINSICS + 3)
        .copy_from(&(-by_right_point * so3::hat(&turned)));
    Some(by)
}

/// Depths at which the error is stated, m.
pub const DEPTHS_M: [f64; 6] = [2.0, 5.0, 10.0, 20.0, 30.0, 40.0];

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimation::{StereoMeasurement, triangulate};
    use crate::geometry::rig_parameters::RigVector;
    use nalgebra::Vector4;
    use rand::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};

    #[test]
    fn depths_spread_as_stated_when_the_rig_does() {
        let rig = crate::simulation::thesis_rig();
        let mut sigmas = RigVector::zeros();
        for (slot, sigma) in [
            (0, 0.3),
            (2, 0.4),
            (12, 0.3),
            (14, 0.4),
            (24, 2e-4),
            (28, 5e-5),
        ] {
            sigmas[slot] = sigma;
        }
        let covariance = RigCovariance::from_diagonal(&sigmas.component_mul(&sigmas));
        let stated = depth_error(&rig, &covariance, 10.0).expect("seen");
        let middle = Vector2::new(
            f64::from(rig.left.width) - 1.0,
            f64::from(rig.left.height) - 1.0,
        ) * 0.5;
        let point = Point3::from(rig.left.ray(&middle).expect("a ray") * 10.0);
        let px: Vector4<f64> = rig.project(&point).expect("seen");
        let mut random = rand_xoshiro::Xoshiro256PlusPlus::seed_from_u64(5);
        let runs = 2000;
        let mut squares = 0.0;
        for _ in 0..runs {
            let error = sigmas.map(|sigma| {
                let unit: f64 = StandardNormal.sample(&mut random);
                sigma * unit
            });
            let measured = StereoMeasurement {
                px,
                sigma_px: Vector4::repeat(1.0),
            };
            let landmark = triangulate(&rig.with_error(&error), &measured).expect("triangulates");
            squares += (landmark.point.z - 10.0).powi(2);
        }
        let found = (squares / f64::from(runs)).sqrt();
        // 1 σ of a standard deviation of 2000 is 1.6 %.
        assert!(
            (found / stated.sigma_rig_m - 1.0).abs() < 0.06,
            "{found} {stated:?}"
        );
        assert!(stated.sigma_tenth_px_m > 0.0);
    }
}
