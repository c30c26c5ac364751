//! Where a stereo rig sees a point that is given in inverse depth, from where it was or from where
//! it is now.
//!
//! A point (x, y, ρ) is (x, y, 1) / ρ in the earlier left camera: ρ in 1/m, 0 at infinity. A pixel
//! depends on a point's direction alone, so everything is computed on the point times ρ, which is
//! finite everywhere.

use super::StereoMeasurement;
use crate::geometry::product::{product, transposed_scaled};
use crate::geometry::{StereoRig, so3};
use nalgebra::{Isometry3, Matrix2x3, Matrix3, Matrix4x3, Point3, SMatrix, Vector3, Vector4};

/// A sight, linearised.
#[derive(Clone, Copy, Debug)]
pub struct Sight {
    /// (ul, vl, ur, vr), px.
    pub px: Vector4<f64>,
    /// By (x, y, ρ).
    pub by_point: Matrix4x3<f64>,
    /// By a right perturbation of `prev_from_now` (translation, rotation).
    pub by_motion: SMatrix<f64, 4, 6>,
    /// By the point times ρ in the right camera, of what that sees.
    pub(super) right_by_ray: Matrix2x3<f64>,
}

/// Where a rig has gone: made once, then asked for many points.
#[derive(Clone, Copy, Debug)]
pub struct Viewpoint {
    left: ToCamera,
    right: ToCamera,
    right_from_left: Matrix3<f64>,
}

/// A point times ρ, in the frame of a camera: affine in (x, y, ρ).
#[derive(Clone, Copy, Debug)]
struct ToCamera {
    by_point: Matrix3<f64>,
    /// Where (0, 0, 0) comes out, straight ahead and infinitely far.
    ahead: Vector3<f64>,
}

impl ToCamera {
    #[inline(always)]
    fn apply(&self, y: &Vector3<f64>) -> Vector3<f64> {
        product(&self.by_point, y) + self.ahead
    }
}

impl Viewpoint {
    /// That of a rig that was moved: `now_from_prev` maps a point of the left camera where points are
    /// given in into the left camera where the rig is.
    #[must_use]
    pub fn new(rig: &StereoRig, now_from_prev: &Isometry3<f64>) -> Self {
        let rotation = now_from_prev.rotation.to_rotation_matrix();
        let right_from_left = rig.right_from_left.rotation.to_rotation_matrix();
        let left = ToCamera {
            by_point: Matrix3::from_columns(&[
                rotation.matrix().column(0).into_owned(),
                rotation.matrix().column(1).into_owned(),
                now_from_prev.translation.vector,
            ]),
            ahead: rotation.matrix().column(2).into_owned(),
        };
        let mut right = ToCamera {
            by_point: right_from_left * left.by_point,
            ahead: right_from_left * left.ahead,
        };
        let mut by_inverse_depth = right.by_point.column_mut(2);
        by_inverse_depth += rig.right_from_left.translation.vector;
        Self {
            left,
            right,
            right_from_left: *right_from_left.matrix(),
        }
    }

    /// That of a rig that has not moved.
    #[must_use]
    pub fn unmoved(rig: &StereoRig) -> Self {
        Self::new(rig, &Isometry3::identity())
    }

    /// The point times ρ, in the left camera and in the right one.
    #[inline]
    pub(super) fn of_cameras(&self, y: &Vector3<f64>) -> [Vector3<f64>; 2] {
        [self.left.apply(y), self.right.apply(y)]
    }

    /// Where `rig` sees the point `y` = (x, y, ρ) from there: (ul, vl, ur, vr), px. `None` where a
    /// camera cannot.
    #[must_use]
    #[inline]
    pub fn seen_at(&self, rig: &StereoRig, y: &Vector3<f64>) -> Option<Vector4<f64>> {
        let [left, right] = self.of_cameras(y);
        let l = rig.left.project(&Point3::from(left))?;
        let r = rig.right.project(&Point3::from(right))?;
        Some(Vector4::new(l.x, l.y, r.x, r.y))
    }

    /// [`seen_at`](Self::seen_at) with its derivatives.
    #[must_use]
    #[inline(always)]
    pub fn linearise(&self, rig: &StereoRig, y: &Vector3<f64>) -> Option<Sight> {
        let [left, right] = self.of_cameras(y);
        let (l_px, l_by) = rig.left.project_with_jacobian(&Point3::from(left))?;
        let (r_px, r_by) = rig.right.project_with_jacobian(&Point3::from(right))?;
        let l_by_point = product(&l_by, &self.left.by_point);
        let r_by_point = product(&r_by, &self.right.by_point);
        // The point now is Exp(−ξ) applied to it: −ρ · translation + [left]× · rotation.
        let turned = so3::hat(&left);
        let r_by_left = product(&r_by, &self.right_from_left);
        let (l_by_turn, r_by_turn) = (product(&l_by, &turned), product(&r_by_left, &turned));
        let mut by_point = Matrix4x3::zeros();
        let mut by_motion = SMatrix::<f64, 4, 6>::zeros();
        for axis in 0..3 {
            for row in 0..2 {
                by_point[(row, axis)] = l_by_point[(row, axis)];
                by_point[(2 + row, axis)] = r_by_point[(row, axis)];
                by_motion[(row, axis)] = l_by[(row, axis)] * -y.z;
                by_motion[(2 + row, axis)] = r_by_left[(row, axis)] * -y.z;
                by_motion[(row, 3 + axis)] = l_by_turn[(row, axis)];
                by_motion[(2 + row, 3 + axis)] = r_by_turn[(row, axis)];
            }
        }
        Some(Sight {
            px: Vector4::new(l_px.x, l_px.y, r_px.x, r_px.y),
            by_point,
            by_motion,
            right_by_ray: r_by,
        })
    }
}

/// Where the rig, moved by `now_from_prev`, sees the point `y` = (x, y, ρ): (ul, vl, ur, vr), px.
/// `None` where a camera cannot.
#[must_use]
pub fn seen_at(
    rig: &StereoRig,
    now_from_prev: &Isometry3<f64>,
    y: &Vector3<f64>,
) -> Option<Vector4<f64>> {
    Viewpoint::new(rig, now_from_prev).seen_at(rig, y)
}

/// [`seen_at`] with its derivatives.
#[must_use]
pub fn linearise(
    rig: &StereoRig,
    now_from_prev: &Isometry3<f64>,
    y: &Vector3<f64>,
) -> Option<Sight> {
    Viewpoint::new(rig, now_from_prev).linearise(rig, y)
}

/// Gauss–Newton steps of [`inverse_depth`]; it converges in two or three.
const MAX_STEPS: usize = 8;

/// The point (x, y, ρ) with the least reprojection error, weighted by σ, in both images. ρ may come
/// out a little below 0 where a point is so far that noise decides.
///
/// `None` where the sights do not meet in front of the cameras or a pixel has no ray.
#[must_use]
pub fn inverse_depth(rig: &StereoRig, measurement: &StereoMeasurement) -> Option<Vector3<f64>> {
    let here = Viewpoint::unmoved(rig);
    let mut y = starting_point(rig, measurement)?;
    let info = measurement.sigma_px.map(|s| 1.0 / (s * s));
    for _ in 0..MAX_STEPS {
        let seen = here.linearise(rig, &y)?;
        let weighted = transposed_scaled(&seen.by_point, &info);
        let step = product(&weighted, &seen.by_point)
            .cholesky()?
            .solve(&product(&weighted, &(measurement.px - seen.px)));
        y += step;
        if step.norm() <= 1e-12 * (1.0 + y.norm()) {
            break;
        }
    }
    y.iter().all(|v| v.is_finite()).then_some(y)
}

/// The left ray, and the ρ that brings it nearest to the right one: on the right normalised plane,
/// `(R m + ρ t)₁,₂ = n (R m + ρ t)₃` is linear in ρ.
fn starting_point(rig: &StereoRig, measurement: &StereoMeasurement) -> Option<Vector3<f64>> {
    let left = rig.left.unproject(&measurement.left_px())?;
    let right = rig.right.unproject(&measurement.right_px())?;
    let turned = rig.right_from_left.rotation * left.push(1.0);
    let t = rig.right_from_left.translation.vector;
    let by_rho = t.xy() - right * t.z;
    let constant = right * turned.z - turned.xy();
    let rho = by_rho.dot(&constant) / by_rho.norm_squared();
    Some(Vector3::new(left.x, left.y, rho))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{parse_rig, se3};
    use nalgebra::Vector6;
    use proptest::prelude::*;

    fn rig() -> StereoRig {
        parse_rig(
            "left = { width = 640, height = 480, focal = [885.81833, 884.10614], principal_point = [313.18805, 243.49370] }
             right = { width = 640, height = 480, focal = [882.93736, 881.18040], principal_point = [300.19781, 246.39833], distortion = { model = \"radtan\", coefficients = [-0.2, 0.1, 0.0005, -0.0003] } }
             right_from_left = { translation_m = [-0.3857, -0.0072, 0.0001], rotation_vector_rad = [0.04046, 0.01616, 0.01419] }",
        )
        .expect("valid")
    }

    proptest! {
        #[test]
        fn jacobians_match_central_differences(
            x in -0.3..0.3_f64, v in -0.25..0.25_f64, rho in 0.0..0.5_f64,
            xi in prop::array::uniform6(-0.1..0.1_f64),
        ) {
            let rig = rig();
            let prev_from_now = se3::exp(&Vector6::from(xi));
            let y = Vector3::new(x, v, rho);
            let exact = linearise(&rig, &prev_from_now.inverse(), &y).expect("in front");
            let at = |motion: &Isometry3<f64>, y: &Vector3<f64>| {
                seen_at(&rig, &motion.inverse(), y).expect("in front")
            };
            prop_assert!((at(&prev_from_now, &y) - exact.px).norm() < 1e-9);
            let h = 1e-6;
            for j in 0..6 {
                let mut d = Vector6::zeros();
                d[j] = h;
                let numeric = (at(&(prev_from_now * se3::exp(&d)), &y)
                    - at(&(prev_from_now * se3::exp(&-d)), &y)) / (2.0 * h);
                prop_assert!((numeric - exact.by_motion.column(j)).norm() < 1e-6 * exact.by_motion.norm());
            }
            for j in 0..3 {
                let mut d = Vector3::zeros();
                d[j] = h;
                let numeric = (at(&prev_from_now, &(y + d)) - at(&prev_from_now, &(y - d))) / (2.0 * h);
                prop_assert!((numeric - exact.by_point.column(j)).norm() < 1e-6 * exact.by_point.norm());
            }
        }

        #[test]
        fn inverse_depth_undoes_the_sight(x in -0.3..0.3_f64, v in -0.25..0.25_f64, rho in 0.0..1.0_f64) {
            let rig = rig();
            let y = Vector3::new(x, v, rho);
            let px = seen_at(&rig, &Isometry3::identity(), &y).expect("in front");
            let found = inverse_depth(&rig, &StereoMeasurement { px, sigma_px: Vector4::repeat(0.5) }).expect("meets");
            prop_assert!((found - y).norm() < 1e-10);
        }
    }
}
