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
            let oldest = self.events.iter().position(is_pair);
            oldest.and_then(|at| self.events.remove(at))
        };
        match dropped {
            Some(PairEvent::Pair(pair)) => Some(pair),
            _ => None,
        }
    }
}

fn is_pair(event: &PairEvent) -> bool {
    matches!(event, PairEvent::Pair(_))
}
