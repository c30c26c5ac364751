//! The stereo rig: two cameras and where the right one stands, as they are; nothing is rectified.

use super::Camera;
use super::rig_parameters::RigCovariance;
use nalgebra::{Isometry3, Matrix4x3, Point3, Vector4};
use std::path::PathBuf;

/// Two calibrated cameras, fixed to each other.
#[derive(Clone, Debug, PartialEq)]
pub struct StereoRig {
    /// The left camera; its optical frame is the frame of points and motions.
    pub left: Camera,
    /// The right camera.
    pub right: Camera,
    /// Maps a point from the left camera's frame into the right camera's.
    pub right_from_left: Isometry3<f64>,
    /// Maps a point from the left camera's frame into the robot's base frame, where configured.
    pub base_from_camera: Option<Isometry3<f64>>,
    /// How well the parameters are known, where that was stated.
    pub uncertainty: Option<RigUncertainty>,
}

/// How well a rig's parameters are known.
#[derive(Clone, Debug, PartialEq)]
pub enum RigUncertainty {
    /// 1 σ of the parameters, each taken as independent of the others.
    Sigmas {
        /// Of each focal length, px.
        focal_px: f64,
        /// Of each coordinate of a principal point, px.
        principal_point_px: f64,
        /// Of each axis of the rotation between the cameras, rad.
        rotation_rad: f64,
        /// Of each axis of the translation between the cameras, m.
        translation_m: f64,
    },
    /// All parameters together, distortion included.
    Covariance {
        /// The file that it stands in, as the rig file names it.
        file: PathBuf,
        /// The matrix.
        covariance: Box<RigCovariance>,
    },
}

impl StereoRig {
    /// The distance between the cameras, m.
    #[must_use]
    pub fn baseline_m(&self) -> f64 {
        self.right_from_left.translation.vector.norm()
    }

    /// Where `point` (m, left camera frame) is seen: (ul, vl, ur, vr), px, raw.
    ///
    /// `None` if either camera cannot see it, whatever the images' borders.
    #[must_use]
    pub fn project(&self, point: &Point3<f64>) -> Option<Vector4<f64>> {
        let left = self.left.project(point)?;
        let right = self.right.project(&(self.right_from_left * point))?;
        Some(Vector4::new(left.x, left.y, right.x, right.y))
    }

    /// [`project`](Self::project) with the derivative by the point, px/m.
    #[must_use]
    pub fn project_with_jacobian(
        &self,
        point: &Point3<f64>,
    ) -> Option<(Vector4<f64>, Matrix4x3<f64>)> {
        let (left, left_by_point) = self.left.project_with_jacobian(point)?;
        let in_right = self.right_from_left * point;
        let (right, right_by_point) = self.right.project_with_jacobian(&in_right)?;
        let rotation = self.right_from_left.rotation.to_rotation_matrix();
        let mut jacobian = Matrix4x3::zeros();
        jacobian
            .fixed_view_mut::<2, 3>(0, 0)
            .copy_from(&left_by_point);
        jacobian
            .fixed_view_mut::<2, 3>(2, 0)
            .copy_from(&(right_by_point * rotation.matrix()));
        Some((Vector4::new(left.x, left.y, right.x, right.y), jacobian))
    }
}
