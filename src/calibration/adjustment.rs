//! Views, a rig and placements in; the rig and the placements that miss the views' points least out.
//!
//! One joint adjustment of both cameras, their extrinsics and all placements of the board: Levenberg and Marquardt's
//! damped steps on the Schur complement of the placements, by which an iteration costs as much as there are
//! points, and a system of the rig's parameters alone is solved.

use super::normal::{
    Loss, Reduced, RigMatrix, ViewEquations, Weighting, cost, misses, moved, placement_step,
};
use super::{Board, View};
use crate::geometry::StereoRig;
use crate::geometry::rig_parameters::RigVector;
use nalgebra::{DMatrix, DVector, Isometry3, Vector2};

/// Steps that an adjustment may take, those that were not taken included.
const MAX_STEPS: usize = 200;
/// The damping at first, as a share of the diagonal.
const FIRST_DAMPING: f64 = 1e-3;
/// Beyond this damping no step leads downhill.
const MOST_DAMPING: f64 = 1e12;
/// How far an adjustment goes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Effort {
    /// So many steps.
    Steps(usize),
    /// Until a step gains less than a thousandth: σ is known by then.
    Rough,
    /// As far as rounding lets it.
    Full,
}

impl Effort {
    fn steps(self) -> usize {
        match self {
            Self::Steps(steps) => steps,
            _ => MAX_STEPS,
        }
    }

    /// The share of the cost that a step must gain for another one to be taken.
    fn smallest_gain(self) -> f64 {
        match self {
            Self::Full => 1e-12,
            _ => 1e-3,
        }
    }
}

/// A rig with the placements of the board, as far as they are known.
#[derive(Clone, Debug)]
pub(super) struct State {
    pub rig: StereoRig,
    /// left_from_board, one a view.
    pub placements: Vec<Isometry3<f64>>,
}

/// What is to be adjusted.
pub(super) struct Problem<'a> {
    pub board: &'a Board,
    pub views: &'a [View],
    /// The rig's slots that are free.
    pub free: &'a [usize],
}

impl Problem<'_> {
    /// Every point's miss, measured − predicted, px: view, side, point.
    pub(super) fn misses(&self, state: &State) -> Vec<(usize, usize, usize, Option<Vector2<f64>>)> {
        let views = self.views.iter().zip(&state.placements).enumerate();
        views
            .flat_map(|(i, (view, placement))| {
                let of_view = misses(&state.rig, placement, self.board, view);
                of_view
                    .into_iter()
                    .map(move |(side, point, miss)| (i, side, point, miss))
            })
            .collect()
    }

    fn cost(&self, state: &State, loss: Loss) -> f64 {
        let views = self.views.iter().zip(&state.placements);
        views
            .map(|(view, placement)| cost(&state.rig, placement, self.board, view, loss))
            .sum()
    }

    /// The views' equations at `state`.
    pub(super) fn equations(
        &self,
        state: &State,
        loss: Loss,
        weighting: Weighting,
    ) -> Vec<ViewEquations> {
        let views = self.views.iter().zip(&state.placements);
        views
            .map(|(view, placement)| {
                ViewEquations::new(&state.rig, placement, self.board, view, loss, weighting)
            })
            .collect()
    }

    /// Adjusts `state`.
    pub(super) fn adjust(&self, state: &mut State, loss: Loss, effort: Effort) {
        let mut damping = FIRST_DAMPING;
        let mut so_far = self.cost(state, loss);
        let mut equations = self.equations(state, loss, Weighting::ByLoss);
        for _ in 0..effort.steps() {
            let next = self.step(state, &equations, damping);
            let next_cost = next
                .as_ref()
                .map_or(f64::INFINITY, |next| self.cost(next, loss));
            match next {
                Some(next) if next_cost < so_far => {
                    let gain = (so_far - next_cost) / so_far.max(f64::MIN_POSITIVE);
                    (*state, so_far) = (next, next_cost);
                    damping = (damping * 0.2).max(1e-12);
                    if gain < effort.smallest_gain() {
                        return;
                    }
                    equations = self.equations(state, loss, Weighting::ByLoss);
                }
                _ if damping > MOST_DAMPING => return,
                _ => damping *= 8.0,
            }
        }
    }

    /// The state after a damped step; `None` where there is none.
    fn step(&self, state: &State, equations: &[ViewEquations], damping: f64) -> Option<State> {
        let mut diagonal = RigVector::zeros();
        let mut reduced = Vec::with_capacity(equations.len());
        for view in equations {
            diagonal += view.diagonal();
            reduced.push(view.reduced(damping)?);
        }
        let (mut information, score) = total(&reduced);
        for &slot in self.free {
            information[(slot, slot)] += damping * diagonal[slot];
        }
        let step = solve(&information, &score, self.free)?;
        let placements = state.placements.iter().zip(equations);
        let placements =
            placements.map(|(p, view)| Some(moved(p, &view.placement_step(&step, damping)?)));
        Some(State {
            placements: placements.collect::<Option<_>>()?,
            rig: state.rig.with_error(&step),
        })
    }
}

/// What all views say together.
pub(super) fn total(reduced: &[Reduced]) -> (RigMatrix, RigVector) {
    let start = (RigMatrix::zeros(), RigVector::zeros());
    reduced.iter().fold(start, |(information, score), view| {
        (information + view.information, score + view.score)
    })
}

/// The free part of an information matrix with unit diagonal, and the scales that make it so. `None` where a
/// slot has no information at all.
pub(super) fn scaled(
    information: &RigMatrix,
    free: &[usize],
) -> Option<(DMatrix<f64>, DVector<f64>)> {
    let scale =
        DVector::from_iterator(free.len(), free.iter().map(|&i| information[(i, i)].sqrt()));
    if !scale.iter().all(|s| s.is_finite() && *s > 0.0) {
        return None;
    }
    let matrix = DMatrix::from_fn(free.len(), free.len(), |i, j| {
        information[(free[i], free[j])] / (scale[i] * scale[j])
    });
    Some((matrix, scale))
}

/// The step of the free slots that `information · step = score` asks for.
fn solve(information: &RigMatrix, score: &RigVector, free: &[usize]) -> Option<RigVector> {
    let (matrix, scale) = scaled(information, free)?;
    let right = DVector::from_iterator(
        free.len(),
        free.iter().zip(scale.iter()).map(|(&i, s)| score[i] / s),
    );
    let solution = matrix.cholesky()?.solve(&right);
    let mut step = RigVector::zeros();
    for (i, &slot) in free.iter().enumerate() {
        step[slot] = solution[i] / scale[i];
    }
    Some(step)
}

/// Fits the placement of one view to a rig that stays as it is.
pub(super) fn fit_placement(
    rig: &StereoRig,
    start: &Isometry3<f64>,
    board: &Board,
    view: &View,
    loss: Loss,
) -> Isometry3<f64> {
    let mut damping = FIRST_DAMPING;
    let (mut placement, mut so_far) = (*start, cost(rig, start, board, view, loss));
    for _ in 0..MAX_STEPS {
        let Some(step) = placement_step(rig, &placement, board, view, loss, damping) else {
            return placement;
        };
        let next = moved(&placement, &step);
        let next_cost = cost(rig, &next, board, view, loss);
        if next_cost < so_far {
            let gain = (so_far - next_cost) / so_far;
            (placement, so_far) = (next, next_cost);
            damping *= 0.2;
            if gain < 1e-9 {
                break;
            }
        } else {
            damping *= 8.0;
            if damping > MOST_DAMPING {
                break;
            }
        }
    }
    placement
}
