//! Memory of matrices, kept from frame to frame: a window's equations differ in size as frames come
//! and go, but never grow beyond those of all frames that it may hold.

use super::super::sources::SOURCES;
use super::MAX_UNKNOWNS;
use nalgebra::{DMatrix, DVector, Matrix6, SMatrix, SVector, Vector6};

/// A number for each unknown, zero beyond those that there are.
pub(super) type Unknowns = SVector<f64, MAX_UNKNOWNS>;

/// Six rows (a pose's), a column for each unknown, zero beyond those that there are.
pub(super) type ByUnknowns = SMatrix<f64, 6, MAX_UNKNOWNS>;

/// The derivative of each unknown by each source of error, zero beyond those that there are.
pub(super) type UnknownsBySources = SMatrix<f64, MAX_UNKNOWNS, SOURCES>;

/// Matrices that nobody needs at present.
#[derive(Clone, Debug, Default)]
pub(super) struct Memory(Vec<Vec<f64>>);

/// More than an adjustment or a marginalisation uses at once.
const STOCK: usize = 10;

impl Memory {
    /// With matrices enough that none has to be made on the way.
    pub(super) fn stocked() -> Self {
        Self((0..STOCK).map(|_| room()).collect())
    }

    /// A square matrix of zeros.
    pub(super) fn square(&mut self, n: usize) -> DMatrix<f64> {
        DMatrix::from_vec(n, n, self.zeros(n * n))
    }

    /// A vector of zeros.
    pub(super) fn vector(&mut self, n: usize) -> DVector<f64> {
        DVector::from_vec(self.zeros(n))
    }

    /// Takes back what [`square`](Self::square) gave.
    pub(super) fn recycle(&mut self, matrix: DMatrix<f64>) {
        self.0.push(matrix.data.into());
    }

    /// Takes back what [`vector`](Self::vector) gave.
    pub(super) fn recycle_vector(&mut self, vector: DVector<f64>) {
        self.0.push(vector.data.into());
    }

    fn zeros(&mut self, len: usize) -> Vec<f64> {
        let mut values = self.0.pop().unwrap_or_else(room);
        values.clear();
        values.resize(len, 0.0);
        values
    }
}

fn room() -> Vec<f64> {
    Vec::with_capacity(MAX_UNKNOWNS * MAX_UNKNOWNS)
}

/// `by · cov · byᵀ`, for the unknowns that `cov` has.
pub(super) fn carried(by: &ByUnknowns, cov: &DMatrix<f64>) -> Matrix6<f64> {
    let mut out = Matrix6::zeros();
    for j in 0..cov.ncols() {
        let mut column = Vector6::zeros();
        for k in 0..cov.nrows() {
            column += by.column(k) * cov[(k, j)];
        }
        for c in 0..6 {
            let factor = by[(c, j)];
            for r in 0..6 {
                out[(r, c)] += column[r] * factor;
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn covariances_are_carried_as_the_library_does() {
        let by = ByUnknowns::from_fn(|i, j| ((7 * i + 3 * j) % 11) as f64 - 5.0);
        let root = DMatrix::from_fn(19, 19, |i, j| ((5 * i + 2 * j) % 13) as f64 - 6.0);
        let cov = &root * root.transpose();
        let known = by.columns(0, 19);
        let expected = known * &cov * known.transpose();
        assert!((carried(&by, &cov) - expected).norm() < 1e-12 * expected.norm());
    }

    #[test]
    fn what_was_given_back_is_zero_again_when_it_returns() {
        let mut memory = Memory::default();
        let mut matrix = memory.square(9);
        matrix.fill(2.0);
        memory.recycle(matrix);
        assert_eq!(memory.vector(81), DVector::zeros(81));
    }
}
