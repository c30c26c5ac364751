//! Left–right by surroundings: the features of the left image and both images in, their partners on the
//! right out.
//!
//! No features are found in the right image. What surrounds a left feature is sought there along the line on
//! which geometry expects it: first in a coarse reduction, where the line is short, then around what was found
//! in finer ones. That takes a fraction of the time that finding and describing features does.

use super::blocks::{self, Block, Place, Sums, first_pixel};
use super::stereo::raw_px;
use super::{Settings, StereoMatch};
use crate::features::{Features, Keypoint};
use crate::geometry::Rectification;
use crate::image::GrayImage;
use crate::refinement::{PyramidPair, from_level, to_level};
use crate::simd::round_i32;
use nalgebra::Vector2;

/// The level of the first search.
const COARSEST: usize = 2;
/// Disparity from one point of a line to the next, px: between them it is taken for straight.
const STRETCH_PX: f64 = 64.0;
/// How near to the best place another one counts as the same, px of the coarsest level.
const SAME_PX: usize = 2;
/// How far a finer level may move what a coarser one found, px of the finer level, across and down.
const REACH_PX: [usize; 2] = [2, 1];
/// Diameter of the largest keypoint that is sought on the finest level, px.
const FINEST_SIZE_PX: f32 = 20.0;
/// Least correlation on every level.
const LEAST_CORRELATION: f32 = 0.7;
/// σ of a place that is found by whole pixels, px of the level.
const SIGMA_PX: f32 = 0.5;

/// Finds partners; keeps its working memory from pair to pair.
#[derive(Debug)]
pub struct SurroundingsMatcher {
    settings: Settings,
    rectification: Rectification,
    sums: Sums,
    line: Vec<Place>,
}

/// What surrounds a left feature on one level.
struct Surroundings {
    block: Block,
    /// From the block's middle pixel to the feature, px of the level.
    rest: Vector2<f64>,
}

impl SurroundingsMatcher {
    /// A matcher for one rig.
    #[must_use]
    pub fn new(settings: Settings, rectification: Rectification) -> Self {
        Self {
            settings,
            rectification,
            sums: Sums::default(),
            line: Vec::new(),
        }
    }

    /// Finds the partners of left features, in their order, replacing what `right` and `matches` held. A partner
    /// has its left feature's looks, and a place and a σ of its own.
    pub fn find(
        &mut self,
        left: &Features,
        images: &PyramidPair<'_>,
        right: &mut Features,
        matches: &mut Vec<StereoMatch>,
    ) {
        matches.clear();
        right.keypoints.clear();
        right.descriptors.clear();
        right.descriptor_len = left.descriptor_len;
        right.keypoints.reserve(left.keypoints.capacity());
        right.descriptors.reserve(left.descriptors.capacity());
        self.sums.fill(images.right.level(COARSEST));
        for (i, keypoint) in left.keypoints.iter().enumerate() {
            let Some((px, sigma_px)) = self.seek(keypoint, images) else {
                continue;
            };
            matches.push(StereoMatch {
                left: i as u32,
                right: right.keypoints.len() as u32,
            });
            right.keypoints.push(Keypoint {
                x_px: px.x as f32,
                y_px: px.y as f32,
                sigma_px,
                ..*keypoint
            });
            right.descriptors.extend_from_slice(left.descriptor(i));
        }
    }

    /// Where the right image shows what surrounds a keypoint, raw px, and the σ of that.
    fn seek(
        &mut self,
        keypoint: &Keypoint,
        images: &PyramidPair<'_>,
    ) -> Option<(Vector2<f64>, f32)> {
        let px = raw_px(keypoint);
        let at = self.rectification.left(&px)?;
        let mut level = COARSEST;
        let coarse = Surroundings::of(images.left.level(level), &px, level)?;
        let mut found = self.search_line(&coarse, images.right.level(level), &at)?;
        while level > 0 && keypoint.size_px <= FINEST_SIZE_PX * (1_u32 << (level - 1)) as f32 {
            level -= 1;
            let finer = Surroundings::of(images.left.level(level), &px, level)?;
            found = finer.refine(images.right.level(level), &found, level)?;
        }
        let sigma_px = keypoint.sigma_px.max(SIGMA_PX * (1_u32 << level) as f32);
        let off_px = (at.y - self.rectification.right(&found)?.y).abs();
        let is_in_band = off_px <= self.settings.row_band_px(sigma_px);
        is_in_band.then_some((found, sigma_px))
    }

    /// Where the line on which geometry expects a left feature, at `at` on the rectified plane, fits it best,
    /// raw px, if that stands out.
    fn search_line(
        &mut self,
        wanted: &Surroundings,
        image: &GrayImage,
        at: &Vector2<f64>,
    ) -> Option<Vector2<f64>> {
        self.take_line(image, at, &wanted.rest);
        wanted.block.compare(image, &self.sums, &mut self.line);
        let places = || self.line.iter().enumerate();
        let (best_at, best) =
            places().max_by(|(_, a), (_, b)| a.correlation.total_cmp(&b.correlation))?;
        let second = places()
            .filter(|(n, _)| n.abs_diff(best_at) > SAME_PX)
            .map(|(_, place)| place.correlation)
            .fold(-1.0, f32::max);
        // What descriptors' distances are to each other, roots of such differences are.
        let ratio = self.settings.max_ratio * self.settings.max_ratio;
        let stands_out = 1.0 - best.correlation <= ratio * (1.0 - second);
        (best.correlation >= LEAST_CORRELATION && stands_out)
            .then(|| wanted.at(image, best.first, COARSEST))
    }

    /// Takes the blocks along a line, from the least disparity to the largest. What is sought lies `rest` px from
    /// their middles.
    fn take_line(&mut self, image: &GrayImage, at: &Vector2<f64>, rest: &Vector2<f64>) {
        self.line.clear();
        let largest_px = self.rectification.disparity_px(self.settings.min_depth_m);
        let mut disparity_px = self.settings.min_disparity_px;
        let middle = |disparity_px: f64| {
            let there = Vector2::new(at.x - disparity_px, at.y);
            let raw = self.rectification.raw_right(&there)?;
            Some((raw.map(|v| to_level(v, COARSEST)) - rest).cast::<f32>())
        };
        let mut from = middle(disparity_px);
        while disparity_px < largest_px {
            disparity_px = (disparity_px + STRETCH_PX).min(largest_px);
            let to = middle(disparity_px);
            let before = self.line.len();
            if let (Some(from), Some(to)) = (from, to) {
                take_stretch(image, from, to, &mut self.line);
            }
            if 0 < before && self.line.len() == before {
                // It has left the image.
                break;
            }
            from = to;
        }
    }
}

/// Appends the blocks from one middle to another, without the last.
fn take_stretch(image: &GrayImage, from: Vector2<f32>, to: Vector2<f32>, line: &mut Vec<Place>) {
    // Lenses may bend what is far outside the image without bound.
    let limit_px = image.width().max(image.height()) as f32;
    let steps = (to - from).amax().ceil().clamp(1.0, STRETCH_PX as f32);
    let step = (to - from) / steps;
    for n in 0..steps as u32 {
        let middle = from + step * n as f32;
        if middle.amax() < limit_px
            && let Some(first) = first_pixel(image, &middle.map(round_i32))
        {
            line.push(Place {
                first,
                correlation: 0.0,
            });
        }
    }
}

impl Surroundings {
    /// What surrounds a place of the left image, raw px, on a level; `None` where that leaves it or is flat.
    fn of(image: &GrayImage, px: &Vector2<f64>, level: usize) -> Option<Self> {
        let at = px.map(|v| to_level(v, level));
        let middle = at.map(f64::round);
        Some(Self {
            block: Block::around(image, &middle.map(|v| v as i32))?,
            rest: at - middle,
        })
    }

    /// Where a block of the right image puts the feature, raw px.
    fn at(&self, image: &GrayImage, first: usize, level: usize) -> Vector2<f64> {
        let at = blocks::middle(image, first).cast::<f64>() + self.rest;
        at.map(|v| from_level(v, level))
    }

    /// Where they fit best near `from`, raw px in and out.
    fn refine(&self, image: &GrayImage, from: &Vector2<f64>, level: usize) -> Option<Vector2<f64>> {
        let middle = (from.map(|v| to_level(v, level)) - self.rest).map(|v| v.round() as i32);
        let reach = Vector2::from(REACH_PX).map(|v| v as i32);
        first_pixel(image, &(middle + reach))?;
        let first = first_pixel(image, &(middle - reach))?;
        let best = self
            .block
            .best_within(image, first, REACH_PX.map(|reach| 2 * reach));
        (best.correlation >= LEAST_CORRELATION).then(|| self.at(image, best.first, level))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::Side;
    use crate::features::{Extractor, surf};
    use crate::refinement::Pyramid;
    use crate::simulation::{
        Looker, SceneName, Settings as SimulationSettings, Simulation, TrajectoryName, small_rig,
    };
    use nalgebra::Point3;
    use rand::{RngExt, SeedableRng};
    use rand_xoshiro::Xoshiro256PlusPlus;

    struct Pair {
        simulation: Simulation,
        left: Features,
        images: [GrayImage; 2],
    }

    /// A pair in the simulated hall.
    fn pair() -> Pair {
        let hall = (SceneName::Hall, TrajectoryName::Straight);
        let settings = SimulationSettings::default();
        let simulation = Simulation::new(hall.0, hall.1, small_rig(), settings).expect("fits");
        let (pair, _) = simulation.pair(0);
        let mut left = Features::default();
        let mut extractor = surf::Surf::new(surf::Settings::default()).expect("valid");
        extractor.extract(&pair.left, &mut left).expect("works");
        Pair {
            simulation,
            left,
            images: [pair.left, pair.right],
        }
    }

    fn find(pair: &Pair, right: &GrayImage) -> (Features, Vec<StereoMatch>) {
        let rectification = Rectification::new(pair.simulation.rig()).expect("side by side");
        let mut matcher = SurroundingsMatcher::new(Settings::default(), rectification);
        let mut pyramids = [Pyramid::default(), Pyramid::default()];
        pyramids[0].fill(&pair.images[0]);
        pyramids[1].fill(right);
        let images = PyramidPair {
            left: &pyramids[0],
            right: &pyramids[1],
        };
        let (mut features, mut matches) = Default::default();
        matcher.find(&pair.left, &images, &mut features, &mut matches);
        assert_eq!(features.len(), matches.len());
        (features, matches)
    }

    #[test]
    fn partners_are_where_the_right_camera_sees_the_same() {
        let pair = pair();
        let (right, matches) = find(&pair, &pair.images[1]);
        let rig = pair.simulation.rig();
        let looker = Looker::new(&pair.simulation, 0, Side::Left);
        let (mut near, mut all) = (0, 0);
        for m in &matches {
            let keypoint = &pair.left.keypoints[m.left as usize];
            let partner = &right.keypoints[m.right as usize];
            assert_eq!(
                right.descriptor(m.right as usize),
                pair.left.descriptor(m.left as usize)
            );
            let px = raw_px(keypoint);
            let (Some(depth_m), Some(ray)) = (looker.depth_m(&px), rig.left.unproject(&px)) else {
                continue;
            };
            let point = Point3::new(ray.x * depth_m, ray.y * depth_m, depth_m);
            let Some(truth) = rig.right.project(&(rig.right_from_left * point)) else {
                continue;
            };
            all += 1;
            near +=
                usize::from((raw_px(partner) - truth).norm() < 3.0 * f64::from(partner.sigma_px));
        }
        // Most have one; not those that a body hides on the right or at whose edge two depths meet.
        assert!(2 * matches.len() > pair.left.len(), "{}", matches.len());
        assert!(20 * near > 19 * all && all > 100, "{near} of {all}");
    }

    #[test]
    fn brightness_and_contrast_do_not_matter() {
        let pair = pair();
        let (_, bright) = find(&pair, &pair.images[1]);
        let pixels = pair.images[1].pixels().iter().map(|p| 30 + p / 2).collect();
        let right = &pair.images[1];
        let dull = GrayImage::from_vec(right.width(), right.height(), pixels).expect("full");
        let (_, dull) = find(&pair, &dull);
        assert!(dull.len().abs_diff(bright.len()) * 20 < bright.len());
    }

    #[test]
    fn hardly_any_have_partners_in_an_image_of_something_else() {
        let pair = pair();
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(1);
        let (width, height) = (pair.images[1].width(), pair.images[1].height());
        let noise = (0..width * height).map(|_| rng.random()).collect();
        let noise = GrayImage::from_vec(width, height, noise).expect("full");
        for other in [
            noise,
            GrayImage::filled(width, height, 80),
            GrayImage::default(),
        ] {
            let (_, matches) = find(&pair, &other);
            assert!(50 * matches.len() < pair.left.len(), "{}", matches.len());
        }
    }
}
