//! A pyramid: one image in, the same smoothed and halved again and again out.
//!
//! Level 0 is the image under a 3 × 3 binomial filter, which takes out what bilinear interpolation
//! would distort; each further level averages 2 × 2 pixels. Pixel (x, y) of level l lies at
//! `(x + ½) 2ˡ − ½` of the image, likewise y.

use crate::image::GrayImage;
use crate::simd::widened;

/// How many levels there are: the coarsest is an eighth of the image.
pub const LEVELS: usize = 4;

/// An image at several resolutions; keeps its memory when filled anew.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Pyramid {
    levels: [GrayImage; LEVELS],
    rows: [Vec<u16>; 3],
}

impl Pyramid {
    /// Replaces what it held by `image` and its reductions.
    pub fn fill(&mut self, image: &GrayImage) {
        smooth(image, &mut self.levels[0], &mut self.rows);
        for level in 1..LEVELS {
            let (finer, coarser) = self.levels.split_at_mut(level);
            halve(&finer[level - 1], &mut coarser[0]);
        }
    }

    /// One level, 0 the finest.
    ///
    /// # Panics
    /// If there is no such level, as an array index does.
    #[must_use]
    pub fn level(&self, level: usize) -> &GrayImage {
        &self.levels[level]
    }
}

/// Where a position of the image lies in a level.
#[must_use]
pub fn to_level(px: f64, level: usize) -> f64 {
    (px + 0.5) / f64::from(1_u32 << level) - 0.5
}

/// Where a position of a level lies in the image.
#[must_use]
pub fn from_level(px: f64, level: usize) -> f64 {
    (px + 0.5) * f64::from(1_u32 << level) - 0.5
}

/// The filter (1 2 1) ⊗ (1 2 1) / 16, rounded; borders are repeated.
fn smooth(image: &GrayImage, out: &mut GrayImage, rows: &mut [Vec<u16>; 3]) {
    let (width, height) = (image.width(), image.height());
    out.reshape(width, height);
    if width == 0 || height == 0 {
        return;
    }
    for row in rows.iter_mut() {
        row.resize(width as usize, 0);
    }
    let last = height - 1;
    smooth_row(image.row(0), &mut rows[0]);
    smooth_row(image.row(0), &mut rows[1]);
    for y in 0..height {
        let next = (y + 1).min(last);
        smooth_row(image.row(next), &mut rows[2]);
        let target = &mut out.pixels_mut()[y as usize * width as usize..][..width as usize];
        smooth_columns(&rows[0], &rows[1], &rows[2], target);
        rows.rotate_left(1);
    }
}

widened! {
    /// (1 2 1) / 16 down the columns of three rows, rounded.
    fn smooth_columns = smooth_columns_narrow, (
        above: &[u16],
        here: &[u16],
        below: &[u16],
        out: &mut [u8],
    )
}

#[inline(always)]
fn smooth_columns_narrow(above: &[u16], here: &[u16], below: &[u16], out: &mut [u8]) {
    for (((o, a), b), c) in out.iter_mut().zip(above).zip(here).zip(below) {
        *o = ((a + 2 * b + c + 8) >> 4) as u8;
    }
}

widened! {
    /// (1 2 1) along a row.
    fn smooth_row = smooth_row_narrow, (row: &[u8], out: &mut [u16])
}

#[inline(always)]
fn smooth_row_narrow(row: &[u8], out: &mut [u16]) {
    let n = row.len();
    if n == 1 {
        out[0] = 4 * u16::from(row[0]);
        return;
    }
    let wide = |v: u8| u16::from(v);
    out[0] = 3 * wide(row[0]) + wide(row[1]);
    out[n - 1] = wide(row[n - 2]) + 3 * wide(row[n - 1]);
    for ((o, a), (b, c)) in out[1..n - 1]
        .iter_mut()
        .zip(&row[..n - 2])
        .zip(row[1..n - 1].iter().zip(&row[2..]))
    {
        *o = wide(*a) + 2 * wide(*b) + wide(*c);
    }
}

/// Averages of 2 × 2 pixels; an odd last row or column is left out.
fn halve(finer: &GrayImage, coarser: &mut GrayImage) {
    let (width, height) = (finer.width() / 2, finer.height() / 2);
    coarser.reshape(width, height);
    for y in 0..height {
        let (top, bottom) = (finer.row(2 * y), finer.row(2 * y + 1));
        let target = &mut coarser.pixels_mut()[y as usize * width as usize..][..width as usize];
        average(top, bottom, target);
    }
}

widened! {
    /// Averages of 2 × 2 pixels of two rows.
    fn average = average_narrow, (top: &[u8], bottom: &[u8], out: &mut [u8])
}

#[inline(always)]
fn average_narrow(top: &[u8], bottom: &[u8], out: &mut [u8]) {
    let (top, bottom) = (top.as_chunks::<2>().0, bottom.as_chunks::<2>().0);
    for ((o, a), b) in out.iter_mut().zip(top).zip(bottom) {
        let sum = u16::from(a[0]) + u16::from(a[1]) + u16::from(b[0]) + u16::from(b[1]);
        *o = ((sum + 2) >> 2) as u8;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ramp(width: u32, height: u32) -> GrayImage {
        let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (2 * x + 3 * y) as u8));
        GrayImage::from_vec(width, height, pixels.collect()).expect("full")
    }

    #[test]
    fn a_ramp_keeps_its_place_on_every_level() {
        let mut pyramid = Pyramid::default();
        pyramid.fill(&ramp(48, 32));
        for level in 0..LEVELS {
            let image = pyramid.level(level);
            let (x, y) = (image.width() / 2, image.height() / 2);
            let truth =
                2.0 * from_level(f64::from(x), level) + 3.0 * from_level(f64::from(y), level);
            let seen = f64::from(image.row(y)[x as usize]);
            assert!(
                (seen - truth).abs() <= 1.0,
                "level {level}: {seen} for {truth}"
            );
        }
    }

    #[test]
    fn refilling_leaves_no_trace_and_odd_sizes_work() {
        let mut used = Pyramid::default();
        used.fill(&ramp(48, 32));
        let mut fresh = Pyramid::default();
        for (width, height) in [(37, 21), (1, 1), (2, 1), (0, 0)] {
            used.fill(&ramp(width, height));
            fresh.fill(&ramp(width, height));
            assert_eq!(used.levels, fresh.levels);
        }
    }

    #[test]
    fn smoothing_is_the_binomial_filter() {
        let mut image = GrayImage::filled(5, 5, 0);
        image.pixels_mut()[12] = 160;
        let mut pyramid = Pyramid::default();
        pyramid.fill(&image);
        let expected = [
            0, 0, 0, 0, 0, 0, 10, 20, 10, 0, 0, 20, 40, 20, 0, 0, 10, 20, 10, 0, 0, 0, 0, 0, 0,
        ];
        assert_eq!(pyramid.level(0).pixels(), expected);
    }

    #[test]
    fn levels_and_image_agree_where_things_are() {
        for level in 0..LEVELS {
            assert!((from_level(to_level(17.3, level), level) - 17.3).abs() < 1e-12);
        }
    }
}
