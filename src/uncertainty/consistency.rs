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

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Matrix6, Vector6};
    use proptest::prelude::*;
    use rand::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};
    use rand_xoshiro::Xoshiro256PlusPlus;

    /// A covariance whose elements differ by as much as metres² and radians² do.
    fn lower() -> Matrix6<f64> {
        let sigma = [0.02, 0.01, 0.05, 3e-4, 5e-4, 2e-4];
        Matrix6::from_fn(|i, j| match i.cmp(&j) {
            std::cmp::Ordering::Less => 0.0,
            std::cmp::Ordering::Equal => sigma[i],
            std::cmp::Ordering::Greater => sigma[i] * 0.6 / (1.0 + (i + j) as f64),
        })
    }

    fn sampled_errors(count: usize, seed: u64) -> Vec<Vector6<f64>> {
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
        (0..count)
            .map(|_| lower() * Vector6::from_fn(|_, _| StandardNormal.sample(&mut rng)))
            .collect()
    }

    #[test]
    fn anees_intervals_are_those_that_the_theory_prints() {
        for (runs, low, high) in [
            (50, 0.846, 1.166),
            (100, 0.890, 1.116),
            (300, 0.936, 1.066),
            (1000, 0.965, 1.036),
        ] {
            let (lo, hi) = anees_interval(6, runs, 0.95);
            assert!(
                (lo - low).abs() < 5e-4 && (hi - high).abs() < 5e-4,
                "{runs}: {lo} {hi}"
            );
        }
    }

    #[test]
    fn chi2_quantiles_agree_with_scipy_up_to_a_hundred_million_degrees_of_freedom() {
        for (dof, probability, quantile) in [
            (1.0, 0.025, 0.0009820691171752555),
            (3.0, 0.95, 7.814727903251179),
            (6.0, 0.025, 1.2373442457912027),
            (6.0, 0.95, 12.591587243743977),
            (6.0, 0.975, 14.44937533544792),
            (300.0, 0.025, 253.91232260248975),
            (30_000.0, 0.975, 30_481.982656347922),
            (1e6, 0.025, 997_230.0871432901),
            (1e8, 0.975, 100_027_719.97074424),
        ] {
            let ours = chi2_quantile(probability, dof);
            assert!(
                (ours / quantile - 1.0).abs() < 1e-9,
                "{dof} {probability}: {ours}"
            );
        }
        assert!(chi2_quantile(0.95, 0.0).is_nan() && chi2_quantile(1.0, 6.0).is_nan());
    }

    #[test]
    fn sampled_errors_are_found_consistent_and_scaled_ones_are_not() {
        let cov = lower() * lower().transpose();
        let errors = sampled_errors(1000, 3);
        let anees = |factor: f64| {
            let sum: f64 = errors.iter().filter_map(|e| nees(e, &(cov * factor))).sum();
            sum / (6.0 * errors.len() as f64)
        };
        let (lo, hi) = anees_interval(6, errors.len(), 0.95);
        assert!((lo..hi).contains(&anees(1.0)), "{}", anees(1.0));
        assert!(anees(0.8) > hi && anees(1.25) < lo);
    }

    #[test]
    fn the_ellipsoid_holds_as_many_as_it_says() {
        let cov = lower() * lower().transpose();
        let values: Vec<f64> = sampled_errors(2000, 5)
            .iter()
            .filter_map(|e| nees(e, &cov))
            .collect();
        let (lo, hi) = coverage_interval(values.len(), 0.95);
        assert!((lo..=hi).contains(&coverage(&values, 6, 0.95)));
        assert!((0.93..0.95).contains(&lo) && (0.95..0.97).contains(&hi));
    }

    #[test]
    fn autocorrelation_tells_white_errors_from_a_moving_average() {
        let cov = lower() * lower().transpose();
        let white: Vec<_> = sampled_errors(1001, 7)
            .iter()
            .filter_map(|e| whiten(e, &cov))
            .collect();
        let pairs = |w: &[Vector6<f64>]| w.windows(2).map(|p| (p[0], p[1])).collect::<Vec<_>>();
        let limit = autocorrelation_limit(6 * 1000, 0.95);
        assert!(autocorrelation(&pairs(&white)).abs() < limit);
        // a − b, b − c, …: half of the variance is shared with the opposite sign.
        let shared: Vec<_> = white.windows(2).map(|p| p[0] - p[1]).collect();
        assert!((autocorrelation(&pairs(&shared)) + 0.5).abs() < 0.05);
    }

    #[test]
    fn what_is_no_covariance_is_refused() {
        let error = Vector6::repeat(0.1);
        assert!(nees(&error, &Matrix6::zeros()).is_none());
        assert!(nees(&error, &-Matrix6::identity()).is_none());
        assert!(nees(&error, &Matrix6::repeat(1.0)).is_none());
        assert!(nees(&error, &(Matrix6::identity() * f64::NAN)).is_none());
        let mut lopsided = Matrix6::identity();
        lopsided[(0, 1)] = 0.1;
        assert!(nees(&error, &lopsided).is_none());
        assert!(nees(&(error * f64::NAN), &Matrix6::identity()).is_none());
    }

    proptest! {
        #[test]
        fn nees_does_not_depend_on_the_units(scales in prop::array::uniform6(-6.0..6.0_f64)) {
            let units = Matrix6::from_diagonal(&Vector6::from(scales.map(|s| 10_f64.powf(s))));
            let cov = lower() * lower().transpose();
            let error = sampled_errors(1, 11)[0];
            let plain = nees(&error, &cov).unwrap();
            let rescaled = nees(&(units * error), &(units * cov * units)).unwrap();
            prop_assert!((rescaled / plain - 1.0).abs() < 1e-9);
        }
    }
}
