//! A patch: what surrounds a point in one image in, where the same lies in another image out, with
//! its covariance.
//!
//! Inverse compositional alignment (Baker & Matthews 2004) of a translation, brightness and
//! contrast free: gradients are the template's, so that their normal equations are solved once. The
//! surface's slope is estimated along with the translation, by what is known of it before; a
//! translation that stands for a slope would be off.

use crate::geometry::definite;
use crate::image::GrayImage;
use crate::simd::{round_i32, widened};
use nalgebra::{Matrix2, Matrix4, Vector2, Vector4};

/// Half the side of a patch, samples.
pub(super) const HALF: usize = 5;
/// Samples a side.
const SIDE: usize = 2 * HALF + 1;
/// Samples of a patch.
const AREA: usize = SIDE * SIDE;
/// Floats that hold them, zeros at the end: a multiple of what registers hold, and room for a last row of
/// whole registers.
const ROOM: usize = (AREA - SIDE + WIDE_SIDE).next_multiple_of(LANES);
/// Sums that run side by side.
const LANES: usize = 8;
/// A side of whole registers.
const WIDE_SIDE: usize = SIDE.next_multiple_of(LANES);
/// A side of the template with the rim that its gradients need.
const RIM_SIDE: usize = SIDE + 2;
/// Samples of a template with its rim.
const RIM_AREA: usize = RIM_SIDE * RIM_SIDE;
/// Floats that hold them and what whole registers read behind the last.
const RIM_ROOM: usize = (RIM_AREA + WIDE_SIDE - SIDE).next_multiple_of(LANES);
/// Room that a patch needs around its centre in the target, px of the level.
const MARGIN: f32 = HALF as f32 + 1.0;

/// Iterations at most.
const MAX_ITERATIONS: usize = 12;
/// A step that ends the alignment, px of the level.
const MIN_STEP: f64 = 0.003;
/// Weakest contrast of a template, grey levels (standard deviation).
const MIN_CONTRAST: f32 = 2.0;
/// Least correlation of what was found with the template.
const MIN_CORRELATION: f32 = 0.9;
/// Neighbouring samples share their deviations, as smoothing and interpolation do with the image's
/// noise: so many count as one.
const SHARED: f64 = 4.5;
/// Rounding to whole grey levels, once in each image: variance 1/12 each, less what smoothing takes.
const ROUNDING_VARIANCE: f64 = 0.1;
/// Variance of a sample, shared, before the alignment tells, grey levels².
const USUAL_VARIANCE: f64 = 4.0;

/// Samples of a patch.
type Samples = [f32; ROOM];

/// How a template depends on its surface's slope.
#[derive(Clone, Copy, Debug)]
pub struct Surface {
    /// The patch's displacement against what lies at infinity, px of the target's level.
    pub lever: Vector2<f64>,
    /// Maps an offset in px of the target's level into the px in which the slope counts.
    pub spread: Matrix2<f64>,
    /// What is known of the slope: how far it is from the one that the template is made with.
    pub gap: Vector2<f64>,
    /// Its information.
    pub information: Matrix2<f64>,
}

/// Maps an offset from the patch's centre in the target's level into the image that the template is
/// sampled from: a homography that keeps the centre, `linear · q / (1 − depth · q)`.
#[derive(Clone, Copy, Debug)]
pub struct Warp {
    /// The derivative at the centre.
    pub linear: Matrix2<f32>,
    /// Share by which depth grows with each px of the target's level.
    pub depth: Vector2<f32>,
}

/// What a point looks like, ready for alignment.
#[derive(Clone, Debug)]
pub struct Template {
    /// Grey values less their mean.
    values: Samples,
    /// Derivatives, less what brightness and contrast would explain, by place (per px of the target's
    /// level) and by slope.
    by: [Samples; 4],
    /// Sum of squared values.
    energy: f32,
    /// The derivatives' normal equations.
    normal: Matrix4<f64>,
    /// What is known of the slope: information, and that times the gap.
    known: (Matrix4<f64>, Vector4<f64>),
}

/// Where a template was found.
#[derive(Clone, Copy, Debug)]
pub struct Aligned {
    /// Position, px of the level.
    pub at: Vector2<f32>,
    /// Covariance of one image's share in it, px² of the level.
    pub cov: Matrix2<f64>,
    /// How far the slope is from the one that the template is made with.
    pub gap: Vector2<f64>,
    /// Its information.
    pub information: Matrix2<f64>,
    /// Correlation of target and template, −1 to 1.
    pub correlation: f32,
}

impl Template {
    /// The surroundings of `centre` in `image`, sampled where a square grid of the target's pixels
    /// falls.
    ///
    /// `None` where they leave the image, or are too flat to be found again.
    #[must_use]
    pub fn new(
        image: &GrayImage,
        centre: &Vector2<f32>,
        warp: &Warp,
        surface: &Surface,
    ) -> Option<Self> {
        let mut template = Self::blank();
        template.fill(image, centre, warp, surface)?;
        Some(template)
    }

    /// One of nothing, to be filled.
    pub(super) fn blank() -> Self {
        Self {
            values: [0.0; ROOM],
            by: [[0.0; ROOM]; 4],
            energy: 0.0,
            normal: Matrix4::zeros(),
            known: (Matrix4::zeros(), Vector4::zeros()),
        }
    }

    /// Makes this one [new](Self::new); `None` where it would not be, which leaves nothing of use.
    pub(super) fn fill(
        &mut self,
        image: &GrayImage,
        centre: &Vector2<f32>,
        warp: &Warp,
        surface: &Surface,
    ) -> Option<()> {
        fill(self, image, centre, warp, surface)
    }

    #[inline(always)]
    fn take(&mut self, wide: &[f32; RIM_ROOM], surface: &Surface) -> Option<()> {
        let Self { values, by, .. } = self;
        let lever = surface.lever.map(|v| v as f32);
        let spread = surface.spread.map(|v| v as f32);
        let across: [f32; WIDE_SIDE] = std::array::from_fn(|column| column as f32 - HALF as f32);
        for row in 0..SIDE {
            // Whole registers: what is too much, the next row writes over.
            let line =
                |down: usize, right: usize| &wide[(row + down) * RIM_SIDE + right..][..WIDE_SIDE];
            let (here, above, below) = (line(1, 1), line(0, 1), line(2, 1));
            let (left, right) = (line(1, 0), line(1, 2));
            values[row * SIDE..][..WIDE_SIDE].copy_from_slice(here);
            let [by_0, by_1, by_2, by_3] =
                by.each_mut().map(|by| &mut by[row * SIDE..][..WIDE_SIDE]);
            let y = row as f32 - HALF as f32;
            for i in 0..WIDE_SIDE {
                let by_x = 0.5 * (right[i] - left[i]);
                let by_y = 0.5 * (below[i] - above[i]);
                let along = -(by_x * lever.x + by_y * lever.y);
                by_0[i] = by_x;
                by_1[i] = by_y;
                by_2[i] = along * (spread[(0, 0)] * across[i] + spread[(0, 1)] * y);
                by_3[i] = along * (spread[(1, 0)] * across[i] + spread[(1, 1)] * y);
            }
        }
        for samples in by.iter_mut().chain([&mut *values]) {
            samples[AREA..].fill(0.0);
        }
        centre_on_zero(values);
        let energy = dot(values, values);
        if energy < MIN_CONTRAST * MIN_CONTRAST * AREA as f32 {
            return None;
        }
        for derivative in by.iter_mut() {
            centre_on_zero(derivative);
            let share = dot(derivative, values) / energy;
            for (d, v) in derivative.iter_mut().zip(&*values) {
                *d -= share * v;
            }
        }
        let mut normal = Matrix4::zeros();
        for row in 0..4 {
            for column in row..4 {
                let sum = f64::from(dot(&by[row], &by[column]));
                normal[(row, column)] = sum;
                normal[(column, row)] = sum;
            }
        }
        let mut information = Matrix4::zeros();
        information
            .fixed_view_mut::<2, 2>(2, 2)
            .copy_from(&surface.information);
        let mut towards = Vector4::zeros();
        towards
            .fixed_rows_mut::<2>(2)
            .copy_from(&(surface.information * surface.gap));
        (self.energy, self.normal) = (energy, normal);
        self.known = (information, towards);
        Some(())
    }

    /// Finds the template in `image`, starting at `start` and at most `reach` px away from there.
    ///
    /// `None` where the search leaves the image or its reach, does not settle, or ends at something
    /// that looks different.
    #[must_use]
    pub fn align(&self, image: &GrayImage, start: &Vector2<f32>, reach: f32) -> Option<Aligned> {
        align(self, image, start, reach)
    }

    /// What an alignment came to that left `misfit`, whose products with the derivatives are
    /// `gradient`, and that `step` would end.
    fn judge(
        &self,
        at: Vector2<f32>,
        misfit: &Samples,
        gradient: &Vector4<f64>,
        step: &Vector4<f64>,
        correlation: f32,
    ) -> Option<Aligned> {
        if correlation.is_nan() || correlation < MIN_CORRELATION {
            return None;
        }
        let explained = 2.0 * step.dot(gradient) - step.dot(&(self.normal * step));
        let left = (f64::from(dot(misfit, misfit)) - explained).max(0.0);
        // Six parameters were fitted; template and target have half of the misfit each.
        let variance = left / (AREA - 6) as f64;
        let share = SHARED * (0.5 * variance + ROUNDING_VARIANCE);
        let cov = definite::inverse(&(self.normal / share + self.known.0))?;
        let step = cov * (gradient / share + self.known.1);
        Some(Aligned {
            at: at - step.xy().map(|v| v as f32),
            cov: cov.fixed_view::<2, 2>(0, 0).into_owned(),
            gap: step.fixed_rows::<2>(2).into_owned(),
            information: cov.fixed_view::<2, 2>(2, 2).try_inverse()?,
            correlation,
        })
    }
}

widened! {
    fn fill = fill_in, (
        template: &mut Template,
        image: &GrayImage,
        centre: &Vector2<f32>,
        warp: &Warp,
        surface: &Surface,
    ) -> Option<()>
}

widened! {
    fn align = align_in, (template: &Template, image: &GrayImage, start: &Vector2<f32>, reach: f32) -> Option<Aligned>
}

#[inline(always)]
fn fill_in(
    template: &mut Template,
    image: &GrayImage,
    centre: &Vector2<f32>,
    warp: &Warp,
    surface: &Surface,
) -> Option<()> {
    let reach = (HALF + 1) as f32;
    let nearest = 1.0 - reach * warp.depth.abs().sum();
    if nearest < 0.5 {
        return None;
    }
    let linear = &warp.linear;
    let extent = Vector2::new(
        linear[(0, 0)].abs() + linear[(0, 1)].abs(),
        linear[(1, 0)].abs() + linear[(1, 1)].abs(),
    ) * (reach / nearest);
    if !holds(image, centre, &extent) {
        return None;
    }
    let (mut x, mut y) = ([0.0; RIM_ROOM], [0.0; RIM_ROOM]);
    for row in 0..RIM_SIDE {
        let v = row as f32 - reach;
        // Whole registers: what is too much, the next row writes over.
        let [x, y] = [&mut x, &mut y].map(|line| &mut line[row * RIM_SIDE..][..WIDE_SIDE]);
        for column in 0..WIDE_SIDE {
            let u = column as f32 - reach;
            let nearness = 1.0 - (warp.depth.x * u + warp.depth.y * v);
            x[column] = centre.x + (linear[(0, 0)] * u + linear[(0, 1)] * v) / nearness;
            y[column] = centre.y + (linear[(1, 0)] * u + linear[(1, 1)] * v) / nearness;
        }
    }
    template.take(&sample(image, &x, &y), surface)
}

#[inline(always)]
fn align_in(
    template: &Template,
    image: &GrayImage,
    start: &Vector2<f32>,
    reach: f32,
) -> Option<Aligned> {
    let inverse = definite::inverse(&(template.normal + template.known.0 * USUAL_VARIANCE))?;
    let mut at = *start;
    let mut seen = [0.0; ROOM];
    for _ in 0..MAX_ITERATIONS {
        if !holds(image, &at, &Vector2::repeat(MARGIN)) || (at - start).amax() > reach {
            return None;
        }
        sample_square(image, &at, &mut seen);
        // Brightness and contrast leave no trace: the values have mean zero, and the derivatives are at right
        // angles to them and to brightness.
        let gain = dot(&seen, &template.values) / template.energy;
        if gain <= 0.1 {
            return None;
        }
        let [by_x, by_y, by_slope_x, by_slope_y] = &template.by;
        let gradient = Vector4::new(
            f64::from(dot(by_x, &seen)),
            f64::from(dot(by_y, &seen)),
            f64::from(dot(by_slope_x, &seen)),
            f64::from(dot(by_slope_y, &seen)),
        ) / f64::from(gain);
        let step = inverse * (gradient + template.known.1 * USUAL_VARIANCE);
        if step.xy().amax() < MIN_STEP {
            centre_on_zero(&mut seen);
            let correlation = gain * (template.energy / dot(&seen, &seen)).sqrt();
            for (s, v) in seen.iter_mut().zip(&template.values) {
                *s = *s / gain - v;
            }
            return template.judge(at, &seen, &gradient, &step, correlation);
        }
        at -= step.xy().map(|v| v as f32);
    }
    None
}

/// Whether all within `extent` of a position can be interpolated.
#[inline(always)]
fn holds(image: &GrayImage, at: &Vector2<f32>, extent: &Vector2<f32>) -> bool {
    at.x - extent.x >= 0.0
        && at.y - extent.y >= 0.0
        && at.x + extent.x < image.width() as f32 - 1.0
        && at.y + extent.y < image.height() as f32 - 1.0
}

/// Bilinear interpolation at many places, all inside the image; zeros behind the last.
#[inline(always)]
fn sample(image: &GrayImage, x: &[f32; RIM_ROOM], y: &[f32; RIM_ROOM]) -> [f32; RIM_ROOM] {
    let (width, pixels) = (image.width() as usize, image.pixels());
    let (mut right, mut low) = ([0.0; RIM_ROOM], [0.0; RIM_ROOM]);
    let mut places = [0_u32; RIM_ROOM];
    for i in 0..RIM_ROOM {
        let (column, row) = (floor(x[i]), floor(y[i]));
        (right[i], low[i]) = (x[i] - column as f32, y[i] - row as f32);
        places[i] = (row * width as i32 + column) as u32;
    }
    // Pixels lie anywhere, arithmetic can be done side by side. Two look-ups for the four around a place:
    // of equal length, so that one look at the place does for both.
    let last = pixels.len().saturating_sub(width);
    let (above, below) = (&pixels[..last], &pixels[pixels.len() - last..]);
    let mut quads = [0_u32; RIM_ROOM];
    for i in 0..RIM_AREA {
        let place = places[i] as usize;
        let [a, b] = [&above[place..][..2], &below[place..][..2]];
        quads[i] = u32::from_le_bytes([a[0], a[1], b[0], b[1]]);
    }
    let mut samples = [0.0; RIM_ROOM];
    for i in 0..RIM_ROOM {
        let corner = |n: u32| ((quads[i] >> (8 * n)) & 0xff) as i32 as f32;
        let upper = corner(0) * (1.0 - right[i]) + corner(1) * right[i];
        let lower = corner(2) * (1.0 - right[i]) + corner(3) * right[i];
        samples[i] = upper * (1.0 - low[i]) + lower * low[i];
    }
    samples
}

/// The largest integer that is not above `value`, whose magnitude is below 2²².
#[inline(always)]
fn floor(value: f32) -> i32 {
    let nearest = round_i32(value);
    nearest - i32::from(nearest as f32 > value)
}

/// The square of pixels around `at`, bilinear: all share their weights. What lies behind the last
/// sample is zero afterwards.
#[inline(always)]
fn sample_square(image: &GrayImage, at: &Vector2<f32>, out: &mut Samples) {
    let (x, y) = (at.x.floor(), at.y.floor());
    let (fx, fy) = (at.x - x, at.y - y);
    let weights = [
        (1.0 - fx) * (1.0 - fy),
        fx * (1.0 - fy),
        (1.0 - fx) * fy,
        fx * fy,
    ];
    let width = image.width() as usize;
    let first = (y as usize - HALF) * width + x as usize - HALF;
    let mut greys = [[[0.0; WIDE_SIDE]; 2]; SIDE + 1];
    for (row, greys) in greys.iter_mut().enumerate() {
        for (right, greys) in greys.iter_mut().enumerate() {
            let bytes = wide_row(image.pixels(), first + row * width + right);
            for i in 0..WIDE_SIDE {
                greys[i] = f32::from(bytes[i]);
            }
        }
    }
    for row in 0..SIDE {
        let [above, below] = [&greys[row], &greys[row + 1]];
        // Whole registers: what is too much, the next row writes over.
        let out = &mut out[row * SIDE..][..WIDE_SIDE];
        for i in 0..WIDE_SIDE {
            out[i] = weights[0] * above[0][i]
                + weights[1] * above[1][i]
                + weights[2] * below[0][i]
                + weights[3] * below[1][i];
        }
    }
    out[AREA..].fill(0.0);
}

/// A row of samples from pixel `first` on, and as many more as whole registers hold; zeros behind the image's
/// last.
#[inline(always)]
fn wide_row(pixels: &[u8], first: usize) -> [u8; WIDE_SIDE] {
    let row = &pixels[first..];
    if let Some(row) = row.first_chunk() {
        return *row;
    }
    let mut padded = [0; WIDE_SIDE];
    padded[..row.len()].copy_from_slice(row);
    padded
}

#[inline(always)]
fn centre_on_zero(values: &mut Samples) {
    let mut sums = [0.0; LANES];
    for values in values.as_chunks::<LANES>().0 {
        for (sum, v) in sums.iter_mut().zip(values) {
            *sum += v;
        }
    }
    let mean = sums.iter().sum::<f32>() / AREA as f32;
    for v in &mut values[..AREA] {
        *v -= mean;
    }
}

#[inline(always)]
fn dot(a: &Samples, b: &Samples) -> f32 {
    let mut sums = [0.0; LANES];
    let (a, b) = (a.as_chunks::<LANES>().0, b.as_chunks::<LANES>().0);
    for (a, b) in a.iter().zip(b) {
        for ((sum, a), b) in sums.iter_mut().zip(a).zip(b) {
            *sum += a * b;
        }
    }
    sums.iter().sum()
}

#[cfg(test)]
mod tests {
    use super::super::{FLOOR_PX, Pyramid};
    use super::*;
    use rand::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};
    use rand_xoshiro::Xoshiro256PlusPlus;

    /// A surface that is known to face the camera.
    const FACING: Surface = Surface {
        lever: Vector2::new(1.0, 0.0),
        spread: Matrix2::new(1.0, 0.0, 0.0, 1.0),
        gap: Vector2::new(0.0, 0.0),
        information: Matrix2::new(1e12, 0.0, 0.0, 1e12),
    };

    fn affine(warp: &Matrix2<f64>) -> Warp {
        Warp {
            linear: warp.map(|v| v as f32),
            depth: Vector2::zeros(),
        }
    }

    /// A smooth texture; `at` in px of the template's image.
    fn texture(at: Vector2<f64>) -> f64 {
        let waves = [
            (0.31, 0.12, 0.4),
            (-0.17, 0.42, 1.9),
            (0.55, -0.38, 2.6),
            (0.09, 0.73, 5.1),
        ];
        let sum: f64 = waves
            .iter()
            .map(|(kx, ky, phase)| (kx * at.x + ky * at.y + phase).sin())
            .sum();
        128.0 + 22.0 * sum
    }

    /// An image of the texture: its pixel p shows what lies at `warp · p + offset`, under noise.
    fn image(
        warp: &Matrix2<f64>,
        offset: &Vector2<f64>,
        gain: f64,
        noise: f64,
        rng: &mut Xoshiro256PlusPlus,
    ) -> GrayImage {
        let pixels = (0..64 * 64).map(|i| {
            let p = Vector2::new(f64::from(i % 64), f64::from(i / 64));
            let n: f64 = StandardNormal.sample(rng);
            (gain * texture(warp * p + offset) + noise * n)
                .round()
                .clamp(0.0, 255.0) as u8
        });
        let image = GrayImage::from_vec(64, 64, pixels.collect()).expect("full");
        let mut pyramid = Pyramid::default();
        pyramid.fill(&image);
        pyramid.level(0).clone()
    }

    fn find(seen: &GrayImage, first: &GrayImage, warp: &Matrix2<f64>) -> Option<Aligned> {
        let centre = Vector2::new(31.3, 30.6);
        let template = Template::new(first, &centre, &affine(warp), &FACING)?;
        template.align(seen, &Vector2::new(30.0, 32.0), 4.0)
    }

    #[test]
    fn a_shifted_and_scaled_patch_is_found_whatever_its_brightness() {
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(1);
        let identity = Matrix2::identity();
        let first = image(&identity, &Vector2::zeros(), 1.0, 0.0, &mut rng);
        for scale in [0.8, 1.0, 1.25] {
            for (x, y) in [(0.0, 0.0), (0.5, 0.25), (1.3, -0.7)] {
                let warp = Matrix2::new(scale, 0.02, -0.03, scale);
                // The patch's centre is to be seen here.
                let truth = Vector2::new(30.4 + x, 31.2 + y);
                let offset = Vector2::new(31.3, 30.6) - warp * truth;
                let seen = image(&warp, &offset, 0.7, 0.0, &mut rng);
                let found = find(&seen, &first, &warp).expect("plain to see");
                let error = (found.at.cast::<f64>() - truth).norm();
                assert!(error < 0.06, "scale {scale}, shift {x}, {y}: {error} px");
                assert!(found.correlation > 0.99);
            }
        }
    }

    #[test]
    fn the_covariance_covers_what_noise_does() {
        const RUNS: usize = 200;
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(2);
        let identity = Matrix2::identity();
        let truth = Vector2::new(30.4, 31.2);
        let offset = Vector2::new(31.3, 30.6) - truth;
        for noise in [2.0, 8.0] {
            let (mut squares, mut stated) = (Vector2::zeros(), Vector2::zeros());
            for _ in 0..RUNS {
                let first = image(&identity, &Vector2::zeros(), 1.0, noise, &mut rng);
                let seen = image(&identity, &offset, 1.0, noise, &mut rng);
                let found = find(&seen, &first, &identity).expect("plain to see");
                let error = found.at.cast::<f64>() - truth;
                squares += error.component_mul(&error) / RUNS as f64;
                // Template and target have one share each; the floor stands for interpolation.
                let floor = Vector2::repeat(FLOOR_PX * FLOOR_PX);
                stated += 2.0 * (found.cov.diagonal() + floor) / RUNS as f64;
            }
            for axis in 0..2 {
                let ratio = squares[axis] / stated[axis];
                assert!((0.05..1.2).contains(&ratio), "noise {noise}: {ratio}");
            }
        }
    }

    /// A surface whose slope nobody knows, seen with so much parallax.
    fn sloping(lever: Vector2<f64>, gap: Vector2<f64>) -> Surface {
        Surface {
            lever,
            spread: Matrix2::identity(),
            gap,
            information: Matrix2::identity() / (0.1 * 0.1),
        }
    }

    #[test]
    fn the_slope_is_found_and_does_not_draw_the_place_along() {
        const RUNS: usize = 100;
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(4);
        let identity = Matrix2::identity();
        let (lever, slope) = (Vector2::new(9.0, 3.0), Vector2::new(0.006, -0.005));
        let centre = Vector2::new(31.3, 30.6);
        let truth = Vector2::new(30.4, 31.2);
        let bent = (identity + lever * slope.transpose())
            .try_inverse()
            .expect("regular");
        let offset = centre - bent * truth;
        let known = Surface {
            information: FACING.information,
            ..sloping(lever, Vector2::zeros())
        };
        let (mut of_place, mut of_slope) = (0.0, 0.0);
        let (mut mean, mut mean_facing) = (Vector2::zeros(), Vector2::zeros());
        for _ in 0..RUNS {
            let first = image(&identity, &Vector2::zeros(), 1.0, 3.0, &mut rng);
            let seen = image(&bent, &offset, 1.0, 3.0, &mut rng);
            let find_on = |surface: &Surface| {
                let at = centre.map(|v: f64| v as f32);
                let template = Template::new(&first, &at, &affine(&identity), surface)?;
                template.align(&seen, &Vector2::new(30.0, 32.0), 4.0)
            };
            let found = find_on(&sloping(lever, Vector2::zeros())).expect("plain to see");
            let error = found.at.cast::<f64>() - truth;
            // Template and target have one share each.
            let cov = 2.0 * found.cov + Matrix2::identity() * (2.0 * FLOOR_PX * FLOOR_PX);
            let inverse = cov.try_inverse().expect("regular");
            of_place += error.dot(&(inverse * error)) / (2 * RUNS) as f64;
            let gap = found.gap - slope;
            of_slope += gap.dot(&(found.information * gap)) / (2 * RUNS) as f64;
            mean += error / RUNS as f64;
            let facing = find_on(&known).expect("plain to see");
            mean_facing += (facing.at.cast::<f64>() - truth) / RUNS as f64;
        }
        assert!((0.3..1.3).contains(&of_place), "{of_place}");
        // The template's own noise makes slopes come out a little too small.
        assert!((0.2..2.2).contains(&of_slope), "{of_slope}");
        assert!(mean_facing.norm() > 0.03, "{mean_facing}");
        assert!(
            mean.norm() < 0.4 * mean_facing.norm(),
            "{mean} {mean_facing}"
        );
    }

    #[test]
    fn what_is_flat_different_or_out_of_reach_is_refused() {
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(3);
        let identity = Matrix2::identity();
        let warp = affine(&identity);
        let first = image(&identity, &Vector2::zeros(), 1.0, 0.0, &mut rng);
        let centre = Vector2::new(31.0, 31.0);
        let flat = GrayImage::filled(64, 64, 90);
        assert!(Template::new(&flat, &centre, &warp, &FACING).is_none());
        assert!(Template::new(&first, &Vector2::new(3.0, 31.0), &warp, &FACING).is_none());
        let template = Template::new(&first, &centre, &warp, &FACING).expect("textured");
        assert!(template.align(&flat, &centre, 4.0).is_none());
        let elsewhere = image(&identity, &Vector2::new(1000.0, 2000.0), 1.0, 0.0, &mut rng);
        assert!(template.align(&elsewhere, &centre, 4.0).is_none());
        assert!(
            template
                .align(&first, &Vector2::new(2.0, 31.0), 4.0)
                .is_none()
        );
        let far = Vector2::new(32.3, 31.0);
        assert!(template.align(&first, &far, 1.0).is_none());
        assert!(template.align(&first, &far, 4.0).is_some());
    }
}
