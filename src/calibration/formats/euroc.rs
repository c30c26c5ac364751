//! A pair of `sensor.yaml`, as EuRoC (ASL) has them: `T_BS` says where each camera stands in the body.

use super::numbers::{coefficients, list, rows};
use crate::capture::euroc;
use crate::geometry::{Camera, Distortion, StereoRig};
use nalgebra::Isometry3;
use std::path::Path;

pub(super) fn import(left: &Path, right: &Path) -> Result<StereoRig, String> {
    euroc::rig(left, right).map_err(|e| e.to_string())
}

/// Both files; the body is the left camera.
pub(super) fn export(stereo: &StereoRig) -> [String; 2] {
    [
        text(&stereo.left, &Isometry3::identity()),
        text(&stereo.right, &stereo.right_from_left.inverse()),
    ]
}

fn text(camera: &Camera, body_from_camera: &Isometry3<f64>) -> String {
    let (model, k) = match camera.distortion() {
        Distortion::None => ("none", Vec::new()),
        Distortion::Equidistant(k) => ("equidistant", k.to_vec()),
        lens @ Distortion::Radtan(_) => ("radial-tangential", coefficients(lens, 4)),
    };
    let (f, c) = (camera.focal_px, camera.principal_point_px);
    format!(
        "sensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n  data: [{}]\nresolution: [{}, {}]\ncamera_model: pinhole\n\
         intrinsics: [{}]\ndistortion_model: {model}\ndistortion_coefficients: [{}]\n",
        list(&rows(&body_from_camera.to_matrix())),
        camera.width,
        camera.height,
        list(&[f.x, f.y, c.x, c.y]),
        list(&k)
    )
}
