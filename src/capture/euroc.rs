//! The EuRoC (ASL) layout: `mav0/cam0`, `mav0/cam1`, each with `sensor.yaml` and stamped images.

use super::dataset::{DatasetError, Layout, Parts, Settings};
use super::euroc_frames::{Frames, paired_by_stamp};
use super::text;
use super::yaml::{Node, YamlFile};
use crate::geometry::{Camera, Distortion, StereoRig};
use nalgebra::{
    Isometry3, Matrix3, Matrix4, Rotation3, RowVector4, Translation3, UnitQuaternion, Vector2,
};
use std::path::Path;

/// Farthest that a matrix stated as a rotation may be from one: files with four digits pass.
const MAX_ROTATION_FAULT: f64 = 1e-3;

pub(super) fn open(
    mav0: &Path,
    rig_override: Option<StereoRig>,
    settings: &Settings,
) -> Result<Parts, DatasetError> {
    let [left, right] = [mav0.join("cam0"), mav0.join("cam1")];
    if !right.is_dir() {
        return Err(DatasetError::file(
            &right,
            "is missing, while cam0 is there",
        ));
    }
    let rig = match rig_override {
        Some(rig) => rig,
        None => rig(&left.join("sensor.yaml"), &right.join("sensor.yaml"))?,
    };
    let pairs = paired_by_stamp(
        &Frames::read(&left)?,
        &Frames::read(&right)?,
        settings.pairing_tolerance_ns(),
    );
    let ground_truth = [
        mav0.join("state_groundtruth_estimate0").join("data.csv"),
        mav0.join("..").join("poses.txt"),
        mav0.join("poses.txt"),
    ];
    Ok(Parts {
        layout: Layout::Euroc,
        rig,
        pairs,
        nominal_times: false,
        ground_truth: ground_truth.into_iter().find(|file| file.is_file()),
    })
}

/// The rig of two files `sensor.yaml`.
pub(crate) fn rig(left_file: &Path, right_file: &Path) -> Result<StereoRig, DatasetError> {
    let (left, body_from_left) = sensor(left_file)?;
    let (right, body_from_right) = sensor(right_file)?;
    let right_from_left = body_from_right.inverse() * body_from_left;
    if right_from_left.translation.vector.norm() < 1e-6 {
        return Err(DatasetError {
            key: Some("T_BS".to_owned()),
            ..DatasetError::file(
                right_file,
                "the cameras must stand apart, but the baseline is zero",
            )
        });
    }
    Ok(StereoRig {
        left,
        right,
        right_from_left,
        base_from_camera: None,
        uncertainty: None,
    })
}

/// A camera and where it stands, body_from_camera (`T_BS`).
fn sensor(file: &Path) -> Result<(Camera, Isometry3<f64>), DatasetError> {
    let yaml = YamlFile::read(file)?;
    if let Some(node) = yaml.get("camera_model") {
        let model = yaml.word("camera_model")?;
        if model != "pinhole" {
            return Err(yaml.wrong(
                node,
                "camera_model",
                format!(
                    "only \"pinhole\" is read, but it is \"{}\"",
                    text::shown(model)
                ),
            ));
        }
    }
    let (node, resolution) = list::<2>(&yaml, "resolution")?;
    let mut size_px = [0_u32; 2];
    for (side, value) in size_px.iter_mut().zip(resolution) {
        let max = f64::from(super::decode::MAX_SIDE_PX);
        if !(1.0..=max).contains(&value) || value.fract() != 0.0 {
            return Err(yaml.wrong(
                node,
                "resolution",
                format!("sides must be whole numbers from 1 to {max} px, but hold {value}"),
            ));
        }
        *side = value as u32;
    }
    let (node, [fu, fv, cu, cv]) = list::<4>(&yaml, "intrinsics")?;
    if fu <= 0.0 || fv <= 0.0 {
        return Err(yaml.wrong(
            node,
            "intrinsics",
            format!("focal lengths must be above 0 px, but are {fu} and {fv}"),
        ));
    }
    let camera = Camera::new(
        size_px[0],
        size_px[1],
        Vector2::new(fu, fv),
        Vector2::new(cu, cv),
        distortion(&yaml)?,
    );
    Ok((camera, body_from_sensor(&yaml)?))
}

/// A list of exactly `N` numbers.
fn list<'a, const N: usize>(
    yaml: &'a YamlFile,
    key: &str,
) -> Result<(&'a Node, [f64; N]), DatasetError> {
    let node = yaml.need(key)?;
    let numbers = yaml.numbers(node, key)?;
    let count = numbers.len();
    let numbers = numbers
        .try_into()
        .map_err(|_| yaml.wrong(node, key, format!("has {N} numbers, but there are {count}")))?;
    Ok((node, numbers))
}

fn distortion(yaml: &YamlFile) -> Result<Distortion, DatasetError> {
    const MODEL: &str = "distortion_model";
    const COEFFICIENTS: &str = "distortion_coefficients";
    let model = yaml.word(MODEL)?;
    if model == "none" {
        return Ok(Distortion::None);
    }
    let node = yaml.need(COEFFICIENTS)?;
    let k = yaml.numbers(node, COEFFICIENTS)?;
    let wrong_count = |wants: &str| {
        yaml.wrong(
            node,
            COEFFICIENTS,
            format!(
                "\"{model}\" takes {wants} coefficients, but there are {}",
                k.len()
            ),
        )
    };
    match model {
        "radial-tangential" | "radtan" | "plumb_bob" => {
            if !matches!(k.len(), 4 | 5 | 8) {
                return Err(wrong_count("4, 5 or 8"));
            }
            let mut all = [0.0; 8];
            all[..k.len()].copy_from_slice(&k);
            Ok(Distortion::Radtan(all))
        }
        "equidistant" => match <[f64; 4]>::try_from(k.as_slice()) {
            Ok(k) => Ok(Distortion::Equidistant(k)),
            Err(_) => Err(wrong_count("4")),
        },
        other => Err(yaml.wrong(
            yaml.need(MODEL)?,
            MODEL,
            format!(
                "\"radial-tangential\", \"equidistant\" and \"none\" are read, but it is \"{}\"",
                text::shown(other)
            ),
        )),
    }
}

/// `T_BS`: a map with `data`, as the data set has it, or the sixteen numbers themselves.
fn body_from_sensor(yaml: &YamlFile) -> Result<Isometry3<f64>, DatasetError> {
    const KEY: &str = "T_BS";
    let outer = yaml.need(KEY)?;
    let node = outer.get("data").unwrap_or(outer);
    let numbers = yaml.numbers(node, KEY)?;
    if numbers.len() != 16 {
        return Err(yaml.wrong(
            node,
            KEY,
            format!(
                "a 4×4 matrix has 16 numbers, but there are {}",
                numbers.len()
            ),
        ));
    }
    let matrix = Matrix4::from_row_slice(&numbers);
    let rotation: Matrix3<f64> = matrix.fixed_view::<3, 3>(0, 0).into_owned();
    let fault = (rotation.transpose() * rotation - Matrix3::identity()).amax();
    if matrix.row(3) != RowVector4::new(0.0, 0.0, 0.0, 1.0)
        || fault > MAX_ROTATION_FAULT
        || rotation.determinant() < 0.0
    {
        return Err(yaml.wrong(node, KEY, "is not a rigid motion, [R t; 0 0 0 1]"));
    }
    let translation = matrix.fixed_view::<3, 1>(0, 3).into_owned();
    // The nearest rotation takes out the rounding of the file's digits.
    let nearest = Rotation3::from_matrix_eps(&rotation, 1e-15, 100, Rotation3::identity());
    Ok(Isometry3::from_parts(
        Translation3::from(translation),
        UnitQuaternion::from_rotation_matrix(&nearest),
    ))
}
