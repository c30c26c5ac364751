//! What every page must hold, however odd the run.

use super::*;
use crate::estimation::{Axes, Counts, Status};
use crate::geometry::se3;
use nalgebra::{Isometry3, Matrix6, Vector6};

fn rows(count: u64) -> Vec<OdometryRow> {
    let step = se3::exp(&Vector6::new(0.05, -0.01, 1.0, 0.001, 0.01, 0.0));
    let mut pose = Isometry3::identity();
    (0..count)
        .map(|sequence| {
            let grown = 1e-4 * sequence as f64;
            let row = OdometryRow {
                sequence,
                timestamp_ns: 1_700_000_000_000_000_000 + 100_000_000 * sequence as i64,
                status: match sequence {
                    0 => Status::Initializing,
                    _ => Status::Tracking,
                },
                odom_from_camera: pose,
                cov_pose: Matrix6::identity() * grown,
                prev_from_now: step,
                cov_motion: Matrix6::identity() * 1e-4,
                counts: Counts {
                    keypoints_left: 900,
                    keypoints_right: 910,
                    stereo_matches: 500,
                    tracks: 300,
                    inliers: 250,
                },
                variance_factor: 1.1,
                latency_ms: Some(20.0),
                epoch: 0,
                innovation_ratio: f64::NAN,
                budget_sigmas: std::array::from_fn(|i| 1e-3 * ((i % 7) as f64) * sequence as f64),
                is_first_order: true,
                undetermined: Axes::NONE,
            };
            pose *= step;
            row
        })
        .collect()
}

/// The truth beside [`rows`]: a little to the side.
fn truth(rows: &[OdometryRow]) -> Trajectory {
    let poses = rows.iter().map(|row| {
        let mut pose = row.odom_from_camera;
        pose.translation.x += 0.001 * row.sequence as f64;
        pose
    });
    Trajectory::by_number(poses.collect())
}

/// The page, once it has been found well formed and free of what is no number.
fn checked(rows: &[OdometryRow], truth: Option<&Trajectory>, title: &str) -> String {
    let page = render(rows, truth, &Settings::default(), title).unwrap();
    let (before_script, _) = page.split_once("<script>").unwrap();
    let (_, drawn) = before_script.split_once("</style>").unwrap();
    for attribute in drawn.split('"').skip(1).step_by(2) {
        for odd in ["NaN", "inf"] {
            assert!(!attribute.contains(odd), "{attribute}");
        }
    }
    assert_balanced(drawn.split_once("<body>").unwrap().1);
    for remote in ["http:", "https:", "src=", "href=", "url(//", "@import"] {
        assert!(!page.contains(remote), "{remote}");
    }
    page
}

/// Every element that opens closes, in order.
fn assert_balanced(html: &str) {
    let mut open: Vec<&str> = Vec::new();
    for tag in html.split('<').skip(1) {
        let (tag, _) = tag.split_once('>').expect("a tag that ends");
        let name = tag
            .trim_start_matches('/')
            .split([' ', '/', '\n'])
            .next()
            .unwrap();
        if tag.starts_with('/') {
            assert_eq!(open.pop(), Some(name));
        } else if !tag.ends_with('/') {
            open.push(name);
        }
    }
    assert!(open.is_empty(), "{open:?}");
}

/// How many points the path of the map has.
fn points_of_the_map(page: &str) -> usize {
    let (_, path) = page.split_once("<path class=\"tracked\" d=\"").unwrap();
    let (path, _) = path.split_once('"').unwrap();
    path.matches(['M', 'L']).count()
}

#[test]
fn every_row_is_drawn() {
    let rows = rows(400);
    let page = checked(&rows, Some(&truth(&rows)), "A run");
    assert_eq!(points_of_the_map(&page), 400);
    assert_eq!(
        page.matches("<circle class=\"points\"").count()
            + page.matches("<circle class=\"outside\"").count(),
        399 + 2
    );
    for heading in [
        "Path from above",
        "Where the uncertainty comes from",
        "Status",
        "Height over distance",
        "Error of the pose",
        "Normalised error of each motion",
        "Published uncertainty",
        "What each estimate rests on",
        "Variance factor",
        "Latency",
        "All numbers of the evaluation",
    ] {
        assert!(page.contains(heading), "{heading}");
    }
}

#[test]
fn without_truth_there_is_no_error_to_show() {
    let page = checked(&rows(20), None, "A run");
    assert!(!page.contains("Error of the pose") && !page.contains("NEES"));
}

#[test]
fn no_row_is_refused_and_one_is_enough() {
    assert_eq!(
        render(&[], None, &Settings::default(), "x"),
        Err(ReportError::NoRows)
    );
    let one = rows(1);
    checked(&one, None, "One");
    checked(&one, Some(&truth(&one)), "One");
}

#[test]
fn lost_frames_missing_numbers_and_broken_covariances_do_not_break_the_page() {
    let mut rows = rows(60);
    for row in &mut rows[20..30] {
        row.status = Status::Lost;
        row.variance_factor = f64::NAN;
        row.latency_ms = None;
        row.counts = Counts::default();
    }
    rows[31].status = Status::Degraded;
    rows[35].latency_ms = Some(f64::INFINITY);
    rows[40].cov_pose = Matrix6::zeros();
    rows[41].cov_pose = -Matrix6::identity();
    rows[42].cov_pose = Matrix6::repeat(f64::NAN);
    rows[43].cov_motion = Matrix6::zeros();
    rows[44].cov_pose = Matrix6::identity() * 1e30;
    rows[45].timestamp_ns = i64::MIN;
    rows[46].timestamp_ns = i64::MAX;
    for row in &mut rows[50..] {
        row.epoch = 1;
    }
    rows[59].cov_pose = Matrix6::repeat(f64::NAN);
    let truth = truth(&rows[..55]);
    let page = checked(&rows, Some(&truth), "Odd");
    assert!(page.contains("lost (10)") && page.contains("degraded (1)"));
    assert!(page.contains("the odometry frame began anew once"));
    checked(&rows, None, "Odd");
}

#[test]
fn a_robot_that_stands_still_with_certainty_gets_its_page() {
    let mut rows = rows(10);
    for row in &mut rows {
        row.odom_from_camera = Isometry3::identity();
        row.prev_from_now = Isometry3::identity();
        row.cov_pose = Matrix6::zeros();
        row.cov_motion = Matrix6::zeros();
        row.timestamp_ns = 0;
        row.latency_ms = None;
        row.variance_factor = f64::NAN;
    }
    let still = Trajectory::by_number(vec![Isometry3::identity(); 10]);
    checked(&rows, Some(&still), "Still");
}

#[test]
fn words_from_outside_stay_words() {
    let page = checked(&rows(3), None, "</title><script>alert('1')</script>\u{7}&");
    assert!(
        page.contains("&lt;/title&gt;&lt;script&gt;alert(&#39;1&#39;)&lt;/script&gt;\u{fffd}&amp;")
    );
    assert_eq!(page.matches("<script>").count(), 1);
}

#[test]
fn very_long_runs_keep_their_extremes_and_a_bearable_size() {
    let mut rows = rows(40_000);
    for row in &mut rows {
        row.odom_from_camera = Isometry3::identity();
    }
    rows[12_345].variance_factor = 9.87;
    let page = checked(&rows, None, "Long");
    assert!(page.len() < 3_000_000, "{}", page.len());
    let (_, after) = page
        .split_once("aria-label=\"Variance factor over time\"")
        .unwrap();
    let (_, path) = after.split_once("<path class=\"one\" d=\"").unwrap();
    // The domain ends 6 % above the largest value, on 200 px below 8 px.
    let top = 8.0 + 200.0 * (1.0 - 1.0 / 1.06);
    assert!(
        path.split_once('"')
            .unwrap()
            .0
            .contains(&format!(",{}", svg::px(top))),
        "{top}"
    );
}

#[test]
fn ticks_are_round_and_inside() {
    for (low, high) in [
        (0.0, 1.0),
        (-3.7, 12.9),
        (1e-7, 3e-7),
        (-5e6, 2e6),
        (4.0, 4.0),
    ] {
        let scale = scale::Scale::linear((low, high), (0.0, 100.0));
        let ticks = scale.ticks(5);
        assert!((2..=12).contains(&ticks.len()), "{low} {high}: {ticks:?}");
        for (value, _) in ticks {
            assert!((-1e-6..=100.0 + 1e-6).contains(&scale.at(value)));
        }
    }
    let labels: Vec<String> = scale::Scale::linear((-0.4, 0.4), (0.0, 1.0))
        .ticks(4)
        .into_iter()
        .map(|tick| tick.1)
        .collect();
    assert_eq!(labels, ["−0.4", "−0.2", "0.0", "0.2", "0.4"]);
}
