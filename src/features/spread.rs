//! Even spread: all keypoints of an image in, the strongest of every part of it out.
//!
//! The image is divided into square cells. In turns every cell gives its strongest keypoint that is
//! still left, the strongest first, until the budget is used up. A cell with little contrast thus
//! gives its best before a rich one gives its third, and what poor cells cannot use goes to the
//! others. Well spread keypoints are what holds a motion's covariance down.

use super::{Keypoint, make_room};
use std::cmp::Ordering;

/// Keypoints a cell would hold if the image were equally rich everywhere. With fewer, one strong
/// corner cannot displace its neighbour; with more, the spread is coarser.
const KEYPOINTS_PER_CELL: f64 = 4.0;

/// The working memory of [`Spread::keep`].
#[derive(Debug, Default)]
pub(super) struct Spread {
    /// Keypoints seen so far in each cell.
    seen: Vec<u32>,
    /// Turn in which a keypoint is drawn, and its place among all by strength.
    turns: Vec<(u32, u32)>,
}

impl Spread {
    /// Makes room for that many keypoints.
    pub(super) fn make_room(&mut self, keypoints: usize) {
        make_room(&mut self.turns, keypoints);
    }

    /// Sorts `keypoints` of an image of `width × height` px by strength, and leaves at most `budget`
    /// of them (0: all) in `kept`, in that order.
    pub(super) fn keep(
        &mut self,
        keypoints: &mut [Keypoint],
        budget: usize,
        size_px: (u32, u32),
        kept: &mut Vec<Keypoint>,
    ) {
        kept.clear();
        keypoints.sort_unstable_by(stronger);
        if budget == 0 || keypoints.len() <= budget {
            kept.extend_from_slice(keypoints);
            return;
        }
        let grid = Grid::new(budget, size_px);
        self.seen.clear();
        self.seen.resize(grid.cells(), 0);
        self.turns.clear();
        for (place, keypoint) in (0..).zip(keypoints.iter()) {
            let at = grid.cell_of(keypoint);
            self.turns.push((self.seen[at], place));
            self.seen[at] += 1;
        }
        self.turns.select_nth_unstable(budget - 1);
        self.turns.truncate(budget);
        self.turns.sort_unstable_by_key(|&(_, place)| place);
        let places = self.turns.iter().map(|&(_, place)| place as usize);
        kept.extend(places.map(|place| keypoints[place]));
    }

    /// Elements held.
    #[cfg(test)]
    pub(super) fn capacity(&self) -> usize {
        self.seen.capacity() + self.turns.capacity()
    }
}

/// The cells of an image.
#[derive(Clone, Copy, Debug)]
pub(super) struct Grid {
    side_px: f64,
    across: usize,
    down: usize,
}

impl Grid {
    /// The cells for a budget above 0 in an image of `width × height` px.
    pub(super) fn new(budget: usize, (width, height): (u32, u32)) -> Self {
        let pixels = f64::from(width) * f64::from(height);
        let side_px = (pixels * KEYPOINTS_PER_CELL / budget as f64)
            .sqrt()
            .max(1.0);
        Self {
            side_px,
            across: (f64::from(width) / side_px).ceil() as usize,
            down: (f64::from(height) / side_px).ceil() as usize,
        }
    }

    /// How many there are.
    pub(super) fn cells(&self) -> usize {
        self.across * self.down
    }

    /// The cell of a place; those outside count for the cell at the border.
    pub(super) fn cell(&self, x_px: f32, y_px: f32) -> usize {
        let along = |at_px: f32, cells| ((f64::from(at_px) / self.side_px) as usize).min(cells - 1);
        along(y_px, self.down) * self.across + along(x_px, self.across)
    }

    /// The cell of a keypoint.
    pub(super) fn cell_of(&self, keypoint: &Keypoint) -> usize {
        self.cell(keypoint.x_px, keypoint.y_px)
    }
}

/// The order of strength: by response, and by size, octave and place where that is equal, so that
/// no two different keypoints are ever equal.
fn stronger(a: &Keypoint, b: &Keypoint) -> Ordering {
    (b.response.total_cmp(&a.response))
        .then(b.size_px.total_cmp(&a.size_px))
        .then(b.octave.cmp(&a.octave))
        .then(b.y_px.total_cmp(&a.y_px))
        .then(a.x_px.total_cmp(&b.x_px))
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_xoshiro::Xoshiro256PlusPlus;

    /// 3,000 keypoints in a 400 × 300 image, nine tenths of them, the strong ones, in its left part.
    fn crowded() -> Vec<Keypoint> {
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(7);
        (0..3000)
            .map(|n| {
                let (x0, response) = if n % 10 == 0 {
                    (100.0, 1.0)
                } else {
                    (0.0, 50.0)
                };
                let across = if n % 10 == 0 { 300.0 } else { 100.0 };
                Keypoint {
                    x_px: x0 + across * rng.random::<f32>(),
                    y_px: 300.0 * rng.random::<f32>(),
                    response: response * (1.0 + rng.random::<f32>()),
                    ..Keypoint::default()
                }
            })
            .collect()
    }

    fn kept(mut keypoints: Vec<Keypoint>, budget: usize) -> Vec<Keypoint> {
        let mut kept = vec![Keypoint::default()];
        Spread::default().keep(&mut keypoints, budget, (400, 300), &mut kept);
        kept
    }

    #[test]
    fn keeps_the_budget_and_fills_it() {
        for budget in [1, 2, 10, 999, 2999, 3000, 5000] {
            let keypoints = kept(crowded(), budget);
            assert_eq!(keypoints.len(), budget.min(3000));
            assert!(keypoints.is_sorted_by(|a, b| stronger(a, b) == Ordering::Less));
        }
        assert_eq!(kept(crowded(), 0).len(), 3000);
    }

    #[test]
    fn the_poor_part_of_the_image_keeps_its_share() {
        let keypoints = kept(crowded(), 400);
        let right = keypoints.iter().filter(|k| k.x_px >= 100.0).count();
        // 300 weak keypoints on three quarters of the area: nearly all of them are drawn.
        assert!(right > 220, "{right}");
        // By strength alone none of them would be.
        let mut by_strength = crowded();
        by_strength.sort_unstable_by(stronger);
        assert!(by_strength[..400].iter().all(|k| k.x_px < 100.0));
    }

    #[test]
    fn what_comes_first_does_not_depend_on_the_order_given() {
        let mut backward = crowded();
        backward.reverse();
        assert_eq!(kept(crowded(), 500), kept(backward, 500));
    }

    #[test]
    fn a_cell_gives_its_strongest() {
        let keypoints = kept(crowded(), 300);
        let all = crowded();
        let weakest_kept = |cell: (i32, i32)| {
            let inside = |k: &&Keypoint| ((k.x_px / 40.0) as i32, (k.y_px / 40.0) as i32) == cell;
            let weakest = keypoints.iter().filter(inside).map(|k| k.response);
            let dropped = all.iter().filter(inside).filter(|k| !keypoints.contains(k));
            (
                weakest.fold(f32::INFINITY, f32::min),
                dropped.map(|k| k.response).fold(0.0, f32::max),
            )
        };
        // 400 · 300 · 4 / 300 = 40²: cells of 40 px.
        for cell in (0..10).flat_map(|x| (0..7).map(move |y| (x, y))) {
            let (weakest, dropped) = weakest_kept(cell);
            assert!(weakest > dropped, "{cell:?}: {weakest} {dropped}");
        }
    }
}
