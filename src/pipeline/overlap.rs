//! How many pairs are under way at once: how they come and are taken in, a number out.
//!
//! While stages overlap, the features of one pair are found while the method is at the pair before: more
//! pairs are handled, and each takes longer, for they share the processors. Where they come much faster
//! than even that can handle, some are dropped whatever is done. Then fewer are under way, down to one: of
//! what comes out each is as fresh as the processors can make it, and some more are dropped.

use std::time::Duration;

/// Pairs taken between two decisions.
const WINDOW: u32 = 16;
/// Pairs that come over those that are handled, from which on that is overload.
const OVERLOAD: f64 = 1.25;
/// Share of the time that the feeder waits for pairs under overload, at most: where it waits, missing ones
/// never came.
const MOST_IDLE: f64 = 0.1;
/// As many must be handled, over what is handled with all that may be under way.
const LEAST_HANDLED: f64 = 0.6;

/// Decides it.
#[derive(Clone, Debug)]
pub(super) struct Overlap {
    most: usize,
    now: usize,
    window: Option<Window>,
    /// Between two pairs with all that may be under way, s.
    interval_of_most_s: f64,
    /// Between two pairs now, over that; not known before the first window is over.
    slowdown: Option<f64>,
    /// With fewer too few would be handled.
    is_least: bool,
}

#[derive(Clone, Copy, Debug)]
struct Window {
    first_sequence: u64,
    began: Duration,
    taken: u32,
    idle: Duration,
}

impl Overlap {
    /// As many as may be, at first.
    pub(super) fn new(most: usize) -> Self {
        Self {
            most,
            now: most,
            window: None,
            interval_of_most_s: 0.0,
            slowdown: None,
            is_least: false,
        }
    }

    /// Pairs that may be under way, the next one among them: 1 or more.
    pub(super) fn under_way(&self) -> usize {
        self.now
    }

    /// Takes note of a pair that was taken `at` a time of the feeder's, which had `waited` for it; whether
    /// another number is under way from now on.
    pub(super) fn take(&mut self, sequence: u64, at: Duration, waited: Duration) -> bool {
        let Some(window) = &mut self.window else {
            self.window = Some(Window {
                first_sequence: sequence,
                began: at,
                taken: 0,
                idle: Duration::ZERO,
            });
            return false;
        };
        window.taken += 1;
        window.idle += waited;
        if window.taken < WINDOW {
            return false;
        }
        let window = *window;
        self.window = None;
        let before = self.now;
        self.decide(&window, sequence, at);
        self.now != before
    }

    fn decide(&mut self, window: &Window, sequence: u64, at: Duration) {
        let span_s = at.saturating_sub(window.began).as_secs_f64();
        let came = sequence.saturating_sub(window.first_sequence).max(1) as f64;
        let (comes_every_s, interval_s) = (span_s / came, span_s / f64::from(window.taken));
        let is_busy = window.idle.as_secs_f64() <= MOST_IDLE * span_s;
        if self.now == self.most {
            if self.most > 1 && is_busy && interval_s >= OVERLOAD * comes_every_s {
                self.interval_of_most_s = interval_s;
                self.step_to(self.most - 1);
                self.is_least = false;
            }
            return;
        }
        let slowdown = *self
            .slowdown
            .get_or_insert((interval_s / self.interval_of_most_s).max(1.0));
        // What a pair takes changes with what it shows.
        if comes_every_s * slowdown >= interval_s {
            self.step_to(self.most);
        } else if slowdown * LEAST_HANDLED > 1.0 {
            self.is_least = true;
            self.step_to(self.now + 1);
        } else if !self.is_least && self.now > 1 {
            self.step_to(self.now - 1);
        }
    }

    fn step_to(&mut self, under_way: usize) {
        self.now = under_way;
        self.slowdown = None;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Pairs that come every so many ms, of which the newest waits, while each interval between two that
    /// are taken depends on how many are under way; how many are under way after each pair.
    fn follow(
        overlap: &mut Overlap,
        comes_every_ms: f64,
        interval_ms: impl Fn(usize) -> f64,
        pairs: u32,
    ) -> Vec<usize> {
        let (mut at_ms, mut last) = (0.0_f64, 0);
        let mut under_way = Vec::new();
        for _ in 0..pairs {
            let free_ms = at_ms + interval_ms(overlap.under_way());
            let newest = (free_ms / comes_every_ms).floor() as u64;
            let sequence = newest.max(last + 1);
            let taken_ms = free_ms.max(sequence as f64 * comes_every_ms);
            overlap.take(
                sequence,
                Duration::from_secs_f64(1e-3 * taken_ms),
                Duration::from_secs_f64(1e-3 * (taken_ms - free_ms)),
            );
            (at_ms, last) = (taken_ms, sequence);
            under_way.push(overlap.under_way());
        }
        under_way
    }

    /// Two processors: features alone take 8 ms with both, the method 4 ms with one.
    fn two_processors(under_way: usize) -> f64 {
        if under_way > 1 { 10.0 } else { 12.0 }
    }

    #[test]
    fn stages_that_keep_up_overlap() {
        for comes_every_ms in [10.5, 11.0, 25.0] {
            let mut overlap = Overlap::new(2);
            let under_way = follow(&mut overlap, comes_every_ms, two_processors, 500);
            assert!(under_way.iter().all(|n| *n == 2), "{comes_every_ms}");
        }
    }

    #[test]
    fn under_overload_one_pair_is_handled_after_the_other_and_stages_overlap_again_after_it() {
        let mut overlap = Overlap::new(2);
        let under_way = follow(&mut overlap, 5.0, two_processors, 500);
        assert!(under_way[40..].iter().all(|n| *n == 1));
        // They could not be handled one after the other, but can be with stages that overlap.
        let mut after = overlap.clone();
        let under_way = follow(&mut after, 11.0, two_processors, 200);
        assert!(under_way[70..].iter().all(|n| *n == 2), "{under_way:?}");
        let under_way = follow(&mut overlap, 50.0, two_processors, 200);
        assert!(under_way[70..].iter().all(|n| *n == 2), "{under_way:?}");
    }

    #[test]
    fn cameras_that_lose_frames_are_no_overload() {
        let mut overlap = Overlap::new(2);
        for n in 0..500 {
            let at = Duration::from_millis(75 * n);
            overlap.take(3 * n, at, Duration::from_millis(60));
            assert_eq!(overlap.under_way(), 2);
        }
    }

    #[test]
    fn on_many_processors_as_many_are_under_way_as_it_takes() {
        // The method takes 8 ms, features 40 ms of one processor each.
        let many = |under_way: usize| (48.0 / under_way as f64).max(8.0);
        let mut overlap = Overlap::new(5);
        let under_way = follow(&mut overlap, 4.0, many, 500);
        // With four 12.0 ms for 9.6 ms, with three 16.0 ms, with two 24.0 ms.
        assert!(under_way[140..].iter().all(|n| *n == 3), "{under_way:?}");
    }

    #[test]
    fn a_single_pair_is_the_least() {
        let mut overlap = Overlap::new(1);
        assert!(
            follow(&mut overlap, 5.0, |_| 20.0, 200)
                .iter()
                .all(|n| *n == 1)
        );
    }
}
