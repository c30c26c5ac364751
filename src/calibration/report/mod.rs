//! Report: a calibration in; one self-contained HTML page out.
//!
//! The page looks and is built as that of a run: it needs no network and no script.

mod figures;

use super::Calibration;
use crate::geometry::Distortion;
use crate::geometry::rig_parameters::{CAMERA_PARAMETERS, EXTRINSICS};
use crate::geometry::so3;
use crate::output::report::page::{SCRIPT, STYLE, push_figure};
use crate::output::report::scale::{brief, number};
use crate::output::report::svg::escape;
use std::fmt::Write as _;

/// How this page's own elements look.
const OWN_STYLE: &str = include_str!("style.css");

/// The parameters that were estimated: name, value, 1 σ. Angles in rad, lengths in m, image positions in px.
#[must_use]
pub fn parameters(found: &Calibration) -> Vec<(String, f64, f64)> {
    let rig = &found.rig;
    let names = rig.parameter_names();
    let turn = so3::log(&rig.right_from_left.rotation);
    let value = |slot: usize| match slot {
        slot if slot >= EXTRINSICS + 3 => turn[slot - EXTRINSICS - 3],
        slot if slot >= EXTRINSICS => rig.right_from_left.translation.vector[slot - EXTRINSICS],
        slot => {
            let camera = if slot < CAMERA_PARAMETERS {
                &rig.left
            } else {
                &rig.right
            };
            match slot % CAMERA_PARAMETERS {
                i @ 0..=1 => camera.focal_px[i],
                i @ 2..=3 => camera.principal_point_px[i - 2],
                i => match camera.distortion() {
                    Distortion::None => 0.0,
                    Distortion::Radtan(k) => k[i - 4],
                    Distortion::Equidistant(k) => k.get(i - 4).copied().unwrap_or(0.0),
                },
            }
        }
    };
    let of = |slot: &usize| {
        let (name, _) = names.iter().find(|(_, i)| i == slot)?;
        Some((name.clone(), value(*slot), found.sigma(*slot)))
    };
    found.free.iter().filter_map(of).collect()
}

/// The whole page; `not_seen` names the pairs in which the board was not found.
#[must_use]
pub fn render(found: &Calibration, not_seen: &[String]) -> String {
    let mut out = String::new();
    // Writing to a `String` cannot fail, here and below.
    let _ = write!(
        out,
        "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
         <meta name=\"generator\" content=\"visod {version}\">\n<title>Calibration of a stereo rig</title>\n\
         <style>\n{STYLE}{OWN_STYLE}</style>\n</head>\n<body>\n<header>\n<h1>Calibration of a stereo rig</h1>\n\
         <p class=\"summary\">{summary}</p>\n</header>\n",
        version = env!("CARGO_PKG_VERSION"),
        summary = escape(&summary(found)),
    );
    push_facts(&mut out, found);
    push_advice(&mut out, found);
    push_left_out(&mut out, found, not_seen);
    out.push_str("<main>\n");
    for figure in figures::all(found) {
        push_figure(&mut out, &figure);
    }
    push_parameters(&mut out, found);
    let _ = write!(
        out,
        "</main>\n<footer>\n<p>σ is one standard deviation. Pixel centres are at integers. Translation and rotation are those of \
         right_from_left, m and rad; the rotation's errors turn about the right camera's axes. Written by visod {}.</p>\n\
         </footer>\n<script>\n{SCRIPT}</script>\n</body>\n</html>\n",
        env!("CARGO_PKG_VERSION"),
    );
    out
}

fn summary(found: &Calibration) -> String {
    let board = &found.board;
    format!(
        "{} views of a board with {} × {} points, {} mm apart, give a baseline of {:.2} ± {:.2} mm. The points miss by {:.3} px (root mean square).",
        found.views.len(),
        board.columns,
        board.rows,
        brief(1e3 * board.square_m),
        1e3 * found.rig.baseline_m(),
        1e3 * sigma_baseline_m(found),
        found.rms_px[2],
    )
}

/// 1 σ of the distance between the cameras, m.
fn sigma_baseline_m(found: &Calibration) -> f64 {
    let along = found.rig.right_from_left.translation.vector.normalize();
    let block = found
        .covariance
        .fixed_view::<3, 3>(EXTRINSICS, EXTRINSICS)
        .into_owned();
    (along.transpose() * block * along)[0].max(0.0).sqrt()
}

fn push_facts(out: &mut String, found: &Calibration) {
    let rig = &found.rig;
    let focal = |camera: &crate::geometry::Camera, slot: usize| {
        format!("{:.2} ± {}", camera.focal_px.x, brief(found.sigma(slot)))
    };
    let facts = [
        (
            "Root mean square miss",
            format!("{:.3} px", found.rms_px[2]),
            format!("left {:.3}, right {:.3}", found.rms_px[0], found.rms_px[1]),
        ),
        (
            "σ of a point",
            format!("{:.3} px", found.sigma_px),
            "each coordinate, from the misses".to_owned(),
        ),
        (
            "Focal length, left",
            format!("{} px", focal(&rig.left, 0)),
            String::new(),
        ),
        (
            "Focal length, right",
            format!("{} px", focal(&rig.right, CAMERA_PARAMETERS)),
            String::new(),
        ),
        (
            "Views against each other",
            format!("{:.2}", found.between_views),
            if found.is_inflated {
                "times their points' noise: the covariance has grown by as much".to_owned()
            } else {
                "times their points' noise: 1 is par".to_owned()
            },
        ),
        (
            "Points",
            found.residuals.len().to_string(),
            format!("{} left out", found.outliers.len()),
        ),
    ];
    out.push_str("<dl class=\"facts\">\n");
    for (name, value, note) in facts {
        let _ = write!(
            out,
            "<div class=\"fact\"><dt>{}</dt><dd>{}</dd>",
            escape(name),
            escape(&value)
        );
        if !note.is_empty() {
            let _ = write!(out, "<dd class=\"note\">{}</dd>", escape(&note));
        }
        out.push_str("</div>\n");
    }
    out.push_str("</dl>\n");
}

fn push_advice(out: &mut String, found: &Calibration) {
    let advice = found.advice();
    out.push_str("<section class=\"advice\">\n<h2>What would make it better</h2>\n");
    if advice.is_empty() {
        out.push_str("<p>Nothing stands out.</p>\n");
    } else {
        out.push_str("<ul>\n");
        for sentence in advice {
            let _ = writeln!(out, "<li>{}</li>", escape(&sentence));
        }
        out.push_str("</ul>\n");
    }
    out.push_str("</section>\n");
}

fn push_left_out(out: &mut String, found: &Calibration, not_seen: &[String]) {
    if not_seen.is_empty() && found.left_out.is_empty() && found.outliers.is_empty() {
        return;
    }
    out.push_str("<section class=\"advice\">\n<h2>Left out</h2>\n<ul>\n");
    for view in &found.left_out {
        let _ = writeln!(
            out,
            "<li>View {}: {}.</li>",
            escape(&view.view),
            escape(&view.why)
        );
    }
    for point in &found.outliers {
        let _ = writeln!(
            out,
            "<li>Point {} of the {} image of {}: {} px off.</li>",
            point.point,
            point.side,
            escape(&point.view),
            number(point.miss_px, 2)
        );
    }
    for name in not_seen {
        let _ = writeln!(
            out,
            "<li>{}: the board was not found in both images.</li>",
            escape(name)
        );
    }
    out.push_str("</ul>\n</section>\n");
}

fn push_parameters(out: &mut String, found: &Calibration) {
    out.push_str(
        "<figure>\n<figcaption>\n<h2>Parameters</h2>\n<p>Each with its 1 σ; the rig file holds the values, the file beside it the whole covariance.</p>\n\
         </figcaption>\n<table class=\"parameters\">\n<thead><tr><th>parameter</th><th>value</th><th>σ</th></tr></thead>\n<tbody>\n",
    );
    for (name, value, sigma) in parameters(found) {
        let decimals = (1 - sigma.log10().floor() as i32).clamp(1, 9) as usize;
        let _ = writeln!(
            out,
            "<tr><td>{}</td><td>{}</td><td>{}</td></tr>",
            escape(&name),
            number(value, decimals),
            number(sigma, decimals)
        );
    }
    out.push_str("</tbody>\n</table>\n</figure>\n");
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::calibration::simulated::{placements, views};
    use crate::calibration::{Board, Lens, Pattern, calibrate};

    #[test]
    fn the_page_is_whole_and_shows_every_view_and_parameter() {
        let rig = crate::simulation::small_rig();
        let board = Board {
            pattern: Pattern::Chessboard,
            columns: 9,
            rows: 6,
            square_m: 0.04,
            sigma_square_m: 0.0,
        };
        let placed = placements(&rig, &board, 8, 3);
        let mut seen = views(&rig, &board, &placed, 0.1, 1);
        seen[2].name = "<odd & name>".to_owned();
        let size = (rig.left.width, rig.left.height);
        let found = calibrate(&board, &seen, size, Lens::Radtan4, &mut |_| {}).expect("calibrates");
        let page = render(&found, &["nothing.png".to_owned()]);
        assert!(page.starts_with("<!DOCTYPE html>") && page.trim_end().ends_with("</html>"));
        assert!(!page.contains("<odd") && page.contains("&lt;odd &amp; name&gt;"));
        assert!(!page.contains("NaN") && !page.contains("http://") && !page.contains("https://"));
        for (name, ..) in parameters(&found) {
            assert!(page.contains(&format!("<td>{name}</td>")), "{name}");
        }
        for tag in ["svg", "figure", "section", "table", "ul"] {
            let (open, closed) = (
                page.matches(&format!("<{tag}")).count(),
                page.matches(&format!("</{tag}>")).count(),
            );
            assert_eq!(open, closed, "{tag}");
        }
        assert!(page.contains("nothing.png") && page.contains("What would make it better"));
    }
}
