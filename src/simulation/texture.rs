//! A grey pattern in, its mean under any elliptical Gaussian out: textures that do not shimmer.
//!
//! What a pixel sees of a flat surface is the surface's pattern weighted by the lens' point spread,
//! which perspective turns into an ellipse. The mean under that ellipse is taken on a level of a
//! mip pyramid whose texels are about as large as the ellipse's short axis, with a kernel whose
//! second moments, together with those of the level's own smoothing, are exactly the ellipse's
//! (elliptical weighted averaging; Heckbert, *Fundamentals of Texture Mapping*, 1989). So nothing
//! aliases, no level shows where it ends, and a sub-pixel shift of the camera is one of the image.

/// Texels that each row is continued by on either side, so that a kernel never has to wrap.
const PAD: usize = 64;
/// Texels handled at once; plain arrays that the compiler turns into vector instructions.
const LANES: usize = 8;
/// The longest that an ellipse may be in its own widths; longer ones are widened.
const MAX_ANISOTROPY: f64 = 8.0;
/// Variance, texel², of the smoothing that every level carries: the fixed point of halving with
/// the binomial kernel, `v = (v + 1) / 4`.
const LEVEL_VARIANCE: f64 = 1.0 / 3.0;
/// Smallest variance, texel², of the kernel that reads a level; below it texels would show.
const MIN_KERNEL_VARIANCE: f64 = 0.5;
/// The kernel `(1 − r²)²` on the unit disc has this reciprocal variance along each axis.
const KERNEL_SPREAD: f64 = 8.0;
/// The smallest level's side, texels; wider ellipses see the mean alone.
const SMALLEST_LEVEL: usize = 8;

/// A periodic grey pattern as a mip pyramid.
pub(super) struct Texture {
    levels: Vec<Level>,
    mean: f32,
}

struct Level {
    size: usize,
    texels: Vec<f32>,
}

/// An ellipse made ready for reading: which level, and the kernel's quadratic form there.
#[derive(Clone, Copy)]
pub(super) struct Footprint {
    level: usize,
    scale: f64,
    qxx: f32,
    qxy: f32,
    qyy: f32,
    half_height: f32,
}

impl Footprint {
    /// From a covariance `[xx, xy, yy]` in texel² of the finest level.
    pub(super) fn new(cov_texel2: [f64; 3]) -> Self {
        let [xx, xy, yy] = cov_texel2;
        let mid = 0.5 * (xx + yy);
        let reach = (0.25 * (xx - yy) * (xx - yy) + xy * xy).sqrt();
        let var_major = (mid + reach).clamp(1e-12, 1e18);
        let var_minor = (mid - reach).max(var_major / (MAX_ANISOTROPY * MAX_ANISOTROPY));
        // The exponent of the variance, halved, is the level at which it lies in 1 … 4 texel².
        let level = (var_minor.log2() * 0.5).floor().max(0.0);
        let scale = (-level).exp2();
        let kernel = |var: f64| (var * scale * scale - LEVEL_VARIANCE).max(MIN_KERNEL_VARIANCE);
        let (minor, major) = (kernel(var_minor), kernel(var_major));
        // minor·I + (major − minor)·vvᵀ with v along the long axis.
        let stretch = if reach > 1e-9 * var_major {
            (major - minor) / (2.0 * reach)
        } else {
            0.0
        };
        let var_small = mid - reach;
        let kxx = minor + stretch * (xx - var_small);
        let kyy = minor + stretch * (yy - var_small);
        let kxy = stretch * xy;
        let by_det = 1.0 / (KERNEL_SPREAD * (kxx * kyy - kxy * kxy));
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a level is small and not negative; single precision is enough for weights"
        )]
        Self {
            level: level as usize,
            scale,
            qxx: (kyy * by_det) as f32,
            qxy: (-kxy * by_det) as f32,
            qyy: (kxx * by_det) as f32,
            half_height: (KERNEL_SPREAD * kyy).sqrt() as f32,
        }
    }
}

impl Texture {
    /// A pyramid over `size`² grey values, row by row; `size` is a power of two of at least
    /// [`SMALLEST_LEVEL`]. The values carry a smoothing of about [`LEVEL_VARIANCE`].
    pub(super) fn new(size: usize, values: &[f32]) -> Self {
        debug_assert!(size.is_power_of_two() && values.len() == size * size);
        let mean = values.iter().map(|&v| f64::from(v)).sum::<f64>() / values.len() as f64;
        let mut levels = vec![Level::new(size, values)];
        let mut side = size;
        let mut current = values.to_vec();
        while side > SMALLEST_LEVEL {
            current = halve(side, &current);
            side /= 2;
            levels.push(Level::new(side, &current));
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
        self.levels[0].size
    }

    /// The weighted mean around `centre`, in texels of the finest level; the pattern repeats.
    pub(super) fn sample(&self, footprint: &Footprint, centre: [f64; 2]) -> f32 {
        match self.levels.get(footprint.level) {
            Some(level) => level.sample(footprint, centre),
            None => self.mean,
        }
    }
}

impl Level {
    fn new(size: usize, values: &[f32]) -> Self {
        let mut texels = Vec::with_capacity(size * (size + 2 * PAD));
        for row in values.chunks_exact(size) {
            texels.extend((0..size + 2 * PAD).map(|i| row[(i + PAD * (size - 1)) % size]));
        }
        Self { size, texels }
    }

    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "positions are wrapped into the level before they are cut to integers"
    )]
    fn sample(&self, footprint: &Footprint, centre: [f64; 2]) -> f32 {
        let side = self.size as f64;
        let wrapped = |c: f64| {
            let scaled = c * footprint.scale;
            (scaled - (scaled / side).floor() * side) as f32
        };
        let (cx, cy) = (wrapped(centre[0]), wrapped(centre[1]));
        let Footprint {
            qxx,
            qxy,
            qyy,
            half_height,
            ..
        } = *footprint;
        let shear = -qxy / qxx;
        let by_half_height = 1.0 / half_height;
        let by_qxx = 1.0 / qxx;
        let stride = self.size + 2 * PAD;
        let mut weights = [0.0_f32; LANES];
        let mut values = [0.0_f32; LANES];
        let (first, last) = ((cy - half_height).ceil(), (cy + half_height).floor());
        let mut y = first;
        while y <= last {
            let dy = y - cy;
            let reach = dy * by_half_height;
            let half_width = ((1.0 - reach * reach).max(0.0) * by_qxx).sqrt();
            let left = cx + shear * dy - half_width;
            let x0 = left.ceil();
            let count = (left + 2.0 * half_width - x0 + 1.0).max(0.0) as usize;
            let row_at = (y as i64 as usize & (self.size - 1)) * stride;
            // At most 46 texels of reach to the left: within the padding.
            let start = row_at + (x0 as i64 + PAD as i64) as usize;
            let linear = 2.0 * qxy * dy;
            let constant = 1.0 - qyy * dy * dy;
            let chunks = count.div_ceil(LANES);
            let texels = &self.texels[start..start + chunks * LANES];
            let mut dx0 = x0 - cx;
            for chunk in texels.chunks_exact(LANES) {
                for lane in 0..LANES {
                    let dx = dx0 + lane as f32;
                    let root = (constant - (qxx * dx + linear) * dx).max(0.0);
                    let weight = root * root;
                    weights[lane] += weight;
                    values[lane] += weight * chunk[lane];
                }
                dx0 += LANES as f32;
            }
            y += 1.0;
        }
        values.iter().sum::<f32>() / weights.iter().sum::<f32>()
    }
}

/// Half the size: the binomial kernel `1 4 6 4 1` both ways around every second texel.
fn halve(size: usize, values: &[f32]) -> Vec<f32> {
    let half = size / 2;
    let mask = size - 1;
    let mut narrow = vec![0.0; size * half];
    for (row, out) in values.chunks_exact(size).zip(narrow.chunks_exact_mut(half)) {
        for (i, value) in out.iter_mut().enumerate() {
            let at = |offset: usize| row[(2 * i + size + offset - 2) & mask];
            *value = binomial([at(0), at(1), at(2), at(3), at(4)]);
        }
    }
    let mut small = vec![0.0; half * half];
    for (j, out) in small.chunks_exact_mut(half).enumerate() {
        let row = |offset: usize| &narrow[((2 * j + size + offset - 2) & mask) * half..][..half];
        let rows = [row(0), row(1), row(2), row(3), row(4)];
        for (i, value) in out.iter_mut().enumerate() {
            *value = binomial(rows.map(|r| r[i]));
        }
    }
    small
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
        // Tolerance: the kernel (1 − r²)² is a Gaussian up to its fourth moment; at exponents below
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
