//! A patch of texels and a kernel's place on it in, their weighted mean out: where rendering spends
//! its time, and so for the processor's widest registers.
#![cfg_attr(
    target_arch = "x86_64",
    expect(unsafe_code, reason = "registers of AVX2")
)]

/// Texels handled at once.
pub(super) const LANES: usize = 8;

/// Where a kernel lies on a level whose rows begin `pad` texels before their first column.
///
/// Its weight is `(1 − v²)²` down and `(1 − u²)²` across, about a middle that moves with the row.
#[derive(Clone, Copy)]
pub(super) struct Placement {
    /// The middle, texels, 0 or above.
    pub(super) middle: [f32; 2],
    /// Half the number of columns and of rows that the kernel reaches, texels.
    pub(super) half: [f32; 2],
    /// How far the middle moves to the right from one row to the next, texels.
    pub(super) shear: f32,
    /// Texels from one row to the next.
    pub(super) stride: usize,
    /// One less than the number of rows, which is a power of two: rows repeat.
    pub(super) row_mask: usize,
    /// Texels by which a row's start lies before its first column, at least as far as the kernel
    /// reaches.
    pub(super) pad: usize,
}

/// The weighted mean of `texels`. Wide registers or not, the same operations in the same order give
/// the same bits.
pub(super) fn weighted_mean(texels: &[f32], at: &Placement) -> f32 {
    #[cfg(target_arch = "x86_64")]
    if std::is_x86_feature_detected!("avx2") {
        // SAFETY: the processor has AVX2, as just asked.
        return unsafe { avx2::weighted_mean(texels, at) };
    }
    portable(texels, at)
}

/// One row of a kernel: where its first texel is and lies, and its weight.
struct Row {
    start: usize,
    dx: f32,
    weight: f32,
}

impl Placement {
    /// The rows that the kernel reaches, counted with the padding.
    #[inline(always)]
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "with the padding they are above 0, so that cutting the fraction off rounds down"
    )]
    fn rows(&self) -> std::ops::RangeInclusive<usize> {
        let middle = self.middle[1] + self.pad as f32;
        (middle - self.half[1]) as usize + 1..=(middle + self.half[1]) as usize
    }

    /// How often [`LANES`] texels cover a row of the kernel.
    #[inline(always)]
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "half a width is positive and small"
    )]
    fn chunks(&self) -> usize {
        (2.0 * self.half[0]) as usize / LANES + 1
    }

    #[inline(always)]
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "as for the rows"
    )]
    fn row(&self, row: usize, by_half_height2: f32) -> Row {
        let pad = self.pad as f32;
        let dy = row as f32 - pad - self.middle[1];
        let root = 1.0 - dy * dy * by_half_height2;
        let middle = self.middle[0] + self.shear * dy + pad;
        let first = (middle - self.half[0]) as usize + 1;
        Row {
            start: (row.wrapping_sub(self.pad) & self.row_mask) * self.stride + first,
            dx: first as f32 - middle,
            weight: root * root,
        }
    }
}

fn portable(texels: &[f32], at: &Placement) -> f32 {
    let [by_half_width2, by_half_height2] = at.half.map(|h| 1.0 / (h * h));
    let chunks = at.chunks();
    let (mut weights, mut values) = ([0.0; LANES], [0.0; LANES]);
    for row in at.rows() {
        let row = at.row(row, by_half_height2);
        let mut dx0 = row.dx;
        for chunk in texels[row.start..row.start + chunks * LANES].chunks_exact(LANES) {
            for lane in 0..LANES {
                let dx = dx0 + lane as f32;
                let root = (1.0 - dx * dx * by_half_width2).max(0.0);
                let weight = root * root * row.weight;
                weights[lane] += weight;
                values[lane] += weight * chunk[lane];
            }
            dx0 += LANES as f32;
        }
    }
    sum(values) / sum(weights)
}

/// The sum in the order in which registers are folded.
fn sum(v: [f32; LANES]) -> f32 {
    let four = [v[0] + v[4], v[1] + v[5], v[2] + v[6], v[3] + v[7]];
    (four[0] + four[2]) + (four[1] + four[3])
}

#[cfg(target_arch = "x86_64")]
mod avx2 {
    use super::{LANES, Placement, sum};
    use std::arch::x86_64::{
        __m256, _mm256_add_ps, _mm256_loadu_ps, _mm256_max_ps, _mm256_mul_ps, _mm256_set1_ps,
        _mm256_setr_ps, _mm256_setzero_ps, _mm256_storeu_ps, _mm256_sub_ps,
    };

    #[target_feature(enable = "avx2")]
    pub(super) fn weighted_mean(texels: &[f32], at: &Placement) -> f32 {
        let [by_half_width2, by_half_height2] = at.half.map(|h| 1.0 / (h * h));
        let chunks = at.chunks();
        let (one, zero) = (_mm256_set1_ps(1.0), _mm256_setzero_ps());
        let lane = _mm256_setr_ps(0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0);
        let by_half_width2 = _mm256_set1_ps(by_half_width2);
        let (mut weights, mut values) = (zero, zero);
        for row in at.rows() {
            let row = at.row(row, by_half_height2);
            let row_weight = _mm256_set1_ps(row.weight);
            let mut dx0 = row.dx;
            for chunk in texels[row.start..row.start + chunks * LANES].chunks_exact(LANES) {
                let dx = _mm256_add_ps(_mm256_set1_ps(dx0), lane);
                let fall = _mm256_mul_ps(_mm256_mul_ps(dx, dx), by_half_width2);
                let root = _mm256_max_ps(_mm256_sub_ps(one, fall), zero);
                let weight = _mm256_mul_ps(_mm256_mul_ps(root, root), row_weight);
                weights = _mm256_add_ps(weights, weight);
                // SAFETY: a chunk holds as many floats as a register.
                let texel = unsafe { _mm256_loadu_ps(chunk.as_ptr()) };
                values = _mm256_add_ps(values, _mm256_mul_ps(weight, texel));
                dx0 += LANES as f32;
            }
        }
        sum(unpack(values)) / sum(unpack(weights))
    }

    #[target_feature(enable = "avx2")]
    fn unpack(register: __m256) -> [f32; LANES] {
        let mut lanes = [0.0; LANES];
        // SAFETY: the array holds as many floats as a register.
        unsafe { _mm256_storeu_ps(lanes.as_mut_ptr(), register) };
        lanes
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// 64 rows of 64 texels with 72 before and after each.
    fn texels() -> Vec<f32> {
        (0..64 * 208)
            .map(|i| ((i * 7919) % 1009) as f32 / 1009.0)
            .collect()
    }

    fn placement(middle: [f32; 2], half: [f32; 2], shear: f32) -> Placement {
        Placement {
            middle,
            half,
            shear,
            stride: 208,
            row_mask: 63,
            pad: 72,
        }
    }

    proptest! {
        #[test]
        fn wide_registers_give_the_same_bits(
            middle in prop::array::uniform2(0.0..63.99_f32),
            half in prop::array::uniform2(2.2..30.0_f32),
            shear in -0.9..0.9_f32,
        ) {
            let at = placement(middle, half, shear);
            let texels = texels();
            let (wide, narrow) = (weighted_mean(&texels, &at), portable(&texels, &at));
            prop_assert_eq!(wide.to_bits(), narrow.to_bits());
        }

        #[test]
        fn the_mean_is_the_sum_over_the_kernel(
            middle in prop::array::uniform2(0.0..63.99_f32),
            half in prop::array::uniform2(2.2..20.0_f32),
            shear in -0.9..0.9_f32,
        ) {
            let texels = texels();
            let (mut weights, mut values) = (0.0_f64, 0.0_f64);
            for y in -40..104_i32 {
                for x in -72..136_i32 {
                    let dy = f64::from(y) - f64::from(middle[1]);
                    let dx = f64::from(x) - f64::from(middle[0]) - f64::from(shear) * dy;
                    let (v, u) = (dy / f64::from(half[1]), dx / f64::from(half[0]));
                    if u.abs() < 1.0 && v.abs() < 1.0 {
                        let weight = (1.0 - u * u).powi(2) * (1.0 - v * v).powi(2);
                        let at = y.rem_euclid(64) * 208 + x + 72;
                        weights += weight;
                        values += weight * f64::from(texels[at as usize]);
                    }
                }
            }
            let mean = f64::from(weighted_mean(&texels, &placement(middle, half, shear)));
            prop_assert!((mean - values / weights).abs() < 1e-4, "{mean} {}", values / weights);
        }
    }
}
