//! Rows: stereo sights of one pair in, equations of what they miss their rows by out.
//!
//! On the rectified plane a right sight should share the row of the left one, wherever the point is. What it
//! misses by is laid to the calibration's own errors and to a turn. Some matches are wrong: each is weighed
//! by Huber's function about the turn that this pair alone would have, and its scale is the median's.

use super::LEAST;
use super::filter::{Equations, Filter, STATICS, StaticsCovariance, UNKNOWNS};
use super::turn::row_by_turn;
use crate::estimation::calibration::sight_by_rig;
use crate::estimation::{Settings, StereoMeasurement, Viewpoint};
use crate::geometry::rig_parameters::RIG_PARAMETERS;
use crate::geometry::{Rectification, StereoRig};
use nalgebra::{Matrix3, RowVector4, SMatrix, SVector, Vector2, Vector3, Vector4};

/// Pairs for which a track lives, so that its own error comes again and again: what pairs say is counted as if only
/// every tenth were there.
const CORRELATED_PAIRS: f64 = 10.0;
/// Huber's: beyond so many σ a deviation counts in proportion, no longer squared.
const HUBER: f64 = 1.345;
/// Rounds of weighing and fitting.
const ROUNDS: usize = 4;
/// σ of a normal variable over the median of its size.
const SIGMA_OVER_MEDIAN: f64 = 1.4826;

/// Working memory.
#[derive(Clone, Debug, Default)]
pub(super) struct Rows {
    rows: Vec<Row>,
    sizes: Vec<f64>,
}

/// One match.
#[derive(Clone, Copy, Debug)]
struct Row {
    by: SVector<f64, UNKNOWNS>,
    /// What it misses by, the state allowed for, px.
    deviation_px: f64,
    sigma_px: f64,
    weight: f64,
}

impl Row {
    fn by_turn(&self) -> Vector3<f64> {
        self.by.fixed_rows::<3>(STATICS).into_owned()
    }
}

impl Rows {
    /// Forgets the pair before.
    pub(super) fn begin(&mut self) {
        self.rows.clear();
    }

    /// Adds a sight, as it was measured.
    pub(super) fn add(
        &mut self,
        rig: &StereoRig,
        rectification: &Rectification,
        sight: &StereoMeasurement,
    ) {
        self.rows.extend(row(rig, rectification, sight));
    }

    /// What the pair says of the deviation from the filter's state. `None` where sights are too few.
    pub(super) fn say(&mut self, filter: &Filter) -> Option<Equations> {
        if self.rows.len() < LEAST {
            return None;
        }
        for row in &mut self.rows {
            row.deviation_px -= row.by.dot(&filter.state);
        }
        let scale = self.weigh()?;
        let mut equations = Equations::default();
        for row in &self.rows {
            equations.add(&row.by, row.deviation_px, row.weight);
        }
        equations.scale(1.0 / (scale * scale * CORRELATED_PAIRS));
        Some(equations)
    }

    /// Weighs each match about the turn that the pair alone would have; the scale of σ.
    fn weigh(&mut self) -> Option<f64> {
        let mut turn_rad = self.middle();
        let mut scale = 1.0;
        for _ in 0..ROUNDS {
            self.sizes.clear();
            let rows = self.rows.iter();
            self.sizes.extend(
                rows.map(|r| ((r.deviation_px - r.by_turn().dot(&turn_rad)) / r.sigma_px).abs()),
            );
            for (row, size) in self.rows.iter_mut().zip(&self.sizes) {
                row.weight = *size;
            }
            let middle = self.sizes.len() / 2;
            let (_, median, _) = self.sizes.select_nth_unstable_by(middle, f64::total_cmp);
            scale = (SIGMA_OVER_MEDIAN * *median).max(1e-3);
            let mut information = Matrix3::zeros();
            let mut vector = Vector3::zeros();
            for row in &mut self.rows {
                let robust = (HUBER * scale / row.weight.max(1e-12)).min(1.0);
                row.weight = robust / (row.sigma_px * row.sigma_px);
                let by = row.by_turn();
                information.ger(row.weight, &by, &by, 1.0);
                vector.axpy(row.weight * row.deviation_px, &by, 1.0);
            }
            turn_rad = information.cholesky()?.solve(&vector);
        }
        Some(scale)
    }

    /// The pitch that the median deviation would be.
    fn middle(&mut self) -> Vector3<f64> {
        self.sizes.clear();
        self.sizes.extend(self.rows.iter().map(|r| r.deviation_px));
        let middle = self.sizes.len() / 2;
        let (_, median, _) = self.sizes.select_nth_unstable_by(middle, f64::total_cmp);
        let median = *median;
        let mean_by: Vector3<f64> =
            self.rows.iter().map(Row::by_turn).sum::<Vector3<f64>>() / self.rows.len() as f64;
        mean_by * (median / mean_by.norm_squared().max(1e-12))
    }
}

/// A match on the rectified plane.
fn row(rig: &StereoRig, rectification: &Rectification, m: &StereoMeasurement) -> Option<Row> {
    let left = rectification.left(&m.left_px())?;
    let right = rectification.right(&m.right_px())?;
    let mut by = SVector::<f64, UNKNOWNS>::zeros();
    by.fixed_rows_mut::<STATICS>(0)
        .copy_from(&terms(rig, &right));
    by.fixed_rows_mut::<3>(STATICS)
        .copy_from(&row_by_turn(rectification, &right).transpose());
    Some(Row {
        by,
        deviation_px: right.y - left.y,
        sigma_px: m.sigma_px[1].hypot(m.sigma_px[3]),
        weight: 1.0,
    })
}

/// 1, x, y, x², xy, y² of a place on the rectified plane, in halves of the image's width.
fn terms(rig: &StereoRig, rectified_px: &Vector2<f64>) -> SVector<f64, STATICS> {
    let at = rectified_px / (0.5 * f64::from(rig.right.width));
    SVector::from([1.0, at.x, at.y, at.x * at.x, at.x * at.y, at.y * at.y])
}

/// Keeps the prior invertible where a calibration is taken as exact, px².
const SMALLEST_VARIANCE_PX2: f64 = 1e-8;
/// For numeric derivatives of the rectified row, px.
const SMALL_PX: f64 = 1e-3;

/// What rows may be missed by from the start: what the rig's stated uncertainty does to points at infinity, else
/// what the settings suppose of each term.
pub(super) fn prior(
    rig: &StereoRig,
    rectification: &Rectification,
    settings: &Settings,
) -> StaticsCovariance {
    let supposed = settings.calibration_sigma_px * settings.calibration_sigma_px;
    let floor = StaticsCovariance::identity() * SMALLEST_VARIANCE_PX2;
    stated(rig, rectification).unwrap_or_else(|| StaticsCovariance::identity() * supposed) + floor
}

fn stated(rig: &StereoRig, rectification: &Rectification) -> Option<StaticsCovariance> {
    let covariance = rig.covariance()?;
    let mut normal = StaticsCovariance::zeros();
    let mut by_rig = SMatrix::<f64, STATICS, RIG_PARAMETERS>::zeros();
    for ray in rig.left.spread_rays() {
        let Some((terms, row_by_rig)) = missed(rig, rectification, &ray.push(0.0)) else {
            continue;
        };
        normal += terms * terms.transpose();
        by_rig += terms * row_by_rig;
    }
    let by_rig = normal.try_inverse()? * by_rig;
    let stated = by_rig * covariance * by_rig.transpose();
    Some((stated + stated.transpose()) * 0.5)
}

/// The terms at a point, and the derivative of what it misses its row by, by the rig's parameters.
fn missed(
    rig: &StereoRig,
    rectification: &Rectification,
    y: &Vector3<f64>,
) -> Option<(SVector<f64, STATICS>, SMatrix<f64, 1, RIG_PARAMETERS>)> {
    let from = Viewpoint::unmoved(rig);
    let px = from.seen_at(rig, y)?;
    let by_rig = sight_by_rig(rig, &from, y)?;
    let misses = |px: &Vector4<f64>| {
        let right = rectification.right(&px.fixed_rows::<2>(2).into_owned())?;
        Some(right.y - rectification.left(&px.fixed_rows::<2>(0).into_owned())?.y)
    };
    let mut by_px = RowVector4::zeros();
    for i in 0..4 {
        let mut moved = Vector4::zeros();
        moved[i] = SMALL_PX;
        by_px[i] = (misses(&(px + moved))? - misses(&(px - moved))?) / (2.0 * SMALL_PX);
    }
    let right = rectification.right(&px.fixed_rows::<2>(2).into_owned())?;
    // Seen by the rig as it is, but rectified by the one that is supposed.
    Some((terms(rig, &right), by_px * by_rig))
}
