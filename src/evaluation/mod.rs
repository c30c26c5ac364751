//! Evaluation: an estimate and the truth in, errors and consistency out.
//!
//! | module | computes |
//! |---|---|
//! | [`trajectory`] | poses from files |
//! | [`estimate`] | the estimate, and which true pose belongs to which row of it |
//! | [`segments`] | KITTI's drift in % and deg/m over lengths of path |
//! | [`pose_errors`], [`alignment`] | absolute and relative pose errors |
//! | [`consistency`] | whether the covariances hold |

pub mod alignment;
pub mod consistency;
pub mod estimate;
mod file_error;
pub mod pose_errors;
pub mod segments;
mod sensor_yaml;
pub mod statistics;
pub mod table;
pub mod trajectory;

pub use alignment::Alignment;
pub use estimate::{AssociationError, Estimate, associate, read_estimate};
pub use file_error::FileError;
pub use sensor_yaml::read_body_from_camera;
pub use trajectory::{Trajectory, read_trajectory};

use crate::estimation::Status;
use crate::output::row::OdometryRow;
use consistency::{Consistency, TruthErrors};
use nalgebra::{Isometry3, Matrix6, Vector6};
use pose_errors::{AbsoluteErrors, RelativeErrors, absolute_errors, relative_errors};
use segments::{KITTI_LENGTHS_M, SegmentReport, path_lengths_m, segment_errors};

/// What to evaluate, and how.
#[derive(Clone, Debug, PartialEq)]
pub struct Settings {
    /// Lengths of the segments, m.
    pub lengths_m: Vec<f64>,
    /// Frames from one segment's beginning to the next one's.
    pub step: usize,
    /// Alignments before absolute errors.
    pub alignments: Vec<Alignment>,
    /// Largest difference in time between an estimate and its true pose, ns.
    pub max_difference_ns: i64,
    /// 1 σ per axis of the truth's own motion from row to row, m.
    pub truth_sigma_m: f64,
    /// The same of its rotation about each axis, rad.
    pub truth_sigma_rad: [f64; 3],
    /// 1 σ per axis of how the truth's own sensor is turned against the camera, the same all along,
    /// rad.
    pub truth_sigma_mounting_rad: f64,
}

impl Default for Settings {
    fn default() -> Self {
        use Alignment::{First, None, Se3, Sim3};
        Self {
            lengths_m: KITTI_LENGTHS_M.to_vec(),
            step: 1,
            alignments: vec![None, First, Se3, Sim3],
            max_difference_ns: 10_000_000,
            truth_sigma_m: 0.0,
            truth_sigma_rad: [0.0; 3],
            truth_sigma_mounting_rad: 0.0,
        }
    }
}

/// Everything that can be said about an estimate beside the truth.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Evaluation {
    /// Poses that were estimated.
    pub poses: usize,
    /// Poses of these with a true one.
    pub associated: usize,
    /// Rows by status; `None` for a plain trajectory.
    pub status: Option<StatusCounts>,
    /// How often the odometry frame began anew within the run.
    pub restarts: usize,
    /// Length of the true path, m.
    pub path_m: f64,
    /// Distance between the last pose and the truth with the first poses brought together, m.
    pub end_error_m: f64,
    /// KITTI's segment errors.
    pub segments: SegmentReport,
    /// Absolute errors by alignment; one that the poses do not determine is missing.
    pub ate: Vec<AbsoluteErrors>,
    /// Errors of the motions from frame to frame; `None` of fewer than two poses.
    pub rpe: Option<RelativeErrors>,
    /// Whether the covariances hold; `None` for a plain trajectory.
    pub consistency: Option<Consistency>,
    /// What cannot be right.
    pub errors: Vec<String>,
    /// What a reader should know before believing a number.
    pub notes: Vec<String>,
}

/// How many rows have which status.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct StatusCounts {
    /// First of an epoch.
    pub initializing: usize,
    /// Measured.
    pub tracking: usize,
    /// Measured from little.
    pub degraded: usize,
    /// Bridged.
    pub lost: usize,
}

impl StatusCounts {
    /// Counts the rows.
    #[must_use]
    pub fn of(rows: &[OdometryRow]) -> Self {
        let mut counts = Self::default();
        for row in rows {
            *match row.status {
                Status::Initializing => &mut counts.initializing,
                Status::Tracking => &mut counts.tracking,
                Status::Degraded => &mut counts.degraded,
                Status::Lost => &mut counts.lost,
            } += 1;
        }
        counts
    }
}

/// Estimated and true poses side by side, the truth in the truth's own frame, apart by epoch.
struct Paired {
    estimate: Vec<Isometry3<f64>>,
    truth: Vec<Isometry3<f64>>,
    /// Where each epoch ends.
    ends: Vec<usize>,
}

impl Paired {
    fn new(estimate: &Estimate, truth: &Trajectory, found: &[Option<usize>]) -> Self {
        let poses = estimate.poses();
        let mut paired = Self {
            estimate: Vec::with_capacity(found.len()),
            truth: Vec::with_capacity(found.len()),
            ends: Vec::new(),
        };
        let mut epoch = None;
        for (i, number) in found.iter().enumerate() {
            let Some(number) = number else { continue };
            if epoch.is_some_and(|epoch| epoch != estimate.epoch(i)) {
                paired.ends.push(paired.truth.len());
            }
            epoch = Some(estimate.epoch(i));
            paired.estimate.push(poses[i]);
            paired.truth.push(truth.world_from_body[*number]);
        }
        paired.ends.push(paired.truth.len());
        paired
    }

    /// Estimated and true poses of each epoch.
    fn runs(&self) -> impl Iterator<Item = (&[Isometry3<f64>], &[Isometry3<f64>])> {
        let begins = std::iter::once(0).chain(self.ends.iter().copied());
        begins
            .zip(self.ends.iter().copied())
            .map(|(begin, end)| (&self.estimate[begin..end], &self.truth[begin..end]))
    }
}

/// The true pose of each row in the frame of the estimate: the first pose of each epoch that has
/// one is where the two agree.
#[must_use]
pub fn truth_in_odometry_frame(
    estimate: &Estimate,
    truth: &Trajectory,
    found: &[Option<usize>],
) -> Vec<Option<Isometry3<f64>>> {
    let poses = estimate.poses();
    let mut anchor: Option<(u32, Isometry3<f64>)> = None;
    let mut place = |i: usize, number: usize| {
        let world_from_body = truth.world_from_body[number];
        let epoch = estimate.epoch(i);
        let odom_from_world = match anchor {
            Some((of, odom_from_world)) if of == epoch => odom_from_world,
            _ => {
                let odom_from_world = poses[i] * world_from_body.inverse();
                anchor = Some((epoch, odom_from_world));
                odom_from_world
            }
        };
        odom_from_world * world_from_body
    };
    found
        .iter()
        .enumerate()
        .map(|(i, number)| number.map(|number| place(i, number)))
        .collect()
}

/// Evaluates an estimate.
///
/// # Errors
/// [`AssociationError`]: no true poses can be found for it.
pub fn evaluate(
    estimate: &Estimate,
    truth: &Trajectory,
    settings: &Settings,
) -> Result<Evaluation, AssociationError> {
    let found = associate(estimate, truth, settings.max_difference_ns)?;
    let paired = Paired::new(estimate, truth, &found);
    let path_m: f64 = paired
        .runs()
        .filter_map(|(_, truth)| path_lengths_m(truth).last().copied())
        .sum();
    let truth_in_odom = truth_in_odometry_frame(estimate, truth, &found);
    let [rx, ry, rz] = settings.truth_sigma_rad;
    let m = settings.truth_sigma_m;
    let sigmas = Vector6::new(m, m, m, rx, ry, rz);
    let truth_errors = TruthErrors {
        cov_motion: Matrix6::from_diagonal(&sigmas.component_mul(&sigmas)),
        sigma_mounting_rad: settings.truth_sigma_mounting_rad,
    };
    let consistency = estimate
        .rows()
        .map(|rows| consistency::consistency(rows, &truth_in_odom, &truth_errors));
    let mut evaluation = Evaluation {
        poses: estimate.len(),
        associated: paired.truth.len(),
        status: estimate.rows().map(StatusCounts::of),
        restarts: paired.ends.len() - 1,
        path_m,
        end_error_m: end_error_m(&estimate.poses(), &truth_in_odom),
        segments: segment_errors(paired.runs(), &settings.lengths_m, settings.step),
        ate: settings
            .alignments
            .iter()
            .filter_map(|&how| absolute_errors(&paired.estimate, &paired.truth, how))
            .collect(),
        rpe: relative_errors(paired.runs()),
        consistency,
        errors: Vec::new(),
        notes: Vec::new(),
    };
    remark(&mut evaluation, settings);
    Ok(evaluation)
}

fn end_error_m(poses: &[Isometry3<f64>], truth: &[Option<Isometry3<f64>>]) -> f64 {
    let mut ends = poses.iter().zip(truth).rev();
    ends.find_map(|(pose, truth)| {
        truth.map(|truth| (pose.translation.vector - truth.translation.vector).norm())
    })
    .unwrap_or(0.0)
}

/// Says what cannot be right, and what a reader should know.
fn remark(evaluation: &mut Evaluation, settings: &Settings) {
    let mut errors = Vec::new();
    let mut notes = Vec::new();
    if let Some(consistency) = &evaluation.consistency {
        let (motion, pose) = (&consistency.increments, &consistency.pose);
        for (of, count, first) in [
            (
                "motion",
                motion.bad_covariances,
                motion.first_bad_covariance,
            ),
            ("pose", pose.bad_covariances, pose.first_bad_covariance),
        ] {
            if let Some(first) = first {
                errors.push(format!(
                    "{count} covariances of the {of} are not symmetric positive definite, the first at seq {first}"
                ));
            }
        }
    }
    let missing = evaluation.poses - evaluation.associated;
    if missing > 0 {
        notes.push(format!(
            "{missing} of {} poses have no true pose and were left out",
            evaluation.poses
        ));
    }
    if evaluation.restarts > 0 {
        notes.push(format!(
            "the odometry frame begins anew {} times: segments and motions stay within one frame, but the ATE compares poses of different frames",
            evaluation.restarts
        ));
    }
    if evaluation.segments.all.segments == 0 {
        notes.push(format!(
            "the path of {:.1} m is too short for a segment: give shorter lengths, as in --lengths 10,20,30,40,50",
            evaluation.path_m
        ));
    }
    for how in &settings.alignments {
        if !evaluation.ate.iter().any(|ate| ate.alignment == *how) {
            notes.push(format!(
                "the alignment {how} is not determined by the path: its points are too few or lie on one line"
            ));
        }
    }
    evaluation.errors = errors;
    evaluation.notes = notes;
}

#[cfg(test)]
mod tests;
