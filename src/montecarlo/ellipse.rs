//! A 2×2 covariance in, its 95 % ellipse in a panel out.

use crate::output::report::scale::Scale;
use crate::output::report::svg::PathData;
use crate::uncertainty::consistency::chi2_quantile;
use nalgebra::{Matrix2, Matrix6, SymmetricEigen, Vector2};

/// Corners of the polygon that is drawn for an ellipse.
const CORNERS: usize = 72;

/// The outline about `centre` that holds 95 % of Gaussian errors, `enlarged` times.
pub(super) fn outline(cov: &Matrix2<f64>, centre: (f64, f64), enlarged: f64) -> Vec<(f64, f64)> {
    let eigen = SymmetricEigen::new(*cov);
    let reach = chi2_quantile(super::verdict::LEVEL, 2.0).sqrt() * enlarged;
    let axes = eigen
        .eigenvalues
        .map(|variance| variance.max(0.0).sqrt() * reach);
    (0..CORNERS)
        .map(|i| {
            let angle = std::f64::consts::TAU * i as f64 / CORNERS as f64;
            let on = Vector2::new(axes.x * angle.cos(), axes.y * angle.sin());
            let edge = eigen.eigenvectors * on;
            (centre.0 + edge.x, centre.1 + edge.y)
        })
        .collect()
}

/// The outline as an element.
pub(super) fn element(points: &[(f64, f64)], x: &Scale, y: &Scale, class: &str) -> String {
    let mut path = PathData::default();
    for &(across, up) in points {
        path.to(x.at(across), y.at(up));
    }
    path.close();
    path.element(class)
}

/// Two rows and columns of a covariance.
pub(super) fn block(cov: &Matrix6<f64>, i: usize, j: usize) -> Matrix2<f64> {
    Matrix2::new(cov[(i, i)], cov[(i, j)], cov[(j, i)], cov[(j, j)])
}
