//! OpenCV's YAML: what its stereo calibration samples write, in one file or in two.

use super::numbers::{
    camera_of_matrix, coefficients, exactly, lens, list, matrix, motion, of_key, pixels, radtan,
    rig, rotation, rows,
};
use crate::capture::yaml::{Node, YamlFile};
use crate::geometry::{Camera, Distortion, StereoRig};
use std::fmt::Write as _;
use std::path::PathBuf;

/// What a camera's matrix and coefficients are called, left and right.
const MATRICES: [&[&str]; 2] = [
    &[
        "M1",
        "K1",
        "cameraMatrix1",
        "camera_matrix_1",
        "camera_matrix_left",
    ],
    &[
        "M2",
        "K2",
        "cameraMatrix2",
        "camera_matrix_2",
        "camera_matrix_right",
    ],
];
const LENSES: [&[&str]; 2] = [
    &[
        "D1",
        "distCoeffs1",
        "dist_coeffs_1",
        "distortion_coefficients_left",
    ],
    &[
        "D2",
        "distCoeffs2",
        "dist_coeffs_2",
        "distortion_coefficients_right",
    ],
];

pub(super) fn import(files: &[PathBuf], size_px: Option<(u32, u32)>) -> Result<StereoRig, String> {
    let read = |file: &PathBuf| YamlFile::read(file).map_err(|e| e.to_string());
    let yamls: Vec<YamlFile> = files.iter().map(read).collect::<Result<_, _>>()?;
    let find = |names: &[&'static str]| -> Option<(&YamlFile, &Node, &'static str)> {
        let places = yamls
            .iter()
            .flat_map(|yaml| names.iter().map(move |name| (yaml, *name)));
        places
            .into_iter()
            .find_map(|(yaml, name)| Some((yaml, yaml.get(name)?, name)))
    };
    let need = |names: &[&'static str]| {
        find(names).ok_or_else(|| format!("{}: holds no {}", files[0].display(), names[0]))
    };
    let stated = || {
        let side = |name: &'static str| {
            let (yaml, ..) = find(&[name])?;
            pixels(yaml.word(name).ok()?)
        };
        Some((side("image_width")?, side("image_height")?))
    };
    let size_px = stated().or(size_px).ok_or_else(|| {
        format!(
            "{}: does not state the images' size; --size does",
            files[0].display()
        )
    })?;
    let model =
        find(&["distortion_model"]).and_then(|(yaml, ..)| yaml.word("distortion_model").ok());
    let camera = |side: usize| -> Result<Camera, String> {
        let (yaml, node, key) = need(MATRICES[side])?;
        let k = exactly::<9>(yaml, node, key)?;
        let distortion = match find(LENSES[side]) {
            None => Distortion::None,
            Some((yaml, node, key)) => {
                let coefficients = of_key(yaml, node, key)?;
                match model {
                    Some(model) => lens(model, &coefficients),
                    None => radtan(&coefficients),
                }
                .map_err(|cause| yaml.wrong(node, key, cause).to_string())?
            }
        };
        camera_of_matrix(size_px, &k, distortion)
            .map_err(|cause| yaml.wrong(node, key, cause).to_string())
    };
    let (left, right) = (camera(0)?, camera(1)?);
    let (yaml, node, key) = need(&["R"])?;
    let turn = rotation(&exactly::<9>(yaml, node, key)?)
        .map_err(|e| yaml.wrong(node, key, e).to_string())?;
    let (yaml, node, key) = need(&["T"])?;
    Ok(rig(
        left,
        right,
        motion(turn, exactly::<3>(yaml, node, key)?),
    ))
}

pub(super) fn export(rig: &StereoRig) -> String {
    let mut out = "%YAML:1.0\n---\n".to_owned();
    // Writing to a `String` cannot fail.
    let _ = writeln!(
        out,
        "image_width: {}\nimage_height: {}",
        rig.left.width, rig.left.height
    );
    if matches!(rig.left.distortion(), Distortion::Equidistant(_)) {
        out.push_str("distortion_model: equidistant\n");
    }
    for (i, camera) in [&rig.left, &rig.right].into_iter().enumerate() {
        push(&mut out, &format!("M{}", i + 1), 3, 3, &matrix(camera));
        let k = coefficients(camera.distortion(), 5);
        push(&mut out, &format!("D{}", i + 1), 1, k.len(), &k);
    }
    let turn = rows(rig.right_from_left.rotation.to_rotation_matrix().matrix());
    push(&mut out, "R", 3, 3, &turn);
    push(
        &mut out,
        "T",
        3,
        1,
        &rows(&rig.right_from_left.translation.vector),
    );
    out
}

fn push(out: &mut String, key: &str, rows: usize, cols: usize, data: &[f64]) {
    // Writing to a `String` cannot fail.
    let _ = writeln!(
        out,
        "{key}: !!opencv-matrix\n   rows: {rows}\n   cols: {cols}\n   dt: d\n   data: [ {} ]",
        list(data)
    );
}
