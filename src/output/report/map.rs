//! A run in, its path seen from above out: equal axes, σ ellipses along the way.

use super::figures::{BELOW_PX, Figure, Key, LEFT_PX, RIGHT_PX, TOP_PX, WIDTH_PX};
use super::plot::{Frame, Panel};
use super::run::{Run, sigma};
use super::scale::{Scale, brief, extent, round_step};
use super::svg::{self, PathData, line, text};
use crate::estimation::Status;
use crate::output::row::OdometryRow;
use nalgebra::{Isometry3, Matrix2, Vector2};

/// Least and most height of the map, px.
const HEIGHTS_PX: (f64, f64) = (200.0, 640.0);
/// Ellipses along the way, that at the end not counted.
const ELLIPSES: usize = 11;
/// The largest 3 σ ellipse is enlarged until its radius has so many px.
const LEAST_RADIUS_PX: f64 = 9.0;

/// Which way the map lies, and how large it is.
struct Layout {
    /// z runs to the right and x down, for a long way ahead; else x to the right and z up.
    landscape: bool,
    /// Horizontally and vertically.
    x: Scale,
    y: Scale,
    frame: Frame,
    px_per_m: f64,
    enlarged: f64,
}

/// The path from above.
pub(super) fn from_above(run: &Run) -> Figure {
    let layout = Layout::of(run);
    let mut panel = Panel::with_scales(layout.frame, layout.x.clone(), layout.y.clone());
    let path = |rows: &[OdometryRow]| -> Vec<_> {
        let places = rows.iter().map(|row| layout.place(&row.odom_from_camera));
        places.collect()
    };
    let of_status = |wanted: Status, panel: &mut Panel, class: &str| {
        for (status, first, end) in run.stretches(|row| row.status) {
            if status == wanted {
                panel.line(&path(&run.rows[first.saturating_sub(1)..end]), class);
            }
        }
    };
    of_status(Status::Degraded, &mut panel, "doubtful");
    if let Some(truth) = &run.truth {
        let gap = (f64::NAN, f64::NAN);
        let places = truth.iter().map(|p| p.map_or(gap, |p| layout.place(&p)));
        panel.line(&places.collect::<Vec<_>>(), "truth");
    }
    for (_, first, end) in run.stretches(|row| row.epoch) {
        panel.line(&path(&run.rows[first..end]), "tracked");
    }
    of_status(Status::Lost, &mut panel, "missing");
    panel.draw(&layout.ellipses(run));
    panel.draw(&layout.ends(run));
    panel.draw(&layout.scale_bar());
    let (x_label, y_label) = match layout.landscape {
        true => ("z, forward, m", "x, right, m"),
        false => ("x, right, m", "z, forward, m"),
    };
    let height = layout.frame.top + layout.frame.height + BELOW_PX;
    let content = panel.finish(y_label, Some(x_label));
    figure(
        run,
        &layout,
        svg::drawing(WIDTH_PX, height, "The path seen from above", &content),
    )
}

fn figure(run: &Run, layout: &Layout, drawing: String) -> Figure {
    let enlarged = match layout.enlarged {
        1.0 => "to scale".to_owned(),
        factor => format!("enlarged {factor}×"),
    };
    let has = |status| run.rows.iter().any(|row| row.status == status);
    let mut legend = vec![Key::line("tracked", "estimate")];
    if run.truth.is_some() {
        legend.push(Key::line("truth", "truth"));
    }
    if layout.enlarged > 0.0 {
        legend.push(Key::area("sigma1", &format!("1 σ ellipse, {enlarged}")));
        legend.push(Key::area("sigma3", &format!("3 σ ellipse, {enlarged}")));
    }
    if has(Status::Degraded) {
        legend.push(Key::line("doubtful", "degraded"));
    }
    if has(Status::Lost) {
        legend.push(Key::line("missing", "lost, bridged"));
    }
    Figure {
        title: "Path from above".to_owned(),
        sentence: "Where the left camera went in the plane of its own right (x) and forward (z) axes \
                   at the start, with the published uncertainty of the position along the way; both \
                   axes have the same scale."
            .to_owned(),
        legend,
        drawing,
    }
}

impl Layout {
    fn of(run: &Run) -> Self {
        let truth = run.truth.iter().flatten().flatten();
        let estimate = run.rows.iter().map(|row| &row.odom_from_camera);
        let poses: Vec<_> = estimate.chain(truth).collect();
        let along = |k: usize| {
            extent(poses.iter().map(|pose| pose.translation.vector[k])).unwrap_or((0.0, 0.0))
        };
        let (x_m, z_m) = (along(0), along(2));
        let mut layout = Self::fit(x_m, z_m);
        layout.enlarged = layout.enlargement(run);
        // Room for the ellipses, unless they dwarf the path.
        let most_m = 0.5 * (x_m.1 - x_m.0).max(z_m.1 - z_m.0).max(0.1);
        let with_ellipses = |k: usize, (low, high): (f64, f64)| {
            let edges = stations(run).into_iter().flat_map(|row| {
                let at = row.odom_from_camera.translation.vector[k];
                let reach = 3.0 * layout.enlarged * sigma(&row.cov_pose, k);
                [at - reach.min(most_m), at + reach.min(most_m)]
            });
            extent(edges.chain([low, high])).unwrap_or((low, high))
        };
        Self {
            enlarged: layout.enlarged,
            ..Self::fit(with_ellipses(0, x_m), with_ellipses(2, z_m))
        }
    }

    /// A map that holds what lies between these.
    fn fit(x_m: (f64, f64), z_m: (f64, f64)) -> Self {
        let landscape = z_m.1 - z_m.0 > x_m.1 - x_m.0;
        let (across, up) = if landscape { (z_m, x_m) } else { (x_m, z_m) };
        let width = WIDTH_PX - LEFT_PX - RIGHT_PX;
        // A robot that stands still gets a map of a decimetre.
        let span = |(low, high): (f64, f64)| (1.1 * (high - low)).max(0.1);
        let px_per_m = (width / span(across)).min(HEIGHTS_PX.1 / span(up));
        let height = (px_per_m * span(up)).clamp(HEIGHTS_PX.0, HEIGHTS_PX.1);
        let frame = Frame {
            left: LEFT_PX,
            top: TOP_PX,
            width,
            height,
        };
        let about = |(low, high): (f64, f64), extent_px: f64| {
            let (middle, half) = (0.5 * (low + high), 0.5 * extent_px / px_per_m);
            (middle - half, middle + half)
        };
        let (top, bottom) = (frame.top, frame.top + height);
        let upright = if landscape {
            (top, bottom)
        } else {
            (bottom, top)
        };
        Self {
            landscape,
            x: Scale::linear(about(across, width), (LEFT_PX, LEFT_PX + width)),
            y: Scale::linear(about(up, height), upright),
            frame,
            px_per_m,
            enlarged: 1.0,
        }
    }

    /// Horizontal and vertical coordinate of a pose, m.
    fn place(&self, pose: &Isometry3<f64>) -> (f64, f64) {
        let p = pose.translation.vector;
        if self.landscape {
            (p.z, p.x)
        } else {
            (p.x, p.z)
        }
    }

    /// The power of ten that makes the largest ellipse visible; 0 if there is none to see.
    fn enlargement(&self, run: &Run) -> f64 {
        let sigmas_m = run.rows.iter().map(|row| {
            let cov = &row.cov_pose;
            cov[(0, 0)].max(cov[(2, 2)]).sqrt()
        });
        let largest_px = 3.0 * self.px_per_m * extent(sigmas_m).map_or(0.0, |(_, high)| high);
        [1.0, 10.0, 100.0, 1000.0]
            .into_iter()
            .find(|factor| largest_px * factor >= LEAST_RADIUS_PX)
            .unwrap_or(0.0)
    }

    fn ellipses(&self, run: &Run) -> String {
        if self.enlarged == 0.0 {
            return String::new();
        }
        let mut content = String::new();
        for row in stations(run) {
            for (sigmas, class) in [(3.0, "sigma3"), (1.0, "sigma1")] {
                content.push_str(&self.ellipse(row, sigmas).element(class));
            }
        }
        content
    }

    fn ellipse(&self, row: &OdometryRow, sigmas: f64) -> PathData {
        let mut path = PathData::default();
        let c = &row.cov_pose;
        let (a, b) = if self.landscape { (2, 0) } else { (0, 2) };
        let cov = Matrix2::new(c[(a, a)], c[(a, b)], c[(b, a)], c[(b, b)]);
        let Some(root) = nalgebra::Cholesky::new(cov) else {
            return path;
        };
        let (across, up) = self.place(&row.odom_from_camera);
        for i in 0..64 {
            let angle = std::f64::consts::TAU * f64::from(i) / 64.0;
            let edge = root.l() * Vector2::new(angle.cos(), angle.sin());
            let edge = edge * (sigmas * self.enlarged);
            path.to(self.x.at(across + edge.x), self.y.at(up + edge.y));
        }
        path.close();
        path
    }

    fn ends(&self, run: &Run) -> String {
        let mut content = String::new();
        let marks = [
            (&run.rows[0], "begin", "start"),
            (run.end(), "finish", "end"),
        ];
        for (row, class, word) in marks {
            let (across, up) = self.place(&row.odom_from_camera);
            let (x, y) = (self.x.at(across), self.y.at(up));
            content.push_str(&svg::dot(x, y, 4.5, class));
            content.push_str(&text(x + 8.0, y - 9.0, "halo", word));
        }
        content
    }

    /// A round length in the corner.
    fn scale_bar(&self) -> String {
        let length_m = round_step(0.12 * self.frame.width / self.px_per_m);
        let right = self.frame.left + self.frame.width - 18.0;
        let left = right - length_m * self.px_per_m;
        let y = self.frame.top + self.frame.height - 16.0;
        let middle = 0.5 * (left + right);
        line((left, y), (right, y), "bar")
            + &line((left, y - 5.0), (left, y + 5.0), "bar")
            + &line((right, y - 5.0), (right, y + 5.0), "bar")
            + &text(
                middle,
                y - 8.0,
                "halo middle",
                &format!("{} m", brief_length(length_m)),
            )
    }
}

/// A round length without needless decimals.
fn brief_length(length_m: f64) -> String {
    if length_m >= 1.0 {
        format!("{length_m:.0}")
    } else {
        brief(length_m).trim_end_matches('0').to_owned()
    }
}

/// Rows at equal distances along the way, and the last.
fn stations<'a>(run: &Run<'a>) -> Vec<&'a OdometryRow> {
    let total_m = run.path_m.last().copied().unwrap_or(0.0);
    let mut indices: Vec<usize> = (1..=ELLIPSES)
        .map(|i| total_m * i as f64 / (ELLIPSES + 1) as f64)
        .map(|at_m| run.path_m.partition_point(|path| *path < at_m))
        .chain([run.rows.len() - 1])
        .map(|i| i.min(run.rows.len() - 1))
        .collect();
    indices.dedup();
    indices.into_iter().map(|i| &run.rows[i]).collect()
}
