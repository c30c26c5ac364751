//! Matched features of a few pairs, and a rig, in; whether they belong together, and if not, what is most likely wrong,
//! out.
//!
//! A match agrees with a rig where it lies on its epipolar line (Sampson's distance) and before both cameras. Of
//! images that belong to a rig most matches agree, of others hardly any. Where few do, rigs with one mistake mended
//! each are tried: if one of them fits, that was the mistake.

use crate::features::surf::{Settings as SurfSettings, Surf};
use crate::features::{ExtractError, Extractor, Features};
use crate::geometry::{Camera, Distortion, Finding, Severity, StereoRig, so3};
use crate::image::GrayImage;
use crate::settings::SettingError;
use nalgebra::{Isometry3, Translation3, Vector2};

/// A match agrees within this distance of its epipolar line, px.
const AGREES_PX: f64 = 1.5;
/// A point may seem to lie beyond infinity by this disparity, px.
const BEYOND_INFINITY_PX: f64 = 2.0;
/// Fewest matches that say anything.
const LEAST_MATCHES: usize = 60;
/// A rig fits when this share of matches agrees; repetitive scenes have many wrong ones.
const FITS: f64 = 0.35;
/// Another rig fits better when it has this many times the share of the one that was stated.
const BETTER: f64 = 1.5;
/// Matches that agree with a good rig lie this near to their lines, median px.
const GOOD_MEDIAN_PX: f64 = 0.6;
/// Most features an image that are compared.
const BUDGET: usize = 800;
/// Nearest over second nearest descriptor.
const RATIO: f32 = 0.75;

/// Where one thing was seen in the left and in the right image, px.
pub type Match = (Vector2<f64>, Vector2<f64>);

/// Finds matches anywhere in the images, without any knowledge of the rig.
pub struct Matcher {
    surf: Surf,
    features: [Features; 2],
}

impl Matcher {
    /// A matcher with the usual features.
    ///
    /// # Errors
    /// Never, as its settings are good.
    pub fn new() -> Result<Self, SettingError> {
        let settings = SurfSettings {
            budget: BUDGET,
            ..SurfSettings::default()
        };
        Ok(Self {
            surf: Surf::new(settings)?,
            features: Default::default(),
        })
    }

    /// Adds the matches of a pair: nearest neighbours both ways that stand out.
    ///
    /// # Errors
    /// The detector fails.
    pub fn add(
        &mut self,
        left: &GrayImage,
        right: &GrayImage,
        matches: &mut Vec<Match>,
    ) -> Result<(), ExtractError> {
        for (image, features) in [left, right].into_iter().zip(&mut self.features) {
            self.surf.extract(image, features)?;
        }
        let [left, right] = &self.features;
        let there = nearest(left, right);
        let back = nearest(right, left);
        for (i, j) in there.iter().enumerate() {
            let Some(j) = j else { continue };
            if back[*j] == Some(i) {
                let at = |features: &Features, k: usize| {
                    let keypoint = &features.keypoints[k];
                    Vector2::new(f64::from(keypoint.x_px), f64::from(keypoint.y_px))
                };
                matches.push((at(left, i), at(right, *j)));
            }
        }
        Ok(())
    }
}

/// For each feature of `from`, the one of `to` that is clearly the nearest.
fn nearest(from: &Features, to: &Features) -> Vec<Option<usize>> {
    (0..from.len())
        .map(|i| {
            let (mut best, mut second) = ((f32::INFINITY, None), f32::INFINITY);
            for j in 0..to.len() {
                if from.keypoints[i].laplacian != to.keypoints[j].laplacian {
                    continue;
                }
                let pairs = from.descriptor(i).iter().zip(to.descriptor(j));
                let distance: f32 = pairs.map(|(a, b)| (a - b) * (a - b)).sum();
                if distance < best.0 {
                    second = best.0;
                    best = (distance, Some(j));
                } else if distance < second {
                    second = distance;
                }
            }
            best.1.filter(|_| best.0 < RATIO * RATIO * second)
        })
        .collect()
}

/// How matches fit a rig.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Fit {
    /// How many there were.
    pub matches: usize,
    /// The share that agrees.
    pub share: f64,
    /// Their median distance from the epipolar lines, px; 0 of none.
    pub median_px: f64,
}

/// How matches fit a rig.
#[must_use]
pub fn fit(rig: &StereoRig, matches: &[Match]) -> Fit {
    let mut distances: Vec<f64> = matches.iter().filter_map(|m| distance_px(rig, m)).collect();
    distances.sort_by(f64::total_cmp);
    Fit {
        matches: matches.len(),
        share: distances.len() as f64 / matches.len().max(1) as f64,
        median_px: distances.get(distances.len() / 2).copied().unwrap_or(0.0),
    }
}

/// The distance of a match from its epipolar line, px; `None` where it does not agree.
fn distance_px(rig: &StereoRig, (left_px, right_px): &Match) -> Option<f64> {
    let (left, right) = (rig.left.ray(left_px)?, rig.right.ray(right_px)?);
    let turned = rig.right_from_left.rotation * left;
    let t = rig.right_from_left.translation.vector;
    let essential = so3::hat(&t) * rig.right_from_left.rotation.to_rotation_matrix();
    let (line_right, line_left) = (essential * left, essential.transpose() * right);
    let gradient = (line_right.xy().norm_squared() + line_left.xy().norm_squared()).sqrt();
    let focal_px = 0.25 * (rig.left.focal_px.sum() + rig.right.focal_px.sum());
    let distance_px = focal_px * right.dot(&line_right).abs() / gradient;
    // z R l + t lies along r: crossed with r, z (R l × r) = −(t × r).
    let (along, shift) = (turned.cross(&right), t.cross(&right));
    let inverse_depth = -along.dot(&shift) / shift.norm_squared().max(f64::MIN_POSITIVE);
    let infinity = -BEYOND_INFINITY_PX / (focal_px * t.norm());
    (distance_px < AGREES_PX && inverse_depth > infinity).then_some(distance_px)
}

/// A rig with one mistake mended.
struct Mended {
    rig: StereoRig,
    /// Whether left and right images are exchanged as well.
    is_swapped: bool,
    key: &'static str,
    mend: String,
}

/// Whether matches belong to a rig; what is wrong otherwise.
#[must_use]
pub fn check(rig: &StereoRig, matches: &[Match]) -> (Fit, Vec<Finding>) {
    let stated = fit(rig, matches);
    if matches.len() < LEAST_MATCHES {
        let message = format!(
            "only {} features were matched, too few to hold the rig against: show it a scene with more to see",
            matches.len()
        );
        return (stated, vec![finding(Severity::Warning, "images", message)]);
    }
    let exchanged: Vec<Match> = matches.iter().map(|(l, r)| (*r, *l)).collect();
    let best = mended(rig)
        .into_iter()
        .map(|mended| {
            let matches = if mended.is_swapped {
                &exchanged
            } else {
                matches
            };
            (fit(&mended.rig, matches), mended)
        })
        .fold(None, |best: Option<(Fit, Mended)>, next| match best {
            Some(best) if best.0.share >= next.0.share => Some(best),
            _ => Some(next),
        });
    let percent = |share: f64| format!("{:.0} %", 100.0 * share);
    if let Some((other, mended)) =
        best.filter(|(other, _)| other.share > FITS && other.share > BETTER * stated.share)
    {
        let message = format!(
            "only {} of the images' {} matches agree with the rig, but {} do if {}",
            percent(stated.share),
            matches.len(),
            percent(other.share),
            mended.mend
        );
        return (stated, vec![finding(Severity::Error, mended.key, message)]);
    }
    let mut findings = Vec::new();
    if stated.share < FITS {
        let message = format!(
            "only {} of the images' {} matches agree with the rig, and no single mistake explains it: do these images come from this rig, unchanged since it was calibrated?",
            percent(stated.share),
            matches.len()
        );
        findings.push(finding(Severity::Error, "images", message));
    } else if stated.median_px > GOOD_MEDIAN_PX {
        let message = format!(
            "matches lie {:.2} px from their epipolar lines (median), where {GOOD_MEDIAN_PX} px or less are usual: the rig may have shifted since it was calibrated; calibrate anew",
            stated.median_px
        );
        findings.push(finding(Severity::Warning, "images", message));
    }
    (stated, findings)
}

fn finding(severity: Severity, key: &str, message: String) -> Finding {
    Finding {
        severity,
        key: key.to_owned(),
        message,
    }
}

/// The rig with each of the usual mistakes mended.
fn mended(rig: &StereoRig) -> Vec<Mended> {
    let mut all = Vec::new();
    let mut push = |rig: StereoRig, is_swapped: bool, key: &'static str, mend: &str| {
        all.push(Mended {
            rig,
            is_swapped,
            key,
            mend: mend.to_owned(),
        });
    };
    push(
        rectified(rig),
        false,
        "images",
        "they are rectified images: give visod the raw ones, or a rig without distortion and rotation, with the rectified focal length and principal point",
    );
    push(
        StereoRig {
            left: with_lens(&rig.left, Distortion::None),
            right: with_lens(&rig.right, Distortion::None),
            ..rig.clone()
        },
        false,
        "left.distortion",
        "they are undistorted already: give visod the raw ones, or set the distortion to none",
    );
    push(
        rig.clone(),
        true,
        "images",
        "left and right images are exchanged: swap the cameras",
    );
    let extrinsics = |right_from_left: Isometry3<f64>| StereoRig {
        right_from_left,
        ..rig.clone()
    };
    let (t, turn) = (
        rig.right_from_left.translation.vector,
        rig.right_from_left.rotation,
    );
    push(
        extrinsics(rig.right_from_left.inverse()),
        false,
        "right_from_left",
        "it is left_from_right: invert it",
    );
    push(
        extrinsics(Isometry3::from_parts(Translation3::from(-t), turn)),
        false,
        "right_from_left.translation_m",
        "the translation has the other sign: negate it",
    );
    push(
        extrinsics(Isometry3::from_parts(Translation3::from(t), turn.inverse())),
        false,
        "right_from_left.rotation_vector_rad",
        "the rotation runs the other way: negate the rotation vector (a matrix was transposed)",
    );
    let stated = so3::log(&turn);
    for turns in -2..=2 {
        // Degrees taken as radians may be more than half a turn, of which a rotation keeps what is left of whole turns.
        let whole = stated.try_normalize(1e-12).map_or(stated, |axis| {
            stated + axis * (std::f64::consts::TAU * f64::from(turns))
        });
        push(
            extrinsics(Isometry3::from_parts(
                Translation3::from(t),
                so3::exp(&(whole * 1_f64.to_radians())),
            )),
            false,
            "right_from_left.rotation_vector_rad",
            "the rotation is in degrees: divide it by 57.2958",
        );
    }
    push(
        StereoRig {
            left: rig.right.clone(),
            right: rig.left.clone(),
            ..rig.clone()
        },
        false,
        "left",
        "the tables left and right are exchanged",
    );
    for scale in [2.0, 0.5, 1.5, 2.0 / 3.0, 4.0, 0.25] {
        push(
            StereoRig {
                left: resized(&rig.left, scale),
                right: resized(&rig.right, scale),
                ..rig.clone()
            },
            false,
            "left.focal",
            &format!(
                "the calibration belongs to another resolution: multiply focal lengths and principal points by {scale:.3}"
            ),
        );
    }
    all
}

/// What a rig usually becomes when its images are rectified: one common camera, side by side.
fn rectified(rig: &StereoRig) -> StereoRig {
    let focal = 0.25 * (rig.left.focal_px.sum() + rig.right.focal_px.sum());
    let camera = |camera: &Camera| {
        let centre = Vector2::new(
            f64::from(camera.width) - 1.0,
            f64::from(camera.height) - 1.0,
        ) * 0.5;
        Camera::new(
            camera.width,
            camera.height,
            Vector2::repeat(focal),
            centre,
            Distortion::None,
        )
    };
    StereoRig {
        left: camera(&rig.left),
        right: camera(&rig.right),
        right_from_left: Isometry3::translation(-rig.baseline_m(), 0.0, 0.0),
        ..rig.clone()
    }
}

fn with_lens(camera: &Camera, lens: Distortion) -> Camera {
    Camera::new(
        camera.width,
        camera.height,
        camera.focal_px,
        camera.principal_point_px,
        lens,
    )
}

fn resized(camera: &Camera, scale: f64) -> Camera {
    // Pixel centres are at integers: the image's edge lies half a pixel before the first.
    let half = Vector2::repeat(0.5);
    Camera::new(
        camera.width,
        camera.height,
        camera.focal_px * scale,
        (camera.principal_point_px + half) * scale - half,
        *camera.distortion(),
    )
}

/// Whether a rig's cameras have images of the size that is given, and what to do otherwise.
#[must_use]
pub fn check_size(rig: &StereoRig, sizes_px: [(u32, u32); 2]) -> Vec<Finding> {
    let cameras = [("left", &rig.left), ("right", &rig.right)];
    let of = |((side, camera), (width, height)): ((&str, &Camera), (u32, u32))| {
        if (camera.width, camera.height) == (width, height) {
            return None;
        }
        let scale = f64::from(width) / f64::from(camera.width);
        let mend = if (f64::from(height) / f64::from(camera.height) - scale).abs() < 0.01 {
            format!(
                "multiply its focal lengths and principal point by {scale:.4}, or calibrate with such images"
            )
        } else {
            "they are cut out of, or come from, another image: calibrate with such images"
                .to_owned()
        };
        let message = format!(
            "its images have {width}×{height} px, but the rig says {}×{}: {mend}",
            camera.width, camera.height
        );
        Some(finding(Severity::Error, &format!("{side}.width"), message))
    };
    cameras.into_iter().zip(sizes_px).filter_map(of).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::parse_rig;
    use nalgebra::{Point3, Vector3};
    use rand::{RngExt, SeedableRng};
    use rand_xoshiro::Xoshiro256PlusPlus;

    fn rig() -> StereoRig {
        parse_rig(
            "left = { width = 640, height = 480, focal = [505.8, 504.1], principal_point = [313.2, 243.5], distortion = { model = \"radtan\", coefficients = [-0.28, 0.08, 0.001, -0.0007] } }
             right = { width = 640, height = 480, focal = [499.9, 498.2], principal_point = [336.2, 226.4], distortion = { model = \"radtan\", coefficients = [-0.30, 0.10, -0.0005, 0.0004] } }
             right_from_left = { translation_m = [-0.21, -0.012, 0.021], rotation_vector_rad = [0.05, 0.03, -0.04] }",
        )
        .expect("valid")
    }

    /// Points before a rig, a quarter of them matched to something else.
    fn matches(rig: &StereoRig) -> Vec<Match> {
        let mut random = Xoshiro256PlusPlus::seed_from_u64(11);
        let mut matches: Vec<Match> = Vec::new();
        while matches.len() < 300 {
            let z = random.random_range(2.0..30.0);
            let point = Point3::new(
                random.random_range(-0.6..0.6) * z,
                random.random_range(-0.45..0.45) * z,
                z,
            );
            let Some(px) = rig.project(&point) else {
                continue;
            };
            let mut noisy = |at: f64| at + random.random_range(-0.4..0.4);
            let (left, right) = (
                Vector2::new(noisy(px[0]), noisy(px[1])),
                Vector2::new(noisy(px[2]), noisy(px[3])),
            );
            if !(rig.left.contains(&left, 0.0) && rig.right.contains(&right, 0.0)) {
                continue;
            }
            let is_wrong = matches.len() % 4 == 3;
            let elsewhere = Vector2::new(
                random.random_range(0.0..640.0),
                random.random_range(0.0..480.0),
            );
            matches.push((left, if is_wrong { elsewhere } else { right }));
        }
        matches
    }

    #[test]
    fn images_of_the_rig_raise_no_alarm() {
        for rig in [rig(), crate::simulation::small_rig()] {
            let (fit, findings) = check(&rig, &matches(&rig));
            assert_eq!(findings, []);
            assert!(fit.share > 0.7 && fit.median_px < 0.4, "{fit:?}");
        }
    }

    #[test]
    fn each_mistake_is_found_with_its_mend() {
        let truth = rig();
        let seen = matches(&truth);
        let extrinsics = |right_from_left| StereoRig {
            right_from_left,
            ..rig()
        };
        let (t, turn) = (
            truth.right_from_left.translation.vector,
            truth.right_from_left.rotation,
        );
        let of = |t: Vector3<f64>, turn| Isometry3::from_parts(Translation3::from(t), turn);
        let half = StereoRig {
            left: resized(&truth.left, 0.5),
            right: resized(&truth.right, 0.5),
            ..rig()
        };
        let tables = StereoRig {
            left: truth.right.clone(),
            right: truth.left.clone(),
            ..rig()
        };
        let wrong = [
            (
                extrinsics(truth.right_from_left.inverse()),
                "left_from_right: invert",
            ),
            (extrinsics(of(-t, turn)), "negate it"),
            (
                extrinsics(of(t, turn.inverse())),
                "negate the rotation vector",
            ),
            (
                extrinsics(of(t, so3::exp(&(so3::log(&turn) * 1_f64.to_degrees())))),
                "in degrees",
            ),
            (half, "by 2.000"),
            (tables, "tables left and right are exchanged"),
        ];
        for (rig, mend) in wrong {
            let (_, findings) = check(&rig, &seen);
            assert_eq!(findings.len(), 1, "{mend}: {findings:?}");
            assert_eq!(findings[0].severity, Severity::Error);
            assert!(findings[0].message.contains(mend), "{mend}: {findings:?}");
        }
    }

    #[test]
    fn rectified_undistorted_and_exchanged_images_are_found() {
        let truth = rig();
        let plain = StereoRig {
            left: with_lens(&truth.left, Distortion::None),
            right: with_lens(&truth.right, Distortion::None),
            ..rig()
        };
        let exchanged: Vec<Match> = matches(&truth).iter().map(|(l, r)| (*r, *l)).collect();
        for (seen, mend) in [
            (matches(&rectified(&truth)), "rectified images"),
            (matches(&plain), "undistorted already"),
            (exchanged, "swap the cameras"),
        ] {
            let (_, findings) = check(&truth, &seen);
            assert_eq!(findings.len(), 1, "{mend}: {findings:?}");
            assert!(findings[0].message.contains(mend), "{mend}: {findings:?}");
        }
    }

    #[test]
    fn a_shifted_rig_and_foreign_images_are_doubted() {
        let truth = rig();
        let mut shifted = truth.clone();
        shifted.right_from_left.rotation =
            so3::exp(&(Vector3::x() * 0.0018)) * shifted.right_from_left.rotation;
        let (_, findings) = check(&shifted, &matches(&truth));
        assert!(
            findings[0].message.contains("may have shifted"),
            "{findings:?}"
        );
        let mut foreign = truth.clone();
        foreign.right_from_left.rotation =
            so3::exp(&Vector3::new(0.1, -0.02, 0.05)) * foreign.right_from_left.rotation;
        let (_, findings) = check(&foreign, &matches(&truth));
        assert!(
            findings[0].message.contains("no single mistake"),
            "{findings:?}"
        );
        let (_, findings) = check(&truth, &matches(&truth)[..20]);
        assert!(findings[0].message.contains("too few"), "{findings:?}");
    }

    #[test]
    fn images_of_another_size_say_by_how_much() {
        assert_eq!(check_size(&rig(), [(640, 480); 2]), []);
        let found = check_size(&rig(), [(1280, 960), (640, 480)]);
        assert_eq!(found.len(), 1);
        assert!(found[0].message.contains("by 2.0000"), "{found:?}");
    }
}
