//! A rig as a vector of numbers: which they are, what a small error of each does, and how well they
//! are known together.
//!
//! The vector is an *error* of the rig: focal lengths, principal point and distortion coefficients
//! add up; the translation of `right_from_left` adds up; its rotation is multiplied from the left,
//! `exp(r) · R`, a turn about the right camera's axes.

use super::{Camera, Distortion, RigUncertainty, StereoRig, so3};
use crate::text_file::{self, shown};
use nalgebra::{Isometry3, SMatrix, SVector, Translation3, Vector2};
use std::path::Path;

/// Slots of a camera: fx, fy, cx, cy, then at most eight coefficients of its distortion.
pub const CAMERA_PARAMETERS: usize = 12;
/// Slots of a rig: left camera, right camera, translation, rotation. Slots that a lens model does
/// not use are always zero.
pub const RIG_PARAMETERS: usize = 2 * CAMERA_PARAMETERS + 6;
/// The first slot of the translation (m); the rotation's (rad) follow.
pub const EXTRINSICS: usize = 2 * CAMERA_PARAMETERS;

/// An error of a rig.
pub type RigVector = SVector<f64, RIG_PARAMETERS>;
/// The covariance of a rig's errors.
pub type RigCovariance = SMatrix<f64, RIG_PARAMETERS, RIG_PARAMETERS>;

impl StereoRig {
    /// The rig with an error added.
    #[must_use]
    pub fn with_error(&self, error: &RigVector) -> Self {
        let extrinsic = |first: usize| error.fixed_rows::<3>(EXTRINSICS + first).into_owned();
        let right_from_left = Isometry3::from_parts(
            Translation3::from(self.right_from_left.translation.vector + extrinsic(0)),
            so3::exp(&extrinsic(3)) * self.right_from_left.rotation,
        );
        Self {
            left: camera_with_error(&self.left, &error.fixed_rows::<CAMERA_PARAMETERS>(0).into()),
            right: camera_with_error(
                &self.right,
                &error
                    .fixed_rows::<CAMERA_PARAMETERS>(CAMERA_PARAMETERS)
                    .into(),
            ),
            right_from_left,
            ..self.clone()
        }
    }

    /// How well the rig's parameters are known, where that was stated.
    #[must_use]
    pub fn covariance(&self) -> Option<RigCovariance> {
        match self.uncertainty.as_ref()? {
            RigUncertainty::Covariance { covariance, .. } => Some(**covariance),
            RigUncertainty::Sigmas {
                focal_px,
                principal_point_px,
                rotation_rad,
                translation_m,
            } => {
                let mut sigmas = RigVector::zeros();
                for camera in [0, CAMERA_PARAMETERS] {
                    sigmas.fixed_rows_mut::<2>(camera).fill(*focal_px);
                    sigmas
                        .fixed_rows_mut::<2>(camera + 2)
                        .fill(*principal_point_px);
                }
                sigmas.fixed_rows_mut::<3>(EXTRINSICS).fill(*translation_m);
                sigmas
                    .fixed_rows_mut::<3>(EXTRINSICS + 3)
                    .fill(*rotation_rad);
                Some(RigCovariance::from_diagonal(&sigmas.component_mul(&sigmas)))
            }
        }
    }

    /// The names of the parameters that this rig has, with their slots: `left.fx`, …,
    /// `right.k1`, …, `tx`, `ty`, `tz`, `rx`, `ry`, `rz`.
    #[must_use]
    pub fn parameter_names(&self) -> Vec<(String, usize)> {
        let mut names = Vec::new();
        for (side, camera, first) in [
            ("left", &self.left, 0),
            ("right", &self.right, CAMERA_PARAMETERS),
        ] {
            let lens: &[&str] = match camera.distortion() {
                Distortion::None => &[],
                Distortion::Radtan(_) => &["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"],
                Distortion::Equidistant(_) => &["k1", "k2", "k3", "k4"],
            };
            let all = ["fx", "fy", "cx", "cy"].iter().chain(lens).enumerate();
            names.extend(all.map(|(i, name)| (format!("{side}.{name}"), first + i)));
        }
        let extrinsics = ["tx", "ty", "tz", "rx", "ry", "rz"].iter().enumerate();
        names.extend(extrinsics.map(|(i, name)| ((*name).to_owned(), EXTRINSICS + i)));
        names
    }
}

fn camera_with_error(camera: &Camera, error: &SVector<f64, CAMERA_PARAMETERS>) -> Camera {
    let distortion = match *camera.distortion() {
        Distortion::None => Distortion::None,
        Distortion::Radtan(mut k) => {
            for (k, error) in k.iter_mut().zip(error.iter().skip(4)) {
                *k += error;
            }
            Distortion::Radtan(k)
        }
        Distortion::Equidistant(mut k) => {
            for (k, error) in k.iter_mut().zip(error.iter().skip(4)) {
                *k += error;
            }
            Distortion::Equidistant(k)
        }
    };
    Camera::new(
        camera.width,
        camera.height,
        camera.focal_px + Vector2::new(error[0], error[1]),
        camera.principal_point_px + Vector2::new(error[2], error[3]),
        distortion,
    )
}

/// The covariance of a rig's parameters as CSV: a line of names, then the matrix row by row, in the
/// parameters' own units. Those that the rig has not are left out.
#[must_use]
pub fn rig_covariance_to_csv(rig: &StereoRig, covariance: &RigCovariance) -> String {
    let names = rig.parameter_names();
    let mut text = names
        .iter()
        .map(|(name, _)| name.as_str())
        .collect::<Vec<_>>()
        .join(",");
    for (_, i) in &names {
        text.push('\n');
        let row = names
            .iter()
            .map(|(_, j)| format!("{:?}", covariance[(*i, *j)]));
        text.push_str(&row.collect::<Vec<_>>().join(","));
    }
    text.push('\n');
    text
}

/// Longest file that is read, bytes: thirty by thirty numbers have 20 000.
const MAX_BYTES: u64 = 1 << 20;

/// Reads what [`rig_covariance_to_csv`] writes; parameters that are not named are exact.
///
/// # Errors
/// One sentence: the file cannot be read, names a parameter that the rig has not, or does not hold
/// a covariance.
pub fn read_rig_covariance(rig: &StereoRig, path: &Path) -> Result<RigCovariance, String> {
    let text = text_file::read(path, MAX_BYTES).map_err(|fault| fault.to_string());
    text.and_then(|text| parse_rig_covariance(rig, &text))
        .map_err(|cause| format!("{}: {cause}", path.display()))
}

/// As [`read_rig_covariance`], from a text.
///
/// # Errors
/// As there, without the file's name.
pub fn parse_rig_covariance(rig: &StereoRig, text: &str) -> Result<RigCovariance, String> {
    let known = rig.parameter_names();
    let mut lines = text.lines().map(str::trim).filter(|line| !line.is_empty());
    let header = lines.next().ok_or("holds nothing")?;
    let mut slots = Vec::new();
    for name in header.split(',').map(str::trim) {
        let slot = known.iter().find(|(known, _)| known == name);
        let Some((_, slot)) = slot else {
            return Err(format!(
                "1: \"{}\" is no parameter of this rig",
                shown(name)
            ));
        };
        if slots.contains(slot) {
            return Err(format!("1: {name:?} is named twice"));
        }
        slots.push(*slot);
    }
    let mut covariance = RigCovariance::zeros();
    let mut rows = 0;
    for (i, line) in slots.iter().zip(lines.by_ref()) {
        rows += 1;
        let numbers: Vec<&str> = line.split(',').map(str::trim).collect();
        if numbers.len() != slots.len() {
            return Err(format!(
                "row {rows} must hold {} numbers, one a name, but holds {}",
                slots.len(),
                numbers.len()
            ));
        }
        for (number, j) in numbers.iter().zip(&slots) {
            covariance[(*i, *j)] = match number.parse::<f64>() {
                Ok(value) if value.is_finite() => value,
                _ => {
                    let shown = shown(number);
                    return Err(format!("row {rows} holds \"{shown}\", which is no number"));
                }
            };
        }
    }
    if rows != slots.len() || lines.next().is_some() {
        return Err(format!("must hold {} rows, one a name", slots.len()));
    }
    check(&covariance).map(|()| covariance)
}

/// Symmetric, and no combination of parameters has a negative variance.
fn check(covariance: &RigCovariance) -> Result<(), String> {
    let mut correlation = *covariance;
    for i in 0..RIG_PARAMETERS {
        if covariance[(i, i)] < 0.0 {
            return Err("is no covariance: a variance is negative".to_owned());
        }
        for j in 0..RIG_PARAMETERS {
            let scale = (covariance[(i, i)] * covariance[(j, j)]).sqrt();
            if (covariance[(i, j)] - covariance[(j, i)]).abs() > 1e-9 * scale {
                return Err("is no covariance: it is not symmetric".to_owned());
            }
            correlation[(i, j)] = if scale > 0.0 {
                covariance[(i, j)] / scale
            } else {
                0.0
            };
        }
    }
    let least = correlation.symmetric_eigenvalues().min();
    if least < -1e-9 {
        return Err(
            "is no covariance: a combination of parameters has a negative variance".to_owned(),
        );
    }
    Ok(())
}

/// Where a camera sees a position of its normalised plane, and by how much that moves with each of
/// the camera's parameters, px per unit.
pub(crate) fn pixel_by_parameters(
    camera: &Camera,
    normalised: &Vector2<f64>,
) -> SMatrix<f64, 2, CAMERA_PARAMETERS> {
    let distorted = camera.distortion().distort(normalised);
    let mut by = SMatrix::<f64, 2, CAMERA_PARAMETERS>::zeros();
    by[(0, 0)] = distorted.x;
    by[(1, 1)] = distorted.y;
    by[(0, 2)] = 1.0;
    by[(1, 3)] = 1.0;
    let by_lens = camera.distortion().by_coefficients(normalised);
    for i in 0..8 {
        by[(0, 4 + i)] = camera.focal_px.x * by_lens[(0, i)];
        by[(1, 4 + i)] = camera.focal_px.y * by_lens[(1, i)];
    }
    by
}

impl Camera {
    /// By how much the undistorted position that is seen at a pixel moves with each parameter of
    /// the camera (fx, fy, cx, cy, distortion), the pixel staying where it was measured.
    ///
    /// `None` where the pixel has no ray.
    #[must_use]
    pub fn unproject_by_parameters(
        &self,
        pixel: &Vector2<f64>,
    ) -> Option<SMatrix<f64, 2, CAMERA_PARAMETERS>> {
        let (normalised, by_pixel) = self.unproject_with_jacobian(pixel)?;
        Some(-by_pixel * pixel_by_parameters(self, &normalised))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::parse_rig;
    use proptest::prelude::*;

    fn rig() -> StereoRig {
        parse_rig(
            "left = { width = 640, height = 480, focal = [885.8, 884.1], principal_point = [313.2, 243.5], distortion = { model = \"radtan\", coefficients = [-0.25, 0.1, 0.0005, -0.0003, 0.01, 0.02, 0.03, 0.01] } }
             right = { width = 640, height = 480, focal = [882.9, 881.2], principal_point = [300.2, 246.4], distortion = { model = \"equidistant\", coefficients = [-0.01, 0.02, -0.01, 0.002] } }
             right_from_left = { translation_m = [-0.3857, -0.0072, 0.0001], rotation_vector_rad = [0.04046, 0.01616, 0.01419] }",
        )
        .expect("valid")
    }

    proptest! {
        #![proptest_config(crate::properties::remembered())]

        #[test]
        fn undistorted_positions_move_with_parameters_as_central_differences_say(
            x in 20.0..620.0_f64, y in 20.0..460.0_f64
        ) {
            let rig = rig();
            let px = Vector2::new(x, y);
            for camera in [&rig.left, &rig.right] {
                let exact = camera.unproject_by_parameters(&px).expect("inside");
                for j in 0..CAMERA_PARAMETERS {
                    let step = if j < 4 { 1e-2 } else { 1e-4 };
                    let at = |sign: f64| {
                        let mut error = SVector::<f64, CAMERA_PARAMETERS>::zeros();
                        error[j] = sign * step;
                        camera_with_error(camera, &error).unproject(&px).expect("inside")
                    };
                    let numeric = (at(1.0) - at(-1.0)) / (2.0 * step);
                    let unused = j >= 8 && matches!(camera.distortion(), Distortion::Equidistant(_));
                    let scale = exact.column(j).norm().max(if unused { 1.0 } else { 1e-6 });
                    prop_assert!((numeric - exact.column(j)).norm() < 1e-6 * scale.max(1e-4), "{j} {numeric} {exact}");
                }
            }
        }
    }

    #[test]
    fn a_covariance_reads_back_as_it_was_written() {
        let rig = rig();
        let root = RigCovariance::from_fn(|i, j| ((7 * i + 3 * j) % 11) as f64 * 1e-3);
        let mut covariance = root * root.transpose();
        let used: Vec<usize> = rig.parameter_names().iter().map(|(_, i)| *i).collect();
        for i in (0..RIG_PARAMETERS).filter(|i| !used.contains(i)) {
            covariance.row_mut(i).fill(0.0);
            covariance.column_mut(i).fill(0.0);
        }
        let text = rig_covariance_to_csv(&rig, &covariance);
        assert_eq!(parse_rig_covariance(&rig, &text), Ok(covariance));
        assert!(text.starts_with("left.fx,left.fy,left.cx,left.cy,left.k1,left.k2,left.p1,"));
        assert_eq!(used.len(), 12 + 8 + 6);
    }

    #[test]
    fn what_is_no_covariance_is_refused_with_a_reason() {
        let rig = rig();
        let error = |text: &str| parse_rig_covariance(&rig, text).expect_err("must be refused");
        assert_eq!(
            error("left.fx,tx\n1,0\n0,1\n1,1"),
            "must hold 2 rows, one a name"
        );
        assert_eq!(error("left.fx\n"), "must hold 1 rows, one a name");
        assert_eq!(
            error("left.fx,right.k5\n1,0\n0,1"),
            "1: \"right.k5\" is no parameter of this rig"
        );
        assert_eq!(error("tx,tx\n1,0\n0,1"), "1: \"tx\" is named twice");
        assert_eq!(
            error("tx,ty\n1\n0,1"),
            "row 1 must hold 2 numbers, one a name, but holds 1"
        );
        assert_eq!(error("tx\nnan"), "row 1 holds \"nan\", which is no number");
        assert_eq!(
            error("tx,ty\n1,0.5\n0,1"),
            "is no covariance: it is not symmetric"
        );
        assert_eq!(
            error("tx,ty\n1,2\n2,1"),
            "is no covariance: a combination of parameters has a negative variance"
        );
        assert_eq!(error("tx\n-1"), "is no covariance: a variance is negative");
    }
}
