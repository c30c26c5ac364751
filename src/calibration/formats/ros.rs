//! A pair of ROS `camera_info` files, as the ROS calibrator and drivers keep them.
//!
//! How the cameras stand to each other is told by their rectification: with `R₁`, `R₂` into the common frame and the
//! projections `K′ [I | t′]` in it, `right_from_left = R₂ᵀ (R₁ · + t′)`.

use super::numbers::{
    camera_of_matrix, coefficients, exactly, lens, list, matrix, motion, of_key, pixels, rig,
    rotation,
};
use crate::capture::yaml::YamlFile;
use crate::geometry::{Camera, Distortion, StereoRig};
use nalgebra::{Isometry3, Matrix3, Translation3, UnitQuaternion, Vector3};
use std::fmt::Write as _;
use std::path::Path;

pub(super) fn import(left: &Path, right: &Path) -> Result<StereoRig, String> {
    let (left, common_from_left) = one(left)?;
    let (right, common_from_right) = one(right)?;
    Ok(rig(
        left,
        right,
        common_from_right.inverse() * common_from_left,
    ))
}

/// A camera, and the motion into the frame that both are rectified to.
fn one(file: &Path) -> Result<(Camera, Isometry3<f64>), String> {
    let yaml = YamlFile::read(file).map_err(|e| e.to_string())?;
    let need = |key: &'static str| yaml.need(key).map_err(|e| e.to_string());
    let side = |key: &'static str| -> Result<u32, String> {
        let word = yaml.word(key).map_err(|e| e.to_string())?;
        let node = need(key)?;
        pixels(word).ok_or_else(|| {
            yaml.wrong(node, key, "must be a whole number of px")
                .to_string()
        })
    };
    let size_px = (side("image_width")?, side("image_height")?);
    let model = yaml.word("distortion_model").map_err(|e| e.to_string())?;
    let node = need("distortion_coefficients")?;
    let distortion = of_key(&yaml, node, "distortion_coefficients").and_then(|k| {
        lens(model, &k).map_err(|e| yaml.wrong(node, "distortion_coefficients", e).to_string())
    })?;
    let node = need("camera_matrix")?;
    let k = exactly::<9>(&yaml, node, "camera_matrix")?;
    let camera = camera_of_matrix(size_px, &k, distortion)
        .map_err(|e| yaml.wrong(node, "camera_matrix", e).to_string())?;
    let node = need("rectification_matrix")?;
    let turn = rotation(&exactly::<9>(&yaml, node, "rectification_matrix")?)
        .map_err(|e| yaml.wrong(node, "rectification_matrix", e).to_string())?;
    let node = need("projection_matrix")?;
    let p = exactly::<12>(&yaml, node, "projection_matrix")?;
    if p[0] <= 0.0 || p[5] <= 0.0 {
        return Err(yaml
            .wrong(
                node,
                "projection_matrix",
                "focal lengths must be above 0 px",
            )
            .to_string());
    }
    let z = p[11];
    // The camera sees K′ (q + t′) of a point q in the common frame: R p = q + t′.
    let shift = [(p[3] - p[2] * z) / p[0], (p[7] - p[6] * z) / p[5], z].map(|t| -t);
    Ok((camera, motion(turn, shift)))
}

/// Both files.
pub(super) fn export(stereo: &StereoRig) -> Result<[String; 2], String> {
    let (common_from_left, baseline_m) = common_frame(stereo)
        .ok_or("the cameras stand behind each other: they cannot be rectified, and camera_info cannot state them")?;
    let common_from_right = common_from_left * stereo.right_from_left.rotation.inverse();
    let focal = 0.25 * (stereo.left.focal_px.sum() + stereo.right.focal_px.sum());
    let text = |camera: &Camera, name: &str, turn: &UnitQuaternion<f64>, shift_m: f64| {
        let (model, k) = match camera.distortion() {
            Distortion::Equidistant(k) => ("equidistant", k.to_vec()),
            lens => match coefficients(lens, 5) {
                k if k.len() == 8 => ("rational_polynomial", k),
                k => ("plumb_bob", k),
            },
        };
        let centre = [
            0.5 * (f64::from(camera.width) - 1.0),
            0.5 * (f64::from(camera.height) - 1.0),
        ];
        let projection = [
            focal,
            0.0,
            centre[0],
            -focal * shift_m,
            0.0,
            focal,
            centre[1],
            0.0,
            0.0,
            0.0,
            1.0,
            0.0,
        ];
        let mut out = format!(
            "image_width: {}\nimage_height: {}\ncamera_name: {name}\n",
            camera.width, camera.height
        );
        push(&mut out, "camera_matrix", 3, 3, &matrix(camera));
        // Writing to a `String` cannot fail.
        let _ = writeln!(out, "distortion_model: {model}");
        push(&mut out, "distortion_coefficients", 1, k.len(), &k);
        let turn = super::numbers::rows(turn.to_rotation_matrix().matrix());
        push(&mut out, "rectification_matrix", 3, 3, &turn);
        push(&mut out, "projection_matrix", 3, 4, &projection);
        out
    };
    Ok([
        text(&stereo.left, "left", &common_from_left, 0.0),
        text(&stereo.right, "right", &common_from_right, baseline_m),
    ])
}

/// The rotation of the left camera into a frame whose x axis is the baseline, and the baseline, m.
fn common_frame(stereo: &StereoRig) -> Option<(UnitQuaternion<f64>, f64)> {
    let to_right = stereo.right_from_left.inverse();
    let right_in_left = to_right.translation.vector;
    let x = right_in_left.try_normalize(1e-12)?;
    let view = Vector3::z() + to_right.rotation * Vector3::z();
    let y = view.cross(&x).try_normalize(1e-6)?;
    let axes = Matrix3::from_rows(&[x.transpose(), y.transpose(), x.cross(&y).transpose()]);
    let turn = nalgebra::Rotation3::from_matrix_unchecked(axes);
    Some((
        UnitQuaternion::from_rotation_matrix(&turn),
        Translation3::from(right_in_left).vector.norm(),
    ))
}

fn push(out: &mut String, key: &str, rows: usize, cols: usize, data: &[f64]) {
    // Writing to a `String` cannot fail.
    let _ = writeln!(
        out,
        "{key}:\n  rows: {rows}\n  cols: {cols}\n  data: [{}]",
        list(data)
    );
}
