//! `rig.toml`: a rig as a file, read with every value checked, and written.

#[cfg(feature = "mcap")]
use super::rig_parameters::parse_rig_covariance;
use super::rig_parameters::{RigCovariance, read_rig_covariance, rig_covariance_to_csv};
use super::{Camera, Distortion, RigUncertainty, StereoRig, so3};
use crate::toml_file::{TomlError, TomlText};
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector2, Vector3};
use serde::{Deserialize, Serialize};
use std::path::{Component, Path, PathBuf};

/// Why a rig file cannot be used.
pub type RigFileError = TomlError;

#[derive(Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
struct RigFile {
    left: CameraTable,
    right: CameraTable,
    right_from_left: ExtrinsicsTable,
    #[serde(skip_serializing_if = "Option::is_none")]
    mounting: Option<MountingTable>,
    #[serde(skip_serializing_if = "Option::is_none")]
    uncertainty: Option<UncertaintyTable>,
}

#[derive(Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
struct CameraTable {
    width: u32,
    height: u32,
    focal: [f64; 2],
    principal_point: [f64; 2],
    #[serde(default)]
    distortion: DistortionTable,
}

#[derive(Deserialize, Serialize, Default)]
#[serde(deny_unknown_fields)]
struct DistortionTable {
    model: DistortionModel,
    #[serde(default)]
    coefficients: Vec<f64>,
}

#[derive(Deserialize, Serialize, Default, Clone, Copy, PartialEq)]
#[serde(rename_all = "lowercase")]
enum DistortionModel {
    #[default]
    None,
    Radtan,
    Equidistant,
}

#[derive(Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
struct ExtrinsicsTable {
    translation_m: [f64; 3],
    rotation_vector_rad: [f64; 3],
}

#[derive(Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
struct MountingTable {
    translation_m: [f64; 3],
    rotation_rpy_rad: [f64; 3],
}

#[derive(Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
struct UncertaintyTable {
    #[serde(skip_serializing_if = "Option::is_none")]
    focal_px: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    principal_point_px: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    rotation_rad: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    translation_m: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    covariance: Option<PathBuf>,
}

/// The name of the covariance's file beside a rig that visod writes into a folder of its own.
pub(crate) const COVARIANCE_FILE: &str = "rig.cov.csv";
/// Longest image side that a rig may have, px.
const MAX_SIDE_PX: u32 = 16_384;

/// Reads a rig file.
///
/// # Errors
/// The file cannot be read, is not TOML, has an unknown or missing key, or a value that no rig can
/// have; with the line and the key where there is one.
pub fn load_rig(path: &Path) -> Result<StereoRig, RigFileError> {
    let folder = path.parent().unwrap_or(Path::new(""));
    checked(&TomlText::read(path)?, &|rig, file| {
        read_rig_covariance(rig, &folder.join(file))
    })
}

/// Reads a rig from a text, beside which there is no file: its covariance cannot be one.
///
/// # Errors
/// As [`load_rig`].
pub fn parse_rig(text: &str) -> Result<StereoRig, RigFileError> {
    checked(&TomlText::new("rig", text), &|_, file| {
        Err(format!(
            "{}: is not at hand, as this rig comes from no file",
            file.display()
        ))
    })
}

/// Reads a rig from a text, and the covariance whose file it names from another.
///
/// # Errors
/// As [`load_rig`].
#[cfg(feature = "mcap")]
pub(crate) fn parse_rig_with_covariance(
    text: &str,
    covariance: &str,
) -> Result<StereoRig, RigFileError> {
    checked(&TomlText::new("rig", text), &|rig, _| {
        parse_rig_covariance(rig, covariance)
    })
}

/// Writes a rig into a folder of its own: `rig.toml`, and beside it the covariance, where one is known.
///
/// # Errors
/// The file that cannot be written, and what the system said.
pub(crate) fn save_rig(folder: &Path, rig: &StereoRig) -> Result<(), (PathBuf, std::io::Error)> {
    let write = |name: &str, text: String| {
        let file = folder.join(name);
        std::fs::write(&file, text).map_err(|cause| (file, cause))
    };
    let (rig, covariance) = with_covariance_beside(rig);
    if let Some(csv) = covariance {
        write(COVARIANCE_FILE, csv)?;
    }
    write("rig.toml", rig_to_toml(&rig))
}

/// The rig as it is to be written with its covariance beside it in [`COVARIANCE_FILE`], and what that holds.
pub(crate) fn with_covariance_beside(rig: &StereoRig) -> (StereoRig, Option<String>) {
    let mut rig = rig.clone();
    let csv = match &mut rig.uncertainty {
        Some(RigUncertainty::Covariance { file, covariance }) => {
            *file = COVARIANCE_FILE.into();
            Some(covariance.clone())
        }
        _ => None,
    };
    let csv = csv.map(|covariance| rig_covariance_to_csv(&rig, &covariance));
    (rig, csv)
}

/// Gives the covariance of a rig from the file that the rig names.
type CovarianceOf<'a> = &'a dyn Fn(&StereoRig, &Path) -> Result<RigCovariance, String>;

fn checked(text: &TomlText, covariance_of: CovarianceOf) -> Result<StereoRig, RigFileError> {
    let file: RigFile = text.parse()?;
    let finite = |key: &str, values: &[f64]| match values.iter().find(|v| !v.is_finite()) {
        Some(bad) => Err(text.wrong(key, format!("must be finite, but holds {bad}"))),
        None => Ok(()),
    };

    let extrinsics = &file.right_from_left;
    finite("right_from_left.translation_m", &extrinsics.translation_m)?;
    finite(
        "right_from_left.rotation_vector_rad",
        &extrinsics.rotation_vector_rad,
    )?;
    let translation = Vector3::from(extrinsics.translation_m);
    if translation.norm() < 1e-6 {
        return Err(text.wrong(
            "right_from_left.translation_m",
            "the cameras must stand apart, but the baseline is zero",
        ));
    }

    let base_from_camera = match &file.mounting {
        None => None,
        Some(mounting) => {
            finite("mounting.translation_m", &mounting.translation_m)?;
            finite("mounting.rotation_rpy_rad", &mounting.rotation_rpy_rad)?;
            let [roll, pitch, yaw] = mounting.rotation_rpy_rad;
            Some(Isometry3::from_parts(
                Translation3::from(Vector3::from(mounting.translation_m)),
                UnitQuaternion::from_euler_angles(roll, pitch, yaw),
            ))
        }
    };

    let mut rig = StereoRig {
        left: camera(text, "left", &file.left)?,
        right: camera(text, "right", &file.right)?,
        right_from_left: Isometry3::from_parts(
            Translation3::from(translation),
            so3::exp(&Vector3::from(extrinsics.rotation_vector_rad)),
        ),
        base_from_camera,
        uncertainty: None,
    };
    if let Some(table) = &file.uncertainty {
        rig.uncertainty = Some(uncertainty(text, &rig, table, covariance_of)?);
    }
    Ok(rig)
}

/// The stated standard deviations, or the covariance from its file.
fn uncertainty(
    text: &TomlText,
    rig: &StereoRig,
    table: &UncertaintyTable,
    covariance_of: CovarianceOf,
) -> Result<RigUncertainty, RigFileError> {
    let sigmas = [
        ("focal_px", table.focal_px),
        ("principal_point_px", table.principal_point_px),
        ("rotation_rad", table.rotation_rad),
        ("translation_m", table.translation_m),
    ];
    let key = |name: &str| format!("uncertainty.{name}");
    if let Some(file) = &table.covariance {
        if let Some((name, _)) = sigmas.iter().find(|(_, sigma)| sigma.is_some()) {
            return Err(text.wrong(
                &key(name),
                "stands beside `covariance`, which holds all parameters: only one of the two may",
            ));
        }
        // Rigs come along with others' recordings, and must not name what else this machine holds.
        let is_inside = file
            .components()
            .all(|c| matches!(c, Component::Normal(_) | Component::CurDir));
        if !is_inside {
            return Err(text.wrong(
                &key("covariance"),
                "must be a file in the folder of the rig file or below, without \"..\"",
            ));
        }
        let covariance =
            covariance_of(rig, file).map_err(|cause| text.wrong(&key("covariance"), cause))?;
        return Ok(RigUncertainty::Covariance {
            file: file.clone(),
            covariance: Box::new(covariance),
        });
    }
    let mut values = [0.0; 4];
    for ((name, sigma), value) in sigmas.into_iter().zip(&mut values) {
        *value = match sigma {
            Some(sigma) if sigma.is_finite() && sigma >= 0.0 => sigma,
            Some(sigma) => {
                return Err(text.wrong(
                    &key(name),
                    format!("a standard deviation must be finite and not negative, but is {sigma}"),
                ));
            }
            None => return Err(text.wrong("uncertainty", format!("missing field `{name}`"))),
        };
    }
    let [focal_px, principal_point_px, rotation_rad, translation_m] = values;
    Ok(RigUncertainty::Sigmas {
        focal_px,
        principal_point_px,
        rotation_rad,
        translation_m,
    })
}

fn camera(text: &TomlText, side: &str, table: &CameraTable) -> Result<Camera, RigFileError> {
    let key = |name: &str| format!("{side}.{name}");
    for (name, value) in [("width", table.width), ("height", table.height)] {
        if !(1..=MAX_SIDE_PX).contains(&value) {
            return Err(text.wrong(
                &key(name),
                format!("must be from 1 to {MAX_SIDE_PX} px, but is {value}"),
            ));
        }
    }
    if let Some(bad) = table.focal.iter().find(|f| !(f.is_finite() && **f > 0.0)) {
        return Err(text.wrong(
            &key("focal"),
            format!("must be finite and above 0 px, but holds {bad}"),
        ));
    }
    if let Some(bad) = table.principal_point.iter().find(|c| !c.is_finite()) {
        return Err(text.wrong(
            &key("principal_point"),
            format!("must be finite, but holds {bad}"),
        ));
    }
    let coefficients = &table.distortion.coefficients;
    if let Some(bad) = coefficients.iter().find(|c| !c.is_finite()) {
        return Err(text.wrong(
            &key("distortion"),
            format!("coefficients must be finite, but hold {bad}"),
        ));
    }
    let count = coefficients.len();
    let distortion = match table.distortion.model {
        DistortionModel::None if count == 0 => Distortion::None,
        DistortionModel::Radtan if matches!(count, 4 | 5 | 8) => {
            let mut k = [0.0; 8];
            k[..count].copy_from_slice(coefficients);
            Distortion::Radtan(k)
        }
        DistortionModel::Equidistant if count == 4 => Distortion::Equidistant([
            coefficients[0],
            coefficients[1],
            coefficients[2],
            coefficients[3],
        ]),
        model => {
            let wants = match model {
                DistortionModel::None => "model \"none\" takes no coefficients",
                DistortionModel::Radtan => "model \"radtan\" takes 4, 5 or 8 coefficients",
                DistortionModel::Equidistant => "model \"equidistant\" takes 4 coefficients",
            };
            return Err(text.wrong(&key("distortion"), format!("{wants}, but has {count}")));
        }
    };
    Ok(Camera::new(
        table.width,
        table.height,
        Vector2::from(table.focal),
        Vector2::from(table.principal_point),
        distortion,
    ))
}

/// A rig as the text of a rig file; [`parse_rig`] reads it back to the last bit but for the
/// rotations, which differ by rounding.
#[must_use]
pub fn rig_to_toml(rig: &StereoRig) -> String {
    let file = RigFile {
        left: camera_table(&rig.left),
        right: camera_table(&rig.right),
        right_from_left: ExtrinsicsTable {
            translation_m: rig.right_from_left.translation.vector.into(),
            rotation_vector_rad: so3::log(&rig.right_from_left.rotation).into(),
        },
        mounting: rig.base_from_camera.as_ref().map(|base_from_camera| {
            let (roll, pitch, yaw) = base_from_camera.rotation.euler_angles();
            MountingTable {
                translation_m: base_from_camera.translation.vector.into(),
                rotation_rpy_rad: [roll, pitch, yaw],
            }
        }),
        uncertainty: rig.uncertainty.as_ref().map(uncertainty_table),
    };
    // A tree of numbers and short strings always has a TOML form.
    toml::to_string(&file).unwrap_or_default()
}

fn uncertainty_table(uncertainty: &RigUncertainty) -> UncertaintyTable {
    match uncertainty {
        RigUncertainty::Sigmas {
            focal_px,
            principal_point_px,
            rotation_rad,
            translation_m,
        } => UncertaintyTable {
            focal_px: Some(*focal_px),
            principal_point_px: Some(*principal_point_px),
            rotation_rad: Some(*rotation_rad),
            translation_m: Some(*translation_m),
            covariance: None,
        },
        RigUncertainty::Covariance { file, .. } => UncertaintyTable {
            focal_px: None,
            principal_point_px: None,
            rotation_rad: None,
            translation_m: None,
            covariance: Some(file.clone()),
        },
    }
}

fn camera_table(camera: &Camera) -> CameraTable {
    let (model, coefficients) = match camera.distortion() {
        Distortion::None => (DistortionModel::None, vec![]),
        Distortion::Radtan(k) if k[5..].iter().all(|&c| c == 0.0) => {
            (DistortionModel::Radtan, k[..5].to_vec())
        }
        Distortion::Radtan(k) => (DistortionModel::Radtan, k.to_vec()),
        Distortion::Equidistant(k) => (DistortionModel::Equidistant, k.to_vec()),
    };
    CameraTable {
        width: camera.width,
        height: camera.height,
        focal: camera.focal_px.into(),
        principal_point: camera.principal_point_px.into(),
        distortion: DistortionTable {
            model,
            coefficients,
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const GOOD: &str = r#"
[left]
width = 640
height = 480
focal = [885.8, 884.1]
principal_point = [313.2, 243.5]

[right]
width = 640
height = 480
focal = [882.9, 881.2]
principal_point = [300.2, 246.4]
distortion = { model = "radtan", coefficients = [-0.2, 0.1, 0.0, 0.0] }

[right_from_left]
translation_m = [-0.3857, -0.0072, 0.0001]
rotation_vector_rad = [0.04046, 0.01616, 0.01419]

[mounting]
translation_m = [0.4, 0.19, 0.8]
rotation_rpy_rad = [-1.5707963, 0.0, -1.5707963]

[uncertainty]
focal_px = 0.5
principal_point_px = 0.5
rotation_rad = 1e-4
translation_m = 2e-4
"#;

    fn error_of(from: &str, to: &str) -> String {
        assert!(GOOD.contains(from), "the test's own replacement must apply");
        parse_rig(&GOOD.replacen(from, to, 1))
            .expect_err("must be refused")
            .to_string()
    }

    #[test]
    fn a_written_rig_reads_back_the_same() {
        let rig = parse_rig(GOOD).expect("valid");
        let again = parse_rig(&rig_to_toml(&rig)).expect("what is written is valid");
        assert_eq!(rig.left, again.left);
        assert_eq!(rig.right, again.right);
        assert_eq!(rig.uncertainty, again.uncertainty);
        let apart = |a: &Isometry3<f64>, b: &Isometry3<f64>| (a.to_matrix() - b.to_matrix()).norm();
        assert!(apart(&rig.right_from_left, &again.right_from_left) < 1e-15);
        let mounting = |rig: &StereoRig| rig.base_from_camera.expect("stated");
        assert!(apart(&mounting(&rig), &mounting(&again)) < 1e-15);
    }

    #[test]
    fn the_mounting_turns_optical_axes_into_the_robots() {
        let rig = parse_rig(GOOD).expect("valid");
        let base_from_camera = rig.base_from_camera.expect("stated");
        let forward = base_from_camera.rotation * Vector3::z();
        let left = base_from_camera.rotation * -Vector3::x();
        assert!((forward - Vector3::x()).norm() < 1e-7);
        assert!((left - Vector3::y()).norm() < 1e-7);
    }

    #[test]
    fn the_covariance_of_a_calibration_comes_from_its_file_beside_the_rig() {
        let folder = tempfile::tempdir().expect("a folder");
        let (head, _) = GOOD.split_once("[uncertainty]").expect("stated");
        let rig_file = folder.path().join("rig.toml");
        let text = format!("{head}[uncertainty]\ncovariance = \"rig.cov.csv\"\n");
        std::fs::write(&rig_file, &text).expect("written");
        let missing = load_rig(&rig_file).expect_err("no such file").to_string();
        assert!(
            missing.contains(": uncertainty.covariance: ")
                && missing.contains("rig.cov.csv: cannot be read"),
            "{missing}"
        );
        std::fs::write(
            folder.path().join("rig.cov.csv"),
            "tx,ry\n4e-8,1e-8\n1e-8,1e-8\n",
        )
        .expect("written");
        let rig = load_rig(&rig_file).expect("valid");
        let covariance = rig.covariance().expect("stated");
        assert_eq!(covariance[(24, 24)], 4e-8);
        assert_eq!((covariance[(24, 28)], covariance[(28, 28)]), (1e-8, 1e-8));
        assert_eq!(covariance.trace(), 5e-8);
        assert!(rig_to_toml(&rig).contains("covariance = \"rig.cov.csv\""));
        let both =
            parse_rig(&text.replace("covariance", "focal_px = 1.0\ncovariance")).expect_err("two");
        assert!(
            both.to_string().contains("only one of the two may"),
            "{both}"
        );
    }

    #[test]
    fn a_rig_names_no_file_outside_its_folder() {
        let folder = tempfile::tempdir().expect("a folder");
        let (head, _) = GOOD.split_once("[uncertainty]").expect("stated");
        std::fs::write(folder.path().join("out.csv"), "tx\n4e-8\n").expect("written");
        std::fs::create_dir(folder.path().join("rig")).expect("made");
        let rig_file = folder.path().join("rig/rig.toml");
        let outside = folder.path().join("out.csv");
        for name in [
            "../out.csv",
            "rig/../../out.csv",
            "",
            outside.to_str().expect("text"),
        ] {
            let text = format!("{head}[uncertainty]\ncovariance = \"{name}\"\n");
            std::fs::write(&rig_file, text).expect("written");
            let why = load_rig(&rig_file).expect_err("outside").to_string();
            let expected = if name.is_empty() {
                "cannot be read"
            } else {
                "must be a file in the folder"
            };
            assert!(why.contains(expected), "{name}: {why}");
        }
    }

    #[test]
    fn a_rig_goes_into_a_folder_with_its_covariance() {
        let folder = tempfile::tempdir().expect("a folder");
        let mut rig = parse_rig(GOOD).expect("valid");
        let mut covariance = RigCovariance::zeros();
        covariance[(24, 24)] = 4e-8;
        rig.uncertainty = Some(RigUncertainty::Covariance {
            file: "/somewhere/else.csv".into(),
            covariance: Box::new(covariance),
        });
        save_rig(folder.path(), &rig).expect("written");
        let again = load_rig(&folder.path().join("rig.toml")).expect("valid");
        assert_eq!(again.covariance(), Some(covariance));
        let alone = parse_rig(&rig_to_toml(&again))
            .expect_err("no file")
            .to_string();
        assert!(alone.contains("rig.cov.csv: is not at hand"), "{alone}");
    }

    #[test]
    fn mistakes_are_named_with_line_and_key() {
        assert_eq!(
            error_of("focal = [885.8,", "focal = [nan,"),
            "rig:5: left.focal: must be finite and above 0 px, but holds NaN"
        );
        assert_eq!(
            error_of("[-0.3857,", "[inf,"),
            "rig:16: right_from_left.translation_m: must be finite, but holds inf"
        );
        let unknown = error_of("[mounting]", "[mountain]");
        assert!(
            unknown.starts_with("rig:19: mountain: unknown field"),
            "{unknown}"
        );
        let wrong_type = error_of("width = 640", "width = \"wide\"");
        assert!(
            wrong_type.starts_with("rig:3: left.width: invalid type"),
            "{wrong_type}"
        );
        let syntax = error_of("height = 480", "height 480");
        assert!(syntax.starts_with("rig:4"), "{syntax}");
        assert!(!syntax.contains('\n'), "{syntax}");
        let count = error_of("[-0.2, 0.1, 0.0, 0.0]", "[-0.2, 0.1]");
        assert!(
            count.ends_with("takes 4, 5 or 8 coefficients, but has 2"),
            "{count}"
        );
        let missing = error_of("translation_m = [-0.3857, -0.0072, 0.0001]\n", "");
        assert!(
            missing.contains("missing field `translation_m`"),
            "{missing}"
        );
    }
}
