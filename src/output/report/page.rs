//! Facts and figures in, the page out.

use super::facts::{facts, summary};
use super::figures::{Figure, Key, Mark};
use super::run::Run;
use super::svg::escape;
use std::fmt::Write as _;

/// What pages and drawings look like, in light and dark and on paper.
pub(crate) const STYLE: &str = include_str!("style.css");
/// Zoom and pan, for those who want it.
pub(crate) const SCRIPT: &str = include_str!("script.js");

/// Hatchings, so that states differ without colour.
pub(crate) const PATTERNS: &str = r#"<svg class="patterns" aria-hidden="true"><defs>
<pattern id="degraded" width="7" height="7" patternUnits="userSpaceOnUse"><rect class="warn" width="7" height="7"/><path class="ink" d="M-1,8L8,-1M-1,1L1,-1M6,8L8,6"/></pattern>
<pattern id="lost" width="7" height="7" patternUnits="userSpaceOnUse"><rect class="bad" width="7" height="7"/><path class="ink" d="M0,0L7,7M7,0L0,7"/></pattern>
<pattern id="part2" width="6" height="6" patternUnits="userSpaceOnUse"><rect class="two" width="6" height="6"/><path class="paper" d="M-1,7L7,-1M-1,1L1,-1M5,7L7,5"/></pattern>
<pattern id="part3" width="5" height="5" patternUnits="userSpaceOnUse"><rect class="three" width="5" height="5"/><circle class="paper" cx="2.5" cy="2.5" r="0.9"/></pattern>
<pattern id="part4" width="6" height="6" patternUnits="userSpaceOnUse"><rect class="four" width="6" height="6"/><path class="paper" d="M3,0V6M0,3H6"/></pattern>
</defs></svg>
"#;

/// The whole page.
pub(super) fn page(title: &str, run: &Run, figures: &[Figure]) -> String {
    let title = escape(title);
    let mut out = String::new();
    // Writing to a `String` cannot fail, here and below.
    let _ = write!(
        out,
        "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
         <meta name=\"generator\" content=\"visod {version}\">\n<title>{title}</title>\n\
         <style>\n{style}</style>\n</head>\n<body>\n{PATTERNS}<header>\n<h1>{title}</h1>\n\
         <p class=\"summary\">{summary}</p>\n</header>\n",
        version = env!("CARGO_PKG_VERSION"),
        style = STYLE,
        summary = escape(&summary(run)),
    );
    push_facts(&mut out, run);
    out.push_str("<main>\n");
    for figure in figures {
        push_figure(&mut out, figure);
    }
    if let Some(evaluation) = &run.evaluation {
        let table = escape(&evaluation.to_string());
        let _ = write!(
            out,
            "<details>\n<summary>All numbers of the evaluation</summary>\n<pre>{table}</pre>\n</details>\n"
        );
    }
    let _ = write!(
        out,
        "</main>\n<footer>\n<p>Positions are those of the left camera, in its own axes at the start: x right, \
         y down, z forward. σ is one standard deviation. In a plane, the 1 σ ellipse holds 39 % and the \
         3 σ ellipse 98.9 % of Gaussian errors. Written by visod {}.</p>\n</footer>\n\
         <script>\n{}</script>\n</body>\n</html>\n",
        env!("CARGO_PKG_VERSION"),
        SCRIPT
    );
    out
}

fn push_facts(out: &mut String, run: &Run) {
    out.push_str("<dl class=\"facts\">\n");
    for fact in facts(run) {
        let _ = write!(
            out,
            "<div class=\"fact{}\"><dt>{}</dt><dd>{}</dd>",
            if fact.wide { " wide" } else { "" },
            escape(fact.name),
            escape(&fact.value)
        );
        if !fact.note.is_empty() {
            let _ = write!(out, "<dd class=\"note\">{}</dd>", escape(&fact.note));
        }
        out.push_str("</div>\n");
    }
    out.push_str("</dl>\n");
}

pub(crate) fn push_figure(out: &mut String, figure: &Figure) {
    let _ = write!(
        out,
        "<figure>\n<figcaption>\n<h2>{}</h2>\n<p>{}</p>\n<ul class=\"legend\">\n",
        escape(&figure.title),
        escape(&figure.sentence)
    );
    for key in &figure.legend {
        let _ = writeln!(out, "<li>{}{}</li>", sample(key), escape(&key.words));
    }
    let _ = write!(
        out,
        "</ul>\n</figcaption>\n<div class=\"sheet\">\n{}</div>\n</figure>\n",
        figure.drawing
    );
}

/// What an entry of the legend looks like in the figure.
pub(crate) fn sample(key: &Key) -> String {
    let shape = match key.mark {
        Mark::Line => "<line class=\"CLASS\" x1=\"2\" y1=\"7\" x2=\"32\" y2=\"7\"/>",
        Mark::Area => "<rect class=\"CLASS\" x=\"2\" y=\"1\" width=\"30\" height=\"12\"/>",
        Mark::Dot => "<circle class=\"CLASS\" cx=\"17\" cy=\"7\" r=\"3.5\"/>",
    };
    let shape = shape.replace("CLASS", &key.class);
    format!("<svg viewBox=\"0 0 34 14\" aria-hidden=\"true\">{shape}</svg>")
}
