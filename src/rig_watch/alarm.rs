//! Deviations of one pair after the other in; how far they are, together, from chance, out.
//!
//! A blow is seen at once where it is strong, and only in the sum of many pairs where it is weak; so sums
//! are kept that forget within different times. A sum of equations `g = Σ λᵏ gₖ` has the covariance
//! `Σ λ²ᵏ Nₖ` by noise, and `A P Aᵀ` with `A = Σ λᵏ Nₖ` by what is not known of the state.

use super::filter::{Equations, Filter, UNKNOWNS};
use nalgebra::{SMatrix, SVector};

/// Sums at most.
const MOST: usize = 4;

/// Sums of the deviations of `D` unknowns.
#[derive(Clone, Debug)]
pub(super) struct Alarm<const D: usize> {
    /// The first of them.
    first: usize,
    sums: [Sum<D>; MOST],
    count: usize,
}

#[derive(Clone, Copy, Debug)]
struct Sum<const D: usize> {
    keeps: f64,
    vector: SVector<f64, D>,
    noise: SMatrix<f64, D, D>,
    by_state: SMatrix<f64, D, UNKNOWNS>,
}

impl<const D: usize> Sum<D> {
    /// One that forgets within so many pairs.
    fn new(pairs: f64) -> Self {
        Self {
            keeps: 1.0 - 1.0 / pairs,
            vector: SVector::zeros(),
            noise: SMatrix::zeros(),
            by_state: SMatrix::zeros(),
        }
    }

    fn add(&mut self, said: &Equations, first: usize) {
        let rows = said.information.fixed_rows::<D>(first);
        self.vector = self.vector * self.keeps + said.vector.fixed_rows::<D>(first);
        self.noise = self.noise * (self.keeps * self.keeps) + rows.fixed_columns::<D>(first);
        self.by_state = self.by_state * self.keeps + rows;
    }

    fn nis(&self, filter: &Filter) -> f64 {
        let cov = self.noise + self.by_state * filter.cov * self.by_state.transpose();
        cov.cholesky()
            .map_or(0.0, |c| self.vector.dot(&c.solve(&self.vector)))
    }
}

impl<const D: usize> Alarm<D> {
    /// Sums of the unknowns from `first` on, that forget within so many pairs each; four at most.
    pub(super) fn new(first: usize, pairs: &[f64]) -> Self {
        let mut sums = [Sum::new(1.0); MOST];
        for (sum, pairs) in sums.iter_mut().zip(pairs) {
            *sum = Sum::new(*pairs);
        }
        Self {
            first,
            sums,
            count: pairs.len().min(MOST),
        }
    }

    /// Adds what a pair says; the greatest of the sums' squared deviations, each χ² with `D` degrees of
    /// freedom by chance.
    pub(super) fn add(&mut self, said: &Equations, filter: &Filter) -> f64 {
        let first = self.first;
        let sums = self.sums[..self.count].iter_mut();
        sums.map(|sum| {
            sum.add(said, first);
            sum.nis(filter)
        })
        .fold(0.0, f64::max)
    }

    /// Forgets all.
    pub(super) fn clear(&mut self) {
        for sum in &mut self.sums {
            sum.vector.fill(0.0);
            sum.noise.fill(0.0);
            sum.by_state.fill(0.0);
        }
    }
}
