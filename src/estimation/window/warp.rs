//! The warp: what calibration has left between the two images.
//!
//! A rig's parameters say where the right image shows a point up to some tenths of a pixel: its
//! cameras have turned since, its lens is no polynomial. The window estimates the difference along
//! with the motion. Across the baseline it shows in every stereo match, and is taken as a quadratic
//! of the position. Along the baseline it is a change of disparity, and only shows in how the world
//! seems to shrink or grow as the robot moves; there one constant is all that can be told from
//! other errors. What is not known of either goes into the covariance of every pose.

use super::super::calibration::sight_by_rig;
use super::super::{Settings, StereoMeasurement, Viewpoint};
use crate::geometry::StereoRig;
use crate::geometry::product::{product, product_transposed};
use crate::geometry::rig_parameters::RIG_PARAMETERS;
use nalgebra::{DVector, Matrix2, SMatrix, SVector, Vector2, Vector4};

/// Terms across the baseline: 1, x, y, x², xy, y².
const TERMS: usize = 6;
/// Unknowns: the displacement along the baseline, then the terms across it.
pub(in super::super) const WARP: usize = 1 + TERMS;

/// Derivative of the displacement at one place, px, by the unknowns: the first displaces along the
/// baseline, the others across it, by their terms there. Products know it, which halves them.
#[derive(Clone, Copy, Debug)]
pub(super) struct ByWarp {
    along: Vector2<f64>,
    across: Vector2<f64>,
    terms: SVector<f64, TERMS>,
}

impl ByWarp {
    /// Itself, `B`.
    fn matrix(&self) -> SMatrix<f64, 2, WARP> {
        self.after(&Matrix2::identity())
    }

    /// `m B`.
    #[inline(always)]
    pub(super) fn after<const R: usize>(&self, m: &SMatrix<f64, R, 2>) -> SMatrix<f64, R, WARP> {
        let across = product(m, &self.across);
        let mut out = SMatrix::<f64, R, WARP>::zeros();
        out.set_column(0, &product(m, &self.along));
        for term in 0..TERMS {
            for row in 0..R {
                out.data.0[1 + term][row] = across[row] * self.terms[term];
            }
        }
        out
    }

    /// `Bᵀ m`.
    #[inline(always)]
    pub(super) fn transposed_before<const C: usize>(
        &self,
        m: &SMatrix<f64, 2, C>,
    ) -> SMatrix<f64, WARP, C> {
        let mut out = SMatrix::<f64, WARP, C>::zeros();
        for (out, m) in out.data.0.iter_mut().zip(&m.data.0) {
            out[0] = self.along.x * m[0] + self.along.y * m[1];
            let across = self.across.x * m[0] + self.across.y * m[1];
            for term in 0..TERMS {
                out[1 + term] = across * self.terms[term];
            }
        }
        out
    }
}

/// A covariance of all unknowns, px².
pub(super) type WarpCovariance = SMatrix<f64, WARP, WARP>;

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
    #[inline]
    pub(super) fn derivative(&self, measurement: &StereoMeasurement) -> ByWarp {
        let at = (measurement.right_px() - self.centre_px) / self.half_width_px;
        let (x, y) = (at.x, at.y);
        ByWarp {
            along: self.along,
            across: self.across,
            terms: SVector::from([1.0, x, y, x * x, x * y, y * y]),
        }
    }

    /// Covariance, px², of the displacement there, for one of the unknowns.
    pub(super) fn displacement_px2(
        &self,
        measurement: &StereoMeasurement,
        cov_warp: &WarpCovariance,
    ) -> Matrix2<f64> {
        let by_warp = self.derivative(measurement).matrix();
        product_transposed(&product(&by_warp, cov_warp), &by_warp)
    }

    /// The measurement that a rig as calibrated would have made.
    pub(super) fn corrected(&self, measurement: &StereoMeasurement) -> StereoMeasurement {
        StereoMeasurement {
            px: self.corrected_px(measurement, &self.derivative(measurement)),
            ..*measurement
        }
    }

    /// The pixels of [`corrected`](Self::corrected), `by_warp` being the derivative there.
    #[inline(always)]
    pub(super) fn corrected_px(
        &self,
        measurement: &StereoMeasurement,
        by_warp: &ByWarp,
    ) -> Vector4<f64> {
        let terms = self.coefficients.fixed_rows::<TERMS>(1).into_owned();
        let displacement =
            by_warp.along * self.coefficients[0] + by_warp.across * by_warp.terms.dot(&terms);
        let mut px = measurement.px;
        px[2] -= displacement.x;
        px[3] -= displacement.y;
        px
    }

    /// Adds a step of all unknowns, which stand first in `step`.
    pub(super) fn step(&mut self, step: &DVector<f64>) {
        self.coefficients += step.fixed_rows::<WARP>(0);
    }
}

/// The covariance of the warp before anything is seen: what the rig's stated uncertainty does to
/// the right image, else what the settings suppose of each coefficient.
pub(super) fn prior_covariance(rig: &StereoRig, settings: &Settings) -> WarpCovariance {
    let floor = WarpCovariance::identity() * SMALLEST_VARIANCE_PX2;
    let supposed = settings.calibration_sigma_px * settings.calibration_sigma_px;
    stated_covariance(rig).unwrap_or_else(|| WarpCovariance::identity() * supposed) + floor
}

/// Keeps the information finite where a calibration is taken as exact.
const SMALLEST_VARIANCE_PX2: f64 = 1e-12;

/// The warp that fits best to what errors of the rig's parameters do to points at infinity: their
/// displacement on the right, less the one on the left.
fn stated_covariance(rig: &StereoRig) -> Option<WarpCovariance> {
    let covariance = rig.covariance()?;
    let warp = Warp::new(rig);
    let mut normal = WarpCovariance::zeros();
    let mut by_rig = SMatrix::<f64, WARP, RIG_PARAMETERS>::zeros();
    let from = Viewpoint::unmoved(rig);
    for ray in rig.left.spread_rays() {
        let infinity = ray.push(0.0);
        let (Some(px), Some(by)) = (
            from.seen_at(rig, &infinity),
            sight_by_rig(rig, &from, &infinity),
        ) else {
            continue;
        };
        let sigma_px = Vector4::zeros();
        let by_warp = warp
            .derivative(&StereoMeasurement { px, sigma_px })
            .matrix();
        normal += by_warp.transpose() * by_warp;
        by_rig += by_warp.transpose() * (by.fixed_rows::<2>(2) - by.fixed_rows::<2>(0));
    }
    let by_rig = normal.try_inverse()? * by_rig;
    let stated = by_rig * covariance * by_rig.transpose();
    Some((stated + stated.transpose()) * 0.5)
}
