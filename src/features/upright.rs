//! Upright patch: a piece of a level in, the 21 × 21 cells of a keypoint without direction out.
//!
//! The samples of such a patch lie in the image's rows and columns, so that rows are interpolated between once for
//! all samples that lie in them, and then columns: along whole registers both times, where a turned patch looks up
//! four pixels a sample.

#![expect(
    clippy::needless_range_loop,
    reason = "several arrays run along one index, plainly enough to be computed by whole registers"
)]

use super::patch::{CELLS, Cells, Pixels, SAMPLES, SAMPLES_PER_CELL, line, split};
use crate::simd::widened;

/// [`CELLS`] rounded up to full vector registers.
const CELLS_PADDED: usize = CELLS.next_multiple_of(8);
/// Pixels across a patch at most, of which the widest have cells of 2.5 px, in full vector registers.
const MOST_PX: usize = 56;
/// Pixels that are interpolated between at once.
const GROUP_PX: usize = 8;

widened! {
    /// Samples the pixels at `spacing_px` around `centre_px` and sums up the samples of each cell; a row of cells is a
    /// column of the image, and a column of cells a row of it, the lowest first: the patch looks up, along its rows.
    pub(super) fn sample_upright = sample_upright_narrow, (
        pixels: &Pixels,
        centre_px: [f32; 2],
        spacing_px: f32,
        cells: &mut Cells,
    )
}

#[inline(always)]
pub(super) fn sample_upright_narrow(
    pixels: &Pixels,
    [x_px, y_px]: [f32; 2],
    spacing_px: f32,
    cells: &mut Cells,
) {
    let (xs, ys) = (line(x_px, spacing_px), line(y_px, -spacing_px));
    let first = split(xs[0]).0;
    let width = split(xs[SAMPLES - 1]).0 + 2 - first;
    // At each column of the image, the sums for each column of cells.
    let mut columns = [[0.0_f32; CELLS_PADDED]; MOST_PX];
    for column in 0..CELLS {
        let mut sums = [0.0_f32; MOST_PX];
        for b in column * SAMPLES_PER_CELL..(column + 1) * SAMPLES_PER_CELL {
            let (y, low) = split(ys[b]);
            let row = &pixels.pairs[y * pixels.pitch + first..][..width.next_multiple_of(GROUP_PX)];
            let groups = row.as_chunks::<GROUP_PX>().0.iter();
            for (pairs, sums) in groups.zip(sums.as_chunks_mut::<GROUP_PX>().0) {
                for x in 0..GROUP_PX {
                    let above = i32::from(pairs[x] & 0xff) as f32;
                    let below = i32::from(pairs[x] >> 8) as f32;
                    sums[x] += above + (below - above) * low;
                }
            }
        }
        for x in 0..width {
            columns[x][column] = sums[x];
        }
    }
    for row in 0..CELLS {
        let mut sums = [0.0_f32; CELLS_PADDED];
        for a in row * SAMPLES_PER_CELL..(row + 1) * SAMPLES_PER_CELL {
            let (x, right) = split(xs[a]);
            let (left, next) = (&columns[x - first], &columns[x - first + 1]);
            for column in 0..CELLS_PADDED {
                sums[column] += left[column] + (next[column] - left[column]) * right;
            }
        }
        cells[row].copy_from_slice(&sums[..CELLS]);
    }
}
