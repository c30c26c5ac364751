//! A source in; the same events out, no sooner than their stamps say.

use super::{PairEvent, PairSource, StereoPair};
use std::time::{Duration, Instant};

/// Releases a recording's events at the rate at which they were taken.
///
/// The first goes at once. None is dropped: a consumer that falls behind gets the ones that are due
/// without a wait, until it has caught up.
#[derive(Debug)]
pub struct Realtime<S> {
    source: S,
    start: Option<Start>,
}

/// When the first stamped event went, by both clocks.
#[derive(Clone, Copy, Debug)]
struct Start {
    instant: Instant,
    timestamp_ns: i64,
}

impl Start {
    /// How long after `now` an event of `timestamp_ns` is due.
    fn wait(&self, timestamp_ns: i64, now: Instant) -> Duration {
        let since_first_ns = timestamp_ns.saturating_sub(self.timestamp_ns);
        let since_first = Duration::from_nanos(u64::try_from(since_first_ns).unwrap_or(0));
        since_first.saturating_sub(now.saturating_duration_since(self.instant))
    }
}

impl<S: PairSource> Realtime<S> {
    /// Paces `source`; its clock starts with the first event that is asked for.
    pub fn new(source: S) -> Self {
        Self {
            source,
            start: None,
        }
    }
}

impl<S: PairSource> PairSource for Realtime<S> {
    fn next_event(&mut self) -> Option<PairEvent> {
        let event = self.source.next_event()?;
        if let Some(timestamp_ns) = event.timestamp_ns() {
            let now = Instant::now();
            let start = *self.start.get_or_insert(Start {
                instant: now,
                timestamp_ns,
            });
            std::thread::sleep(start.wait(timestamp_ns, now));
        }
        Some(event)
    }

    fn len_hint(&self) -> Option<u64> {
        self.source.len_hint()
    }

    fn make_room(&mut self, pairs_held: usize) {
        self.source.make_room(pairs_held);
    }

    fn recycle(&mut self, pair: StereoPair) {
        self.source.recycle(pair);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const START_NS: i64 = 1_403_715_273_262_142_976;

    fn start() -> Start {
        Start {
            instant: Instant::now(),
            timestamp_ns: START_NS,
        }
    }

    #[test]
    fn an_event_waits_for_what_is_left_of_its_time() {
        let start = start();
        let later = start.instant + Duration::from_millis(30);
        let wait = start.wait(START_NS + 50_000_000, later);
        assert_eq!(wait, Duration::from_millis(20));
    }

    #[test]
    fn what_is_due_already_or_stamped_before_the_first_does_not_wait() {
        let start = start();
        let later = start.instant + Duration::from_millis(80);
        assert_eq!(start.wait(START_NS + 50_000_000, later), Duration::ZERO);
        assert_eq!(start.wait(START_NS - 1, start.instant), Duration::ZERO);
        assert_eq!(start.wait(i64::MIN, start.instant), Duration::ZERO);
    }
}
