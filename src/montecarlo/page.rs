//! Outcomes in, files out: each figure as SVG, and all of them as one HTML page.

use super::figures::{self, Drawing};
use super::table::summary_text;
use super::{Outcomes, Settings};
use crate::output::report::figures::WIDTH_PX;
use crate::output::report::page::{SCRIPT, STYLE, push_figure, sample};
use crate::output::report::svg::escape;
use std::fmt::Write as _;

/// A file to be written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FigureFile {
    /// Its name.
    pub name: String,
    /// What it holds.
    pub content: String,
}

/// The figures as SVG files and as one HTML page, montecarlo.html. All are self-contained: they need
/// no network and no script.
#[must_use]
pub fn figure_files(outcomes: &Outcomes, settings: &Settings) -> Vec<FigureFile> {
    let drawings = figures::all(outcomes);
    let mut files: Vec<FigureFile> = drawings
        .iter()
        .map(|drawing| FigureFile {
            name: format!("{}.svg", drawing.name),
            content: standalone(drawing),
        })
        .collect();
    files.push(FigureFile {
        name: "montecarlo.html".to_owned(),
        content: page(outcomes, settings, &drawings),
    });
    files
}

/// Room above a drawing for its title and its legend, px.
const HEAD_PX: f64 = 56.0;
/// Width of a letter, px, for the places of a legend's entries.
const LETTER_PX: f64 = 7.2;

/// A figure as a file of its own.
fn standalone(drawing: &Drawing) -> String {
    let figure = &drawing.figure;
    let height = drawing.height_px + HEAD_PX;
    let mut out = String::new();
    // Writing to a `String` cannot fail, here and below.
    let _ = write!(
        out,
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{WIDTH_PX}\" height=\"{height}\" \
         viewBox=\"0 0 {WIDTH_PX} {height}\" role=\"img\" aria-label=\"{title}\">\n<style>\n{STYLE}\
         svg {{ font-family: system-ui, -apple-system, \"Segoe UI\", \"Noto Sans\", \"DejaVu Sans\", sans-serif; }}\n\
         svg .title {{ font-size: 17px; font-weight: 650; }}\nsvg .paper {{ fill: var(--paper); }}\n</style>\n\
         <rect class=\"paper\" width=\"{WIDTH_PX}\" height=\"{height}\"/>\n\
         <text class=\"title\" x=\"12\" y=\"22\">{title}</text>\n",
        title = escape(&figure.title),
    );
    let mut x = 12.0;
    for key in &figure.legend {
        let mark = sample(key).replace("<svg ", "<svg width=\"34\" height=\"14\" ");
        let _ = writeln!(
            out,
            "<g transform=\"translate({x:.0} 33)\">{mark}<text x=\"41\" y=\"12\">{}</text></g>",
            escape(&key.words)
        );
        x += 60.0 + LETTER_PX * key.words.chars().count() as f64;
    }
    // The page's own class would stretch an inner drawing.
    let inner = figure.drawing.replacen(
        "<svg class=\"plot\"",
        &format!(
            "<svg y=\"{HEAD_PX}\" width=\"{WIDTH_PX}\" height=\"{}\"",
            drawing.height_px
        ),
        1,
    );
    out.push_str(&inner);
    out.push_str("</svg>\n");
    out
}

fn page(outcomes: &Outcomes, settings: &Settings, drawings: &[Drawing]) -> String {
    let mut out = String::new();
    let _ = write!(
        out,
        "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
         <meta name=\"generator\" content=\"visod {version}\">\n<title>Monte Carlo against first order</title>\n\
         <style>\n{STYLE}</style>\n</head>\n<body>\n<header>\n<h1>Monte Carlo against first order</h1>\n\
         <p class=\"summary\">{summary}</p>\n<p>{what}</p>\n</header>\n<main>\n",
        version = env!("CARGO_PKG_VERSION"),
        summary = escape(&verdict_sentence(outcomes)),
        what = escape(&what_was_run(settings)),
    );
    for drawing in drawings {
        push_figure(&mut out, &drawing.figure);
    }
    let _ = write!(
        out,
        "<details open>\n<summary>All numbers</summary>\n<pre>{}</pre>\n</details>\n</main>\n<footer>\n\
         <p>Frames: left camera, x right, y down, z forward. Landmarks are drawn once; every run measures them \
         anew. Written by visod {}.</p>\n</footer>\n<script>\n{SCRIPT}</script>\n</body>\n</html>\n",
        escape(&summary_text(outcomes)),
        env!("CARGO_PKG_VERSION"),
    );
    out
}

fn verdict_sentence(outcomes: &Outcomes) -> String {
    let verdicts = [
        ("one motion", outcomes.motion.as_ref().map(|o| &o.verdict)),
        (
            "the path's end",
            outcomes.odometry.as_ref().map(|o| o.last()),
        ),
    ];
    let mut words = Vec::new();
    if let Some(points) = &outcomes.triangulation {
        let good = points
            .points
            .iter()
            .filter(|p| p.verdict.is_consistent())
            .count();
        words.push(format!(
            "Points: ANEES of {good} of {} inside its 95 % interval.",
            points.points.len()
        ));
    }
    for (name, verdict) in verdicts {
        let Some(v) = verdict else { continue };
        let judged = match v.anees {
            a if a > v.anees_interval.1 => "overconfident",
            a if a < v.anees_interval.0 => "pessimistic",
            _ => "honest",
        };
        words.push(format!(
            "The covariance of {name} is {judged}: ANEES {:.3}, interval {:.3} to {:.3}, {:.1} % inside the 95 % ellipsoid.",
            v.anees, v.anees_interval.0, v.anees_interval.1, 100.0 * v.coverage
        ));
    }
    words.join(" ")
}

fn what_was_run(s: &Settings) -> String {
    format!(
        "{} runs, seed {}; {} features a motion at {} to {} m, survival {}; {} motions of {} m with a turn of \
         {:.2}° each; noise {:?}, stated σ {} px; {:?} estimator, {:?} motions, rig error: {:?}.",
        s.runs,
        s.seed,
        s.features,
        s.depth_m[0],
        s.depth_m[1],
        s.survival,
        s.steps,
        s.step_m,
        s.turn_rad.to_degrees(),
        s.noise,
        s.stated_sigma_px(),
        s.estimator,
        s.model,
        s.rig_error
    )
}
