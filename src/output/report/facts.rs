//! A run in, its headline out: one sentence and the numbers that matter.

use super::run::{Run, sigma};
use super::scale::{brief, length_unit};
use crate::evaluation::consistency::Verdict;
use crate::evaluation::{Evaluation, StatusCounts};

/// A number with its name and a remark.
pub(super) struct Fact {
    pub name: &'static str,
    pub value: String,
    pub note: String,
    /// Whether the value is a long one.
    pub wide: bool,
}

impl Fact {
    fn new(name: &'static str, value: String, note: String) -> Self {
        Self {
            name,
            value,
            note,
            wide: false,
        }
    }
}

/// The run in a sentence or two.
pub(super) fn summary(run: &Run) -> String {
    let status = StatusCounts::of(run.rows);
    let measured = status.tracking + status.degraded;
    let motions = measured + status.lost;
    let mut text = format!(
        "{measured} of {motions} motions were measured over {} m.",
        brief(run.path_m.last().copied().unwrap_or(0.0))
    );
    if let Some(evaluation) = &run.evaluation {
        let (end, percent) = end_error(evaluation);
        text.push_str(&format!(" The path ends {end} from the truth{percent}."));
        let full = evaluation
            .consistency
            .as_ref()
            .and_then(|c| c.increments.full);
        match full.map(|full| full.verdict) {
            Some(Verdict::Consistent) => {
                text.push_str(" The errors of the motions are as large as their covariances say.")
            }
            Some(Verdict::Overconfident) => {
                text.push_str(" The errors of the motions are larger than their covariances say.");
            }
            Some(Verdict::Pessimistic) => {
                text.push_str(" The errors of the motions are smaller than their covariances say.");
            }
            None => {}
        }
    }
    text
}

/// The numbers of the headline.
pub(super) fn facts(run: &Run) -> Vec<Fact> {
    let mut facts = about_the_run(run);
    facts.push(end_position(run));
    if let Some(evaluation) = &run.evaluation {
        facts.extend(about_the_errors(evaluation));
    }
    facts.extend(latency(run));
    facts
}

fn about_the_run(run: &Run) -> Vec<Fact> {
    let status = StatusCounts::of(run.rows);
    let (begin, end) = run.time_span_s();
    let duration_s = end - begin;
    let rate = match duration_s > 0.0 {
        true => format!(
            "{} pairs a second",
            brief((run.rows.len() - 1) as f64 / duration_s)
        ),
        false => String::new(),
    };
    let restarts = run.stretches(|row| row.epoch).len() - 1;
    let pairs = match restarts {
        0 => format!("{} initializing", status.initializing),
        1 => "the odometry frame began anew once".to_owned(),
        n => format!("the odometry frame began anew {n} times"),
    };
    vec![
        Fact::new("Stereo pairs", run.rows.len().to_string(), pairs),
        Fact::new(
            "Distance",
            format!("{} m", brief(run.path_m.last().copied().unwrap_or(0.0))),
            "along the estimated path".to_owned(),
        ),
        Fact::new("Duration", format!("{} s", brief(duration_s)), rate),
        Fact::new(
            "Lost / degraded",
            format!("{} / {}", status.lost, status.degraded),
            format!("of {} pairs", run.rows.len()),
        ),
    ]
}

fn end_position(run: &Run) -> Fact {
    let end = run.end();
    let sigmas_m: Vec<f64> = (0..3).map(|k| sigma(&end.cov_pose, k)).collect();
    let largest_m = sigmas_m.iter().copied().fold(0.0, f64::max);
    let (unit, per_m) = length_unit(largest_m);
    let position: Vec<String> = end
        .odom_from_camera
        .translation
        .vector
        .iter()
        .map(|x| super::scale::number(*x, 2))
        .collect();
    let sigmas: Vec<String> = sigmas_m
        .iter()
        .map(|s| format!("±{}", brief(per_m * s)))
        .collect();
    Fact {
        name: "End position x, y, z",
        value: format!("{} m", position.join(", ")),
        note: format!("1 σ: {} {unit}", sigmas.join(", ")),
        wide: true,
    }
}

fn about_the_errors(evaluation: &Evaluation) -> Vec<Fact> {
    let mut facts = Vec::new();
    let pose = evaluation.consistency.as_ref().map(|c| &c.pose);
    let (end, percent) = end_error(evaluation);
    let ellipsoid = match pose.and_then(|pose| pose.end) {
        Some(end) if end.nees <= end.nees_limit => "; inside its 95 % ellipsoid",
        Some(_) => "; outside its 95 % ellipsoid",
        None => "",
    };
    let note = format!("{}{ellipsoid}", percent.trim_start_matches(", "));
    facts.push(Fact::new("End position error", end, note));
    let segments = &evaluation.segments;
    if let (Some(drift), Some(turn)) = (
        segments.all.translation_percent,
        segments.all.rotation_deg_per_m,
    ) {
        let lengths = segments.by_length.iter().filter(|l| l.segments > 0);
        let lengths: Vec<f64> = lengths.filter_map(|l| l.length_m).collect();
        let span = match (lengths.first(), lengths.last()) {
            (Some(a), Some(b)) if a != b => format!("{a} to {b} m"),
            (Some(a), _) => format!("{a} m"),
            _ => String::new(),
        };
        facts.push(Fact::new(
            "Drift",
            format!("{} %", brief(drift)),
            format!(
                "and {} deg/m, mean of {} segments of {span}",
                brief(turn),
                segments.all.segments
            ),
        ));
    }
    if let Some(full) = evaluation
        .consistency
        .as_ref()
        .and_then(|c| c.increments.full)
    {
        facts.push(Fact::new(
            "Motion ANEES",
            brief(full.anees),
            format!(
                "{}; 95 % interval {:.3} to {:.3}",
                full.verdict, full.interval.0, full.interval.1
            ),
        ));
    }
    facts
}

/// The distance at the end, and its share of the path in words.
fn end_error(evaluation: &Evaluation) -> (String, String) {
    let (unit, per_m) = length_unit(evaluation.end_error_m);
    let end = format!("{} {unit}", brief(per_m * evaluation.end_error_m));
    let percent = 100.0 * evaluation.end_error_m / evaluation.path_m;
    match percent.is_finite() {
        true => (end, format!(", {} % of the true path", brief(percent))),
        false => (end, String::new()),
    }
}

fn latency(run: &Run) -> Option<Fact> {
    let mut all: Vec<f64> = run
        .rows
        .iter()
        .filter_map(|row| row.latency_ms)
        .filter(|ms| ms.is_finite())
        .collect();
    all.sort_by(f64::total_cmp);
    let largest = all.last()?;
    let median = all[all.len() / 2];
    Some(Fact::new(
        "Latency",
        format!("{} ms", brief(median)),
        format!("median; at most {} ms", brief(*largest)),
    ))
}
