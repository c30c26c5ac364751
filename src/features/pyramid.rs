//! Image pyramid: one image in, the same at half, a quarter, … of its size out.
//!
//! Large keypoints are described from a smaller image, so that none costs more than another.

use crate::image::GrayImage;

/// An image and its halvings. Pixel `i` of level `p` is the mean of the pixels `2ᵖ i … 2ᵖ (i + 1) − 1`.
#[derive(Debug, Default)]
pub(super) struct Pyramid {
    halved: Vec<GrayImage>,
    built: usize,
}

impl Pyramid {
    /// Forgets the last image.
    pub(super) fn clear(&mut self) {
        self.built = 0;
    }

    /// Level `level` of `image`, built if it is not yet. All calls since [`Self::clear`] must be
    /// with the same image.
    pub(super) fn level<'a>(&'a mut self, image: &'a GrayImage, level: usize) -> &'a GrayImage {
        while self.built < level {
            if self.halved.len() == self.built {
                self.halved.push(GrayImage::default());
            }
            let (done, rest) = self.halved.split_at_mut(self.built);
            halve(done.last().unwrap_or(image), &mut rest[0]);
            self.built += 1;
        }
        level.checked_sub(1).map_or(image, |n| &self.halved[n])
    }

    /// Bytes held.
    #[cfg(test)]
    pub(super) fn capacity(&self) -> usize {
        self.halved.iter().map(|image| image.pixels().len()).sum()
    }
}

/// Means of two by two pixels, halves rounded up; a last odd row or column counts twice.
fn halve(from: &GrayImage, to: &mut GrayImage) {
    to.reshape(from.width().div_ceil(2), from.height().div_ceil(2));
    let width = to.width() as usize;
    if width == 0 {
        return;
    }
    for (y, out) in (0..from.height())
        .step_by(2)
        .zip(to.pixels_mut().chunks_exact_mut(width))
    {
        let above = from.row(y);
        let below = from.row((y + 1).min(from.height() - 1));
        let (above_pairs, above_rest) = above.as_chunks::<2>();
        let (below_pairs, below_rest) = below.as_chunks::<2>();
        let mean = |a: [u8; 2], b: [u8; 2]| {
            let sum = u16::from(a[0]) + u16::from(a[1]) + u16::from(b[0]) + u16::from(b[1]);
            ((sum + 2) / 4) as u8
        };
        for ((out, &a), &b) in out.iter_mut().zip(above_pairs).zip(below_pairs) {
            *out = mean(a, b);
        }
        if let (Some(out), &[a], &[b]) = (out.last_mut(), above_rest, below_rest) {
            *out = mean([a, a], [b, b]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn levels_are_means_and_odd_borders_count_twice() {
        let image = GrayImage::from_vec(3, 3, vec![1, 2, 3, 4, 5, 6, 7, 8, 9]).unwrap_or_default();
        let mut pyramid = Pyramid::default();
        let half = pyramid.level(&image, 1);
        assert_eq!((half.width(), half.height()), (2, 2));
        assert_eq!(half.pixels(), [3, 5, 8, 9]);
        assert_eq!(pyramid.level(&image, 2).pixels(), [6]);
        assert_eq!(pyramid.level(&image, 0), &image);
        let other = GrayImage::filled(4, 2, 7);
        pyramid.clear();
        assert_eq!(pyramid.level(&other, 1), &GrayImage::filled(2, 1, 7));
    }
}
