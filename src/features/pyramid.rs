//! Image pyramid: one image in, the same at half, a quarter, … of its size out, ready to sample.
//!
//! Large keypoints are described from a smaller image, so that none costs more than another.

use super::make_room;
use crate::image::GrayImage;
use crate::simd::widened;

/// How far beyond the image's border a level can be sampled, px.
pub(super) const BORDER_PX: usize = 48;

/// An image and its halvings. Pixel `i` of level `p` is the mean of the pixels `2ᵖ i … 2ᵖ (i + 1) − 1`.
#[derive(Debug, Default)]
pub(super) struct Pyramid {
    halved: Vec<GrayImage>,
    levels: Vec<Level>,
    built: usize,
}

/// A level with [`BORDER_PX`] more pixels on each side, each as the nearest one of the image.
///
/// Each pixel has the one below it in its upper byte, so that the four pixels around a sample are
/// two neighbours.
#[derive(Debug, Default)]
pub(super) struct Level {
    pitch: usize,
    pairs: Vec<u16>,
}

impl Pyramid {
    /// Makes room for that many levels of images of a size.
    pub(super) fn make_room(&mut self, (mut width, mut height): (u32, u32), levels: usize) {
        for level in 0..levels {
            if self.levels.len() == level {
                self.levels.push(Level::default());
                self.halved.push(GrayImage::default());
            }
            let bordered = |side_px: u32| side_px as usize + 2 * BORDER_PX;
            let pairs = bordered(width) * bordered(height);
            make_room(&mut self.levels[level].pairs, pairs);
            let pixels = width as usize * height as usize;
            if level > 0 && self.halved[level].pixels().len() < pixels {
                self.halved[level].reshape(width, height);
            }
            (width, height) = (width.div_ceil(2), height.div_ceil(2));
        }
    }

    /// Forgets the last image.
    pub(super) fn clear(&mut self) {
        self.built = 0;
    }

    /// Level `level` of `image`, which has pixels, built if it is not yet. All calls since
    /// [`Self::clear`] must be with the same image.
    pub(super) fn level(&mut self, image: &GrayImage, level: usize) -> &Level {
        while self.built <= level {
            if self.levels.len() == self.built {
                self.levels.push(Level::default());
                self.halved.push(GrayImage::default());
            }
            let (done, rest) = self.halved.split_at_mut(self.built);
            // The image itself is level 0; the first of the halved ones stays empty.
            let last = if self.built < 2 {
                image
            } else {
                &done[self.built - 1]
            };
            let this = if self.built == 0 {
                image
            } else {
                halve(last, &mut rest[0]);
                &rest[0]
            };
            self.levels[self.built].fill(this);
            self.built += 1;
        }
        &self.levels[level]
    }

    /// Elements held.
    #[cfg(test)]
    pub(super) fn capacity(&self) -> usize {
        let pairs = self.levels.iter().map(|level| level.pairs.capacity());
        let pixels = self.halved.iter().map(|image| image.pixels().len());
        pairs.chain(pixels).sum()
    }
}

impl Level {
    /// Elements of a row.
    #[inline]
    pub(super) fn pitch(&self) -> usize {
        self.pitch
    }

    /// The pairs from pixel `(x, y)` on, which is no more than [`BORDER_PX`] from the image.
    #[inline]
    pub(super) fn from(&self, x: i32, y: i32) -> &[u16] {
        let border = BORDER_PX as i32;
        &self.pairs[(y + border) as usize * self.pitch + (x + border) as usize..]
    }

    fn fill(&mut self, image: &GrayImage) {
        self.pitch = image.width() as usize + 2 * BORDER_PX;
        let rows = image.height() as usize + 2 * BORDER_PX;
        self.pairs.resize(self.pitch * rows, 0);
        let row = |y: usize| {
            image.row(y.saturating_sub(BORDER_PX).min(image.height() as usize - 1) as u32)
        };
        for (y, pairs) in self.pairs.chunks_exact_mut(self.pitch).enumerate() {
            let (left, inside) = pairs.split_at_mut(BORDER_PX);
            let (inside, right) = inside.split_at_mut(image.width() as usize);
            join(row(y), row(y + 1), inside);
            left.fill(inside[0]);
            right.fill(inside[inside.len() - 1]);
        }
    }
}

widened! {
    /// Joins the pixels of a row with those below them.
    fn join = join_narrow, (row: &[u8], below: &[u8], pairs: &mut [u16])
}

#[inline(always)]
fn join_narrow(row: &[u8], below: &[u8], pairs: &mut [u16]) {
    let (row, below) = (&row[..pairs.len()], &below[..pairs.len()]);
    for x in 0..pairs.len() {
        pairs[x] = u16::from(row[x]) | u16::from(below[x]) << 8;
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
        let below = from.row((y + 1).min(from.height() - 1));
        means(from.row(y), below, out);
    }
}

widened! {
    /// Means of two by two pixels of two rows.
    fn means = means_narrow, (above: &[u8], below: &[u8], out: &mut [u8])
}

#[inline(always)]
fn means_narrow(above: &[u8], below: &[u8], out: &mut [u8]) {
    let (above_pairs, above_rest) = above.as_chunks::<2>();
    let (below_pairs, below_rest) = below.as_chunks::<2>();
    let pairs = above_pairs.len();
    let (below_pairs, out_pairs) = (&below_pairs[..pairs], &mut out[..pairs]);
    for x in 0..pairs {
        out_pairs[x] = mean(above_pairs[x], below_pairs[x]);
    }
    if let (&[a], &[b]) = (above_rest, below_rest) {
        out[pairs] = mean([a, a], [b, b]);
    }
}

#[inline(always)]
fn mean(a: [u8; 2], b: [u8; 2]) -> u8 {
    let sum = u16::from(a[0]) + u16::from(a[1]) + u16::from(b[0]) + u16::from(b[1]);
    ((sum + 2) / 4) as u8
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The pixels of a level without its border.
    fn pixels(level: &Level, width: i32, height: i32) -> Vec<u16> {
        let at = |n| level.from(n % width, n / width)[0] % 256;
        (0..width * height).map(at).collect()
    }

    #[test]
    fn levels_are_means_and_odd_borders_count_twice() {
        let image = GrayImage::from_vec(3, 3, vec![1, 2, 3, 4, 5, 6, 7, 8, 9]).unwrap_or_default();
        let mut pyramid = Pyramid::default();
        assert_eq!(pixels(pyramid.level(&image, 1), 2, 2), [3, 5, 8, 9]);
        assert_eq!(pixels(pyramid.level(&image, 2), 1, 1), [6]);
        assert_eq!(
            pixels(pyramid.level(&image, 0), 3, 3),
            [1, 2, 3, 4, 5, 6, 7, 8, 9]
        );
        let other = GrayImage::filled(4, 2, 7);
        pyramid.clear();
        assert_eq!(pixels(pyramid.level(&other, 1), 2, 1), [7, 7]);
    }

    #[test]
    fn outside_the_image_is_its_border() {
        let image = GrayImage::from_vec(2, 2, vec![10, 20, 30, 40]).unwrap_or_default();
        let mut pyramid = Pyramid::default();
        let level = pyramid.level(&image, 0);
        let border = BORDER_PX as i32;
        for (y, x) in (-border..2 + border).flat_map(|y| (-border..2 + border).map(move |x| (y, x)))
        {
            let nearest =
                |x: i32, y: i32| u16::from(image.row(y.clamp(0, 1) as u32)[x.clamp(0, 1) as usize]);
            let pair = level.from(x, y)[0];
            assert_eq!((pair % 256, pair / 256), (nearest(x, y), nearest(x, y + 1)));
        }
    }
}
