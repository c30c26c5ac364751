//! What kind of motion a robot can make: any, or one on flat ground (the thesis' x, y, θ).
//!
//! A planar motion is an SE(3) motion whose twist lies in a three-dimensional subspace. Estimators
//! solve within it, and their covariances are those of SE(3), of rank three.

use super::closed_form::MotionEstimate;
use crate::geometry::{StereoRig, se3};
use crate::uncertainty::consistency;
use nalgebra::{
    Isometry2, Isometry3, Matrix3, Matrix6, Rotation3, SMatrix, Translation3, UnitQuaternion,
    Vector2, Vector3, Vector6,
};
use serde::{Deserialize, Serialize};

/// What is estimated of a motion.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum MotionModel {
    /// Position and heading on flat ground: x, y, θ.
    Planar,
    /// Everything: three translations, three rotations.
    #[default]
    Se3,
}

impl MotionModel {
    /// The model as a rig sees it.
    #[must_use]
    pub fn of(self, rig: &StereoRig) -> Model {
        match self {
            Self::Planar => Model::Planar(Plane::of(rig)),
            Self::Se3 => Model::Se3,
        }
    }
}

/// The ground's plane, as the left camera sees it.
///
/// Its axes are a robot's: x forward, y left, z up.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Plane {
    plane_from_camera: UnitQuaternion<f64>,
}

impl Plane {
    /// The plane of the rig's mounting (its base's x and y), or that of a camera which looks
    /// straight ahead: forward along its z axis, up against its y axis.
    #[must_use]
    pub fn of(rig: &StereoRig) -> Self {
        let plane_from_camera = match &rig.base_from_camera {
            Some(base_from_camera) => base_from_camera.rotation,
            None => UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(
                Matrix3::new(0.0, 0.0, 1.0, -1.0, 0.0, 0.0, 0.0, -1.0, 0.0),
            )),
        };
        Self { plane_from_camera }
    }

    /// The camera twist that a planar twist (x, y, θ) is: 6×3, orthonormal columns.
    #[must_use]
    pub fn basis(&self) -> SMatrix<f64, 6, 3> {
        let camera_from_plane = self.plane_from_camera.inverse();
        let mut basis = SMatrix::<f64, 6, 3>::zeros();
        for (column, axis) in [Vector3::x(), Vector3::y()].into_iter().enumerate() {
            basis
                .fixed_view_mut::<3, 1>(0, column)
                .copy_from(&(camera_from_plane * axis));
        }
        basis
            .fixed_view_mut::<3, 1>(3, 2)
            .copy_from(&(camera_from_plane * Vector3::z()));
        basis
    }

    /// The camera's motion that goes with a motion in the plane.
    #[must_use]
    pub fn lift(&self, planar: &Isometry2<f64>) -> Isometry3<f64> {
        let in_plane = Isometry3::from_parts(
            Translation3::from(planar.translation.vector.push(0.0)),
            UnitQuaternion::from_axis_angle(&Vector3::z_axis(), planar.rotation.angle()),
        );
        self.plane_from_camera.inverse() * in_plane * self.plane_from_camera
    }

    /// The motion in the plane that is nearest to a motion of the camera.
    #[must_use]
    pub fn project(&self, a_from_b: &Isometry3<f64>) -> Isometry2<f64> {
        let in_plane = self.plane_from_camera * a_from_b * self.plane_from_camera.inverse();
        let rotation = in_plane.rotation.to_rotation_matrix();
        let r = rotation.matrix();
        let theta = (r[(1, 0)] - r[(0, 1)]).atan2(r[(0, 0)] + r[(1, 1)]);
        Isometry2::new(in_plane.translation.vector.xy(), theta)
    }

    /// A direction or position of the camera's frame along the plane's axes.
    #[must_use]
    pub fn in_plane(&self, v: &Vector3<f64>) -> Vector2<f64> {
        (self.plane_from_camera * v).xy()
    }

    /// The camera twists that leave the plane: heave, roll and pitch; 6×3, orthonormal columns.
    #[must_use]
    pub fn across(&self) -> SMatrix<f64, 6, 3> {
        let camera_from_plane = self.plane_from_camera.inverse();
        let mut across = SMatrix::<f64, 6, 3>::zeros();
        across
            .fixed_view_mut::<3, 1>(0, 0)
            .copy_from(&(camera_from_plane * Vector3::z()));
        for (column, axis) in [(1, Vector3::x()), (2, Vector3::y())] {
            across
                .fixed_view_mut::<3, 1>(3, column)
                .copy_from(&(camera_from_plane * axis));
        }
        across
    }

    /// How far an unconstrained motion leaves the plane, in units of its own covariance: the
    /// normalised square of heave, roll and pitch, three degrees of freedom.
    ///
    /// `sigma_heave_m` and `sigma_tilt_rad` say how flat the ground may fail to be over one motion.
    /// On ground that is flat to that degree the mean is at most 3; its χ² 99.9 % quantile is 16.3.
    /// `None` where the covariance is none.
    #[must_use]
    pub fn departure(
        &self,
        motion: &MotionEstimate,
        sigma_heave_m: f64,
        sigma_tilt_rad: f64,
    ) -> Option<f64> {
        let xi = se3::log(&motion.prev_from_now);
        let across = self.across();
        let allowed = Vector3::new(sigma_heave_m, sigma_tilt_rad, sigma_tilt_rad);
        let cov = across.transpose() * motion.cov_right * across
            + Matrix3::from_diagonal(&allowed.component_mul(&allowed));
        let cov = (cov + cov.transpose()) * 0.5;
        consistency::nees(&(across.transpose() * xi), &cov)
    }
}

/// The motions that are possible, resolved for a rig.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Model {
    /// Any.
    Se3,
    /// Those on a plane.
    Planar(Plane),
}

impl Model {
    /// How many numbers a motion has.
    #[must_use]
    pub fn degrees_of_freedom(&self) -> usize {
        match self {
            Self::Se3 => 6,
            Self::Planar(_) => 3,
        }
    }

    /// The inverse of an information matrix (or Hessian) within the model: `B (Bᵀ H B)⁻¹ Bᵀ`, and
    /// so both the covariance of the estimate and what turns a gradient into a step.
    ///
    /// `None` where `H` is not positive definite within the model, or so nearly singular that its
    /// inverse would be rounding rather than information.
    #[must_use]
    pub fn inverse(&self, info: &Matrix6<f64>) -> Option<Matrix6<f64>> {
        match self {
            Self::Se3 => inverse_definite(info),
            Self::Planar(plane) => {
                let basis = plane.basis();
                let reduced: Matrix3<f64> = basis.transpose() * info * basis;
                let inverse = basis * inverse_definite(&reduced)? * basis.transpose();
                Some(se3::symmetric(&inverse))
            }
        }
    }

    /// The possible motion nearest to `a_from_b`.
    #[must_use]
    pub fn constrain(&self, a_from_b: &Isometry3<f64>) -> Isometry3<f64> {
        match self {
            Self::Se3 => *a_from_b,
            Self::Planar(plane) => plane.lift(&plane.project(a_from_b)),
        }
    }

    /// The error in units of its covariance, squared, over the model's degrees of freedom alone.
    /// `None` where the covariance is none.
    #[must_use]
    pub fn nees(&self, error: &Vector6<f64>, cov: &Matrix6<f64>) -> Option<f64> {
        match self {
            Self::Se3 => consistency::nees(error, cov),
            Self::Planar(plane) => {
                let basis = plane.basis();
                let reduced: Matrix3<f64> = basis.transpose() * cov * basis;
                consistency::nees(
                    &(basis.transpose() * error),
                    &((reduced + reduced.transpose()) * 0.5),
                )
            }
        }
    }
}

/// The departure from the plane that one pair in a thousand has on flat ground (χ² with three
/// degrees of freedom).
pub const FLAT_LIMIT: f64 = 16.27;

/// The share of a diagonal element that elimination must leave of it: metres and radians are scaled
/// alike first, so that this is a matter of geometry.
const SMALLEST_PIVOT: f64 = 1e-11;

fn inverse_definite<const D: usize>(m: &SMatrix<f64, D, D>) -> Option<SMatrix<f64, D, D>> {
    let scale = m
        .diagonal()
        .map(|d| if d > 0.0 { 1.0 / d.sqrt() } else { f64::NAN });
    let mut scaled = *m;
    for (i, j) in (0..D).flat_map(|i| (0..D).map(move |j| (i, j))) {
        scaled[(i, j)] = 0.5 * (m[(i, j)] + m[(j, i)]) * scale[i] * scale[j];
    }
    let factor = scaled.cholesky()?;
    let lower = factor.l_dirty();
    if (0..D).any(|i| lower[(i, i)] * lower[(i, i)] < SMALLEST_PIVOT) {
        return None;
    }
    let inverse = factor.inverse();
    let mut out = inverse;
    for (i, j) in (0..D).flat_map(|i| (0..D).map(move |j| (i, j))) {
        out[(i, j)] = 0.5 * (inverse[(i, j)] + inverse[(j, i)]) * scale[i] * scale[j];
    }
    out.iter().all(|v| v.is_finite()).then_some(out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{parse_rig, se2};
    use crate::simulation::thesis_rig;
    use proptest::prelude::*;

    fn planes() -> [Plane; 2] {
        let tilted = parse_rig(
            "left = { width = 640, height = 480, focal = [800.0, 800.0], principal_point = [320.0, 240.0] }
             right = { width = 640, height = 480, focal = [800.0, 800.0], principal_point = [320.0, 240.0] }
             right_from_left = { translation_m = [-0.3, 0.0, 0.0], rotation_vector_rad = [0.0, 0.0, 0.0] }
             mounting = { translation_m = [0.4, 0.19, 0.8], rotation_rpy_rad = [-1.9, 0.1, -1.4] }",
        )
        .expect("valid");
        [Plane::of(&thesis_rig()), Plane::of(&tilted)]
    }

    #[test]
    fn a_level_camera_moves_ahead_along_its_axis_and_turns_left_about_up() {
        let plane = planes()[0];
        let ahead = plane.lift(&Isometry2::new(Vector2::new(2.0, 0.5), 0.0));
        assert!((ahead.translation.vector - Vector3::new(-0.5, 0.0, 2.0)).norm() < 1e-15);
        let left = plane.lift(&Isometry2::new(Vector2::zeros(), 0.1));
        // Turning left, what was ahead is now to the right: the camera's own x.
        let seen = left.inverse() * nalgebra::Point3::new(0.0, 0.0, 1.0);
        assert!(seen.x > 0.09 && seen.y.abs() < 1e-15);
    }

    proptest! {
        #[test]
        fn projecting_undoes_lifting(xi in prop::array::uniform3(-2.0..2.0_f64)) {
            for plane in planes() {
                let planar = se2::exp(&Vector3::from(xi));
                let back = plane.project(&plane.lift(&planar));
                prop_assert!((back.to_homogeneous() - planar.to_homogeneous()).norm() < 1e-13);
            }
        }

        #[test]
        fn the_basis_is_the_lift_of_small_twists(xi in prop::array::uniform3(-1.0..1.0_f64)) {
            for plane in planes() {
                let small = Vector3::from(xi) * 1e-3;
                let lifted = se3::log(&plane.lift(&se2::exp(&small)));
                prop_assert!((lifted - plane.basis() * small).norm() < 1e-15);
            }
        }

        #[test]
        fn the_inverse_within_a_plane_is_that_of_the_reduced_problem(seed in prop::array::uniform32(-1.0..1.0_f64)) {
            let root = Matrix6::from_fn(|i, j| seed[(6 * i + j) % 32] + f64::from(u8::from(i == j)) * 2.0);
            let info = root * root.transpose() + Matrix6::identity() * 0.1;
            for plane in planes() {
                let basis = plane.basis();
                let cov = Model::Planar(plane).inverse(&info).expect("definite");
                let reduced = basis.transpose() * cov * basis;
                let product = reduced * (basis.transpose() * info * basis);
                prop_assert!((product - Matrix3::identity()).norm() < 1e-9);
            }
        }
    }

    #[test]
    fn a_motion_out_of_the_plane_is_noticed() {
        let plane = planes()[0];
        let cov_right = Matrix6::identity() * 1e-6;
        let motion = |xi: Vector6<f64>| MotionEstimate {
            prev_from_now: se3::exp(&xi),
            cov_right,
        };
        let flat = plane.departure(
            &motion(Vector6::new(0.1, 0.0, 0.4, 0.0, 0.05, 0.0)),
            1e-3,
            1e-3,
        );
        assert!(flat.expect("definite") < 1e-9);
        // 4 mm up, where 1.4 mm are covered: 8 σ².
        let up = plane.departure(
            &motion(Vector6::new(0.0, 0.004, 0.0, 0.0, 0.0, 0.0)),
            1e-3,
            1e-3,
        );
        assert!((up.expect("definite") - 8.0).abs() < 1e-9);
    }
}
