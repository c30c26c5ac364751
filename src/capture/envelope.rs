//! Points that lie above a line in, by distances whose distribution nobody knows; the line out, with
//! how far it may be off.
//!
//! Of all lines below the points the one nearest to them is the edge of their lower convex hull that
//! spans their mean (it minimises the sum of the distances, which is linear on each edge). It lies too
//! high, for no point lies on the truth. By how much is told by the lowest points: whatever the
//! distances are distributed like, the k-th lowest of them is about `scale · k^shape` (they are the
//! points of a Poisson process, as extreme value theory has it), with a shape of 1 where distances near
//! zero are as likely as others, and less where they are rare. Scale and shape are read off two ranks.
//!
//! That law holds where distances at one time are like those at another. A host that is busy now and then
//! holds up even its most punctual frames, for a while at a time, and a line follows such a creeping floor
//! as it follows the truth. So the points are looked at in blocks, too: what the lowest points of the blocks
//! scatter by beyond what the law gives them is taken for a floor that creeps.
//!
//! Source of the idea: clock skew from one-way delays by the convex hull, L. Zhang, Z. Liu, C. H. Xia,
//! *Clock synchronization algorithms for network measurements*, INFOCOM 2002.

/// 1 σ of the slope before anything is known: what crystals are sold with.
const SIGMA_SLOPE: f64 = 50e-6;
/// Largest slope that a crystal may have; more is no crystal, or no frame rate.
const MAX_SLOPE: f64 = 300e-6;
/// What a frame is held up by while nothing is known, ns: USB and Ethernet on a busy host.
const USUAL_DISTANCE_NS: f64 = 5e6;
/// Below this a distance says more about the resolution of the stamps than about anything else, ns.
const MIN_SIGMA_NS: f64 = 300.0;
/// The shape while nothing is known, as if seen on so many points.
const USUAL_SHAPE: f64 = 0.5;
const USUAL_SHAPE_WEIGHT: f64 = 4.0;
/// Shapes beyond these are taken for these.
const SHAPES: (f64, f64) = (0.2, 1.5);
/// Points from which the shape is known lie below this share of all, for the law holds near zero only.
const FAR_SHARE: usize = 16;
/// The farther of the two ranks, at least (where there are points enough) and at most.
const FAR_RANKS: (usize, usize) = (8, 32);
/// The farther rank by the nearer.
const FAR_BY_NEAR: usize = 4;
/// What a line rises by from end to end where its floor walks at random, in scatters about the line: of a
/// walk of variance 1 the line rises by (6/5)^(1/2), and (1/15)^(1/2) is left. Measured with hosts that are
/// busy for one or two seconds at a time.
const RISE_OF_CREEP: f64 = 4.24;
/// Steps of the iteration that finds shape and scale, which depend on each other but little.
const STEPS: usize = 5;
/// Distances that leave the law soon make the line worse than the law says: measured with Γ-distributed
/// ones and with such as only now and then are short.
const CAUTION: f64 = 1.15;

/// Into how many blocks the points are cut to see whether their floor creeps.
const BLOCKS: usize = 8;
/// Fewest points a block, and fewest blocks.
const MIN_BLOCK: usize = 6;
const MIN_BLOCKS: usize = 4;
/// What the lowest point of a block varies by, in distances to the fourth lowest: 0.45 of them at a shape of
/// 1/2, 0.32 at 1.
const RANK_IN_BLOCK: usize = 4;
const FLOOR_BY_GAP: f64 = 0.45;
/// What the floors of blocks may scatter by, in variances that are expected of them, before it means
/// anything: of eight, one set in six reaches that by chance.
const CHANCE: f64 = 1.5;

/// A line below points.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct LowerLine {
    /// At x = 0, ns.
    pub(super) height_ns: f64,
    pub(super) slope: f64,
    /// 1 σ of the height at the centre, ns.
    pub(super) sigma_height_ns: f64,
    /// 1 σ of the slope, independent of the height at the centre.
    pub(super) sigma_slope: f64,
    /// Where the height is known best.
    pub(super) centre_ns: f64,
}

/// Fits lines below points, in memory that it keeps.
#[derive(Clone, Debug, Default)]
pub(super) struct Envelope {
    points: Vec<(f64, f64)>,
    hull: Vec<(f64, f64)>,
    heights: Vec<f64>,
}

impl Envelope {
    /// The line below points whose x rise, all in ns; `None` where there are none.
    pub(super) fn fit(&mut self, points: impl Iterator<Item = (f64, f64)>) -> Option<LowerLine> {
        self.points.clear();
        self.points.extend(points);
        let span_ns = self.points.last()?.0 - self.points.first()?.0;
        let mean_ns = self.points.iter().map(|p| p.0).sum::<f64>() / self.points.len() as f64;
        lower_hull(&self.points, &mut self.hull);
        let mut edges = self.hull.windows(2);
        let slope = edges.find(|edge| edge[1].0 >= mean_ns).map_or(0.0, |edge| {
            (edge[1].1 - edge[0].1) / (edge[1].0 - edge[0].0)
        });
        let (_, tail) = self.lowest(slope, 1.0);
        let creep_ns = self.creep_ns(slope);
        let sigma_slope = tail.sigma_rise_ns().hypot(RISE_OF_CREEP * creep_ns) / span_ns.max(1.0);
        // What is known beforehand and what the points say, each with its weight.
        let weight = if slope.abs() < MAX_SLOPE {
            1.0 / (1.0 + (sigma_slope / SIGMA_SLOPE).powi(2))
        } else {
            0.0
        };
        let slope = weight * slope;
        let ((x_ns, height_ns), tail) = self.lowest(slope, weight);
        Some(LowerLine {
            height_ns: height_ns - tail.lift_ns(weight),
            slope,
            sigma_height_ns: tail
                .sigma_height_ns(weight)
                .hypot(creep_ns)
                .max(MIN_SIGMA_NS),
            sigma_slope: SIGMA_SLOPE * (1.0 - weight).sqrt(),
            // A line of a given slope is known where it touches.
            centre_ns: weight * mean_ns + (1.0 - weight) * x_ns,
        })
    }

    /// 1 σ by which the floor below the points creeps: what the lowest points of blocks, in the order of
    /// time, scatter by above a line of this slope, beyond what the next lowest points let expect.
    fn creep_ns(&mut self, slope: f64) -> f64 {
        let blocks = BLOCKS.min(self.points.len() / MIN_BLOCK);
        if blocks < MIN_BLOCKS {
            return 0.0;
        }
        let (mut sum, mut squares, mut gaps) = (0.0, 0.0, 0.0);
        let first_ns = self.points.first().map_or(0.0, |p| p.1 - slope * p.0);
        for block in 0..blocks {
            let [from, to] = [block, block + 1].map(|b| b * self.points.len() / blocks);
            self.heights.clear();
            // Less the first, so that squares of large numbers do not cancel.
            let above = |p: &(f64, f64)| p.1 - slope * p.0 - first_ns;
            self.heights.extend(self.points[from..to].iter().map(above));
            let (below, reach_ns, _) = self
                .heights
                .select_nth_unstable_by(RANK_IN_BLOCK - 1, f64::total_cmp);
            let floor_ns = below.iter().copied().fold(*reach_ns, f64::min);
            sum += floor_ns;
            squares += floor_ns * floor_ns;
            gaps += *reach_ns - floor_ns;
        }
        let n = blocks as f64;
        let scatter = (squares - sum * sum / n) / (n - 1.0);
        let by_chance_ns = FLOOR_BY_GAP * gaps / n;
        (scatter - CHANCE * by_chance_ns * by_chance_ns)
            .max(0.0)
            .sqrt()
    }

    /// The point that the highest line of a slope below all points touches (its x, and the line's height
    /// at x = 0), and how the lowest points lie above the line. `freedom` is 0 where the slope was known
    /// beforehand, 1 where it is the points' own.
    fn lowest(&mut self, slope: f64, freedom: f64) -> ((f64, f64), Tail) {
        let mut lowest = (0.0, f64::INFINITY);
        self.heights.clear();
        for &(x, y) in &self.points {
            let height = y - slope * x;
            if height < lowest.1 {
                lowest = (x, height);
            }
            self.heights.push(height);
        }
        let count = self.heights.len();
        let far = (count / FAR_SHARE)
            .max(FAR_RANKS.0.min(count / 2))
            .clamp(1, FAR_RANKS.1);
        let near = far / FAR_BY_NEAR;
        let (below, reach, _) = self.heights.select_nth_unstable_by(far - 1, f64::total_cmp);
        let far_ns = *reach - lowest.1;
        let near_ns = (near > 0).then(|| {
            let (_, reach, _) = below.select_nth_unstable_by(near - 1, f64::total_cmp);
            *reach - lowest.1
        });
        (lowest, Tail::of(count, far, far_ns, near_ns, freedom))
    }
}

/// How the lowest points lie above the truth: the k-th by about `scale · k^shape`.
#[derive(Clone, Copy, Debug)]
struct Tail {
    scale_ns: f64,
    shape: f64,
    /// 1 σ of the scale, as a share of it.
    doubt: f64,
}

impl Tail {
    /// From how far the points of the far and of the near rank lie above the fitted line.
    fn of(count: usize, far: usize, far_ns: f64, near_ns: Option<f64>, freedom: f64) -> Self {
        let rank = far as f64;
        // As if one more had been seen, held up by what is usual: few that happen to lie close to each
        // other must not pretend that all do.
        let usual_ns = USUAL_DISTANCE_NS / (count * count) as f64;
        let scale_ns = |shape: f64| {
            let ranks = rank.powf(shape) - lift(shape, freedom);
            far_ns / ranks.max(0.3) + usual_ns
        };
        let mut shape = USUAL_SHAPE;
        if let Some(near_ns) = near_ns {
            for _ in 0..STEPS {
                // The line itself is too high.
                let lift_ns = lift(shape, freedom) * scale_ns(shape);
                let ratio = (far_ns + lift_ns) / (near_ns + lift_ns);
                let seen = (ratio.ln() / (FAR_BY_NEAR as f64).ln()).clamp(SHAPES.0, SHAPES.1);
                shape =
                    (rank * seen + USUAL_SHAPE_WEIGHT * USUAL_SHAPE) / (rank + USUAL_SHAPE_WEIGHT);
            }
        }
        // 1 / near − 1 / far is the variance of the logarithm of the ratio by the shape's square.
        let variance_of_ratio = (FAR_BY_NEAR - 1) as f64 / (rank + USUAL_SHAPE_WEIGHT);
        let sigma_shape = shape * variance_of_ratio.sqrt() / (FAR_BY_NEAR as f64).ln();
        Self {
            scale_ns: scale_ns(shape),
            shape,
            doubt: (shape / rank.sqrt()).hypot(sigma_shape * rank.ln()),
        }
    }

    /// By how much a line is usually too high, ns.
    fn lift_ns(&self, freedom: f64) -> f64 {
        self.scale_ns * lift(self.shape, freedom)
    }

    /// 1 σ of the height of a line that has been lowered by its lift, ns.
    fn sigma_height_ns(&self, freedom: f64) -> f64 {
        let of_lift = lift(self.shape, freedom) * self.doubt;
        self.cautious_ns() * spread(self.shape, freedom).hypot(of_lift)
    }

    /// 1 σ of what a line of free slope rises by from end to end, ns.
    fn sigma_rise_ns(&self) -> f64 {
        self.cautious_ns() * spread_of_rise(self.shape)
    }

    fn cautious_ns(&self) -> f64 {
        CAUTION * self.scale_ns * 1_f64.hypot(self.doubt)
    }
}

/// By how much a line is too high on average, in scales: at the mean of the points where its slope is
/// free, where it touches else. This and the two that follow are fits to simulations (see the tests).
fn lift(shape: f64, freedom: f64) -> f64 {
    0.9 + freedom * (0.1 + 0.84 * shape * shape)
}

/// By how much that varies, in scales.
fn spread(shape: f64, freedom: f64) -> f64 {
    let (held, free) = (0.9 + 0.1 * shape, 0.87 + 0.47 * shape * shape);
    shape * (held + freedom * (free - held))
}

/// By how much the rise from end to end of a line of free slope varies, in scales.
fn spread_of_rise(shape: f64) -> f64 {
    spread(shape, 1.0) * (3.6 + 1.7 * shape)
}

/// The lower convex hull of points whose x rise (Andrew's monotone chain).
fn lower_hull(points: &[(f64, f64)], hull: &mut Vec<(f64, f64)>) {
    hull.clear();
    for &p in points {
        while let [.., a, b] = hull[..] {
            let turn = (b.0 - a.0) * (p.1 - a.1) - (b.1 - a.1) * (p.0 - a.0);
            if turn > 0.0 {
                break;
            }
            hull.pop();
        }
        hull.push(p);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_xoshiro::Xoshiro256PlusPlus;

    /// Mean and standard deviation.
    fn moments(values: &[f64]) -> (f64, f64) {
        let n = values.len() as f64;
        let mean = values.iter().sum::<f64>() / n;
        let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n;
        (mean, variance.sqrt())
    }

    fn assert_near(what: &str, stated: f64, measured: f64) {
        println!("{what}: {stated:.3}, measured {measured:.3}");
        assert!((stated / measured - 1.0).abs() < 0.15, "{what}");
    }

    /// Distances of which those below r are as many as r^(1/shape) says: the line's errors in scales are
    /// what the fits say.
    #[test]
    fn lines_are_as_wrong_as_the_fits_say() {
        const COUNT: usize = 400;
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(1);
        for shape in [0.25, 1.0 / 3.0, 0.5, 2.0 / 3.0, 1.0] {
            let scale = (COUNT as f64).powf(-shape);
            let (mut held, mut free, mut rises) = (Vec::new(), Vec::new(), Vec::new());
            let (mut points, mut hull) = (Vec::new(), Vec::new());
            for _ in 0..2000 {
                points.clear();
                points.extend((0..COUNT).map(|n| {
                    let x = (n as f64 + 0.5) / COUNT as f64 - 0.5;
                    (x, rng.random::<f64>().powf(shape) / scale)
                }));
                lower_hull(&points, &mut hull);
                let mut edges = hull.windows(2);
                let edge = edges.find(|e| e[1].0 >= 0.0).expect("it spans the middle");
                let slope = (edge[1].1 - edge[0].1) / (edge[1].0 - edge[0].0);
                free.push(edge[0].1 - slope * edge[0].0);
                rises.push(slope);
                held.push(points.iter().map(|p| p.1).fold(f64::INFINITY, f64::min));
            }
            for (freedom, heights) in [(0.0, &held), (1.0, &free)] {
                let (mean, deviation) = moments(heights);
                let named = |what| format!("{what} of shape {shape:.2} and freedom {freedom}");
                assert_near(&named("lift"), lift(shape, freedom), mean);
                assert_near(&named("spread"), spread(shape, freedom), deviation);
            }
            let (_, deviation) = moments(&rises);
            let what = format!("rise of shape {shape:.2}");
            assert_near(&what, spread_of_rise(shape), deviation);
        }
    }

    #[test]
    fn nothing_has_no_line_and_one_point_a_level_one() {
        let mut envelope = Envelope::default();
        assert_eq!(envelope.fit(std::iter::empty()), None);
        let line = envelope.fit(std::iter::once((0.0, 7.0))).expect("a line");
        assert_eq!((line.slope, line.centre_ns), (0.0, 0.0));
        assert!(line.sigma_height_ns > 1e6, "{line:?}");
        assert!((line.sigma_slope - SIGMA_SLOPE).abs() < 1e-12, "{line:?}");
    }
}
