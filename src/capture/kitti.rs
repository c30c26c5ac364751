//! The KITTI odometry layout: rectified images, and two projection matrices in `calib.txt`.

use super::dataset::{DatasetError, ImageFiles, Layout, PairFiles, Parts};
use super::decode::Decoder;
use super::own::stamped_pairs;
use super::text;
use crate::geometry::{Camera, Distortion, StereoRig};
use nalgebra::{Isometry3, Matrix3x4, Translation3, UnitQuaternion, Vector2, Vector3};
use std::path::{Path, PathBuf};

pub(super) fn open(
    path: &Path,
    left: &Path,
    right: &Path,
    rig_override: Option<StereoRig>,
) -> Result<Parts, DatasetError> {
    let (pairs, nominal_times) = stamped_pairs(path, left, right)?;
    let rig = match rig_override {
        Some(rig) => rig,
        None => {
            let calibration = Calibration::read(&path.join("calib.txt"))?;
            let sizes_px = first_sizes_px(left, &pairs)?;
            calibration.rig(sizes_px)?
        }
    };
    Ok(Parts {
        layout: Layout::Kitti,
        rig,
        pairs,
        nominal_times,
        ground_truth: ground_truth(path),
    })
}

/// `poses.txt` in the recording, or where the benchmark keeps it: `poses/NN.txt` beside the folder
/// of sequences.
fn ground_truth(path: &Path) -> Option<PathBuf> {
    let inside = path.join("poses.txt");
    if inside.is_file() {
        return Some(inside);
    }
    let mut name = path.file_name()?.to_owned();
    name.push(".txt");
    let beside = path.join("..").join("..").join("poses").join(name);
    beside.is_file().then_some(beside)
}

/// `calib.txt` does not state the images' size: the first pair that can be read does.
fn first_sizes_px(left: &Path, pairs: &[PairFiles]) -> Result<[(u32, u32); 2], DatasetError> {
    let mut decoder = Decoder::default();
    let mut why = None;
    for pair in pairs {
        if let ImageFiles::Both { left, right } = &pair.images {
            match (decoder.size_px(left), decoder.size_px(right)) {
                (Ok(left), Ok(right)) => return Ok([left, right]),
                (Err(e), _) | (_, Err(e)) => why = why.or(Some(e)),
            }
        }
    }
    let cause = why.map_or_else(String::new, |e| format!(": {e}"));
    Err(DatasetError::file(
        left,
        format!("no pair of images can be read{cause}"),
    ))
}

/// The two projection matrices, each with its line in the file.
pub(crate) struct Calibration {
    file: PathBuf,
    left: (usize, Matrix3x4<f64>),
    right: (usize, Matrix3x4<f64>),
}

impl Calibration {
    pub(crate) fn read(file: &Path) -> Result<Self, DatasetError> {
        let text = text::read_calibration(file)?;
        let find = |key: &str| {
            text::lines(&text)
                .filter_map(|(line, words)| Some((line, words.split_once(':')?)))
                .find(|(_, (name, _))| name.trim() == key)
                .map(|(line, (_, numbers))| (line, numbers))
                .ok_or_else(|| DatasetError {
                    key: Some(key.to_owned()),
                    ..DatasetError::file(file, "the projection matrix is missing")
                })
                .and_then(|(line, numbers)| {
                    projection(numbers)
                        .map(|matrix| (line, matrix))
                        .map_err(|cause| DatasetError::key(file, line, key, cause))
                })
        };
        Ok(Self {
            file: file.to_owned(),
            left: find("P0")?,
            right: find("P1")?,
        })
    }

    /// Both cameras are rectified: they differ by where they stand alone.
    pub(crate) fn rig(&self, sizes_px: [(u32, u32); 2]) -> Result<StereoRig, DatasetError> {
        let (left, left_from_world) = camera(&self.left.1, sizes_px[0]);
        let (right, right_from_world) = camera(&self.right.1, sizes_px[1]);
        let translation = right_from_world - left_from_world;
        if translation.norm() < 1e-6 {
            return Err(DatasetError::key(
                &self.file,
                self.right.0,
                "P1",
                "the cameras must stand apart, but the baseline is zero",
            ));
        }
        Ok(StereoRig {
            left,
            right,
            right_from_left: Isometry3::from_parts(
                Translation3::from(translation),
                UnitQuaternion::identity(),
            ),
            base_from_camera: None,
            uncertainty: None,
        })
    }
}

/// A rectified camera's 3×4 matrix `K [I | t]` from its twelve numbers.
fn projection(numbers: &str) -> Result<Matrix3x4<f64>, String> {
    let mut values = Vec::new();
    for word in numbers.split_whitespace() {
        match word.parse::<f64>() {
            Ok(value) if value.is_finite() => values.push(value),
            _ => {
                return Err(format!(
                    "a finite number was expected, but it reads \"{}\"",
                    text::shown(word)
                ));
            }
        }
    }
    if values.len() != 12 {
        return Err(format!(
            "a projection matrix has 12 numbers, but there are {}",
            values.len()
        ));
    }
    let p = Matrix3x4::from_row_slice(&values);
    if p[(0, 0)] <= 0.0 || p[(1, 1)] <= 0.0 {
        return Err(format!(
            "focal lengths must be above 0 px, but are {} and {}",
            p[(0, 0)],
            p[(1, 1)]
        ));
    }
    let rectified = p[(0, 1)] == 0.0
        && p[(1, 0)] == 0.0
        && p.fixed_view::<1, 3>(2, 0) == Vector3::z().transpose();
    if !rectified {
        return Err(
            "is not the matrix of a rectified camera, [f 0 c ·; 0 f c ·; 0 0 1 ·]".to_owned(),
        );
    }
    Ok(p)
}

/// The camera of `K [I | t]`, and t, m.
fn camera(p: &Matrix3x4<f64>, (width, height): (u32, u32)) -> (Camera, Vector3<f64>) {
    let focal_px = Vector2::new(p[(0, 0)], p[(1, 1)]);
    let centre_px = Vector2::new(p[(0, 2)], p[(1, 2)]);
    let z = p[(2, 3)];
    let translation = Vector3::new(
        (p[(0, 3)] - centre_px.x * z) / focal_px.x,
        (p[(1, 3)] - centre_px.y * z) / focal_px.y,
        z,
    );
    let camera = Camera::new(width, height, focal_px, centre_px, Distortion::None);
    (camera, translation)
}
