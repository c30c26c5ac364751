//! Slant: how the inverse depth of a surface changes over a patch.
//!
//! A plane's inverse depth is linear in the image: around a pixel it is `ρ · (1 + γ · δ)` at δ px from
//! there, γ the *slope*. Where the camera moves, a pixel is displaced in proportion to its inverse
//! depth; a patch is therefore deformed by `lever · γᵀ`, the lever being the displacement of its centre
//! against what lies at infinity. To take every surface for one that faces the camera (γ = 0) draws a
//! patch's place along as it comes nearer, ever more and always the same way.

use nalgebra::{Matrix2, Vector2};

/// σ of the tangent of a surface's slant before anything is known: floors are steep.
const SIGMA_TANGENT: f64 = 2.0;
/// Share of what was known that counts beside a new image: all of them are compared with the same
/// template, whose noise they share.
const KEPT: f64 = 0.5;

/// What is known of a surface's slope.
#[derive(Clone, Copy, Debug)]
pub struct Slant {
    /// The slope, per px of the anchor's left image.
    pub slope: Vector2<f64>,
    /// Its information, px².
    pub information: Matrix2<f64>,
}

impl Slant {
    /// Nothing is known; `focal_px` is the left camera's.
    #[must_use]
    pub fn unknown(focal_px: f64) -> Self {
        let sigma = SIGMA_TANGENT / focal_px;
        Self {
            slope: Vector2::zeros(),
            information: Matrix2::identity() / (sigma * sigma),
        }
    }

    /// What is known after one more image, by which alone and `self` the slope is `slope` with
    /// `information`.
    #[must_use]
    pub(super) fn after(&self, slope: Vector2<f64>, information: Matrix2<f64>) -> Self {
        Self {
            slope,
            information: information - self.information * (1.0 - KEPT),
        }
    }
}
