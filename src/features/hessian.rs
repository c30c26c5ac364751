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
//! instead of thirty-two, every one of them along contiguous memory. Where samples are steps apart,
//! only those columns are combined that share their remainder with one that is looked up. Up to the
//! last multiplications all is in integers, so no order of summation can change a bit.

use super::integral::{IntegralImage, SortedColumns};
use crate::simd::widened;

/// How much the mixed derivative counts: the boxes' norm ratio of Bay et al., equation 4, squared.
const MIXED_WEIGHT: f32 = 0.81;

/// The three box filters of one size.
#[derive(Clone, Debug)]
pub(super) struct Filter {
    /// Side of the filter, px.
    pub size_px: usize,
    /// Distance of neighbouring samples, px.
    pub step_px: usize,
    /// How many pixels of the filter come before the one that a sample is named after: sample `n` is of pixel
    /// `n * step_px`.
    before_px: usize,
    /// Where the `n`-th ninth of the side ends, px.
    ninth_px: [usize; 10],
    /// One over the area of a box of D_xx and D_yy.
    per_area: f32,
    /// One over the area of a box of D_xy.
    per_mixed_area: f32,
}

/// The ninths of a filter's side at which D_xx, D_yy and D_xy look up columns; rows are looked up at those of D_yy, D_xx
/// and D_xy.
const XX: [usize; 4] = [0, 3, 6, 9];
const YY: [usize; 2] = [2, 7];
const XY: [usize; 4] = [1, 4, 5, 8];

/// Stretches of combined rows at most: one for each column that is looked up.
const MOST_STRETCHES: usize = XX.len() + YY.len() + XY.len();

/// The working memory of [`Filter::respond`]: stretches of integral rows, combined with the vertical
/// weights of D_xx, D_yy or D_xy.
#[derive(Debug, Default)]
pub(super) struct Combined(Vec<i32>);

impl Combined {
    /// Stretches of `len` sums, as many as a filter needs at most.
    fn stretches(&mut self, len: usize) -> &mut [i32] {
        let all = MOST_STRETCHES * len;
        if self.0.len() < all {
            self.0.resize(all, 0);
        }
        &mut self.0[..all]
    }

    /// Elements held.
    #[cfg(test)]
    pub(super) fn capacity(&self) -> usize {
        self.0.capacity()
    }
}

impl Filter {
    /// The filter of layer `layer` in octave `octave`, both counted from 0; in the first octave samples are
    /// `sampling_px` apart, a power of two.
    pub(super) fn new(octave: u32, layer: usize, sampling_px: usize) -> Self {
        let taps = 9 + 6 * layer;
        let size_px = taps << octave;
        // The side is a multiple of three, so a multiple of a ninth of it is never half a pixel.
        let ninth_px = std::array::from_fn(|n| (2 * n * size_px + 9) / 18);
        let third = ninth_px[3];
        Self {
            size_px,
            step_px: sampling_px << octave,
            before_px: (taps / 2) << octave,
            ninth_px,
            per_area: 1.0 / (third * (ninth_px[7] - ninth_px[2])) as f32,
            per_mixed_area: 1.0 / (third * third) as f32,
        }
    }

    /// How many samples from the border the first complete one lies.
    #[inline]
    pub(super) fn margin(&self) -> usize {
        self.before_px.div_ceil(self.step_px)
    }

    /// The pixel row or column that the filter begins at, of a sample that is complete.
    #[inline(always)]
    fn begin_px(&self, sample: usize) -> usize {
        sample * self.step_px - self.before_px
    }

    /// The middle of the filter at a sample, px; it has an even number of pixels from the second octave on.
    #[inline]
    pub(super) fn middle_px(&self, sample: usize) -> f32 {
        let after_px = self.size_px - 1 - self.before_px;
        let beyond_px = (after_px - self.before_px) as f32;
        (sample * self.step_px) as f32 + 0.5 * beyond_px
    }

    /// Whether the filter fits into the image at all.
    #[inline]
    pub(super) fn fits(&self, integral: &IntegralImage) -> bool {
        self.size_px <= integral.width() && self.size_px <= integral.height()
    }

    /// How many samples of row `row` are complete; where it is none, the filter reaches beyond the
    /// image's upper or lower border there.
    #[inline]
    pub(super) fn samples(&self, integral: &IntegralImage, row: usize) -> usize {
        let complete = self.fits(integral)
            && row >= self.margin()
            && self.begin_px(row) + self.size_px <= integral.height();
        if complete {
            (integral.width() + self.before_px - self.size_px) / self.step_px + 1 - self.margin()
        } else {
            0
        }
    }

    /// The determinants of samples of a row, from sample `(row, column)` on; all are among the
    /// row's [`Self::samples`]. The columns are sorted by this filter's step.
    pub(super) fn respond(
        &self,
        integral: &IntegralImage,
        columns: &SortedColumns,
        (row, column): (usize, usize),
        combined: &mut Combined,
        out: &mut [f32],
    ) {
        debug_assert_eq!(columns.step(), self.step_px);
        let (top, left) = (self.begin_px(row), self.begin_px(column));
        let rows = self
            .ninth_px
            .map(|ninth_px| columns.row(integral, top + ninth_px));
        // A column is every `step_px`-th of those that it shares its remainder with.
        let starts = self
            .ninth_px
            .map(|ninth_px| columns.place(left + ninth_px % self.step_px));
        let len = out.len() + self.size_px / self.step_px;
        respond(self, &rows, &starts, combined.stretches(len), out);
    }

    /// The determinant at sample `(row, column)`, to the last bit what [`Self::respond`] gives.
    pub(super) fn determinant(&self, integral: &IntegralImage, row: usize, column: usize) -> f32 {
        let corners = self.corners(row, column);
        let at = |y: usize, x: usize| integral.at(corners[0][y], corners[1][x]);
        let [xx, yy] = second_sums(&at);
        let pillar = |x: usize| mixed(at(1, x), at(4, x), at(5, x), at(8, x));
        let xy = mixed(pillar(1), pillar(4), pillar(5), pillar(8));
        self.weighed(xx, yy, xy)
    }

    /// The Laplacian's sign at sample `(row, column)`: +1 for a dark blob, −1 for a light one.
    pub(super) fn laplacian_sign(&self, integral: &IntegralImage, row: usize, column: usize) -> i8 {
        let corners = self.corners(row, column);
        let [xx, yy] = second_sums(&|y: usize, x: usize| integral.at(corners[0][y], corners[1][x]));
        (i64::from(xx) + i64::from(yy)).signum() as i8
    }

    /// The rows and the columns at the filter's ninths around a sample.
    #[inline(always)]
    fn corners(&self, row: usize, column: usize) -> [[usize; 10]; 2] {
        [self.begin_px(row), self.begin_px(column)]
            .map(|from| self.ninth_px.map(|ninth_px| from + ninth_px))
    }

    /// The determinant from the sums over the boxes.
    #[inline(always)]
    fn weighed(&self, xx: i32, yy: i32, xy: i32) -> f32 {
        let d_xx = xx as f32 * self.per_area;
        let d_yy = yy as f32 * self.per_area;
        let d_xy = xy as f32 * self.per_mixed_area;
        d_xx * d_yy - MIXED_WEIGHT * d_xy * d_xy
    }
}

widened! {
    /// Determinants from the ten integral rows at a filter's ninths, and where in these the columns begin
    /// that share their remainder with each ninth.
    fn respond = respond_narrow, (
        filter: &Filter,
        rows: &[&[i32]; 10],
        starts: &[usize; 10],
        stretches: &mut [i32],
        out: &mut [f32],
    )
}

#[inline(always)]
fn respond_narrow(
    filter: &Filter,
    rows: &[&[i32]; 10],
    starts: &[usize; 10],
    stretches: &mut [i32],
    out: &mut [f32],
) {
    let len = out.len() + filter.size_px / filter.step_px;
    let mut room = Room {
        filter,
        starts,
        len,
        stretches,
        used: 0,
        places: [0; 10],
    };
    for n in 0..XX.len() {
        if let Some((start, sums)) = room.place(&XX, n) {
            let row = |n: usize| &rows[n][start..][..len];
            let (r2, r7) = (row(2), row(7));
            for x in 0..len {
                sums[x] = r7[x].wrapping_sub(r2[x]);
            }
        }
    }
    room.combine_four(rows, XX, &YY, second);
    room.combine_four(rows, XY, &XY, mixed);
    let Room {
        stretches, places, ..
    } = room;
    weigh(filter, stretches, &places, out);
}

/// Stretches of combined rows, one after the other, the last ones free as yet.
struct Room<'a> {
    filter: &'a Filter,
    starts: &'a [usize; 10],
    len: usize,
    stretches: &'a mut [i32],
    used: usize,
    /// Where the column of each ninth stands in the stretches.
    places: [usize; 10],
}

impl Room<'_> {
    /// Gives the column at the `n`-th of some ninths, for which rows are combined alike, its place: in the
    /// stretch of an earlier one with the same remainder, or in a new one, which is then to be filled from where
    /// it begins in the rows.
    #[inline(always)]
    fn place(&mut self, ninths: &[usize], n: usize) -> Option<(usize, &mut [i32])> {
        let steps = |ninth: usize| self.filter.ninth_px[ninth] / self.filter.step_px;
        let start = self.starts[ninths[n]];
        let like = ninths[..n].iter().find(|&&m| self.starts[m] == start);
        if let Some(&m) = like {
            self.places[ninths[n]] = self.places[m] - steps(m) + steps(ninths[n]);
            return None;
        }
        let stretch = self.used;
        self.places[ninths[n]] = stretch + steps(ninths[n]);
        self.used += self.len;
        Some((start, &mut self.stretches[stretch..][..self.len]))
    }

    /// Combines the rows at four ninths for the columns at others.
    #[inline(always)]
    fn combine_four(
        &mut self,
        rows: &[&[i32]; 10],
        [a, b, c, d]: [usize; 4],
        columns: &[usize],
        combined: impl Fn(i32, i32, i32, i32) -> i32,
    ) {
        let len = self.len;
        for n in 0..columns.len() {
            if let Some((start, sums)) = self.place(columns, n) {
                let row = |n: usize| &rows[n][start..][..len];
                let (a, b, c, d) = (row(a), row(b), row(c), row(d));
                for x in 0..len {
                    sums[x] = combined(a[x], b[x], c[x], d[x]);
                }
            }
        }
    }
}

/// Determinants from the combined rows.
#[inline(always)]
fn weigh(filter: &Filter, stretches: &[i32], places: &[usize; 10], out: &mut [f32]) {
    let len = out.len();
    let column = |n: usize| &stretches[places[n]..][..len];
    let (x0, x3, x6, x9) = (column(0), column(3), column(6), column(9));
    let (y2, y7) = (column(2), column(7));
    let (m1, m4, m5, m8) = (column(1), column(4), column(5), column(8));
    for j in 0..len {
        let xx = second(x0[j], x3[j], x6[j], x9[j]);
        let yy = y7[j].wrapping_sub(y2[j]);
        let xy = mixed(m1[j], m4[j], m5[j], m8[j]);
        out[j] = filter.weighed(xx, yy, xy);
    }
}

/// D_xx and D_yy times the area of their boxes, from the integral image at a row's and a column's
/// ninth of a filter.
#[inline(always)]
fn second_sums(at: &impl Fn(usize, usize) -> i32) -> [i32; 2] {
    let xx = |x: usize| at(7, x).wrapping_sub(at(2, x));
    let yy = |y: usize| at(y, 7).wrapping_sub(at(y, 2));
    [
        second(xx(0), xx(3), xx(6), xx(9)),
        second(yy(0), yy(3), yy(6), yy(9)),
    ]
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
        let mut combined = Combined::default();
        let octaves = [1, 2].into_iter().flat_map(|s| (0..4).map(move |o| (s, o)));
        for (sampling_px, octave, layer) in
            octaves.flat_map(|(s, o)| (0..5).map(move |l| (s, o, l)))
        {
            let filter = Filter::new(octave, layer, sampling_px);
            let columns = sorted(&integral, filter.step_px);
            for row in 0..97 / filter.step_px {
                let samples = filter.samples(&integral, row);
                let mut out = vec![f32::NAN; 131];
                if samples > 0 {
                    let out = &mut out[filter.margin()..][..samples];
                    filter.respond(
                        &integral,
                        &columns,
                        (row, filter.margin()),
                        &mut combined,
                        out,
                    );
                }
                for j in (0..samples).step_by(3) {
                    let corner = [filter.margin() + j, row].map(|n| filter.begin_px(n));
                    let b = |n| mean(&image, &filter, corner.into(), n);
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
                    let single = filter.determinant(&integral, row, filter.margin() + j);
                    assert_eq!(single.to_bits(), out[filter.margin() + j].to_bits());
                    let sign = filter.laplacian_sign(&integral, row, filter.margin() + j);
                    assert!(f64::from(sign) * (xx + yy) >= 0.0);
                }
            }
        }
    }

    fn sorted(integral: &IntegralImage, step_px: usize) -> SortedColumns {
        let mut columns = SortedColumns::default();
        columns.begin(integral, step_px);
        columns.widen(integral, step_px);
        columns
    }

    #[test]
    fn wider_registers_give_the_same_bits() {
        let image = noise(301, 97);
        let mut integral = IntegralImage::default();
        integral.compute(&image);
        for layer in 0..5 {
            let filter = Filter::new(0, layer, 1);
            let rows = filter.ninth_px.map(|y| integral.row(y));
            let samples = filter.samples(&integral, filter.margin());
            let (mut wide, mut narrow) = (vec![0.0; samples], vec![1.0; samples]);
            let mut stretches = vec![0; MOST_STRETCHES * 302];
            respond(&filter, &rows, &[0; 10], &mut stretches, &mut wide);
            respond_narrow(&filter, &rows, &[0; 10], &mut stretches, &mut narrow);
            assert_eq!(wide, narrow);
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
        let filter = Filter::new(0, 2, 1);
        let mut out = vec![0.0; 5000];
        let columns = sorted(&integral, 1);
        filter.respond(
            &integral,
            &columns,
            (3500, filter.margin()),
            &mut Combined::default(),
            &mut out[filter.margin()..5000 - filter.margin()],
        );
        assert!(out[4500] > 1000.0);
        assert!(out[10..4400].iter().all(|&v| v == 0.0));
        assert_eq!(filter.laplacian_sign(&integral, 3500, 4500), 1);
    }
}
