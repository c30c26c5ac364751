use super::*;
use crate::capture::clock::ClockMap;
use proptest::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, Exp1};
use rand_xoshiro::Xoshiro256PlusPlus;

const MS: i64 = 1_000_000;
const PERIOD_NS: i64 = 50 * MS;

fn frame(number: u64, stamp_ns: i64) -> Candidate<u64> {
    Candidate {
        number,
        stamp_ns,
        sigma_ns: 1_000.0,
        item: number,
    }
}

fn outcomes(pairer: &mut Pairer<u64>) -> Vec<Paired<u64>> {
    std::iter::from_fn(|| pairer.pop()).collect()
}

/// A frame that stays alone: its side, its item and why.
type Alone = (Side, u64, &'static str);

/// The items of pairs, and the sides and items of frames that stay alone.
fn summary(outcomes: &[Paired<u64>]) -> (Vec<(u64, u64)>, Vec<Alone>) {
    let (mut pairs, mut alone) = (Vec::new(), Vec::new());
    for outcome in outcomes {
        match outcome {
            Paired::Pair { left, right, .. } => pairs.push((left.item, right.item)),
            Paired::Unmatched { side, frame, why } => {
                alone.push((*side, frame.item, why.as_str()));
            }
        }
    }
    (pairs, alone)
}

#[test]
fn a_missing_frame_leaves_its_partner_alone_with_a_reason() {
    let mut pairer = Pairer::new(PairBy::Stamp, 5 * MS);
    for n in 0..6 {
        let at = n as i64 * PERIOD_NS;
        if n != 2 {
            pairer.push(Side::Left, frame(n, at));
        }
        if n != 4 {
            pairer.push(Side::Right, frame(100 + n, at + MS));
        }
    }
    let all = outcomes(&mut pairer);
    let (pairs, alone) = summary(&all);
    assert_eq!(pairs, [(0, 100), (1, 101), (3, 103), (5, 105)]);
    assert_eq!(
        alone,
        [(Side::Right, 102, "too_far"), (Side::Left, 4, "too_far")]
    );
    let Paired::Pair { skew, .. } = &all[0] else {
        panic!("a pair");
    };
    assert_eq!(skew.ns, MS);
    assert!((skew.sigma_ns - 1_414.2).abs() < 0.1);
}

#[test]
fn what_lies_beyond_the_tolerance_is_alone_and_told_how_far() {
    let mut pairer = Pairer::new(PairBy::Stamp, 5 * MS);
    pairer.push(Side::Left, frame(0, 0));
    pairer.push(Side::Right, frame(1, 6 * MS));
    pairer.push(Side::Left, frame(2, 20 * MS));
    let all = outcomes(&mut pairer);
    assert_eq!(all.len(), 2);
    let whys: Vec<String> = all
        .iter()
        .map(|o| match o {
            Paired::Unmatched { why, .. } => why.to_string(),
            Paired::Pair { .. } => panic!("no pair"),
        })
        .collect();
    assert_eq!(whys[0], "the other camera's nearest is 6.000 ms away");
    assert_eq!(whys[1], "the other camera's nearest is 14.000 ms away");
}

#[test]
fn a_silent_camera_does_not_hold_the_other_up() {
    let mut pairer = Pairer::new(PairBy::Stamp, 5 * MS);
    for n in 0..20 {
        pairer.push(Side::Right, frame(n, n as i64 * PERIOD_NS));
    }
    let (pairs, alone) = summary(&outcomes(&mut pairer));
    assert!(pairs.is_empty());
    assert_eq!(alone.len(), 20 - MAX_WAITING);
    assert!(alone.iter().all(|(_, _, why)| *why == "other_silent"));
}

#[test]
fn the_wide_gate_of_uncertain_stamps_never_reaches_a_neighbour() {
    let mut pairer = Pairer::new(PairBy::Stamp, 5 * MS);
    for n in 0..40 {
        let at = n as i64 * PERIOD_NS;
        let mut left = frame(n, at);
        left.sigma_ns = 1e9;
        pairer.push(Side::Left, left);
        // The right camera lacks every frame but the first ten: never one of another instant.
        if n < 10 {
            pairer.push(Side::Right, frame(n, at + 2 * MS));
        }
    }
    let (pairs, _) = summary(&outcomes(&mut pairer));
    assert_eq!(pairs.len(), 10);
    assert!(pairs.iter().all(|(left, right)| left == right));
}

#[test]
fn by_trigger_the_numbers_pair_what_the_stamps_would_not() {
    let mut pairer = Pairer::new(PairBy::Trigger, 2 * MS);
    let mut rng = Xoshiro256PlusPlus::seed_from_u64(1);
    for n in 0..200_u64 {
        let at = n as i64 * PERIOD_NS;
        // After the first few, stamps jitter by up to 20 ms.
        let jitter = if n < 5 {
            0
        } else {
            rng.random_range(0..20 * MS)
        };
        if n % 17 != 3 {
            pairer.push(Side::Left, frame(n, at));
        }
        if n % 23 != 7 {
            pairer.push(Side::Right, frame(n + 5000, at + jitter));
        }
    }
    assert_eq!(pairer.number_difference(), Some(5000));
    let all = outcomes(&mut pairer);
    let (pairs, alone) = summary(&all);
    assert!(pairs.iter().all(|(left, right)| left + 5000 == *right));
    let expected = (0..200).filter(|n| n % 17 != 3 && n % 23 != 7).count();
    assert_eq!(pairs.len(), expected);
    assert!(alone.len() >= 18);
}

#[test]
fn a_camera_that_lost_count_is_found_again_by_its_stamps() {
    let mut pairer = Pairer::new(PairBy::Trigger, 2 * MS);
    for n in 0..40_u64 {
        let at = n as i64 * PERIOD_NS;
        let counted = if n < 20 { n } else { n + 1 };
        pairer.push(Side::Left, frame(n, at));
        pairer.push(
            Side::Right,
            Candidate {
                item: n,
                ..frame(counted, at)
            },
        );
    }
    let (pairs, _) = summary(&outcomes(&mut pairer));
    let wrong = pairs.iter().filter(|(left, right)| left != right).count();
    assert!(wrong <= PAIRS_TO_LEARN as usize, "{wrong} wrong pairs");
    assert_eq!(pairer.number_difference(), Some(1));
    assert_eq!(pairs.last(), Some(&(39, 39)));
}

#[test]
fn nothing_of_a_reopened_camera_is_paired_with_what_waited() {
    let mut pairer = Pairer::new(PairBy::Stamp, 5 * MS);
    pairer.push(Side::Left, frame(0, 0));
    pairer.reopen(Side::Left);
    pairer.push(Side::Right, frame(1, 0));
    pairer.push(Side::Left, frame(2, PERIOD_NS));
    pairer.push(Side::Right, frame(3, PERIOD_NS));
    let (pairs, alone) = summary(&outcomes(&mut pairer));
    assert_eq!(pairs, [(2, 3)]);
    assert_eq!(
        alone,
        [(Side::Left, 0, "reopened"), (Side::Right, 1, "too_far")]
    );
}

/// Two cameras triggered together, whose clocks differ by 3 ms and 50 ppm and whose frames arrive up
/// to many milliseconds late: each frame finds its own partner.
#[test]
fn clocks_that_drift_apart_do_not_part_pairs() {
    for seed in 0..10 {
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
        let mut clocks = [ClockMap::new(), ClockMap::new()];
        let mut pairer = Pairer::new(PairBy::Stamp, 5 * MS);
        for n in 0..2400_i64 {
            let taken_ns = 77_000 * MS + n * PERIOD_NS;
            let camera_ns = [
                n * PERIOD_NS,
                n * PERIOD_NS + 3 * MS + n * PERIOD_NS / 20_000,
            ];
            for (side, at) in [(Side::Left, 0), (Side::Right, 1)] {
                let held_up: f64 = Distribution::<f64>::sample(&Exp1, &mut rng) * 1.5e6;
                let arrived_ns = taken_ns + MS + held_up as i64;
                let mapped = clocks[at].map(camera_ns[at], arrived_ns);
                assert_eq!(mapped.event, None);
                pairer.push(
                    side,
                    Candidate {
                        number: n as u64,
                        stamp_ns: mapped.host_ns,
                        sigma_ns: mapped.sigma_ns,
                        item: n as u64,
                    },
                );
            }
        }
        let all = outcomes(&mut pairer);
        let (pairs, alone) = summary(&all);
        assert_eq!(alone, []);
        assert_eq!(pairs.len(), 2400);
        assert!(pairs.iter().all(|(left, right)| left == right));
        for outcome in &all[20..] {
            let Paired::Pair { skew, .. } = outcome else {
                continue;
            };
            assert!(
                (skew.ns as f64).abs() < 4.5 * skew.sigma_ns,
                "they were taken together, but {skew:?}"
            );
        }
    }
}

proptest! {
    /// Whatever comes, each frame has one fate, pairs rise, and no pair is wider than the gate.
    #[test]
    fn every_frame_has_exactly_one_fate(
        frames in prop::collection::vec((any::<bool>(), 0_i64..80_000_000), 1..200),
        by_trigger in any::<bool>(),
    ) {
        let by = if by_trigger { PairBy::Trigger } else { PairBy::Stamp };
        let mut pairer = Pairer::new(by, 5 * MS);
        let mut at_ns = [0_i64; 2];
        let mut all = Vec::new();
        for (n, (right, ahead_ns)) in frames.iter().enumerate() {
            let side = if *right { Side::Right } else { Side::Left };
            at_ns[side as usize] += ahead_ns + 1;
            pairer.push(side, frame(n as u64, at_ns[side as usize]));
            all.extend(outcomes(&mut pairer));
        }
        pairer.reopen(Side::Left);
        pairer.reopen(Side::Right);
        all.extend(outcomes(&mut pairer));
        let (pairs, alone) = summary(&all);
        let mut seen: Vec<u64> = pairs.iter().flat_map(|(l, r)| [*l, *r]).collect();
        seen.extend(alone.iter().map(|(_, item, _)| *item));
        seen.sort_unstable();
        prop_assert_eq!(seen, (0..frames.len() as u64).collect::<Vec<_>>());
        prop_assert!(pairs.windows(2).all(|w| w[0].0 < w[1].0 && w[0].1 < w[1].1));
        if !by_trigger {
            for outcome in &all {
                if let Paired::Pair { skew, .. } = outcome {
                    prop_assert!((skew.ns.abs() as f64) <= 5.0e6 + 3.0 * skew.sigma_ns);
                }
            }
        }
    }

    /// Two cameras that expose together and lose frames: whatever the order in which their frames come, as long
    /// as neither runs far ahead, the pairs are those of the frames that both have.
    #[test]
    fn the_interleaving_of_two_cameras_makes_no_difference(
        kept in prop::collection::vec(any::<[bool; 2]>(), 1..80),
        jitter_ns in prop::collection::vec(-MS..MS, 80),
        turns in prop::collection::vec(any::<bool>(), 160),
    ) {
        const LEAD: usize = MAX_WAITING - 2;
        let frames = [0, 1].map(|side| {
            let is_kept = |n: &usize| kept[*n][side];
            (0..kept.len()).filter(is_kept).collect::<Vec<_>>()
        });
        let stamp_ns = |side: usize, n: usize| {
            n as i64 * PERIOD_NS + if side == 1 { jitter_ns[n] } else { 0 }
        };
        let mut pairer = Pairer::new(PairBy::Stamp, 5 * MS);
        let mut next = [0, 0];
        let mut all = Vec::new();
        let mut turns = turns.iter().cycle();
        while next != [frames[0].len(), frames[1].len()] {
            // The numbers of the frames that come next; one that has none left is not waited for.
            let at = [0, 1].map(|side: usize| frames[side].get(next[side]).copied().unwrap_or(usize::MAX));
            let is_right = usize::from(turns.next() == Some(&true));
            let other = 1 - is_right;
            let runs_ahead = at[is_right] == usize::MAX || at[is_right] > at[other].saturating_add(LEAD);
            let side = if runs_ahead { other } else { is_right };
            let n = at[side];
            pairer.push([Side::Left, Side::Right][side], frame(n as u64, stamp_ns(side, n)));
            next[side] += 1;
            all.extend(outcomes(&mut pairer));
        }
        pairer.reopen(Side::Left);
        pairer.reopen(Side::Right);
        all.extend(outcomes(&mut pairer));
        let (pairs, _) = summary(&all);
        let both = (0..kept.len()).filter(|n| kept[*n] == [true; 2]).map(|n| (n as u64, n as u64));
        prop_assert_eq!(pairs, both.collect::<Vec<_>>());
    }
}
