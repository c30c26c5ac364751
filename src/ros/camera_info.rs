//! The calibrations of two cameras as ROS has them in; a rig out, and back.
//!
//! ROS describes a stereo camera by what rectifies it: `r` turns a camera's points into the common
//! frame of the rectified pair, and `p` of the right camera holds the baseline there,
//! `p[3] = −f · baseline`. So `p_right = r_rightᵀ (r_left p_left + (p[3]/p[0], 0, 0))`.

use super::Fixed;
use super::messages::CameraInfo;
use crate::geometry::{Camera, Distortion, Rectification, StereoRig};
use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion, Vector2, Vector3};

/// Farthest that a matrix stated as a rotation may be from one.
const MAX_ROTATION_FAULT: f64 = 1e-3;

/// Longest image side, px.
const MAX_SIDE_PX: u32 = 16_384;

/// One camera's calibration.
#[derive(Clone, Copy, Debug)]
pub struct Calibration<'a> {
    /// The topic that it came on.
    pub topic: &'a str,
    /// What it says.
    pub info: &'a CameraInfo,
    /// Whether the camera's images are rectified already.
    pub is_rectified: bool,
}

/// The rig of two cameras.
///
/// # Errors
/// One sentence: what is missing or cannot be, on which topic.
pub fn rig(left: Calibration<'_>, right: Calibration<'_>) -> Result<StereoRig, String> {
    let p = &right.info.p.0;
    let shift_m = p[3] / p[0];
    if !shift_m.is_finite() || shift_m.abs() < 1e-6 {
        return Err(format!(
            "{}: p holds no baseline: its fourth number must be the focal length times minus the distance of the cameras",
            right.topic
        ));
    }
    let common_from_left = left.common_from_camera()?;
    let right_from_common = right.common_from_camera()?.inverse();
    let translation = right_from_common * Vector3::new(shift_m, 0.0, 0.0);
    let rotation = right_from_common * common_from_left;
    Ok(StereoRig {
        left: left.camera()?,
        right: right.camera()?,
        right_from_left: Isometry3::from_parts(
            Translation3::from(translation),
            UnitQuaternion::from_rotation_matrix(&rotation),
        ),
        base_from_camera: None,
        uncertainty: None,
    })
}

impl Calibration<'_> {
    fn camera(&self) -> Result<Camera, String> {
        let (topic, info) = (self.topic, self.info);
        if !(1..=MAX_SIDE_PX).contains(&info.width) || !(1..=MAX_SIDE_PX).contains(&info.height) {
            return Err(format!(
                "{topic}: images of {}×{} px cannot be",
                info.width, info.height
            ));
        }
        let (k, p) = (&info.k.0, &info.p.0);
        let [fx, fy, cx, cy] = if self.is_rectified {
            [p[0], p[5], p[2], p[6]]
        } else {
            [k[0], k[4], k[2], k[5]]
        };
        if !(fx > 0.0 && fy > 0.0 && fx.is_finite() && fy.is_finite()) {
            return Err(format!(
                "{topic}: focal lengths must be above 0 px, but are {fx} and {fy}: this camera was never calibrated"
            ));
        }
        let distortion = if self.is_rectified {
            Distortion::None
        } else {
            distortion(info).map_err(|why| format!("{topic}: {why}"))?
        };
        let (focal_px, centre_px) = (Vector2::new(fx, fy), Vector2::new(cx, cy));
        Ok(Camera::new(
            info.width,
            info.height,
            focal_px,
            centre_px,
            distortion,
        ))
    }

    fn common_from_camera(&self) -> Result<Rotation3<f64>, String> {
        if self.is_rectified {
            return Ok(Rotation3::identity());
        }
        rotation(self.info).map_err(|why| format!("{}: {why}", self.topic))
    }
}

fn distortion(info: &CameraInfo) -> Result<Distortion, String> {
    let d = &info.d;
    if d.iter().all(|k| *k == 0.0) {
        return Ok(Distortion::None);
    }
    match (info.distortion_model.as_str(), d.len()) {
        ("plumb_bob" | "rational_polynomial", 4..=8) => {
            let mut k = [0.0; 8];
            k[..d.len()].copy_from_slice(d);
            Ok(Distortion::Radtan(k))
        }
        ("equidistant" | "fisheye", 4) => Ok(Distortion::Equidistant([d[0], d[1], d[2], d[3]])),
        (model, n) => Err(format!(
            "a distortion \"{}\" of {n} coefficients is not read",
            model.chars().take(40).collect::<String>().escape_debug()
        )),
    }
}

/// `r`, a rotation; all zeros mean none.
fn rotation(info: &CameraInfo) -> Result<Rotation3<f64>, String> {
    if info.r.0.iter().all(|v| *v == 0.0) {
        return Ok(Rotation3::identity());
    }
    let m = Matrix3::from_row_slice(&info.r.0);
    let fault = (m * m.transpose() - Matrix3::identity()).norm();
    if !(fault < MAX_ROTATION_FAULT && m.determinant() > 0.0) {
        return Err("r is no rotation".to_owned());
    }
    // Without a limit to its iterations the search for the nearest one need not end.
    Ok(Rotation3::from_matrix_eps(
        &m,
        1e-15,
        100,
        Rotation3::identity(),
    ))
}

/// The calibrations of a rig's cameras, without header. `None` if the rig cannot be rectified.
#[must_use]
pub fn of_rig(rig: &StereoRig) -> Option<[CameraInfo; 2]> {
    let rectification = Rectification::new(rig)?;
    let focal_px = rectification.focal_px();
    let one = |camera: &Camera, common_from_camera: &Rotation3<f64>, shift: f64| {
        let (f, c) = (camera.focal_px, camera.principal_point_px);
        let (model, d) = match camera.distortion() {
            Distortion::None => ("plumb_bob", vec![0.0; 5]),
            Distortion::Radtan(k) if k[5..].iter().all(|k| *k == 0.0) => {
                ("plumb_bob", k[..5].to_vec())
            }
            Distortion::Radtan(k) => ("rational_polynomial", k.to_vec()),
            Distortion::Equidistant(k) => ("equidistant", k.to_vec()),
        };
        let m = common_from_camera.matrix();
        let centre = [
            0.5 * f64::from(camera.width - 1),
            0.5 * f64::from(camera.height - 1),
        ];
        CameraInfo {
            height: camera.height,
            width: camera.width,
            distortion_model: model.to_owned(),
            d,
            k: Fixed([f.x, 0.0, c.x, 0.0, f.y, c.y, 0.0, 0.0, 1.0]),
            r: Fixed(std::array::from_fn(|i| m[(i / 3, i % 3)])),
            p: Fixed([
                focal_px, 0.0, centre[0], shift, 0.0, focal_px, centre[1], 0.0, 0.0, 0.0, 1.0, 0.0,
            ]),
            ..CameraInfo::default()
        }
    };
    Some([
        one(&rig.left, rectification.common_from_left(), 0.0),
        one(
            &rig.right,
            rectification.common_from_right(),
            -focal_px * rig.baseline_m(),
        ),
    ])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::parse_rig;

    fn thesis_rig() -> StereoRig {
        parse_rig(
            "left = { width = 1280, height = 960, focal = [1771.6, 1768.2], principal_point = [626.4, 487.0], distortion = { model = \"radtan\", coefficients = [-0.25, 0.1, 0.0005, -0.0003, 0.01] } }
             right = { width = 1280, height = 960, focal = [1765.9, 1762.4], principal_point = [600.4, 492.8], distortion = { model = \"equidistant\", coefficients = [-0.01, 0.02, -0.01, 0.002] } }
             right_from_left = { translation_m = [-0.3857, -0.0072, 0.0001], rotation_vector_rad = [0.04046, 0.01616, 0.01419] }",
        )
        .expect("valid")
    }

    fn back(infos: &[CameraInfo; 2], is_rectified: bool) -> Result<StereoRig, String> {
        let [left, right] = [
            ("/left/camera_info", &infos[0]),
            ("/right/camera_info", &infos[1]),
        ]
        .map(|(topic, info)| Calibration {
            topic,
            info,
            is_rectified,
        });
        rig(left, right)
    }

    #[test]
    fn a_rig_comes_back_from_its_calibrations() {
        let rig = thesis_rig();
        let infos = of_rig(&rig).expect("side by side");
        let same = back(&infos, false).expect("whole");
        assert_eq!((&same.left, &same.right), (&rig.left, &rig.right));
        let gap = rig.right_from_left.inverse() * same.right_from_left;
        assert!(
            gap.translation.vector.norm() < 1e-12 && gap.rotation.angle() < 1e-12,
            "{gap}"
        );
    }

    #[test]
    fn rectified_images_have_the_rectified_rig() {
        let infos = of_rig(&thesis_rig()).expect("side by side");
        let rectified = back(&infos, true).expect("whole");
        assert_eq!(rectified.left.distortion(), &Distortion::None);
        assert_eq!(rectified.left.focal_px.x, infos[0].p.0[0]);
        assert_eq!(
            rectified.right_from_left.rotation,
            UnitQuaternion::identity()
        );
        let baseline_m = thesis_rig().baseline_m();
        assert!((rectified.right_from_left.translation.x + baseline_m).abs() < 1e-12);
    }

    #[test]
    fn what_is_no_calibration_is_named() {
        let good = of_rig(&thesis_rig()).expect("side by side");
        let mut without = good.clone();
        without[1].p.0[3] = 0.0;
        let why = back(&without, false).expect_err("no baseline");
        assert!(
            why.contains("/right/camera_info") && why.contains("no baseline"),
            "{why}"
        );
        let mut never = good.clone();
        never[0].k = Fixed::default();
        let why = back(&never, false).expect_err("no focal length");
        assert!(why.contains("never calibrated"), "{why}");
        let mut strange = good.clone();
        strange[0].distortion_model = "thin_prism".to_owned();
        let why = back(&strange, false).expect_err("unknown");
        assert!(why.contains("\"thin_prism\" of 5"), "{why}");
        let mut turned = good;
        turned[1].r.0[0] = 3.0;
        assert!(back(&turned, false).is_err());
    }
}
