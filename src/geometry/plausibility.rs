//! Calibrations that parse but cannot be right, and what the mistake most likely is.

use super::{Camera, StereoRig, so3};
use nalgebra::Vector2;

/// How sure it is that a rig is wrong.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Severity {
    /// Unusual: look again.
    Warning,
    /// Poses from such a rig would be wrong.
    Error,
}

/// One thing that looks wrong about a rig.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
pub struct Finding {
    /// How sure it is.
    pub severity: Severity,
    /// The key of the rig file that it is about.
    pub key: String,
    /// One sentence: what is odd, and the likely mend.
    pub message: String,
}

/// A principal point farther from the centre than this share of the image's side is odd.
const MAX_CENTRE_OFFSET: f64 = 0.15;
/// Focal lengths outside this range, in image widths, are odd: views from 150° to 5°.
const FOCAL_IN_WIDTHS: std::ops::RangeInclusive<f64> = 0.13..=12.0;
/// Baselines, m, outside this range are odd for a robot.
const BASELINE_M: std::ops::RangeInclusive<f64> = 0.005..=3.0;
/// Cameras turned apart by more than this, rad, hardly share a view.
const MAX_TURN_RAD: f64 = 0.6;

/// What looks wrong about a rig; empty for a plausible one.
#[must_use]
pub fn check_rig(rig: &StereoRig) -> Vec<Finding> {
    let mut findings = Vec::new();
    check_camera("left", &rig.left, &mut findings);
    check_camera("right", &rig.right, &mut findings);
    check_focal_match(rig, &mut findings);
    check_extrinsics(rig, &mut findings);
    findings
}

fn check_camera(side: &str, camera: &Camera, findings: &mut Vec<Finding>) {
    let size = Vector2::new(f64::from(camera.width), f64::from(camera.height));
    let offset = centre_offset(&camera.principal_point_px, &size);
    if offset > MAX_CENTRE_OFFSET {
        let (severity, message) = match other_size(camera) {
            Some(scale) => (
                Severity::Error,
                format!(
                    "the principal point ({:.1}, {:.1}) lies far from the centre of {}×{} images, but near \
                     that of {:.0}×{:.0} ones: the calibration belongs to images of another resolution; \
                     multiply its focal lengths and principal point by {}",
                    camera.principal_point_px.x,
                    camera.principal_point_px.y,
                    camera.width,
                    camera.height,
                    size.x / scale,
                    size.y / scale,
                    scale,
                ),
            ),
            None => (
                Severity::Warning,
                format!(
                    "the principal point ({:.1}, {:.1}) lies {:.0} % of the image's side away from the centre \
                     of {}×{} images: check that it belongs to this camera and resolution",
                    camera.principal_point_px.x,
                    camera.principal_point_px.y,
                    offset * 100.0,
                    camera.width,
                    camera.height,
                ),
            ),
        };
        push(
            findings,
            severity,
            format!("{side}.principal_point"),
            message,
        );
    }
    let in_widths = camera.focal_px.x / size.x.max(size.y);
    if !FOCAL_IN_WIDTHS.contains(&in_widths) {
        push(
            findings,
            Severity::Error,
            format!("{side}.focal"),
            format!(
                "a focal length of {:.1} px on a {} px wide image is a view of {:.1}°: it must be in pixels, \
                 not in millimetres or metres",
                camera.focal_px.x,
                camera.width,
                (0.5 / in_widths).atan().to_degrees() * 2.0,
            ),
        );
    }
    let aspect = camera.focal_px.x / camera.focal_px.y;
    if !(0.95..=1.05).contains(&aspect) {
        push(
            findings,
            Severity::Warning,
            format!("{side}.focal"),
            format!(
                "the focal lengths in x and y differ by {:.1} %: pixels are square on most cameras",
                (aspect - 1.0).abs() * 100.0
            ),
        );
    }
}

fn check_focal_match(rig: &StereoRig, findings: &mut Vec<Finding>) {
    let per_width = |camera: &Camera| camera.focal_px.x / f64::from(camera.width);
    let ratio = per_width(&rig.left) / per_width(&rig.right);
    if !(0.67..=1.5).contains(&ratio) {
        push(
            findings,
            Severity::Warning,
            "right.focal".to_owned(),
            format!(
                "the cameras' fields of view differ by a factor of {:.2}: check that both calibrations belong to the same resolution",
                ratio.max(1.0 / ratio)
            ),
        );
    }
}

fn check_extrinsics(rig: &StereoRig, findings: &mut Vec<Finding>) {
    let baseline = rig.baseline_m();
    if baseline > *BASELINE_M.end() {
        push(
            findings,
            Severity::Error,
            "right_from_left.translation_m".to_owned(),
            format!(
                "a baseline of {baseline:.3} m: translations are in metres; if this is {baseline:.1} mm, divide by 1000"
            ),
        );
    } else if baseline < *BASELINE_M.start() {
        push(
            findings,
            Severity::Error,
            "right_from_left.translation_m".to_owned(),
            format!(
                "a baseline of {:.2} mm is too short to measure depth: check its unit",
                baseline * 1e3
            ),
        );
    }
    let angle = so3::log(&rig.right_from_left.rotation).norm();
    if angle > MAX_TURN_RAD {
        push(
            findings,
            Severity::Error,
            "right_from_left.rotation_vector_rad".to_owned(),
            format!(
                "the cameras are turned apart by {:.0}°: rotation vectors are in radians; if this is degrees, divide by 57.2958",
                angle.to_degrees()
            ),
        );
        return;
    }
    let right_in_left = rig.right_from_left.inverse().translation.vector;
    if right_in_left.x < 0.0 && right_in_left.x.abs() > 0.5 * baseline {
        push(
            findings,
            Severity::Error,
            "right_from_left.translation_m".to_owned(),
            "the right camera stands to the left of the left one: the sign of the translation is wrong (it is where the left camera's origin lies for the right camera, so x is negative), or left and right are swapped".to_owned(),
        );
    } else if right_in_left.x.abs() < 0.5 * baseline {
        push(
            findings,
            Severity::Warning,
            "right_from_left.translation_m".to_owned(),
            "the cameras stand above or behind one another rather than side by side".to_owned(),
        );
    }
}

/// The distance from the centre as a share of the side, the larger of both axes.
fn centre_offset(principal_point: &Vector2<f64>, size: &Vector2<f64>) -> f64 {
    let offset = (principal_point - (size - Vector2::repeat(1.0)) * 0.5).component_div(size);
    offset.x.abs().max(offset.y.abs())
}

/// The factor between the image's size and that to which the principal point seems to belong.
fn other_size(camera: &Camera) -> Option<f64> {
    let size = Vector2::new(f64::from(camera.width), f64::from(camera.height));
    [2.0, 4.0, 3.0, 1.5, 0.5, 0.25, 1.0 / 3.0, 2.0 / 3.0]
        .into_iter()
        .find(|scale| centre_offset(&camera.principal_point_px, &(size / *scale)) < 0.07)
}

fn push(findings: &mut Vec<Finding>, severity: Severity, key: String, message: String) {
    findings.push(Finding {
        severity,
        key,
        message,
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::parse_rig;

    /// The thesis' table (§4.3) as printed: 1280×960 images with the calibration of 640×480 ones.
    const THESIS_AS_PRINTED: &str = "
        left = { width = 1280, height = 960, focal = [885.81833, 884.10614], principal_point = [313.18805, 243.49370] }
        right = { width = 1280, height = 960, focal = [882.93736, 881.18040], principal_point = [300.19781, 246.39833] }
        right_from_left = { translation_m = [-0.3857, -0.0072, 0.0001], rotation_vector_rad = [0.04046, 0.01616, 0.01419] }
    ";

    fn findings(text: &str) -> Vec<Finding> {
        check_rig(&parse_rig(text).expect("parses"))
    }

    #[test]
    fn the_thesis_own_table_is_caught() {
        let found = findings(THESIS_AS_PRINTED);
        assert_eq!(found.len(), 2, "{found:#?}");
        for (finding, side) in found.iter().zip(["left", "right"]) {
            assert_eq!(finding.severity, Severity::Error);
            assert_eq!(finding.key, format!("{side}.principal_point"));
            assert!(finding.message.contains("640×480"), "{}", finding.message);
            assert!(finding.message.ends_with("by 2"), "{}", finding.message);
        }
    }

    #[test]
    fn the_thesis_rig_at_its_own_resolution_is_plausible() {
        let text = THESIS_AS_PRINTED
            .replace("1280", "640")
            .replace("960", "480");
        assert_eq!(findings(&text), []);
    }

    #[test]
    fn units_and_signs_are_caught() {
        let good = THESIS_AS_PRINTED
            .replace("1280", "640")
            .replace("960", "480");
        for (from, to, key, word) in [
            (
                "-0.3857, -0.0072, 0.0001",
                "-385.7, -7.2, 0.1",
                "right_from_left.translation_m",
                "mm",
            ),
            (
                "-0.3857, -0.0072",
                "0.3857, -0.0072",
                "right_from_left.translation_m",
                "swapped",
            ),
            (
                "0.04046, 0.01616, 0.01419",
                "2.318, 0.926, 0.813",
                "right_from_left.rotation_vector_rad",
                "degrees",
            ),
            (
                "[885.81833, 884.10614]",
                "[0.0041, 0.0041]",
                "left.focal",
                "millimetres",
            ),
        ] {
            assert!(good.contains(from));
            let found = findings(&good.replacen(from, to, 1));
            assert!(
                found
                    .iter()
                    .any(|f| f.key == key && f.message.contains(word)),
                "{to}: {found:#?}"
            );
        }
    }
}
