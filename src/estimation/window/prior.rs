//! The prior: what frames that left the window said about those that are still in it.
//!
//! A Gaussian in information form over the warp and the right perturbations of
//! the poses of frames 1 … m (relative to the datum, frame 0), together `x`, each counted from
//! where the prior was linearised: cost `½ xᵀ H x − bᵀ x`.

use super::super::sources::{SOURCES, WARP_COLUMNS};
use super::memory::{Unknowns, UnknownsBySources};
use super::warp::{WARP, Warp};
use super::{Frame, row_of};
use crate::geometry::se3;
use nalgebra::{DMatrix, DVector, Isometry3, SMatrix};

/// What is known before the window's own measurements.
#[derive(Clone, Debug)]
pub(super) struct Prior {
    pub(super) information: DMatrix<f64>,
    pub(super) vector: DVector<f64>,
    /// By how much the vector moves with each source of error.
    pub(super) by_sources: UnknownsBySources,
}

impl Prior {
    /// Nothing is known but the warp, which is as given, with a covariance.
    pub(super) fn new(warp: &Warp, cov: &SMatrix<f64, WARP, WARP>) -> Self {
        let information = cov
            .cholesky()
            .map_or_else(SMatrix::identity, |c| c.inverse());
        let mut prior = Self {
            information: DMatrix::zeros(WARP, WARP),
            vector: DVector::zeros(WARP),
            by_sources: UnknownsBySources::zeros(),
        };
        prior.information.copy_from(&information);
        prior.vector.copy_from(&(information * warp.coefficients));
        if let Some(factor) = cov.cholesky() {
            let by_own = information * factor.l();
            prior
                .by_sources
                .fixed_view_mut::<WARP, WARP>(0, WARP_COLUMNS)
                .copy_from(&by_own);
        }
        prior
    }

    /// The same, the warp's error being known by source.
    pub(super) fn learnt(
        warp: &Warp,
        cov: &SMatrix<f64, WARP, WARP>,
        warp_by_sources: &SMatrix<f64, WARP, SOURCES>,
    ) -> Self {
        let mut prior = Self::new(warp, cov);
        let information = prior.information.fixed_view::<WARP, WARP>(0, 0);
        prior.by_sources.fill(0.0);
        prior
            .by_sources
            .fixed_rows_mut::<WARP>(0)
            .copy_from(&(information * warp_by_sources));
        prior
    }

    /// The warp, and how far the poses of frames 1 … stand from where they were
    /// linearised; zero for those that the prior does not know.
    pub(super) fn offsets(&self, warp: &Warp, frames: &[Frame]) -> Unknowns {
        let mut x = Unknowns::zeros();
        x.fixed_rows_mut::<WARP>(0).copy_from(&warp.coefficients);
        for (i, frame) in frames.iter().enumerate().skip(1) {
            if let Some(linearised) = &frame.linearised {
                let offset: Isometry3<f64> = linearised.inverse() * frame.datum_from_frame;
                x.fixed_rows_mut::<6>(row_of(i))
                    .copy_from(&se3::log(&offset));
            }
        }
        x
    }

    /// Adds the prior to equations that are linearised at the current poses. Returns its cost.
    pub(super) fn add_to(
        &self,
        warp: &Warp,
        frames: &[Frame],
        hessian: &mut DMatrix<f64>,
        gradient: &mut DVector<f64>,
    ) -> f64 {
        let m = self.vector.len();
        let x = self.offsets(warp, frames);
        let mut by_x = Unknowns::zeros();
        for (j, column) in self.information.column_iter().enumerate() {
            by_x.rows_mut(0, m).axpy(x[j], &column, 1.0);
        }
        let mut top = hessian.view_mut((0, 0), (m, m));
        top += &self.information;
        let mut head = gradient.rows_mut(0, m);
        head += &self.vector;
        head -= by_x.rows(0, m);
        0.5 * x.dot(&by_x) - self.vector.dot(&x.rows(0, m))
    }
}
