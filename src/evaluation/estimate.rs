//! An odometry CSV or a plain trajectory in, one view of it out; and which true pose belongs to
//! each of its rows.

use super::file_error::{FileError, read_text};
use super::trajectory::{Trajectory, parse_trajectory};
use crate::output::csv::parse_odometry_csv;
use crate::output::row::OdometryRow;
use nalgebra::Isometry3;
use std::path::Path;

/// What is evaluated.
#[derive(Clone, Debug, PartialEq)]
pub enum Estimate {
    /// visod's own odometry, with covariances.
    Odometry(Vec<OdometryRow>),
    /// Poses of any program.
    Trajectory(Trajectory),
}

/// Why no true pose can be found for an estimate.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum AssociationError {
    /// Neither numbers nor times to go by.
    #[error(
        "{estimate} poses of an estimate {how} cannot be associated with {truth} true poses {other}: \
         give the odometry CSV, or ground truth in the same form"
    )]
    DifferentForms {
        /// How many poses are estimated.
        estimate: usize,
        /// How many are true.
        truth: usize,
        /// What the estimate has.
        how: &'static str,
        /// What the truth has.
        other: &'static str,
    },
    /// Times that go back and forth.
    #[error("the times of the estimate do not rise at seq {sequence}")]
    TimesNotRising {
        /// Where.
        sequence: u64,
    },
    /// Nothing in common.
    #[error("none of the {estimate} estimates has a true pose among {truth}: {hint}")]
    NothingInCommon {
        /// How many poses are estimated.
        estimate: usize,
        /// How many are true.
        truth: usize,
        /// What to look at.
        hint: String,
    },
}

/// Reads an odometry CSV, or a trajectory in KITTI, TUM or EuRoC form, as its content says.
///
/// # Errors
/// The file cannot be read, holds no row, or has a line that cannot be one.
pub fn read_estimate(path: &Path) -> Result<Estimate, FileError> {
    let text = read_text(path)?;
    if looks_like_odometry_csv(&text) {
        parse_rows(path, &text).map(Estimate::Odometry)
    } else {
        parse_trajectory(path, &text).map(Estimate::Trajectory)
    }
}

/// Whether a text begins as an odometry CSV does.
fn looks_like_odometry_csv(text: &str) -> bool {
    let header = text.lines().next().unwrap_or("");
    header.contains(',') && header.split(',').any(|name| name.trim() == "seq")
}

fn parse_rows(name: &Path, text: &str) -> Result<Vec<OdometryRow>, FileError> {
    let rows = parse_odometry_csv(name, text.as_bytes()).map_err(|error| FileError {
        line: error.line.and_then(|line| usize::try_from(line).ok()),
        cause: match error.column {
            Some(column) => format!("{column}: {}", error.cause),
            None => error.cause,
        },
        file: error.file,
    })?;
    if rows.is_empty() {
        return Err(FileError::new(name, None, "holds a header but no row"));
    }
    if let Some(pair) = rows.windows(2).find(|w| w[0].sequence >= w[1].sequence) {
        let (before, after) = (pair[0].sequence, pair[1].sequence);
        let cause = format!("seq must rise, but {after} follows {before}");
        return Err(FileError::new(name, None, cause));
    }
    Ok(rows)
}

impl Estimate {
    /// How many poses there are.
    #[must_use]
    pub fn len(&self) -> usize {
        match self {
            Self::Odometry(rows) => rows.len(),
            Self::Trajectory(trajectory) => trajectory.world_from_body.len(),
        }
    }

    /// Whether there is no pose.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Rows with covariances, if there are any.
    #[must_use]
    pub fn rows(&self) -> Option<&[OdometryRow]> {
        match self {
            Self::Odometry(rows) => Some(rows),
            Self::Trajectory(_) => None,
        }
    }

    /// The poses: each maps a point of the camera into the frame of the estimate.
    #[must_use]
    pub fn poses(&self) -> Vec<Isometry3<f64>> {
        match self {
            Self::Odometry(rows) => rows.iter().map(|row| row.odom_from_camera).collect(),
            Self::Trajectory(trajectory) => trajectory.world_from_body.clone(),
        }
    }

    /// The number of a pose's stereo pair in its recording.
    #[must_use]
    pub fn sequence(&self, index: usize) -> u64 {
        match self {
            Self::Odometry(rows) => rows[index].sequence,
            Self::Trajectory(_) => index as u64,
        }
    }

    /// Which odometry frame a pose is given in.
    #[must_use]
    pub fn epoch(&self, index: usize) -> u32 {
        match self {
            Self::Odometry(rows) => rows[index].epoch,
            Self::Trajectory(_) => 0,
        }
    }

    fn stamps_ns(&self) -> Option<Vec<i64>> {
        match self {
            Self::Odometry(rows) => Some(rows.iter().map(|row| row.timestamp_ns).collect()),
            Self::Trajectory(trajectory) => trajectory.stamps_ns.clone(),
        }
    }

    /// Whether the number of a pose is that of its stereo pair: TUM files leave pairs out.
    fn is_numbered(&self) -> bool {
        match self {
            Self::Odometry(_) => true,
            Self::Trajectory(trajectory) => trajectory.stamps_ns.is_none(),
        }
    }
}

/// The index of the true pose of each estimate.
///
/// Truth with times is associated by the nearest time within `max_difference_ns`, one estimate to
/// one true pose; truth without by the number of the stereo pair.
///
/// # Errors
/// [`AssociationError`].
pub fn associate(
    estimate: &Estimate,
    truth: &Trajectory,
    max_difference_ns: i64,
) -> Result<Vec<Option<usize>>, AssociationError> {
    let truths = truth.world_from_body.len();
    let found = match (estimate.stamps_ns(), &truth.stamps_ns) {
        (Some(of_estimate), Some(of_truth)) => {
            if let Some(i) = of_estimate.windows(2).position(|pair| pair[0] >= pair[1]) {
                let sequence = estimate.sequence(i + 1);
                return Err(AssociationError::TimesNotRising { sequence });
            }
            by_time(&of_estimate, of_truth, max_difference_ns)
        }
        (_, None) if estimate.is_numbered() || estimate.len() == truths => (0..estimate.len())
            .map(|i| usize::try_from(estimate.sequence(i)).ok())
            .map(|number| number.filter(|&n| n < truths))
            .collect(),
        (None, Some(_)) if estimate.len() == truths => (0..truths).map(Some).collect(),
        (of_estimate, of_truth) => {
            let what = |has_times| match has_times {
                true => "with times",
                false => "without times",
            };
            return Err(AssociationError::DifferentForms {
                estimate: estimate.len(),
                truth: truths,
                how: what(of_estimate.is_some()),
                other: what(of_truth.is_some()),
            });
        }
    };
    if found.iter().all(Option::is_none) {
        return Err(AssociationError::NothingInCommon {
            estimate: estimate.len(),
            truth: truths,
            hint: hint(estimate, truth, max_difference_ns),
        });
    }
    Ok(found)
}

/// Each time of the shorter list finds its nearest in the longer one.
fn by_time(estimate: &[i64], truth: &[i64], max_difference_ns: i64) -> Vec<Option<usize>> {
    if estimate.len() <= truth.len() {
        return estimate
            .iter()
            .map(|&stamp| nearest(truth, stamp, max_difference_ns))
            .collect();
    }
    let mut found = vec![None; estimate.len()];
    for (index, &stamp) in truth.iter().enumerate() {
        if let Some(i) = nearest(estimate, stamp, max_difference_ns) {
            found[i] = Some(index);
        }
    }
    found
}

/// The index of the value nearest to `wanted`, of two equally near the earlier.
fn nearest(rising: &[i64], wanted: i64, max_difference: i64) -> Option<usize> {
    let after = rising.partition_point(|&value| value < wanted);
    let gap = |i: usize| rising[i].abs_diff(wanted);
    let candidates = after.saturating_sub(1)..(after + 1).min(rising.len());
    candidates
        .min_by_key(|&i| gap(i))
        .filter(|&i| gap(i) <= max_difference.unsigned_abs())
}

fn hint(estimate: &Estimate, truth: &Trajectory, max_difference_ns: i64) -> String {
    let span = |stamps: &[i64]| match (stamps.first(), stamps.last()) {
        (Some(first), Some(last)) => {
            format!("{:.3} to {:.3} s", *first as f64 / 1e9, *last as f64 / 1e9)
        }
        _ => "no time".to_owned(),
    };
    match (estimate.stamps_ns(), &truth.stamps_ns) {
        (Some(of_estimate), Some(of_truth)) => format!(
            "the estimate's times are {}, the truth's {}, and {} s is the largest difference allowed",
            span(&of_estimate),
            span(of_truth),
            max_difference_ns as f64 / 1e9
        ),
        _ => "their numbers do not overlap".to_owned(),
    }
}
