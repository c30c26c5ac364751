//! The warp: what calibration has left between the two images.
//!
//! A rig's parameters say where the right image shows a point up to some tenths of a pixel: its
//! cameras have turned since, its lens is no polynomial. The window estimates the difference along
//! with the motion. Across the baseline it shows in every stereo match, and is taken as a quadratic
//! of the position. Along the baseline it is a change of disparity, and only shows in how the world
//! seems to shrink or grow as the robot moves; there one constant is all that can be told from
//! other errors. What is not known of either goes into the covariance of every pose.

use super::super::{Settings, StereoMeasurement};
use crate::geometry::StereoRig;
use nalgebra::{DVector, SMatrix, SVector, Vector2};

/// Terms across the baseline: 1, x, y, x², xy, y².
const TERMS: usize = 6;
/// Unknowns: the displacement along the baseline, then the terms across it.
pub(super) const WARP: usize = 1 + TERMS;

/// Derivative of the displacement, px, by the unknowns.
pub(super) type ByWarp = SMatrix<f64, 2, WARP>;

/// A displacement of the right image.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Warp {
    centre_px: Vector2<f64>,
    half_width_px: f64,
    /// Direction of the baseline in the right image, and across it.
    along: Vector2<f64>,
    across: Vector2<f64>,
    /// px.
    pub(super) coefficients: SVector<f64, WARP>,
}

impl Warp {
    /// None at all.
    pub(super) fn new(rig: &StereoRig) -> Self {
        let (width, height) = (f64::from(rig.right.width), f64::from(rig.right.height));
        let baseline = rig.right_from_left.translation.vector.xy();
        let along = baseline.try_normalize(1e-12).unwrap_or_else(Vector2::x);
        Self {
            centre_px: Vector2::new(0.5 * (width - 1.0), 0.5 * (height - 1.0)),
            half_width_px: 0.5 * width,
            along,
            across: Vector2::new(-along.y, along.x),
            coefficients: SVector::zeros(),
        }
    }

    /// By how much each unknown displaces what the right camera saw, px.
    pub(super) fn derivative(&self, measurement: &StereoMeasurement) -> ByWarp {
        let at = (measurement.right_px() - self.centre_px) / self.half_width_px;
        let (x, y) = (at.x, at.y);
        let terms = SMatrix::<f64, 1, TERMS>::from([[1.0], [x], [y], [x * x], [x * y], [y * y]]);
        let mut by_warp = ByWarp::zeros();
        by_warp.set_column(0, &self.along);
        by_warp
            .fixed_columns_mut::<TERMS>(1)
            .copy_from(&(self.across * terms));
        by_warp
    }

    /// The measurement that a rig as calibrated would have made.
    pub(super) fn corrected(&self, measurement: &StereoMeasurement) -> StereoMeasurement {
        let displacement = self.derivative(measurement) * self.coefficients;
        let mut corrected = *measurement;
        corrected.px[2] -= displacement.x;
        corrected.px[3] -= displacement.y;
        corrected
    }

    /// Adds a step of all unknowns, which stand first in `step`.
    pub(super) fn step(&mut self, step: &DVector<f64>) {
        self.coefficients += step.fixed_rows::<WARP>(0);
    }
}

/// The covariance of the warp before anything is seen: from what the rig states of itself, else
/// what the settings suppose of each coefficient.
pub(super) fn prior_covariance(rig: &StereoRig, settings: &Settings) -> SMatrix<f64, WARP, WARP> {
    let sigmas_px =
        stated_sigmas_px(rig).unwrap_or_else(|| SVector::repeat(settings.calibration_sigma_px));
    SMatrix::from_diagonal(&sigmas_px.map(|s| (s * s).max(SMALLEST_VARIANCE_PX2)))
}

/// Keeps the information finite where a calibration is taken as exact.
const SMALLEST_VARIANCE_PX2: f64 = 1e-12;

/// What the uncertainties of rotation, principal points and focal lengths do to the right image, to
/// second order in the position.
fn stated_sigmas_px(rig: &StereoRig) -> Option<SVector<f64, WARP>> {
    let stated = rig.uncertainty.as_ref()?;
    let focal_px = rig.right.focal_px.x;
    let tangent = 0.5 * f64::from(rig.right.width) / focal_px;
    let turn_px = stated.rotation_rad * focal_px;
    let both = |sigma: f64| sigma * std::f64::consts::SQRT_2;
    let offset = turn_px.hypot(both(stated.principal_point_px));
    let stretch = both(stated.focal_px) * tangent;
    let roll = turn_px * tangent;
    // A turn about the image's vertical lifts by xy, one about its horizontal by y².
    let keystone = turn_px * tangent * tangent;
    Some(SVector::from([
        offset, offset, roll, stretch, 0.0, keystone, keystone,
    ]))
}
