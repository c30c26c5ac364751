//! A step: landmarks that were known before in, by how much the right image's columns have jumped against where
//! it should show them, as a yaw, out.
//!
//! The robot's own motion is an unknown beside the yaw, but the left image alone settles it: what the right one
//! deviates by is then the yaw's. The motion is eliminated (Schur complement), and so are pitch and roll: what
//! rows are missed by, landmarks do not know from before any better than any one pair. Landmarks bring their own
//! uncertainty with them, `S = Σ_z + J Σ_y Jᵀ`.

use super::LEAST;
use super::filter::{Equations, YAW};
use super::turn::px_by_turn;
use crate::estimation::{StereoMeasurement, linearise_sight};
use crate::geometry::StereoRig;
use nalgebra::{Isometry3, Matrix3, Matrix4, SMatrix, SVector, Vector3};

/// Beyond this squared deviation, σ², a landmark counts in proportion only: 95 % of χ² with four degrees of freedom.
const HUBER_SIGMA2: f64 = 9.49;
/// Unknowns to be eliminated: the motion's, then pitch and roll.
const OTHERS: usize = 8;
/// All unknowns: those, then the yaw.
const UNKNOWNS: usize = OTHERS + 1;

/// What the landmarks of one pair say.
#[derive(Clone, Copy, Debug)]
pub(super) struct Step {
    information: SMatrix<f64, UNKNOWNS, UNKNOWNS>,
    vector: SVector<f64, UNKNOWNS>,
    count: usize,
}

impl Default for Step {
    fn default() -> Self {
        Self {
            information: SMatrix::zeros(),
            vector: SVector::zeros(),
            count: 0,
        }
    }
}

impl Step {
    pub(super) fn begin(&mut self) {
        *self = Self::default();
    }

    /// Adds one landmark: (x, y, ρ) in the newest frame with its covariance, and where it is seen now.
    pub(super) fn add(
        &mut self,
        rig: &StereoRig,
        now_from_newest: &Isometry3<f64>,
        (y, cov): &(Vector3<f64>, Matrix3<f64>),
        seen: &StereoMeasurement,
    ) {
        let (Some(sight), Some(by_turn)) = (
            linearise_sight(rig, now_from_newest, y),
            px_by_turn(&rig.right, &seen.right_px()),
        ) else {
            return;
        };
        let spread: Matrix4<f64> =
            seen.cov_px2() + sight.by_point * cov * sight.by_point.transpose();
        let Some(weight) = spread.try_inverse() else {
            return;
        };
        let deviation = seen.px - sight.px;
        let squared = deviation.dot(&(weight * deviation));
        let weight = weight * (HUBER_SIGMA2 / squared.max(HUBER_SIGMA2)).sqrt();
        let mut by = SMatrix::<f64, 4, UNKNOWNS>::zeros();
        by.fixed_columns_mut::<6>(0).copy_from(&sight.by_motion);
        for (column, axis) in [(6, 0), (7, 2), (OTHERS, YAW)] {
            by.fixed_view_mut::<2, 1>(2, column)
                .copy_from(&by_turn.column(axis));
        }
        let weighted = by.transpose() * weight;
        self.information += weighted * by;
        self.vector += weighted * deviation;
        self.count += 1;
    }

    /// What the yaw deviates by. `None` where landmarks are too few.
    pub(super) fn say(&self) -> Option<Equations> {
        if self.count < LEAST {
            return None;
        }
        let others = self
            .information
            .fixed_view::<OTHERS, OTHERS>(0, 0)
            .into_owned();
        let cross = self
            .information
            .fixed_view::<OTHERS, 1>(0, OTHERS)
            .into_owned();
        let gain = others.cholesky()?.solve(&cross);
        Some(Equations::of_yaw(
            self.information[(OTHERS, OTHERS)] - cross.dot(&gain),
            self.vector[OTHERS] - gain.dot(&self.vector.fixed_rows::<OTHERS>(0)),
        ))
    }
}

/// How much wider steps spread than landmarks' own covariances say, as variances: these leave out what landmarks
/// share, the errors of the frames that they come from. Measured as it goes.
#[derive(Clone, Copy, Debug)]
pub(super) struct Spread {
    factor: f64,
    pairs: f64,
}

/// What is supposed at first, as if measured over so many pairs, and believed at least.
const SUPPOSED_SPREAD: f64 = 10.0;
const SUPPOSED_PAIRS: f64 = 10.0;
const LEAST_SPREAD: f64 = 2.0;
/// Pairs over which it is measured at most.
const MOST_PAIRS: f64 = 100.0;

impl Default for Spread {
    fn default() -> Self {
        Self {
            factor: SUPPOSED_SPREAD,
            pairs: SUPPOSED_PAIRS,
        }
    }
}

impl Spread {
    pub(super) fn factor(&self) -> f64 {
        self.factor.max(LEAST_SPREAD)
    }

    /// Takes note of one more step, squared, over its variance by the landmarks' own covariances.
    pub(super) fn take(&mut self, squared: f64) {
        if !squared.is_finite() {
            return;
        }
        self.pairs = (self.pairs + 1.0).min(MOST_PAIRS);
        self.factor += (squared - self.factor) / self.pairs;
    }
}
