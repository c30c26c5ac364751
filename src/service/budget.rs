//! How long pairs took and how many wait in; overruns, and which share of the features is looked for, out.
//!
//! Pairs that wait show that the stages are slower than the cameras. Before one has to be dropped, fewer
//! features are looked for: a fifth fewer each time pairs have waited three times in a row, down to three
//! tenths. When none has waited for a while, the share grows again, slowly, so that it does not swing.

use std::time::Duration;

/// Rows in a row with pairs waiting before features are trimmed.
const LATE_ROWS: u32 = 3;
/// Rows in a row without before the share grows.
const CALM_ROWS: u32 = 40;
/// What is left of the share when it shrinks.
const SHRINK: f32 = 0.8;
/// What is added to it when it grows.
const GROW: f32 = 0.05;
/// Below, too few features are left to be matched.
const LEAST_SHARE: f32 = 0.3;

/// What a row says about the time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Timing {
    /// From the pair's arrival to its row.
    pub total: Duration,
    /// Work of the stages on it.
    pub busy: Duration,
    /// Time between two pairs, as it usually is; zero while it is not known.
    pub period: Duration,
    /// Pairs that wait for the stages.
    pub waiting: usize,
}

/// Watches the time that pairs take.
#[derive(Clone, Debug)]
pub struct FrameBudget {
    deadline: Duration,
    trims: bool,
    share: f32,
    late_rows: u32,
    calm_rows: u32,
    overruns: u64,
    over_period: u64,
}

impl FrameBudget {
    /// A budget with a deadline a pair; `trims` says whether features may be trimmed.
    #[must_use]
    pub fn new(deadline: Duration, trims: bool) -> Self {
        Self {
            deadline,
            trims,
            share: 1.0,
            late_rows: 0,
            calm_rows: 0,
            overruns: 0,
            over_period: 0,
        }
    }

    /// Takes over other settings; counters go on.
    pub fn set(&mut self, deadline: Duration, trims: bool) {
        self.deadline = deadline;
        self.trims = trims;
        if !trims {
            self.share = 1.0;
        }
    }

    /// Takes note of a row; the new share of features where it changes.
    pub fn add(&mut self, timing: &Timing) -> Option<f32> {
        self.overruns += u64::from(timing.total > self.deadline);
        let is_over_period = !timing.period.is_zero() && timing.busy > timing.period;
        self.over_period += u64::from(is_over_period);
        if timing.waiting > 0 {
            self.late_rows += 1;
            self.calm_rows = 0;
        } else {
            self.late_rows = 0;
            self.calm_rows += 1;
        }
        let wanted = if self.late_rows >= LATE_ROWS {
            (self.share * SHRINK).max(LEAST_SHARE)
        } else if self.calm_rows >= CALM_ROWS {
            (self.share + GROW).min(1.0)
        } else {
            return None;
        };
        (self.late_rows, self.calm_rows) = (0, 0);
        if !self.trims || wanted == self.share {
            return None;
        }
        self.share = wanted;
        Some(wanted)
    }

    /// The share of the features that is looked for, 0.3 to 1.
    #[must_use]
    pub fn share(&self) -> f32 {
        self.share
    }

    /// Pairs whose rows came after the deadline.
    #[must_use]
    pub fn overruns(&self) -> u64 {
        self.overruns
    }

    /// Pairs that took more work than there is time between two; stages overlap, so that this alone does
    /// not make them late.
    #[must_use]
    pub fn over_period(&self) -> u64 {
        self.over_period
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(waiting: usize) -> Timing {
        Timing {
            total: Duration::from_millis(60),
            busy: Duration::from_millis(30),
            period: Duration::from_millis(50),
            waiting,
        }
    }

    /// Stages whose work is a fixed part and one that goes with the share; cameras of one period. The queue
    /// holds one pair, as the capture's does.
    fn overload(fixed_ms: f64, share_ms: f64, period_ms: f64, rows: usize) -> (FrameBudget, usize) {
        let mut budget = FrameBudget::new(Duration::from_secs(1), true);
        let (mut backlog_ms, mut dropped_late) = (0.0_f64, 0);
        for n in 0..rows {
            backlog_ms += fixed_ms + share_ms * f64::from(budget.share()) - period_ms;
            backlog_ms = backlog_ms.max(0.0);
            let mut waiting = (backlog_ms / period_ms) as usize;
            while waiting > 1 {
                waiting -= 1;
                backlog_ms -= period_ms;
                dropped_late += usize::from(n > rows / 2);
            }
            budget.add(&row(waiting));
        }
        (budget, dropped_late)
    }

    #[test]
    fn stages_that_keep_up_look_for_all_features() {
        let (budget, dropped) = overload(10.0, 30.0, 50.0, 1000);
        assert_eq!((budget.share(), dropped), (1.0, 0));
    }

    #[test]
    fn features_are_trimmed_until_no_pair_is_dropped() {
        let (budget, dropped) = overload(10.0, 60.0, 50.0, 1000);
        assert!(budget.share() < 0.75, "{}", budget.share());
        assert!(dropped <= 10, "{dropped} of 500");
    }

    #[test]
    fn the_share_has_a_least_and_recovers() {
        let mut budget = FrameBudget::new(Duration::from_secs(1), true);
        for _ in 0..100 {
            budget.add(&row(2));
        }
        assert_eq!(budget.share(), LEAST_SHARE);
        for _ in 0..CALM_ROWS * 20 {
            budget.add(&row(0));
        }
        assert_eq!(budget.share(), 1.0);
    }

    #[test]
    fn without_leave_nothing_is_trimmed() {
        let mut budget = FrameBudget::new(Duration::from_secs(1), false);
        for _ in 0..100 {
            assert_eq!(budget.add(&row(2)), None);
        }
        assert_eq!(budget.share(), 1.0);
    }

    #[test]
    fn overruns_are_counted_by_deadline_and_by_period() {
        let mut budget = FrameBudget::new(Duration::from_millis(100), true);
        let late = Timing {
            total: Duration::from_millis(101),
            busy: Duration::from_millis(51),
            ..row(0)
        };
        budget.add(&row(0));
        budget.add(&late);
        assert_eq!((budget.overruns(), budget.over_period()), (1, 1));
        let unknown = Timing {
            period: Duration::ZERO,
            ..late
        };
        budget.add(&unknown);
        assert_eq!((budget.overruns(), budget.over_period()), (2, 1));
    }
}
