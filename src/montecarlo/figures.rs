//! Outcomes in, figures in the manner of the thesis' 4.5, 4.6, 4.7 and 4.11 out.

use super::ellipse::{block, element, outline};
use super::verdict::{Part, Verdict};
use super::{MotionOutcome, OdometryOutcome, Outcomes, PointOutcome, TriangulationOutcome};
use crate::geometry::se3;
use crate::output::report::figures::{BELOW_PX, Figure, Key, LEFT_PX, RIGHT_PX, TOP_PX, WIDTH_PX};
use crate::output::report::plot::{Frame, Panel};
use crate::output::report::scale::{Scale, angle_unit, extent, length_unit};
use crate::output::report::svg;
use nalgebra::{Isometry3, Matrix2, Vector2};

/// A figure with the name of its file and its size, px.
pub(super) struct Drawing {
    pub name: &'static str,
    pub figure: Figure,
    pub height_px: f64,
}

/// Classes of both ellipses and curves: they differ in colour and in dashes.
const MONTE_CARLO: &str = "one solid";
const FIRST_ORDER: &str = "two";
const BOUND: &str = "three";
const GAP_PX: f64 = 14.0;

/// All figures of what was run.
pub(super) fn all(outcomes: &Outcomes) -> Vec<Drawing> {
    let mut figures = Vec::new();
    if let Some(outcome) = &outcomes.triangulation {
        figures.push(points_from_above(outcome));
        figures.push(point_errors(outcome));
    }
    if let Some(outcome) = &outcomes.motion {
        figures.push(motion_errors(outcome));
    }
    if let Some(outcome) = &outcomes.odometry {
        figures.push(path_from_above(outcome));
        figures.push(growth(outcome));
        figures.push(consistency(outcome));
    }
    figures
}

fn both_ellipses() -> Vec<Key> {
    vec![
        Key::line(MONTE_CARLO, "Monte Carlo, 95 %"),
        Key::line(FIRST_ORDER, "first order, 95 %"),
    ]
}

/// Scales of the same px per unit about what is to be seen, and the frame that they fill.
fn equal_scales(x: (f64, f64), y: (f64, f64), most_height: f64) -> (Frame, Scale, Scale) {
    let width = WIDTH_PX - LEFT_PX - RIGHT_PX;
    let span = |(low, high): (f64, f64)| (1.08 * (high - low)).max(1e-6);
    let per = (width / span(x)).min(most_height / span(y));
    let height = (per * span(y)).clamp(160.0, most_height);
    let about = |(low, high): (f64, f64), px: f64| {
        let (middle, half) = (0.5 * (low + high), 0.5 * px / per);
        (middle - half, middle + half)
    };
    let frame = Frame {
        left: LEFT_PX,
        top: TOP_PX,
        width,
        height,
    };
    let x = Scale::linear(about(x, width), (LEFT_PX, LEFT_PX + width));
    // What lies to the right of the way ahead is below it, as on a map.
    let y = Scale::linear(about(y, height), (TOP_PX, TOP_PX + height));
    (frame, x, y)
}

/// Everything that outlines reach.
fn reach<'a>(outlines: impl Iterator<Item = &'a Vec<(f64, f64)>> + Clone) -> [(f64, f64); 2] {
    let along = |of: fn(&(f64, f64)) -> f64| {
        extent(outlines.clone().flatten().map(of)).unwrap_or((0.0, 1.0))
    };
    [along(|p| p.0), along(|p| p.1)]
}

/// The thesis' figure 4.5: points with both ellipses, to scale.
fn points_from_above(outcome: &TriangulationOutcome) -> Drawing {
    let place = |p: &PointOutcome| (p.point.z, p.point.x);
    let ellipses = |of: fn(&Verdict) -> &nalgebra::Matrix6<f64>| -> Vec<Vec<(f64, f64)>> {
        let each = outcome.points.iter();
        each.map(|p| outline(&block(of(&p.verdict), 2, 0), place(p), 1.0))
            .collect()
    };
    let sampled = ellipses(|v| &v.monte_carlo);
    let stated = ellipses(|v| &v.first_order);
    let [along, across] = reach(sampled.iter().chain(&stated));
    let (frame, x, y) = equal_scales((along.0.min(0.0), along.1), across, 420.0);
    let mut panel = Panel::with_scales(frame, x.clone(), y.clone());
    for p in &outcome.points {
        let dots: Vec<_> = p.sample.iter().map(|s| (s.z, s.x)).collect();
        panel.dots(&dots, 1.0, "points");
    }
    for (outline, class) in sampled
        .iter()
        .map(|o| (o, MONTE_CARLO))
        .chain(stated.iter().map(|o| (o, FIRST_ORDER)))
    {
        panel.draw(&element(outline, &x, &y, class));
    }
    panel.dots(&[(0.0, 0.0)], 4.5, "finish");
    let height_px = TOP_PX + frame.height + BELOW_PX;
    let content = panel.finish("to the right, m", Some("ahead, m"));
    let mut legend = both_ellipses();
    legend.push(Key::dot("points", "triangulated in one run"));
    legend.push(Key::dot("finish", "left camera"));
    Drawing {
        name: "points",
        height_px,
        figure: Figure {
            title: "Pixels to points".to_owned(),
            sentence:
                "Points seen from above, to scale, with what pixel noise makes of them: depth is \
                       uncertain with its square."
                    .to_owned(),
            legend,
            drawing: svg::drawing(WIDTH_PX, height_px, "Points from above", &content),
        },
    }
}

/// One panel a depth, each to its own scale.
fn point_errors(outcome: &TriangulationOutcome) -> Drawing {
    // Of the points of one depth, that nearest to the axis.
    let mut shown: Vec<&PointOutcome> = Vec::new();
    for p in &outcome.points {
        match shown.last_mut() {
            Some(last) if (last.point.z - p.point.z).abs() < 1e-9 => {
                if p.point.x.abs() < last.point.x.abs() {
                    *last = p;
                }
            }
            _ => shown.push(p),
        }
    }
    const HEIGHT_PX: f64 = 190.0;
    let columns = shown.len().max(1) as f64;
    let width = (WIDTH_PX - RIGHT_PX) / columns - LEFT_PX;
    let mut content = String::new();
    for (i, p) in shown.iter().enumerate() {
        let frame = Frame {
            left: LEFT_PX + i as f64 * (width + LEFT_PX),
            top: TOP_PX,
            width,
            height: HEIGHT_PX,
        };
        let sample: Vec<_> = p
            .sample
            .iter()
            .map(|s| (s.x - p.point.x, s.z - p.point.z))
            .collect();
        let covs = [&p.verdict.monte_carlo, &p.verdict.first_order].map(|c| block(c, 0, 2));
        content += &scatter(
            frame,
            &sample,
            &covs,
            length_unit,
            length_unit,
            [&format!("right, at {:.0} m", p.point.z), "ahead"],
        );
    }
    let mut legend = both_ellipses();
    legend.push(Key::dot("points", "error of one run"));
    let height_px = TOP_PX + HEIGHT_PX + BELOW_PX;
    Drawing {
        name: "point-errors",
        height_px,
        figure: Figure {
            title: "Errors of points".to_owned(),
            sentence:
                "The same near the axis, each depth to its own scale, axes not alike: first order \
                       holds where both ellipses meet."
                    .to_owned(),
            legend,
            drawing: svg::drawing(WIDTH_PX, height_px, "Errors of points", &content),
        },
    }
}

/// Errors with both ellipses; units are chosen for each axis by what is largest on it.
fn scatter(
    frame: Frame,
    sample: &[(f64, f64)],
    covs: &[Matrix2<f64>; 2],
    unit_x: impl Fn(f64) -> (&'static str, f64),
    unit_y: impl Fn(f64) -> (&'static str, f64),
    labels: [&str; 2],
) -> String {
    let outlines = covs.each_ref().map(|cov| outline(cov, (0.0, 0.0), 1.0));
    let [x, y] = reach(outlines.iter());
    let most = |(low, high): (f64, f64)| 1.35 * low.abs().max(high.abs()).max(1e-12);
    let (most_x, most_y) = (most(x), most(y));
    let ((name_x, per_x), (name_y, per_y)) = (unit_x(most_x), unit_y(most_y));
    let scale_x = Scale::linear(
        (-most_x * per_x, most_x * per_x),
        (frame.left, frame.left + frame.width),
    );
    let scale_y = Scale::linear(
        (-most_y * per_y, most_y * per_y),
        (frame.top + frame.height, frame.top),
    );
    let mut panel = Panel::with_scales(frame, scale_x.clone(), scale_y.clone());
    let scaled = |points: &[(f64, f64)]| -> Vec<_> {
        points.iter().map(|p| (p.0 * per_x, p.1 * per_y)).collect()
    };
    panel.dots(&scaled(sample), 1.3, "points");
    for (outline, class) in outlines.iter().zip([MONTE_CARLO, FIRST_ORDER]) {
        panel.draw(&element(&scaled(outline), &scale_x, &scale_y, class));
    }
    panel.finish(
        &format!("{}, {name_y}", labels[1]),
        Some(&format!("{}, {name_x}", labels[0])),
    )
}

/// The thesis' figure 4.6: the errors of one motion.
fn motion_errors(outcome: &MotionOutcome) -> Drawing {
    const HEIGHT_PX: f64 = 300.0;
    let width = 0.5 * (WIDTH_PX - RIGHT_PX) - LEFT_PX;
    let frame = |i: usize| Frame {
        left: LEFT_PX + i as f64 * (width + LEFT_PX),
        top: TOP_PX,
        width,
        height: HEIGHT_PX,
    };
    let v = &outcome.verdict;
    let pair = |i: usize, j: usize| -> (Vec<(f64, f64)>, [Matrix2<f64>; 2]) {
        let shown = outcome.errors.iter().take(2000);
        (
            shown.map(|e| (e[i], e[j])).collect(),
            [block(&v.monte_carlo, i, j), block(&v.first_order, i, j)],
        )
    };
    let (sample, covs) = pair(0, 2);
    let mut content = scatter(
        frame(0),
        &sample,
        &covs,
        length_unit,
        length_unit,
        ["translation, right", "translation, ahead"],
    );
    let (sample, covs) = pair(0, 4);
    content += &scatter(
        frame(1),
        &sample,
        &covs,
        length_unit,
        angle_unit,
        ["translation, right", "turn about down"],
    );
    let mut legend = both_ellipses();
    legend.push(Key::dot("points", "error of one run"));
    let height_px = TOP_PX + HEIGHT_PX + BELOW_PX;
    Drawing {
        name: "motion",
        height_px,
        figure: Figure {
            title: "Points to one motion".to_owned(),
            sentence: format!(
                "Errors of one motion in the camera's frame. ANEES {:.3}, 95 % interval {:.3} to {:.3}.",
                v.anees, v.anees_interval.0, v.anees_interval.1
            ),
            legend,
            drawing: svg::drawing(WIDTH_PX, height_px, "Errors of one motion", &content),
        },
    }
}

/// A pose's place seen from above: ahead along the first camera's axis, and to its right.
fn place(pose: &Isometry3<f64>) -> (f64, f64) {
    (pose.translation.z, pose.translation.x)
}

/// A pose's covariance seen from above, in the same order: that of a right perturbation is turned
/// into the first camera's axes.
fn place_cov(pose: &Isometry3<f64>, cov: &nalgebra::Matrix6<f64>) -> Matrix2<f64> {
    block(&se3::cov_fixed_axes_from_right(pose, cov), 2, 0)
}

/// The thesis' figure 4.7: a path with both ellipses.
fn path_from_above(outcome: &OdometryOutcome) -> Drawing {
    const STATIONS: usize = 10;
    let steps = outcome.poses.len();
    let mut stations: Vec<usize> = (1..=STATIONS)
        .map(|i| (i * steps).div_ceil(STATIONS))
        .collect();
    stations.dedup();
    let way: Vec<(f64, f64)> = outcome.truth.iter().map(place).collect();
    let [along, across] = reach(std::iter::once(&way));
    let size = (along.1 - along.0).max(across.1 - across.0).max(0.1);
    let last = &outcome.truth[steps];
    let largest = place_cov(last, &outcome.last().monte_carlo).trace().sqrt();
    let enlarged = [1.0, 10.0, 100.0, 1000.0, 10_000.0]
        .into_iter()
        .rfind(|factor| largest * factor < 0.12 * size)
        .unwrap_or(1.0);
    let at = |k: usize, of: fn(&Verdict) -> &nalgebra::Matrix6<f64>| {
        let (pose, verdict) = (&outcome.truth[k], &outcome.poses[k - 1]);
        outline(&place_cov(pose, of(verdict)), place(pose), enlarged)
    };
    let sampled: Vec<_> = stations
        .iter()
        .map(|&k| at(k, |v| &v.monte_carlo))
        .collect();
    let stated: Vec<_> = stations
        .iter()
        .map(|&k| at(k, |v| &v.first_order))
        .collect();
    let [along, across] = reach(sampled.iter().chain(&stated).chain([&way]));
    let (frame, x, y) = equal_scales(along, across, 560.0);
    let mut panel = Panel::with_scales(frame, x.clone(), y.clone());
    panel.line(&way, "truth");
    let ends = outcome.last_errors.iter().take(2000).map(|error| {
        let moved = last.rotation * se3::translation_of(error);
        let (ahead, right) = place(last);
        let off = Vector2::new(moved.z, moved.x) * enlarged;
        (ahead + off.x, right + off.y)
    });
    panel.dots(&ends.collect::<Vec<_>>(), 1.3, "points");
    for (outlines, class) in [(&sampled, MONTE_CARLO), (&stated, FIRST_ORDER)] {
        for outline in outlines {
            panel.draw(&element(outline, &x, &y, class));
        }
    }
    panel.dots(&way[..1], 4.5, "begin");
    let height_px = TOP_PX + frame.height + BELOW_PX;
    let content = panel.finish("to the right, m", Some("ahead, m"));
    let mut legend = vec![Key::line("truth", "true path")];
    legend.extend(both_ellipses());
    legend.push(Key::dot("points", "where runs end"));
    let how = if enlarged > 1.0 {
        format!("enlarged {enlarged}×")
    } else {
        "to scale".to_owned()
    };
    Drawing {
        name: "path",
        height_px,
        figure: Figure {
            title: "Motions to a path".to_owned(),
            sentence: format!("The path from above with the errors of its poses, {how}."),
            legend,
            drawing: svg::drawing(WIDTH_PX, height_px, "The path from above", &content),
        },
    }
}

/// The thesis' figure 4.11: how uncertainty grows along the path.
fn growth(outcome: &OdometryOutcome) -> Drawing {
    const HEIGHT_PX: f64 = 170.0;
    let steps = (0.0, outcome.poses.len() as f64);
    let series = |of: &dyn Fn(&Verdict) -> f64| -> Vec<(f64, f64)> {
        let values = outcome.poses.iter().map(of);
        (1..).map(f64::from).zip(values).collect()
    };
    let panel_of =
        |index: usize, part: fn(&Verdict) -> Part, unit: fn(f64) -> (&'static str, f64)| {
            let bound = |p: Part| {
                p.ratio_to_bound
                    .map_or(f64::NAN, |r| p.sigma_monte_carlo / r)
            };
            let curves = [
                (series(&|v| part(v).sigma_monte_carlo), MONTE_CARLO),
                (series(&|v| part(v).sigma_first_order), FIRST_ORDER),
                (series(&|v| bound(part(v))), BOUND),
            ];
            let all = curves
                .iter()
                .flat_map(|(points, _)| points.iter().map(|p| p.1));
            let largest = extent(all).map_or(1.0, |(_, high)| high);
            let (name, per) = unit(largest);
            let frame = Frame {
                left: LEFT_PX,
                top: TOP_PX + index as f64 * (HEIGHT_PX + GAP_PX),
                width: WIDTH_PX - LEFT_PX - RIGHT_PX,
                height: HEIGHT_PX,
            };
            let mut panel = Panel::new(frame, steps, (0.0, 1.06 * largest * per));
            for (points, class) in &curves {
                let scaled: Vec<_> = points.iter().map(|p| (p.0, p.1 * per)).collect();
                panel.line(&scaled, class);
            }
            (panel, name)
        };
    let rotation = |v: &Verdict| v.rotation().unwrap_or_else(|| v.translation());
    let (above, metres) = panel_of(0, Verdict::translation, length_unit);
    let (below, angle) = panel_of(1, rotation, angle_unit);
    let content = above.finish(&format!("σ of position, {metres}"), None)
        + &below.finish(&format!("σ of orientation, {angle}"), Some("motions"));
    let height_px = TOP_PX + 2.0 * HEIGHT_PX + GAP_PX + BELOW_PX;
    let mut legend = vec![
        Key::line(MONTE_CARLO, "Monte Carlo"),
        Key::line(FIRST_ORDER, "first order"),
    ];
    if outcome.last().bound.is_some() {
        legend.push(Key::line(BOUND, "bound: all pairs at once"));
    }
    Drawing {
        name: "growth",
        height_px,
        figure: Figure {
            title: "Growth of the uncertainty".to_owned(),
            sentence: "Roots of the traces along the path: what runs show, what first order says, and the \
                       least that any unbiased estimator could reach."
                .to_owned(),
            legend,
            drawing: svg::drawing(WIDTH_PX, height_px, "Growth of the uncertainty", &content),
        },
    }
}

/// ANEES along the path.
fn consistency(outcome: &OdometryOutcome) -> Drawing {
    const HEIGHT_PX: f64 = 190.0;
    let points: Vec<(f64, f64)> = (1..)
        .map(f64::from)
        .zip(outcome.poses.iter().map(|v| v.anees))
        .collect();
    let (low, high) = outcome.last().anees_interval;
    let (least, most) = extent(points.iter().map(|p| p.1)).unwrap_or((low, high));
    let margin = 0.5 * (high - low);
    let frame = Frame {
        left: LEFT_PX,
        top: TOP_PX,
        width: WIDTH_PX - LEFT_PX - RIGHT_PX,
        height: HEIGHT_PX,
    };
    let domain = ((least.min(low) - margin).max(0.0), most.max(high) + margin);
    let mut panel = Panel::new(frame, (0.0, points.len() as f64), domain);
    panel.level_band(low, high, "band");
    panel.level(1.0, "rule");
    panel.line(&points, MONTE_CARLO);
    let height_px = TOP_PX + HEIGHT_PX + BELOW_PX;
    let content = panel.finish("ANEES", Some("motions"));
    Drawing {
        name: "anees",
        height_px,
        figure: Figure {
            title: "Honesty along the path".to_owned(),
            sentence: "Average squared error of the pose in units of its own covariance: above the band is \
                       overconfident, below pessimistic."
                .to_owned(),
            legend: vec![
                Key::line(MONTE_CARLO, "ANEES"),
                Key::area("band", "95 % interval of an honest covariance"),
            ],
            drawing: svg::drawing(WIDTH_PX, height_px, "ANEES along the path", &content),
        },
    }
}
