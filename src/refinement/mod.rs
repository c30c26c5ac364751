//! Refinement: a landmark's patch in the image of its anchor in, where both cameras see the very
//! same patch out, to a fraction of a pixel and with its covariance.
//!
//! A detector places a keypoint in each image anew, with an error of its own each time; a patch
//! says where *this* surface is. It is warped as its surface, whose slope is learnt on the way, is
//! seen from elsewhere, and aligned from coarse to fine; what is reported is the level that
//! determines the position best.

mod patch;
mod pyramid;
mod slant;
mod view;

pub use patch::{Aligned, Surface, Template, Warp};
pub use pyramid::{LEVELS, Pyramid, from_level, to_level};
pub use slant::Slant;
pub use view::View;

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
    /// What is known of its surface.
    pub slant: Slant,
}

/// A keypoint of this diameter or less is sought on the finest level, px.
const FINEST_SIZE_PX: f64 = 10.0;
/// What alignment leaves however good the contrast, from interpolation: σ, px of the level.
const FLOOR_PX: f64 = 0.03;
/// What it leaves of a deformation, relief and edges being no plane: σ, px of the level, of a patch that
/// is seen at twice or half its size. It stays with the patch from pair to pair.
const RELIEF_PX: f64 = 0.25;
/// A patch is made anew where its rim is displaced by a better slope by more, px of the level …
const MAX_BEND_PX: f64 = 0.3;
/// … so many times at most.
const MAX_BENDS: usize = 3;
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
) -> Option<Refined> {
    let anchor = linearise_sight(rig, &Isometry3::identity(), inverse_depth)?.by_point;
    let now = linearise_sight(rig, now_from_anchor, inverse_depth)?.by_point;
    let by_px: Matrix2<f64> = anchor.fixed_view::<2, 2>(0, 0).try_inverse()?;
    let cameras = [*now_from_anchor, rig.right_from_left * now_from_anchor];
    let mut appearance = *appearance;
    let (mut px, mut sigma_px) = (Vector4::zeros(), Vector4::zeros());
    let mut relief_px = Vector2::zeros();
    let mut correlation = 1.0_f32;
    for (side, image) in [(0, images.left), (2, images.right)] {
        let view = View::new(&now, side, &by_px, &cameras[side / 2], inverse_depth);
        let from = Vector2::new(start[side], start[side + 1]);
        let found = coarse_to_fine(&appearance, image, &view, &from, reach_px)?;
        appearance.slant = found.slant;
        px.fixed_rows_mut::<2>(side).copy_from(&found.px);
        sigma_px
            .fixed_rows_mut::<2>(side)
            .copy_from(&found.sigma_px);
        relief_px[side / 2] = found.relief_px;
        correlation = correlation.min(found.correlation);
    }
    Some(Refined {
        measurement: StereoMeasurement { px, sigma_px },
        relief_px,
        slant: appearance.slant,
        correlation,
    })
}

/// A landmark's patch in its own anchor: the left position is the patch's centre by definition, and
/// shares the uncertainty that the patch has; the right one is sought.
///
/// `start` is where the detector saw it. `None` where it is not found on the right.
#[must_use]
pub fn refine_right(
    rig: &StereoRig,
    appearance: &Appearance<'_>,
    right: &Pyramid,
    start: &StereoMeasurement,
    reach_px: f64,
) -> Option<Refined> {
    let inverse_depth = crate::estimation::inverse_depth(rig, start)?;
    let by_point = linearise_sight(rig, &Isometry3::identity(), &inverse_depth)?.by_point;
    let by_px: Matrix2<f64> = by_point.fixed_view::<2, 2>(0, 0).try_inverse()?;
    let view = View::new(&by_point, 2, &by_px, &rig.right_from_left, &inverse_depth);
    let found = coarse_to_fine(appearance, right, &view, &start.right_px(), reach_px)?;
    let (px, sigma) = (found.px, found.sigma_px);
    let measurement = StereoMeasurement {
        px: Vector4::new(appearance.px.x, appearance.px.y, px.x, px.y),
        sigma_px: Vector4::new(sigma.x, sigma.y, sigma.x, sigma.y),
    };
    Some(Refined {
        measurement,
        relief_px: Vector2::new(0.0, found.relief_px),
        slant: found.slant,
        correlation: found.correlation,
    })
}

/// A patch found in one image.
#[derive(Clone, Copy, Debug)]
pub struct Found {
    /// Its centre, raw px.
    pub px: Vector2<f64>,
    /// Standard deviations in x and y, px.
    pub sigma_px: Vector2<f64>,
    /// σ of what does not fit because the surface is no plane, px.
    pub relief_px: f64,
    /// What is known of the surface with this image.
    pub slant: Slant,
    /// Correlation with the patch in its anchor, −1 to 1.
    pub correlation: f32,
}

/// A patch found in both images of a pair.
#[derive(Clone, Copy, Debug)]
pub struct Refined {
    /// Where.
    pub measurement: StereoMeasurement,
    /// On the left and on the right, σ of what does not fit because the surface is no plane, px. All
    /// sights of a patch are off the same way, each in proportion to this.
    pub relief_px: Vector2<f64>,
    /// What is known of the surface with this pair.
    pub slant: Slant,
    /// Correlation with the patch in its anchor, −1 to 1: the lesser one of both images.
    pub correlation: f32,
}

/// Finds a patch in `image`, level by level.
#[must_use]
pub fn coarse_to_fine(
    appearance: &Appearance<'_>,
    image: &Pyramid,
    view: &View,
    start: &Vector2<f64>,
    reach_px: f64,
) -> Option<Found> {
    let mut best: Option<(Found, f64)> = None;
    let mut at = *start;
    let mut slope = appearance.slant.slope;
    let mut template = Template::blank();
    for level in (0..=coarsest_level(appearance.size_px)).rev() {
        let px = f64::from(1_u32 << level);
        let reach = match best {
            None => (reach_px / px) as f32,
            Some(_) => FINER_REACH_PX,
        };
        let Some(found) = on_level(
            appearance,
            image,
            view,
            &mut template,
            (level, reach),
            &at,
            slope,
        ) else {
            if best.is_some() {
                break;
            }
            continue;
        };
        let var = found
            .cov
            .diagonal()
            .map(|v| (v + FLOOR_PX * FLOOR_PX) * px * px);
        at = found.at.map(|v| from_level(f64::from(v), level));
        slope = found.gap;
        if best.is_none_or(|(_, sum)| var.sum() < sum) {
            let found = Found {
                px: at,
                sigma_px: var.map(f64::sqrt),
                relief_px: RELIEF_PX * px * view.deformation(&slope),
                slant: appearance.slant.after(slope, found.information),
                correlation: found.correlation,
            };
            best = Some((found, var.sum()));
        }
    }
    best.map(|(found, _)| found)
}

/// Finds a patch on one level, bending it until it fits; the slope itself is left in `gap`. `template` is working
/// memory.
fn on_level(
    appearance: &Appearance<'_>,
    image: &Pyramid,
    view: &View,
    template: &mut Template,
    (level, reach): (usize, f32),
    start: &Vector2<f64>,
    mut slope: Vector2<f64>,
) -> Option<Aligned> {
    let px = f64::from(1_u32 << level);
    let from = start.map(|v| to_level(v, level) as f32);
    let mut at = from;
    for bend in 1.. {
        let (now_by_anchor, depth_by_px) = view.on(&slope);
        let magnified = now_by_anchor.determinant();
        if !(0.1..10.0).contains(&magnified) {
            return None;
        }
        // The level of the anchor's image that shows about as much as this one.
        let anchor_level = if magnified > 2.0 {
            level.saturating_sub(1)
        } else if magnified < 0.5 {
            (level + 1).min(LEVELS - 1)
        } else {
            level
        };
        let spread = now_by_anchor.try_inverse()? * px;
        let surface = Surface {
            lever: view.lever_px / px,
            spread,
            gap: appearance.slant.slope - slope,
            information: appearance.slant.information,
        };
        let warp = Warp {
            linear: (spread / f64::from(1_u32 << anchor_level)).map(|v| v as f32),
            depth: (spread.transpose() * depth_by_px).map(|v| v as f32),
        };
        let centre = appearance.px.map(|v| to_level(v, anchor_level) as f32);
        template.fill(
            appearance.image.level(anchor_level),
            &centre,
            &warp,
            &surface,
        )?;
        let mut found = template.align(image.level(level), &at, reach.max(1.0))?;
        if (found.at - from).amax() > reach.max(1.0) {
            return None;
        }
        let bent_px =
            surface.lever.norm() * (spread.transpose() * found.gap).norm() * patch::HALF as f64;
        found.gap += slope;
        if bent_px < MAX_BEND_PX || bend == MAX_BENDS {
            return Some(found);
        }
        (slope, at) = (found.gap, found.at);
    }
    None
}

fn coarsest_level(size_px: f64) -> usize {
    let level = (size_px / FINEST_SIZE_PX).log2().ceil().max(0.0);
    (level as usize).min(LEVELS - 1)
}
