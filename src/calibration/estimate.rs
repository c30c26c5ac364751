//! The whole of a calibration: a start, a robust joint adjustment, outliers named and left out, the covariance.

use super::adjustment::{Effort, Problem, State};
use super::covariance::{Spread, Undetermined, covariance, lengths_px, robust_sigma_px};
use super::normal::{Loss, Weighting};
use super::{Board, Lens, View, initial};
use crate::geometry::rig_parameters::{EXTRINSICS, RigCovariance};
use crate::geometry::{RigUncertainty, StereoRig};
use nalgebra::{Isometry3, Vector2};

/// Fewest views that see the board with both cameras.
const LEAST_VIEWS: usize = 3;
/// Misses count linearly beyond this many σ: of normal misses, one in ninety.
const LOSS_SIGMAS: f64 = 3.0;
/// Points that missed by more than this many σ are left out: of normal misses, one in 270 000.
const OUTLIER_SIGMAS: f64 = 5.0;
/// Nor is a point left out that missed by less than this, px.
const OUTLIER_LEAST_PX: f64 = 0.05;
/// A view is left out whose points miss by this many times the median of all views,
const VIEW_TIMES_MEDIAN: f64 = 4.0;
/// or of whose points this share is outliers.
const VIEW_OUTLIER_SHARE: f64 = 0.3;
/// Rounds of adjusting and leaving out.
const MAX_ROUNDS: usize = 8;
/// Rounds of adjusting and measuring σ anew.
const SIGMA_ROUNDS: usize = 10;
/// The file that the covariance is named after where nobody says otherwise.
const COVARIANCE_FILE: &str = "rig.cov.csv";

/// Why there is no calibration.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CalibrationError {
    /// Too few views.
    #[error("only {usable} views show the board to both cameras, but at least {LEAST_VIEWS} must")]
    TooFewViews {
        /// How many there are.
        usable: usize,
    },
    /// No focal length fits.
    #[error(
        "the {side} camera's views fit no focal length: check the board's number of points, and that it is tilted in some views"
    )]
    NoStart {
        /// Which camera.
        side: &'static str,
    },
    /// The cameras never saw the board together.
    #[error("no view was seen by both cameras, so that nothing says how they stand to each other")]
    NoCommonView,
    /// The views do not tell all parameters.
    #[error("the views do not determine {}: show the board tilted both ways, nearer and farther, and up to the images' edges, or choose a lens with fewer coefficients", .parameters.join(", "))]
    Undetermined {
        /// Their names.
        parameters: Vec<String>,
    },
}

/// What is being done, for a progress display.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// Seeking a start.
    Start,
    /// Adjusting, round by round.
    Adjust {
        /// Which round, from 1.
        round: usize,
    },
    /// Computing the covariance.
    Covariance,
}

/// By how much a point was missed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Residual {
    /// The view's number in [`Calibration::views`].
    pub view: usize,
    /// 0 left, 1 right.
    pub side: usize,
    /// The point's number on the board.
    pub point: usize,
    /// Where it was seen, px.
    pub seen_px: Vector2<f64>,
    /// Seen − predicted, px.
    pub miss_px: Vector2<f64>,
}

/// A point that was left out.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct OutlierPoint {
    /// The view.
    pub view: String,
    /// The camera.
    pub side: &'static str,
    /// The point's number on the board, row by row from 0.
    pub point: usize,
    /// By how much it missed, px.
    pub miss_px: f64,
}

/// A view that was left out.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
pub struct LeftOut {
    /// The view.
    pub view: String,
    /// Why.
    pub why: String,
}

/// A view that the calibration rests on.
#[derive(Clone, Debug, PartialEq)]
pub struct ViewResult {
    /// The view.
    pub name: String,
    /// Where the board stood.
    pub left_from_board: Isometry3<f64>,
    /// Root mean square length of its points' misses, px, left and right; `None` where it was not seen.
    pub rms_px: [Option<f64>; 2],
}

/// A calibrated rig with all that is known about it.
#[derive(Clone, Debug)]
pub struct Calibration {
    /// The rig; its uncertainty is the covariance.
    pub rig: StereoRig,
    /// The covariance of its parameters, of [`rig_parameters`](crate::geometry::rig_parameters).
    pub covariance: RigCovariance,
    /// The slots that were estimated.
    pub free: Vec<usize>,
    /// The board that was shown.
    pub board: Board,
    /// The lens model.
    pub lens: Lens,
    /// The views that it rests on.
    pub views: Vec<ViewResult>,
    /// All points that it rests on.
    pub residuals: Vec<Residual>,
    /// Views left out.
    pub left_out: Vec<LeftOut>,
    /// Points left out of views that stay.
    pub outliers: Vec<OutlierPoint>,
    /// Root mean square length of the misses, px: left, right, both.
    pub rms_px: [f64; 3],
    /// 1 σ of a coordinate of a point, px, from the misses.
    pub sigma_px: f64,
    /// The variance by which views differ over that which their points' noise explains; 1 is par.
    pub between_views: f64,
    /// Whether the covariance was multiplied by it, being significant.
    pub is_inflated: bool,
}

impl Calibration {
    /// 1 σ of a slot.
    #[must_use]
    pub fn sigma(&self, slot: usize) -> f64 {
        self.covariance[(slot, slot)].sqrt()
    }

    /// How far two slots' errors go together, −1 to 1.
    #[must_use]
    pub fn correlation(&self, a: usize, b: usize) -> f64 {
        self.covariance[(a, b)] / (self.sigma(a) * self.sigma(b))
    }
}

/// Calibrates a rig whose images have `size_px` pixels; `progress` is told what is being done.
///
/// # Errors
/// See the variants of [`CalibrationError`].
pub fn calibrate(
    board: &Board,
    views: &[View],
    size_px: (u32, u32),
    lens: Lens,
    progress: &mut dyn FnMut(Stage),
) -> Result<Calibration, CalibrationError> {
    let usable = views
        .iter()
        .filter(|v| v.count(0) > 0 && v.count(1) > 0)
        .count();
    if usable < LEAST_VIEWS {
        return Err(CalibrationError::TooFewViews { usable });
    }
    progress(Stage::Start);
    let (state, kept) = initial::start(board, views, size_px, lens)?;
    let not_placed = |i: &usize| !kept.contains(i);
    let left_out = (0..views.len()).filter(not_placed).map(|i| LeftOut {
        view: views[i].name.clone(),
        why: "too few of its points were found to place the board".to_owned(),
    });
    let mut fit = Fit {
        board,
        views: kept.iter().map(|&i| views[i].clone()).collect(),
        free: lens.rig_slots(),
        state,
        loss: Loss::SQUARED,
        left_out: left_out.collect(),
        outliers: Vec::new(),
    };
    for round in 1..=MAX_ROUNDS {
        progress(Stage::Adjust { round });
        fit.adjust();
        if !fit.leave_out() {
            break;
        }
        let usable = fit
            .views
            .iter()
            .filter(|v| v.count(0) > 0 && v.count(1) > 0)
            .count();
        if usable < LEAST_VIEWS {
            return Err(CalibrationError::TooFewViews { usable });
        }
    }
    progress(Stage::Covariance);
    fit.finish(lens)
}

/// A calibration that is under way.
struct Fit<'a> {
    board: &'a Board,
    views: Vec<View>,
    free: Vec<usize>,
    state: State,
    loss: Loss,
    left_out: Vec<LeftOut>,
    outliers: Vec<OutlierPoint>,
}

impl Fit<'_> {
    fn problem(&self) -> Problem<'_> {
        Problem {
            board: self.board,
            views: &self.views,
            free: &self.free,
        }
    }

    fn parameters(&self) -> usize {
        self.free.len() + 6 * self.views.len()
    }

    fn sigma_px(&self, state: &State) -> f64 {
        let misses = self.problem().misses(state);
        robust_sigma_px(
            &lengths_px(misses.iter().map(|(.., miss)| miss)),
            self.parameters(),
        )
    }

    /// Adjusts everything, the loss' threshold going along with σ.
    fn adjust(&mut self) {
        let mut state = self.state.clone();
        let mut sigma_px = self.sigma_px(&state);
        for _ in 0..SIGMA_ROUNDS {
            // Exact points have a σ of rounding alone.
            self.loss = Loss {
                threshold_px: LOSS_SIGMAS * sigma_px.max(1e-9),
            };
            self.problem().adjust(&mut state, self.loss, Effort::Rough);
            let next = self.sigma_px(&state);
            let is_settled = (next - sigma_px).abs() <= 0.01 * sigma_px;
            sigma_px = next;
            if is_settled {
                break;
            }
        }
        self.problem().adjust(&mut state, self.loss, Effort::Full);
        self.state = state;
    }

    /// Leaves out what cannot be right, naming it; whether there was such a thing.
    fn leave_out(&mut self) -> bool {
        let misses = self.problem().misses(&self.state);
        let limit_px = (OUTLIER_SIGMAS * self.sigma_px(&self.state)).max(OUTLIER_LEAST_PX);
        let lengths = lengths_px(misses.iter().map(|(.., miss)| miss));
        let found: Vec<_> = misses
            .iter()
            .zip(lengths)
            .filter(|(_, length)| *length > limit_px)
            .collect();
        let rms: Vec<f64> = (0..self.views.len())
            .map(|i| rms_of(misses.iter().filter(|m| m.0 == i).map(|m| &m.3)))
            .collect();
        let mut sorted = rms.clone();
        sorted.sort_by(f64::total_cmp);
        let median = sorted[sorted.len() / 2];
        let mut keep = vec![true; self.views.len()];
        for (i, view) in self.views.iter().enumerate() {
            let of_view = found.iter().filter(|(miss, _)| miss.0 == i).count();
            let share = of_view as f64 / (view.count(0) + view.count(1)).max(1) as f64;
            let times = rms[i] / median;
            if share > VIEW_OUTLIER_SHARE
                || (times > VIEW_TIMES_MEDIAN && rms[i] > OUTLIER_LEAST_PX)
            {
                keep[i] = false;
                self.left_out.push(LeftOut {
                    view: view.name.clone(),
                    why: format!(
                        "its points miss by {:.2} px, {times:.1} times as much as those of the other views",
                        rms[i]
                    ),
                });
            }
        }
        // A wrong view leads the others astray: their points are judged once it is gone.
        let views_are_good = keep.iter().all(|k| *k);
        for &(&(view, side, point, _), miss_px) in &found {
            if views_are_good {
                self.outliers.push(OutlierPoint {
                    view: self.views[view].name.clone(),
                    side: ["left", "right"][side],
                    point,
                    miss_px,
                });
                if let Some(seen) = &mut self.views[view].seen[side] {
                    seen[point] = None;
                }
            }
        }
        let is_clean = found.is_empty() && views_are_good;
        let mut kept = keep.iter();
        self.views.retain(|_| *kept.next().unwrap_or(&true));
        let mut kept = keep.iter();
        self.state
            .placements
            .retain(|_| *kept.next().unwrap_or(&true));
        let gone: Vec<&str> = self.left_out.iter().map(|out| out.view.as_str()).collect();
        self.outliers
            .retain(|outlier| !gone.contains(&outlier.view.as_str()));
        !is_clean
    }

    fn finish(self, lens: Lens) -> Result<Calibration, CalibrationError> {
        let problem = self.problem();
        let misses = problem.misses(&self.state);
        let undetermined = |slots: &[usize]| {
            let names = self.state.rig.parameter_names();
            let name = |slot: &usize| {
                names
                    .iter()
                    .find(|(_, i)| i == slot)
                    .map(|(name, _)| name.clone())
            };
            CalibrationError::Undetermined {
                parameters: slots.iter().filter_map(name).collect(),
            }
        };
        let equations = problem.equations(&self.state, self.loss, Weighting::Full);
        let reduced: Option<Vec<_>> = equations.iter().map(|view| view.reduced(0.0)).collect();
        let reduced = reduced.ok_or_else(|| undetermined(&self.free))?;
        let lengths = lengths_px(misses.iter().map(|(.., miss)| miss));
        let Spread {
            covariance,
            sigma_px,
            between_views,
            is_inflated,
        } = covariance(
            &self.state.rig,
            self.board,
            &self.free,
            &reduced,
            &lengths,
            self.loss,
        )
        .map_err(|Undetermined(slots)| undetermined(&slots))?;
        let of = |view: Option<usize>, side: Option<usize>| {
            let chosen = misses
                .iter()
                .filter(|m| view.is_none_or(|v| v == m.0) && side.is_none_or(|s| s == m.1));
            rms_of(chosen.map(|m| &m.3))
        };
        let views = self
            .views
            .iter()
            .zip(&self.state.placements)
            .enumerate()
            .map(|(i, (view, placement))| ViewResult {
                name: view.name.clone(),
                left_from_board: *placement,
                rms_px: [0, 1].map(|side| (view.count(side) > 0).then(|| of(Some(i), Some(side)))),
            });
        let residual =
            |&(view, side, point, miss): &(usize, usize, usize, Option<Vector2<f64>>)| {
                let seen_px = self.views[view].seen[side].as_ref()?[point]?;
                Some(Residual {
                    view,
                    side,
                    point,
                    seen_px,
                    miss_px: miss?,
                })
            };
        let mut rig = self.state.rig.clone();
        rig.uncertainty = Some(RigUncertainty::Covariance {
            file: COVARIANCE_FILE.into(),
            covariance: Box::new(covariance),
        });
        debug_assert_eq!(self.free.len(), 2 * (4 + lens.coefficients()) + 6);
        debug_assert_eq!(self.free.last(), Some(&(EXTRINSICS + 5)));
        Ok(Calibration {
            rig,
            covariance,
            free: self.free.clone(),
            board: *self.board,
            lens,
            views: views.collect(),
            residuals: misses.iter().filter_map(residual).collect(),
            rms_px: [of(None, Some(0)), of(None, Some(1)), of(None, None)],
            sigma_px,
            between_views,
            is_inflated,
            left_out: self.left_out,
            outliers: self.outliers,
        })
    }
}

/// Root mean square length, px, of the misses that there are; 0 of none.
fn rms_of<'a>(misses: impl Iterator<Item = &'a Option<Vector2<f64>>>) -> f64 {
    let (mut sum, mut count) = (0.0, 0);
    for miss in misses {
        sum += miss.map_or(f64::INFINITY, |m| m.norm_squared());
        count += 1;
    }
    if count == 0 {
        0.0
    } else {
        (sum / f64::from(count)).sqrt()
    }
}
