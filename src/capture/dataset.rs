//! A folder with a recording in; its rig, its image files in pairs, and their stamps out.
//!
//! The layout is recognised by what the folder holds: visod's own, KITTI odometry, or EuRoC (ASL).
//! Links are followed, as recordings are often assembled from them; names *inside* a recording's
//! files lead nowhere but into the recording.

use super::{euroc, kitti, own};
use crate::geometry::StereoRig;
use crate::settings::SettingError;
use crate::toml_file::TomlError;
use std::path::{Path, PathBuf};

/// Spacing of pairs whose recording has no stamps, ns: 10 Hz.
pub const NOMINAL_PERIOD_NS: i64 = 100_000_000;

/// How recordings are read.
#[derive(Clone, Debug, PartialEq, serde::Deserialize, serde::Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// The 16-bit sample that becomes white; 4095 for a camera that stores 12 bits in 16. Without
    /// effect on 8-bit images. Sample value, 1 to 65535, default 65535: the whole range.
    pub white_level: u16,
    /// How far the stamps of a EuRoC recording's left and right image may lie apart. Seconds, 0 to
    /// 0.1, default 0.002: far below a frame's period, above what unsynchronised clocks of one
    /// driver differ by.
    pub pairing_tolerance_s: f64,
    /// How many decoded images a side wait ahead of the consumer. Images, 1 to 64, default 4: rides
    /// out a slow read without holding much memory.
    pub read_ahead: usize,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            white_level: u16::MAX,
            pairing_tolerance_s: 0.002,
            read_ahead: 4,
        }
    }
}

impl Settings {
    /// Refuses values out of range.
    ///
    /// # Errors
    /// The first setting that lies outside its range.
    pub fn check(&self) -> Result<(), SettingError> {
        SettingError::unless_in("white_level", self.white_level, 1..=u16::MAX)?;
        SettingError::unless_in("pairing_tolerance_s", self.pairing_tolerance_s, 0.0..=0.1)?;
        SettingError::unless_in("read_ahead", self.read_ahead, 1..=64)
    }

    pub(super) fn pairing_tolerance_ns(&self) -> i64 {
        (self.pairing_tolerance_s * 1e9).round() as i64
    }
}

/// Why a folder is not a recording that can be read, and where.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DatasetError {
    /// The file or folder that is to blame.
    pub file: PathBuf,
    /// The line, counted from 1, where there is one.
    pub line: Option<usize>,
    /// The key, where there is one.
    pub key: Option<String>,
    /// The cause.
    pub cause: String,
}

impl std::fmt::Display for DatasetError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}", self.file.display())?;
        if let Some(line) = self.line {
            write!(f, ":{line}")?;
        }
        if let Some(key) = &self.key {
            write!(f, ": {key}")?;
        }
        write!(f, ": {}", self.cause)
    }
}

impl std::error::Error for DatasetError {}

impl From<TomlError> for DatasetError {
    fn from(error: TomlError) -> Self {
        Self {
            file: error.file.into(),
            line: error.line,
            key: error.key,
            cause: error.cause,
        }
    }
}

impl DatasetError {
    /// A file or folder as a whole is wrong.
    pub(super) fn file(file: &Path, cause: impl Into<String>) -> Self {
        Self {
            file: file.to_owned(),
            line: None,
            key: None,
            cause: cause.into(),
        }
    }

    /// A line is wrong.
    pub(super) fn line(file: &Path, line: usize, cause: impl Into<String>) -> Self {
        Self {
            line: Some(line),
            ..Self::file(file, cause)
        }
    }

    /// The value of a key is wrong.
    pub(super) fn key(file: &Path, line: usize, key: &str, cause: impl Into<String>) -> Self {
        Self {
            key: Some(key.to_owned()),
            ..Self::line(file, line, cause)
        }
    }
}

/// How a recording is laid out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Layout {
    /// `left/`, `right/`, `rig.toml`, optional `times.txt` and `poses.txt`.
    Visod,
    /// `image_0/`, `image_1/` (or `left/`, `right/`), `calib.txt`, `times.txt`.
    Kitti,
    /// `mav0/cam0`, `mav0/cam1`, each with `data/`, `sensor.yaml`, optional `data.csv`.
    Euroc,
}

impl std::fmt::Display for Layout {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Visod => "visod",
            Self::Kitti => "KITTI odometry",
            Self::Euroc => "EuRoC",
        })
    }
}

/// One pair of a recording, before anything is decoded.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PairFiles {
    /// When the left image was taken (the right one, where there is no left), ns, in the
    /// recording's own clock.
    pub timestamp_ns: i64,
    /// Where the images are.
    pub images: ImageFiles,
}

/// The files of one pair.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ImageFiles {
    /// Both are named by the recording, which does not mean that they can be decoded.
    Both {
        /// The left image.
        left: PathBuf,
        /// The right image.
        right: PathBuf,
    },
    /// One of them is missing.
    Unpaired {
        /// One sentence with the file's name.
        why: String,
    },
}

/// A recording in a folder.
#[derive(Clone, Debug)]
pub struct Dataset {
    /// The layout that was recognised.
    pub layout: Layout,
    /// The cameras.
    pub rig: StereoRig,
    /// All pairs in order, those with a missing image included; stamps rise strictly.
    pub pairs: Vec<PairFiles>,
    /// Whether the stamps are made up, [`NOMINAL_PERIOD_NS`] apart, as the recording has none.
    pub nominal_times: bool,
    /// Where the ground truth is, if the recording has one.
    pub ground_truth: Option<PathBuf>,
    /// How it is read.
    pub settings: Settings,
}

impl Dataset {
    /// Opens the recording at `path` with default settings; `rig_override` takes the place of the
    /// recording's own calibration, which then need not be there.
    ///
    /// # Errors
    /// `path` is not a folder or holds no known layout; a calibration or stamp file has a missing,
    /// misplaced or impossible value; there is no image.
    pub fn open(path: &Path, rig_override: Option<StereoRig>) -> Result<Self, DatasetError> {
        Self::open_with(path, rig_override, Settings::default())
    }

    /// [`open`](Self::open) with settings.
    ///
    /// # Errors
    /// As [`open`](Self::open).
    pub fn open_with(
        path: &Path,
        rig_override: Option<StereoRig>,
        settings: Settings,
    ) -> Result<Self, DatasetError> {
        let meta = std::fs::metadata(path)
            .map_err(|e| DatasetError::file(path, format!("cannot be read: {e}")))?;
        if !meta.is_dir() {
            return Err(DatasetError::file(path, "is not a folder with a recording"));
        }
        let parts = match recognise(path, rig_override.is_some())? {
            Found::Euroc { mav0 } => euroc::open(&mav0, rig_override, &settings),
            Found::Kitti { left, right } => kitti::open(path, &left, &right, rig_override),
            Found::Visod { left, right } => own::open(path, &left, &right, rig_override),
        }?;
        Ok(Self {
            layout: parts.layout,
            rig: parts.rig,
            pairs: parts.pairs,
            nominal_times: parts.nominal_times,
            ground_truth: parts.ground_truth,
            settings,
        })
    }
}

/// What a layout's reader finds out.
pub(super) struct Parts {
    pub(super) layout: Layout,
    pub(super) rig: StereoRig,
    pub(super) pairs: Vec<PairFiles>,
    pub(super) nominal_times: bool,
    pub(super) ground_truth: Option<PathBuf>,
}

enum Found {
    Euroc { mav0: PathBuf },
    Kitti { left: PathBuf, right: PathBuf },
    Visod { left: PathBuf, right: PathBuf },
}

/// Which layout the folder `path` has. A calibration file decides where the image folders would
/// suit two; visod's own goes first, as it is the one that somebody may have added.
fn recognise(path: &Path, has_rig: bool) -> Result<Found, DatasetError> {
    for mav0 in [path.join("mav0"), path.to_owned()] {
        if mav0.join("cam0").is_dir() {
            return Ok(Found::Euroc { mav0 });
        }
    }
    let image_folders = [("left", "right"), ("image_0", "image_1")]
        .map(|(left, right)| (path.join(left), path.join(right)))
        .into_iter()
        .find(|(left, right)| left.is_dir() || right.is_dir());
    let (has_toml, has_calib) = (
        path.join("rig.toml").is_file(),
        path.join("calib.txt").is_file(),
    );
    let Some((left, right)) = image_folders else {
        return Err(DatasetError::file(
            path,
            no_images(path, has_toml, has_calib),
        ));
    };
    for folder in [&left, &right] {
        if !folder.is_dir() {
            return Err(DatasetError::file(
                folder,
                "is missing, while the other camera's folder is there",
            ));
        }
    }
    if has_toml {
        Ok(Found::Visod { left, right })
    } else if has_calib {
        Ok(Found::Kitti { left, right })
    } else if has_rig {
        Ok(Found::Visod { left, right })
    } else {
        Err(DatasetError::file(
            path,
            "has images but neither rig.toml nor calib.txt: name a rig file with --rig",
        ))
    }
}

fn no_images(path: &Path, has_toml: bool, has_calib: bool) -> String {
    let is_empty = std::fs::read_dir(path).is_ok_and(|mut entries| entries.next().is_none());
    if is_empty {
        return "the folder is empty".to_owned();
    }
    let calibration = match (has_toml, has_calib) {
        (true, _) => " beside rig.toml",
        (_, true) => " beside calib.txt",
        _ => "",
    };
    format!(
        "holds no recording: there is neither left/ and right/, nor image_0/ and image_1/, nor mav0/cam0 and mav0/cam1{calibration}"
    )
}

#[cfg(test)]
#[path = "dataset_tests.rs"]
mod tests;
