//! Draw: candidates in, the keypoints at those that the even spread may keep, out.
//!
//! [`Spread`](super::spread::Spread) takes the strongest keypoints of every cell, in turns. To confirm
//! a candidate costs more than to find it, and many are never taken: so every cell has its candidates
//! confirmed from the strongest on, one a turn, until what was confirmed fills the budget. What is
//! left then would have come in a later turn, so that the spread keeps the same as of all.

use super::extrema::Candidate;
use super::spread::Grid;
use super::{Keypoint, make_room};

/// Candidates of a cell that are sorted at a time.
const SORTED_AT_ONCE: usize = 8;

/// The candidate's keypoint may lie in one of several cells.
const UNDECIDED: u32 = u32::MAX;

/// The working memory of [`Draw::confirm`].
#[derive(Debug, Default)]
pub(super) struct Draw {
    /// The cell of each candidate.
    cell_of: Vec<u32>,
    /// The candidates whose cell is decided, cell by cell.
    by_cell: Vec<Lot>,
    cells: Vec<Cell>,
}

/// A candidate by its number, with its response.
#[derive(Clone, Copy, Debug, Default)]
struct Lot {
    response: f32,
    number: u32,
}

/// The candidates of one cell.
#[derive(Clone, Copy, Debug, Default)]
struct Cell {
    /// Where those that have not been drawn start and end in `by_cell`.
    next: usize,
    end: usize,
    /// Those before this one are sorted.
    sorted: usize,
    /// How many of those that were drawn are keypoints, and the response of the last of them.
    confirmed: usize,
    weakest: f32,
    /// Keypoints in this cell, those of undecided candidates included.
    keypoints: usize,
}

impl Draw {
    /// Makes room for that many candidates.
    pub(super) fn make_room(&mut self, candidates: usize) {
        make_room(&mut self.cell_of, candidates);
        make_room(&mut self.by_cell, candidates);
    }

    /// Appends to `found` the keypoints at those candidates that [`Spread`](super::spread::Spread) may
    /// keep with this `budget` (0: all), in an image of `width × height` px.
    pub(super) fn confirm(
        &mut self,
        candidates: &[Candidate],
        budget: usize,
        size_px: (u32, u32),
        confirm: impl Fn(&Candidate) -> Option<Keypoint>,
        found: &mut Vec<Keypoint>,
    ) {
        if budget == 0 || candidates.len() <= budget {
            found.extend(candidates.iter().filter_map(confirm));
            return;
        }
        let grid = Grid::new(budget, size_px);
        self.sort_into_cells(candidates, &grid);
        for (candidate, &cell) in candidates.iter().zip(&self.cell_of) {
            if cell == UNDECIDED
                && let Some(keypoint) = confirm(candidate)
            {
                self.cells[grid.cell_of(&keypoint)].keypoints += 1;
                found.push(keypoint);
            }
        }
        let mut turns = 1;
        loop {
            let (mut drawn, mut is_any_left) = (0, false);
            for cell in &mut self.cells {
                cell.draw(
                    turns,
                    &mut self.by_cell,
                    &|n| confirm(&candidates[n]),
                    found,
                );
                drawn += cell.keypoints.min(turns);
                is_any_left |= cell.next < cell.end;
            }
            if drawn >= budget || !is_any_left {
                return;
            }
            turns += 1;
        }
    }

    /// Sorts the candidates whose cell is decided into `by_cell`.
    fn sort_into_cells(&mut self, candidates: &[Candidate], grid: &Grid) {
        self.cells.clear();
        self.cells.resize(grid.cells(), Cell::default());
        self.cell_of.clear();
        self.cell_of.extend(candidates.iter().map(|candidate| {
            let [[left, right], [top, bottom]] = candidate.reach_px();
            let (first, last) = (grid.cell(left, top), grid.cell(right, bottom));
            // The cells between lie in the rectangle of these two, which is one cell.
            if first == last {
                first as u32
            } else {
                UNDECIDED
            }
        }));
        for &cell in self.cell_of.iter().filter(|&&cell| cell != UNDECIDED) {
            self.cells[cell as usize].end += 1;
        }
        let mut start = 0;
        for cell in &mut self.cells {
            let count = cell.end;
            (cell.next, cell.sorted, cell.end) = (start, start, start);
            start += count;
        }
        self.by_cell.clear();
        self.by_cell.resize(start, Lot::default());
        for ((number, candidate), &cell) in (0..).zip(candidates).zip(&self.cell_of) {
            if cell != UNDECIDED {
                let cell = &mut self.cells[cell as usize];
                let response = candidate.response();
                self.by_cell[cell.end] = Lot { response, number };
                cell.end += 1;
            }
        }
    }

    /// Elements held.
    #[cfg(test)]
    pub(super) fn capacity(&self) -> usize {
        self.cell_of.capacity() + self.by_cell.capacity() + self.cells.capacity()
    }
}

impl Cell {
    /// Draws candidates from the strongest on until `turns` of them are keypoints, and none as strong
    /// as the last of these is left.
    fn draw(
        &mut self,
        turns: usize,
        by_cell: &mut [Lot],
        confirm: &impl Fn(usize) -> Option<Keypoint>,
        found: &mut Vec<Keypoint>,
    ) {
        while self.next < self.end {
            if self.next == self.sorted {
                self.sort_more(by_cell);
            }
            let Lot { response, number } = by_cell[self.next];
            if self.confirmed >= turns && response < self.weakest {
                return;
            }
            self.next += 1;
            if let Some(keypoint) = confirm(number as usize) {
                self.confirmed += 1;
                self.keypoints += 1;
                self.weakest = response;
                found.push(keypoint);
            }
        }
    }

    /// Brings the strongest of those that are not sorted to their front, in order.
    fn sort_more(&mut self, by_cell: &mut [Lot]) {
        let rest = &mut by_cell[self.sorted..self.end];
        let count = rest.len().min(SORTED_AT_ONCE);
        let stronger = |a: &Lot, b: &Lot| b.response.total_cmp(&a.response);
        if count < rest.len() {
            rest.select_nth_unstable_by(count - 1, stronger);
        }
        rest[..count].sort_unstable_by(stronger);
        self.sorted += count;
    }
}

#[cfg(test)]
mod tests {
    use super::super::spread::Spread;
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_xoshiro::Xoshiro256PlusPlus;
    use std::cell::Cell as Counter;

    const SIZE_PX: (u32, u32) = (400, 300);

    /// Candidates of two octaves, most of them in the left part of the image; many are equally strong.
    fn crowded(count: usize, seed: u64) -> Vec<Candidate> {
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
        let candidate = |_| {
            let octave = rng.random_range(0..2_u8);
            let across = if rng.random_range(0..10) < 8 {
                150
            } else {
                400
            };
            let column = rng.random_range(1..across - 1) >> octave;
            let row = rng.random_range(1..299_u32) >> octave;
            Candidate::lone(octave, (row, column), rng.random_range(1..200_u32) as f32)
        };
        (0..count).map(candidate).collect()
    }

    /// Confirms two of three, and puts their keypoints anywhere within reach.
    fn confirm(candidate: &Candidate) -> Option<Keypoint> {
        let [[left, right], [top, bottom]] = candidate.reach_px();
        let chance = (left * 7.0 + top * 13.0) as u32 % 97;
        let share = (chance % 11) as f32 / 10.0;
        (!chance.is_multiple_of(3)).then(|| Keypoint {
            x_px: left + share * (right - left),
            y_px: top + (1.0 - share) * (bottom - top),
            response: candidate.response(),
            ..Keypoint::default()
        })
    }

    fn kept(mut keypoints: Vec<Keypoint>, budget: usize) -> Vec<Keypoint> {
        let mut kept = Vec::new();
        Spread::default().keep(&mut keypoints, budget, SIZE_PX, &mut kept);
        kept
    }

    #[test]
    fn the_spread_keeps_the_same_as_of_all() {
        let mut draw = Draw::default();
        for (count, seed) in [(0, 1), (50, 2), (3000, 3), (3000, 4), (6000, 5)] {
            let candidates = crowded(count, seed);
            let all: Vec<_> = candidates.iter().filter_map(confirm).collect();
            for budget in [0, 1, 2, 30, 200, 999, 1900, 2100, 5000] {
                let mut found = Vec::new();
                draw.confirm(&candidates, budget, SIZE_PX, confirm, &mut found);
                assert_eq!(
                    kept(found, budget),
                    kept(all.clone(), budget),
                    "{count} {budget}"
                );
            }
        }
    }

    #[test]
    fn what_is_far_from_being_kept_is_not_confirmed() {
        let candidates = crowded(6000, 6);
        let looked_at = Counter::new(0);
        let count = |candidate: &Candidate| {
            looked_at.set(looked_at.get() + 1);
            confirm(candidate)
        };
        let mut found = Vec::new();
        Draw::default().confirm(&candidates, 200, SIZE_PX, count, &mut found);
        assert!(found.len() >= 200);
        assert!(looked_at.get() < 2500, "{}", looked_at.get());
    }
}
