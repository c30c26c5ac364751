//! Descriptor: a keypoint's turned and scaled surroundings in, 64 or 128 floats of unit length out.
//!
//! The square of side 20 s around the keypoint, turned to its direction, is sampled into 21 × 21
//! cells of side s; differences of cells are 20 × 20 gradients (Haar wavelets of side 2 s), weighted
//! by a Gaussian of 3.3 s. Each of 4 × 4 parts gives the sums of dx, dy, |dx|, |dy| over its 5 × 5
//! gradients, or, extended, each of these sums apart for both signs of the other derivative (Bay et
//! al., section 4.2).

#![expect(
    clippy::needless_range_loop,
    reason = "several arrays run along one index, plainly enough to be computed by whole registers"
)]

use super::Keypoint;
use super::orientation::Direction;
use super::patch::{CELLS, Cells, Patch};
use crate::image::GrayImage;
use crate::simd::widened;

/// Gradients across the patch.
const GRADIENTS: usize = CELLS - 1;
/// Parts of the patch across it.
const PARTS: usize = 4;
/// Gradients across a part.
const PART: usize = GRADIENTS / PARTS;
/// σ of the gradients' weights, in cells.
const WEIGHT_SIGMA: f64 = 3.3;

/// The Gaussian weights of the gradients.
type Weights = [[f32; GRADIENTS]; GRADIENTS];

/// Makes descriptors; holds its working memory.
#[derive(Debug)]
pub(super) struct Describer {
    weights: Weights,
    patch: Patch,
}

impl Describer {
    pub(super) fn new() -> Self {
        let middle = 0.5 * (GRADIENTS as f64 - 1.0);
        let weight = |n: usize| (-0.5 * ((n as f64 - middle) / WEIGHT_SIGMA).powi(2)).exp();
        Self {
            weights: std::array::from_fn(|y| {
                std::array::from_fn(|x| (weight(x) * weight(y)) as f32)
            }),
            patch: Patch::new(),
        }
    }

    /// Makes room for images of this size and keypoints up to `size_px`.
    pub(super) fn make_room(&mut self, image: &GrayImage, size_px: f32) {
        self.patch.make_room(image, size_px);
    }

    /// Prepares for another image.
    pub(super) fn begin(&mut self) {
        self.patch.begin();
    }

    /// Writes the descriptor of `keypoint` of `image`, which turns by `direction`, to `out`: 64
    /// floats, or 128 for the extended one.
    pub(super) fn describe(
        &mut self,
        image: &GrayImage,
        keypoint: &Keypoint,
        direction: Direction,
        out: &mut [f32],
    ) {
        let cells = self.patch.take(image, keypoint, direction);
        if out.len() == PARTS * PARTS * 8 {
            sum_extended(cells, &self.weights, out);
        } else {
            sum_plain(cells, &self.weights, out);
        }
        normalise(out);
    }

    /// Elements held.
    #[cfg(test)]
    pub(super) fn capacity(&self) -> usize {
        self.patch.capacity()
    }
}

widened! {
    /// The descriptor of 64 floats, not yet of unit length.
    fn sum_plain = sum_plain_narrow, (cells: &Cells, weights: &Weights, out: &mut [f32])
}

#[inline(always)]
fn sum_plain_narrow(cells: &Cells, weights: &Weights, out: &mut [f32]) {
    sum_parts(cells, weights, plain_terms, out);
}

widened! {
    /// The descriptor of 128 floats, not yet of unit length.
    fn sum_extended = sum_extended_narrow, (cells: &Cells, weights: &Weights, out: &mut [f32])
}

#[inline(always)]
fn sum_extended_narrow(cells: &Cells, weights: &Weights, out: &mut [f32]) {
    sum_parts(cells, weights, extended_terms, out);
}

/// What a gradient adds to its part's four sums.
#[inline(always)]
fn plain_terms(dx: f32, dy: f32) -> [f32; 4] {
    [dx, dy, dx.abs(), dy.abs()]
}

/// What a gradient adds to its part's eight sums.
#[inline(always)]
fn extended_terms(dx: f32, dy: f32) -> [f32; 8] {
    let on = |condition, value: f32| if condition { value } else { 0.0 };
    [
        on(dy >= 0.0, dx),
        on(dy >= 0.0, dx.abs()),
        on(dy < 0.0, dx),
        on(dy < 0.0, dx.abs()),
        on(dx >= 0.0, dy),
        on(dx >= 0.0, dy.abs()),
        on(dx < 0.0, dy),
        on(dx < 0.0, dy.abs()),
    ]
}

/// Sums the terms of the gradients of each part.
#[inline(always)]
fn sum_parts<const TERMS: usize>(
    cells: &Cells,
    weights: &Weights,
    terms: impl Fn(f32, f32) -> [f32; TERMS],
    out: &mut [f32],
) {
    for band in 0..PARTS {
        let mut columns = [[0.0_f32; GRADIENTS]; TERMS];
        for y in band * PART..(band + 1) * PART {
            let (above, below, weights) = (&cells[y], &cells[y + 1], &weights[y]);
            for x in 0..GRADIENTS {
                let falling = below[x + 1] - above[x];
                let rising = above[x + 1] - below[x];
                let dx = (falling + rising) * weights[x];
                let dy = (falling - rising) * weights[x];
                let terms = terms(dx, dy);
                for n in 0..TERMS {
                    columns[n][x] += terms[n];
                }
            }
        }
        let out = &mut out[band * PARTS * TERMS..][..PARTS * TERMS];
        for part in 0..PARTS {
            for n in 0..TERMS {
                let column = &columns[n][part * PART..][..PART];
                let mut sum = column[0];
                for x in 1..PART {
                    sum += column[x];
                }
                out[part * TERMS + n] = sum;
            }
        }
    }
}

/// Scales to unit length; what is zero stays so.
fn normalise(vector: &mut [f32]) {
    let square: f32 = vector.iter().map(|v| v * v).sum();
    if square > 0.0 {
        let factor = 1.0 / square.sqrt();
        vector.iter_mut().for_each(|v| *v *= factor);
    }
}
