//! Rows and truth in, what several figures need of them out.

use super::ReportError;
use crate::evaluation::segments::{KITTI_LENGTHS_M, path_lengths_m};
use crate::evaluation::{
    Estimate, Evaluation, Settings, Trajectory, associate, evaluate, truth_in_odometry_frame,
};
use crate::geometry::se3::error_fixed_axes;
use crate::output::row::OdometryRow;
use nalgebra::{Isometry3, Vector6};

/// Lengths of segments on a path too short for the benchmark's, m.
const SHORT_LENGTHS_M: [f64; 5] = [10.0, 20.0, 30.0, 40.0, 50.0];

/// A run as the figures see it; every list has one entry a row.
pub(super) struct Run<'a> {
    pub rows: &'a [OdometryRow],
    /// Since the first row.
    pub times_s: Vec<f64>,
    /// Along the estimated path; jumps to a new odometry frame do not count.
    pub path_m: Vec<f64>,
    /// True poses in the odometry frame.
    pub truth: Option<Vec<Option<Isometry3<f64>>>>,
    /// Where there is truth.
    pub evaluation: Option<Evaluation>,
}

impl<'a> Run<'a> {
    pub(super) fn new(
        rows: &'a [OdometryRow],
        truth: Option<&Trajectory>,
        settings: &Settings,
    ) -> Result<Self, ReportError> {
        let first_ns = rows.first().map_or(0, |row| row.timestamp_ns);
        let mut run = Self {
            rows,
            times_s: rows
                .iter()
                .map(|row| (i128::from(row.timestamp_ns) - i128::from(first_ns)) as f64 / 1e9)
                .collect(),
            path_m: path_m(rows),
            truth: None,
            evaluation: None,
        };
        if let Some(truth) = truth {
            let estimate = Estimate::Odometry(rows.to_vec());
            let found = associate(&estimate, truth, settings.max_difference_ns)?;
            let mut evaluation = evaluate(&estimate, truth, settings)?;
            if evaluation.segments.all.segments == 0 && settings.lengths_m == KITTI_LENGTHS_M {
                let shorter = Settings {
                    lengths_m: SHORT_LENGTHS_M.to_vec(),
                    ..settings.clone()
                };
                evaluation = evaluate(&estimate, truth, &shorter)?;
            }
            run.truth = Some(truth_in_odometry_frame(&estimate, truth, &found));
            run.evaluation = Some(evaluation);
        }
        Ok(run)
    }

    /// The last row.
    pub(super) fn end(&self) -> &OdometryRow {
        // `render` refuses a run without rows before it makes a `Run`.
        &self.rows[self.rows.len() - 1]
    }

    /// From the first to the last time, for axes.
    pub(super) fn time_span_s(&self) -> (f64, f64) {
        super::scale::extent(self.times_s.iter().copied()).unwrap_or((0.0, 1.0))
    }

    /// A value of each row over time.
    pub(super) fn over_time(&self, of: impl Fn(&OdometryRow) -> f64) -> Vec<(f64, f64)> {
        let values = self.rows.iter().map(of);
        self.times_s.iter().copied().zip(values).collect()
    }

    /// The pose's error of each row with truth, `[t_est − t ; Log(R_est Rᵀ)]`.
    pub(super) fn errors(&self) -> Option<Vec<Option<Vector6<f64>>>> {
        let truth = self.truth.as_ref()?;
        let pairs = self.rows.iter().zip(truth);
        Some(
            pairs
                .map(|(row, truth)| {
                    truth.map(|truth| error_fixed_axes(&row.odom_from_camera, &truth))
                })
                .collect(),
        )
    }

    /// Stretches of rows with one value of `key`: its value, first row, and the row after the last.
    pub(super) fn stretches<K: PartialEq>(
        &self,
        key: impl Fn(&OdometryRow) -> K,
    ) -> Vec<(K, usize, usize)> {
        let mut stretches: Vec<(K, usize, usize)> = Vec::new();
        for (i, row) in self.rows.iter().enumerate() {
            let now = key(row);
            match stretches.last_mut() {
                Some((before, _, end)) if *before == now => *end = i + 1,
                _ => stretches.push((now, i, i + 1)),
            }
        }
        stretches
    }
}

/// 1 σ of element `k` of a covariance's error; not a number where the variance is negative.
pub(super) fn sigma(cov: &nalgebra::Matrix6<f64>, k: usize) -> f64 {
    cov[(k, k)].sqrt()
}

fn path_m(rows: &[OdometryRow]) -> Vec<f64> {
    let mut all = Vec::with_capacity(rows.len());
    for epoch in rows.chunk_by(|a, b| a.epoch == b.epoch) {
        let before = all.last().copied().unwrap_or(0.0);
        let poses: Vec<_> = epoch.iter().map(|row| row.odom_from_camera).collect();
        all.extend(path_lengths_m(&poses).iter().map(|path| before + path));
    }
    all
}
