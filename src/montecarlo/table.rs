//! Outcomes in, a table for a person and a CSV file out.

use super::verdict::{LEVEL, Part};
use super::{ImagesOutcome, MotionOutcome, OdometryOutcome, TriangulationOutcome, Verdict};
use std::fmt::Write as _;

/// What the three stages found, as far as they were run.
#[derive(Clone, Debug, Default)]
pub struct Outcomes {
    /// Pixels to points.
    pub triangulation: Option<TriangulationOutcome>,
    /// Points to one motion.
    pub motion: Option<MotionOutcome>,
    /// Motions to a path.
    pub odometry: Option<OdometryOutcome>,
    /// Images to a path.
    pub images: Option<ImagesOutcome>,
}

/// One verdict with its name.
struct Row<'a> {
    stage: &'static str,
    /// A depth in m, a step, or nothing.
    at: String,
    verdict: &'a Verdict,
    failed: u64,
}

fn rows(outcomes: &Outcomes) -> Vec<Row<'_>> {
    let mut rows = Vec::new();
    for p in outcomes.triangulation.iter().flat_map(|o| &o.points) {
        rows.push(Row {
            stage: "point",
            at: format!("{:.3}", p.point.z),
            verdict: &p.verdict,
            failed: p.failed,
        });
    }
    if let Some(o) = &outcomes.motion {
        rows.push(Row {
            stage: "motion",
            at: String::new(),
            verdict: &o.verdict,
            failed: o.failed,
        });
    }
    if let Some(o) = &outcomes.odometry {
        rows.push(Row {
            stage: "increment",
            at: String::new(),
            verdict: &o.increments,
            failed: o.failed,
        });
        for (k, verdict) in o.poses.iter().enumerate() {
            rows.push(Row {
                stage: "pose",
                at: (k + 1).to_string(),
                verdict,
                failed: o.failed,
            });
        }
    }
    if let Some(o) = &outcomes.images {
        for (stage, verdict) in [("image increment", &o.increments), ("image pose", &o.last)] {
            rows.push(Row {
                stage,
                at: String::new(),
                verdict,
                failed: o.failed,
            });
        }
    }
    rows
}

/// Every verdict as CSV: one row a point, a motion, all increments, and each pose of the path.
/// Lengths in m, angles in rad; what does not exist is empty.
#[must_use]
pub fn to_csv(outcomes: &Outcomes) -> String {
    let mut out = "stage,at,runs,failed,degrees_of_freedom,anees,anees_low,anees_high,coverage,coverage_low,\
                   coverage_high,sigma_translation_first_order_m,sigma_translation_monte_carlo_m,\
                   trace_ratio_translation,ratio_to_bound_translation,sigma_rotation_first_order_rad,\
                   sigma_rotation_monte_carlo_rad,trace_ratio_rotation,ratio_to_bound_rotation\n"
        .to_owned();
    for row in rows(outcomes) {
        let v = row.verdict;
        // Writing to a `String` cannot fail, here and below.
        let _ = write!(
            out,
            "{},{},{},{},{},{:?},{:?},{:?},{:?},{:?},{:?}",
            row.stage,
            row.at,
            v.runs,
            row.failed,
            v.degrees_of_freedom,
            v.anees,
            v.anees_interval.0,
            v.anees_interval.1,
            v.coverage,
            v.coverage_interval.0,
            v.coverage_interval.1
        );
        for part in [Some(v.translation()), v.rotation()] {
            push_part(&mut out, part.as_ref());
        }
        out.push('\n');
    }
    out
}

fn push_part(out: &mut String, part: Option<&Part>) {
    let Some(p) = part else {
        out.push_str(",,,,");
        return;
    };
    let _ = write!(
        out,
        ",{:?},{:?},{:?},",
        p.sigma_first_order, p.sigma_monte_carlo, p.trace_ratio
    );
    if let Some(ratio) = p.ratio_to_bound {
        let _ = write!(out, "{ratio:?}");
    }
}

/// The same as JSON: a list of objects with the CSV's names and numbers, absent ones `null`.
///
/// # Errors
/// Never for numbers; what serde says otherwise.
pub fn to_json(outcomes: &Outcomes) -> serde_json::Result<String> {
    #[derive(serde::Serialize)]
    struct Object<'a> {
        stage: &'a str,
        at: Option<f64>,
        runs: u64,
        failed: u64,
        degrees_of_freedom: usize,
        anees: f64,
        anees_interval: (f64, f64),
        coverage: f64,
        coverage_interval: (f64, f64),
        translation_m: Part,
        rotation_rad: Option<Part>,
    }
    let rows = rows(outcomes);
    let objects = rows.iter().map(|row| Object {
        stage: row.stage,
        at: row.at.parse().ok(),
        runs: row.verdict.runs,
        failed: row.failed,
        degrees_of_freedom: row.verdict.degrees_of_freedom,
        anees: row.verdict.anees,
        anees_interval: row.verdict.anees_interval,
        coverage: row.verdict.coverage,
        coverage_interval: row.verdict.coverage_interval,
        translation_m: row.verdict.translation(),
        rotation_rad: row.verdict.rotation(),
    });
    let objects: Vec<_> = objects.collect();
    match &outcomes.images {
        None => serde_json::to_string_pretty(&objects),
        Some(images) => serde_json::to_string_pretty(&serde_json::json!({
            "verdicts": objects,
            "sequences": images.sequences,
            "whiteness": { "autocorrelation": images.whiteness.0, "limit": images.whiteness.1 },
        })),
    }
}

/// The table for a person: points, motion, increments, and some of the path's poses.
#[must_use]
pub fn summary_text(outcomes: &Outcomes) -> String {
    let mut out = format!(
        "{:<22} {:>7}  {:>18}  {:>17}  {:>23}  {:>23}  {:>11}\n",
        "",
        "runs",
        "ANEES  [95 %]",
        "coverage of 95 %",
        "σ translation, mm",
        "σ rotation, mdeg",
        "÷ bound"
    );
    let steps = outcomes.odometry.as_ref().map_or(0, |o| o.poses.len());
    for row in rows(outcomes) {
        if row.stage == "pose" && !is_shown(row.at.parse().unwrap_or(0), steps) {
            continue;
        }
        push_line(&mut out, &row);
    }
    let _ = writeln!(
        out,
        "σ: first order / Monte Carlo (trace ratio). An ANEES inside its {:.0} % interval is honest; \
         above is overconfident, below pessimistic.",
        100.0 * LEVEL
    );
    if let Some(o) = &outcomes.images {
        push_sequences(&mut out, o);
    }
    out
}

/// Sequence by sequence, and how far neighbouring motions share errors.
fn push_sequences(out: &mut String, o: &ImagesOutcome) {
    let _ = writeln!(
        out,
        "\n{:<22} {:>6} {:>8} {:>5}  {:>16}  {:>11}",
        "sequence", "seed", "motions", "lost", "ANEES of motions", "NEES/6 end"
    );
    for s in &o.sequences {
        let _ = writeln!(
            out,
            "{:<22} {:>6} {:>8} {:>5}  {:>16.3}  {:>11.3}",
            format!("{}, {}", s.scene, s.trajectory),
            s.seed,
            s.motions,
            s.lost,
            s.anees_of_motions,
            s.nees_of_end
        );
    }
    let (found, limit) = o.whiteness;
    let _ = writeln!(
        out,
        "whiteness of motions: lag-1 autocorrelation {found:+.3}, ±{limit:.3} if they were independent"
    );
}

/// A path's poses that are worth a line: the first, some on the way, the last.
fn is_shown(step: usize, steps: usize) -> bool {
    let every = steps.div_ceil(5).max(1);
    step == 1 || step == steps || step.is_multiple_of(every)
}

fn push_line(out: &mut String, row: &Row<'_>) {
    let v = row.verdict;
    let name = match row.stage {
        "point" => format!(
            "point at {} m",
            row.at.trim_end_matches('0').trim_end_matches('.')
        ),
        "pose" => format!("pose after {} motions", row.at),
        "increment" => "motions of the path".to_owned(),
        "image increment" => "motions, from images".to_owned(),
        "image pose" => "last pose, from images".to_owned(),
        other => other.to_owned(),
    };
    let part = |p: Option<Part>, per: f64| {
        p.map_or_else(String::new, |p| {
            format!(
                "{:.4} /{:.4} ({:.3})",
                per * p.sigma_first_order,
                per * p.sigma_monte_carlo,
                p.trace_ratio
            )
        })
    };
    let bound = match (v.translation().ratio_to_bound, v.rotation()) {
        (
            Some(t),
            Some(Part {
                ratio_to_bound: Some(r),
                ..
            }),
        ) => format!("{t:.2} {r:.2}"),
        _ => String::new(),
    };
    let _ = writeln!(
        out,
        "{name:<22} {:>7}  {:>5.3} [{:.3} {:.3}]  {:>5.3} [{:.3} {:.3}]  {:>23}  {:>23}  {bound:>11}",
        v.runs,
        v.anees,
        v.anees_interval.0,
        v.anees_interval.1,
        v.coverage,
        v.coverage_interval.0,
        v.coverage_interval.1,
        part(Some(v.translation()), 1e3),
        part(v.rotation(), 1e3_f64.to_degrees()),
    );
}
