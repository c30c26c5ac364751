//! Errors with the covariances that claim to cover them in, the verdict out.

use crate::geometry::se3;
use crate::uncertainty::consistency::{anees_interval, chi2_quantile, coverage_interval};
use nalgebra::{Matrix6, Vector6};

/// The probability that intervals and ellipsoids are for.
pub const LEVEL: f64 = 0.95;

/// How errors compare with the covariances that were stated for them.
///
/// Errors are ordered translation (or position), rotation: m, rad.
#[derive(Clone, Debug, PartialEq)]
pub struct Verdict {
    /// Errors that were counted.
    pub runs: u64,
    /// Degrees of freedom of an error.
    pub degrees_of_freedom: usize,
    /// Average normalised squared error over the degrees of freedom: 1 if honest, above if
    /// overconfident.
    pub anees: f64,
    /// Where it lies with 95 % probability if the covariances are right, the errors being
    /// independent.
    pub anees_interval: (f64, f64),
    /// Share of the errors inside their own 95 % ellipsoid.
    pub coverage: f64,
    /// Where that lies with 95 % probability.
    pub coverage_interval: (f64, f64),
    /// Mean of the stated first-order covariances.
    pub first_order: Matrix6<f64>,
    /// Mean square of the errors.
    pub monte_carlo: Matrix6<f64>,
    /// Mean of the errors.
    pub bias: Vector6<f64>,
    /// The least covariance that an unbiased estimator can have, where it was computed.
    pub bound: Option<Matrix6<f64>>,
}

/// Half of a [`Verdict`]: translations, or rotations.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Part {
    /// Stated 1 σ, the root of the trace: m or rad.
    pub sigma_first_order: f64,
    /// Root of the mean square error.
    pub sigma_monte_carlo: f64,
    /// Stated trace over sampled trace.
    pub trace_ratio: f64,
    /// Root of the mean square error over the bound's.
    pub ratio_to_bound: Option<f64>,
}

impl Verdict {
    /// Whether the ANEES lies in its interval.
    #[must_use]
    pub fn is_consistent(&self) -> bool {
        (self.anees_interval.0..=self.anees_interval.1).contains(&self.anees)
    }

    /// Of translations (or positions).
    #[must_use]
    pub fn translation(&self) -> Part {
        self.part(0)
    }

    /// Of rotations; `None` where the error has none.
    #[must_use]
    pub fn rotation(&self) -> Option<Part> {
        (self.monte_carlo[(4, 4)] > 0.0 || self.first_order[(4, 4)] > 0.0).then(|| self.part(3))
    }

    /// The length of the mean error in units of the mean covariance's σ, translations only: about
    /// `√(3 / runs)` where there is no bias.
    #[must_use]
    pub fn bias_sigmas(&self) -> f64 {
        let bias = self.bias.fixed_rows::<3>(0).norm();
        bias / self.translation().sigma_monte_carlo
    }

    fn part(&self, first: usize) -> Part {
        let trace = |m: &Matrix6<f64>| (first..first + 3).map(|i| m[(i, i)]).sum::<f64>();
        let sampled = trace(&self.monte_carlo);
        Part {
            sigma_first_order: trace(&self.first_order).sqrt(),
            sigma_monte_carlo: sampled.sqrt(),
            trace_ratio: trace(&self.first_order) / sampled,
            ratio_to_bound: self
                .bound
                .as_ref()
                .map(|bound| (sampled / trace(bound)).sqrt()),
        }
    }
}

/// Adds up errors; the order of adding is the order of the runs, so that sums are the same bits.
#[derive(Clone, Debug)]
pub(super) struct Tally {
    degrees_of_freedom: usize,
    limit: f64,
    count: u64,
    covered: u64,
    nees: f64,
    error: Vector6<f64>,
    square: Matrix6<f64>,
    stated: Matrix6<f64>,
}

impl Tally {
    pub(super) fn new(degrees_of_freedom: usize) -> Self {
        Self {
            degrees_of_freedom,
            limit: chi2_quantile(LEVEL, degrees_of_freedom as f64),
            count: 0,
            covered: 0,
            nees: 0.0,
            error: Vector6::zeros(),
            square: Matrix6::zeros(),
            stated: Matrix6::zeros(),
        }
    }

    pub(super) fn add(&mut self, error: &Vector6<f64>, stated: &Matrix6<f64>, nees: f64) {
        self.count += 1;
        self.covered += u64::from(nees <= self.limit);
        self.nees += nees;
        self.error += error;
        self.square += error * error.transpose();
        self.stated += stated;
    }

    pub(super) fn count(&self) -> u64 {
        self.count
    }

    /// The verdict; not numbers where nothing was added.
    pub(super) fn verdict(&self, bound: Option<Matrix6<f64>>) -> Verdict {
        let n = self.count as f64;
        Verdict {
            runs: self.count,
            degrees_of_freedom: self.degrees_of_freedom,
            anees: self.nees / (n * self.degrees_of_freedom as f64),
            anees_interval: anees_interval(self.degrees_of_freedom, self.count as usize, LEVEL),
            coverage: self.covered as f64 / n,
            coverage_interval: coverage_interval(self.count as usize, LEVEL),
            first_order: se3::symmetric(&(self.stated / n)),
            monte_carlo: se3::symmetric(&(self.square / n)),
            bias: self.error / n,
            bound,
        }
    }
}
