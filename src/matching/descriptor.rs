//! Comparing descriptors: distance, the best of several candidates, and the tests a match passes.

#![expect(
    clippy::needless_range_loop,
    reason = "several arrays run along one index, plainly enough to be computed by whole registers"
)]

use super::Settings;
use crate::features::{Features, Keypoint};
use crate::simd::widened;

/// Lanes of partial sums: the compiler turns them into vector registers, and the fixed order of
/// additions keeps the bits the same everywhere.
const LANES: usize = 16;

/// Blocks of lanes between two looks at what the sum has come to.
const BLOCKS_A_LOOK: usize = 2;

/// Squared Euclidean distance of two descriptors of equal length; `None` if it exceeds `reach`, which
/// most often shows long before the end.
///
/// Partial sums never shrink, not even by rounding: what exceeds `reach` half-way does so at the end.
#[inline(always)]
fn squared_distance_within(a: &[f32], b: &[f32], reach: f32) -> Option<f32> {
    let mut sums = [0.0_f32; LANES];
    let (a_blocks, a_rest) = a.as_chunks::<LANES>();
    let (b_blocks, b_rest) = b.as_chunks::<LANES>();
    let blocks = a_blocks.len().min(b_blocks.len());
    for block in 0..blocks {
        let (x, y) = (&a_blocks[block], &b_blocks[block]);
        for lane in 0..LANES {
            let d = x[lane] - y[lane];
            sums[lane] += d * d;
        }
        let is_look = (block + 1) % BLOCKS_A_LOOK == 0 || block + 1 == blocks;
        if is_look && total(sums) > reach {
            return None;
        }
    }
    let mut rest = 0.0;
    for n in 0..a_rest.len().min(b_rest.len()) {
        rest += (a_rest[n] - b_rest[n]) * (a_rest[n] - b_rest[n]);
    }
    let squared = total(sums) + rest;
    (squared <= reach).then_some(squared)
}

/// The sum over all lanes, in a fixed order.
#[inline(always)]
fn total(mut sums: [f32; LANES]) -> f32 {
    let mut width = LANES / 2;
    while width > 0 {
        for lane in 0..width {
            sums[lane] += sums[lane + width];
        }
        width /= 2;
    }
    sums[0]
}

/// The squared distance beyond which a candidate can neither be accepted nor stand in the way of
/// another that can: √(this) × `max_ratio` is `max_distance`, and a little more for rounding.
pub(super) fn greatest_reach(settings: &Settings) -> f32 {
    let reach = settings.max_distance / settings.max_ratio;
    reach * reach * (1.0 + 1e-5)
}

/// The best and the second best candidate of one feature.
#[derive(Clone, Copy, Debug)]
pub(super) struct Best {
    index: u32,
    squared: f32,
    second_squared: f32,
}

impl Best {
    /// Before any candidate was seen.
    pub(super) const NONE: Self = Self {
        index: u32::MAX,
        squared: f32::INFINITY,
        second_squared: f32::INFINITY,
    };

    /// Takes note of a candidate.
    #[inline(always)]
    fn offer(&mut self, index: u32, squared: f32) {
        if squared < self.squared {
            self.second_squared = self.squared;
            self.squared = squared;
            self.index = index;
        } else if squared < self.second_squared {
            self.second_squared = squared;
        }
    }

    /// The winner, if it is near enough and clearly nearer than the second.
    pub(super) fn accepted(&self, settings: &Settings) -> Option<u32> {
        let ratio2 = settings.max_ratio * settings.max_ratio;
        let limit2 = settings.max_distance * settings.max_distance;
        (self.index != u32::MAX
            && self.squared <= limit2
            && self.squared <= ratio2 * self.second_squared)
            .then_some(self.index)
    }
}

/// One feature that is compared with its candidates.
#[derive(Clone, Copy, Debug)]
pub(super) struct Seeker<'a> {
    /// Its number in its list.
    pub(super) number: u32,
    /// Its descriptor.
    pub(super) descriptor: &'a [f32],
    /// The squared distance beyond which nothing matters.
    pub(super) greatest_reach: f32,
}

/// A candidate.
#[derive(Clone, Copy, Debug)]
pub(super) struct Candidate {
    /// Its number in its list.
    pub(super) number: u32,
    /// Its descriptor's number among those of its image.
    pub(super) feature: u32,
}

widened! {
    /// Compares a feature with candidates among the features of an image, one after the other: the
    /// feature's best two and theirs, by their numbers, take note of each other.
    pub(super) fn compare = compare_narrow, (
        seeker: Seeker<'_>,
        candidates: &[Candidate],
        features: &Features,
        best: &mut Best,
        bests: &mut [Best],
    )
}

#[inline(always)]
fn compare_narrow(
    seeker: Seeker<'_>,
    candidates: &[Candidate],
    features: &Features,
    best: &mut Best,
    bests: &mut [Best],
) {
    for n in 0..candidates.len() {
        let Candidate { number, feature } = candidates[n];
        let other = &mut bests[number as usize];
        // What is farther than both second bests changes neither.
        let farther = best.second_squared.max(other.second_squared);
        let reach = farther.min(seeker.greatest_reach);
        let descriptor = features.descriptor(feature as usize);
        if let Some(squared) = squared_distance_within(seeker.descriptor, descriptor, reach) {
            best.offer(number, squared);
            other.offer(seeker.number, squared);
        }
    }
}

/// Whether two keypoints can be the same spot at all: same polarity, similar size.
pub(super) fn compatible(a: &Keypoint, b: &Keypoint, settings: &Settings) -> bool {
    a.laplacian == b.laplacian
        && a.size_px <= b.size_px * settings.max_size_ratio
        && b.size_px <= a.size_px * settings.max_size_ratio
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn distance_agrees_with_the_plain_sum(
            pairs in prop::collection::vec((-1.0..1.0_f32, -1.0..1.0_f32), 0..200)
        ) {
            let (a, b): (Vec<f32>, Vec<f32>) = pairs.iter().copied().unzip();
            let plain: f64 = pairs.iter().map(|(x, y)| f64::from(x - y).powi(2)).sum();
            let found = squared_distance_within(&a, &b, f32::INFINITY).expect("within reach");
            prop_assert!((f64::from(found) - plain).abs() <= 1e-5 * plain.max(1.0));
        }

        #[test]
        fn looking_early_changes_no_bit(
            pairs in prop::collection::vec((-1.0..1.0_f32, -1.0..1.0_f32), 0..200),
            share in 0.0..2.0_f32,
        ) {
            let (a, b): (Vec<f32>, Vec<f32>) = pairs.iter().copied().unzip();
            let all = squared_distance_within(&a, &b, f32::INFINITY).expect("within reach");
            for reach in [share * all, all, all.next_down(), all.next_up()] {
                let found = squared_distance_within(&a, &b, reach);
                prop_assert_eq!(found, (all <= reach).then_some(all));
            }
        }

        /// Whatever is out of reach, and whichever candidate it is, leaves the choice as it was.
        #[test]
        fn candidates_out_of_reach_decide_nothing(
            squares in prop::collection::vec(0.0..2.0_f32, 1..8),
            max_ratio in 0.1..1.0_f32, max_distance in 0.0..2.0_f32,
        ) {
            let settings = Settings { max_ratio, max_distance, ..Settings::default() };
            let choice = |reach: f32| {
                let mut best = Best::NONE;
                for (i, &squared) in squares.iter().enumerate() {
                    if squared <= reach {
                        best.offer(i as u32, squared);
                    }
                }
                best.accepted(&settings)
            };
            prop_assert_eq!(choice(greatest_reach(&settings)), choice(f32::INFINITY));
        }
    }

    #[test]
    fn the_best_two_are_kept_in_any_order() {
        let settings = Settings::default();
        for order in [[0.09, 0.25, 0.16], [0.25, 0.16, 0.09], [0.16, 0.09, 0.25]] {
            let mut best = Best::NONE;
            for (i, d) in order.into_iter().enumerate() {
                best.offer(i as u32, d);
            }
            assert_eq!((best.squared, best.second_squared), (0.09, 0.16));
            // √(0.09 / 0.16) = 0.75 passes a ratio of 0.85.
            let winner = order.iter().position(|&d| d == 0.09).map(|i| i as u32);
            assert_eq!(best.accepted(&settings), winner);
        }
        assert_eq!(Best::NONE.accepted(&settings), None);
    }
}
