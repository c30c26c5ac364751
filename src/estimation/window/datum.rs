//! The datum: where the window's oldest keyframe stands in the odometry frame.
//!
//! Its error (right perturbation) is `δ₀ = B x + β + ε`: `x` are the warp and the window's relative
//! poses, counted from where the prior was linearised, `ε` is independent of them and of all that is yet
//! to come. So the past is corrected by what the window learns, and the pose's covariance has every
//! correlation in it.

use super::super::sources::BySources;
use super::memory::{ByUnknowns, Unknowns, UnknownsBySources, carried};
use super::warp::WARP;
use super::{Frame, Joint, row_of};
use crate::geometry::product::product;
use crate::geometry::se3;
use nalgebra::{Isometry3, Matrix6, SMatrix, Vector6};

/// A pose with an error that is partly the window's.
#[derive(Clone, Debug)]
pub(super) struct Datum {
    odom_from_linearised: Isometry3<f64>,
    /// `B`, 6 rows; columns for the warp and the frames that the prior knows.
    by_window: ByUnknowns,
    /// How many these are.
    known: usize,
    /// `β`.
    offset: Vector6<f64>,
    /// Covariance of `ε`.
    cov: Matrix6<f64>,
    /// By how much `β` moves with each source of error.
    by_sources: BySources,
}

impl Datum {
    pub(super) fn new(
        odom_from_datum: &Isometry3<f64>,
        cov: &Matrix6<f64>,
        by_sources: &BySources,
    ) -> Self {
        Self {
            odom_from_linearised: *odom_from_datum,
            by_window: ByUnknowns::zeros(),
            known: WARP,
            offset: Vector6::zeros(),
            cov: *cov,
            by_sources: *by_sources,
        }
    }

    /// The pose at the window's offsets `x`.
    pub(super) fn pose(&self, x: &Unknowns) -> Isometry3<f64> {
        let mut by_window = Vector6::zeros();
        for (column, x) in self.by_window.column_iter().zip(x).take(self.known) {
            by_window += column * *x;
        }
        se3::renormalised(self.odom_from_linearised * se3::exp(&(by_window + self.offset)))
    }

    /// The covariance (right perturbation) of the pose of the last frame in the window, which
    /// stands at `datum_from_last`; `cov_window` is the joint covariance of the warp and all
    /// poses but the datum's.
    pub(super) fn covariance_of(
        &self,
        datum_from_last: &Isometry3<f64>,
        cov_window: &Joint,
    ) -> Matrix6<f64> {
        let by_window = self.last_by_window(datum_from_last, cov_window.nrows());
        let carry = se3::adjoint(&datum_from_last.inverse());
        carried(&by_window, cov_window) + carry * self.cov * carry.transpose()
    }

    /// Adds to the covariance of the datum's pose, in what is independent of the window.
    pub(super) fn add(&mut self, cov: &Matrix6<f64>) {
        self.cov += cov;
    }

    /// The derivative of the same pose by each source of error, given that of the `n` unknowns
    /// of the warp and all poses but the datum's.
    pub(super) fn sensitivity_of(
        &self,
        datum_from_last: &Isometry3<f64>,
        n: usize,
        window_by_sources: &UnknownsBySources,
    ) -> BySources {
        let by_window = self.last_by_window(datum_from_last, n);
        let carry = se3::adjoint(&datum_from_last.inverse());
        product(&carry, &self.by_sources) + product(&by_window, window_by_sources)
    }

    /// The derivative of the pose of the last frame by the window, which has `n` unknowns.
    fn last_by_window(&self, datum_from_last: &Isometry3<f64>, n: usize) -> ByUnknowns {
        let carry = se3::adjoint(&datum_from_last.inverse());
        let mut by_window = ByUnknowns::zeros();
        for i in 0..self.known.min(n) {
            by_window.set_column(i, &(carry * self.by_window.column(i)));
        }
        if n >= WARP + 6 {
            let mut own = by_window.fixed_columns_mut::<6>(n - 6);
            own += Matrix6::<f64>::identity();
        }
        by_window
    }

    /// Moves the datum on to frame 1, whose error `x₁` is given by the others' as
    /// `x₁ = mean + by_rest · x' + η`, η with covariance `cov_first`, where
    /// `xᵢ = x'ᵢ + moved(i) · x₁` for the frames i > 1.
    pub(super) fn advance(
        &mut self,
        frames: &[Frame],
        moved: &[Matrix6<f64>],
        mean: &Vector6<f64>,
        mean_by_sources: &BySources,
        by_rest: &ByUnknowns,
        cov_first: &Matrix6<f64>,
    ) {
        let linearised = *frames[1].datum_from_linearised();
        let carry = se3::adjoint(&linearised.inverse());
        let block = |at: usize| -> Matrix6<f64> {
            product(&carry, &self.by_window.fixed_columns::<6>(at).into_owned())
        };
        // By x₁, itself included, through all that moved with it.
        let mut by_first = Matrix6::identity();
        let mut by_window = ByUnknowns::zeros();
        let by_warp: SMatrix<f64, 6, WARP> = self.by_window.fixed_columns::<WARP>(0).into_owned();
        by_window
            .fixed_columns_mut::<WARP>(0)
            .copy_from(&product(&carry, &by_warp));
        if self.known > WARP {
            by_first += block(WARP);
            for (i, along) in moved.iter().enumerate() {
                let at = row_of(i + 2);
                if at < self.known {
                    let block = block(at);
                    by_first += product(&block, along);
                    by_window
                        .fixed_columns_mut::<6>(row_of(i + 1))
                        .copy_from(&block);
                }
            }
        }
        by_window += product(&by_first, by_rest);
        self.odom_from_linearised = se3::renormalised(self.odom_from_linearised * linearised);
        self.offset = by_first * mean + carry * self.offset;
        self.by_sources = by_first * mean_by_sources + carry * self.by_sources;
        self.cov = se3::symmetric(
            &(by_first * cov_first * by_first.transpose() + carry * self.cov * carry.transpose()),
        );
        self.by_window = by_window;
        self.known = row_of(frames.len() - 1);
    }
}
