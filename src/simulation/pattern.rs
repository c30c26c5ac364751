//! A seed in, the grey values of a periodic pattern out.
//!
//! Scattered leaves of all sizes that cover one another have the statistics of natural images:
//! edges, corners and blobs at every scale, with the same contrast at each (Lee, Mumford and Huang,
//! *Occlusion models for natural images*, 2001).

use rand::{RngExt, SeedableRng};
use rand_xoshiro::Xoshiro256PlusPlus;

/// What leaves are scattered.
#[derive(Clone, Copy)]
pub(super) struct Leaves {
    /// Smallest and largest radius, texels; as many per octave of area as fill the same area.
    pub(super) radius_texel: [f64; 2],
    /// How often, on average, a texel is covered.
    pub(super) coverage: f64,
    /// Darkest and brightest albedo.
    pub(super) albedo: [f32; 2],
}

/// Share of the leaves that are polygons; the others are ellipses.
const POLYGONS: f64 = 0.6;
/// Sides that a polygon has at most.
const MAX_SIDES: usize = 6;
/// A shade's change from a leaf's centre to its rim.
const MAX_SHADING: f32 = 0.12;

/// Leaves over a ground of middle grey.
pub(super) fn leaves(size: usize, style: &Leaves, seed: u64) -> Vec<f32> {
    let ground = 0.5 * (style.albedo[0] + style.albedo[1]);
    let mut values = vec![ground; size * size];
    scatter(&mut values, size, style, seed);
    values
}

/// One tile or two courses of bricks, with joints; meant to be repeated.
pub(super) fn bricks(size: usize, seed: u64) -> Vec<f32> {
    let style = Leaves {
        radius_texel: [4.0, size as f64 / 8.0],
        coverage: 1.0,
        albedo: [0.25, 0.75],
    };
    let mut values = leaves(size, &style, seed);
    let joint = size as f64 / 40.0;
    let period = size as f64;
    for (i, value) in values.iter_mut().enumerate() {
        let (x, y) = ((i % size) as f64 + 0.5, (i / size) as f64 + 0.5);
        let course = y * 2.0 / period;
        let shift = if course < 1.0 { 0.0 } else { 0.5 * period };
        let to_upright = distance_to_multiple(x + shift, period);
        let to_level = distance_to_multiple(y, 0.5 * period);
        let cover = soft_step(to_upright.min(to_level) - joint) as f32;
        *value = 0.12 * cover + *value * (1.0 - cover);
    }
    values
}

fn distance_to_multiple(x: f64, period: f64) -> f64 {
    (x - (x / period).round() * period).abs()
}

/// 1 inside (negative distance, texels), 0 outside: a ramp of two texels, whose smoothing is the
/// one that a texture's finest level must carry.
fn soft_step(distance_texel: f64) -> f64 {
    (0.5 - 0.5 * distance_texel).clamp(0.0, 1.0)
}

fn scatter(values: &mut [f32], size: usize, style: &Leaves, seed: u64) {
    let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
    let [r_min, r_max] = style.radius_texel;
    // Radii with density ∝ r⁻³ have the mean square 2 ln(r_max/r_min) / (r_min⁻² − r_max⁻²).
    let (inv_min2, inv_max2) = (r_min.powi(-2), r_max.powi(-2));
    let mean_area = 2.0 * 2.0 * (r_max / r_min).ln() / (inv_min2 - inv_max2);
    let count = style.coverage * (size * size) as f64 / mean_area;
    for _ in 0..count as usize {
        let share: f64 = rng.random();
        let radius = (inv_min2 + share * (inv_max2 - inv_min2)).powf(-0.5);
        let leaf = Leaf::random(radius, style.albedo, &mut rng);
        let centre = [
            rng.random::<f64>() * size as f64,
            rng.random::<f64>() * size as f64,
        ];
        leaf.draw(values, size, centre);
    }
}

/// A convex shape around the origin: half-planes, and an ellipse that bounds it.
struct Leaf {
    sides: [[f64; 3]; MAX_SIDES],
    count: usize,
    axes: [f64; 2],
    turn: [f64; 2],
    albedo: f32,
    shading: [f32; 2],
}

impl Leaf {
    fn random(radius: f64, albedo: [f32; 2], rng: &mut Xoshiro256PlusPlus) -> Self {
        let polygon = rng.random::<f64>() < POLYGONS;
        let count = if polygon {
            rng.random_range(3..=MAX_SIDES)
        } else {
            0
        };
        let tau = std::f64::consts::TAU;
        let start: f64 = rng.random::<f64>() * tau;
        let mut sides = [[0.0; 3]; MAX_SIDES];
        for (i, side) in sides.iter_mut().take(count).enumerate() {
            let angle = start + tau * (i as f64 + 0.5 * rng.random::<f64>()) / count as f64;
            *side = [
                angle.cos(),
                angle.sin(),
                radius * rng.random_range(0.45..0.95),
            ];
        }
        let slim = if polygon {
            1.0
        } else {
            rng.random_range(0.4..1.0)
        };
        let shade = MAX_SHADING * rng.random::<f32>() / radius as f32;
        Self {
            sides,
            count,
            axes: [radius, radius * slim],
            turn: [start.cos(), start.sin()],
            albedo: rng.random_range(albedo[0]..albedo[1]),
            shading: [shade * start.cos() as f32, shade * start.sin() as f32],
        }
    }

    /// Signed distance from the rim, texels, negative inside.
    fn distance(&self, x: f64, y: f64) -> f64 {
        let along = (x * self.turn[0] + y * self.turn[1]) / self.axes[0];
        let across = (y * self.turn[0] - x * self.turn[1]) / self.axes[1];
        let square = along * along + across * across;
        let slope = ((along / self.axes[0]).powi(2) + (across / self.axes[1]).powi(2)).sqrt();
        // The first-order distance from the ellipse; its centre has none, and is inside.
        let to_ellipse = 0.5 * (square - 1.0) / slope.max(1e-9);
        self.sides[..self.count]
            .iter()
            .map(|[nx, ny, d]| nx * x + ny * y - d)
            .fold(to_ellipse, f64::max)
    }

    fn draw(&self, values: &mut [f32], size: usize, centre: [f64; 2]) {
        let reach = self.axes[0] + 1.0;
        let mask = size - 1;
        let span = |c: f64| (c - reach).ceil() as i64..=(c + reach).floor() as i64;
        for y in span(centre[1]) {
            let row = (y as usize & mask) * size;
            let dy = y as f64 - centre[1];
            for x in span(centre[0]) {
                let dx = x as f64 - centre[0];
                if dx * dx + dy * dy > reach * reach {
                    continue;
                }
                let cover = soft_step(self.distance(dx, dy)) as f32;
                if cover > 0.0 {
                    let value = &mut values[row + (x as usize & mask)];
                    let shade = self.shading[0] * dx as f32 + self.shading[1] * dy as f32;
                    let leaf = (self.albedo + shade).clamp(0.02, 0.98);
                    *value += cover * (leaf - *value);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STYLE: Leaves = Leaves {
        radius_texel: [3.0, 40.0],
        coverage: 3.0,
        albedo: [0.1, 0.9],
    };

    #[test]
    fn the_same_seed_paints_the_same_pattern_and_another_one_another() {
        assert_eq!(leaves(128, &STYLE, 5), leaves(128, &STYLE, 5));
        assert_ne!(leaves(128, &STYLE, 5), leaves(128, &STYLE, 6));
    }

    #[test]
    fn leaves_leave_little_ground_and_much_contrast() {
        let values = leaves(256, &STYLE, 1);
        let n = values.len() as f32;
        let bare = values.iter().filter(|&&v| v == 0.5).count() as f32 / n;
        assert!(bare < 0.1, "{bare}");
        let mean = values.iter().sum::<f32>() / n;
        let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f32>() / n;
        // A uniform albedo from 0.1 to 0.9 has σ = 0.23.
        assert!((0.15..0.27).contains(&variance.sqrt()), "{variance}");
    }

    #[test]
    fn patterns_continue_across_their_border() {
        let size = 128;
        let values = leaves(size, &STYLE, 3);
        let step = |a: usize, b: usize| {
            (0..size)
                .map(|y| (values[y * size + a] - values[y * size + b]).abs())
                .sum::<f32>()
                / size as f32
        };
        let inside = (1..size).map(|x| step(x - 1, x)).sum::<f32>() / (size - 1) as f32;
        assert!(step(size - 1, 0) < 3.0 * inside);
    }
}
