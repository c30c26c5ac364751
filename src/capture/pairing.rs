//! Frames of two cameras in, stamped in one clock; pairs out, and a reason for each frame without a
//! partner.
//!
//! By nearest stamp, or by trigger index: cameras that one pulse triggers count the same pulses, so
//! that the difference of their numbers is constant; stamps only have to find it once.

use super::Side;
use std::collections::VecDeque;

/// How partners are found.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Deserialize, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum PairBy {
    /// By the nearest stamp.
    #[default]
    Stamp,
    /// By the cameras' count of triggers.
    Trigger,
}

/// How far apart in time the two images of a pair were taken.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Skew {
    /// The right image's time less the left one's, ns.
    pub ns: i64,
    /// 1 σ of that, ns.
    pub sigma_ns: f64,
}

/// A frame that looks for a partner.
#[derive(Clone, Debug, PartialEq)]
pub struct Candidate<T> {
    /// The camera's own number of it.
    pub number: u64,
    /// When it was taken, in a clock that both sides share, ns.
    pub stamp_ns: i64,
    /// 1 σ of that, ns.
    pub sigma_ns: f64,
    /// Whatever goes with it.
    pub item: T,
}

/// Why a frame has no partner.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WhyUnmatched {
    /// The other camera's frames lie too far from it in time.
    TooFar {
        /// The nearest, other less own, ns.
        nearest_ns: i64,
    },
    /// The other camera missed the trigger.
    NoSuchTrigger,
    /// The other camera was silent for as long as the frame could wait.
    OtherSilent,
    /// One of the cameras was opened anew while it waited.
    Reopened,
}

impl WhyUnmatched {
    /// The words for tables, in the order in which [`Unmatched`] counts.
    const WORDS: [&str; 4] = ["too_far", "no_such_trigger", "other_silent", "reopened"];

    /// A word for tables.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        Self::WORDS[self.place()]
    }

    fn place(&self) -> usize {
        match self {
            Self::TooFar { .. } => 0,
            Self::NoSuchTrigger => 1,
            Self::OtherSilent => 2,
            Self::Reopened => 3,
        }
    }
}

/// Frames without a partner, counted by reason.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Unmatched([u64; WhyUnmatched::WORDS.len()]);

impl Unmatched {
    /// Counts one.
    pub fn add(&mut self, why: &WhyUnmatched) {
        self.0[why.place()] += 1;
    }

    /// How many there are.
    #[must_use]
    pub fn total(&self) -> u64 {
        self.0.iter().sum()
    }

    /// Each reason, in a word, with its count.
    pub fn iter(&self) -> impl Iterator<Item = (&'static str, u64)> + '_ {
        WhyUnmatched::WORDS.into_iter().zip(self.0)
    }
}

impl std::fmt::Display for WhyUnmatched {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::TooFar { nearest_ns } => write!(
                f,
                "the other camera's nearest is {:.3} ms away",
                *nearest_ns as f64 * 1e-6
            ),
            Self::NoSuchTrigger => f.write_str("the other camera has none of the same trigger"),
            Self::OtherSilent => f.write_str("the other camera is silent"),
            Self::Reopened => f.write_str("a camera was opened anew"),
        }
    }
}

/// What became of one frame, or of two.
#[derive(Clone, Debug, PartialEq)]
pub enum Paired<T> {
    /// Two frames of one instant.
    Pair {
        /// The left camera's.
        left: Candidate<T>,
        /// The right camera's.
        right: Candidate<T>,
        /// How far apart they were taken.
        skew: Skew,
    },
    /// A frame that stays alone.
    Unmatched {
        /// Whose it is.
        side: Side,
        /// The frame.
        frame: Candidate<T>,
        /// Why it stays alone.
        why: WhyUnmatched,
    },
}

/// Frames a side that wait for a partner before they are given up.
pub(super) const MAX_WAITING: usize = 8;
/// Pairs by stamp in a row whose numbers differ by the same before that difference is relied upon.
const PAIRS_TO_LEARN: u32 = 3;
/// 1 σ of the time between the exposures that one pulse triggers, ns.
const SIGMA_TRIGGER_NS: f64 = 1_000.0;
/// The gate may widen to this share of a period, beyond which a neighbour would be nearer.
const MAX_GATE_PERIODS: f64 = 0.45;

/// Pairs the frames of two cameras.
#[derive(Debug)]
pub struct Pairer<T> {
    by: PairBy,
    tolerance_ns: i64,
    waiting: [VecDeque<Candidate<T>>; 2],
    spacing: [Spacing; 2],
    numbers: Numbers,
    out: VecDeque<Paired<T>>,
}

impl<T> Pairer<T> {
    /// A pairer; frames that lie no more than `tolerance_ns`, and three σ of their stamps, apart are
    /// partners.
    #[must_use]
    pub fn new(by: PairBy, tolerance_ns: i64) -> Self {
        Self {
            by,
            tolerance_ns,
            waiting: [VecDeque::new(), VecDeque::new()],
            spacing: Default::default(),
            numbers: Numbers::default(),
            out: VecDeque::new(),
        }
    }

    /// Takes a frame; stamps of a side rise.
    pub fn push(&mut self, side: Side, frame: Candidate<T>) {
        self.spacing[side as usize].add(frame.stamp_ns);
        self.waiting[side as usize].push_back(frame);
        self.settle();
        while self.waiting[side as usize].len() > MAX_WAITING {
            self.give_up(side, WhyUnmatched::OtherSilent);
        }
    }

    /// The next outcome, in order.
    pub fn pop(&mut self) -> Option<Paired<T>> {
        self.out.pop_front()
    }

    /// A camera was opened anew: nothing of it may be paired with what waits, and its count of
    /// triggers began anew.
    pub fn reopen(&mut self, side: Side) {
        while !self.waiting[side as usize].is_empty() {
            self.give_up(side, WhyUnmatched::Reopened);
        }
        self.spacing[side as usize] = Spacing::default();
        self.numbers = Numbers::default();
    }

    /// The difference of the numbers, right less left, once it is known.
    #[must_use]
    pub fn number_difference(&self) -> Option<i64> {
        self.numbers.known()
    }

    /// Gives up the oldest frame of a side.
    fn give_up(&mut self, side: Side, why: WhyUnmatched) {
        if let Some(frame) = self.waiting[side as usize].pop_front() {
            self.out.push_back(Paired::Unmatched { side, frame, why });
        }
    }

    /// Decides all that can be decided.
    fn settle(&mut self) {
        while let [Some(left), Some(right)] = [self.waiting[0].front(), self.waiting[1].front()] {
            let skew = Skew {
                ns: right.stamp_ns - left.stamp_ns,
                sigma_ns: left.sigma_ns.hypot(right.sigma_ns),
            };
            let ahead = right.number.wrapping_sub(left.number) as i64;
            match (self.by, self.numbers.known()) {
                (PairBy::Trigger, Some(expected)) => self.settle_by_number(skew, ahead - expected),
                _ => self.settle_by_stamp(skew, ahead),
            }
        }
    }

    fn settle_by_stamp(&mut self, skew: Skew, ahead: i64) {
        if skew.ns.abs() as f64 <= self.gate_ns(&skew) {
            self.numbers.learn(ahead);
            self.pair(skew);
        } else {
            let nearest_ns = |sign: i64| WhyUnmatched::TooFar {
                nearest_ns: sign * skew.ns,
            };
            if skew.ns > 0 {
                self.give_up(Side::Left, nearest_ns(1));
            } else {
                self.give_up(Side::Right, nearest_ns(-1));
            }
        }
    }

    fn settle_by_number(&mut self, skew: Skew, ahead: i64) {
        match ahead {
            0 => {
                // Stamps that contradict the numbers time and again: a camera has lost count.
                let far = skew.ns.abs() as f64 > self.doubt_ns(&skew);
                self.numbers.confirm(!far);
                let together = Skew {
                    ns: 0,
                    sigma_ns: SIGMA_TRIGGER_NS,
                };
                self.pair(if far { skew } else { together });
            }
            1.. => self.give_up(Side::Left, WhyUnmatched::NoSuchTrigger),
            _ => self.give_up(Side::Right, WhyUnmatched::NoSuchTrigger),
        }
    }

    fn pair(&mut self, skew: Skew) {
        let [left, right] = [0, 1].map(|side| self.waiting[side].pop_front());
        if let (Some(left), Some(right)) = (left, right) {
            self.out.push_back(Paired::Pair { left, right, skew });
        }
    }

    /// How far apart stamps of the same trigger may lie before the numbers are doubted, ns.
    fn doubt_ns(&self, skew: &Skew) -> f64 {
        let periods = self.spacing.iter().filter_map(Spacing::usual_ns);
        let half = periods.map(|period| 0.5 * period as f64).reduce(f64::min);
        half.unwrap_or_else(|| self.gate_ns(skew))
    }

    /// How far apart partners may lie, ns.
    fn gate_ns(&self, skew: &Skew) -> f64 {
        let gate = self.tolerance_ns as f64 + 3.0 * skew.sigma_ns;
        let periods = self.spacing.iter().filter_map(Spacing::usual_ns);
        periods.fold(gate, |gate, period| {
            gate.min(MAX_GATE_PERIODS * period as f64)
        })
    }
}

/// The usual time between a side's last frames.
#[derive(Debug, Default)]
struct Spacing {
    last_ns: Option<i64>,
    spacings_ns: VecDeque<i64>,
}

impl Spacing {
    fn add(&mut self, stamp_ns: i64) {
        if let Some(last_ns) = self.last_ns.replace(stamp_ns) {
            self.spacings_ns.push_back((stamp_ns - last_ns).max(0));
            if self.spacings_ns.len() > 16 {
                self.spacings_ns.pop_front();
            }
        }
    }

    /// The median: a single stamp that is off must not narrow the gate.
    fn usual_ns(&self) -> Option<i64> {
        if self.spacings_ns.len() < 4 {
            return None;
        }
        let mut sorted: Vec<i64> = self.spacings_ns.iter().copied().collect();
        sorted.sort_unstable();
        sorted.get(sorted.len() / 2).copied()
    }
}

/// The constant difference of two cameras' trigger counts.
#[derive(Debug, Default)]
struct Numbers {
    difference: i64,
    times: u32,
    doubts: u32,
}

impl Numbers {
    fn known(&self) -> Option<i64> {
        (self.times >= PAIRS_TO_LEARN).then_some(self.difference)
    }

    fn learn(&mut self, difference: i64) {
        if self.times > 0 && self.difference == difference {
            self.times += 1;
        } else {
            *self = Self {
                difference,
                times: 1,
                doubts: 0,
            };
        }
    }

    fn confirm(&mut self, fits: bool) {
        self.doubts = if fits { 0 } else { self.doubts + 1 };
        if self.doubts >= PAIRS_TO_LEARN {
            *self = Self::default();
        }
    }
}

#[cfg(test)]
#[path = "pairing_tests.rs"]
mod tests;
