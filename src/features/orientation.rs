//! Orientation: the surroundings of a keypoint in, the direction in which they grow lighter out.
//!
//! Gradients (Haar wavelets of side 4 s) are taken at the 113 grid points of spacing s within 6 s,
//! weighted by a Gaussian of 2.5 s. Of all sectors of 60° of gradient directions, one every 5°, the
//! one with the longest sum of gradients gives the direction (Bay et al., section 4.1).

#![expect(
    clippy::needless_range_loop,
    reason = "several arrays run along one index, plainly enough to be computed by whole registers"
)]

use super::integral::IntegralImage;
use crate::simd::{round_i32, widened};

/// Radius of the disc in which gradients are taken, in units of the scale.
const RADIUS: i32 = 6;
/// σ of the gradients' weights, in units of the scale.
const WEIGHT_SIGMA: f64 = 2.5;
/// Grid points across the disc.
const DIAMETER: usize = 2 * RADIUS as usize + 1;
/// Grid points in the disc.
const POINTS: usize = 113;
/// [`POINTS`] rounded up to full vector registers.
const POINTS_PADDED: usize = POINTS.next_multiple_of(8);
/// Directions apart of the sectors that are tried.
const SECTOR_STEP_DEG: usize = 5;
/// Sectors that are tried.
const SECTORS: usize = 360 / SECTOR_STEP_DEG;
/// Steps before and after a sector's middle that lie in it whole; of the step before them it has
/// all but the first degree, being open at ±30°.
const WHOLE_STEPS: usize = 5;

/// A direction in the image, from the x axis towards the y axis (down).
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Direction {
    /// Angle, rad in [0, 2π).
    pub angle_rad: f32,
    /// Its cosine.
    pub cos: f32,
    /// Its sine.
    pub sin: f32,
}

impl Direction {
    /// What upright keypoints have: straight up, as OpenCV's have.
    pub(super) const UP: Self = Self {
        angle_rad: 1.5 * std::f32::consts::PI,
        cos: 0.0,
        sin: -1.0,
    };

    fn of(x: f32, y: f32) -> Self {
        let length = (x * x + y * y).sqrt();
        if length > 0.0 {
            Self {
                angle_rad: angle_rad(x, y),
                cos: x / length,
                sin: y / length,
            }
        } else {
            // No gradient anywhere: any direction is as good.
            Self {
                angle_rad: 0.0,
                cos: 1.0,
                sin: 0.0,
            }
        }
    }
}

/// Where the gradients are taken, and how much they count.
#[derive(Debug)]
pub(super) struct Compass {
    /// Row by row of the grid.
    rows: [GridRow; DIAMETER],
}

/// The grid points of a row: from column `first` on, as many as there are weights above zero.
#[derive(Clone, Copy, Debug, Default)]
struct GridRow {
    first: usize,
    end: usize,
    /// By column of the grid.
    weights: [f32; DIAMETER],
    /// By column of the grid: which gradient it is, column by column of the disc.
    numbers: [usize; DIAMETER],
}

impl Compass {
    pub(super) fn new() -> Self {
        let mut rows = [GridRow::default(); DIAMETER];
        rows.iter_mut().for_each(|row| row.first = DIAMETER);
        let disc = (-RADIUS..=RADIUS)
            .flat_map(|x| (-RADIUS..=RADIUS).map(move |y| (x, y)))
            .filter(|(x, y)| x * x + y * y <= RADIUS * RADIUS);
        for (number, (x, y)) in disc.enumerate() {
            let weight = (-0.5 * f64::from(x * x + y * y) / WEIGHT_SIGMA.powi(2)).exp();
            let column = (x + RADIUS) as usize;
            let row = &mut rows[(y + RADIUS) as usize];
            row.first = row.first.min(column);
            row.end = row.end.max(column + 1);
            row.weights[column] = weight as f32;
            row.numbers[column] = number;
        }
        Self { rows }
    }

    /// The direction at `(x_px, y_px)` for scale `scale_px`; `None` where no gradient can be taken
    /// within the image.
    pub(super) fn direction(
        &self,
        integral: &IntegralImage,
        (x_px, y_px): (f32, f32),
        scale_px: f32,
    ) -> Option<Direction> {
        let half = round_i32(2.0 * scale_px) as usize;
        let side = 2 * half;
        if side > integral.width() || side > integral.height() {
            return None;
        }
        let [xs, ys] = [x_px, y_px].map(|middle_px| corners(middle_px, scale_px, side));
        // What cannot be taken stays zero, which adds nothing to any sum.
        let mut gradients = Gradients::default();
        let mut is_any = false;
        for (row, y) in self.rows.iter().zip(ys) {
            if y < 0 || y >= (integral.height() - side) as i32 {
                continue;
            }
            let rows = [0, half, side].map(|below| integral.row(y as usize + below));
            for column in row.first..row.end {
                let x = xs[column];
                if x < 0 || x >= (integral.width() - side) as i32 {
                    continue;
                }
                let (gx, gy) = gradient(rows, x as usize, half);
                let number = row.numbers[column];
                gradients.x[number] = gx as f32 * row.weights[column];
                gradients.y[number] = gy as f32 * row.weights[column];
                is_any = true;
            }
        }
        is_any.then(|| {
            let mut sum = [0.0; 2];
            strongest_sector(&gradients, &mut sum);
            Direction::of(sum[0], sum[1])
        })
    }
}

/// One coordinate of the upper left corners of squares of side `side` around the grid's points.
fn corners(middle_px: f32, scale_px: f32, side: usize) -> [i32; DIAMETER] {
    let to_corner = (side as f32 - 1.0) * 0.5;
    let mut corners = [0; DIAMETER];
    for n in 0..DIAMETER {
        let steps = (n as i32 - RADIUS) as f32;
        corners[n] = round_i32(middle_px + steps * scale_px - to_corner);
    }
    corners
}

/// Weighted gradients; those behind the last are zero, which adds nothing to any sum.
struct Gradients {
    x: [f32; POINTS_PADDED],
    y: [f32; POINTS_PADDED],
}

impl Default for Gradients {
    fn default() -> Self {
        Self {
            x: [0.0; POINTS_PADDED],
            y: [0.0; POINTS_PADDED],
        }
    }
}

/// Sum of the right less that of the left half of a square of side `2 half` whose corners lie from
/// column `x` on, and the same of its lower and upper half. The integral rows are those at its
/// upper side, its middle and its lower side.
#[inline(always)]
fn gradient([top, middle, bottom]: [&[i32]; 3], x: usize, half: usize) -> (i32, i32) {
    let to = |row: &[i32], end: usize| row[end].wrapping_sub(row[x]);
    let (end, centre) = (x + 2 * half, x + half);
    let above = to(top, end);
    let all = to(bottom, end).wrapping_sub(above);
    let left = to(bottom, centre).wrapping_sub(to(top, centre));
    let upper = to(middle, end).wrapping_sub(above);
    let twice = |part: i32| part.wrapping_add(part);
    (
        all.wrapping_sub(twice(left)),
        all.wrapping_sub(twice(upper)),
    )
}

widened! {
    /// The longest sum of gradients within a sector.
    fn strongest_sector = strongest_sector_narrow, (gradients: &Gradients, sum: &mut [f32; 2])
}

#[inline(always)]
fn strongest_sector_narrow(gradients: &Gradients, sum: &mut [f32; 2]) {
    let mut steps = [0; POINTS_PADDED];
    // What of each gradient is not in the first degree of its step.
    let (mut open_x, mut open_y) = ([0.0; POINTS_PADDED], [0.0; POINTS_PADDED]);
    for n in 0..POINTS_PADDED {
        let (x, y) = (gradients.x[n], gradients.y[n]);
        let angle_rad = angle_rad(x, y);
        let degree = round_i32(angle_rad * const { 180.0 / std::f32::consts::PI }) as u32;
        let degree = if degree >= 360 { degree - 360 } else { degree };
        let step = degree / SECTOR_STEP_DEG as u32;
        steps[n] = step;
        let is_first = step * SECTOR_STEP_DEG as u32 == degree;
        open_x[n] = if is_first { 0.0 } else { x };
        open_y[n] = if is_first { 0.0 } else { y };
    }
    // Gradients by step of directions: all of it, and all but its first degree.
    let mut whole = [[0.0_f32; SECTORS + 2 * WHOLE_STEPS + 1]; 2];
    let mut open = [[0.0_f32; SECTORS]; 2];
    for n in 0..POINTS {
        let step = steps[n] as usize;
        let at = step + WHOLE_STEPS + 1;
        whole[0][at] += gradients.x[n];
        whole[1][at] += gradients.y[n];
        open[0][step] += open_x[n];
        open[1][step] += open_y[n];
    }
    for wrapped in &mut whole {
        wrapped.copy_within(SECTORS..SECTORS + WHOLE_STEPS + 1, 0);
        wrapped.copy_within(
            WHOLE_STEPS + 1..2 * WHOLE_STEPS + 1,
            SECTORS + WHOLE_STEPS + 1,
        );
    }
    let xs = sector_sums(&whole[0], &open[0]);
    let ys = sector_sums(&whole[1], &open[1]);
    let mut squares = [0.0_f32; SECTORS];
    let mut longest = 0.0_f32;
    for n in 0..SECTORS {
        squares[n] = xs[n] * xs[n] + ys[n] * ys[n];
    }
    for n in 0..SECTORS {
        longest = if squares[n] > longest {
            squares[n]
        } else {
            longest
        };
    }
    for n in 0..SECTORS {
        if squares[n] == longest {
            *sum = [xs[n], ys[n]];
            return;
        }
    }
}

/// For each step the sum over the sector around its first degree. `wrapped` begins
/// `WHOLE_STEPS + 1` steps before the first.
#[inline(always)]
fn sector_sums(
    wrapped: &[f32; SECTORS + 2 * WHOLE_STEPS + 1],
    open: &[f32; SECTORS],
) -> [f32; SECTORS] {
    let mut sums = [0.0; SECTORS];
    let (first, last) = sums.split_at_mut(WHOLE_STEPS + 1);
    first.copy_from_slice(&open[SECTORS - WHOLE_STEPS - 1..]);
    last.copy_from_slice(&open[..SECTORS - WHOLE_STEPS - 1]);
    for lag in 1..=2 * WHOLE_STEPS + 1 {
        for step in 0..SECTORS {
            sums[step] += wrapped[step + lag];
        }
    }
    sums
}

/// The angle of `(x, y)`, rad in [0, 2π), to 1e-6: the arc tangent as the polynomial of least
/// greatest error on [0, 1], so that every machine has the same bits.
#[inline(always)]
fn angle_rad(x: f32, y: f32) -> f32 {
    use std::f32::consts::{FRAC_PI_2, PI, TAU};
    const ODD: [f32; 8] = [
        0.999_999_34,
        -0.333_298_6,
        0.199_465_66,
        -0.139_086_29,
        0.096_421_97,
        -0.055_912_32,
        0.021_862_96,
        -0.004_054_57,
    ];
    let (run, rise) = (x.abs(), y.abs());
    let ratio = run.min(rise) / run.max(rise).max(f32::MIN_POSITIVE);
    let square = ratio * ratio;
    let mut sum = 0.0;
    for coefficient in ODD.iter().rev() {
        sum = sum * square + coefficient;
    }
    let first_octant = ratio * sum;
    let quadrant = if rise > run {
        FRAC_PI_2 - first_octant
    } else {
        first_octant
    };
    let half = if x < 0.0 { PI - quadrant } else { quadrant };
    let angle = if y < 0.0 { TAU - half } else { half };
    if angle < TAU { angle } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::GrayImage;

    #[test]
    fn angles_are_those_of_the_arc_tangent() {
        for n in 0..100_000 {
            let truth = f64::from(n) * std::f64::consts::TAU / 100_000.0;
            let (y, x) = truth.sin_cos();
            let error = f64::from(angle_rad(7.5 * x as f32, 7.5 * y as f32)) - truth;
            let turned = (error + std::f64::consts::PI).rem_euclid(std::f64::consts::TAU);
            assert!(
                (turned - std::f64::consts::PI).abs() < 1e-6,
                "{truth} {error}"
            );
        }
        assert_eq!(angle_rad(0.0, 0.0), 0.0);
        assert!((0.0..std::f32::consts::TAU).contains(&angle_rad(1.0, -1e-30)));
    }

    #[test]
    fn the_disc_has_as_many_points_as_said() {
        let compass = Compass::new();
        let rows = compass.rows.iter();
        let weights: Vec<f32> = rows
            .flat_map(|r| &r.weights[r.first..r.end])
            .copied()
            .collect();
        assert_eq!(weights.len(), POINTS);
        assert!(weights.iter().all(|&w| w > 0.0));
        assert_eq!(weights.iter().filter(|&&w| w == 1.0).count(), 1);
    }

    #[test]
    fn sectors_are_sixty_degrees_open_at_both_ends() {
        // One unit gradient in a degree: a sector every 5° has it if it lies within ±29°.
        for degree in 0..360_usize {
            let (y, x) = (degree as f32).to_radians().sin_cos();
            let mut gradients = Gradients::default();
            (gradients.x[70], gradients.y[70]) = (x, y);
            let mut best = [0.0; 2];
            strongest_sector(&gradients, &mut best);
            assert_eq!(best, [x, y]);
        }
        let hit = |degree: usize, sector: usize| {
            let mut wrapped = [0.0; SECTORS + 2 * WHOLE_STEPS + 1];
            let mut open = [0.0; SECTORS];
            for lap in [0, SECTORS, 2 * SECTORS] {
                let at = degree / 5 + lap + WHOLE_STEPS + 1;
                if let Some(bin) = at.checked_sub(SECTORS).and_then(|at| wrapped.get_mut(at)) {
                    *bin = 1.0;
                }
            }
            open[degree / 5] = if degree.is_multiple_of(5) { 0.0 } else { 1.0 };
            sector_sums(&wrapped, &open)[sector]
        };
        for degree in 0..360 {
            for sector in 0..SECTORS {
                let apart = (degree as i32 - 5 * sector as i32 + 540) % 360 - 180;
                let expected = if apart.abs() < 30 { 1.0 } else { 0.0 };
                assert_eq!(hit(degree, sector), expected, "{degree} {sector}");
            }
        }
    }

    #[test]
    fn a_ramp_points_uphill() {
        for degree in (0..360).step_by(7) {
            let (sin, cos) = f64::from(degree).to_radians().sin_cos();
            let pixel = |n: u32| {
                let (x, y) = (f64::from(n % 101) - 50.0, f64::from(n / 101) - 50.0);
                (128.0 + 1.5 * (x * cos + y * sin)).round() as u8
            };
            let pixels = (0..101 * 101).map(pixel).collect();
            let image = GrayImage::from_vec(101, 101, pixels).unwrap_or_default();
            let mut integral = IntegralImage::default();
            integral.compute(&image);
            let found = Compass::new().direction(&integral, (50.0, 50.0), 3.0);
            let found = found.map_or(f32::NAN, |d| d.angle_rad.to_degrees());
            let error = (f64::from(found) - f64::from(degree) + 540.0) % 360.0 - 180.0;
            assert!(error.abs() < 1.0, "{degree}: {found}");
        }
    }

    #[test]
    fn too_small_an_image_has_no_direction() {
        let mut integral = IntegralImage::default();
        integral.compute(&GrayImage::filled(9, 40, 3));
        assert_eq!(Compass::new().direction(&integral, (4.0, 20.0), 2.4), None);
    }
}
