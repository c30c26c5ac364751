//! A run with truth in, the figures that hold its errors against its covariances out.

use super::figures::{
    BELOW_PX, Figure, HEIGHT_PX, Key, LEFT_PX, RIGHT_PX, TIME_LABEL, TOP_PX, WIDTH_PX, single,
    stacked,
};
use super::plot::{Frame, Panel};
use super::run::{Run, sigma};
use super::scale::{angle_unit, extent, length_unit};
use super::svg;
use crate::evaluation::consistency::{AXES, LEVEL};
use crate::uncertainty::consistency::chi2_quantile;
use nalgebra::Vector6;

/// Of the six panels of [`errors`], each, and between two.
const PANEL_PX: f64 = 112.0;
const GAP_PX: f64 = 14.0;

/// The errors of the pose in six panels, positions left, orientations right.
pub(super) fn errors(run: &Run) -> Option<Figure> {
    let errors = run.errors()?;
    let largest = |first: usize| {
        let three = (first..first + 3).map(|k| largest_of(run, &errors, k));
        three.fold(0.0, f64::max)
    };
    let units = [length_unit(largest(0)), angle_unit(largest(3))];
    let mut content = String::new();
    for k in 0..6 {
        content.push_str(&error_panel(run, &errors, k, units[k / 3]));
    }
    let height = TOP_PX + 3.0 * PANEL_PX + 2.0 * GAP_PX + BELOW_PX;
    Some(Figure {
        title: "Error of the pose against ±3 σ".to_owned(),
        sentence: "Estimate minus truth, positions on the left and rotations on the right, the first \
                   poses brought together; if the covariance holds, a line lies outside its band in \
                   one of 370 independent runs at any given time."
            .to_owned(),
        legend: vec![Key::line("two solid", "error"), Key::area("band", "±3 σ, as published")],
        drawing: svg::drawing(WIDTH_PX, height, "Error of the pose over time", &content),
    })
}

/// The largest error or 3 σ of element `k`.
fn largest_of(run: &Run, errors: &[Option<Vector6<f64>>], k: usize) -> f64 {
    let sigmas = run.rows.iter().map(|row| 3.0 * sigma(&row.cov_pose, k));
    let errors = errors.iter().flatten().map(|error| error[k].abs());
    extent(sigmas.chain(errors)).map_or(0.0, |(_, high)| high)
}

fn error_panel(
    run: &Run,
    errors: &[Option<Vector6<f64>>],
    k: usize,
    (unit, per): (&str, f64),
) -> String {
    let width = 0.5 * (WIDTH_PX - RIGHT_PX) - LEFT_PX;
    let frame = Frame {
        left: LEFT_PX + (k / 3) as f64 * (width + LEFT_PX),
        top: TOP_PX + (k % 3) as f64 * (PANEL_PX + GAP_PX),
        width,
        height: PANEL_PX,
    };
    let most = (1.06 * per * largest_of(run, errors, k)).max(1e-9);
    let mut panel = Panel::new(frame, run.time_span_s(), (-most, most));
    let three_sigma = run.over_time(|row| 3.0 * per * sigma(&row.cov_pose, k));
    let band: Vec<_> = three_sigma.iter().map(|&(time, s)| (time, -s, s)).collect();
    panel.band(&band, "band");
    panel.level(0.0, "rule");
    let errors = errors
        .iter()
        .map(|error| error.map_or(f64::NAN, |error| per * error[k]));
    let line: Vec<_> = run.times_s.iter().copied().zip(errors).collect();
    panel.line(&line, "two solid");
    let x_label = (k % 3 == 2).then_some(TIME_LABEL);
    panel.finish(&format!("{}, {unit}", AXES[k]), x_label)
}

/// The normalised error squared of each motion.
pub(super) fn nees(run: &Run) -> Option<Figure> {
    let consistency = run.evaluation.as_ref()?.consistency.as_ref()?;
    let values = &consistency.increments.nees;
    let tail = 0.5 * (1.0 - LEVEL);
    let (low, high) = (chi2_quantile(tail, 6.0), chi2_quantile(1.0 - tail, 6.0));
    let points: Vec<_> = run
        .times_s
        .iter()
        .zip(values)
        .filter_map(|(time, value)| Some((*time, (*value)?)))
        .collect();
    let (least, most) = extent(points.iter().map(|p| p.1))?;
    // Rare tiny values would stretch a logarithmic axis without saying anything.
    let y = (least.clamp(0.05, low) * 0.7, most.max(high) * 1.6);
    let mut panel = Panel::logarithmic(stacked(0, HEIGHT_PX, 0.0), run.time_span_s(), y);
    panel.level_band(low, high, "band");
    panel.level(6.0, "rule");
    let is_in = |p: &&(f64, f64)| (low..=high).contains(&p.1);
    let inside: Vec<_> = points.iter().filter(is_in).copied().collect();
    let outside: Vec<_> = points.iter().filter(|p| !is_in(p)).copied().collect();
    let radius = if points.len() > 1000 { 1.6 } else { 2.6 };
    panel.dots(&inside, radius, "points");
    panel.dots(&outside, radius + 0.8, "outside");
    let share = 100.0 * inside.len() as f64 / points.len() as f64;
    Some(Figure {
        title: "Normalised error of each motion (NEES)".to_owned(),
        sentence: format!(
            "Squared error of each motion in units of its own covariance, six degrees of freedom: of \
             honest motions 95 in 100 lie in the band, and their mean is 6 (dashed). Here {share:.1} % \
             lie inside. Far above is overconfident, far below is pessimistic."
        ),
        legend: vec![
            Key::dot("points", &format!("inside ({})", inside.len())),
            Key::dot("outside", &format!("outside ({})", outside.len())),
            Key::area("band", "95 % of χ² with 6 degrees of freedom"),
        ],
        drawing: single(panel, "NEES", TIME_LABEL, "NEES of the motions over time"),
    })
}
