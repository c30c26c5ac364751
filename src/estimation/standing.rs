//! Status: inliers and plausibility of one pair after the other in, `tracking` or `degraded` out,
//! without flicker.
//!
//! A status falls at once, for a consumer must not rely on what is weak; it rises again only when
//! there is something to spare, or when several pairs in a row were good.

use super::Status;

/// Inliers that make a degraded estimate good at once, over those that keep a good one good.
const RISE_RATIO: f64 = 1.25;
/// Good pairs in a row that make a degraded estimate good.
const RISE_PAIRS: u32 = 3;
/// The innovation ratio above which the noise model is rejected.
const REJECTED: f64 = 1.0;
/// The innovation ratio below which the noise model is fine.
const FINE: f64 = 0.5;

/// How well the last pairs were measured.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Standing {
    good_inliers: u32,
    is_good: bool,
    good_in_a_row: u32,
}

impl Standing {
    /// One that takes the first measured pair at its word.
    pub(super) fn new(good_inliers: u32) -> Self {
        Self {
            good_inliers,
            is_good: true,
            good_in_a_row: 0,
        }
    }

    /// Begins anew.
    pub(super) fn begin(&mut self) {
        *self = Self::new(self.good_inliers);
    }

    /// Takes note of a pair that gave nothing.
    pub(super) fn lost(&mut self) {
        self.is_good = false;
        self.good_in_a_row = 0;
    }

    /// The status of a pair that was measured; `is_plausible` is false where the ground is taken as flat
    /// and proves not to be, where no robot moves like that, and where the images leave an axis open.
    pub(super) fn measured(
        &mut self,
        inliers: u32,
        innovation_ratio: f64,
        is_plausible: bool,
    ) -> Status {
        let good = inliers >= self.good_inliers && innovation_ratio <= REJECTED && is_plausible;
        let to_spare = f64::from(inliers) >= RISE_RATIO * f64::from(self.good_inliers)
            && innovation_ratio < FINE;
        self.good_in_a_row = if good {
            self.good_in_a_row.saturating_add(1)
        } else {
            0
        };
        self.is_good = good && (self.is_good || to_spare || self.good_in_a_row >= RISE_PAIRS);
        if self.is_good {
            Status::Tracking
        } else {
            Status::Degraded
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use Status::{Degraded, Tracking};

    fn run(pairs: &[(u32, f64)]) -> Vec<Status> {
        let mut standing = Standing::new(30);
        let each = |(inliers, ratio): &(u32, f64)| standing.measured(*inliers, *ratio, true);
        pairs.iter().map(each).collect()
    }

    #[test]
    fn a_status_falls_at_once_and_does_not_flicker_at_the_threshold() {
        let inliers = [31, 29, 31, 29, 31, 31, 31, 29].map(|n| (n, 0.25));
        assert_eq!(
            run(&inliers),
            [
                Tracking, Degraded, Degraded, Degraded, Degraded, Degraded, Tracking, Degraded
            ]
        );
    }

    #[test]
    fn with_something_to_spare_it_rises_at_once() {
        assert_eq!(
            run(&[(20, 0.25), (38, 0.25), (38, 0.25)]),
            [Degraded, Tracking, Tracking]
        );
    }

    #[test]
    fn a_noise_model_that_is_rejected_degrades_the_estimate() {
        assert_eq!(
            run(&[(100, 0.25), (100, 0.9), (100, 1.1), (100, 0.7), (100, 0.3)]),
            [Tracking, Tracking, Degraded, Degraded, Tracking]
        );
    }

    #[test]
    fn after_a_loss_a_few_pairs_must_agree() {
        let mut standing = Standing::new(30);
        standing.lost();
        let statuses = [31; 3].map(|n| standing.measured(n, 0.25, true));
        assert_eq!(statuses, [Degraded, Degraded, Tracking]);
    }
}
