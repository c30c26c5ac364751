//! Products of small matrices with all loops unrolled.
//!
//! The general routine behind `*` walks strides that it learns at run time; at the sizes of one
//! track's normal equations that is most of the time.

use nalgebra::SMatrix;

/// `a b`.
#[inline(always)]
pub(crate) fn product<const R: usize, const K: usize, const C: usize>(
    a: &SMatrix<f64, R, K>,
    b: &SMatrix<f64, K, C>,
) -> SMatrix<f64, R, C> {
    let mut out = SMatrix::<f64, R, C>::zeros();
    for c in 0..C {
        for k in 0..K {
            let factor = b.data.0[c][k];
            for r in 0..R {
                out.data.0[c][r] += a.data.0[k][r] * factor;
            }
        }
    }
    out
}

/// `a bᵀ`.
#[inline(always)]
pub(crate) fn product_transposed<const R: usize, const K: usize, const C: usize>(
    a: &SMatrix<f64, R, K>,
    b: &SMatrix<f64, C, K>,
) -> SMatrix<f64, R, C> {
    let mut out = SMatrix::<f64, R, C>::zeros();
    for k in 0..K {
        for c in 0..C {
            let factor = b.data.0[k][c];
            for r in 0..R {
                out.data.0[c][r] += a.data.0[k][r] * factor;
            }
        }
    }
    out
}

/// `aᵀ b`.
#[inline(always)]
pub(crate) fn transposed_product<const R: usize, const K: usize, const C: usize>(
    a: &SMatrix<f64, K, R>,
    b: &SMatrix<f64, K, C>,
) -> SMatrix<f64, R, C> {
    let mut out = SMatrix::<f64, R, C>::zeros();
    for c in 0..C {
        for k in 0..K {
            let factor = b.data.0[c][k];
            for r in 0..R {
                out.data.0[c][r] += a.data.0[r][k] * factor;
            }
        }
    }
    out
}

/// `aᵀ diag(d)`.
#[inline(always)]
pub(crate) fn transposed_scaled<const R: usize, const C: usize>(
    a: &SMatrix<f64, R, C>,
    d: &SMatrix<f64, R, 1>,
) -> SMatrix<f64, C, R> {
    let mut out = SMatrix::<f64, C, R>::zeros();
    for c in 0..C {
        for r in 0..R {
            out.data.0[r][c] = a.data.0[c][r] * d.data.0[0][r];
        }
    }
    out
}

/// Takes `a bᵀ` off `out`.
#[inline(always)]
pub(crate) fn subtract_product_transposed<const R: usize, const K: usize, const C: usize>(
    out: &mut SMatrix<f64, R, C>,
    a: &SMatrix<f64, R, K>,
    b: &SMatrix<f64, C, K>,
) {
    for c in 0..C {
        for r in 0..R {
            let mut sum = 0.0;
            for k in 0..K {
                sum += a.data.0[k][r] * b.data.0[k][c];
            }
            out.data.0[c][r] -= sum;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn products_are_those_of_the_library(values in prop::array::uniform32(-1.0..1.0_f64)) {
            let a = SMatrix::<f64, 6, 4>::from_fn(|i, j| values[4 * i + j]);
            let b = SMatrix::<f64, 4, 3>::from_fn(|i, j| values[31 - 4 * j - i]);
            let d = SMatrix::<f64, 6, 1>::from_fn(|i, _| values[i]);
            prop_assert!((product(&a, &b) - a * b).norm() < 1e-14);
            prop_assert!((product_transposed(&a, &b.transpose()) - a * b).norm() < 1e-14);
            prop_assert!((transposed_product(&a.transpose(), &b) - a * b).norm() < 1e-14);
            let mut left = SMatrix::<f64, 6, 3>::repeat(0.25);
            subtract_product_transposed(&mut left, &a, &b.transpose());
            prop_assert!((left - (SMatrix::<f64, 6, 3>::repeat(0.25) - a * b)).norm() < 1e-14);
            prop_assert_eq!(transposed_scaled(&a, &d), a.transpose() * SMatrix::<f64, 6, 6>::from_diagonal(&d));
        }
    }
}
