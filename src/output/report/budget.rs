//! A run in, what its error budget was made of over time out.

use super::figures::{BELOW_PX, Figure, Key, TIME_LABEL, TOP_PX, WIDTH_PX, stacked};
use super::plot::Panel;
use super::run::Run;
use super::svg;
use crate::output::row::OdometryRow;

/// The parts in the order of [`OdometryRow::budget_sigmas`]: class of the area, and words.
const PARTS: [(&str, &str); 4] = [
    ("part1", "detection of keypoints"),
    ("part2", "calibration of the rig"),
    ("part3", "synchronisation of the images"),
    ("part4", "bridging of lost pairs"),
];
const PANEL_PX: f64 = 130.0;
const GAP_PX: f64 = 16.0;

/// Shares of the pose's variance by source; `None` where no row has a budget.
pub(super) fn shares(run: &Run) -> Option<Figure> {
    let has_budget = |row: &OdometryRow| row.budget_sigmas.iter().any(|s| *s > 0.0);
    if !run.rows.iter().any(has_budget) {
        return None;
    }
    let content = panel(run, 0).finish("position, %", None)
        + &panel(run, 1).finish("orientation, %", Some(TIME_LABEL));
    let height = TOP_PX + 2.0 * PANEL_PX + GAP_PX + BELOW_PX;
    Some(Figure {
        title: "Where the uncertainty comes from".to_owned(),
        sentence:
            "The pose's variance by its source, in per cent of the whole: what would have to \
                   become better for the pose to be better known."
                .to_owned(),
        legend: PARTS
            .iter()
            .map(|(class, words)| Key::area(class, words))
            .collect(),
        drawing: svg::drawing(WIDTH_PX, height, "Error budget over time", &content),
    })
}

/// Position (0) or orientation (1).
fn panel(run: &Run, index: usize) -> Panel {
    let frame = stacked(index, PANEL_PX, GAP_PX);
    let mut panel = Panel::new(frame, run.time_span_s(), (0.0, 100.0));
    let sums: Vec<[f64; 5]> = run.rows.iter().map(|row| sums(row, 3 * index)).collect();
    for (i, (class, _)) in PARTS.iter().enumerate() {
        let edges = run.times_s.iter().zip(&sums);
        let band: Vec<_> = edges
            .map(|(time, sums)| (*time, sums[i], sums[i + 1]))
            .collect();
        // A part that is nowhere is no hairline either.
        if sums.iter().any(|sums| sums[i + 1] - sums[i] > 1e-9) {
            panel.band(&band, class);
        }
    }
    panel
}

/// Shares of the parts in the variance of three coordinates from `first` on, per cent, summed up: 0 comes
/// first and 100 last. Not numbers where there is no variance.
fn sums(row: &OdometryRow, first: usize) -> [f64; 5] {
    let variance = |part: usize| -> f64 {
        let sigmas = &row.budget_sigmas[6 * part + first..][..3];
        sigmas.iter().map(|s| s * s).sum()
    };
    let total: f64 = (0..PARTS.len()).map(variance).sum();
    let mut sums = [0.0; 5];
    for part in 0..PARTS.len() {
        sums[part + 1] = sums[part] + variance(part);
    }
    if total > 0.0 {
        sums.map(|sum| 100.0 * sum / total)
    } else {
        [f64::NAN; 5]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::output::row::tests::sample_odometry;

    #[test]
    fn shares_are_of_variances_and_end_at_the_whole() {
        let mut row = OdometryRow::new(&sample_odometry(3), None);
        row.budget_sigmas = [0.0; 24];
        row.budget_sigmas[0] = 3.0;
        row.budget_sigmas[7] = 4.0;
        assert_eq!(sums(&row, 0), [0.0, 36.0, 100.0, 100.0, 100.0]);
        assert!(sums(&row, 3).iter().all(|s| s.is_nan()));
    }
}
