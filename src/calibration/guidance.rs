//! While capturing: views in, whether each adds something and what is still missing out.
//!
//! A view is taken where the board holds still, at a place or a tilt that was not shown yet, and, once there is a
//! first calibration, where it would improve some combination of the rig's parameters: the largest eigenvalue of
//! `A⁻¹ H`, the view's information against that of all views so far, says by how much the variance of the
//! combination that gains most would fall.

use super::adjustment::{scaled, total};
use super::advice::Coverage;
use super::normal::{Loss, Reduced, ViewEquations, Weighting};
use super::{Board, Calibration, Lens, Stage, View, calibrate, initial};
use crate::geometry::{Camera, StereoRig};
use nalgebra::{DMatrix, Isometry3, Vector2};

/// The board holds still when its points moved by less than this since the pair before, px.
const STILL_PX: f64 = 1.5;
/// A view is new when its middle or its size differs from all others by this share of the image's width,
const NEW_SHARE: f64 = 0.06;
/// or its shape, that is its tilt, by this: points about their middle, in units of their spread.
const NEW_SHAPE: f64 = 0.08;
/// The variance of some combination of parameters must fall by this factor at least.
const LEAST_GAIN: f64 = 1.15;
/// Views with which a first calibration is tried, and how often it is renewed.
const FIRST_CALIBRATION: usize = 5;
const RENEWED_EVERY: usize = 3;
/// Fewest views that can be enough.
const ENOUGH_VIEWS: usize = 12;

/// What becomes of a view.
#[derive(Clone, Debug, PartialEq)]
pub enum Verdict {
    /// It was taken; the factor by which the variance of what gained most has fallen, where that is known.
    Taken {
        /// That factor.
        gain: Option<f64>,
    },
    /// Not both cameras see the board.
    NotSeen,
    /// The board moves.
    Moving,
    /// It was shown like this before.
    Known,
    /// It would tell nothing that is not known already.
    NothingNew {
        /// The factor by which the variance of what gained most would fall.
        gain: f64,
    },
}

/// Views that were taken, and what they tell so far.
pub struct Guide {
    board: Board,
    lens: Lens,
    size_px: (u32, u32),
    taken: Vec<View>,
    before: Option<Vec<Vector2<f64>>>,
    known: Option<Known>,
}

/// The last calibration with its information.
struct Known {
    found: Calibration,
    reduced: Vec<Reduced>,
}

impl Guide {
    /// A guide that has seen nothing yet.
    #[must_use]
    pub fn new(board: Board, lens: Lens, size_px: (u32, u32)) -> Self {
        Self {
            board,
            lens,
            size_px,
            taken: Vec::new(),
            before: None,
            known: None,
        }
    }

    /// The views that were taken.
    #[must_use]
    pub fn views(&self) -> &[View] {
        &self.taken
    }

    /// The last calibration from them, if there is one.
    #[must_use]
    pub fn calibration(&self) -> Option<&Calibration> {
        self.known.as_ref().map(|known| &known.found)
    }

    /// Looks at a view; takes it if it adds something.
    pub fn offer(&mut self, view: View) -> Verdict {
        if view.count(0) < self.board.len() || view.count(1) < self.board.len() {
            self.before = None;
            return Verdict::NotSeen;
        }
        let points: Vec<_> = view.points(0).map(|(_, px)| px).collect();
        let before = self.before.replace(points.clone());
        let is_still = before.is_some_and(|before| rms_apart(&before, &points) < STILL_PX);
        if !is_still {
            return Verdict::Moving;
        }
        let width = f64::from(self.size_px.0);
        let is_known = |other: &View| {
            let other: Vec<_> = other.points(0).map(|(_, px)| px).collect();
            is_like(&other, &points, width)
        };
        if self.taken.iter().any(is_known) {
            return Verdict::Known;
        }
        let gain = self.gain(&view);
        if let Some(gain) = gain.filter(|gain| *gain < LEAST_GAIN) {
            return Verdict::NothingNew { gain };
        }
        self.taken.push(view);
        let count = self.taken.len();
        if count >= FIRST_CALIBRATION
            && (self.known.is_none() || count.is_multiple_of(RENEWED_EVERY))
        {
            self.renew();
        } else {
            self.add_information();
        }
        Verdict::Taken { gain }
    }

    fn renew(&mut self) {
        let found = calibrate(
            &self.board,
            &self.taken,
            self.size_px,
            self.lens,
            &mut |_: Stage| {},
        );
        // Too few views to tell all parameters: more will come.
        if let Ok(found) = found {
            let placed = |view: &View| {
                let placement = initial::placed(&self.board, view, 0, &found.rig.left)?;
                self.reduced(&found.rig, &placement, view)
            };
            let reduced = self.taken.iter().filter_map(placed).collect();
            self.known = Some(Known { found, reduced });
        }
    }

    fn add_information(&mut self) {
        let Some(known) = &self.known else { return };
        let Some(view) = self.taken.last() else {
            return;
        };
        let placement = initial::placed(&self.board, view, 0, &known.found.rig.left);
        let reduced =
            placement.and_then(|placement| self.reduced(&known.found.rig, &placement, view));
        if let (Some(known), Some(reduced)) = (&mut self.known, reduced) {
            known.reduced.push(reduced);
        }
    }

    fn reduced(&self, rig: &StereoRig, placement: &Isometry3<f64>, view: &View) -> Option<Reduced> {
        ViewEquations::new(
            rig,
            placement,
            &self.board,
            view,
            Loss::SQUARED,
            Weighting::Full,
        )
        .reduced(0.0)
    }

    /// The factor by which the variance of the combination of parameters that gains most would fall.
    fn gain(&self, view: &View) -> Option<f64> {
        let known = self.known.as_ref()?;
        let rig = &known.found.rig;
        let placement = initial::placed(&self.board, view, 0, &rig.left)?;
        let new = self.reduced(rig, &placement, view)?;
        let free = &known.found.free;
        let (information, _) = total(&known.reduced);
        let (matrix, scale) = scaled(&information, free)?;
        let lower = matrix.cholesky()?.unpack();
        let added = DMatrix::from_fn(free.len(), free.len(), |i, j| {
            new.information[(free[i], free[j])] / (scale[i] * scale[j])
        });
        let half = lower.solve_lower_triangular(&added)?;
        let whitened = lower.solve_lower_triangular(&half.transpose())?;
        Some(1.0 + whitened.symmetric_eigenvalues().max())
    }

    /// What is still missing, each a phrase for a sentence such as "show the board …".
    #[must_use]
    pub fn missing(&self) -> Vec<String> {
        let mut coverage = Coverage::default();
        let guess;
        let left: &Camera = match self.calibration() {
            Some(found) => &found.rig.left,
            None => {
                guess = self
                    .lens
                    .camera(self.size_px, Vector2::repeat(f64::from(self.size_px.0)));
                &guess
            }
        };
        for view in &self.taken {
            for side in 0..2 {
                for (_, px) in view.points(side) {
                    coverage.add_point(side, &px, self.size_px);
                }
            }
            if let Some(placement) = initial::placed(&self.board, view, 0, left) {
                coverage.add_placement(&placement);
            }
        }
        coverage.missing()
    }

    /// Whether there are enough views and nothing is missing.
    #[must_use]
    pub fn is_content(&self) -> bool {
        self.taken.len() >= ENOUGH_VIEWS && self.known.is_some() && self.missing().is_empty()
    }
}

fn rms_apart(a: &[Vector2<f64>], b: &[Vector2<f64>]) -> f64 {
    let squares: f64 = a.iter().zip(b).map(|(a, b)| (a - b).norm_squared()).sum();
    (squares / a.len().max(1) as f64).sqrt()
}

/// Whether two images of the board are much the same.
fn is_like(a: &[Vector2<f64>], b: &[Vector2<f64>], width_px: f64) -> bool {
    let middle =
        |points: &[Vector2<f64>]| points.iter().sum::<Vector2<f64>>() / points.len().max(1) as f64;
    let (in_a, in_b) = (middle(a), middle(b));
    let spread = |points: &[Vector2<f64>], middle: &Vector2<f64>| {
        (points
            .iter()
            .map(|p| (p - middle).norm_squared())
            .sum::<f64>()
            / points.len().max(1) as f64)
            .sqrt()
    };
    let (size_a, size_b) = (spread(a, &in_a), spread(b, &in_b));
    let limit_px = NEW_SHARE * width_px;
    if (in_a - in_b).norm() > limit_px || (size_a - size_b).abs() > 0.5 * limit_px {
        return false;
    }
    let shape = |points: &[Vector2<f64>], middle: Vector2<f64>, size: f64| -> Vec<Vector2<f64>> {
        points.iter().map(|p| (p - middle) / size).collect()
    };
    rms_apart(&shape(a, in_a, size_a), &shape(b, in_b, size_b)) < NEW_SHAPE
}

#[cfg(test)]
mod tests {
    use super::super::Pattern;
    use super::super::simulated::{placements, views};
    use super::*;

    const BOARD: Board = Board {
        pattern: Pattern::Chessboard,
        columns: 9,
        rows: 6,
        square_m: 0.04,
        sigma_square_m: 0.0,
    };

    fn guide() -> (Guide, Vec<View>) {
        let rig = crate::simulation::small_rig();
        let placed = placements(&rig, &BOARD, 40, 3);
        let seen = views(&rig, &BOARD, &placed, 0.1, 1);
        (
            Guide::new(BOARD, Lens::Radtan4, (rig.left.width, rig.left.height)),
            seen,
        )
    }

    #[test]
    fn a_view_is_taken_once_it_holds_still_and_not_again() {
        let (mut guide, seen) = guide();
        assert_eq!(guide.offer(seen[0].clone()), Verdict::Moving);
        assert_eq!(guide.offer(seen[0].clone()), Verdict::Taken { gain: None });
        assert_eq!(guide.offer(seen[0].clone()), Verdict::Known);
        assert_eq!(guide.offer(seen[1].clone()), Verdict::Moving);
        let half = View {
            seen: [seen[1].seen[0].clone(), None],
            ..seen[1].clone()
        };
        assert_eq!(guide.offer(half), Verdict::NotSeen);
        assert_eq!(guide.views().len(), 1);
        assert!(!guide.missing().is_empty() && !guide.is_content());
    }

    #[test]
    fn views_are_taken_as_long_as_they_tell_something() {
        let (mut guide, seen) = guide();
        let mut gains = Vec::new();
        let mut refused = 0;
        for view in &seen {
            guide.offer(view.clone());
            match guide.offer(view.clone()) {
                Verdict::Taken { gain } => gains.extend(gain),
                Verdict::NothingNew { gain } => {
                    assert!(gain < LEAST_GAIN);
                    refused += 1;
                }
                Verdict::Known => refused += 1,
                other => panic!("{other:?}"),
            }
        }
        // The first to be weighed tells much more than the last.
        assert!(
            gains.len() > 5 && gains[0] > 1.2 * gains[gains.len() - 1],
            "{gains:?}"
        );
        assert!(
            refused > 0,
            "forty views of one kind are not all needed: {gains:?}"
        );
        let found = guide.calibration().expect("calibrated");
        let rig = crate::simulation::small_rig();
        assert!((found.rig.baseline_m() - rig.baseline_m()).abs() < 5.0 * found.sigma(24));
    }
}
