//! Blocks: square pieces of images, and how well one fits others.
//!
//! The measure is the normalised cross-correlation, −1 to 1: what is brighter or of more contrast fits as
//! well. The sums that it needs of the other image are made once for all its blocks where many are compared.

#![expect(
    clippy::needless_range_loop,
    reason = "several arrays run along one index, plainly enough to be computed by whole registers"
)]

use crate::image::GrayImage;
use crate::simd::widened;
use nalgebra::Vector2;

/// Pixels across a block.
const SIDE: usize = 8;
/// Pixels of a block.
const AREA: f32 = (SIDE * SIDE) as f32;
/// Weakest contrast of a block: the sum of its squared deviations, grey levels².
const LEAST_ENERGY: f32 = 4.0 * AREA;

/// One block, to be compared with others.
#[derive(Clone, Debug)]
pub(super) struct Block {
    pixels: [[u8; SIDE]; SIDE],
    mean: f32,
    /// One over the root of the sum of its squared deviations.
    per_root: f32,
}

/// A block of an image by its first pixel, and how well it fits.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Place {
    pub(super) first: usize,
    pub(super) correlation: f32,
}

/// The sums of all blocks of an image, by their first pixel; zeros where there is no whole one.
#[derive(Debug, Default)]
pub(super) struct Sums {
    sums: Vec<f32>,
    /// One over the root of the sum of squared deviations; 0 where a block is flat.
    per_root: Vec<f32>,
    /// Sums and squared sums of a row's columns, of a block's height.
    columns: [Vec<i32>; 2],
}

/// The first pixel of the block around `middle`; `None` where that leaves the image.
#[inline]
pub(super) fn first_pixel(image: &GrayImage, middle: &Vector2<i32>) -> Option<usize> {
    let half = SIDE as i32 / 2;
    let (x, y) = (middle.x - half, middle.y - half);
    let is_inside = x >= 0
        && y >= 0
        && x + SIDE as i32 <= image.width() as i32
        && y + SIDE as i32 <= image.height() as i32;
    is_inside.then(|| y as usize * image.width() as usize + x as usize)
}

/// The middle of the block from a pixel on.
pub(super) fn middle(image: &GrayImage, first: usize) -> Vector2<i32> {
    let width = image.width() as usize;
    Vector2::new((first % width) as i32, (first / width) as i32).add_scalar(SIDE as i32 / 2)
}

impl Block {
    /// The block around `middle`; `None` where it leaves the image or is flat.
    pub(super) fn around(image: &GrayImage, middle: &Vector2<i32>) -> Option<Self> {
        let first = first_pixel(image, middle)?;
        let mut pixels = [[0; SIDE]; SIDE];
        for (y, row) in pixels.iter_mut().enumerate() {
            *row = *image.pixels()[first + y * image.width() as usize..].first_chunk()?;
        }
        let [sum, square] = products(&pixels, image, first, |_, pixel| [1, pixel]);
        let energy = energy(sum, square);
        (energy >= LEAST_ENERGY).then(|| Self {
            pixels,
            mean: sum / AREA,
            per_root: 1.0 / energy.sqrt(),
        })
    }

    /// Says of each of `places` of an image how well it fits; `sums` are that image's.
    pub(super) fn compare(&self, image: &GrayImage, sums: &Sums, places: &mut [Place]) {
        compare(self, image, sums, places);
    }

    /// The block of an image that fits best of those whose first pixels lie up to `reach` to the right of and below
    /// `first`. All have to lie in the image.
    pub(super) fn best_within(&self, image: &GrayImage, first: usize, reach: [usize; 2]) -> Place {
        best_within(self, image, first, reach)
    }
}

impl Sums {
    /// Sums up all blocks of `image`.
    pub(super) fn fill(&mut self, image: &GrayImage) {
        let (width, pixels) = (image.width() as usize, image.pixels());
        for sums in [&mut self.sums, &mut self.per_root] {
            sums.clear();
            sums.resize(pixels.len(), 0.0);
        }
        for columns in &mut self.columns {
            columns.resize(width, 0);
        }
        let [sums, squares] = &mut self.columns;
        for y in 0..(image.height() as usize + 1).saturating_sub(SIDE) {
            let line = y * width..(y + 1) * width;
            sum_columns(&pixels[y * width..][..SIDE * width], sums, squares);
            let (out, per_root) = (&mut self.sums[line.clone()], &mut self.per_root[line]);
            sum_blocks(sums, squares, out, per_root);
        }
    }
}

widened! {
    /// The sums of a block of rows' columns, and of their squares.
    fn sum_columns = sum_columns_narrow, (rows: &[u8], sums: &mut [i32], squares: &mut [i32])
}

#[inline(always)]
fn sum_columns_narrow(rows: &[u8], sums: &mut [i32], squares: &mut [i32]) {
    let len = sums.len();
    let squares = &mut squares[..len];
    sums.fill(0);
    squares.fill(0);
    for row in rows.chunks_exact(len.max(1)) {
        for x in 0..len {
            let pixel = i32::from(row[x]);
            sums[x] += pixel;
            squares[x] += pixel * pixel;
        }
    }
}

widened! {
    /// The sums of a row's blocks from those of their columns, and one over the roots of their energies.
    fn sum_blocks = sum_blocks_narrow, (
        sums: &[i32],
        squares: &[i32],
        out: &mut [f32],
        per_root: &mut [f32],
    )
}

#[inline(always)]
fn sum_blocks_narrow(sums: &[i32], squares: &[i32], out: &mut [f32], per_root: &mut [f32]) {
    let len = (sums.len() + 1).saturating_sub(SIDE);
    let (out, per_root) = (&mut out[..len], &mut per_root[..len]);
    for x in 0..len {
        let (mut sum, mut square) = (0, 0);
        for column in 0..SIDE {
            sum += sums[x + column];
            square += squares[x + column];
        }
        let sum = sum as f32;
        let energy = energy(sum, square as f32);
        out[x] = sum;
        per_root[x] = if energy >= LEAST_ENERGY {
            1.0 / energy.sqrt()
        } else {
            0.0
        };
    }
}

widened! {
    fn compare = compare_narrow, (block: &Block, image: &GrayImage, sums: &Sums, places: &mut [Place])
}

#[inline(always)]
fn compare_narrow(block: &Block, image: &GrayImage, sums: &Sums, places: &mut [Place]) {
    for place in places {
        let [product] = products(&block.pixels, image, place.first, |other, _| [other]);
        let covariance = product - sums.sums[place.first] * block.mean;
        place.correlation = covariance * sums.per_root[place.first] * block.per_root;
    }
}

widened! {
    fn best_within = best_within_narrow, (
        block: &Block,
        image: &GrayImage,
        first: usize,
        reach: [usize; 2],
    ) -> Place
}

#[inline(always)]
fn best_within_narrow(
    block: &Block,
    image: &GrayImage,
    first: usize,
    [across, down]: [usize; 2],
) -> Place {
    let mut best = Place {
        first,
        correlation: -1.0,
    };
    for y in 0..=down {
        for x in 0..=across {
            let first = first + y * image.width() as usize + x;
            let [product, sum, square] = products(&block.pixels, image, first, |other, pixel| {
                [other, 1, pixel]
            });
            let energy = energy(sum, square).max(LEAST_ENERGY);
            let correlation = (product - sum * block.mean) / energy.sqrt() * block.per_root;
            if correlation > best.correlation {
                best = Place { first, correlation };
            }
        }
    }
    best
}

/// The sum of a block's squared deviations from the sums of its pixels and of their squares.
#[inline(always)]
fn energy(sum: f32, square: f32) -> f32 {
    square - sum * sum / AREA
}

/// Sums over the pixels of the block from `first` on, each times some factors, which depend on the one of `others` in
/// its place and on itself.
#[inline(always)]
fn products<const N: usize>(
    others: &[[u8; SIDE]; SIDE],
    image: &GrayImage,
    first: usize,
    factors: impl Fn(i16, i16) -> [i16; N],
) -> [f32; N] {
    let width = image.width() as usize;
    let mut sums = [[0_i32; SIDE]; N];
    for y in 0..SIDE {
        let Some(row) = image.pixels()[first + y * width..].first_chunk::<SIDE>() else {
            break;
        };
        for x in 0..SIDE {
            let pixel = i16::from(row[x]);
            let factors = factors(i16::from(others[y][x]), pixel);
            for n in 0..N {
                sums[n][x] += i32::from(pixel) * i32::from(factors[n]);
            }
        }
    }
    let mut totals = [0.0; N];
    for n in 0..N {
        totals[n] = sums[n].iter().sum::<i32>() as f32;
    }
    totals
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_xoshiro::Xoshiro256PlusPlus;

    const SIZE: (u32, u32) = (61, 43);

    fn noise(seed: u64, least: u8, most: u8) -> GrayImage {
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
        let pixels = (0..SIZE.0 * SIZE.1).map(|_| rng.random_range(least..=most));
        GrayImage::from_vec(SIZE.0, SIZE.1, pixels.collect()).expect("full")
    }

    /// Pearson's coefficient of two blocks, straight from its definition.
    fn pearson(a: &GrayImage, at: usize, b: &GrayImage, there: usize) -> f64 {
        let pixels = |image: &GrayImage, first: usize| -> Vec<f64> {
            (0..SIDE * SIDE)
                .map(|n| first + n / SIDE * image.width() as usize + n % SIDE)
                .map(|n| f64::from(image.pixels()[n]))
                .collect()
        };
        let centred = |values: Vec<f64>| -> Vec<f64> {
            let mean = values.iter().sum::<f64>() / values.len() as f64;
            values.iter().map(|v| v - mean).collect()
        };
        let (a, b) = (centred(pixels(a, at)), centred(pixels(b, there)));
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        dot(&a, &b) / (dot(&a, &a) * dot(&b, &b)).sqrt()
    }

    #[test]
    fn the_correlation_is_pearsons() {
        let (a, b) = (noise(1, 0, 255), noise(2, 90, 160));
        let mut sums = Sums::default();
        sums.fill(&noise(3, 0, 9)); // memory of another image before
        sums.fill(&b);
        let middle_of_a = Vector2::new(20, 17);
        let first_of_a = first_pixel(&a, &middle_of_a).expect("inside");
        let block = Block::around(&a, &middle_of_a).expect("of contrast");
        for y in 4..=SIZE.1 as i32 - 4 {
            for x in 4..=SIZE.0 as i32 - 4 {
                let first = first_pixel(&b, &Vector2::new(x, y)).expect("inside");
                assert_eq!(middle(&b, first), Vector2::new(x, y));
                let mut places = [Place {
                    first,
                    correlation: 0.0,
                }];
                block.compare(&b, &sums, &mut places);
                let expected = pearson(&a, first_of_a, &b, first);
                let found = f64::from(places[0].correlation);
                assert!((found - expected).abs() < 1e-4, "{found} {expected}");
                let alone = block.best_within(&b, first, [0, 0]);
                assert!((f64::from(alone.correlation) - expected).abs() < 1e-4);
            }
        }
    }

    #[test]
    fn the_best_is_found_whatever_its_brightness() {
        let image = noise(4, 0, 255);
        let pixels = image.pixels().iter().map(|p| 40 + p / 3).collect();
        let dull = GrayImage::from_vec(SIZE.0, SIZE.1, pixels).expect("full");
        let block = Block::around(&image, &Vector2::new(30, 20)).expect("of contrast");
        let corner = first_pixel(&dull, &Vector2::new(28, 19)).expect("inside");
        let best = block.best_within(&dull, corner, [4, 2]);
        assert_eq!(middle(&dull, best.first), Vector2::new(30, 20));
        assert!(best.correlation > 0.999, "{}", best.correlation);
    }

    #[test]
    fn what_is_flat_or_outside_is_none() {
        let flat = GrayImage::filled(SIZE.0, SIZE.1, 7);
        assert!(Block::around(&flat, &Vector2::new(20, 20)).is_none());
        let image = noise(5, 0, 255);
        for (x, y) in [(3, 20), (20, 3), (58, 20), (20, 40), (-5, 20), (20, 900)] {
            assert!(
                Block::around(&image, &Vector2::new(x, y)).is_none(),
                "{x} {y}"
            );
        }
        let block = Block::around(&image, &Vector2::new(20, 20)).expect("of contrast");
        let mut sums = Sums::default();
        sums.fill(&flat);
        let mut places = [Place {
            first: 100,
            correlation: 1.0,
        }];
        block.compare(&flat, &sums, &mut places);
        assert_eq!(places[0].correlation, 0.0);
        // Too small for a block.
        sums.fill(&GrayImage::filled(20, 7, 7));
        sums.fill(&GrayImage::default());
    }

    #[test]
    fn wider_registers_give_the_same_bits() {
        let (a, b) = (noise(6, 0, 255), noise(7, 0, 255));
        let mut sums = Sums::default();
        sums.fill(&b);
        let block = Block::around(&a, &Vector2::new(20, 20)).expect("of contrast");
        let place = |first| Place {
            first,
            correlation: 0.0,
        };
        let mut wide: Vec<Place> = (0..900).map(place).collect();
        let mut narrow = wide.clone();
        compare(&block, &b, &sums, &mut wide);
        compare_narrow(&block, &b, &sums, &mut narrow);
        assert_eq!(wide, narrow);
        let narrow = best_within_narrow(&block, &b, 300, [4, 2]);
        assert_eq!(best_within(&block, &b, 300, [4, 2]), narrow);
        let mut columns = [[vec![0; 61], vec![0; 61]], [vec![1; 61], vec![1; 61]]];
        let [[wide, wide_squares], [narrow, narrow_squares]] = &mut columns;
        sum_columns(&b.pixels()[..8 * 61], wide, wide_squares);
        sum_columns_narrow(&b.pixels()[..8 * 61], narrow, narrow_squares);
        assert_eq!((wide, wide_squares), (narrow, narrow_squares));
    }
}
