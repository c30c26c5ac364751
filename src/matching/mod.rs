//! Matching: features of two stereo pairs in, stereo matches and tracks out.
//!
//! A *stereo match* joins a left and a right feature of one pair; a *track* joins a stereo match
//! of an earlier pair with one of this pair, and has passed the circle left now – right now – right
//! before – left before. Everything is found among few candidates: left–right in a narrow band of
//! rectified rows, over time near the predicted position. No image is resampled. OpenCV's FLANN may
//! propose the candidates instead, where that was built in; they pass the same gates. Or a left feature's
//! partner is what the right image shows of its surroundings, and no feature of that image.

mod blocks;
mod candidates;
mod descriptor;
#[cfg(feature = "opencv")]
pub mod flann;
mod grid;
mod pairing;
mod stereo;
mod surroundings;
#[cfg(test)]
pub(crate) mod synthetic;
mod temporal;
#[cfg(test)]
mod tests;

pub use candidates::{MatchError, MatcherName};
pub use stereo::{StereoMatch, StereoMatcher};
pub use surroundings::SurroundingsMatcher;
pub use temporal::{MatchedPair, TemporalMatcher, Track};

use crate::settings::SettingError;
use serde::{Deserialize, Serialize};

/// What of the right image is matched with the left features.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Partners {
    /// Features that are found in it.
    #[default]
    Features,
    /// Its pixels: no features are found in it.
    Surroundings,
}

/// How features are matched.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// Where candidates come from: "guided", from where geometry expects them, or "flann", from the
    /// two nearest descriptors by OpenCV's FLANN where that was built in. Default "guided": FLANN
    /// is slower, and misses what repeats itself elsewhere in the image.
    pub matcher: MatcherName,
    /// What left features are matched with: "features" of the right image, or, with the window's method,
    /// "surroundings": what surrounds them is sought in the right image, in which no features are found then.
    /// Default "features".
    pub partners: Partners,
    /// Greatest ratio of the best descriptor distance to the second best among the candidates of
    /// one feature. No unit, 0.1 to 1, default 0.85: candidates are few, so that a stricter test
    /// loses good matches without catching more bad ones.
    pub max_ratio: f32,
    /// Greatest descriptor distance of a match. No unit (descriptors have length 1), 0 to 2,
    /// default 1: what is farther apart is hardly nearer than chance (√2); a quarter of the bits of
    /// a binary descriptor.
    pub max_distance: f32,
    /// How far a right feature's rectified row may lie from the left one's. px, 0.1 to 50, default
    /// 2: three σ of fine features and what a good calibration leaves.
    pub row_band_px: f64,
    /// The same, for coarse features: in units of the keypoint's own σ, 0 to 10, default 3.
    pub row_band_sigmas: f64,
    /// Smallest disparity. px, −20 to 100, default −1: points at infinity stay, for they measure
    /// rotation.
    pub min_disparity_px: f64,
    /// Distance of the nearest point, which bounds the disparity. m, 0.01 to 100, default 0.5.
    pub min_depth_m: f64,
    /// How far from its predicted position a feature is sought over time. px, 1 to 4096, default
    /// 40: what a robot's change of velocity from frame to frame may shift.
    pub search_radius_px: f64,
    /// The same where there is no prediction yet, or where it failed. Share of the image's width,
    /// 0.01 to 1, default 0.25.
    pub wide_search: f64,
    /// Largest ratio of the sizes of matched keypoints. No unit, 1 to 10, default 1.6.
    pub max_size_ratio: f32,
    /// Settings of FLANN.
    #[cfg(feature = "opencv")]
    pub flann: flann::Settings,
    /// Settings of FLANN, which was not built in: refused, with the reason.
    #[cfg(not(feature = "opencv"))]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub flann: Option<toml::Table>,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            matcher: MatcherName::default(),
            partners: Partners::default(),
            max_ratio: 0.85,
            max_distance: 1.0,
            row_band_px: 2.0,
            row_band_sigmas: 3.0,
            min_disparity_px: -1.0,
            min_depth_m: 0.5,
            search_radius_px: 40.0,
            wide_search: 0.25,
            max_size_ratio: 1.6,
            flann: Default::default(),
        }
    }
}

impl Settings {
    /// How far a right feature's rectified row may lie from that of a feature with σ `sigma_px`, px.
    fn row_band_px(&self, sigma_px: f32) -> f64 {
        self.row_band_px
            .max(self.row_band_sigmas * f64::from(sigma_px))
    }

    /// Refuses values out of range, and FLANN where it was not built in.
    ///
    /// # Errors
    /// The first setting that cannot be used.
    pub fn check(&self) -> Result<(), SettingError> {
        SettingError::unless_in("max_ratio", self.max_ratio, 0.1..=1.0)?;
        SettingError::unless_in("max_distance", self.max_distance, 0.0..=2.0)?;
        SettingError::unless_in("row_band_px", self.row_band_px, 0.1..=50.0)?;
        SettingError::unless_in("row_band_sigmas", self.row_band_sigmas, 0.0..=10.0)?;
        SettingError::unless_in("min_disparity_px", self.min_disparity_px, -20.0..=100.0)?;
        SettingError::unless_in("min_depth_m", self.min_depth_m, 0.01..=100.0)?;
        SettingError::unless_in("search_radius_px", self.search_radius_px, 1.0..=4096.0)?;
        SettingError::unless_in("wide_search", self.wide_search, 0.01..=1.0)?;
        SettingError::unless_in("max_size_ratio", self.max_size_ratio, 1.0..=10.0)?;
        #[cfg(feature = "opencv")]
        self.flann.check()?;
        #[cfg(not(feature = "opencv"))]
        if self.flann.is_some() || self.matcher != MatcherName::Guided {
            return Err(SettingError {
                key: "matcher",
                cause: MatchError::NotBuiltIn.to_string(),
            });
        }
        Ok(())
    }
}
