//! A run in, its figures over time and distance out.

use super::plot::{Frame, Panel};
use super::run::{Run, sigma};
use super::scale::{angle_unit, extent, length_unit};
use super::svg;
use super::{against_truth, budget};
use crate::estimation::Status;

/// Width of every drawing, px.
pub(crate) const WIDTH_PX: f64 = 960.0;
pub(crate) const LEFT_PX: f64 = 76.0;
pub(crate) const RIGHT_PX: f64 = 16.0;
pub(crate) const TOP_PX: f64 = 8.0;
pub(super) const HEIGHT_PX: f64 = 200.0;
/// Below a panel that shows its x axis.
pub(crate) const BELOW_PX: f64 = 48.0;
pub(super) const TIME_LABEL: &str = "time since the first pair, s";
/// Classes of the lines x, y, z: they differ in colour and in dashes.
const LINES: [&str; 3] = ["one", "two", "three"];

/// A drawing with its words.
pub(crate) struct Figure {
    pub title: String,
    /// What it shows, in a sentence or two.
    pub sentence: String,
    pub legend: Vec<Key>,
    pub drawing: String,
}

/// An entry of a legend.
pub(crate) struct Key {
    pub class: String,
    pub mark: Mark,
    pub words: String,
}

/// What an entry's sample looks like.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Mark {
    Line,
    Area,
    Dot,
}

impl Key {
    fn new(mark: Mark, class: &str, words: &str) -> Self {
        Self {
            class: class.to_owned(),
            mark,
            words: words.to_owned(),
        }
    }

    pub(crate) fn line(class: &str, words: &str) -> Self {
        Self::new(Mark::Line, class, words)
    }

    pub(crate) fn area(class: &str, words: &str) -> Self {
        Self::new(Mark::Area, class, words)
    }

    pub(crate) fn dot(class: &str, words: &str) -> Self {
        Self::new(Mark::Dot, class, words)
    }
}

/// Every figure but the map, in the order of the page.
pub(super) fn all(run: &Run) -> Vec<Figure> {
    let mut figures = vec![status(run), height(run)];
    figures.extend(against_truth::errors(run));
    figures.extend(against_truth::nees(run));
    figures.push(sigmas(run));
    figures.extend(budget::shares(run));
    figures.push(counts(run));
    figures.extend(variance_factor(run));
    figures.extend(latency(run));
    figures
}

/// The frame of the `index`th panel of a stack, each `height` px with `gap` px between.
pub(super) fn stacked(index: usize, height: f64, gap: f64) -> Frame {
    Frame {
        left: LEFT_PX,
        top: TOP_PX + index as f64 * (height + gap),
        width: WIDTH_PX - LEFT_PX - RIGHT_PX,
        height,
    }
}

/// A drawing of one panel.
pub(super) fn single(panel: Panel, y_label: &str, x_label: &str, label: &str) -> String {
    let content = panel.finish(y_label, Some(x_label));
    svg::drawing(WIDTH_PX, TOP_PX + HEIGHT_PX + BELOW_PX, label, &content)
}

/// From `low` (or the least value) to a little above the largest.
fn domain(values: impl IntoIterator<Item = f64>, low: Option<f64>) -> (f64, f64) {
    let (least, most) = extent(values).unwrap_or((0.0, 1.0));
    let least = low.map_or(least, |low| low.min(least));
    let margin = 0.06 * (most - least);
    let below = if low.is_some() { 0.0 } else { margin };
    (least - below, most + margin)
}

fn status(run: &Run) -> Figure {
    let frame = Frame {
        height: 30.0,
        ..stacked(0, 0.0, 0.0)
    };
    let (begin, end) = run.time_span_s();
    let mut panel = Panel::new(frame, (begin, end), (0.0, 1.0));
    for (status, first, after) in run.stretches(|row| row.status) {
        // A row stands for the time since the row before it.
        let from = run.times_s[first.saturating_sub(1)];
        let class = format!("is-{}", status.as_str());
        panel.span(from, run.times_s[after - 1], &class);
    }
    let content = panel.finish_strip(TIME_LABEL);
    let count = |wanted| run.rows.iter().filter(|row| row.status == wanted).count();
    let legend = [
        Status::Initializing,
        Status::Tracking,
        Status::Degraded,
        Status::Lost,
    ]
    .into_iter()
    .map(|status| {
        let words = format!("{} ({})", status.as_str(), count(status));
        Key::area(&format!("is-{}", status.as_str()), &words)
    })
    .collect();
    Figure {
        title: "Status".to_owned(),
        sentence:
            "Whether each motion was measured well, measured from little, or had to be bridged."
                .to_owned(),
        legend,
        drawing: svg::drawing(
            WIDTH_PX,
            TOP_PX + 30.0 + BELOW_PX,
            "Status over time",
            &content,
        ),
    }
}

fn height(run: &Run) -> Figure {
    // The camera's y axis points down.
    let heights = || {
        run.rows
            .iter()
            .map(|row| -row.odom_from_camera.translation.y)
    };
    let band = |sigmas: f64| -> Vec<_> {
        let rows = run.path_m.iter().zip(run.rows).zip(heights());
        rows.map(|((path, row), height)| {
            let reach = sigmas * sigma(&row.cov_pose, 1);
            (*path, height - reach, height + reach)
        })
        .collect()
    };
    let (one_sigma, three_sigma) = (band(1.0), band(3.0));
    let truth: Vec<_> = run.truth.as_ref().map_or_else(Vec::new, |truth| {
        let heights = truth
            .iter()
            .map(|pose| pose.map_or(f64::NAN, |pose| -pose.translation.y));
        run.path_m.iter().copied().zip(heights).collect()
    });
    let shown = three_sigma.iter().flat_map(|p| [p.1, p.2]).chain(heights());
    let end_m = run.path_m.last().copied().unwrap_or(0.0);
    let y = domain(shown.chain(truth.iter().map(|p| p.1)), None);
    let mut panel = Panel::new(stacked(0, HEIGHT_PX, 0.0), (0.0, end_m), y);
    panel.band(&three_sigma, "band");
    panel.band(&one_sigma, "band");
    panel.line(&truth, "truth");
    let points: Vec<_> = run.path_m.iter().copied().zip(heights()).collect();
    panel.line(&points, "one");
    let mut legend = vec![
        Key::line("one", "estimate"),
        Key::area("band", "±1 σ and, lighter, ±3 σ"),
    ];
    if run.truth.is_some() {
        legend.push(Key::line("truth", "truth"));
    }
    Figure {
        title: "Height over distance".to_owned(),
        sentence:
            "How far the camera rose above where it began, against its vertical axis at the start."
                .to_owned(),
        legend,
        drawing: single(
            panel,
            "height, m",
            "distance travelled, m",
            "Height over distance",
        ),
    }
}

fn sigmas(run: &Run) -> Figure {
    let panel_of = |first: usize, index: usize, unit: f64| {
        let series: Vec<Vec<(f64, f64)>> = (first..first + 3)
            .map(|k| run.over_time(|row| unit * sigma(&row.cov_pose, k)))
            .collect();
        let y = domain(series.iter().flatten().map(|p| p.1), Some(0.0));
        let mut panel = Panel::new(stacked(index, 150.0, 16.0), run.time_span_s(), y);
        for (points, class) in series.iter().zip(LINES) {
            panel.line(points, class);
        }
        panel
    };
    let largest = |first: usize| {
        let all = run.rows.iter();
        let sigmas = all.flat_map(|row| (first..first + 3).map(|k| sigma(&row.cov_pose, k)));
        extent(sigmas).map_or(0.0, |(_, high)| high)
    };
    let (length, per_m) = length_unit(largest(0));
    let (angle, per_rad) = angle_unit(largest(3));
    let content = panel_of(0, 0, per_m).finish(&format!("position, {length}"), None)
        + &panel_of(3, 1, per_rad).finish(&format!("orientation, {angle}"), Some(TIME_LABEL));
    Figure {
        title: "Published uncertainty of the pose, 1 σ".to_owned(),
        sentence:
            "What the odometry says of its own error, axis by axis. It accumulates; a position's \
                   σ falls only where the way turns back and an error of heading weighs less again."
                .to_owned(),
        legend: [("x", "right"), ("y", "down"), ("z", "forward")]
            .iter()
            .zip(LINES)
            .map(|((axis, way), class)| {
                Key::line(class, &format!("along {axis} ({way}), and about it"))
            })
            .collect(),
        drawing: svg::drawing(WIDTH_PX, TOP_PX + 316.0 + BELOW_PX, "σ over time", &content),
    }
}

fn counts(run: &Run) -> Figure {
    let series = [
        (
            "four",
            "keypoints, left image",
            run.over_time(|r| f64::from(r.counts.keypoints_left)),
        ),
        (
            "three",
            "left–right matches",
            run.over_time(|r| f64::from(r.counts.stereo_matches)),
        ),
        (
            "two",
            "tracks from the pair before",
            run.over_time(|r| f64::from(r.counts.tracks)),
        ),
        (
            "one",
            "inliers of the estimate",
            run.over_time(|r| f64::from(r.counts.inliers)),
        ),
    ];
    let y = domain(
        series.iter().flat_map(|s| s.2.iter().map(|p| p.1)),
        Some(0.0),
    );
    let mut panel = Panel::new(stacked(0, HEIGHT_PX, 0.0), run.time_span_s(), y);
    for (class, _, points) in &series {
        panel.line(points, class);
    }
    Figure {
        title: "What each estimate rests on".to_owned(),
        sentence:
            "How many keypoints were found, matched between the two images, followed from the \
                   pair before, and used: a fall of one line alone names the stage that struggled."
                .to_owned(),
        legend: series
            .iter()
            .map(|(class, words, _)| Key::line(class, words))
            .collect(),
        drawing: single(panel, "count", TIME_LABEL, "Counts over time"),
    }
}

fn variance_factor(run: &Run) -> Option<Figure> {
    let points = run.over_time(|row| row.variance_factor);
    extent(points.iter().map(|p| p.1))?;
    let y = domain(points.iter().map(|p| p.1).chain([1.0]), Some(0.0));
    let mut panel = Panel::new(stacked(0, HEIGHT_PX, 0.0), run.time_span_s(), y);
    panel.level(1.0, "rule");
    panel.line(&points, "one");
    Some(Figure {
        title: "Variance factor".to_owned(),
        sentence:
            "Size of the squared residuals against what the noise model expects: 1 (dashed) when \
                   it is right, above when images are noisier than it says."
                .to_owned(),
        legend: vec![Key::line("one", "a-posteriori variance factor")],
        drawing: single(
            panel,
            "variance factor",
            TIME_LABEL,
            "Variance factor over time",
        ),
    })
}

fn latency(run: &Run) -> Option<Figure> {
    let points = run.over_time(|row| row.latency_ms.unwrap_or(f64::NAN));
    extent(points.iter().map(|p| p.1))?;
    let y = domain(points.iter().map(|p| p.1), Some(0.0));
    let mut panel = Panel::new(stacked(0, HEIGHT_PX, 0.0), run.time_span_s(), y);
    panel.line(&points, "one");
    Some(Figure {
        title: "Latency".to_owned(),
        sentence: "Time from the complete pair of images to the estimate.".to_owned(),
        legend: vec![Key::line("one", "latency")],
        drawing: single(panel, "latency, ms", TIME_LABEL, "Latency over time"),
    })
}
