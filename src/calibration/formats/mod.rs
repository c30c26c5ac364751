//! Other tools' calibrations in, a rig out, and back.
//!
//! | format | files | states |
//! |---|---|---|
//! | visod | rig.toml | all |
//! | OpenCV | one YAML or two (`M1 D1 M2 D2`, `R T`) | no size |
//! | ROS | two `camera_info` YAML files | all |
//! | Kalibr | one camchain YAML | all |
//! | EuRoC | two `sensor.yaml` | all |
//! | KITTI | `calib.txt` (`P0`, `P1`) | rectified rigs alone, no size |
//! | MATLAB | the camera calibration toolbox' values as text | no size; lengths in mm |
//!
//! All of them put pixel centres at integers, as visod does. Numbers are written so that they read back to the last
//! bit; a rotation that a format states as a matrix comes back within rounding.

mod euroc;
mod kalibr;
mod kitti;
mod matlab;
mod numbers;
mod opencv;
mod ros;

use crate::capture::text::read_calibration;
use crate::geometry::{StereoRig, load_rig, rig_to_toml};
use std::path::{Path, PathBuf};

/// A format of calibration files.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// visod's own rig.toml.
    Visod,
    /// OpenCV's YAML.
    Opencv,
    /// A pair of ROS camera_info files.
    Ros,
    /// Kalibr's camchain.
    Kalibr,
    /// A pair of sensor.yaml, as EuRoC (ASL) has them.
    Euroc,
    /// KITTI odometry's calib.txt.
    Kitti,
    /// Values of the camera calibration toolbox for MATLAB.
    Matlab,
}

/// All formats.
pub const FORMATS: [Format; 7] = [
    Format::Visod,
    Format::Opencv,
    Format::Ros,
    Format::Kalibr,
    Format::Euroc,
    Format::Kitti,
    Format::Matlab,
];

impl Format {
    /// Its name on the command line.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Visod => "visod",
            Self::Opencv => "opencv",
            Self::Ros => "ros",
            Self::Kalibr => "kalibr",
            Self::Euroc => "euroc",
            Self::Kitti => "kitti",
            Self::Matlab => "matlab",
        }
    }

    /// How many metres its unit of length usually has.
    #[must_use]
    pub fn usual_unit_m(self) -> f64 {
        match self {
            Self::Matlab => 1e-3,
            _ => 1.0,
        }
    }

    /// Which format a file has, from its name and what it holds.
    fn of(file: &Path, text: &str) -> Option<Self> {
        let ending = file
            .extension()
            .and_then(|e| e.to_str())
            .unwrap_or_default();
        let has = |key: &str| text.lines().any(|line| line.trim_start().starts_with(key));
        Some(match ending {
            "toml" => Self::Visod,
            "m" => Self::Matlab,
            _ if has("P0:") && has("P1:") => Self::Kitti,
            _ if has("cam0:") => Self::Kalibr,
            _ if has("T_BS:") => Self::Euroc,
            _ if has("projection_matrix:") => Self::Ros,
            _ if text.contains("opencv-matrix") => Self::Opencv,
            _ if text.contains("fc_left") => Self::Matlab,
            _ => return None,
        })
    }
}

/// What files do not say by themselves.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Hints {
    /// The format; otherwise the files tell it.
    pub format: Option<Format>,
    /// The images' size, px, for formats that do not state it.
    pub size_px: Option<(u32, u32)>,
    /// How many metres the unit of length has; otherwise what is usual in the format.
    pub unit_m: Option<f64>,
}

/// Reads a rig from one file or two.
///
/// # Errors
/// One sentence with the file, and the line and key where there is one.
pub fn import(files: &[PathBuf], hints: &Hints) -> Result<StereoRig, String> {
    let first = files.first().ok_or("no file was named")?;
    let format = match hints.format {
        Some(format) => format,
        None => {
            let text = read(first)?;
            Format::of(first, &text).ok_or_else(|| {
                format!(
                    "{}: is in no format that is known; --from names one",
                    first.display()
                )
            })?
        }
    };
    let wanted = match format {
        Format::Ros | Format::Euroc => 2..=2,
        Format::Opencv => 1..=2,
        _ => 1..=1,
    };
    if !wanted.contains(&files.len()) {
        return Err(format!(
            "a calibration in the format {} is in {} file{}, but {} were named",
            format.as_str(),
            wanted.end(),
            if *wanted.end() == 1 {
                ""
            } else {
                "s, left and right"
            },
            files.len()
        ));
    }
    let size_px = || {
        let missing = format!(
            "{}: does not state the images' size; --size does",
            first.display()
        );
        hints.size_px.ok_or(missing)
    };
    let mut rig = match format {
        Format::Visod => load_rig(first).map_err(|e| e.to_string())?,
        Format::Opencv => opencv::import(files, hints.size_px)?,
        Format::Ros => ros::import(&files[0], &files[1])?,
        Format::Kalibr => kalibr::import(first)?,
        Format::Euroc => euroc::import(&files[0], &files[1])?,
        Format::Kitti => kitti::import(first, size_px()?)?,
        Format::Matlab => matlab::import(first, &read(first)?, hints.size_px)?,
    };
    let unit_m = hints.unit_m.unwrap_or_else(|| format.usual_unit_m());
    if unit_m != 1.0 {
        numbers::scale_lengths(&mut rig, unit_m);
    }
    if rig.baseline_m() < 1e-9 {
        return Err(format!(
            "{}: the cameras must stand apart, but the baseline is zero",
            first.display()
        ));
    }
    Ok(rig)
}

/// A file to be written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Exported {
    /// Its name within a folder; empty where the format has one file alone, which may have any.
    pub name: &'static str,
    /// What it holds.
    pub text: String,
}

/// A rig as files of a format, lengths in its usual unit.
///
/// # Errors
/// One sentence: the format cannot state such a rig.
pub fn export(rig: &StereoRig, format: Format) -> Result<Vec<Exported>, String> {
    let one = |text: String| vec![Exported { name: "", text }];
    Ok(match format {
        Format::Visod => one(rig_to_toml(rig)),
        Format::Opencv => one(opencv::export(rig)),
        Format::Ros => {
            let [left, right] = ros::export(rig)?;
            vec![
                Exported {
                    name: "left.yaml",
                    text: left,
                },
                Exported {
                    name: "right.yaml",
                    text: right,
                },
            ]
        }
        Format::Kalibr => one(kalibr::export(rig)),
        Format::Euroc => {
            let [left, right] = euroc::export(rig);
            vec![
                Exported {
                    name: "cam0/sensor.yaml",
                    text: left,
                },
                Exported {
                    name: "cam1/sensor.yaml",
                    text: right,
                },
            ]
        }
        Format::Kitti => one(kitti::export(rig)?),
        Format::Matlab => one(matlab::export(rig)?),
    })
}

fn read(file: &Path) -> Result<String, String> {
    read_calibration(file).map_err(|e| e.to_string())
}

#[cfg(test)]
mod tests;
