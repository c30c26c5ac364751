//! The covariance of a minimiser, by the implicit function theorem (thesis §3.2, theory of Haralick
//! and Faugeras).

use nalgebra::SMatrix;

/// The derivative of `y(z) = argmin C(z, y)` by `z`, from the second derivatives of the cost at the
/// minimum (thesis 3.9): `−(∂²C/∂y²)⁻¹ ∂²C/∂y∂z`.
///
/// `None` where the Hessian is not positive definite, so that the minimum is not one.
#[must_use]
pub fn derivative_of_minimiser<const Y: usize, const Z: usize>(
    hessian: &SMatrix<f64, Y, Y>,
    mixed: &SMatrix<f64, Y, Z>,
) -> Option<SMatrix<f64, Y, Z>> {
    Some(-hessian.cholesky()?.solve(mixed))
}

/// First-order propagation (thesis 3.2): `J Σ Jᵀ`, symmetric to the last bit.
#[must_use]
pub fn propagate<const Y: usize, const Z: usize>(
    jacobian: &SMatrix<f64, Y, Z>,
    cov: &SMatrix<f64, Z, Z>,
) -> SMatrix<f64, Y, Y> {
    let product = jacobian * cov * jacobian.transpose();
    (product + product.transpose()) * 0.5
}
