//! KITTI odometry's `calib.txt`: projection matrices of rectified cameras, and nothing else.

use super::numbers::list;
use crate::capture::kitti::Calibration;
use crate::geometry::so3;
use crate::geometry::{Camera, Distortion, StereoRig};
use nalgebra::Vector3;
use std::path::Path;

/// Farthest from parallel that cameras which count as rectified may be, rad: a hundredth of a pixel over an image.
const PARALLEL_RAD: f64 = 1e-9;

pub(super) fn import(file: &Path, size_px: (u32, u32)) -> Result<StereoRig, String> {
    let rig = Calibration::read(file).and_then(|calibration| calibration.rig([size_px; 2]));
    rig.map_err(|e| e.to_string())
}

pub(super) fn export(stereo: &StereoRig) -> Result<String, String> {
    let has_lens = [&stereo.left, &stereo.right]
        .iter()
        .any(|camera| *camera.distortion() != Distortion::None);
    if has_lens || so3::log(&stereo.right_from_left.rotation).norm() > PARALLEL_RAD {
        return Err(
            "KITTI's calib.txt states rectified cameras alone, but these have a lens, or are turned against each other"
                .to_owned(),
        );
    }
    let line = |camera: &Camera, t: &Vector3<f64>| {
        let (f, c) = (camera.focal_px, camera.principal_point_px);
        let p = [
            f.x,
            0.0,
            c.x,
            f.x * t.x + c.x * t.z,
            0.0,
            f.y,
            c.y,
            f.y * t.y + c.y * t.z,
            0.0,
            0.0,
            1.0,
            t.z,
        ];
        list(&p).replace(", ", " ")
    };
    Ok(format!(
        "P0: {}\nP1: {}\n",
        line(&stereo.left, &Vector3::zeros()),
        line(&stereo.right, &stereo.right_from_left.translation.vector)
    ))
}
