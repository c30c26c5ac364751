//! The views' equations and misses in, the covariance of the rig's parameters out.
//!
//! Of an M-estimate (Huber, *Robust Statistics*, §7.6) the covariance is `E ψ² / (E ψ′)² · A⁻¹`, A the information of
//! all points with unit weight: the misses themselves say how noisy the points are. That counts points as
//! independent. Points of one view are not quite (the board is bent, the light falls from one side): how much more
//! the views' demands differ than their points' noise explains is measured, and where it is significant the
//! covariance grows by that factor.

use super::Board;
use super::adjustment::{scaled, total};
use super::normal::{Loss, Reduced};
use crate::geometry::StereoRig;
use crate::geometry::rig_parameters::{EXTRINSICS, RIG_PARAMETERS, RigCovariance};
use crate::uncertainty::consistency::chi2_quantile;
use nalgebra::{DMatrix, DVector, Vector2};

/// A direction of the scaled parameters with less than this share of information is not determined.
const LEAST_INFORMATION: f64 = 1e-13;
/// The views' disagreement counts when chance alone would show as much in fewer than this share of calibrations.
const SIGNIFICANCE: f64 = 0.01;

/// What the misses say.
#[derive(Clone, Debug)]
pub(super) struct Spread {
    /// The covariance of the rig's parameters.
    pub covariance: RigCovariance,
    /// 1 σ of a point's coordinate, px.
    pub sigma_px: f64,
    /// The variance by which views differ over that which their points' noise explains; 1 is par.
    pub between_views: f64,
    /// Whether the covariance was multiplied by it.
    pub is_inflated: bool,
}

/// Which parameters the views leave undetermined, by their slots, the most affected first.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Undetermined(pub Vec<usize>);

/// `reduced`: information with full weights, scores by the loss; `lengths_px`: of all misses.
pub(super) fn covariance(
    rig: &StereoRig,
    board: &Board,
    free: &[usize],
    reduced: &[Reduced],
    lengths_px: &[f64],
    loss: Loss,
) -> Result<Spread, Undetermined> {
    let (information, _) = total(reduced);
    let inverse = inverse(&information, free)?;
    let spread = Noise::of(lengths_px, loss, free.len() + 6 * reduced.len());
    let (squares, dof) = disagreement(reduced, free, &inverse);
    let between_views = squares / (dof * spread.var_psi_px2);
    let is_inflated = between_views > chi2_quantile(1.0 - SIGNIFICANCE, dof) / dof;
    let scale = spread.var_px2 * if is_inflated { between_views } else { 1.0 };
    let mut covariance = RigCovariance::zeros();
    for (i, &a) in free.iter().enumerate() {
        for (j, &b) in free.iter().enumerate() {
            covariance[(a, b)] = 0.5 * scale * (inverse[(i, j)] + inverse[(j, i)]);
        }
    }
    // Images do not change when the board and all distances grow together.
    let relative = board.sigma_square_m / board.square_m;
    let translation = rig.right_from_left.translation.vector * relative;
    let mut block = covariance.fixed_view_mut::<3, 3>(EXTRINSICS, EXTRINSICS);
    block += translation * translation.transpose();
    Ok(Spread {
        covariance,
        sigma_px: spread.var_px2.sqrt(),
        between_views,
        is_inflated,
    })
}

/// Σ gᵥᵀ A⁻¹ gᵥ over views, gᵥ what is left of their demands at the solution. Of independent points' noise with
/// variance 1 it is on average `p − Σ tr (A⁻¹ Hᵥ)²`, which comes along.
fn disagreement(reduced: &[Reduced], free: &[usize], inverse: &DMatrix<f64>) -> (f64, f64) {
    let (mut squares, mut dof) = (0.0, free.len() as f64);
    for view in reduced {
        let score = DVector::from_iterator(free.len(), free.iter().map(|&i| view.score[i]));
        let information = DMatrix::from_fn(free.len(), free.len(), |i, j| {
            view.information[(free[i], free[j])]
        });
        squares += score.dot(&(inverse * &score));
        let share = inverse * information;
        dof -= share.component_mul(&share.transpose()).sum();
    }
    (squares, dof)
}

/// The noise of a point's coordinate.
struct Noise {
    /// Its variance as far as the covariance of the estimate wants it, px².
    var_px2: f64,
    /// The variance of the demand that a miss makes, px².
    var_psi_px2: f64,
}

impl Noise {
    fn of(lengths_px: &[f64], loss: Loss, parameters: usize) -> Self {
        let coordinates = 2 * lengths_px.len();
        let dof = coordinates.saturating_sub(parameters).max(1) as f64;
        let psi = |length: &f64| length.min(loss.threshold_px);
        let var_psi_px2 = lengths_px.iter().map(|l| psi(l).powi(2)).sum::<f64>() / dof;
        // Of the two directions of a miss, ψ grows along it only below the threshold, across it by ψ/r.
        let slope = |length: &f64| match *length {
            l if l <= loss.threshold_px => 1.0,
            l => 0.5 * loss.threshold_px / l,
        };
        let mean_slope = lengths_px.iter().map(slope).sum::<f64>() / lengths_px.len().max(1) as f64;
        Self {
            var_px2: var_psi_px2 / (mean_slope * mean_slope),
            var_psi_px2,
        }
    }
}

fn inverse(
    information: &super::normal::RigMatrix,
    free: &[usize],
) -> Result<DMatrix<f64>, Undetermined> {
    let Some((matrix, scale)) = scaled(information, free) else {
        let without = |slot: &&usize| {
            let own = information[(**slot, **slot)];
            !(own.is_finite() && own > 0.0)
        };
        return Err(Undetermined(free.iter().filter(without).copied().collect()));
    };
    let eigen = matrix.clone().symmetric_eigen();
    let least = eigen.eigenvalues.imin();
    if eigen.eigenvalues[least].is_nan() || eigen.eigenvalues[least] < LEAST_INFORMATION {
        let direction = eigen.eigenvectors.column(least);
        let mut order: Vec<usize> = (0..free.len()).collect();
        order.sort_by(|&a, &b| direction[b].abs().total_cmp(&direction[a].abs()));
        let most = direction.amax();
        let affected = order
            .into_iter()
            .filter(|&i| direction[i].abs() > 0.3 * most);
        return Err(Undetermined(affected.map(|i| free[i]).collect()));
    }
    let nothing = || Undetermined(free.to_vec());
    let inverse = matrix.cholesky().ok_or_else(nothing)?.inverse();
    Ok(DMatrix::from_fn(free.len(), free.len(), |i, j| {
        inverse[(i, j)] / (scale[i] * scale[j])
    }))
}

/// 1 σ of a coordinate from the lengths of two-dimensional misses, px, whatever the outliers: the median of a
/// Rayleigh variable is 1.1774 σ.
pub(super) fn robust_sigma_px(lengths_px: &[f64], parameters: usize) -> f64 {
    if lengths_px.is_empty() {
        return 0.0;
    }
    let mut sorted = lengths_px.to_vec();
    sorted.sort_by(f64::total_cmp);
    let coordinates = 2 * sorted.len();
    let left = coordinates.saturating_sub(parameters).max(1) as f64;
    let median = sorted[sorted.len() / 2];
    median / (2.0 * std::f64::consts::LN_2).sqrt() * (coordinates as f64 / left).sqrt()
}

/// The lengths of misses, px; of points that cannot be projected, infinite.
pub(super) fn lengths_px<'a>(
    misses: impl IntoIterator<Item = &'a Option<Vector2<f64>>>,
) -> Vec<f64> {
    misses
        .into_iter()
        .map(|m| m.map_or(f64::INFINITY, |m| m.norm()))
        .collect()
}

const _: () = assert!(EXTRINSICS + 6 == RIG_PARAMETERS);
