//! The lens models that a calibration can find, and which of the rig's slots they free.

use crate::geometry::rig_parameters::{CAMERA_PARAMETERS, EXTRINSICS};
use crate::geometry::{Camera, Distortion};
use nalgebra::Vector2;

/// How many coefficients of which lens model are estimated.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Lens {
    /// A pinhole: no distortion.
    None,
    /// k1, k2, p1, p2.
    Radtan4,
    /// k1, k2, p1, p2, k3.
    #[default]
    Radtan5,
    /// k1, k2, p1, p2, k3 and the rational k4, k5, k6.
    Radtan8,
    /// The fisheye's k1 … k4.
    Equidistant,
}

impl Lens {
    /// A camera with this lens undistorted, the principal point in the middle.
    pub(super) fn camera(self, (width, height): (u32, u32), focal_px: Vector2<f64>) -> Camera {
        let centre = Vector2::new(f64::from(width) - 1.0, f64::from(height) - 1.0) * 0.5;
        let distortion = match self {
            Self::None => Distortion::None,
            Self::Radtan4 | Self::Radtan5 | Self::Radtan8 => Distortion::Radtan([0.0; 8]),
            Self::Equidistant => Distortion::Equidistant([0.0; 4]),
        };
        Camera::new(width, height, focal_px, centre, distortion)
    }

    /// How many coefficients it has.
    #[must_use]
    pub fn coefficients(self) -> usize {
        match self {
            Self::None => 0,
            Self::Radtan4 | Self::Equidistant => 4,
            Self::Radtan5 => 5,
            Self::Radtan8 => 8,
        }
    }

    /// The free slots of a camera: focal lengths, principal point, coefficients.
    pub(super) fn camera_slots(self) -> Vec<usize> {
        (0..4 + self.coefficients()).collect()
    }

    /// The free slots of a rig with two of these lenses.
    #[must_use]
    pub fn rig_slots(self) -> Vec<usize> {
        let camera = self.camera_slots();
        let right = camera.iter().map(|slot| CAMERA_PARAMETERS + slot);
        camera
            .iter()
            .copied()
            .chain(right)
            .chain(EXTRINSICS..EXTRINSICS + 6)
            .collect()
    }
}
