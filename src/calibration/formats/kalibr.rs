//! Kalibr's camchain: `cam0`, `cam1`, the second with `T_cn_cnm1`, which is right_from_left.

use super::numbers::{
    camera, coefficients, exactly, lens, list, motion, of_key, pixels, rig, rotation,
};
use crate::capture::yaml::{Node, Value, YamlFile};
use crate::geometry::{Camera, Distortion, StereoRig};
use crate::text_file::shown;
use std::fmt::Write as _;
use std::path::Path;

pub(super) fn import(file: &Path) -> Result<StereoRig, String> {
    let yaml = YamlFile::read(file).map_err(|e| e.to_string())?;
    let of = |key: &str| yaml.need(key).map_err(|e| e.to_string());
    let (left, right) = (of("cam0")?, of("cam1")?);
    let node = right
        .get("T_cn_cnm1")
        .ok_or_else(|| yaml.wrong(right, "T_cn_cnm1", "is missing").to_string())?;
    let t = exactly::<16>(&yaml, node, "T_cn_cnm1")?;
    let turn = rotation(&[t[0], t[1], t[2], t[4], t[5], t[6], t[8], t[9], t[10]])
        .map_err(|e| yaml.wrong(node, "T_cn_cnm1", e).to_string())?;
    Ok(rig(
        one(&yaml, left)?,
        one(&yaml, right)?,
        motion(turn, [t[3], t[7], t[11]]),
    ))
}

fn one(yaml: &YamlFile, node: &Node) -> Result<Camera, String> {
    let need = |key: &str| {
        node.get(key)
            .ok_or_else(|| yaml.wrong(node, key, "is missing").to_string())
    };
    let word = |key: &str| match &need(key)?.value {
        Value::Scalar(word) => Ok(word.clone()),
        _ => Err(yaml
            .wrong(node, key, "a single word was expected")
            .to_string()),
    };
    let model = word("camera_model")?;
    if model != "pinhole" {
        return Err(yaml
            .wrong(
                need("camera_model")?,
                "camera_model",
                format!("only \"pinhole\" is read, but it is \"{}\"", shown(&model)),
            )
            .to_string());
    }
    let [fu, fv, cu, cv] = exactly::<4>(yaml, need("intrinsics")?, "intrinsics")?;
    let sides = exactly::<2>(yaml, need("resolution")?, "resolution")?;
    let [Some(width), Some(height)] = sides.map(|side| pixels(&side.to_string())) else {
        return Err(yaml
            .wrong(
                need("resolution")?,
                "resolution",
                "must be whole numbers of px",
            )
            .to_string());
    };
    let lens_model = word("distortion_model")?;
    let k = match node.get("distortion_coeffs") {
        Some(node) => of_key(yaml, node, "distortion_coeffs")?,
        None => Vec::new(),
    };
    let wrong = |cause: String| yaml.wrong(node, "distortion_coeffs", cause).to_string();
    let distortion = lens(&lens_model, &k).map_err(wrong)?;
    camera((width, height), [fu, fv], [cu, cv], distortion)
        .map_err(|e| yaml.wrong(node, "intrinsics", e).to_string())
}

pub(super) fn export(stereo: &StereoRig) -> String {
    let mut out = String::new();
    for (name, camera) in [("cam0", &stereo.left), ("cam1", &stereo.right)] {
        let (model, k) = match camera.distortion() {
            Distortion::None => ("none", Vec::new()),
            Distortion::Equidistant(k) => ("equidistant", k.to_vec()),
            lens @ Distortion::Radtan(_) => ("radtan", coefficients(lens, 4)),
        };
        let (f, c) = (camera.focal_px, camera.principal_point_px);
        // Writing to a `String` cannot fail, here and below.
        let _ = writeln!(
            out,
            "{name}:\n  camera_model: pinhole\n  intrinsics: [{}]\n  distortion_model: {model}\n  distortion_coeffs: [{}]\n  resolution: [{}, {}]",
            list(&[f.x, f.y, c.x, c.y]),
            list(&k),
            camera.width,
            camera.height
        );
    }
    out.push_str("  T_cn_cnm1:\n");
    for row in stereo.right_from_left.to_matrix().row_iter() {
        let _ = writeln!(
            out,
            "  - [{}]",
            list(&row.iter().copied().collect::<Vec<_>>())
        );
    }
    out
}
