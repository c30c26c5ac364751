//! SURF: a grey image in, its [`Features`] out.
//!
//! Bay, Ess, Tuytelaars, Van Gool: *Speeded-Up Robust Features (SURF)*, Computer Vision and Image
//! Understanding 110 (3), 2008. Thresholds, sizes, angles, signs and the order of a descriptor's
//! floats are those of OpenCV's SURF, so that values compare. The steps are files of their own:
//! integral image, Hessian responses, their extrema, draw, spread, orientation, descriptor.

use super::descriptor::Describer;
use super::draw::Draw;
use super::extrema::{Candidate, Detector, Search};
use super::integral::IntegralImage;
use super::orientation::{Compass, Direction};
use super::spread::Spread;
use super::{ExtractError, Extractor, Features, Keypoint, make_room};
use crate::image::GrayImage;
use crate::settings::SettingError;

/// Scale of a filter in units of its size: 9 px approximate a Gaussian of σ 1.2 px.
const SCALE_PER_SIZE: f32 = 1.2 / 9.0;

/// Size of a keypoint that is to be removed.
const DROPPED: f32 = 0.0;

/// Pixels for each candidate that there is room for from the start: so few that hardly an image makes
/// the room grow.
const PIXELS_PER_CANDIDATE: usize = 32;
/// The same for each keypoint before the budget is applied.
const PIXELS_PER_FOUND: usize = 64;

/// The knobs of [`Surf`].
#[derive(Clone, Debug, PartialEq, serde::Deserialize, serde::Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// Determinant of the Hessian that a keypoint exceeds, grey values² / px⁴ as OpenCV scales it;
    /// 0 to 1e6, default 100. Low, so that images of little contrast have features too: the
    /// budget keeps the strongest. Of keypoints between 50 and 100, 59 to 77 % were found again
    /// under noise on five images; above 1600, 81 to 95 %.
    pub hessian: f32,
    /// Octaves, each with half the samples of the one before; 1 to 8, default 4.
    pub octaves: u32,
    /// Layers an octave in which keypoints are found; 1 to 8, default 3.
    pub layers: usize,
    /// Distance of the samples in the first octave, px; 1, as OpenCV has it, or 2, as Bay et al. have it;
    /// default 1. With 2 a quarter as many are looked at. Under noise, and moved by one pixel, 70 % of the
    /// keypoints are then found again instead of 90 %, with a σ of 0.09 to 0.12 scales instead of 0.02 to 0.04.
    pub sampling_px: usize,
    /// 128 floats a descriptor instead of 64: more distinctive, slower to match; default false.
    pub extended: bool,
    /// No orientation; default false. Of the keypoints found again after a roll of 5°, 10°, 15°, 20°, 30° 96, 94, 91,
    /// 84, 57 % are then recognised by their descriptors, with an orientation 87, 84, 84, 79, 78 %.
    pub upright: bool,
    /// Keypoints an image at most, spread evenly over it; 0 for all, default 1000.
    pub budget: usize,
    /// σ of a keypoint's position, in x and in y, in units of its scale (scale = size · 1.2 / 9);
    /// 0.001 to 10, default 0.12. Half the width that holds 68 % of the differences between the
    /// keypoints of five images and those of the same images shifted, turned, scaled and with
    /// noise of 2 to 4 grey values was 0.17 scales, about the same for every scale; √2 less is one
    /// keypoint's share.
    pub noise_per_scale: f32,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            hessian: 100.0,
            octaves: 4,
            layers: 3,
            sampling_px: 1,
            extended: false,
            upright: false,
            budget: 1000,
            noise_per_scale: 0.12,
        }
    }
}

impl Settings {
    /// Whether every setting is within its range.
    ///
    /// # Errors
    /// The first that is not.
    pub fn check(&self) -> Result<(), SettingError> {
        SettingError::unless_in("hessian", self.hessian, 0.0..=1e6)?;
        SettingError::unless_in("octaves", self.octaves, 1..=8)?;
        SettingError::unless_in("layers", self.layers, 1..=8)?;
        SettingError::unless_in("sampling_px", self.sampling_px, 1..=2)?;
        SettingError::unless_in("budget", self.budget, 0..=1_000_000)?;
        SettingError::unless_in("noise_per_scale", self.noise_per_scale, 0.001..=10.0)
    }

    /// Floats a descriptor.
    fn descriptor_len(&self) -> usize {
        if self.extended { 128 } else { 64 }
    }
}

/// The SURF detector and descriptor with its working memory, which no image after the first of its
/// size makes grow.
#[derive(Debug)]
pub struct Surf {
    settings: Settings,
    share: f32,
    compass: Compass,
    integral: IntegralImage,
    detector: Detector,
    candidates: Vec<Candidate>,
    draw: Draw,
    found: Vec<Keypoint>,
    spread: Spread,
    describer: Describer,
    order: Vec<u32>,
}

impl Surf {
    /// A detector with the given settings.
    ///
    /// # Errors
    /// A setting is out of its range.
    pub fn new(settings: Settings) -> Result<Self, SettingError> {
        settings.check()?;
        Ok(Self {
            settings,
            share: 1.0,
            compass: Compass::new(),
            integral: IntegralImage::default(),
            detector: Detector::default(),
            candidates: Vec::new(),
            draw: Draw::default(),
            found: Vec::new(),
            spread: Spread::default(),
            describer: Describer::new(),
            order: Vec::new(),
        })
    }

    /// Makes room for what an image of this size holds at the first of them: which worker meets the
    /// richest image, and when, is chance.
    fn make_room(&mut self, image: &GrayImage, features: &mut Features) {
        let pixels = image.pixels().len();
        let found = pixels / PIXELS_PER_FOUND;
        let kept = self.settings.budget.min(pixels);
        let candidates = pixels / PIXELS_PER_CANDIDATE;
        make_room(&mut self.candidates, candidates);
        self.detector.make_room(candidates);
        self.draw.make_room(candidates);
        make_room(&mut self.found, found);
        self.spread.make_room(found);
        make_room(&mut self.order, kept);
        make_room(&mut features.keypoints, kept);
        let floats = kept * self.settings.descriptor_len();
        make_room(&mut features.descriptors, floats);
        self.describer.make_room(image, self.search().largest_px());
    }

    /// Keypoints to be kept of those found, 0 for all: the budget's share.
    fn budget(&self, found: usize) -> usize {
        if self.share >= 1.0 {
            return self.settings.budget;
        }
        let all = match self.settings.budget {
            0 => found,
            budget => budget.min(found),
        };
        ((all as f32 * self.share) as usize).max(1)
    }

    /// Gives direction, σ and descriptor to the keypoints; drops those so near to the border that
    /// they have no direction.
    fn describe(&mut self, image: &GrayImage, features: &mut Features) {
        let len = self.settings.descriptor_len();
        features.descriptor_len = len;
        features.descriptors.resize(features.len() * len, 0.0);
        self.describer.begin();
        self.order_by_place(&features.keypoints);
        for n in 0..self.order.len() {
            let n = self.order[n] as usize;
            let keypoint = &mut features.keypoints[n];
            let Some(direction) = self.direction(keypoint) else {
                keypoint.size_px = DROPPED;
                continue;
            };
            keypoint.angle_rad = direction.angle_rad;
            keypoint.sigma_px = self.settings.noise_per_scale * keypoint.size_px * SCALE_PER_SIZE;
            let descriptor = &mut features.descriptors[n * len..][..len];
            self.describer
                .describe(image, keypoint, direction, descriptor);
        }
        remove_dropped(features);
    }

    /// Fills `order` with the indices of the keypoints, band by band of the image, so that
    /// neighbours follow one another and find their pixels in the cache.
    fn order_by_place(&mut self, keypoints: &[Keypoint]) {
        const BAND_PX: f32 = 32.0;
        self.order.clear();
        self.order.extend(0..keypoints.len() as u32);
        self.order.sort_unstable_by_key(|&n| {
            let keypoint = &keypoints[n as usize];
            ((keypoint.y_px / BAND_PX) as u32, keypoint.x_px as u32, n)
        });
    }

    fn direction(&self, keypoint: &Keypoint) -> Option<Direction> {
        if self.settings.upright {
            return Some(Direction::UP);
        }
        let scale_px = keypoint.size_px * SCALE_PER_SIZE;
        let at = (keypoint.x_px, keypoint.y_px);
        self.compass.direction(&self.integral, at, scale_px)
    }

    fn search(&self) -> Search {
        Search {
            octaves: self.settings.octaves,
            layers: self.settings.layers,
            sampling_px: self.settings.sampling_px,
            threshold: self.settings.hessian,
        }
    }

    /// Elements of working memory held.
    #[cfg(test)]
    fn capacity(&self) -> usize {
        self.integral.capacity()
            + self.detector.capacity()
            + self.candidates.capacity()
            + self.draw.capacity()
            + self.found.capacity()
            + self.spread.capacity()
            + self.describer.capacity()
            + self.order.capacity()
    }
}

impl Extractor for Surf {
    fn extract(&mut self, image: &GrayImage, features: &mut Features) -> Result<(), ExtractError> {
        self.make_room(image, features);
        self.integral.compute(image);
        self.detector
            .detect(&self.integral, self.search(), &mut self.candidates);
        let size = (image.width(), image.height());
        let budget = self.budget(self.candidates.len());
        self.found.clear();
        self.draw.confirm(
            &self.candidates,
            budget,
            size,
            |candidate| self.detector.confirm(&self.integral, candidate),
            &mut self.found,
        );
        let kept = &mut features.keypoints;
        self.spread.keep(&mut self.found, budget, size, kept);
        self.describe(image, features);
        Ok(())
    }

    fn set_share(&mut self, share: f32) {
        self.share = share;
    }
}

/// Removes the keypoints of size [`DROPPED`] with their descriptors; the others keep their order.
fn remove_dropped(features: &mut Features) {
    let len = features.descriptor_len;
    let mut kept = 0;
    for n in 0..features.len() {
        if features.keypoints[n].size_px == DROPPED {
            continue;
        }
        if kept < n {
            features.keypoints[kept] = features.keypoints[n];
            features
                .descriptors
                .copy_within(n * len..(n + 1) * len, kept * len);
        }
        kept += 1;
    }
    features.keypoints.truncate(kept);
    features.descriptors.truncate(kept * len);
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A pattern with corners of all sizes.
    fn pattern(width: u32, height: u32) -> GrayImage {
        let pixel = |n: u32| {
            let (x, y) = (n % width, n / width);
            ((x * x / 7 + y * y / 11 + (x / 9) * (y / 13) * 31) % 251) as u8
        };
        let pixels = (0..width * height).map(pixel).collect();
        GrayImage::from_vec(width, height, pixels).unwrap_or_default()
    }

    #[test]
    fn working_memory_stops_growing_after_the_first_image() {
        let image = pattern(320, 240);
        let settings = Settings {
            budget: 200,
            ..Settings::default()
        };
        let mut surf = Surf::new(settings).unwrap_or_else(|e| unreachable!("{e:?}"));
        let mut features = Features::default();
        let mut sizes = Vec::new();
        for _ in 0..4 {
            // In turn with a smaller image, which must not make anything start again.
            for image in [&pattern(200, 100), &image] {
                assert_eq!(surf.extract(image, &mut features), Ok(()));
            }
            assert_eq!(features.len(), 200);
            let keypoints = features.keypoints.capacity();
            sizes.push((surf.capacity(), keypoints, features.descriptors.capacity()));
        }
        assert!(sizes.iter().all(|size| *size == sizes[0]), "{sizes:?}");
    }
}
