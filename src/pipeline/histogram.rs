//! A histogram of durations: any number of them in, quantiles to half a percent out, in fixed memory.

use std::time::Duration;

/// The upper end of the first bin.
const FIRST: Duration = Duration::from_micros(1);
/// Bins to a doubling of the time: neighbours are 0.9 % apart.
const BINS_A_DOUBLING: f64 = 80.0;
/// Bins up to 2³⁰ µs, a quarter of an hour; the last holds what took longer.
const BINS: usize = 30 * BINS_A_DOUBLING as usize + 2;

/// Counts durations by length, in bins that grow with the length.
#[derive(Clone, Debug)]
pub(super) struct Histogram {
    counts: Box<[u64]>,
    total: u64,
    greatest: Duration,
}

impl Default for Histogram {
    fn default() -> Self {
        Self {
            counts: vec![0; BINS].into_boxed_slice(),
            total: 0,
            greatest: Duration::ZERO,
        }
    }
}

impl Histogram {
    /// Takes note of a duration.
    pub(super) fn add(&mut self, time: Duration) {
        let doublings = (time.as_secs_f64() / FIRST.as_secs_f64()).log2().max(0.0);
        // Rounded up: a bin holds what is at most its end.
        let bin = ((doublings * BINS_A_DOUBLING).ceil() as usize).min(BINS - 1);
        self.counts[bin] += 1;
        self.total += 1;
        self.greatest = self.greatest.max(time);
    }

    /// The time that `share` of the durations do not exceed, to 0.5 %; zero where there is none.
    pub(super) fn quantile(&self, share: f64) -> Duration {
        let wanted = ((share * self.total as f64).ceil() as u64).max(1);
        let mut seen = 0;
        let bin = self.counts.iter().position(|count| {
            seen += count;
            seen >= wanted
        });
        bin.map_or(Duration::ZERO, |bin| {
            let middle = (bin as f64 - 0.5).max(0.0) / BINS_A_DOUBLING;
            FIRST.mul_f64(middle.exp2()).min(self.greatest)
        })
    }

    /// The longest duration; zero where there is none.
    pub(super) fn greatest(&self) -> Duration {
        self.greatest
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn quantiles_are_those_of_the_sorted_durations(
            mut times_us in prop::collection::vec(1.0..1e8_f64, 1..300), share in 0.01..1.0_f64,
        ) {
            let mut histogram = Histogram::default();
            for &us in &times_us {
                histogram.add(Duration::from_secs_f64(us * 1e-6));
            }
            times_us.sort_by(f64::total_cmp);
            let at = (share * times_us.len() as f64).ceil() as usize - 1;
            let found_us = histogram.quantile(share).as_secs_f64() * 1e6;
            // Half a bin, and the nanosecond to which a duration is rounded.
            let tolerance_us = 0.005 * times_us[at] + 0.002;
            prop_assert!((found_us - times_us[at]).abs() < tolerance_us, "{} {}", found_us, times_us[at]);
            let greatest_us = histogram.greatest().as_secs_f64() * 1e6;
            prop_assert!((greatest_us - times_us[times_us.len() - 1]).abs() < 0.002);
        }
    }

    #[test]
    fn nothing_and_extremes_are_no_trouble() {
        let mut histogram = Histogram::default();
        assert_eq!(histogram.quantile(0.5), Duration::ZERO);
        assert_eq!(histogram.greatest(), Duration::ZERO);
        histogram.add(Duration::ZERO);
        assert_eq!(histogram.quantile(0.99), Duration::ZERO);
        histogram.add(Duration::from_secs(1 << 20));
        assert_eq!(histogram.greatest(), Duration::from_secs(1 << 20));
        assert!(histogram.quantile(0.99) >= Duration::from_secs(1000));
    }
}
