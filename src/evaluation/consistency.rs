//! Rows with covariances and their true poses in, a verdict on the covariances out.
//!
//! The accumulated pose and the motion of each row are judged apart. Poses of one run hold one
//! another's errors, so that a run is one sample of the pose and no interval applies to its
//! average; the motions are many samples, as far as they are independent, which their
//! autocorrelation tells.

use crate::estimation::Status;
use crate::geometry::se3::error_fixed_axes;
use crate::geometry::so3;
use crate::output::row::OdometryRow;
use crate::uncertainty::consistency::{
    anees_interval, autocorrelation, autocorrelation_limit, chi2_quantile, coverage,
    coverage_interval, nees, whiten,
};
use nalgebra::{Isometry3, Matrix3, Matrix6, Matrix6x3, SVector, Vector6};

/// The probability of intervals and ellipsoids.
pub const LEVEL: f64 = 0.95;

/// Names of the elements of a pose's error, in order.
pub const AXES: [&str; 6] = ["x", "y", "z", "rx", "ry", "rz"];

/// Whether the covariances of a run hold.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Consistency {
    /// Of the motions from row to row.
    pub increments: Increments,
    /// Of the accumulated pose.
    pub pose: Accumulated,
}

/// How well the covariances of the motions hold.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Increments {
    /// Motions that were judged.
    pub samples: usize,
    /// Rows left out because they begin an epoch.
    pub initializing: usize,
    /// Rows left out because their motion was not measured.
    pub lost: usize,
    /// Rows left out because they or the row before have no true pose.
    pub without_truth: usize,
    /// Rows left out because their covariance is not symmetric positive definite.
    pub bad_covariances: usize,
    /// `seq` of the first of these.
    pub first_bad_covariance: Option<u64>,
    /// All six degrees of freedom.
    pub full: Option<Anees>,
    /// Translation alone.
    pub translation: Option<Anees>,
    /// Rotation alone.
    pub rotation: Option<Anees>,
    /// Correlation of neighbouring errors in units of their covariance.
    pub whiteness: Option<Whiteness>,
    /// Element by element: x, y, z, rx, ry, rz.
    pub axes: Vec<Axis>,
    /// NEES by row of the estimate, where it could be computed.
    #[serde(skip)]
    pub nees: Vec<Option<f64>>,
}

/// The average normalised error squared of independent samples, with what it should be.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Anees {
    /// Degrees of freedom of a sample.
    pub dof: usize,
    /// How many samples.
    pub samples: usize,
    /// Average NEES divided by the degrees of freedom: 1 if the covariances hold.
    pub anees: f64,
    /// Where that lies in 95 of 100 honest runs.
    pub interval: (f64, f64),
    /// What follows.
    pub verdict: Verdict,
    /// Share of samples inside their 95 % ellipsoid.
    pub coverage: f64,
    /// Where that lies in 95 of 100 honest runs.
    pub coverage_interval: (f64, f64),
}

/// Which way covariances err.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Verdict {
    /// Errors are as large as the covariances say.
    Consistent,
    /// Errors are larger.
    Overconfident,
    /// Errors are smaller.
    Pessimistic,
}

impl std::fmt::Display for Verdict {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Consistent => "consistent",
            Self::Overconfident => "overconfident",
            Self::Pessimistic => "pessimistic",
        })
    }
}

/// Correlation of neighbours in time.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Whiteness {
    /// Neighbouring pairs of motions.
    pub pairs: usize,
    /// Lag-1 autocorrelation over all six elements.
    pub autocorrelation: f64,
    /// Its absolute value stays below this in 95 of 100 runs with independent motions.
    pub limit: f64,
}

/// One element of the motions' errors.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Axis {
    /// x, y, z, rx, ry or rz.
    pub name: &'static str,
    /// Root mean square error, m or rad.
    pub rms_error: f64,
    /// Root of the mean predicted variance, m or rad.
    pub rms_sigma: f64,
    /// Mean of error / σ: 0 without bias.
    pub mean_normalised: f64,
    /// Root mean square of error / σ: 1 if the covariances hold.
    pub rms_normalised: f64,
    /// Lag-1 autocorrelation of error / σ.
    pub autocorrelation: Option<f64>,
}

/// How well the covariance of the accumulated pose holds.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct Accumulated {
    /// Poses that were judged.
    pub samples: usize,
    /// Rows whose covariance is not symmetric positive definite.
    pub bad_covariances: usize,
    /// `seq` of the first of these.
    pub first_bad_covariance: Option<u64>,
    /// The last pose that could be judged.
    pub end: Option<EndPose>,
    /// Average NEES / 6 along the run: one sample drawn out, not many.
    pub mean_nees_per_dof: Option<f64>,
    /// Share of poses inside their 95 % ellipsoid: no more independent than that average.
    pub coverage: Option<f64>,
}

/// The end of a run against its covariance.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct EndPose {
    /// `seq` of its row.
    pub sequence: u64,
    /// NEES, six degrees of freedom.
    pub nees: f64,
    /// NEES / 3 of the position alone.
    pub translation_nees_per_dof: f64,
    /// NEES / 3 of the orientation alone.
    pub rotation_nees_per_dof: f64,
    /// The NEES that 95 of 100 honest runs stay below.
    pub nees_limit: f64,
}

/// What the truth may itself be wrong by.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TruthErrors {
    /// Covariance of its own motion from row to row: new in each.
    pub cov_motion: Matrix6<f64>,
    /// 1 σ per axis of how its sensor is turned against the camera, the same all along, rad.
    pub sigma_mounting_rad: f64,
}

impl TruthErrors {
    /// What a true motion is uncertain by, as its fixed-axes error. A sensor that is turned by a
    /// small φ sees the motion (R, t) as that of the camera turned by φ: it errs by φ × t and by
    /// φ − R φ.
    #[must_use]
    pub fn covariance(&self, prev_from_now: &Isometry3<f64>) -> Matrix6<f64> {
        let mut by_mounting = Matrix6x3::zeros();
        by_mounting
            .fixed_view_mut::<3, 3>(0, 0)
            .copy_from(&-so3::hat(&prev_from_now.translation.vector));
        by_mounting.fixed_view_mut::<3, 3>(3, 0).copy_from(
            &(Matrix3::identity() - prev_from_now.rotation.to_rotation_matrix().matrix()),
        );
        let variance = self.sigma_mounting_rad * self.sigma_mounting_rad;
        self.cov_motion + by_mounting * by_mounting.transpose() * variance
    }
}

/// Judges the covariances of rows whose true poses, in the frame of the odometry, are given.
///
/// `truth` has one entry a row. What the truth itself may be wrong by is added to the covariance of
/// each motion before that is judged; the accumulated pose is judged as if the truth were perfect.
#[must_use]
pub fn consistency(
    rows: &[OdometryRow],
    truth: &[Option<Isometry3<f64>>],
    truth_errors: &TruthErrors,
) -> Consistency {
    Consistency {
        increments: judge_increments(rows, truth, truth_errors),
        pose: judge_pose(rows, truth),
    }
}

/// A motion's error with the covariance that it should have.
#[derive(Clone, Copy)]
struct Sample {
    error: Vector6<f64>,
    cov: Matrix6<f64>,
    whitened: Vector6<f64>,
}

fn judge_increments(
    rows: &[OdometryRow],
    truth: &[Option<Isometry3<f64>>],
    truth_errors: &TruthErrors,
) -> Increments {
    let mut initializing = 0;
    let mut lost = 0;
    let mut without_truth = 0;
    let mut bad = Vec::new();
    let mut samples: Vec<Option<Sample>> = vec![None; rows.len()];
    for (i, row) in rows.iter().enumerate() {
        match row.status {
            Status::Initializing => initializing += 1,
            Status::Lost => lost += 1,
            Status::Tracking | Status::Degraded => match true_motion(rows, truth, i) {
                None => without_truth += 1,
                Some(prev_from_now) => {
                    let error = error_fixed_axes(&row.prev_from_now, &prev_from_now);
                    let cov = row.cov_motion + truth_errors.covariance(&prev_from_now);
                    samples[i] = whiten(&error, &cov).map(|whitened| Sample {
                        error,
                        cov,
                        whitened,
                    });
                    if samples[i].is_none() {
                        bad.push(row.sequence);
                    }
                }
            },
        }
    }
    let good: Vec<Sample> = samples.iter().flatten().copied().collect();
    let neighbours: Vec<(Sample, Sample)> = samples
        .windows(2)
        .filter_map(|pair| Some((pair[0]?, pair[1]?)))
        .collect();
    Increments {
        samples: good.len(),
        initializing,
        lost,
        without_truth,
        bad_covariances: bad.len(),
        first_bad_covariance: bad.first().copied(),
        full: anees::<6>(&good, 0),
        translation: anees::<3>(&good, 0),
        rotation: anees::<3>(&good, 3),
        whiteness: whiteness(&neighbours),
        axes: (0..6).filter_map(|k| axis(k, &good, &neighbours)).collect(),
        nees: samples
            .iter()
            .map(|s| s.map(|s| s.whitened.norm_squared()))
            .collect(),
    }
}

/// The true motion into row `i` from the row before, if both are in one epoch and have truth.
fn true_motion(
    rows: &[OdometryRow],
    truth: &[Option<Isometry3<f64>>],
    i: usize,
) -> Option<Isometry3<f64>> {
    let before = i.checked_sub(1)?;
    if rows[before].epoch != rows[i].epoch {
        return None;
    }
    Some(truth[before]?.inv_mul(&truth[i]?))
}

/// The verdict on `N` elements from `first` on.
fn anees<const N: usize>(samples: &[Sample], first: usize) -> Option<Anees> {
    let values: Vec<f64> = samples
        .iter()
        .filter_map(|s| nees_of_part::<N>(&s.error, &s.cov, first))
        .collect();
    if values.is_empty() {
        return None;
    }
    let count = values.len();
    let anees = values.iter().sum::<f64>() / (count * N) as f64;
    let interval = anees_interval(N, count, LEVEL);
    Some(Anees {
        dof: N,
        samples: count,
        anees,
        interval,
        verdict: if anees > interval.1 {
            Verdict::Overconfident
        } else if anees < interval.0 {
            Verdict::Pessimistic
        } else {
            Verdict::Consistent
        },
        coverage: coverage(&values, N, LEVEL),
        coverage_interval: coverage_interval(count, LEVEL),
    })
}

fn nees_of_part<const N: usize>(
    error: &Vector6<f64>,
    cov: &Matrix6<f64>,
    first: usize,
) -> Option<f64> {
    let error: SVector<f64, N> = error.fixed_rows::<N>(first).into_owned();
    nees(&error, &cov.fixed_view::<N, N>(first, first).into_owned())
}

fn whiteness(neighbours: &[(Sample, Sample)]) -> Option<Whiteness> {
    if neighbours.is_empty() {
        return None;
    }
    let pairs: Vec<_> = neighbours
        .iter()
        .map(|(a, b)| (a.whitened, b.whitened))
        .collect();
    Some(Whiteness {
        pairs: pairs.len(),
        autocorrelation: autocorrelation(&pairs),
        limit: autocorrelation_limit(6 * pairs.len(), LEVEL),
    })
}

fn axis(k: usize, samples: &[Sample], neighbours: &[(Sample, Sample)]) -> Option<Axis> {
    if samples.is_empty() {
        return None;
    }
    let normalised = |s: &Sample| s.error[k] / s.cov[(k, k)].sqrt();
    let mean =
        |f: &dyn Fn(&Sample) -> f64| samples.iter().map(f).sum::<f64>() / samples.len() as f64;
    let pairs: Vec<_> = neighbours
        .iter()
        .map(|(a, b)| {
            (
                SVector::from([normalised(a)]),
                SVector::from([normalised(b)]),
            )
        })
        .collect();
    Some(Axis {
        name: AXES[k],
        rms_error: mean(&|s| s.error[k].powi(2)).sqrt(),
        rms_sigma: mean(&|s| s.cov[(k, k)]).sqrt(),
        mean_normalised: mean(&normalised),
        rms_normalised: mean(&|s| normalised(s).powi(2)).sqrt(),
        autocorrelation: (!pairs.is_empty()).then(|| autocorrelation::<1>(&pairs)),
    })
}

fn judge_pose(rows: &[OdometryRow], truth: &[Option<Isometry3<f64>>]) -> Accumulated {
    let mut anchored_epoch = None;
    let mut bad = Vec::new();
    let mut values = Vec::new();
    let mut end = None;
    for (row, truth) in rows.iter().zip(truth) {
        let Some(truth) = truth else { continue };
        // The first pose of an epoch agrees with the truth by definition.
        if anchored_epoch != Some(row.epoch) {
            anchored_epoch = Some(row.epoch);
            continue;
        }
        let error = error_fixed_axes(&row.odom_from_camera, truth);
        match nees(&error, &row.cov_pose) {
            Some(value) => {
                values.push(value);
                end = end_pose(row, &error, value);
            }
            None => bad.push(row.sequence),
        }
    }
    let any = !values.is_empty();
    Accumulated {
        samples: values.len(),
        bad_covariances: bad.len(),
        first_bad_covariance: bad.first().copied(),
        end,
        mean_nees_per_dof: any.then(|| values.iter().sum::<f64>() / (6 * values.len()) as f64),
        coverage: any.then(|| coverage(&values, 6, LEVEL)),
    }
}

fn end_pose(row: &OdometryRow, error: &Vector6<f64>, nees: f64) -> Option<EndPose> {
    Some(EndPose {
        sequence: row.sequence,
        nees,
        translation_nees_per_dof: nees_of_part::<3>(error, &row.cov_pose, 0)? / 3.0,
        rotation_nees_per_dof: nees_of_part::<3>(error, &row.cov_pose, 3)? / 3.0,
        nees_limit: chi2_quantile(LEVEL, 6.0),
    })
}
