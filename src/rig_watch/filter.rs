//! The slow state: by how much the calibration misses rows from the start, and by how much the right camera has
//! turned since; with their joint covariance.
//!
//! A Kalman filter in information form: equations `N x = g` of one pair, counted from the present state, make
//! `P ← (P⁻¹ + N)⁻¹`, `x ← x + P g`; written `(I + P N)⁻¹ P`, which holds where P is singular, too, as it
//! is at the start: nothing has turned by then.

use nalgebra::{Matrix3, SMatrix, SVector, Vector3};

/// Terms of what the calibration misses rows by: 1, x, y, x², xy, y².
pub(super) const STATICS: usize = 6;
/// All unknowns: the terms, px, then the turn, rad.
pub(super) const UNKNOWNS: usize = STATICS + 3;

/// Which axis of the turn is the yaw.
pub(super) const YAW: usize = 1;

/// A covariance of the terms, px².
pub(super) type StaticsCovariance = SMatrix<f64, STATICS, STATICS>;

/// Normal equations of the deviation from the present state.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Equations {
    pub(super) information: SMatrix<f64, UNKNOWNS, UNKNOWNS>,
    pub(super) vector: SVector<f64, UNKNOWNS>,
}

impl Default for Equations {
    /// Those that say nothing.
    fn default() -> Self {
        Self {
            information: SMatrix::zeros(),
            vector: SVector::zeros(),
        }
    }
}

impl Equations {
    /// One measurement more: its derivative by the unknowns, what it deviates by, and its weight.
    pub(super) fn add(&mut self, by: &SVector<f64, UNKNOWNS>, deviation: f64, weight: f64) {
        self.information.ger(weight, by, by, 1.0);
        self.vector.axpy(weight * deviation, by, 1.0);
    }

    /// Equations of the yaw alone.
    pub(super) fn of_yaw(information: f64, vector: f64) -> Self {
        let mut equations = Self::default();
        equations.information[(STATICS + YAW, STATICS + YAW)] = information;
        equations.vector[STATICS + YAW] = vector;
        equations
    }

    /// The yaw that they say, squared, over its variance.
    pub(super) fn yaw_squared(&self) -> f64 {
        let i = STATICS + YAW;
        self.vector[i] * self.vector[i] / self.information[(i, i)]
    }

    /// Counts the deviation from a state that has gone on by so much.
    pub(super) fn count_from(&mut self, gone_on: &SVector<f64, UNKNOWNS>) {
        self.vector -= self.information * gone_on;
    }

    /// The same with `factor` times the information.
    pub(super) fn scale(&mut self, factor: f64) {
        self.information *= factor;
        self.vector *= factor;
    }
}

/// The state with its covariance.
#[derive(Clone, Debug)]
pub(super) struct Filter {
    pub(super) state: SVector<f64, UNKNOWNS>,
    pub(super) cov: SMatrix<f64, UNKNOWNS, UNKNOWNS>,
    prior: StaticsCovariance,
}

impl Filter {
    pub(super) fn new(prior: StaticsCovariance) -> Self {
        let mut cov = SMatrix::<f64, UNKNOWNS, UNKNOWNS>::zeros();
        cov.fixed_view_mut::<STATICS, STATICS>(0, 0)
            .copy_from(&prior);
        Self {
            state: SVector::zeros(),
            cov,
            prior,
        }
    }

    /// Time passes: the turn may have crept.
    pub(super) fn walk(&mut self, rad_per_root_s: f64, dt_s: f64) {
        self.widen(rad_per_root_s * rad_per_root_s * dt_s.max(0.0));
    }

    /// The turn may be another one altogether.
    pub(super) fn open(&mut self, sigma_rad: f64) {
        self.widen(sigma_rad * sigma_rad);
    }

    fn widen(&mut self, variance_rad2: f64) {
        for i in STATICS..UNKNOWNS {
            self.cov[(i, i)] += variance_rad2;
        }
    }

    pub(super) fn update(&mut self, said: &Equations) {
        let widened = SMatrix::<f64, UNKNOWNS, UNKNOWNS>::identity() + self.cov * said.information;
        let Some(inverse) = widened.try_inverse() else {
            return;
        };
        let cov = inverse * self.cov;
        self.cov = (cov + cov.transpose()) * 0.5;
        self.state += self.cov * said.vector;
    }

    pub(super) fn turn_rad(&self) -> Vector3<f64> {
        self.state.fixed_rows::<3>(STATICS).into_owned()
    }

    pub(super) fn turn_cov(&self) -> Matrix3<f64> {
        self.cov.fixed_view::<3, 3>(STATICS, STATICS).into_owned()
    }

    /// The turn over its own uncertainty, χ² with three degrees of freedom where the camera has not turned.
    pub(super) fn turn_nees(&self) -> f64 {
        let turn_rad = self.turn_rad();
        self.turn_cov()
            .cholesky()
            .map_or(0.0, |c| turn_rad.dot(&c.solve(&turn_rad)))
    }

    /// What the calibration misses by over what it was expected to: at most χ² with a degree of freedom a
    /// term, as an estimate varies by its prior less what is still unknown.
    pub(super) fn statics_nees(&self) -> f64 {
        let statics = self.state.fixed_rows::<STATICS>(0).into_owned();
        self.prior
            .cholesky()
            .map_or(0.0, |c| statics.dot(&c.solve(&statics)))
    }
}
