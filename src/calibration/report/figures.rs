//! A calibration in, the figures of its page out.

use super::super::Calibration;
use super::super::depth::depth_error;
use crate::geometry::Camera;
use crate::output::report::figures::{BELOW_PX, Figure, Key, LEFT_PX, RIGHT_PX, TOP_PX, WIDTH_PX};
use crate::output::report::plot::{Frame, Panel};
use crate::output::report::scale::{Scale, number, round_step};
use crate::output::report::svg;

/// Room between the two cameras' images, px.
const GAP_PX: f64 = 24.0;
/// Cells of the coverage map along an image's longer side.
const CELLS: usize = 10;
/// Height of a plot, px.
const PLOT_PX: f64 = 230.0;

pub(super) fn all(found: &Calibration) -> Vec<Figure> {
    vec![
        misses(found),
        coverage(found),
        per_view(found),
        depth(found),
        correlations(found),
    ]
}

/// An image's frame on the drawing.
struct Sheet {
    left: f64,
    top: f64,
    scale: f64,
    size: (f64, f64),
}

impl Sheet {
    /// Both cameras' images side by side, with the drawing's height.
    fn both(found: &Calibration) -> ([Self; 2], f64) {
        let width = (WIDTH_PX - GAP_PX) / 2.0;
        let top = 26.0;
        let mut height: f64 = 0.0;
        let sheets = [(&found.rig.left, 0.0), (&found.rig.right, width + GAP_PX)].map(
            |(camera, left): (&Camera, f64)| {
                let size = (f64::from(camera.width), f64::from(camera.height));
                let scale = width / size.0;
                height = height.max(size.1 * scale);
                Self {
                    left,
                    top,
                    scale,
                    size,
                }
            },
        );
        (sheets, top + height + 8.0)
    }

    fn at(&self, x_px: f64, y_px: f64) -> (f64, f64) {
        (
            self.left + (x_px + 0.5) * self.scale,
            self.top + (y_px + 0.5) * self.scale,
        )
    }

    fn ground(&self) -> String {
        svg::rect(
            self.left,
            self.top,
            self.size.0 * self.scale,
            self.size.1 * self.scale,
            "ground",
        )
    }

    fn frame(&self, name: &str) -> String {
        let edge = svg::rect(
            self.left,
            self.top,
            self.size.0 * self.scale,
            self.size.1 * self.scale,
            "frame",
        );
        edge + &svg::text(self.left + 2.0, self.top - 9.0, "label", name)
    }
}

/// Residuals as vectors over the images.
fn misses(found: &Calibration) -> Figure {
    let (sheets, height) = Sheet::both(found);
    // A miss of the root mean square is drawn this long, px.
    let wanted = 14.0;
    let magnified = round_step(wanted / (found.rms_px[2].max(1e-6) * sheets[0].scale));
    let mut content: String = sheets.iter().map(Sheet::ground).collect();
    for residual in &found.residuals {
        let sheet = &sheets[residual.side];
        let from = sheet.at(residual.seen_px.x, residual.seen_px.y);
        let along = residual.miss_px * (magnified * sheet.scale);
        content.push_str(&svg::dot(from.0, from.1, 1.1, "at"));
        content.push_str(&svg::line(
            from,
            (from.0 + along.x, from.1 + along.y),
            "miss",
        ));
    }
    for (sheet, name) in sheets.iter().zip(["left", "right"]) {
        content.push_str(&sheet.frame(name));
    }
    Figure {
        title: "What is left of each point".to_owned(),
        sentence: format!(
            "Seen minus predicted, {} times as long as it is. Arrows that run the same way in one region tell of a lens that the model does not describe, or of a board that is not flat; chance alone points everywhere.",
            number(magnified, if magnified < 1.0 { 1 } else { 0 })
        ),
        legend: vec![Key::dot("at", "point"), Key::line("miss", "miss")],
        drawing: svg::drawing(
            WIDTH_PX,
            height,
            "Residuals of all points as vectors over both images",
            &content,
        ),
    }
}

/// How many points each part of the images has.
fn coverage(found: &Calibration) -> Figure {
    let (sheets, height) = Sheet::both(found);
    let mut content: String = sheets.iter().map(Sheet::ground).collect();
    for (side, sheet) in sheets.iter().enumerate() {
        let cell = sheet.size.0.max(sheet.size.1) / CELLS as f64;
        let columns = (sheet.size.0 / cell).round().max(1.0) as usize;
        let rows = (sheet.size.1 / cell).round().max(1.0) as usize;
        let (width, tall) = (sheet.size.0 / columns as f64, sheet.size.1 / rows as f64);
        let mut counts = vec![0_usize; columns * rows];
        for residual in found.residuals.iter().filter(|r| r.side == side) {
            let column = ((residual.seen_px.x + 0.5) / width).max(0.0) as usize;
            let row = ((residual.seen_px.y + 0.5) / tall).max(0.0) as usize;
            counts[row.min(rows - 1) * columns + column.min(columns - 1)] += 1;
        }
        let most = counts.iter().copied().max().unwrap_or(1).max(1) as f64;
        for (i, &count) in counts.iter().enumerate() {
            let (x, y) = sheet.at(
                (i % columns) as f64 * width - 0.5,
                (i / columns) as f64 * tall - 0.5,
            );
            let (w, h) = (width * sheet.scale, tall * sheet.scale);
            if count == 0 {
                content.push_str(&svg::rect(x, y, w, h, "hollow"));
            } else {
                let shade = 0.12 + 0.6 * (count as f64 / most).sqrt();
                let filled = svg::rect(x, y, w, h, "cover");
                content.push_str(&filled.replace("/>", &format!(" fill-opacity=\"{shade:.2}\"/>")));
            }
            content.push_str(&svg::text(
                x + w / 2.0,
                y + h / 2.0 + 4.0,
                "count",
                &count.to_string(),
            ));
        }
    }
    for (sheet, name) in sheets.iter().zip(["left", "right"]) {
        content.push_str(&sheet.frame(name));
    }
    Figure {
        title: "Where the board was seen".to_owned(),
        sentence: "Points in each part of the images. A lens is known where points were; towards the edges it is guessed from the model where there were none.".to_owned(),
        legend: vec![Key::area("cover", "points"), Key::area("hollow", "none")],
        drawing: svg::drawing(WIDTH_PX, height, "Number of points in each part of both images", &content),
    }
}

/// Each view's root mean square miss.
fn per_view(found: &Calibration) -> Figure {
    let frame = Frame {
        left: LEFT_PX,
        top: TOP_PX,
        width: WIDTH_PX - LEFT_PX - RIGHT_PX,
        height: PLOT_PX,
    };
    let most = found
        .views
        .iter()
        .flat_map(|v| v.rms_px)
        .flatten()
        .fold(0.0, f64::max);
    let y = Scale::linear(
        (0.0, 1.1 * most.max(1e-9)),
        (frame.top + frame.height, frame.top),
    );
    let step = frame.width / found.views.len().max(1) as f64;
    let bottom = frame.top + frame.height;
    let mut content = svg::rect(frame.left, frame.top, frame.width, frame.height, "ground");
    for (value, label) in y.ticks(8) {
        content.push_str(&svg::line(
            (frame.left, y.at(value)),
            (frame.left + frame.width, y.at(value)),
            "grid",
        ));
        content.push_str(&svg::text(
            frame.left - 8.0,
            y.at(value) + 4.0,
            "tick end",
            &label,
        ));
    }
    for (i, view) in found.views.iter().enumerate() {
        let x = frame.left + (i as f64 + 0.5) * step;
        for (rms_px, class, shift) in [
            (view.rms_px[0], "bar-left", -0.36),
            (view.rms_px[1], "bar-right", 0.02),
        ] {
            if let Some(rms_px) = rms_px {
                let top = y.at(rms_px);
                content.push_str(&svg::rect(
                    x + shift * step,
                    top,
                    0.34 * step,
                    bottom - top,
                    class,
                ));
            }
        }
        // Names read upwards; of many views, every so many is named.
        let every = (found.views.len() / 40) + 1;
        if i % every == 0 {
            content.push_str(&svg::text_up(
                x + 4.0,
                bottom + 6.0,
                "small end",
                &shortened(&view.name),
            ));
        }
    }
    content.push_str(&svg::line(
        (frame.left, y.at(found.rms_px[2])),
        (frame.left + frame.width, y.at(found.rms_px[2])),
        "rule",
    ));
    content.push_str(&svg::rect(
        frame.left,
        frame.top,
        frame.width,
        frame.height,
        "frame",
    ));
    content.push_str(&svg::text_up(
        frame.left - 52.0,
        frame.top + frame.height / 2.0,
        "label middle",
        "root mean square, px",
    ));
    Figure {
        title: "View by view".to_owned(),
        sentence: "Root mean square miss of each view's points. A view that stands out was blurred, moved between the exposures, or shows a bent board.".to_owned(),
        legend: vec![Key::area("bar-left", "left"), Key::area("bar-right", "right"), Key::line("rule", "all")],
        drawing: svg::drawing(WIDTH_PX, bottom + 92.0, "Root mean square miss of each view", &content),
    }
}

/// The end of a long name, which differs most.
fn shortened(name: &str) -> String {
    let count = name.chars().count();
    match count {
        0..=14 => name.to_owned(),
        _ => format!("…{}", name.chars().skip(count - 13).collect::<String>()),
    }
}

/// What the calibration means for depths.
fn depth(found: &Calibration) -> Figure {
    let depths = (0..=76).map(|i| 2.0 + 0.5 * f64::from(i));
    let errors: Vec<_> = depths
        .filter_map(|z| depth_error(&found.rig, &found.covariance, z))
        .collect();
    let line = |of: fn(&super::super::depth::DepthError) -> f64| -> Vec<(f64, f64)> {
        errors
            .iter()
            .map(|e| (e.depth_m, 100.0 * of(e) / e.depth_m))
            .collect()
    };
    let (rig, pixels) = (line(|e| e.sigma_rig_m), line(|e| e.sigma_tenth_px_m));
    let all = rig
        .iter()
        .chain(&pixels)
        .map(|(_, percent)| *percent)
        .filter(|p| *p > 0.0);
    let (low, high) = all.fold((f64::INFINITY, 0.0_f64), |(low, high), p| {
        (low.min(p), high.max(p))
    });
    let frame = Frame {
        left: LEFT_PX,
        top: TOP_PX,
        width: WIDTH_PX - LEFT_PX - RIGHT_PX,
        height: PLOT_PX,
    };
    let domain = if high > 0.0 {
        (0.7 * low, 1.4 * high)
    } else {
        (0.01, 1.0)
    };
    let mut panel = Panel::logarithmic(frame, (2.0, 40.0), domain);
    panel.line(&rig, "one");
    panel.line(&pixels, "two");
    let content = panel.finish("σ of the depth, %", Some("depth, m"));
    Figure {
        title: "What it means for depths".to_owned(),
        sentence: "1 σ of the depth of a point in the middle of the left image, as a share of it. The calibration's part is the same at every pair and does not average out; that of measuring pixels to a tenth stands beside it.".to_owned(),
        legend: vec![Key::line("one", "by this calibration"), Key::line("two", "by 0.1 px of each coordinate")],
        drawing: svg::drawing(WIDTH_PX, TOP_PX + PLOT_PX + BELOW_PX, "Depth error over depth", &content),
    }
}

/// How far parameters' errors go together.
fn correlations(found: &Calibration) -> Figure {
    let names = found.rig.parameter_names();
    let names: Vec<&str> = found
        .free
        .iter()
        .map(|slot| {
            names
                .iter()
                .find(|(_, i)| i == slot)
                .map_or("", |(name, _)| name)
        })
        .collect();
    let count = names.len();
    let (left, top) = (80.0, 74.0);
    let cell = ((WIDTH_PX - left - RIGHT_PX) / count as f64).min(24.0);
    let mut content = svg::rect(
        left,
        top,
        cell * count as f64,
        cell * count as f64,
        "ground",
    );
    for (i, &a) in found.free.iter().enumerate() {
        for (j, &b) in found.free.iter().enumerate().filter(|(j, _)| *j != i) {
            let correlation = found.correlation(a, b);
            if correlation.is_finite() {
                let side = cell * correlation.abs().sqrt().min(1.0);
                let class = if correlation > 0.0 { "plus" } else { "minus" };
                let place = |k: usize| (k as f64 + 0.5) * cell - side / 2.0;
                let mark = svg::rect(left + place(j), top + place(i), side, side, class);
                let words = format!(
                    "><title>{} and {}: {correlation:.2}</title></rect>",
                    names[i], names[j]
                );
                content.push_str(&mark.replace("/>", &words));
            }
        }
        let middle = (i as f64 + 0.5) * cell;
        content.push_str(&svg::text(
            left - 6.0,
            top + middle + 4.0,
            "small end",
            names[i],
        ));
        content.push_str(&svg::text_up(
            left + middle + 3.5,
            top - 6.0,
            "small",
            names[i],
        ));
    }
    content.push_str(&svg::rect(
        left,
        top,
        cell * count as f64,
        cell * count as f64,
        "frame",
    ));
    Figure {
        title: "Which errors go together".to_owned(),
        sentence: "The larger a square, the closer to ±1 the correlation. A principal point and a rotation, a focal length and the board's distance make up for each other: a consumer that takes parameters as independent claims too much error.".to_owned(),
        legend: vec![Key::area("plus", "together"), Key::area("minus", "against each other")],
        drawing: svg::drawing(WIDTH_PX, top + cell * count as f64 + 8.0, "Correlations of the parameters", &content),
    }
}
