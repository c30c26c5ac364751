//! OpenCV's detectors: one raw image in, its SIFT, ORB or AKAZE features out.
//!
//! They are alternatives to SURF and a yardstick for it. What OpenCV answers is brought into this
//! crate's terms, so that no later stage can tell the detectors apart:
//!
//! - Positions have pixel centres at integers. SIFT doubles the image and ORB shrinks it without
//!   regard to the centres; the shift that this causes is taken out.
//! - Descriptors are floats of unit length. A binary one of n bits becomes n values of ±1/√n, whose
//!   squared Euclidean distance is 4/n times the Hamming distance.
//!
//! OpenCV runs in the calling thread alone: the pipeline already works on two images at a time, and
//! the order of the features then depends on nothing but the image.

use super::{ExtractError, Extractor, Features, Keypoint};
use crate::image::GrayImage;
use crate::settings::SettingError;
use opencv::core::{self, KeyPoint, KeyPointTraitConst, Mat, MatTraitConstManual, Ptr, Vector};
use opencv::features2d::{
    AKAZE, AKAZETrait, Feature2D, Feature2DTrait, ORB, ORB_ScoreType, ORBTrait, SIFT,
};
use std::f32::consts::TAU;
use std::sync::OnceLock;

/// An image with a shorter side is smaller than any descriptor's neighbourhood: it has no features, and
/// OpenCV fails at its pyramid.
const LEAST_SIDE_PX: u32 = 8;
/// OpenCV's ratio of neighbouring levels of ORB's pyramid, which is kept.
const ORB_LEVEL_RATIO: f32 = 1.2;
/// A SIFT keypoint's diameter over the standard deviation of its Gaussian.
const SIFT_SIZE_PER_SCALE: f32 = 2.0;
/// An AKAZE keypoint's diameter over the standard deviation of its level.
const AKAZE_SIZE_PER_SCALE: f32 = 3.0;

/// Which of OpenCV's detectors.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, serde::Deserialize, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Detector {
    /// SIFT (Lowe 2004): extrema of differences of Gaussians, 128 floats.
    Sift,
    /// ORB (Rublee et al. 2011): oriented FAST corners, 256 bits.
    Orb,
    /// AKAZE (Alcantarilla et al. 2013): Hessian extrema in a non-linear scale space, 486 bits.
    Akaze,
}

impl Detector {
    /// Its name, as its authors write it.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Sift => "SIFT",
            Self::Orb => "ORB",
            Self::Akaze => "AKAZE",
        }
    }

    /// How many floats one of its descriptors has.
    #[must_use]
    pub fn descriptor_len(self) -> usize {
        match self {
            Self::Sift => 128,
            Self::Orb => 256,
            Self::Akaze => 486,
        }
    }

    /// A position's standard deviation over the scale at which it was found. Measured on textures
    /// shifted by known fractions of a pixel under noise of two grey levels, and held by a test; one
    /// number for all octaves, although SIFT and AKAZE grow worse more slowly than their scale does.
    /// ORB's is that of whole pixels of a level, 1/√12, and a little more.
    fn noise_per_scale(self) -> f32 {
        match self {
            Self::Sift => 0.023,
            Self::Orb => 0.32,
            Self::Akaze => 0.017,
        }
    }
}

/// The knobs of OpenCV's detectors.
#[derive(Clone, Debug, PartialEq, serde::Deserialize, serde::Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// Most features that an image may have; the strongest are kept. Count, 1 to 100000, default
    /// 2000: enough for a motion estimate from a 1.2 megapixel image.
    pub budget: u32,
    /// SIFT's least contrast of an extremum, for grey values from 0 to 1 and spread over the layers
    /// of an octave. Dimensionless, 0 to 1, default 0.04: Lowe's choice as OpenCV has it.
    pub sift_contrast_threshold: f64,
    /// How much a ring pixel must differ from the centre for ORB's FAST corners. Grey levels, 1 to
    /// 255, default 20: OpenCV's choice.
    pub orb_fast_threshold: i32,
    /// AKAZE's least determinant of the Hessian, for grey values from 0 to 1. Dimensionless, 0 to 1,
    /// default 0.001: OpenCV's choice.
    pub akaze_threshold: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            budget: 2000,
            sift_contrast_threshold: 0.04,
            orb_fast_threshold: 20,
            akaze_threshold: 0.001,
        }
    }
}

impl Settings {
    /// Refuses values out of their range.
    ///
    /// # Errors
    /// The first knob whose value lies outside.
    pub fn check(&self) -> Result<(), SettingError> {
        SettingError::unless_in("budget", self.budget, 1..=100_000)?;
        SettingError::unless_in(
            "sift_contrast_threshold",
            self.sift_contrast_threshold,
            0.0..=1.0,
        )?;
        SettingError::unless_in("orb_fast_threshold", self.orb_fast_threshold, 1..=255)?;
        SettingError::unless_in("akaze_threshold", self.akaze_threshold, 0.0..=1.0)
    }
}

/// One of OpenCV's detectors, as an [`Extractor`].
pub struct OpencvExtractor {
    detector: Detector,
    budget: usize,
    feature2d: Ptr<Feature2D>,
    found: Vector<KeyPoint>,
    described: Mat,
    order: Vec<usize>,
}

impl OpencvExtractor {
    /// Makes `detector` ready to work.
    ///
    /// # Errors
    /// OpenCV refuses the settings.
    pub fn new(detector: Detector, settings: &Settings) -> Result<Self, ExtractError> {
        run_in_calling_thread()
            .and_then(|()| create(detector, settings))
            .map(|feature2d| Self {
                detector,
                budget: settings.budget as usize,
                feature2d,
                found: Vector::new(),
                described: Mat::default(),
                order: Vec::new(),
            })
            .map_err(|cause| library_error(detector, &cause))
    }

    fn detect_and_describe(&mut self, image: &GrayImage) -> opencv::Result<()> {
        let (rows, cols) = (
            i32::try_from(image.height())?,
            i32::try_from(image.width())?,
        );
        let pixels = Mat::new_rows_cols_with_data(rows, cols, image.pixels())?;
        self.feature2d.detect_and_compute_def(
            &pixels,
            &core::no_array(),
            &mut self.found,
            &mut self.described,
        )
    }

    /// Notes in `order` the strongest features within the budget, in the order in which they were
    /// found: OpenCV's own limit is overrun by features of equal strength, and AKAZE has none.
    fn choose_strongest(&mut self) {
        let responses: Vec<f32> = self.found.iter().map(|found| found.response()).collect();
        self.order.clear();
        self.order.extend(0..responses.len());
        if responses.len() > self.budget {
            self.order
                .sort_by(|&a, &b| responses[b].total_cmp(&responses[a]));
            self.order.truncate(self.budget);
            self.order.sort_unstable();
        }
    }

    fn collect(&self, image: &GrayImage, features: &mut Features) -> opencv::Result<()> {
        let size = [image.width(), image.height()];
        for &index in &self.order {
            features
                .keypoints
                .push(keypoint(self.detector, &self.found.get(index)?, size));
            let row = i32::try_from(index)?;
            match self.detector {
                Detector::Sift => push_normalised(
                    self.described.at_row::<f32>(row)?,
                    &mut features.descriptors,
                ),
                Detector::Orb | Detector::Akaze => push_bits(
                    self.described.at_row::<u8>(row)?,
                    self.detector.descriptor_len(),
                    &mut features.descriptors,
                ),
            }
        }
        Ok(())
    }
}

impl Extractor for OpencvExtractor {
    fn extract(&mut self, image: &GrayImage, features: &mut Features) -> Result<(), ExtractError> {
        features.keypoints.clear();
        features.descriptors.clear();
        features.descriptor_len = self.detector.descriptor_len();
        if image.width().min(image.height()) < LEAST_SIDE_PX {
            return Ok(());
        }
        self.detect_and_describe(image)
            .map(|()| self.choose_strongest())
            .and_then(|()| self.collect(image, features))
            .map_err(|cause| library_error(self.detector, &cause))
    }
}

/// Takes OpenCV's own threads away, once: it is not safe to do so while another thread uses them.
fn run_in_calling_thread() -> opencv::Result<()> {
    static DONE: OnceLock<Result<(), (i32, String)>> = OnceLock::new();
    DONE.get_or_init(|| core::set_num_threads(1).map_err(|cause| (cause.code, cause.message)))
        .clone()
        .map_err(|(code, message)| opencv::Error::new(code, message))
}

fn library_error(detector: Detector, cause: &opencv::Error) -> ExtractError {
    ExtractError::Library {
        detector: detector.as_str(),
        // OpenCV's messages end in a line break, which would tear ours apart.
        cause: cause.message.trim().replace('\n', " "),
    }
}

fn create(detector: Detector, settings: &Settings) -> opencv::Result<Ptr<Feature2D>> {
    let budget = i32::try_from(settings.budget)?;
    Ok(match detector {
        Detector::Sift => SIFT::create
            .create_sift(budget, settings.sift_contrast_threshold)?
            .into(),
        Detector::Orb => {
            let mut orb = ORB::create_def()?;
            orb.set_max_features(budget)?;
            orb.set_scale_factor(f64::from(ORB_LEVEL_RATIO))?;
            orb.set_score_type(ORB_ScoreType::HARRIS_SCORE)?;
            orb.set_fast_threshold(settings.orb_fast_threshold)?;
            orb.into()
        }
        Detector::Akaze => {
            let mut akaze = AKAZE::create_def()?;
            akaze.set_threshold(settings.akaze_threshold)?;
            akaze.into()
        }
    })
}

/// `SIFT::create`, whose C++ form has had one argument more since OpenCV 4.8; the binding is generated
/// from whichever is installed, and `Arguments` tells them apart.
trait CreateSift<Arguments> {
    fn create_sift(self, budget: i32, contrast: f64) -> opencv::Result<Ptr<SIFT>>;
}

/// Layers of an octave, edge threshold and first blur: Lowe's, and OpenCV's defaults.
const SIFT_LAYERS: i32 = 3;
const SIFT_EDGE_THRESHOLD: f64 = 10.0;
const SIFT_SIGMA: f64 = 1.6;

impl<F> CreateSift<(i32, i32, f64, f64, f64)> for F
where
    F: Fn(i32, i32, f64, f64, f64) -> opencv::Result<Ptr<SIFT>>,
{
    fn create_sift(self, budget: i32, contrast: f64) -> opencv::Result<Ptr<SIFT>> {
        self(
            budget,
            SIFT_LAYERS,
            contrast,
            SIFT_EDGE_THRESHOLD,
            SIFT_SIGMA,
        )
    }
}

impl<F> CreateSift<(i32, i32, f64, f64, f64, bool)> for F
where
    F: Fn(i32, i32, f64, f64, f64, bool) -> opencv::Result<Ptr<SIFT>>,
{
    fn create_sift(self, budget: i32, contrast: f64) -> opencv::Result<Ptr<SIFT>> {
        // Imprecise upscaling, as the older versions have it: `keypoint` takes its shift out.
        self(
            budget,
            SIFT_LAYERS,
            contrast,
            SIFT_EDGE_THRESHOLD,
            SIFT_SIGMA,
            false,
        )
    }
}

/// OpenCV's keypoint, found in an image of `size` pixels, in this crate's terms.
fn keypoint(detector: Detector, found: &KeyPoint, [width, height]: [u32; 2]) -> Keypoint {
    let at = found.pt();
    let (octave, scale, x_px, y_px) = match detector {
        // The lowest byte holds the octave, −1 for the doubled image. Doubling puts the centre of
        // pixel 0 at 0.5, which halving turns into 0.25.
        Detector::Sift => (
            i32::from(found.octave() as i8) + 1,
            found.size() / SIFT_SIZE_PER_SCALE,
            at.x - 0.25,
            at.y - 0.25,
        ),
        Detector::Orb => {
            let scale = ORB_LEVEL_RATIO.powi(found.octave());
            (
                found.octave(),
                scale,
                orb_position(at.x, scale, width),
                orb_position(at.y, scale, height),
            )
        }
        Detector::Akaze => (
            found.octave(),
            found.size() / AKAZE_SIZE_PER_SCALE,
            at.x,
            at.y,
        ),
    };
    Keypoint {
        x_px,
        y_px,
        size_px: found.size(),
        angle_rad: found.angle().to_radians().rem_euclid(TAU),
        response: found.response(),
        octave,
        laplacian: 0,
        sigma_px: detector.noise_per_scale() * scale,
    }
}

/// Where in the image ORB's `position` is, along a side of `length` pixels. ORB multiplies the pixel of
/// the level by the nominal `scale`; but a level has a whole number of pixels, so that the true ratio
/// differs a little, and it is the levels' edges that coincide, half a pixel before the first centres.
fn orb_position(position: f32, scale: f32, length: u32) -> f32 {
    let length = length as f32;
    let ratio = length / (length / scale).round_ties_even();
    (position / scale + 0.5) * ratio - 0.5
}

fn push_normalised(values: &[f32], descriptors: &mut Vec<f32>) {
    let norm = values.iter().map(|value| value * value).sum::<f32>().sqrt();
    let factor = if norm > 0.0 { norm.recip() } else { 0.0 };
    descriptors.extend(values.iter().map(|value| value * factor));
}

/// Appends the first `len` bits, the lowest of a byte first, as ±1/√len.
fn push_bits(bytes: &[u8], len: usize, descriptors: &mut Vec<f32>) {
    let one = (len as f32).sqrt().recip();
    descriptors.extend((0..len).map(|bit| {
        if bytes[bit / 8] >> (bit % 8) & 1 == 1 {
            one
        } else {
            -one
        }
    }));
}

#[cfg(test)]
mod tests {
    use super::*;
    use opencv::core::NORM_HAMMING;
    use proptest::prelude::*;

    /// Hamming distance as OpenCV counts it.
    fn hamming(a: &[u8], b: &[u8]) -> f64 {
        let (a, b) = (Mat::from_slice(a).unwrap(), Mat::from_slice(b).unwrap());
        core::norm2(&a, &b, NORM_HAMMING, &core::no_array()).unwrap()
    }

    fn squared_distance(a: &[u8], b: &[u8], len: usize) -> f64 {
        let (mut x, mut y) = (Vec::new(), Vec::new());
        push_bits(a, len, &mut x);
        push_bits(b, len, &mut y);
        assert_eq!((x.len(), y.len()), (len, len));
        x.iter()
            .zip(&y)
            .map(|(x, y)| f64::from(x - y).powi(2))
            .sum()
    }

    proptest! {
        /// 1/√256 and all that follows are exact in binary.
        #[test]
        fn orb_distance_is_the_hamming_distance_exactly(
            a in prop::array::uniform32(any::<u8>()),
            b in prop::array::uniform32(any::<u8>()),
        ) {
            prop_assert_eq!(squared_distance(&a, &b, 256), 4.0 * hamming(&a, &b) / 256.0);
        }

        /// 1/√486 is rounded once, to f32: a relative error of 2⁻²⁴, twice that of its square, and
        /// as much again from the difference.
        #[test]
        fn akaze_distance_is_the_hamming_distance(
            mut a in prop::collection::vec(any::<u8>(), 61),
            mut b in prop::collection::vec(any::<u8>(), 61),
        ) {
            // OpenCV leaves the last two bits clear.
            a[60] &= 0x3f;
            b[60] &= 0x3f;
            let wanted = 4.0 * hamming(&a, &b) / 486.0;
            prop_assert!((squared_distance(&a, &b, 486) - wanted).abs() <= 4.0 * 2f64.powi(-24) * wanted);
        }
    }

    #[test]
    fn a_binary_descriptor_has_unit_length() {
        let mut descriptor = Vec::new();
        push_bits(&[0b1010_0110; 32], 256, &mut descriptor);
        assert_eq!(descriptor.iter().map(|x| x * x).sum::<f32>(), 1.0);
        assert_eq!(descriptor[..4], [-0.0625, 0.0625, 0.0625, -0.0625]);
    }

    #[test]
    fn settings_out_of_range_are_named() {
        assert!(Settings::default().check().is_ok());
        let settings = Settings {
            orb_fast_threshold: 0,
            ..Settings::default()
        };
        assert_eq!(settings.check().unwrap_err().key, "orb_fast_threshold");
    }
}
