//! A patch: what surrounds a point in one image in, where the same lies in another image out, with
//! its covariance.
//!
//! Inverse compositional alignment (Baker & Matthews 2004) of a translation, brightness and
//! contrast free: gradients are the template's, so that their normal equations are solved once.

use crate::image::GrayImage;
use nalgebra::{Matrix2, Vector2};

/// Half the side of a patch, samples.
const HALF: usize = 5;
/// Samples a side.
const SIDE: usize = 2 * HALF + 1;
/// Samples of a patch.
const AREA: usize = SIDE * SIDE;
/// A side of the template with the rim that its gradients need.
const RIM_SIDE: usize = SIDE + 2;
/// Room that a patch needs around its centre in the target, px of the level.
const MARGIN: f32 = HALF as f32 + 1.0;

/// Iterations at most.
const MAX_ITERATIONS: usize = 12;
/// A step that ends the alignment, px of the level.
const MIN_STEP: f32 = 0.003;
/// Weakest contrast of a template, grey levels (standard deviation).
const MIN_CONTRAST: f32 = 2.0;
/// Least correlation of what was found with the template.
const MIN_CORRELATION: f32 = 0.8;
/// Neighbouring samples share their deviations, what smoothing and interpolation did to the image's
/// noise and what a warp that is not quite right does: so many count as one.
const SHARED: f32 = 4.0;
/// Rounding to whole grey levels, once in each image: variance 1/12 each, less what smoothing takes.
const ROUNDING_VARIANCE: f32 = 0.1;

/// What a point looks like, ready for alignment.
#[derive(Clone, Debug)]
pub struct Template {
    /// Grey values less their mean.
    values: [f32; AREA],
    /// Gradients, less what brightness and contrast would explain, per px of the target's level.
    by_x: [f32; AREA],
    by_y: [f32; AREA],
    /// Sum of squared values.
    energy: f32,
    /// Inverse of the gradients' normal equations.
    inverse: Matrix2<f32>,
}

/// Where a template was found.
#[derive(Clone, Copy, Debug)]
pub struct Aligned {
    /// Position, px of the level.
    pub at: Vector2<f32>,
    /// Covariance of one image's share in it, px² of the level.
    pub cov: Matrix2<f32>,
    /// Correlation of target and template, −1 to 1.
    pub correlation: f32,
}

impl Template {
    /// The surroundings of `centre` in `image`, sampled where a square grid of the target's pixels
    /// falls: `warp` maps a px of the target's level into px of `image`.
    ///
    /// `None` where they leave the image, or are too flat to be found again.
    #[must_use]
    pub fn new(image: &GrayImage, centre: &Vector2<f32>, warp: &Matrix2<f32>) -> Option<Self> {
        let mut wide = [0.0_f32; RIM_SIDE * RIM_SIDE];
        let reach = (HALF + 1) as f32;
        let extent = Vector2::new(
            warp[(0, 0)].abs() + warp[(0, 1)].abs(),
            warp[(1, 0)].abs() + warp[(1, 1)].abs(),
        ) * reach;
        if !holds(image, centre, &extent) {
            return None;
        }
        for row in 0..RIM_SIDE {
            for column in 0..RIM_SIDE {
                let grid = Vector2::new(column as f32 - reach, row as f32 - reach);
                wide[row * RIM_SIDE + column] = sample(image, &(centre + warp * grid));
            }
        }
        Self::from_samples(&wide)
    }

    fn from_samples(wide: &[f32; RIM_SIDE * RIM_SIDE]) -> Option<Self> {
        let mut template = Self {
            values: [0.0; AREA],
            by_x: [0.0; AREA],
            by_y: [0.0; AREA],
            energy: 0.0,
            inverse: Matrix2::zeros(),
        };
        for row in 0..SIDE {
            for column in 0..SIDE {
                let at = (row + 1) * RIM_SIDE + column + 1;
                let i = row * SIDE + column;
                template.values[i] = wide[at];
                template.by_x[i] = 0.5 * (wide[at + 1] - wide[at - 1]);
                template.by_y[i] = 0.5 * (wide[at + RIM_SIDE] - wide[at - RIM_SIDE]);
            }
        }
        centre_on_zero(&mut template.values);
        template.energy = dot(&template.values, &template.values);
        if template.energy < MIN_CONTRAST * MIN_CONTRAST * AREA as f32 {
            return None;
        }
        for gradient in [&mut template.by_x, &mut template.by_y] {
            centre_on_zero(gradient);
            let share = dot(gradient, &template.values) / template.energy;
            for (g, v) in gradient.iter_mut().zip(&template.values) {
                *g -= share * v;
            }
        }
        let normal = Matrix2::new(
            dot(&template.by_x, &template.by_x),
            dot(&template.by_x, &template.by_y),
            dot(&template.by_x, &template.by_y),
            dot(&template.by_y, &template.by_y),
        );
        template.inverse = normal.try_inverse()?;
        let positive = template.inverse[(0, 0)] > 0.0 && template.inverse[(1, 1)] > 0.0;
        positive.then_some(template)
    }

    /// Finds the template in `image`, starting at `start` and at most `reach` px away from there.
    ///
    /// `None` where the search leaves the image or its reach, does not settle, or ends at something
    /// that looks different.
    #[must_use]
    pub fn align(&self, image: &GrayImage, start: &Vector2<f32>, reach: f32) -> Option<Aligned> {
        let mut at = *start;
        let mut seen = [0.0_f32; AREA];
        for _ in 0..MAX_ITERATIONS {
            if !holds(image, &at, &Vector2::repeat(MARGIN)) || (at - start).amax() > reach {
                return None;
            }
            sample_square(image, &at, &mut seen);
            centre_on_zero(&mut seen);
            let gain = dot(&seen, &self.values) / self.energy;
            if gain <= 0.1 {
                return None;
            }
            let mut gradient = Vector2::zeros();
            let gradients = self.by_x.iter().zip(&self.by_y);
            for ((s, v), (x, y)) in seen.iter().zip(&self.values).zip(gradients) {
                let e = s / gain - v;
                gradient.x += e * x;
                gradient.y += e * y;
            }
            let step = self.inverse * gradient;
            if step.amax() < MIN_STEP {
                return self.judge(at - step, &seen, gain);
            }
            at -= step;
        }
        None
    }

    fn judge(&self, at: Vector2<f32>, seen: &[f32; AREA], gain: f32) -> Option<Aligned> {
        let seen_energy = dot(seen, seen);
        let correlation = gain * (self.energy / seen_energy).sqrt();
        if correlation.is_nan() || correlation < MIN_CORRELATION {
            return None;
        }
        let mut misfit = 0.0;
        for (s, v) in seen.iter().zip(&self.values) {
            let e = s / gain - v;
            misfit += e * e;
        }
        // Four parameters were fitted; template and target have half of the misfit each.
        let variance = misfit / (AREA - 4) as f32;
        let share = SHARED * (0.5 * variance + ROUNDING_VARIANCE);
        Some(Aligned {
            at,
            cov: self.inverse * share,
            correlation,
        })
    }
}

/// Whether all within `extent` of a position can be interpolated.
fn holds(image: &GrayImage, at: &Vector2<f32>, extent: &Vector2<f32>) -> bool {
    at.x - extent.x >= 0.0
        && at.y - extent.y >= 0.0
        && at.x + extent.x < image.width() as f32 - 1.0
        && at.y + extent.y < image.height() as f32 - 1.0
}

/// Bilinear interpolation.
fn sample(image: &GrayImage, at: &Vector2<f32>) -> f32 {
    let (x, y) = (at.x as u32, at.y as u32);
    let (fx, fy) = (at.x - x as f32, at.y - y as f32);
    let (top, bottom) = (&image.row(y)[x as usize..], &image.row(y + 1)[x as usize..]);
    let upper = f32::from(top[0]) * (1.0 - fx) + f32::from(top[1]) * fx;
    let lower = f32::from(bottom[0]) * (1.0 - fx) + f32::from(bottom[1]) * fx;
    upper * (1.0 - fy) + lower * fy
}

/// The square of pixels around `at`, bilinear: all share their weights.
fn sample_square(image: &GrayImage, at: &Vector2<f32>, out: &mut [f32; AREA]) {
    let (x, y) = (at.x.floor(), at.y.floor());
    let (fx, fy) = (at.x - x, at.y - y);
    let weights = [
        (1.0 - fx) * (1.0 - fy),
        fx * (1.0 - fy),
        (1.0 - fx) * fy,
        fx * fy,
    ];
    let (left, top) = (x as usize - HALF, y as u32 - HALF as u32);
    let mut above = &image.row(top)[left..][..SIDE + 1];
    for (row, out) in (1..).zip(out.chunks_exact_mut(SIDE)) {
        let below = &image.row(top + row)[left..][..SIDE + 1];
        for (i, o) in out.iter_mut().enumerate() {
            *o = weights[0] * f32::from(above[i])
                + weights[1] * f32::from(above[i + 1])
                + weights[2] * f32::from(below[i])
                + weights[3] * f32::from(below[i + 1]);
        }
        above = below;
    }
}

fn centre_on_zero(values: &mut [f32; AREA]) {
    let mean = values.iter().sum::<f32>() / AREA as f32;
    for v in values {
        *v -= mean;
    }
}

fn dot(a: &[f32; AREA], b: &[f32; AREA]) -> f32 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

#[cfg(test)]
mod tests {
    use super::super::{FLOOR_PX, Pyramid};
    use super::*;
    use rand::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};
    use rand_xoshiro::Xoshiro256PlusPlus;

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
        let template = Template::new(first, &centre, &warp.map(|v| v as f32))?;
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
                stated += 2.0 * (found.cov.diagonal().cast::<f64>() + floor) / RUNS as f64;
            }
            for axis in 0..2 {
                let ratio = squares[axis] / stated[axis];
                assert!((0.05..1.2).contains(&ratio), "noise {noise}: {ratio}");
            }
        }
    }

    #[test]
    fn what_is_flat_different_or_out_of_reach_is_refused() {
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(3);
        let identity = Matrix2::identity();
        let warp = Matrix2::identity();
        let first = image(&identity, &Vector2::zeros(), 1.0, 0.0, &mut rng);
        let centre = Vector2::new(31.0, 31.0);
        let flat = GrayImage::filled(64, 64, 90);
        assert!(Template::new(&flat, &centre, &warp).is_none());
        assert!(Template::new(&first, &Vector2::new(3.0, 31.0), &warp).is_none());
        let template = Template::new(&first, &centre, &warp).expect("textured");
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
