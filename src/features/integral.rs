//! The integral image: a grey image in, sums over any upright rectangle in four look-ups out.

use crate::image::GrayImage;
use crate::simd::widened;

/// Sums of all pixels above and to the left of each pixel corner.
///
/// Entry `(y, x)` is the sum of the pixels of rows `0..y` and columns `0..x`, so that there is one
/// more row and one more column than in the image. Sums wrap at 32 bits; a difference of them is
/// right wherever the sum over the rectangle itself fits, that is up to 8.4 million white pixels.
#[derive(Debug, Default)]
pub(super) struct IntegralImage {
    stride: usize,
    sums: Vec<i32>,
}

impl IntegralImage {
    /// Sums up `image`, re-using the memory of the last one.
    pub(super) fn compute(&mut self, image: &GrayImage) {
        let width = image.width() as usize;
        let stride = width + 1;
        self.stride = stride;
        self.sums.resize(stride * (image.height() as usize + 1), 0);
        self.sums[..stride].fill(0);
        if width == 0 {
            self.sums.fill(0);
            return;
        }
        let rows = image.pixels().chunks_exact(width).enumerate();
        for (y, pixels) in rows {
            let (above, below) = self.sums[y * stride..].split_at_mut(stride);
            below[0] = 0;
            let mut row_sum = 0_i32;
            let corners = below[1..stride].iter_mut().zip(&above[1..]);
            for ((sum, &sum_above), &pixel) in corners.zip(pixels) {
                row_sum = row_sum.wrapping_add(i32::from(pixel));
                *sum = sum_above.wrapping_add(row_sum);
            }
        }
    }

    /// Columns of the image.
    #[inline]
    pub(super) fn width(&self) -> usize {
        self.stride - 1
    }

    /// Rows of the image.
    #[inline]
    pub(super) fn height(&self) -> usize {
        self.sums.len() / self.stride - 1
    }

    /// The `width() + 1` sums of the corners above pixel row `y`, for `y` from 0 to `height()`.
    #[inline]
    pub(super) fn row(&self, y: usize) -> &[i32] {
        &self.sums[y * self.stride..][..self.stride]
    }

    /// The sum at corner `(y, x)`.
    #[inline(always)]
    pub(super) fn at(&self, y: usize, x: usize) -> i32 {
        self.sums[y * self.stride + x]
    }

    /// Elements held.
    #[cfg(test)]
    pub(super) fn capacity(&self) -> usize {
        self.sums.capacity()
    }
}

/// An integral image with its columns sorted by their remainder by `step`: first the columns 0,
/// `step`, `2 step`, …, then 1, `step + 1`, …, so that every `step`-th column is contiguous.
#[derive(Debug, Default)]
pub(super) struct SortedColumns {
    step: usize,
    row_len: usize,
    sums: Vec<i32>,
    row: Vec<i32>,
}

impl SortedColumns {
    /// Takes the columns of `integral` as they are: a step of 1. They are copied at the first
    /// [`Self::widen`] only; `widest` is the step that this will come to at most, a power of two.
    ///
    /// A row is longer than the image's by a step at least, which lets a stretch of columns begin anywhere and end
    /// one step beyond the last.
    pub(super) fn begin(&mut self, integral: &IntegralImage, widest: usize) {
        self.step = 1;
        self.row_len = (integral.stride + widest).next_multiple_of(widest);
        self.row.resize(self.row_len, 0);
    }

    /// Doubles the step until it is `step`.
    pub(super) fn widen(&mut self, integral: &IntegralImage, step: usize) {
        while self.step < step {
            self.double_step(integral);
        }
    }

    fn double_step(&mut self, integral: &IntegralImage) {
        let half = self.row_len / 2;
        self.sums.resize(self.row_len * (integral.height() + 1), 0);
        for (y, sums) in self.sums.chunks_exact_mut(self.row_len).enumerate() {
            let (even, odd) = sums.split_at_mut(half);
            if self.step == 1 {
                deal(integral.row(y), even, odd);
                continue;
            }
            let row = &mut self.row[..self.row_len];
            row[..half].copy_from_slice(even);
            row[half..].copy_from_slice(odd);
            let run = self.row_len / self.step;
            for n in 0..self.step {
                let [from, to] = [n * run, (n + 1) * run];
                deal(
                    &row[from..to],
                    &mut even[from / 2..to / 2],
                    &mut odd[from / 2..to / 2],
                );
            }
        }
        self.step *= 2;
    }

    /// Distance of columns that are contiguous.
    #[inline]
    pub(super) fn step(&self) -> usize {
        self.step
    }

    /// The sorted sums of the corners above pixel row `y`.
    #[inline]
    pub(super) fn row<'a>(&'a self, integral: &'a IntegralImage, y: usize) -> &'a [i32] {
        if self.step == 1 {
            integral.row(y)
        } else {
            &self.sums[y * self.row_len..][..self.row_len]
        }
    }

    /// Where column `x` stands in a row; the columns `x + step`, `x + 2 step`, … follow it.
    #[inline]
    pub(super) fn place(&self, x: usize) -> usize {
        // The step is a power of two.
        let bits = self.step.trailing_zeros();
        (x & (self.step - 1)) * (self.row_len >> bits) + (x >> bits)
    }

    /// Elements held.
    #[cfg(test)]
    pub(super) fn capacity(&self) -> usize {
        self.sums.capacity() + self.row.capacity()
    }
}

widened! {
    /// Deals a row out in turn: its first, third, … value to `even`, the others to `odd`.
    fn deal = deal_narrow, (row: &[i32], even: &mut [i32], odd: &mut [i32])
}

#[inline(always)]
fn deal_narrow(row: &[i32], even: &mut [i32], odd: &mut [i32]) {
    let (pairs, last) = row.as_chunks::<2>();
    let (even_pairs, odd_pairs) = (&mut even[..pairs.len()], &mut odd[..pairs.len()]);
    for n in 0..pairs.len() {
        even_pairs[n] = pairs[n][0];
        odd_pairs[n] = pairs[n][1];
    }
    if let &[last] = last {
        even[pairs.len()] = last;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn every_corner_is_the_naive_sum(
            (width, height, pixels) in (0_u32..20, 0_u32..20).prop_flat_map(|(w, h)| {
                (Just(w), Just(h), prop::collection::vec(any::<u8>(), (w * h) as usize))
            })
        ) {
            let image = GrayImage::from_vec(width, height, pixels).unwrap_or_default();
            let mut integral = IntegralImage::default();
            integral.compute(&GrayImage::filled(7, 31, 9)); // memory of another image before
            integral.compute(&image);
            prop_assert_eq!(integral.width(), width as usize);
            prop_assert_eq!(integral.height(), height as usize);
            for y in 0..=height {
                for x in 0..=width as usize {
                    let naive: i32 = (0..y)
                        .flat_map(|row| &image.row(row)[..x])
                        .map(|&pixel| i32::from(pixel))
                        .sum();
                    prop_assert_eq!(integral.row(y as usize)[x], naive);
                }
            }
        }
    }
    #[test]
    fn sorted_columns_are_where_they_are_said_to_be() {
        let pixels = (0..37_u32 * 5).map(|n| (n * n % 251) as u8).collect();
        let image = GrayImage::from_vec(37, 5, pixels).unwrap_or_default();
        let mut integral = IntegralImage::default();
        integral.compute(&image);
        let mut sorted = SortedColumns::default();
        for _ in 0..2 {
            sorted.begin(&integral, 8);
            for octave in 0..4 {
                sorted.widen(&integral, 1 << octave);
                assert_eq!(sorted.step(), 1 << octave);
                for (x, y) in (0..=37).flat_map(|x| (0..=5).map(move |y| (x, y))) {
                    let found = sorted.row(&integral, y)[sorted.place(x)];
                    assert_eq!(found, integral.row(y)[x], "{octave} {x} {y}");
                    let next = x + sorted.step();
                    assert!(next > 37 || sorted.place(next) == sorted.place(x) + 1);
                }
            }
        }
    }
}
