//! The fate of every frame, written down until somebody takes it.

use crate::capture::Side;
use crate::capture::camera::Loss;
use crate::capture::pairing::WhyUnmatched;
use std::collections::VecDeque;

/// Entries that are kept where nobody takes them.
const MOST_ENTRIES: usize = 100_000;

/// What became of one frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fate {
    /// It is in the pair of this number.
    Paired(u64),
    /// It was, but the pair was dropped because nobody took it in time.
    Dropped(u64),
    /// It has no partner.
    Unmatched(WhyUnmatched),
    /// It did not arrive, or not in one piece: that many frames.
    Lost(Loss, u64),
}

/// One line of the journal.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Entry {
    /// Whose frame.
    pub side: Side,
    /// The camera's own number; `None` for frames that never arrived.
    pub number: Option<u64>,
    /// The camera's own stamp, ns.
    pub stamp_ns: Option<i64>,
    /// The same in the host's CLOCK_MONOTONIC, ns.
    pub host_ns: Option<i64>,
    /// When the first of it arrived, CLOCK_MONOTONIC, ns.
    pub arrived_ns: Option<i64>,
    /// What became of it.
    pub fate: Fate,
}

/// Entries in the order in which fates were decided; none where none are wanted.
#[derive(Debug)]
pub(super) struct Journal {
    is_kept: bool,
    entries: VecDeque<Entry>,
}

impl Journal {
    pub(super) fn new(is_kept: bool) -> Self {
        Self {
            is_kept,
            entries: VecDeque::new(),
        }
    }

    pub(super) fn note(&mut self, entry: Entry) {
        if self.is_kept && self.entries.len() < MOST_ENTRIES {
            self.entries.push_back(entry);
        }
    }

    /// Notes a fate of frames whose number and stamps are not known, or not any more.
    pub(super) fn note_nameless(&mut self, side: Side, fate: Fate) {
        self.note(Entry {
            side,
            number: None,
            stamp_ns: None,
            host_ns: None,
            arrived_ns: None,
            fate,
        });
    }

    /// All entries since the last call.
    pub(super) fn take(&mut self) -> Vec<Entry> {
        std::mem::take(&mut self.entries).into()
    }
}
