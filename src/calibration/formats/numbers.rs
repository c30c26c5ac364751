//! Numbers as files have them, matrices and lenses made of them.

use crate::capture::yaml::{Node, YamlFile};
use crate::geometry::rig_parameters::EXTRINSICS;
use crate::geometry::{Camera, Distortion, RigUncertainty, StereoRig};
use crate::text_file::shown;
use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion, Vector2, Vector3};

/// Farthest that a matrix stated as a rotation may be from one: files with four digits pass.
const MAX_ROTATION_FAULT: f64 = 1e-3;

/// Numbers with commas between, each to the last bit.
pub(super) fn list(numbers: &[f64]) -> String {
    numbers
        .iter()
        .map(|n| format!("{n:?}"))
        .collect::<Vec<_>>()
        .join(", ")
}

/// A matrix' numbers row by row.
pub(super) fn rows<R: nalgebra::Dim, C: nalgebra::Dim, S: nalgebra::RawStorage<f64, R, C>>(
    matrix: &nalgebra::Matrix<f64, R, C, S>,
) -> Vec<f64> {
    matrix
        .row_iter()
        .flat_map(|row| row.iter().copied().collect::<Vec<_>>())
        .collect()
}

/// The numbers of a key: a list, or a map with `data`.
pub(super) fn of_key(yaml: &YamlFile, node: &Node, key: &str) -> Result<Vec<f64>, String> {
    let node = node.get("data").unwrap_or(node);
    yaml.numbers(node, key).map_err(|e| e.to_string())
}

/// As [`of_key`], exactly so many.
pub(super) fn exactly<const N: usize>(
    yaml: &YamlFile,
    node: &Node,
    key: &str,
) -> Result<[f64; N], String> {
    let numbers = of_key(yaml, node, key)?;
    let count = numbers.len();
    numbers.try_into().map_err(|_| {
        yaml.wrong(node, key, format!("has {N} numbers, but there are {count}"))
            .to_string()
    })
}

/// The nearest rotation to a stated one.
pub(super) fn rotation(numbers: &[f64; 9]) -> Result<UnitQuaternion<f64>, String> {
    let stated = Matrix3::from_row_slice(numbers);
    let fault = (stated.transpose() * stated - Matrix3::identity()).amax();
    if fault > MAX_ROTATION_FAULT || stated.determinant() < 0.0 {
        return Err("is not a rotation matrix".to_owned());
    }
    let nearest = Rotation3::from_matrix_eps(&stated, 1e-15, 100, Rotation3::identity());
    Ok(UnitQuaternion::from_rotation_matrix(&nearest))
}

/// A motion from rotation and translation.
pub(super) fn motion(rotation: UnitQuaternion<f64>, translation: [f64; 3]) -> Isometry3<f64> {
    Isometry3::from_parts(Translation3::from(Vector3::from(translation)), rotation)
}

/// A rig of two cameras.
pub(super) fn rig(left: Camera, right: Camera, right_from_left: Isometry3<f64>) -> StereoRig {
    StereoRig {
        left,
        right,
        right_from_left,
        base_from_camera: None,
        uncertainty: None,
    }
}

/// Coefficients in OpenCV's order; what is zero throughout is no distortion.
pub(super) fn radtan(coefficients: &[f64]) -> Result<Distortion, String> {
    let count = coefficients.len();
    if !matches!(count, 0 | 4 | 5 | 8 | 12 | 14) {
        return Err(format!(
            "a lens has 4, 5 or 8 coefficients, but there are {count}"
        ));
    }
    if let Some(thin) = coefficients.iter().skip(8).find(|c| **c != 0.0) {
        return Err(format!(
            "thin prism or tilt coefficients are not known here, but one is {thin}; calibrate with 8 coefficients at most"
        ));
    }
    if coefficients.iter().all(|c| *c == 0.0) {
        return Ok(Distortion::None);
    }
    let mut k = [0.0; 8];
    for (k, coefficient) in k.iter_mut().zip(coefficients) {
        *k = *coefficient;
    }
    Ok(Distortion::Radtan(k))
}

/// A lens as others call it, with its coefficients.
pub(super) fn lens(model: &str, coefficients: &[f64]) -> Result<Distortion, String> {
    match model {
        "none" => Ok(Distortion::None),
        "plumb_bob" | "radtan" | "radial-tangential" | "rational_polynomial" => {
            radtan(coefficients)
        }
        "equidistant" | "fisheye" => <[f64; 4]>::try_from(coefficients)
            .map(Distortion::Equidistant)
            .map_err(|_| {
                format!(
                    "a fisheye has 4 coefficients, but there are {}",
                    coefficients.len()
                )
            }),
        other => Err(format!("a lens model \"{}\" is not known", shown(other))),
    }
}

/// The coefficients of a radial and tangential lens: at least `least`, and eight if it takes them.
pub(super) fn coefficients(distortion: &Distortion, least: usize) -> Vec<f64> {
    match distortion {
        Distortion::None => vec![0.0; least],
        Distortion::Equidistant(k) => k.to_vec(),
        Distortion::Radtan(k) => {
            let last = if k[5..].iter().any(|c| *c != 0.0) {
                8
            } else if k[4] != 0.0 {
                5
            } else {
                4
            };
            k[..last.max(least)].to_vec()
        }
    }
}

/// A camera, its numbers checked.
pub(super) fn camera(
    (width, height): (u32, u32),
    focal: [f64; 2],
    principal_point: [f64; 2],
    distortion: Distortion,
) -> Result<Camera, String> {
    const MAX_SIDE_PX: u32 = 16_384;
    if !(1..=MAX_SIDE_PX).contains(&width) || !(1..=MAX_SIDE_PX).contains(&height) {
        return Err(format!(
            "an image has sides of 1 to {MAX_SIDE_PX} px, not {width}×{height}"
        ));
    }
    if !focal.iter().all(|f| f.is_finite() && *f > 0.0) {
        return Err(format!(
            "focal lengths must be above 0 px, but are {} and {}",
            focal[0], focal[1]
        ));
    }
    Ok(Camera::new(
        width,
        height,
        Vector2::from(focal),
        Vector2::from(principal_point),
        distortion,
    ))
}

/// A camera from its 3×3 matrix, which must not have skew.
pub(super) fn camera_of_matrix(
    size_px: (u32, u32),
    k: &[f64; 9],
    distortion: Distortion,
) -> Result<Camera, String> {
    if k[1] != 0.0 || k[3] != 0.0 || k[6..] != [0.0, 0.0, 1.0] {
        return Err("a camera matrix is [f 0 c; 0 f c; 0 0 1]".to_owned());
    }
    camera(size_px, [k[0], k[4]], [k[2], k[5]], distortion)
}

/// A whole number of pixels.
pub(super) fn pixels(word: &str) -> Option<u32> {
    word.parse::<f64>()
        .ok()
        .filter(|v| v.fract() == 0.0 && (1.0..=65_536.0).contains(v))
        .map(|v| v as u32)
}

/// 3×3 of a camera.
pub(super) fn matrix(camera: &Camera) -> [f64; 9] {
    let (f, c) = (camera.focal_px, camera.principal_point_px);
    [f.x, 0.0, c.x, 0.0, f.y, c.y, 0.0, 0.0, 1.0]
}

/// Turns lengths into metres.
pub(super) fn scale_lengths(rig: &mut StereoRig, unit_m: f64) {
    rig.right_from_left.translation.vector *= unit_m;
    match &mut rig.uncertainty {
        Some(RigUncertainty::Sigmas { translation_m, .. }) => *translation_m *= unit_m,
        Some(RigUncertainty::Covariance { covariance, .. }) => {
            for i in EXTRINSICS..EXTRINSICS + 3 {
                covariance.row_mut(i).scale_mut(unit_m);
                covariance.column_mut(i).scale_mut(unit_m);
            }
        }
        None => {}
    }
}
