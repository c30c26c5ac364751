//! A trajectory file in KITTI, TUM or EuRoC form in, poses out.

use super::file_error::{FileError, read_text};
use crate::capture::MAX_STAMP_NS;
use crate::text_file::shown;
use nalgebra::{Isometry3, Matrix3, Quaternion, Translation3, UnitQuaternion, Vector3};
use std::path::Path;

/// How far RᵀR may be from the identity, or a quaternion's length from 1: files carry six digits
/// or so; more is a matrix of something else.
const ROTATION_TOLERANCE: f64 = 1e-3;

/// How a trajectory file is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Form {
    /// Twelve numbers a line: the upper 3×4 of the pose's matrix, row by row. No time.
    Kitti,
    /// `t tx ty tz qx qy qz qw`, t in seconds.
    Tum,
    /// EuRoC's `data.csv`: `t, px, py, pz, qw, qx, qy, qz, …`, t in nanoseconds.
    Euroc,
}

impl std::fmt::Display for Form {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Kitti => "KITTI",
            Self::Tum => "TUM",
            Self::Euroc => "EuRoC",
        })
    }
}

/// Poses over time.
#[derive(Clone, Debug, PartialEq)]
pub struct Trajectory {
    /// How the file was written.
    pub form: Form,
    /// When each pose was, ns, rising; `None` where the form has no times.
    pub stamps_ns: Option<Vec<i64>>,
    /// Poses: each maps a point of the moving body into the trajectory's own frame, m.
    pub world_from_body: Vec<Isometry3<f64>>,
}

impl Trajectory {
    /// Poses without times: pose i belongs to the stereo pair i.
    #[must_use]
    pub fn by_number(world_from_body: Vec<Isometry3<f64>>) -> Self {
        Self {
            form: Form::Kitti,
            stamps_ns: None,
            world_from_body,
        }
    }

    /// The trajectory of a camera that is fixed to the body.
    #[must_use]
    pub fn of_camera(mut self, body_from_camera: &Isometry3<f64>) -> Self {
        for pose in &mut self.world_from_body {
            *pose *= body_from_camera;
        }
        self
    }
}

/// Reads a trajectory; which form it has is seen from its first line of numbers.
///
/// # Errors
/// The file cannot be read, holds no pose, or has a line that cannot be one.
pub fn read_trajectory(path: &Path) -> Result<Trajectory, FileError> {
    parse_trajectory(path, &read_text(path)?)
}

/// As [`read_trajectory`], from the text itself; `name` is for messages.
///
/// # Errors
/// As [`read_trajectory`].
pub fn parse_trajectory(name: &Path, text: &str) -> Result<Trajectory, FileError> {
    let mut lines = numbered_lines(text).peekable();
    let &(first_line, first) = lines
        .peek()
        .ok_or_else(|| FileError::new(name, None, "holds no pose"))?;
    let form = recognise(first).map_err(|cause| FileError::new(name, Some(first_line), cause))?;
    let mut stamps_ns = Vec::new();
    let mut world_from_body = Vec::new();
    for (line, text) in lines {
        let fail = |cause| FileError::new(name, Some(line), cause);
        let (stamp_ns, pose) = parse_line(form, text).map_err(fail)?;
        if let Some(stamp_ns) = stamp_ns {
            if stamps_ns.last().is_some_and(|&before| before >= stamp_ns) {
                return Err(fail("its time is not after that of the line before".into()));
            }
            stamps_ns.push(stamp_ns);
        }
        world_from_body.push(pose);
    }
    Ok(Trajectory {
        form,
        stamps_ns: (form != Form::Kitti).then_some(stamps_ns),
        world_from_body,
    })
}

/// The lines that hold something, with their number from 1.
fn numbered_lines(text: &str) -> impl Iterator<Item = (usize, &str)> {
    let text = text.strip_prefix('\u{feff}').unwrap_or(text);
    (1..)
        .zip(text.lines())
        .map(|(number, line)| (number, line.trim()))
        .filter(|(_, line)| !line.is_empty() && !line.starts_with('#'))
}

fn recognise(line: &str) -> Result<Form, String> {
    if line.contains(',') {
        let columns = fields(line).count();
        return if columns >= 8 {
            Ok(Form::Euroc)
        } else {
            Err(format!(
                "has {columns} comma-separated columns; EuRoC's form has at least 8"
            ))
        };
    }
    match fields(line).count() {
        12 => Ok(Form::Kitti),
        8 => Ok(Form::Tum),
        columns => Err(format!(
            "has {columns} columns; a pose has 12 in KITTI's form, 8 in TUM's, and EuRoC's is separated by commas"
        )),
    }
}

fn parse_line(form: Form, line: &str) -> Result<(Option<i64>, Isometry3<f64>), String> {
    match form {
        Form::Kitti => {
            let m: [f64; 12] = numbers(line, 0, true)?;
            Ok((None, pose_of_matrix(&m)?))
        }
        Form::Tum => {
            let [x, y, z, qx, qy, qz, qw] = numbers(line, 1, true)?;
            let stamp_ns = seconds_as_ns(first_field(line))?;
            let pose = pose_of_quaternion([x, y, z], Quaternion::new(qw, qx, qy, qz))?;
            Ok((Some(stamp_ns), pose))
        }
        Form::Euroc => {
            let [x, y, z, qw, qx, qy, qz] = numbers(line, 1, false)?;
            let first = first_field(line);
            let stamp_ns = first.parse().ok().filter(is_stamp).ok_or_else(|| {
                format!(
                    "column 1 must be a time in whole ns, but is '{}'",
                    shown(first)
                )
            })?;
            let pose = pose_of_quaternion([x, y, z], Quaternion::new(qw, qx, qy, qz))?;
            Ok((Some(stamp_ns), pose))
        }
    }
}

fn fields(line: &str) -> impl Iterator<Item = &str> {
    let commas = line.contains(',');
    line.split(move |c: char| if commas { c == ',' } else { c.is_whitespace() })
        .map(str::trim)
        .filter(move |field| commas || !field.is_empty())
}

fn first_field(line: &str) -> &str {
    fields(line).next().unwrap_or("")
}

/// `N` finite numbers after `skip` columns; with `all`, the line must end there.
fn numbers<const N: usize>(line: &str, skip: usize, all: bool) -> Result<[f64; N], String> {
    let columns = fields(line).count();
    let wanted = skip + N;
    if columns < wanted || (all && columns > wanted) {
        return Err(format!("has {columns} columns, but must have {wanted}"));
    }
    let mut values = [0.0; N];
    for (i, (value, field)) in values.iter_mut().zip(fields(line).skip(skip)).enumerate() {
        let column = skip + i + 1;
        let number: f64 = field.parse().map_err(|_| {
            format!(
                "column {column} must be a number, but is '{}'",
                shown(field)
            )
        })?;
        if !number.is_finite() {
            return Err(format!(
                "column {column} must be finite, but is {}",
                shown(field)
            ));
        }
        *value = number;
    }
    Ok(values)
}

/// Seconds in decimal notation, exactly: an f64 of today's seconds has lost the nanoseconds.
fn seconds_as_ns(text: &str) -> Result<i64, String> {
    let fail = || {
        format!(
            "column 1 must be a time in seconds, but is '{}'",
            shown(text)
        )
    };
    let (whole, fraction) = text.split_once('.').unwrap_or((text, ""));
    let digits = |s: &str| s.bytes().all(|b| b.is_ascii_digit());
    if digits(fraction) && !whole.is_empty() && digits(whole) {
        let whole: i64 = whole.parse().map_err(|_| fail())?;
        let nine: String = fraction
            .chars()
            .chain("000000000".chars())
            .take(9)
            .collect();
        let ns: i64 = nine.parse().map_err(|_| fail())?;
        return whole
            .checked_mul(1_000_000_000)
            .and_then(|s| s.checked_add(ns))
            .filter(is_stamp)
            .ok_or_else(fail);
    }
    let seconds: f64 = text.parse().map_err(|_| fail())?;
    // What is too large for an integer becomes the largest, and not a number zero.
    let ns = (seconds * 1e9).round() as i64;
    Some(ns)
        .filter(|ns| seconds.is_finite() && is_stamp(ns))
        .ok_or_else(fail)
}

fn is_stamp(ns: &i64) -> bool {
    ns.unsigned_abs() < MAX_STAMP_NS.unsigned_abs()
}

pub(super) fn pose_of_matrix(m: &[f64; 12]) -> Result<Isometry3<f64>, String> {
    let rotation = Matrix3::new(m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]);
    Ok(Isometry3::from_parts(
        Translation3::new(m[3], m[7], m[11]),
        nearest_rotation(&rotation)?,
    ))
}

/// The rotation nearest to a matrix that is one up to the digits of a file.
fn nearest_rotation(m: &Matrix3<f64>) -> Result<UnitQuaternion<f64>, String> {
    let gap = (m.transpose() * m - Matrix3::identity()).amax();
    if gap > ROTATION_TOLERANCE || m.determinant() < 0.0 {
        return Err(format!(
            "its matrix is not a rotation: determinant {:.6}, RᵀR off the identity by {gap:.2e}",
            m.determinant()
        ));
    }
    let svd = m.svd(true, true);
    let (Some(u), Some(v_t)) = (svd.u, svd.v_t) else {
        return Err("its matrix is not a rotation".into());
    };
    let rotation = nalgebra::Rotation3::from_matrix_unchecked(u * v_t);
    Ok(UnitQuaternion::from_rotation_matrix(&rotation))
}

pub(super) fn pose_of_quaternion(
    position_m: [f64; 3],
    rotation: Quaternion<f64>,
) -> Result<Isometry3<f64>, String> {
    let norm = rotation.norm();
    if (norm - 1.0).abs() > ROTATION_TOLERANCE {
        return Err(format!(
            "its quaternion must have length 1, but has {norm:.6}"
        ));
    }
    Ok(Isometry3::from_parts(
        Translation3::from(Vector3::from(position_m)),
        UnitQuaternion::new_normalize(rotation),
    ))
}
