//! An odometry CSV in, its rows out. Columns are found by name; more may be there, in any order.

use super::file_error::{FileError, read_text};
use super::trajectory::pose_of_quaternion;
use crate::estimation::{Counts, Status};
use nalgebra::{Isometry3, Matrix6, Quaternion};
use std::path::Path;

/// One row of the odometry CSV.
#[derive(Clone, Debug, PartialEq)]
pub struct OdometryRow {
    /// The number of the pair in its recording.
    pub sequence: u64,
    /// When the left image was taken, ns.
    pub timestamp_ns: i64,
    /// How far this estimate can be trusted.
    pub status: Status,
    /// Pose: maps a point of the left camera into the odometry frame, m.
    pub odom_from_camera: Isometry3<f64>,
    /// Covariance of the pose.
    pub cov_pose: Matrix6<f64>,
    /// Motion since the pair before.
    pub prev_from_now: Isometry3<f64>,
    /// Covariance of the motion.
    pub cov_motion: Matrix6<f64>,
    /// What the estimate rests on.
    pub counts: Counts,
    /// A-posteriori variance factor; not a number where nothing was measured.
    pub variance_factor: f64,
    /// From the complete pair to the estimate, ms, where it was measured.
    pub latency_ms: Option<f64>,
    /// Rises whenever the odometry frame begins anew.
    pub epoch: u32,
}

/// Whether a text begins as an odometry CSV does.
pub(super) fn looks_like_odometry_csv(text: &str) -> bool {
    let header = text.lines().next().unwrap_or("");
    header.contains(',') && header.split(',').any(|name| name.trim() == "seq")
}

/// Reads an odometry CSV.
///
/// # Errors
/// The file cannot be read, lacks a column, has no row, or holds a value that cannot be.
pub fn read_odometry_csv(path: &Path) -> Result<Vec<OdometryRow>, FileError> {
    parse_odometry_csv(path, &read_text(path)?)
}

/// As [`read_odometry_csv`], from the text itself; `name` is for messages.
///
/// # Errors
/// As [`read_odometry_csv`].
pub fn parse_odometry_csv(name: &Path, text: &str) -> Result<Vec<OdometryRow>, FileError> {
    let mut lines = (1..).zip(text.lines());
    let header: Vec<&str> = match lines.next() {
        Some((_, line)) => line.split(',').map(str::trim).collect(),
        None => return Err(FileError::new(name, None, "is empty: it has no header")),
    };
    let mut rows: Vec<OdometryRow> = Vec::new();
    for (number, line) in lines.filter(|(_, line)| !line.trim().is_empty()) {
        let fields: Vec<&str> = line.split(',').map(str::trim).collect();
        let row = Record {
            header: &header,
            fields: &fields,
        }
        .row()
        .map_err(|cause| FileError::new(name, Some(number), cause))?;
        if rows
            .last()
            .is_some_and(|before| before.sequence >= row.sequence)
        {
            let cause = format!("seq {} does not rise", row.sequence);
            return Err(FileError::new(name, Some(number), cause));
        }
        rows.push(row);
    }
    if rows.is_empty() {
        return Err(FileError::new(name, None, "holds a header but no row"));
    }
    Ok(rows)
}

/// One line beside the header that names its fields.
struct Record<'a> {
    header: &'a [&'a str],
    fields: &'a [&'a str],
}

impl Record<'_> {
    fn row(&self) -> Result<OdometryRow, String> {
        if self.fields.len() != self.header.len() {
            return Err(format!(
                "has {} columns, but the header has {}",
                self.fields.len(),
                self.header.len()
            ));
        }
        let latency_ms: f64 = self.parse("latency_ms", "a number")?;
        Ok(OdometryRow {
            sequence: self.parse("seq", "a whole number")?,
            timestamp_ns: self.parse("timestamp_ns", "a whole number of ns")?,
            status: self.status()?,
            odom_from_camera: self.pose("")?,
            cov_pose: self.covariance('c')?,
            prev_from_now: self.pose("m")?,
            cov_motion: self.covariance('m')?,
            counts: Counts {
                keypoints_left: self.parse("keypoints_left", "a count")?,
                keypoints_right: self.parse("keypoints_right", "a count")?,
                stereo_matches: self.parse("stereo_matches", "a count")?,
                tracks: self.parse("tracks", "a count")?,
                inliers: self.parse("inliers", "a count")?,
            },
            variance_factor: self.parse("variance_factor", "a number")?,
            latency_ms: latency_ms.is_finite().then_some(latency_ms),
            epoch: match self.header.contains(&"epoch") {
                true => self.parse("epoch", "a whole number")?,
                false => 0,
            },
        })
    }

    fn text(&self, name: &str) -> Result<&str, String> {
        self.header
            .iter()
            .position(|found| *found == name)
            .map(|i| self.fields[i])
            .ok_or_else(|| format!("the column {name} is missing from the header"))
    }

    fn parse<T: std::str::FromStr>(&self, name: &str, what: &str) -> Result<T, String> {
        let text = self.text(name)?;
        text.parse()
            .map_err(|_| format!("{name} must be {what}, but is '{text}'"))
    }

    fn finite(&self, name: &str) -> Result<f64, String> {
        let value: f64 = self.parse(name, "a number")?;
        if value.is_finite() {
            Ok(value)
        } else {
            Err(format!("{name} must be finite, but is {value}"))
        }
    }

    fn pose(&self, prefix: &str) -> Result<Isometry3<f64>, String> {
        let value = |name: &str| self.finite(&format!("{prefix}{name}"));
        pose_of_quaternion(
            [value("tx")?, value("ty")?, value("tz")?],
            Quaternion::new(value("qw")?, value("qx")?, value("qy")?, value("qz")?),
        )
    }

    /// A covariance from its upper triangle. What is no number stays so: it is counted later.
    fn covariance(&self, letter: char) -> Result<Matrix6<f64>, String> {
        let mut cov = Matrix6::zeros();
        for i in 0..6 {
            for j in i..6 {
                let value = self.parse(&format!("{letter}{i}{j}"), "a number")?;
                cov[(i, j)] = value;
                cov[(j, i)] = value;
            }
        }
        Ok(cov)
    }

    fn status(&self) -> Result<Status, String> {
        match self.text("status")? {
            "initializing" => Ok(Status::Initializing),
            "tracking" => Ok(Status::Tracking),
            "degraded" => Ok(Status::Degraded),
            "lost" => Ok(Status::Lost),
            other => Err(format!(
                "status must be initializing, tracking, degraded or lost, but is '{other}'"
            )),
        }
    }
}
