//! Consistency: errors and the covariances that claim to cover them in, a verdict with its χ²
//! interval out.
//!
//! The normalised estimation error squared (NEES) of an honest estimate with n degrees of freedom
//! is χ²-distributed with n degrees of freedom. Its average over N independent runs, divided by n
//! (ANEES), is 1 on average: larger is overconfident, smaller is pessimistic. Bar-Shalom, Li,
//! Kirubarajan, *Estimation with Applications to Tracking and Navigation*, §5.4.

use nalgebra::{Cholesky, SMatrix, SVector};
use statrs::distribution::{Binomial, ChiSquared, ContinuousCDF, DiscreteCDF, Normal};

/// The share of a variance that elimination must leave of it: below is rounding, not information.
const SMALLEST_PIVOT: f64 = 1e-13;

/// The error in units of its own covariance, `L⁻¹ e` with `cov = L Lᵀ`: unit variance and no
/// correlation between its elements if the covariance is right.
///
/// `None` where `cov` is not a symmetric positive definite matrix of finite numbers.
#[must_use]
pub fn whiten<const N: usize>(
    error: &SVector<f64, N>,
    cov: &SMatrix<f64, N, N>,
) -> Option<SVector<f64, N>> {
    if !error.iter().chain(cov.iter()).all(|x| x.is_finite()) || !is_symmetric(cov) {
        return None;
    }
    let lower = Cholesky::new(*cov)?.unpack();
    let is_definite = (0..N).all(|i| lower[(i, i)] * lower[(i, i)] > SMALLEST_PIVOT * cov[(i, i)]);
    if !is_definite {
        return None;
    }
    lower.solve_lower_triangular(error)
}

/// The normalised estimation error squared, `eᵀ cov⁻¹ e`.
///
/// `None` where `cov` is not a symmetric positive definite matrix of finite numbers.
#[must_use]
pub fn nees<const N: usize>(error: &SVector<f64, N>, cov: &SMatrix<f64, N, N>) -> Option<f64> {
    whiten(error, cov).map(|w| w.norm_squared())
}

/// The value below which a χ² variable of `dof` degrees of freedom lies with probability
/// `probability`. Not a number unless `dof` > 0 and 0 < `probability` < 1.
#[must_use]
pub fn chi2_quantile(probability: f64, dof: f64) -> f64 {
    match ChiSquared::new(dof) {
        Ok(chi2) if probability > 0.0 && probability < 1.0 => chi2.inverse_cdf(probability),
        _ => f64::NAN,
    }
}

/// Where the ANEES of `n_runs` independent errors of `n_dof` degrees of freedom lies with
/// probability `level`, two-sided, if the covariances are right: χ²(n N) / (n N).
#[must_use]
pub fn anees_interval(n_dof: usize, n_runs: usize, level: f64) -> (f64, f64) {
    let total = n_dof as f64 * n_runs as f64;
    let tail = 0.5 * (1.0 - level);
    (
        chi2_quantile(tail, total) / total,
        chi2_quantile(1.0 - tail, total) / total,
    )
}

/// The share of `nees` inside the `level` ellipsoid of `n_dof` degrees of freedom. Not a number
/// for no values.
#[must_use]
pub fn coverage(nees: &[f64], n_dof: usize, level: f64) -> f64 {
    let limit = chi2_quantile(level, n_dof as f64);
    nees.iter().filter(|&&e| e <= limit).count() as f64 / nees.len() as f64
}

/// Where the coverage of the `level` ellipsoid, counted over `n_runs` independent errors, lies
/// with probability `level` if the covariances are right. Not numbers for no runs.
#[must_use]
pub fn coverage_interval(n_runs: usize, level: f64) -> (f64, f64) {
    let tail = 0.5 * (1.0 - level);
    match Binomial::new(level, n_runs as u64) {
        Ok(count) if n_runs > 0 && tail > 0.0 && tail < 0.5 => {
            let share = |p: f64| count.inverse_cdf(p) as f64 / n_runs as f64;
            (share(tail), share(1.0 - tail))
        }
        _ => (f64::NAN, f64::NAN),
    }
}

/// How much neighbours in time have in common: `Σ a·b / ½ Σ (a² + b²)` over pairs of whitened
/// errors, from −1 to 1, near 0 for errors that are independent from one time to the next.
///
/// `pairs` holds an error and its successor; a gap in time simply gives no pair.
#[must_use]
pub fn autocorrelation<const N: usize>(pairs: &[(SVector<f64, N>, SVector<f64, N>)]) -> f64 {
    let product: f64 = pairs.iter().map(|(a, b)| a.dot(b)).sum();
    let energy: f64 = pairs
        .iter()
        .map(|(a, b)| 0.5 * (a.norm_squared() + b.norm_squared()))
        .sum();
    product / energy
}

/// The half width of the interval about 0 in which [`autocorrelation`] lies with probability
/// `level` if `n_products` products of independent elements were summed (first order).
#[must_use]
pub fn autocorrelation_limit(n_products: usize, level: f64) -> f64 {
    Normal::standard().inverse_cdf(0.5 + 0.5 * level) / (n_products as f64).sqrt()
}

/// Whether opposite elements agree up to rounding.
fn is_symmetric<const N: usize>(m: &SMatrix<f64, N, N>) -> bool {
    (0..N).all(|i| {
        (0..i).all(|j| {
            let scale = (m[(i, i)].abs() * m[(j, j)].abs()).sqrt();
            (m[(i, j)] - m[(j, i)]).abs() <= 1e-9 * scale
        })
    })
}
