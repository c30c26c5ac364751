//! SURF: a grey image in, its [`Features`] out.
//!
//! Bay, Ess, Tuytelaars, Van Gool: *Speeded-Up Robust Features (SURF)*, Computer Vision and Image
//! Understanding 110 (3), 2008. Thresholds, sizes, angles, signs and the order of a descriptor's
//! floats are those of OpenCV's SURF, so that values compare. The steps are files of their own:
//! integral image, Hessian responses, their extrema, spread, orientation, descriptor.

use super::descriptor::Describer;
use super::extrema::{Detector, Search};
use super::integral::IntegralImage;
use super::orientation::{Compass, Direction};
use super::spread::Spread;
use super::{ExtractError, Extractor, Features, Keypoint};
use crate::image::GrayImage;
use crate::settings::SettingError;

/// Scale of a filter in units of its size: 9 px approximate a Gaussian of σ 1.2 px.
const SCALE_PER_SIZE: f32 = 1.2 / 9.0;

/// The knobs of [`Surf`].
#[derive(Clone, Debug, PartialEq, serde::Deserialize, serde::Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// Determinant of the Hessian that a keypoint exceeds, grey values² / px⁴ as OpenCV scales it;
    /// 0 to 1e6, default 100. Low, so that images of little contrast have features too: the
    /// budget keeps the strongest.
    pub hessian: f32,
    /// Octaves, each with half the samples of the one before; 1 to 8, default 4.
    pub octaves: u32,
    /// Layers an octave in which keypoints are found; 1 to 8, default 3.
    pub layers: usize,
    /// 128 floats a descriptor instead of 64: more distinctive, slower to match; default false.
    pub extended: bool,
    /// No orientation: descriptors of a camera that never rolls; default false.
    pub upright: bool,
    /// Keypoints an image at most, spread evenly over it; 0 for all, default 1000.
    pub budget: usize,
    /// σ of a keypoint's position per px of its scale (scale = size · 1.2 / 9); 0.001 to 10.
    pub noise_per_scale: f32,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            hessian: 100.0,
            octaves: 4,
            layers: 3,
            extended: false,
            upright: false,
            budget: 1000,
            noise_per_scale: 0.1,
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
    compass: Compass,
    integral: IntegralImage,
    detector: Detector,
    spread: Spread,
    describer: Describer,
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
            compass: Compass::new(),
            integral: IntegralImage::default(),
            detector: Detector::default(),
            spread: Spread::default(),
            describer: Describer::new(),
        })
    }

    /// Gives direction, σ and descriptor to the keypoints; drops those so near to the border that
    /// they have no direction.
    fn describe(&mut self, image: &GrayImage, features: &mut Features) {
        let len = self.settings.descriptor_len();
        let Features {
            keypoints,
            descriptor_len,
            descriptors,
        } = features;
        *descriptor_len = len;
        descriptors.resize(keypoints.len() * len, 0.0);
        self.describer.begin();
        let mut described = 0;
        for n in 0..keypoints.len() {
            let mut keypoint = keypoints[n];
            let Some(direction) = self.direction(&keypoint) else {
                continue;
            };
            keypoint.angle_rad = direction.angle_rad;
            keypoint.sigma_px = self.settings.noise_per_scale * keypoint.size_px * SCALE_PER_SIZE;
            let descriptor = &mut descriptors[described * len..][..len];
            self.describer
                .describe(image, &keypoint, direction, descriptor);
            keypoints[described] = keypoint;
            described += 1;
        }
        keypoints.truncate(described);
        descriptors.truncate(described * len);
    }

    fn direction(&self, keypoint: &Keypoint) -> Option<Direction> {
        if self.settings.upright {
            return Some(Direction::UP);
        }
        let scale_px = keypoint.size_px * SCALE_PER_SIZE;
        let at = (keypoint.x_px, keypoint.y_px);
        self.compass.direction(&self.integral, at, scale_px)
    }

    /// Elements of working memory held.
    #[cfg(test)]
    fn capacity(&self) -> usize {
        self.integral.capacity()
            + self.detector.capacity()
            + self.spread.capacity()
            + self.describer.capacity()
    }
}

impl Extractor for Surf {
    fn extract(&mut self, image: &GrayImage, features: &mut Features) -> Result<(), ExtractError> {
        features.keypoints.clear();
        self.integral.compute(image);
        let search = Search {
            octaves: self.settings.octaves,
            layers: self.settings.layers,
            threshold: self.settings.hessian,
        };
        self.detector
            .detect(&self.integral, search, &mut features.keypoints);
        let size = (image.width(), image.height());
        self.spread
            .keep(&mut features.keypoints, self.settings.budget, size);
        self.describe(image, features);
        Ok(())
    }
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
