//! Events that wait for the stages: of pairs only so many.

use crate::capture::{PairEvent, StereoPair};
use std::collections::VecDeque;

/// Which pair is dropped when the queue is full.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Overflow {
    /// The one that waited longest: the stages want what is fresh.
    Oldest,
    /// The one that comes: a recording wants no holes where it need not have any.
    Newest,
}

/// How pairs are handed on.
#[derive(Clone, Copy, Debug)]
pub struct Delivery {
    /// Pairs that may wait.
    pub queue: usize,
    /// Which one goes when there are more.
    pub overflow: Overflow,
    /// Whether the fate of every frame is written down.
    pub keeps_journal: bool,
}

/// The queue of a [`Delivery`].
#[derive(Debug)]
pub(super) struct Queue {
    events: VecDeque<PairEvent>,
    most_pairs: usize,
    overflow: Overflow,
}

impl Queue {
    pub(super) fn new(delivery: Delivery) -> Self {
        Self {
            events: VecDeque::new(),
            most_pairs: delivery.queue,
            overflow: delivery.overflow,
        }
    }

    /// Pairs that wait.
    pub(super) fn pairs(&self) -> usize {
        self.events.iter().filter(|event| is_pair(event)).count()
    }

    pub(super) fn pop(&mut self) -> Option<PairEvent> {
        self.events.pop_front()
    }

    /// Puts an event last; the pair that there is no room for comes back.
    pub(super) fn push(&mut self, event: PairEvent) -> Option<StereoPair> {
        // Of events without images in a row one is enough.
        if !is_pair(&event) {
            if self.events.back().is_some_and(|last| !is_pair(last)) {
                self.events.pop_back();
            }
            self.events.push_back(event);
            return None;
        }
        let dropped = if self.pairs() < self.most_pairs {
            self.events.push_back(event);
            None
        } else if self.overflow == Overflow::Newest {
            Some(event)
        } else {
            self.events.push_back(event);
            self.pop_oldest_pair()
        };
        match dropped {
            Some(PairEvent::Pair(pair)) => Some(pair),
            _ => None,
        }
    }
    /// Takes the oldest pair out. What stood before and behind it may now be events without images in a row.
    fn pop_oldest_pair(&mut self) -> Option<PairEvent> {
        let at = self.events.iter().position(is_pair)?;
        let pair = self.events.remove(at);
        if at > 0 && self.events.get(at).is_some_and(|next| !is_pair(next)) {
            self.events.remove(at - 1);
        }
        pair
    }
}

fn is_pair(event: &PairEvent) -> bool {
    matches!(event, PairEvent::Pair(_))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::{Skew, Unusable};
    use crate::image::GrayImage;
    use proptest::prelude::*;

    fn pair(sequence: u64) -> PairEvent {
        PairEvent::Pair(StereoPair {
            sequence,
            timestamp_ns: 0,
            skew: Skew::default(),
            left: GrayImage::default(),
            right: GrayImage::default(),
        })
    }

    fn none(sequence: u64) -> PairEvent {
        PairEvent::Unusable(Unusable {
            sequence,
            timestamp_ns: None,
            why: "silence".to_owned(),
        })
    }

    fn number(event: &PairEvent) -> u64 {
        match event {
            PairEvent::Pair(pair) => pair.sequence,
            PairEvent::Unusable(unusable) => unusable.sequence,
        }
    }

    /// What happens to a queue.
    #[derive(Clone, Copy, Debug)]
    enum Step {
        Pair,
        NoPair,
        Pop,
    }

    proptest! {
        /// Whatever the schedule of the cameras' side and the stages' side: no more pairs wait than may, each
        /// comes out once or is dropped once, in order, and the right one is dropped.
        #[test]
        fn every_pair_is_handed_on_or_dropped_once_under_any_schedule(
            steps in prop::collection::vec(
                prop_oneof![Just(Step::Pair), Just(Step::NoPair), Just(Step::Pop)],
                0..200,
            ),
            room in 1..5_usize,
            keeps_oldest in any::<bool>(),
        ) {
            let overflow = if keeps_oldest { Overflow::Newest } else { Overflow::Oldest };
            let mut queue = Queue::new(Delivery { queue: room, overflow, keeps_journal: false });
            let (mut handed_on, mut dropped, mut waiting) = (Vec::new(), Vec::new(), Vec::new());
            let mut next = 0;
            for step in steps {
                match step {
                    Step::Pop => {
                        let event = queue.pop();
                        if let Some(event) = &event
                            && is_pair(event)
                        {
                            prop_assert_eq!(number(event), waiting.remove(0));
                        }
                        handed_on.extend(event);
                    }
                    Step::NoPair => {
                        prop_assert!(queue.push(none(next)).is_none());
                        next += 1;
                    }
                    Step::Pair => {
                        let was_full = waiting.len() == room;
                        let out = queue.push(pair(next)).map(|pair| pair.sequence);
                        waiting.push(next);
                        let expected = was_full.then(|| match overflow {
                            Overflow::Oldest => waiting.remove(0),
                            Overflow::Newest => waiting.remove(room),
                        });
                        prop_assert_eq!(out, expected);
                        dropped.extend(out);
                        next += 1;
                    }
                }
                prop_assert!(queue.pairs() <= room);
                prop_assert_eq!(queue.pairs(), waiting.len());
                // Between two pairs stands one event at most that is none.
                prop_assert!(queue.events.len() <= 2 * queue.pairs() + 1);
            }
            handed_on.extend(std::iter::from_fn(|| queue.pop()));
            let numbers: Vec<u64> = handed_on.iter().map(number).collect();
            prop_assert!(numbers.windows(2).all(|two| two[0] < two[1]), "{numbers:?}");
            let on: Vec<u64> = handed_on.iter().filter(|e| is_pair(e)).map(number).collect();
            prop_assert!(dropped.iter().all(|n| !on.contains(n)));
        }
    }
}
