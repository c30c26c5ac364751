//! Patch: a keypoint's surroundings in, turned and scaled to 21 × 21 cells, out.
//!
//! A cell is the mean of 2 × 2 interpolated samples of the pyramid's level that leaves it at most
//! [`CELL_MAX_PX`] wide: a keypoint of any size costs the same.

#![expect(
    clippy::needless_range_loop,
    reason = "several arrays run along one index, plainly enough to be computed by whole registers"
)]

use super::Keypoint;
use super::orientation::Direction;
use super::pyramid::{Level, Pyramid};
use super::upright::sample_upright;
use crate::image::GrayImage;
use crate::simd::{round_i32, widened};

/// Cells across the patch.
pub(super) const CELLS: usize = 21;
/// Samples across a cell.
pub(super) const SAMPLES_PER_CELL: usize = 2;
/// Samples across the patch.
pub(super) const SAMPLES: usize = CELLS * SAMPLES_PER_CELL;
/// [`SAMPLES`] rounded up to full vector registers.
const SAMPLES_PADDED: usize = SAMPLES.next_multiple_of(8);
/// Largest side of a cell in pixels of the level it is sampled from.
const CELL_MAX_PX: f32 = 2.5;
/// Bits of a sample's place behind the point.
const FRACTION_BITS: i32 = 15;
/// All of them.
const FRACTION: i32 = (1 << FRACTION_BITS) - 1;

/// A piece of a level: what lies to the right of and below one of its pixels.
struct Window<'a> {
    level: &'a Level,
    left: i32,
    top: i32,
}

impl Window<'_> {
    fn pixels(&self) -> Pixels<'_> {
        Pixels {
            pitch: self.level.pitch(),
            pairs: self.level.from(self.left, self.top),
        }
    }
}

/// The means of the cells, times the samples in one.
pub(super) type Cells = [[f32; CELLS]; CELLS];

/// Takes patches from an image; holds the working memory.
#[derive(Debug)]
pub(super) struct Patch {
    pyramid: Pyramid,
    cells: Cells,
}

impl Patch {
    pub(super) fn new() -> Self {
        Self {
            pyramid: Pyramid::default(),
            cells: [[0.0; CELLS]; CELLS],
        }
    }

    /// Makes room for images of this size and keypoints up to `size_px`.
    pub(super) fn make_room(&mut self, image: &GrayImage, size_px: f32) {
        let (level, _) = level_of(cell_px(size_px));
        self.pyramid
            .make_room((image.width(), image.height()), level + 1);
    }

    /// Prepares for another image.
    pub(super) fn begin(&mut self) {
        self.pyramid.clear();
    }

    /// The cells around `keypoint` of `image`, their rows along `direction`.
    pub(super) fn take(
        &mut self,
        image: &GrayImage,
        keypoint: &Keypoint,
        direction: Direction,
    ) -> &Cells {
        let (level, cell_px) = level_of(cell_px(keypoint.size_px));
        let (mut x_px, mut y_px) = (keypoint.x_px, keypoint.y_px);
        for _ in 0..level {
            // A level's pixel 0 has its centre between the pixels 0 and 1 of the level before.
            (x_px, y_px) = (0.5 * x_px - 0.25, 0.5 * y_px - 0.25);
        }
        let extent = direction.cos.abs() + direction.sin.abs();
        let reach_px = (0.5 * CELLS as f32 * cell_px * extent).ceil() as i32 + 1;
        let left = x_px.floor() as i32 - reach_px;
        let top = y_px.floor() as i32 - reach_px;
        let window = Window {
            level: self.pyramid.level(image, level),
            left,
            top,
        };
        let centre_px = [x_px - left as f32, y_px - top as f32];
        let spacing_px = cell_px / SAMPLES_PER_CELL as f32;
        let pixels = window.pixels();
        if direction == Direction::UP {
            sample_upright(&pixels, centre_px, spacing_px, &mut self.cells);
        } else {
            sample(&pixels, centre_px, spacing_px, direction, &mut self.cells);
        }
        &self.cells
    }

    /// Elements held.
    #[cfg(test)]
    pub(super) fn capacity(&self) -> usize {
        self.pyramid.capacity()
    }
}

/// The side of a cell of a keypoint's patch: OpenCV's patch has a whole number of pixels.
fn cell_px(size_px: f32) -> f32 {
    let cells = CELLS as f32;
    (cells * size_px * (1.2 / 9.0)).floor().max(1.0) / cells
}

/// The level that cells of a side are sampled from, and their side in pixels of it.
fn level_of(mut cell_px: f32) -> (usize, f32) {
    let mut level = 0;
    while cell_px > CELL_MAX_PX {
        cell_px *= 0.5;
        level += 1;
    }
    (level, cell_px)
}

widened! {
    /// Samples the pixels at `spacing_px` around `centre_px` and sums up the samples of each cell.
    fn sample = sample_narrow, (
        pixels: &Pixels,
        centre_px: [f32; 2],
        spacing_px: f32,
        direction: Direction,
        cells: &mut Cells,
    )
}

#[inline(always)]
fn sample_narrow(
    pixels: &Pixels,
    centre_px: [f32; 2],
    spacing_px: f32,
    direction: Direction,
    cells: &mut Cells,
) {
    let Direction { cos, sin, .. } = direction;
    // Sample (a, b) lies at across[·][b] + (down_x[a], down_y[a]).
    let across = [line(0.0, spacing_px * cos), line(0.0, spacing_px * sin)];
    let down_x = line(centre_px[0], -spacing_px * sin);
    let down_y = line(centre_px[1], spacing_px * cos);
    for row in 0..CELLS {
        let mut sums = [0.0; SAMPLES_PADDED];
        for a in row * SAMPLES_PER_CELL..(row + 1) * SAMPLES_PER_CELL {
            add_row(pixels, &across, [down_x[a], down_y[a]], &mut sums);
        }
        for column in 0..CELLS {
            cells[row][column] = sums[2 * column] + sums[2 * column + 1];
        }
    }
}

/// The pixels of a window, row by row, each with the one below it in its upper byte.
pub(super) struct Pixels<'a> {
    pub(super) pitch: usize,
    pub(super) pairs: &'a [u16],
}

/// The pixel before a place in 2⁻¹⁵ px, and how far beyond it the place lies, px.
#[inline(always)]
pub(super) fn split(place: i32) -> (usize, f32) {
    let fraction = place & FRACTION;
    let pixel = (place >> FRACTION_BITS) as usize;
    (pixel, fraction as f32 * (1.0 / (FRACTION + 1) as f32))
}

/// One coordinate of the samples of a row or a column, in 2⁻¹⁵ px.
#[inline(always)]
pub(super) fn line(middle_px: f32, step_px: f32) -> [i32; SAMPLES_PADDED] {
    const UNIT: f32 = (1 << FRACTION_BITS) as f32;
    let mut line = [0; SAMPLES_PADDED];
    for n in 0..SAMPLES_PADDED {
        // The padding repeats the last: it is computed with, but counts for nothing.
        let from_middle = n.min(SAMPLES - 1) as f32 - 0.5 * (SAMPLES as f32 - 1.0);
        line[n] = round_i32((middle_px + from_middle * step_px) * UNIT);
    }
    line
}

/// Adds the interpolated samples of a row to `sums`.
#[inline(always)]
fn add_row(
    pixels: &Pixels,
    across: &[[i32; SAMPLES_PADDED]; 2],
    [x0, y0]: [i32; 2],
    sums: &mut [f32; SAMPLES_PADDED],
) {
    let pitch = pixels.pitch as i32;
    let mut places = [0_u32; SAMPLES_PADDED];
    let (mut right, mut low) = ([0.0_f32; SAMPLES_PADDED], [0.0_f32; SAMPLES_PADDED]);
    for b in 0..SAMPLES_PADDED {
        let (x, y) = (x0 + across[0][b], y0 + across[1][b]);
        places[b] = ((y >> FRACTION_BITS) * pitch + (x >> FRACTION_BITS)) as u32;
        right[b] = (x & FRACTION) as f32 * (1.0 / (FRACTION + 1) as f32);
        low[b] = (y & FRACTION) as f32 * (1.0 / (FRACTION + 1) as f32);
    }
    // Of equal length, so that one look at a place does for both.
    let last = pixels.pairs.len() - 1;
    let (pairs, next) = (&pixels.pairs[..last], &pixels.pairs[1..][..last]);
    let mut quads = [0_u32; SAMPLES_PADDED];
    for b in 0..SAMPLES {
        let place = places[b] as usize;
        quads[b] = u32::from(pairs[place]) | u32::from(next[place]) << 16;
    }
    for b in 0..SAMPLES_PADDED {
        let pixel = |byte: u32| ((quads[b] >> (8 * byte)) & 0xff) as i32 as f32;
        let above = pixel(0) + (pixel(2) - pixel(0)) * right[b];
        let below = pixel(1) + (pixel(3) - pixel(1)) * right[b];
        sums[b] += above + (below - above) * low[b];
    }
}

#[cfg(test)]
mod tests {
    use super::super::upright::sample_upright_narrow;
    use super::*;

    /// A plane of grey values, which interpolation reproduces.
    fn plane(x: f32, y: f32) -> f32 {
        40.0 + x + 0.5 * y
    }

    #[test]
    fn cells_of_a_plane_are_its_values_at_their_centres() {
        let pixels = (0..150 * 100).map(|n| plane((n % 150) as f32, (n / 150 * 2) as f32 * 0.5));
        let pixels = pixels.map(|p| p as u8).collect();
        let image = GrayImage::from_vec(150, 100, pixels).unwrap_or_default();
        let mut patch = Patch::new();
        for (size_px, degree) in [
            (15.0_f32, 0.0_f32),
            (15.0, 33.0),
            (18.0, 200.0),
            (24.0, 300.0),
        ] {
            let (sin, cos) = degree.to_radians().sin_cos();
            let direction = Direction {
                angle_rad: degree.to_radians(),
                cos,
                sin,
            };
            let keypoint = Keypoint {
                x_px: 75.3,
                y_px: 49.6,
                size_px,
                ..Keypoint::default()
            };
            patch.begin();
            let cells = patch.take(&image, &keypoint, direction);
            let cell_px = (size_px * 2.8 + 1e-4).floor() / 21.0;
            for (row, column) in (0..21).flat_map(|row| (0..21).map(move |c| (row, c))) {
                let (u, v) = (
                    (column as f32 - 10.0) * cell_px,
                    (row as f32 - 10.0) * cell_px,
                );
                let truth = plane(75.3 + u * cos - v * sin, 49.6 + u * sin + v * cos);
                let found = cells[row][column] / 4.0;
                assert!(
                    (found - truth).abs() < 0.8,
                    "{degree} {row} {column}: {found} {truth}"
                );
            }
        }
    }

    /// Their places are rounded once instead of twice, by 2⁻¹⁵ px at most.
    #[test]
    fn upright_patches_are_those_of_samples_that_are_looked_up_one_by_one() {
        let pixels = (0..150_u32 * 100).map(|n| (n * n * 31 % 251) as u8);
        let image = GrayImage::from_vec(150, 100, pixels.collect()).unwrap_or_default();
        let mut pyramid = Pyramid::default();
        for (left, top, spacing_px) in [(-5, 30, 0.7), (100, -10, 1.0), (60, 40, 1.24999)] {
            let level = pyramid.level(&image, 0);
            let window = Window { level, left, top };
            let pixels = window.pixels();
            let (mut upright, mut narrow) = ([[0.0; CELLS]; CELLS], [[1.0; CELLS]; CELLS]);
            let mut looked_up = [[2.0; CELLS]; CELLS];
            let centre_px = [27.3, 27.999];
            sample_upright(&pixels, centre_px, spacing_px, &mut upright);
            sample_upright_narrow(&pixels, centre_px, spacing_px, &mut narrow);
            sample(
                &pixels,
                centre_px,
                spacing_px,
                Direction::UP,
                &mut looked_up,
            );
            assert_eq!(upright, narrow);
            let differences = upright.as_flattened().iter().zip(looked_up.as_flattened());
            assert!(
                differences
                    .map(|(a, b)| (a - b).abs())
                    .all(|difference| difference < 0.1)
            );
        }
    }

    #[test]
    fn wider_registers_give_the_same_bits() {
        let pixels = (0..150_u32 * 100).map(|n| (n * n * 31 % 251) as u8);
        let image = GrayImage::from_vec(150, 100, pixels.collect()).unwrap_or_default();
        let mut pyramid = Pyramid::default();
        let window = Window {
            level: pyramid.level(&image, 0),
            left: 30,
            top: -10,
        };
        let direction = Direction {
            angle_rad: 1.0,
            cos: 0.540_302_3,
            sin: 0.841_471,
        };
        let (mut wide, mut narrow) = ([[0.0; CELLS]; CELLS], [[1.0; CELLS]; CELLS]);
        let pixels = window.pixels();
        sample(&pixels, [40.3, 39.6], 1.2, direction, &mut wide);
        sample_narrow(&pixels, [40.3, 39.6], 1.2, direction, &mut narrow);
        assert_eq!(wide, narrow);
    }
}
