//! Pairs with their true poses in, a dataset in visod's own layout out.
//!
//! `left/000000.png` …, `right/000000.png` …, `rig.toml`, `times.txt` (seconds, one a line) and
//! `poses.txt` (the upper three rows of each pose's matrix, row by row, as KITTI has them).

use crate::capture::StereoPair;
use crate::geometry::{StereoRig, save_rig};
use crate::image::GrayImage;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};
use nalgebra::Isometry3;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// Why a dataset could not be written.
#[derive(Debug, thiserror::Error)]
pub enum DatasetError {
    /// The folder holds something already.
    #[error("{}: is not empty; name a new folder, so that no recording is overwritten", .0.display())]
    NotEmpty(PathBuf),
    /// The name belongs to something else than a folder.
    #[error("{}: is not a folder", .0.display())]
    NotAFolder(PathBuf),
    /// A file or folder cannot be written: no right to, no room left …
    #[error("{}: cannot be written: {cause}", file.display())]
    Write {
        /// The file or folder.
        file: PathBuf,
        /// What the system said.
        cause: std::io::Error,
    },
    /// An image has no PNG form.
    #[error("{}: cannot be encoded: {cause}", file.display())]
    Encode {
        /// The file.
        file: PathBuf,
        /// What the encoder said.
        cause: image::ImageError,
    },
}

/// Writes a dataset, pair by pair.
pub struct DatasetWriter {
    folder: PathBuf,
    times: String,
    poses: String,
}

impl DatasetWriter {
    /// Makes the dataset's folder, with its parents, and writes the rig into it.
    ///
    /// # Errors
    /// The folder is there and not empty, or something cannot be written.
    pub fn create(folder: &Path, rig: &StereoRig) -> Result<Self, DatasetError> {
        if folder.exists() && !folder.is_dir() {
            return Err(DatasetError::NotAFolder(folder.to_owned()));
        }
        if std::fs::read_dir(folder).is_ok_and(|mut entries| entries.next().is_some()) {
            return Err(DatasetError::NotEmpty(folder.to_owned()));
        }
        for name in ["left", "right"] {
            let part = folder.join(name);
            std::fs::create_dir_all(&part).map_err(|cause| DatasetError::Write {
                file: part.clone(),
                cause,
            })?;
        }
        let writer = Self {
            folder: folder.to_owned(),
            times: String::new(),
            poses: String::new(),
        };
        save_rig(folder, rig).map_err(|(file, cause)| DatasetError::Write { file, cause })?;
        Ok(writer)
    }

    /// Writes one pair's images and remembers its time and pose for [`finish`](Self::finish).
    ///
    /// # Errors
    /// A file cannot be written.
    pub fn add(
        &mut self,
        pair: &StereoPair,
        odom_from_camera: &Isometry3<f64>,
    ) -> Result<(), DatasetError> {
        let name = |side: &str| format!("{side}/{:06}.png", pair.sequence);
        let (left, right) = rayon::join(
            || self.write_image(&name("left"), &pair.left),
            || self.write_image(&name("right"), &pair.right),
        );
        left.and(right)?;
        let (seconds, rest) = (
            pair.timestamp_ns.div_euclid(1_000_000_000),
            pair.timestamp_ns.rem_euclid(1_000_000_000),
        );
        // Writing to a string cannot fail.
        let _ = writeln!(self.times, "{seconds}.{rest:09}");
        let matrix = odom_from_camera.to_homogeneous();
        let row: Vec<String> = (0..12)
            .map(|i| format!("{:e}", matrix[(i / 4, i % 4)]))
            .collect();
        let _ = writeln!(self.poses, "{}", row.join(" "));
        Ok(())
    }

    /// Writes the times and poses; without this, a dataset has its images and rig alone.
    ///
    /// # Errors
    /// A file cannot be written.
    pub fn finish(self) -> Result<(), DatasetError> {
        self.write("times.txt", self.times.as_bytes())?;
        self.write("poses.txt", self.poses.as_bytes())
    }

    fn write_image(&self, name: &str, image: &GrayImage) -> Result<(), DatasetError> {
        let mut png = Vec::with_capacity(image.pixels().len());
        PngEncoder::new_with_quality(&mut png, CompressionType::Fast, FilterType::Sub)
            .write_image(
                image.pixels(),
                image.width(),
                image.height(),
                ExtendedColorType::L8,
            )
            .map_err(|cause| DatasetError::Encode {
                file: self.folder.join(name),
                cause,
            })?;
        self.write(name, &png)
    }

    fn write(&self, name: &str, bytes: &[u8]) -> Result<(), DatasetError> {
        let file = self.folder.join(name);
        std::fs::write(&file, bytes).map_err(|cause| DatasetError::Write { file, cause })
    }
}
