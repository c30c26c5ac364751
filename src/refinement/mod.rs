//! Refinement: a landmark's patch in the image of its anchor in, where both cameras see the very
//! same patch out, to a fraction of a pixel and with its covariance.
//!
//! A detector places a keypoint in each image anew, with an error of its own each time; a patch
//! says where *this* surface is. It is warped as a surface that faces the camera would be, and
//! aligned from coarse to fine; what is reported is the level that determines the position best.

mod patch;
mod pyramid;

pub use patch::{Aligned, Template};
pub use pyramid::{LEVELS, Pyramid, from_level, to_level};

use crate::estimation::{StereoMeasurement, linearise_sight};
use crate::geometry::StereoRig;
use nalgebra::{Isometry3, Matrix2, Vector2, Vector3, Vector4};

/// A pair of images, reduced.
#[derive(Clone, Copy, Debug)]
pub struct PyramidPair<'a> {
    /// The left image's.
    pub left: &'a Pyramid,
    /// The right image's.
    pub right: &'a Pyramid,
}

/// What a landmark looks like: where its patch is.
#[derive(Clone, Copy, Debug)]
pub struct Appearance<'a> {
    /// The left image of the anchor.
    pub image: &'a Pyramid,
    /// The centre of the patch there, raw px.
    pub px: Vector2<f64>,
    /// Diameter of the keypoint, px.
    pub size_px: f64,
}

/// A keypoint of this diameter or less is sought on the finest level, px.
const FINEST_SIZE_PX: f64 = 10.0;
/// What alignment leaves however good the contrast: interpolation, warp. px of the level.
const FLOOR_PX: f64 = 0.05;
/// How far a finer level may move what a coarser one found, px of the finer level.
const FINER_REACH_PX: f32 = 2.0;

/// Where both cameras see a landmark's patch.
///
/// `inverse_depth` is (x, y, ρ) of the landmark in its anchor, `start` where it should be seen (ul,
/// vl, ur, vr), raw px, and `reach_px` how far from there it may be. `None` where it is not found in
/// both images.
#[must_use]
pub fn refine(
    rig: &StereoRig,
    appearance: &Appearance<'_>,
    inverse_depth: &Vector3<f64>,
    now_from_anchor: &Isometry3<f64>,
    images: &PyramidPair<'_>,
    start: &Vector4<f64>,
    reach_px: f64,
) -> Option<StereoMeasurement> {
    let anchor = linearise_sight(rig, &Isometry3::identity(), inverse_depth)?.by_point;
    let now = linearise_sight(rig, now_from_anchor, inverse_depth)?.by_point;
    let by_px: Matrix2<f64> = anchor.fixed_view::<2, 2>(0, 0).try_inverse()?;
    let mut measurement = StereoMeasurement {
        px: Vector4::zeros(),
        sigma_px: Vector4::zeros(),
    };
    for (side, image) in [(0, images.left), (2, images.right)] {
        let warp: Matrix2<f64> = now.fixed_view::<2, 2>(side, 0) * by_px;
        let from = Vector2::new(start[side], start[side + 1]);
        let found = coarse_to_fine(appearance, image, &warp, &from, reach_px)?;
        measurement
            .px
            .fixed_rows_mut::<2>(side)
            .copy_from(&found.px);
        measurement
            .sigma_px
            .fixed_rows_mut::<2>(side)
            .copy_from(&found.sigma_px);
    }
    Some(measurement)
}

/// The stereo measurement of a landmark's patch in its own anchor: the left position is the patch's
/// centre by definition, and shares the uncertainty that the patch has; the right one is sought.
///
/// `start` is where the detector saw it. `None` where it is not found on the right.
#[must_use]
pub fn refine_right(
    rig: &StereoRig,
    appearance: &Appearance<'_>,
    right: &Pyramid,
    start: &StereoMeasurement,
    reach_px: f64,
) -> Option<StereoMeasurement> {
    let inverse_depth = crate::estimation::inverse_depth(rig, start)?;
    let by_point = linearise_sight(rig, &Isometry3::identity(), &inverse_depth)?.by_point;
    let by_px: Matrix2<f64> = by_point.fixed_view::<2, 2>(0, 0).try_inverse()?;
    let warp: Matrix2<f64> = by_point.fixed_view::<2, 2>(2, 0) * by_px;
    let found = coarse_to_fine(appearance, right, &warp, &start.right_px(), reach_px)?;
    let (px, sigma) = (found.px, found.sigma_px);
    Some(StereoMeasurement {
        px: Vector4::new(appearance.px.x, appearance.px.y, px.x, px.y),
        sigma_px: Vector4::new(sigma.x, sigma.y, sigma.x, sigma.y),
    })
}

/// A patch found in one image.
#[derive(Clone, Copy, Debug)]
pub struct Found {
    /// Its centre, raw px.
    pub px: Vector2<f64>,
    /// Standard deviations in x and y, px.
    pub sigma_px: Vector2<f64>,
}

/// Finds a patch in `image`, level by level. `now_by_anchor` is the derivative of a pixel of the
/// image by the one of the anchor that shows the same.
#[must_use]
pub fn coarse_to_fine(
    appearance: &Appearance<'_>,
    image: &Pyramid,
    now_by_anchor: &Matrix2<f64>,
    start: &Vector2<f64>,
    reach_px: f64,
) -> Option<Found> {
    let anchor_by_now = now_by_anchor.try_inverse()?;
    let magnified = now_by_anchor.determinant().abs();
    let mut best: Option<(Found, f64)> = None;
    let mut at = *start;
    for level in (0..=coarsest_level(appearance.size_px)).rev() {
        let px = f64::from(1_u32 << level);
        // The level of the anchor's image that shows about as much as this one.
        let anchor_level = if magnified > 2.0 {
            level.saturating_sub(1)
        } else if magnified < 0.5 {
            (level + 1).min(LEVELS - 1)
        } else {
            level
        };
        let warp = anchor_by_now * (px / f64::from(1_u32 << anchor_level));
        let centre = appearance.px.map(|v| to_level(v, anchor_level) as f32);
        let reach = match best {
            None => (reach_px / px) as f32,
            Some(_) => FINER_REACH_PX,
        };
        let from = at.map(|v| to_level(v, level) as f32);
        let found = Template::new(
            appearance.image.level(anchor_level),
            &centre,
            &warp.map(|v| v as f32),
        )
        .and_then(|template| template.align(image.level(level), &from, reach.max(1.0)));
        let Some(found) = found else {
            if best.is_some() {
                break;
            }
            continue;
        };
        let var = Vector2::new(found.cov[(0, 0)], found.cov[(1, 1)])
            .map(|v| (f64::from(v) + FLOOR_PX * FLOOR_PX) * px * px);
        at = found.at.map(|v| from_level(f64::from(v), level));
        if best.is_none_or(|(_, sum)| var.sum() < sum) {
            let found = Found {
                px: at,
                sigma_px: var.map(f64::sqrt),
            };
            best = Some((found, var.sum()));
        }
    }
    best.map(|(found, _)| found)
}

fn coarsest_level(size_px: f64) -> usize {
    let level = (size_px / FINEST_SIZE_PX).log2().ceil().max(0.0);
    (level as usize).min(LEVELS - 1)
}
