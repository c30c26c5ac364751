//! A grey pattern in, its mean under any elliptical Gaussian out: textures that do not shimmer.
//!
//! What a pixel sees of a flat surface is the surface's pattern weighted by the lens' point spread,
//! which perspective turns into an ellipse. The mean under that ellipse is taken on a level of a
//! mip pyramid whose texels are about as large as the ellipse is wide, with a kernel whose second
//! moments, together with those of the level's own smoothing, are exactly the ellipse's
//! (elliptical weighted averaging; Heckbert, *Fundamentals of Texture Mapping*, 1989). So nothing
//! aliases, no level shows where it ends, and a sub-pixel shift of the camera is one of the image.
//! Levels also come narrowed along x, in which direction foreshortened surfaces lie.

use super::kernel::{Placement, weighted_mean};

/// Texels that each row is continued by on either side, so that a kernel never has to wrap.
const PAD: usize = 72;
/// The longest that an ellipse may be in its own widths; longer ones are widened.
const MAX_ANISOTROPY: f64 = 8.0;
/// Variance, texel², of the smoothing that every level carries: the fixed point of halving with
/// the binomial kernel, `v = (v + 1) / 4`.
const LEVEL_VARIANCE: f64 = 1.0 / 3.0;
/// Smallest variance, texel², of the kernel that reads a level; below it texels would show. With
/// [`LEVEL_VARIANCE`] it makes 1, the least that a level is chosen for.
const MIN_KERNEL_VARIANCE: f64 = 2.0 / 3.0;
/// The kernel `(1 − t²)²` from −1 to 1 has this reciprocal variance.
const KERNEL_SPREAD: f64 = 7.0;
/// The smallest level's side, texels; wider ellipses see the mean alone.
const SMALLEST_LEVEL: usize = 8;
/// How often a level is halved once more along x alone.
const NARROWINGS: usize = 3;

/// A periodic grey pattern as a mip pyramid.
pub(super) struct Texture {
    /// By how often both sides were halved, then by how often x was halved once more.
    levels: Vec<Vec<Level>>,
    mean: f32,
}

struct Level {
    width: usize,
    height: usize,
    texels: Vec<f32>,
}

/// An ellipse made ready for reading: which level, and the kernel there.
///
/// A Gaussian with correlated axes is one in y times one in x about a mean that moves with y; the
/// kernel is made in the same way, so that it has the same second moments.
#[derive(Clone, Copy)]
pub(super) struct Footprint {
    level: usize,
    narrowing: usize,
    scale: [f64; 2],
    half: [f32; 2],
    shear: f32,
}

impl Footprint {
    /// From a covariance `[xx, xy, yy]` in texel² of the finest level.
    pub(super) fn new(cov_texel2: [f64; 3]) -> Self {
        let [xx, xy, yy] = limit_anisotropy(cov_texel2);
        // Where x is known, y still varies by this, and the other way round: what a texel must
        // resolve. Half the binary exponent is the level on which it lies in 1 … 4 texel².
        let det = xx * yy - xy * xy;
        let level = |var: f64| exponent(var).max(0) / 2;
        let level_y = level(det / xx).min(level(det / yy));
        let level_x = level(det / yy).min(level_y + NARROWINGS as i64);
        let (scale_x, scale_y) = (power_of_two(-level_x), power_of_two(-level_y));
        let kyy = (yy * scale_y * scale_y - LEVEL_VARIANCE).max(MIN_KERNEL_VARIANCE);
        let kxx = xx * scale_x * scale_x - LEVEL_VARIANCE;
        let kxy = xy * scale_x * scale_y;
        let shear = kxy / kyy;
        let kxx_at_y = (kxx - shear * kxy).max(MIN_KERNEL_VARIANCE);
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a level is small and not negative; single precision is enough for weights"
        )]
        Self {
            level: level_y as usize,
            narrowing: (level_x - level_y) as usize,
            scale: [scale_x, scale_y],
            half: [
                (KERNEL_SPREAD * kxx_at_y).sqrt() as f32,
                (KERNEL_SPREAD * kyy).sqrt() as f32,
            ],
            shear: shear as f32,
        }
    }
}

/// A covariance whose ellipse is widened where it is longer than [`MAX_ANISOTROPY`] widths.
fn limit_anisotropy([xx, xy, yy]: [f64; 3]) -> [f64; 3] {
    let mid = (0.5 * (xx + yy)).clamp(1e-12, 1e18);
    let reach = (0.25 * (xx - yy) * (xx - yy) + xy * xy).sqrt().min(mid);
    let (minor, major) = (mid - reach, mid + reach);
    let wanted = major * (1.0 / (MAX_ANISOTROPY * MAX_ANISOTROPY));
    if minor >= wanted {
        return [xx, xy, yy];
    }
    // V + (wanted − minor)·uuᵀ with u across the long axis, where uuᵀ = (major·I − V) / 2·reach.
    let share = (wanted - minor) / (2.0 * reach);
    [
        xx + share * (major - xx),
        xy - share * xy,
        yy + share * (major - yy),
    ]
}

/// The binary exponent of a positive, normal number.
#[expect(clippy::cast_possible_wrap, reason = "eleven bits")]
fn exponent(value: f64) -> i64 {
    ((value.to_bits() >> 52) & 0x7ff) as i64 - 1023
}

/// 2 to the power of `n`, for n within the exponents of normal numbers.
#[expect(clippy::cast_sign_loss, reason = "the sum is positive")]
fn power_of_two(n: i64) -> f64 {
    f64::from_bits(((1023 + n) as u64) << 52)
}

impl Texture {
    /// A pyramid over `size`² grey values, row by row; `size` is a power of two of at least
    /// [`SMALLEST_LEVEL`]. The values carry a smoothing of about [`LEVEL_VARIANCE`].
    pub(super) fn new(size: usize, values: &[f32]) -> Self {
        debug_assert!(size.is_power_of_two() && values.len() == size * size);
        let mean = values.iter().map(|&v| f64::from(v)).sum::<f64>() / values.len() as f64;
        let mut levels = Vec::new();
        let mut side = size;
        let mut current = values.to_vec();
        loop {
            let narrow = halve_columns(side, &current);
            let next = halve_rows(side / 2, &narrow);
            levels.push(narrowings(side, current, narrow));
            if side <= SMALLEST_LEVEL {
                break;
            }
            current = next;
            side /= 2;
        }
        Self {
            levels,
            mean: mean as f32,
        }
    }

    /// The mean of all texels.
    pub(super) fn mean(&self) -> f32 {
        self.mean
    }

    /// The side of the finest level, texels.
    pub(super) fn size(&self) -> usize {
        self.levels[0][0].width
    }

    /// The weighted mean around `centre`, in texels of the finest level; the pattern repeats.
    pub(super) fn sample(&self, footprint: &Footprint, centre: [f64; 2]) -> f32 {
        let level = self
            .levels
            .get(footprint.level)
            .and_then(|narrowings| narrowings.get(footprint.narrowing));
        match level {
            Some(level) => level.sample(footprint, centre),
            None => self.mean,
        }
    }
}

/// A level, once halved along x, and further.
fn narrowings(side: usize, values: Vec<f32>, narrow: Vec<f32>) -> Vec<Level> {
    let mut levels = vec![Level::new(side, &values)];
    let (mut width, mut current) = (side / 2, narrow);
    while levels.len() <= NARROWINGS && width >= SMALLEST_LEVEL {
        levels.push(Level::new(width, &current));
        current = halve_columns(width, &current);
        width /= 2;
    }
    levels
}

impl Level {
    fn new(width: usize, values: &[f32]) -> Self {
        let height = values.len() / width;
        let mut texels = Vec::with_capacity(height * (width + 2 * PAD));
        for row in values.chunks_exact(width) {
            let around = row.iter().cycle().skip(PAD * (width - 1) % width);
            texels.extend(around.take(width + 2 * PAD));
        }
        Self {
            width,
            height,
            texels,
        }
    }

    fn sample(&self, footprint: &Footprint, centre: [f64; 2]) -> f32 {
        let at = Placement {
            middle: [
                wrap(centre[0] * footprint.scale[0], self.width),
                wrap(centre[1] * footprint.scale[1], self.height),
            ],
            half: footprint.half,
            shear: footprint.shear,
            stride: self.width + 2 * PAD,
            row_mask: self.height - 1,
            pad: PAD,
        };
        weighted_mean(&self.texels, &at)
    }
}

/// A coordinate of the endless pattern as one of a level of `size` texels, 0 ≤ c < size.
#[expect(
    clippy::cast_possible_truncation,
    reason = "the quotient is cut on purpose"
)]
fn wrap(c: f64, size: usize) -> f32 {
    let turns = c / size as f64;
    // Cutting off the fraction rounds towards zero; one less is below any coordinate.
    let whole = (turns as i64 - i64::from(turns < 0.0)) as f64;
    ((turns - whole) * size as f64) as f32
}

/// Half as wide: the binomial kernel `1 4 6 4 1` around every second texel of each row.
fn halve_columns(width: usize, values: &[f32]) -> Vec<f32> {
    let mask = width - 1;
    let mut narrow = Vec::with_capacity(values.len() / 2);
    for row in values.chunks_exact(width) {
        narrow.extend((0..width / 2).map(|i| {
            binomial([0, 1, 2, 3, 4].map(|offset| row[(2 * i + width + offset - 2) & mask]))
        }));
    }
    narrow
}

/// Half as high, likewise.
fn halve_rows(width: usize, values: &[f32]) -> Vec<f32> {
    let height = values.len() / width;
    let mut low = Vec::with_capacity(values.len() / 2);
    for j in 0..height / 2 {
        let rows = [0, 1, 2, 3, 4].map(|offset| {
            let row = (2 * j + height + offset - 2) & (height - 1);
            &values[row * width..][..width]
        });
        low.extend((0..width).map(|i| binomial(rows.map(|r| r[i]))));
    }
    low
}

fn binomial(v: [f32; 5]) -> f32 {
    (v[0] + v[4] + 4.0 * (v[1] + v[3]) + 6.0 * v[2]) * (1.0 / 16.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A plane wave of `cycles` over the texture, smoothed as a level must be.
    fn wave(size: usize, cycles: [f64; 2]) -> Texture {
        let tau = std::f64::consts::TAU;
        let omega = cycles.map(|c| tau * c / size as f64);
        let damping = (-0.5 * LEVEL_VARIANCE * (omega[0].powi(2) + omega[1].powi(2))).exp();
        let values: Vec<f32> = (0..size * size)
            .map(|i| {
                let (x, y) = ((i % size) as f64, (i / size) as f64);
                (damping * (omega[0] * x + omega[1] * y).cos()) as f32
            })
            .collect();
        Texture::new(size, &values)
    }

    #[test]
    fn a_wave_is_damped_as_the_gaussian_damps_it_and_keeps_its_phase() {
        // Tolerance: the kernel (1 − t²)² is a Gaussian up to its fourth moment; at exponents below
        // 0.8 their transforms differ by less than 0.02.
        let size = 256;
        let tau = std::f64::consts::TAU;
        for cycles in [[5.0, 0.0], [3.0, 7.0], [0.0, 11.0], [16.0, -4.0]] {
            let texture = wave(size, cycles);
            let omega = cycles.map(|c: f64| tau * c / size as f64);
            for cov in [[2.0, 0.0, 2.0], [9.0, 3.0, 4.0], [40.0, -30.0, 30.0]] {
                let exponent = 0.5
                    * (cov[0] * omega[0].powi(2)
                        + 2.0 * cov[1] * omega[0] * omega[1]
                        + cov[2] * omega[1].powi(2));
                if exponent > 0.8 {
                    continue;
                }
                let footprint = Footprint::new(cov);
                for k in 0..40 {
                    let centre = [200.3 + 2.37 * f64::from(k), -7.1 + 1.91 * f64::from(k)];
                    let phase = omega[0] * centre[0] + omega[1] * centre[1];
                    let expected = (-exponent).exp() * phase.cos();
                    let seen = f64::from(texture.sample(&footprint, centre));
                    assert!(
                        (seen - expected).abs() < 0.02,
                        "{cycles:?} {cov:?} {centre:?}: {seen} instead of {expected}"
                    );
                }
            }
        }
    }

    #[test]
    fn what_is_finer_than_a_pixel_fades_instead_of_aliasing() {
        // 100 cycles in 256 texels under a pixel of σ = 4 texels: damped by e⁻⁴⁸ in theory.
        let texture = wave(256, [100.0, 0.0]);
        let footprint = Footprint::new([16.0, 0.0, 16.0]);
        for k in 0..50 {
            let seen = texture.sample(&footprint, [f64::from(k) * 3.3, 17.0]);
            assert!(seen.abs() < 2e-3, "{seen}");
        }
    }

    #[test]
    fn the_widest_ellipses_see_the_mean() {
        let texture = wave(64, [1.0, 0.0]);
        let footprint = Footprint::new([1e9, 0.0, 1e9]);
        assert!((texture.sample(&footprint, [3.0, 5.0]) - texture.mean()).abs() < 1e-6);
    }

    #[test]
    fn the_longest_kernel_stays_within_the_padding() {
        for (xx, xy, yy) in [(250.0, 0.0, 4.0), (1e6, 0.0, 1.0), (1e4, 9.9e3, 1e4)] {
            let texture = wave(64, [1.0, 0.0]);
            let footprint = Footprint::new([xx, xy, yy]);
            for c in [0.0, 0.001, 31.5, 63.999] {
                assert!(texture.sample(&footprint, [c, c]).is_finite());
            }
        }
    }
}
