//! Inverses of symmetric positive definite matrices, in half or a third of the general routine's work.
//!
//! With `A = L Lᵀ` and `uₖ` the rows of `L⁻¹`, `A⁻¹ = Σ uₖ uₖᵀ`: row `k` has `k + 1` numbers that are not
//! zero, so that neither step touches what is known to be nothing, and both run along memory.

use super::product::product_transposed;
use crate::simd::widened;
use nalgebra::{DMatrix, SMatrix};

/// The inverse of a small matrix, all loops unrolled; `None` if it is not positive definite.
#[inline(always)]
pub(crate) fn inverse<const N: usize>(matrix: &SMatrix<f64, N, N>) -> Option<SMatrix<f64, N, N>> {
    let mut lower = *matrix;
    for j in 0..N {
        let pivot = lower.data.0[j][j];
        // A NaN is not positive either.
        if pivot.is_nan() || pivot <= 0.0 {
            return None;
        }
        let scale = 1.0 / pivot.sqrt();
        for i in j..N {
            lower.data.0[j][i] *= scale;
        }
        for c in j + 1..N {
            let factor = lower.data.0[j][c];
            for i in c..N {
                lower.data.0[c][i] -= factor * lower.data.0[j][i];
            }
        }
    }
    let mut rows = SMatrix::<f64, N, N>::zeros();
    for k in 0..N {
        let scale = 1.0 / lower.data.0[k][k];
        for j in 0..k {
            let factor = lower.data.0[j][k] * scale;
            for i in 0..=j {
                rows.data.0[k][i] -= factor * rows.data.0[j][i];
            }
        }
        rows.data.0[k][k] = scale;
    }
    Some(product_transposed(&rows, &rows))
}

widened! {
    /// Leaves `(L Lᵀ)⁻¹` in `inverse`, `L` being the lower triangle of `lower`; `room` is working memory of
    /// the same shape, of zeros, as `inverse` is.
    pub(crate) fn inverse_from_factor = inverse_from_factor_in,
        (lower: &DMatrix<f64>, room: &mut DMatrix<f64>, inverse: &mut DMatrix<f64>)
}

#[inline(always)]
fn inverse_from_factor_in(
    lower: &DMatrix<f64>,
    room: &mut DMatrix<f64>,
    inverse: &mut DMatrix<f64>,
) {
    let n = lower.nrows();
    // Column k of `rows` is row k of L⁻¹.
    let (lower, rows, inverse) = (
        lower.as_slice(),
        room.as_mut_slice(),
        inverse.as_mut_slice(),
    );
    for k in 0..n {
        let (before, row) = rows.split_at_mut(k * n);
        let row = &mut row[..n];
        let scale = 1.0 / lower[k * n + k];
        for j in 0..k {
            let factor = lower[j * n + k] * scale;
            for (out, of_j) in row[..=j].iter_mut().zip(&before[j * n..]) {
                *out -= factor * of_j;
            }
        }
        row[k] = scale;
        for j in 0..=k {
            let factor = row[j];
            for (out, of_row) in inverse[j * n..][..=j].iter_mut().zip(&*row) {
                *out += factor * of_row;
            }
        }
    }
    for j in 0..n {
        for i in 0..j {
            inverse[i * n + j] = inverse[j * n + i];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn inverses_are_those_of_the_library(values in prop::collection::vec(-1.0..1.0_f64, 25)) {
            let root = SMatrix::<f64, 5, 5>::from_column_slice(&values);
            let matrix = root * root.transpose() + SMatrix::identity() * 0.01;
            let expected = matrix.cholesky().expect("definite").inverse();
            let found = inverse(&matrix).expect("definite");
            prop_assert!((found - expected).norm() < 1e-11 * expected.norm());
        }

        #[test]
        fn large_inverses_are_those_of_the_library(n in 1..40_usize, seed in 0..1000_u32) {
            let entry = |i: usize, j: usize| f64::from((seed + 31 * i as u32 + 17 * j as u32) % 23) - 11.0;
            let root = DMatrix::from_fn(n, n, entry);
            let matrix = &root * root.transpose() + DMatrix::identity(n, n);
            let factor = matrix.cholesky().expect("definite");
            let expected = factor.inverse();
            let mut found = DMatrix::zeros(n, n);
            inverse_from_factor(factor.l_dirty(), &mut DMatrix::zeros(n, n), &mut found);
            prop_assert!((&found - &expected).norm() < 1e-10 * expected.norm());
            prop_assert_eq!(&found, &found.transpose());
        }
    }

    #[test]
    fn what_is_not_definite_has_none() {
        assert_eq!(
            inverse(&SMatrix::<f64, 2, 2>::new(1.0, 2.0, 2.0, 1.0)),
            None
        );
        assert_eq!(inverse(&SMatrix::<f64, 2, 2>::zeros()), None);
        assert_eq!(inverse(&SMatrix::<f64, 2, 2>::repeat(f64::NAN)), None);
    }
}
