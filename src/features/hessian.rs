//! Responses of the fast Hessian: an integral image in, rows of determinants out.
//!
//! Bay et al. approximate the second derivatives of a Gaussian of scale `1.2 · size / 9` by boxes
//! whose corners lie on multiples of a ninth of the filter's size, rounded to pixels:
//!
//! ```text
//!      D_yy               D_xy
//!   · · · · · · · · ·   · · · · · · · · ·
//!   · · 1 1 1 1 1 · ·   · 1 1 1 · − − − ·       D_xx is D_yy on its side.
//!   · · 1 1 1 1 1 · ·   · 1 1 1 · − − − ·       D_yy's boxes weigh 1, −2, 1.
//!   · · 1 1 1 1 1 · ·   · 1 1 1 · − − − ·
//!   · · −−−−−−−−− · ·   · · · · · · · · ·       Each box counts as its mean, so that the
//!   · · −−−−−−−−− · ·   · − − − · 1 1 1 ·       response does not depend on the size.
//!        …                    …
//! ```
//!
//! The rows of the integral image are first combined with the filter's vertical weights, then the
//! columns of that one row with the horizontal ones: ten look-ups and ten more for a determinant
//! instead of thirty-two, every one of them along contiguous memory. Up to the last
//! multiplications all is in integers, so no order of summation can change a bit.

use super::integral::IntegralImage;

/// How much the mixed derivative counts: the boxes' norm ratio of Bay et al., equation 4, squared.
const MIXED_WEIGHT: f32 = 0.81;

/// The three box filters of one size.
#[derive(Clone, Debug)]
pub(super) struct Filter {
    /// Side of the filter, px: `taps * step_px`.
    pub size_px: usize,
    /// Side of the filter in sampling steps, an odd number.
    pub taps: usize,
    /// Distance of neighbouring samples, px.
    pub step_px: usize,
    /// Where the `n`-th ninth of the side ends, px.
    ninth_px: [usize; 10],
    /// One over the area of a box of D_xx and D_yy.
    per_area: f32,
    /// One over the area of a box of D_xy.
    per_mixed_area: f32,
}

/// The working memory of [`Filter::respond`].
#[derive(Debug, Default)]
pub(super) struct Columns {
    /// One row of integral rows combined with the vertical weights of D_xx, D_yy and D_xy.
    combined: [Vec<i32>; 3],
    /// The same with every `step_px`-th column side by side.
    sorted: [Vec<i32>; 3],
}

impl Columns {
    /// Makes room for rows of `len` sums.
    fn reserve(&mut self, len: usize, step: usize) {
        self.combined.iter_mut().for_each(|row| row.resize(len, 0));
        let sorted_len = len.div_ceil(step) * step;
        self.sorted.iter_mut().for_each(|row| {
            row.resize(if step == 1 { 0 } else { sorted_len }, 0);
        });
    }

    /// Elements held.
    #[cfg(test)]
    pub(super) fn capacity(&self) -> usize {
        let rows = self.combined.iter().chain(&self.sorted);
        rows.map(Vec::capacity).sum()
    }
}

impl Filter {
    /// The filter of layer `layer` in octave `octave`, both counted from 0.
    pub(super) fn new(octave: u32, layer: usize) -> Self {
        let step_px = 1_usize << octave;
        let taps = 9 + 6 * layer;
        let size_px = taps * step_px;
        // The side is a multiple of three, so a multiple of a ninth of it is never half a pixel.
        let ninth_px = std::array::from_fn(|n| (2 * n * size_px + 9) / 18);
        let third = ninth_px[3];
        Self {
            size_px,
            taps,
            step_px,
            ninth_px,
            per_area: 1.0 / (third * (ninth_px[7] - ninth_px[2])) as f32,
            per_mixed_area: 1.0 / (third * third) as f32,
        }
    }

    /// How many samples from the border the first complete one lies.
    pub(super) fn margin(&self) -> usize {
        self.taps / 2
    }

    /// Whether the filter fits into the image at all.
    pub(super) fn fits(&self, integral: &IntegralImage) -> bool {
        self.size_px <= integral.width() && self.size_px <= integral.height()
    }

    /// How many samples of row `row` are complete; where it is none, the filter reaches beyond the
    /// image's upper or lower border there.
    pub(super) fn samples(&self, integral: &IntegralImage, row: usize) -> usize {
        let complete = self.fits(integral)
            && row >= self.margin()
            && (row - self.margin()) * self.step_px + self.size_px <= integral.height();
        if complete {
            1 + (integral.width() - self.size_px) / self.step_px
        } else {
            0
        }
    }

    /// The determinants of row `row`, which has [`Self::samples`], to the samples of `out` from
    /// [`Self::margin`] on.
    pub(super) fn respond(
        &self,
        integral: &IntegralImage,
        row: usize,
        columns: &mut Columns,
        out: &mut [f32],
    ) {
        #[cfg(target_arch = "x86_64")]
        if std::is_x86_feature_detected!("avx2") {
            // SAFETY: the processor has AVX2, as just asked.
            unsafe { self.respond_avx2(integral, row, columns, out) };
            return;
        }
        self.respond_anywhere(integral, row, columns, out);
    }

    /// [`Self::respond_anywhere`] compiled for wider registers: the same operations on the same
    /// numbers, hence the same bits.
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn respond_avx2(
        &self,
        integral: &IntegralImage,
        row: usize,
        columns: &mut Columns,
        out: &mut [f32],
    ) {
        self.respond_anywhere(integral, row, columns, out);
    }

    #[inline(always)]
    fn respond_anywhere(
        &self,
        integral: &IntegralImage,
        row: usize,
        columns: &mut Columns,
        out: &mut [f32],
    ) {
        let samples = self.samples(integral, row);
        let top = (row - self.margin()) * self.step_px;
        let sums: [&[i32]; 10] = std::array::from_fn(|n| integral.row(top + self.ninth_px[n]));
        columns.reserve(integral.width() + 1, self.step_px);
        let [xx, yy, xy] = &mut columns.combined;
        difference([sums[2], sums[7]], xx);
        second_difference([sums[0], sums[3], sums[6], sums[9]], yy);
        mixed_difference([sums[1], sums[4], sums[5], sums[8]], xy);
        if self.step_px > 1 {
            for (from, to) in columns.combined.iter().zip(&mut columns.sorted) {
                sort_columns(self.step_px, from, to);
            }
        }
        let [xx, yy, xy] = if self.step_px > 1 {
            &columns.sorted
        } else {
            &columns.combined
        };
        let at = |row, n| self.samples_at(row, n, samples);
        self.determinants(
            [at(xx, 0), at(xx, 3), at(xx, 6), at(xx, 9)],
            [at(yy, 2), at(yy, 7)],
            [at(xy, 1), at(xy, 4), at(xy, 5), at(xy, 8)],
            &mut out[self.margin()..][..samples],
        );
    }

    /// The entries `ninth_px[n] + step_px * j` of a row with sorted columns, for `samples` of `j`.
    #[inline(always)]
    fn samples_at<'a>(&self, sorted: &'a [i32], n: usize, samples: usize) -> &'a [i32] {
        let offset = self.ninth_px[n];
        let run = sorted.len() / self.step_px;
        &sorted[offset % self.step_px * run + offset / self.step_px..][..samples]
    }

    #[inline(always)]
    fn determinants(&self, xx: [&[i32]; 4], yy: [&[i32]; 2], xy: [&[i32]; 4], out: &mut [f32]) {
        let len = out.len();
        let (xx, yy, xy) = (
            xx.map(|s| &s[..len]),
            yy.map(|s| &s[..len]),
            xy.map(|s| &s[..len]),
        );
        for j in 0..len {
            let sum_xx = second(xx[0][j], xx[1][j], xx[2][j], xx[3][j]);
            let sum_yy = yy[1][j].wrapping_sub(yy[0][j]);
            let sum_xy = mixed(xy[0][j], xy[1][j], xy[2][j], xy[3][j]);
            let d_xx = sum_xx as f32 * self.per_area;
            let d_yy = sum_yy as f32 * self.per_area;
            let d_xy = sum_xy as f32 * self.per_mixed_area;
            out[j] = d_xx * d_yy - MIXED_WEIGHT * d_xy * d_xy;
        }
    }

    /// The Laplacian's sign at sample `(row, column)`: +1 for a dark blob, −1 for a light one.
    pub(super) fn laplacian_sign(&self, integral: &IntegralImage, row: usize, column: usize) -> i8 {
        let n = &self.ninth_px;
        let left = (column - self.margin()) * self.step_px;
        let top = (row - self.margin()) * self.step_px;
        let rows: [&[i32]; 10] = std::array::from_fn(|k| &integral.row(top + n[k])[left..]);
        let strip = |x: usize| rows[7][n[x]].wrapping_sub(rows[2][n[x]]);
        let sum_xx = second(strip(0), strip(3), strip(6), strip(9));
        let strip = |y: usize| rows[y][n[7]].wrapping_sub(rows[y][n[2]]);
        let sum_yy = second(strip(0), strip(3), strip(6), strip(9));
        (i64::from(sum_xx) + i64::from(sum_yy)).signum() as i8
    }
}

/// Weights 1, −2, 1 on the three stretches between four cumulated values.
#[inline(always)]
fn second(a: i32, b: i32, c: i32, d: i32) -> i32 {
    let gap = b.wrapping_sub(c);
    d.wrapping_sub(a)
        .wrapping_add(gap.wrapping_add(gap).wrapping_add(gap))
}

/// Weights 1 and −1 on the stretches from `a` to `b` and from `c` to `d`.
#[inline(always)]
fn mixed(a: i32, b: i32, c: i32, d: i32) -> i32 {
    b.wrapping_sub(a).wrapping_sub(d.wrapping_sub(c))
}

#[inline(always)]
fn difference(from: [&[i32]; 2], to: &mut [i32]) {
    let from = from.map(|row| &row[..to.len()]);
    for x in 0..to.len() {
        to[x] = from[1][x].wrapping_sub(from[0][x]);
    }
}

#[inline(always)]
fn second_difference(from: [&[i32]; 4], to: &mut [i32]) {
    let from = from.map(|row| &row[..to.len()]);
    for x in 0..to.len() {
        to[x] = second(from[0][x], from[1][x], from[2][x], from[3][x]);
    }
}

#[inline(always)]
fn mixed_difference(from: [&[i32]; 4], to: &mut [i32]) {
    let from = from.map(|row| &row[..to.len()]);
    for x in 0..to.len() {
        to[x] = mixed(from[0][x], from[1][x], from[2][x], from[3][x]);
    }
}

/// Brings the columns `p, p + step, p + 2 step, …` together, one run after the other for each `p`.
#[inline(always)]
fn sort_columns(step: usize, from: &[i32], to: &mut [i32]) {
    let run = to.len() / step;
    match step {
        2 => sort_columns_by::<2>(run, from, to),
        4 => sort_columns_by::<4>(run, from, to),
        _ => {
            for (p, to) in to.chunks_exact_mut(run).enumerate() {
                let column = from.iter().skip(p).step_by(step);
                to.iter_mut().zip(column).for_each(|(t, &f)| *t = f);
            }
        }
    }
}

/// [`sort_columns`] for a step known to the compiler.
#[inline(always)]
fn sort_columns_by<const STEP: usize>(run: usize, from: &[i32], to: &mut [i32]) {
    let (groups, rest) = from.as_chunks::<STEP>();
    for p in 0..STEP {
        let to = &mut to[p * run..][..run];
        to.iter_mut().zip(groups).for_each(|(t, f)| *t = f[p]);
        if let (Some(last), Some(&value)) = (to.last_mut(), rest.get(p)) {
            *last = value;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::GrayImage;
    use rand::{RngExt, SeedableRng};
    use rand_xoshiro::Xoshiro256PlusPlus;

    fn noise(width: u32, height: u32) -> GrayImage {
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(11);
        let pixels = (0..width * height).map(|_| rng.random()).collect();
        GrayImage::from_vec(width, height, pixels).unwrap_or_default()
    }

    /// The mean of the pixels of a box given in ninths of the filter's side.
    fn mean(image: &GrayImage, filter: &Filter, corner: (usize, usize), ninths: [usize; 4]) -> f64 {
        let px = |n: usize| (n as f64 * filter.size_px as f64 / 9.0).round() as usize;
        let [x0, y0, x1, y1] = ninths.map(px);
        let rows = (corner.1 + y0..corner.1 + y1).map(|y| &image.row(y as u32)[corner.0..]);
        let sum: f64 = rows
            .flat_map(|row| &row[x0..x1])
            .map(|&p| f64::from(p))
            .sum();
        sum / ((x1 - x0) * (y1 - y0)) as f64
    }

    #[test]
    fn determinants_are_those_of_naive_box_sums() {
        let image = noise(131, 97);
        let mut integral = IntegralImage::default();
        integral.compute(&image);
        let mut columns = Columns::default();
        for (octave, layer) in (0..4).flat_map(|o| (0..5).map(move |l| (o, l))) {
            let filter = Filter::new(octave, layer);
            for row in 0..97 >> octave {
                let samples = filter.samples(&integral, row);
                let mut out = vec![f32::NAN; 131];
                if samples > 0 {
                    filter.respond(&integral, row, &mut columns, &mut out);
                }
                for j in (0..samples).step_by(3) {
                    let top = (row - filter.margin()) * filter.step_px;
                    let b = |n| mean(&image, &filter, (j * filter.step_px, top), n);
                    let xx = b([0, 2, 3, 7]) - 2.0 * b([3, 2, 6, 7]) + b([6, 2, 9, 7]);
                    let yy = b([2, 0, 7, 3]) - 2.0 * b([2, 3, 7, 6]) + b([2, 6, 7, 9]);
                    let xy = b([1, 1, 4, 4]) - b([5, 1, 8, 4]) - b([1, 5, 4, 8]) + b([5, 5, 8, 8]);
                    let expected = xx * yy - 0.81 * xy * xy;
                    let found = f64::from(out[filter.margin() + j]);
                    let scale = (xx * yy).abs() + xy * xy;
                    assert!(
                        (found - expected).abs() <= 1e-6 * scale,
                        "{found} {expected}"
                    );
                    let sign = filter.laplacian_sign(&integral, row, filter.margin() + j);
                    assert!(f64::from(sign) * (xx + yy) >= 0.0);
                }
            }
        }
    }

    #[test]
    fn wider_registers_give_the_same_bits() {
        let image = noise(301, 97);
        let mut integral = IntegralImage::default();
        integral.compute(&image);
        let mut columns = Columns::default();
        for (octave, layer) in (0..4).flat_map(|o| (0..5).map(move |l| (o, l))) {
            let filter = Filter::new(octave, layer);
            for row in (0..97 >> octave).filter(|&row| filter.samples(&integral, row) > 0) {
                let (mut wide, mut plain) = (vec![0.0; 301], vec![0.0; 301]);
                filter.respond(&integral, row, &mut columns, &mut wide);
                filter.respond_anywhere(&integral, row, &mut columns, &mut plain);
                assert_eq!(wide, plain);
            }
        }
    }

    #[test]
    fn brightest_images_do_not_overflow() {
        // 20 million white pixels: the integral image wraps, the responses must not notice.
        let mut pixels = vec![255_u8; 5000 * 4000];
        let dark = |x: usize, y: usize| x.abs_diff(4500).pow(2) + y.abs_diff(3500).pow(2) < 36;
        (3490..3510).for_each(|y| {
            (4490..4510)
                .filter(|&x| dark(x, y))
                .for_each(|x| pixels[y * 5000 + x] = 0);
        });
        let image = GrayImage::from_vec(5000, 4000, pixels).unwrap_or_default();
        let mut integral = IntegralImage::default();
        integral.compute(&image);
        let filter = Filter::new(0, 2);
        let mut out = vec![0.0; 5000];
        filter.respond(&integral, 3500, &mut Columns::default(), &mut out);
        assert!(out[4500] > 1000.0);
        assert!(out[10..4400].iter().all(|&v| v == 0.0));
        assert_eq!(filter.laplacian_sign(&integral, 3500, 4500), 1);
    }
}
