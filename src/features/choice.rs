//! Which detector: its settings in, an [`Extractor`] out.

#[cfg(feature = "opencv")]
use super::opencv;
use super::{Extractor, surf};
use crate::settings::SettingError;
use serde::{Deserialize, Serialize};

/// Which detector finds and describes features.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum DetectorName {
    /// This crate's own SURF.
    #[default]
    Surf,
    /// OpenCV's SIFT.
    Sift,
    /// OpenCV's ORB.
    Orb,
    /// OpenCV's AKAZE.
    Akaze,
}

/// How features are found.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// The detector: "surf", or one of OpenCV's where that was built in: "sift", "orb", "akaze".
    /// Default "surf": the others are slower or less repeatable.
    pub detector: DetectorName,
    /// Settings of SURF.
    pub surf: surf::Settings,
    /// Settings of OpenCV's detectors.
    #[cfg(feature = "opencv")]
    pub opencv: opencv::Settings,
    /// Settings of detectors that were not built in: refused, with the reason.
    #[cfg(not(feature = "opencv"))]
    #[serde(skip_serializing_if = "Option::is_none")]
    opencv: Option<toml::Table>,
}

impl Settings {
    /// Refuses values out of range and detectors that were not built in.
    ///
    /// # Errors
    /// The first setting that cannot be used.
    pub fn check(&self) -> Result<(), SettingError> {
        self.surf.check()?;
        #[cfg(feature = "opencv")]
        self.opencv.check()?;
        #[cfg(not(feature = "opencv"))]
        if self.opencv.is_some() || self.detector != DetectorName::Surf {
            let key = if self.opencv.is_some() {
                "opencv"
            } else {
                "detector"
            };
            return Err(not_built_in(key));
        }
        Ok(())
    }
}

/// The detector that the settings ask for.
///
/// # Errors
/// A setting is out of range, or the detector was not built in.
pub fn extractor(settings: &Settings) -> Result<Box<dyn Extractor>, SettingError> {
    let detector = match settings.detector {
        DetectorName::Surf => return Ok(Box::new(surf::Surf::new(settings.surf.clone())?)),
        other => other,
    };
    opencv_extractor(detector, settings)
}

#[cfg(feature = "opencv")]
fn opencv_extractor(
    detector: DetectorName,
    settings: &Settings,
) -> Result<Box<dyn Extractor>, SettingError> {
    let detector = match detector {
        DetectorName::Orb => opencv::Detector::Orb,
        DetectorName::Akaze => opencv::Detector::Akaze,
        DetectorName::Sift | DetectorName::Surf => opencv::Detector::Sift,
    };
    match opencv::OpencvExtractor::new(detector, &settings.opencv) {
        Ok(extractor) => Ok(Box::new(extractor)),
        Err(e) => Err(SettingError {
            key: "detector",
            cause: e.to_string(),
        }),
    }
}

#[cfg(not(feature = "opencv"))]
fn opencv_extractor(_: DetectorName, _: &Settings) -> Result<Box<dyn Extractor>, SettingError> {
    Err(not_built_in("detector"))
}

#[cfg(not(feature = "opencv"))]
fn not_built_in(key: &'static str) -> SettingError {
    SettingError {
        key,
        cause: "OpenCV's detectors need the cargo feature `opencv`, with which this visod was not built"
            .to_owned(),
    }
}
