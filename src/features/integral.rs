//! The integral image: a grey image in, sums over any upright rectangle in four look-ups out.

use crate::image::GrayImage;

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
        self.sums.clear();
        self.sums.resize(stride * (image.height() as usize + 1), 0);
        if width == 0 {
            return;
        }
        let rows = image.pixels().chunks_exact(width).enumerate();
        for (y, pixels) in rows {
            let (above, below) = self.sums[y * stride..].split_at_mut(stride);
            let mut row_sum = 0_i32;
            let corners = below[1..stride].iter_mut().zip(&above[1..]);
            for ((sum, &sum_above), &pixel) in corners.zip(pixels) {
                row_sum = row_sum.wrapping_add(i32::from(pixel));
                *sum = sum_above.wrapping_add(row_sum);
            }
        }
    }

    /// Columns of the image.
    pub(super) fn width(&self) -> usize {
        self.stride - 1
    }

    /// Rows of the image.
    pub(super) fn height(&self) -> usize {
        self.sums.len() / self.stride - 1
    }

    /// The `width() + 1` sums of the corners above pixel row `y`, for `y` from 0 to `height()`.
    pub(super) fn row(&self, y: usize) -> &[i32] {
        &self.sums[y * self.stride..][..self.stride]
    }

    /// Bytes held.
    #[cfg(test)]
    pub(super) fn capacity(&self) -> usize {
        self.sums.capacity()
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
}
