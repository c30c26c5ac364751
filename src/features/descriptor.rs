//! Descriptor: a keypoint's turned and scaled surroundings in, 64 or 128 floats of unit length out.
//!
//! The square of side 20 s around the keypoint, turned to its direction, is sampled into 21 × 21
//! cells of side s; differences of cells are 20 × 20 gradients (Haar wavelets of side 2 s), weighted
//! by a Gaussian of 3.3 s. Each of 4 × 4 parts gives the sums of dx, dy, |dx|, |dy| over its 5 × 5
//! gradients, or, extended, each of these sums apart for both signs of the other derivative (Bay et
//! al., section 4.2).
//!
//! A cell is the mean of 2 × 2 interpolated samples of the pyramid's level that leaves it at most
//! [`CELL_MAX_PX`] wide: a keypoint of any size costs the same.

use super::Keypoint;
use super::orientation::Direction;
use super::pyramid::Pyramid;
use crate::image::GrayImage;

/// Cells across the patch.
const CELLS: usize = 21;
/// Gradients across the patch.
const GRADIENTS: usize = CELLS - 1;
/// Parts of the patch across it.
const PARTS: usize = 4;
/// Gradients across a part.
const PART: usize = GRADIENTS / PARTS;
/// σ of the gradients' weights, in cells.
const WEIGHT_SIGMA: f64 = 3.3;
/// Samples across a cell.
const SAMPLES_PER_CELL: usize = 2;
/// Samples across the patch.
const SAMPLES: usize = CELLS * SAMPLES_PER_CELL;
/// [`SAMPLES`] rounded up to full vector registers.
const SAMPLES_PADDED: usize = SAMPLES.next_multiple_of(8);
/// Largest side of a cell in pixels of the level it is sampled from.
const CELL_MAX_PX: f32 = 2.5;
/// Row length of the window, px: a power of two above 21 · 2.5 · √2 + 4.
const PITCH: usize = 128;

/// Makes descriptors; holds its working memory.
#[derive(Debug)]
pub(super) struct Describer {
    weights: [[f32; GRADIENTS]; GRADIENTS],
    pyramid: Pyramid,
    window: Box<[u8; PITCH * PITCH]>,
    cells: [[f32; CELLS]; CELLS],
}

impl Describer {
    pub(super) fn new() -> Self {
        let middle = 0.5 * (GRADIENTS as f64 - 1.0);
        let weight = |n: usize| (-0.5 * ((n as f64 - middle) / WEIGHT_SIGMA).powi(2)).exp();
        Self {
            weights: std::array::from_fn(|y| {
                std::array::from_fn(|x| (weight(x) * weight(y)) as f32)
            }),
            pyramid: Pyramid::default(),
            window: Box::new([0; PITCH * PITCH]),
            cells: [[0.0; CELLS]; CELLS],
        }
    }

    /// Prepares for another image.
    pub(super) fn begin(&mut self) {
        self.pyramid.clear();
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
        self.sample(image, keypoint, direction);
        if out.len() == PARTS * PARTS * 8 {
            sum_parts(&self.cells, &self.weights, extended_terms, out);
        } else {
            sum_parts(&self.cells, &self.weights, plain_terms, out);
        }
        normalise(out);
    }

    /// Fills the cells.
    fn sample(&mut self, image: &GrayImage, keypoint: &Keypoint, direction: Direction) {
        // OpenCV's patch has a whole number of pixels.
        let cells = CELLS as f32;
        let mut cell_px = (cells * keypoint.size_px * (1.2 / 9.0)).floor().max(1.0) / cells;
        let (mut x_px, mut y_px) = (keypoint.x_px, keypoint.y_px);
        let mut level = 0;
        while cell_px > CELL_MAX_PX {
            // Pixel centres are at integers: a level's pixel 0 lies half a pixel right of ours.
            (x_px, y_px) = (0.5 * x_px - 0.25, 0.5 * y_px - 0.25);
            cell_px *= 0.5;
            level += 1;
        }
        let reach_px = (0.5 * cells * cell_px * std::f32::consts::SQRT_2).ceil() as i32 + 1;
        let (left, top) = (
            x_px.floor() as i32 - reach_px,
            y_px.floor() as i32 - reach_px,
        );
        let side = 2 * reach_px as usize + 2;
        copy_window(
            self.pyramid.level(image, level),
            (left, top),
            side,
            &mut self.window,
        );
        let centre = (x_px - left as f32, y_px - top as f32);
        let spacing_px = cell_px / SAMPLES_PER_CELL as f32;
        Grid::new(centre, spacing_px, direction).sample(&self.window, &mut self.cells);
    }

    /// Elements held.
    #[cfg(test)]
    pub(super) fn capacity(&self) -> usize {
        self.pyramid.capacity()
    }
}

/// Copies the square of `side` px with upper left corner `(left, top)` to `window`; what lies
/// outside the image is as the nearest pixel inside.
fn copy_window(
    image: &GrayImage,
    (left, top): (i32, i32),
    side: usize,
    window: &mut [u8; PITCH * PITCH],
) {
    let (last_x, last_y) = (image.width() as i32 - 1, image.height() as i32 - 1);
    let rows = window.chunks_exact_mut(PITCH).take(side);
    for (y, to) in (top..).zip(rows) {
        let row = image.row(y.clamp(0, last_y) as u32);
        let to = &mut to[..side];
        if left >= 0 && left + side as i32 <= last_x + 1 {
            to.copy_from_slice(&row[left as usize..][..side]);
        } else {
            for (x, to) in (left..).zip(to) {
                *to = row[x.clamp(0, last_x) as usize];
            }
        }
    }
}

/// Where samples lie in the window, in 65536ths of a pixel: sample `(a, b)` at `across[b] + down[a]`.
struct Grid {
    across: [[i32; SAMPLES_PADDED]; 2],
    down: [[i32; SAMPLES_PADDED]; 2],
}

impl Grid {
    fn new(centre: (f32, f32), spacing_px: f32, direction: Direction) -> Self {
        let Direction { cos, sin, .. } = direction;
        let line = |start: f32, step: f32| {
            std::array::from_fn(|n| {
                let from_middle = n.min(SAMPLES - 1) as f32 - 0.5 * (SAMPLES as f32 - 1.0);
                ((start + from_middle * spacing_px * step) * 65536.0) as i32
            })
        };
        Self {
            across: [line(0.0, cos), line(0.0, sin)],
            down: [line(centre.0, -sin), line(centre.1, cos)],
        }
    }

    /// Sums up the samples of each cell.
    fn sample(&self, window: &[u8; PITCH * PITCH], cells: &mut [[f32; CELLS]; CELLS]) {
        for (cell_row, cells) in cells.iter_mut().enumerate() {
            let mut sums = [0.0; SAMPLES_PADDED];
            for a in cell_row * SAMPLES_PER_CELL..(cell_row + 1) * SAMPLES_PER_CELL {
                self.add_row(window, a, &mut sums);
            }
            for (cell, samples) in cells.iter_mut().zip(sums.as_chunks::<SAMPLES_PER_CELL>().0) {
                *cell = samples.iter().sum();
            }
        }
    }

    /// Adds the interpolated samples of row `a` to `sums`.
    #[inline(always)]
    fn add_row(&self, window: &[u8; PITCH * PITCH], a: usize, sums: &mut [f32; SAMPLES_PADDED]) {
        let (x0, y0) = (self.down[0][a], self.down[1][a]);
        let mut at = [0_u32; SAMPLES_PADDED];
        let (mut right, mut low) = ([0.0_f32; SAMPLES_PADDED], [0.0_f32; SAMPLES_PADDED]);
        for b in 0..SAMPLES_PADDED {
            let (x, y) = (x0 + self.across[0][b], y0 + self.across[1][b]);
            at[b] = ((y >> 16) * PITCH as i32 + (x >> 16)) as u32;
            right[b] = (x & 0xffff) as f32 * (1.0 / 65536.0);
            low[b] = (y & 0xffff) as f32 * (1.0 / 65536.0);
        }
        let mut quads = [0_u32; SAMPLES_PADDED];
        for b in 0..SAMPLES {
            // The masks never change an index: they tell the compiler that it lies in the window.
            let pixel = |offset| window[(at[b] as usize + offset) & (PITCH * PITCH - 1)];
            quads[b] = u32::from_le_bytes([pixel(0), pixel(1), pixel(PITCH), pixel(PITCH + 1)]);
        }
        for b in 0..SAMPLES_PADDED {
            let pixel = |n: u32| ((quads[b] >> (8 * n)) & 0xff) as i32 as f32;
            let above = pixel(0) + (pixel(1) - pixel(0)) * right[b];
            let below = pixel(2) + (pixel(3) - pixel(2)) * right[b];
            sums[b] += above + (below - above) * low[b];
        }
    }
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
    cells: &[[f32; CELLS]; CELLS],
    weights: &[[f32; GRADIENTS]; GRADIENTS],
    terms: impl Fn(f32, f32) -> [f32; TERMS],
    out: &mut [f32],
) {
    let bands = out.chunks_exact_mut(PARTS * TERMS);
    for (band, out) in bands.enumerate() {
        let mut columns = [[0.0_f32; GRADIENTS]; TERMS];
        for y in band * PART..(band + 1) * PART {
            let (above, below, weights) = (&cells[y], &cells[y + 1], &weights[y]);
            for x in 0..GRADIENTS {
                let falling = below[x + 1] - above[x];
                let rising = above[x + 1] - below[x];
                let dx = (falling + rising) * weights[x];
                let dy = (falling - rising) * weights[x];
                for (columns, term) in columns.iter_mut().zip(terms(dx, dy)) {
                    columns[x] += term;
                }
            }
        }
        for (part, out) in out.chunks_exact_mut(TERMS).enumerate() {
            for (out, columns) in out.iter_mut().zip(&columns) {
                *out = columns[part * PART..][..PART].iter().sum();
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
