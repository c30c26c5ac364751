//! The prior: what frames that left the window said about those that are still in it.
//!
//! A Gaussian in information form over the right perturbations `x` of the poses of frames 1 … m
//! (relative to the datum, frame 0), each counted from where the prior was linearised:
//! cost `½ xᵀ H x − bᵀ x`.

use super::Frame;
use crate::geometry::se3;
use nalgebra::{DMatrix, DVector, Isometry3};

/// What is known before the window's own measurements.
#[derive(Clone, Debug)]
pub(super) struct Prior {
    pub(super) information: DMatrix<f64>,
    pub(super) vector: DVector<f64>,
}

impl Default for Prior {
    fn default() -> Self {
        Self {
            information: DMatrix::zeros(0, 0),
            vector: DVector::zeros(0),
        }
    }
}

impl Prior {
    /// How far the poses of frames 1 … stand from where they were linearised; zero for those that
    /// the prior does not know.
    pub(super) fn offsets(&self, frames: &[Frame]) -> DVector<f64> {
        let mut x = DVector::zeros(6 * frames.len().saturating_sub(1));
        for (i, frame) in frames.iter().enumerate().skip(1) {
            if let Some(linearised) = &frame.linearised {
                let offset: Isometry3<f64> = linearised.inverse() * frame.datum_from_frame;
                x.fixed_rows_mut::<6>(6 * (i - 1)).copy_from(&se3::log(&offset));
            }
        }
        x
    }

    /// Adds the prior to equations that are linearised at the current poses. Returns its cost.
    pub(super) fn add_to(
        &self,
        frames: &[Frame],
        hessian: &mut DMatrix<f64>,
        gradient: &mut DVector<f64>,
    ) -> f64 {
        let m = self.vector.len();
        if m == 0 {
            return 0.0;
        }
        let x = self.offsets(frames).rows(0, m).into_owned();
        let by_x = &self.information * &x;
        let mut top = hessian.view_mut((0, 0), (m, m));
        top += &self.information;
        let mut head = gradient.rows_mut(0, m);
        head += &self.vector - &by_x;
        0.5 * x.dot(&by_x) - self.vector.dot(&x)
    }
}
