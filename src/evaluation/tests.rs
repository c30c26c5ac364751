//! What the evaluation must say of estimates whose errors are known beforehand.

use super::alignment::umeyama;
use super::consistency::TruthErrors;
use super::consistency::Verdict;
use super::pose_errors::{absolute_errors, relative_errors};
use super::segments::segment_errors;
use super::statistics::Statistics;
use super::trajectory::{Form, parse_trajectory};
use super::*;
use crate::estimation::{Axes, Counts};
use crate::geometry::{se3, so3};
use crate::output::csv;
use nalgebra::Vector3;
use proptest::prelude::*;
use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use rand_xoshiro::Xoshiro256PlusPlus;
use std::path::Path;

/// A winding drive of `count` poses, about a metre apart.
fn winding(count: usize) -> Vec<Isometry3<f64>> {
    let mut pose = Isometry3::identity();
    (0..count)
        .map(|i| {
            let now = pose;
            let phase = i as f64 / 15.0;
            pose *= se3::exp(&Vector6::new(
                0.02,
                -0.01,
                1.0,
                0.004,
                0.05 * phase.sin(),
                0.003,
            ));
            now
        })
        .collect()
}

fn scaled(poses: &[Isometry3<f64>], factor: f64) -> Vec<Isometry3<f64>> {
    let mut poses = poses.to_vec();
    for pose in &mut poses {
        pose.translation.vector *= factor;
    }
    poses
}

fn row(
    sequence: u64,
    odom_from_camera: Isometry3<f64>,
    prev_from_now: Isometry3<f64>,
) -> OdometryRow {
    OdometryRow {
        sequence,
        timestamp_ns: sequence as i64 * 100_000_000,
        status: match sequence {
            0 => Status::Initializing,
            _ => Status::Tracking,
        },
        odom_from_camera,
        cov_pose: Matrix6::zeros(),
        prev_from_now,
        cov_motion: Matrix6::zeros(),
        counts: Counts::default(),
        variance_factor: 1.0,
        latency_ms: None,
        epoch: 0,
        innovation_ratio: f64::NAN,
        budget_sigmas: [0.0; 24],
        is_first_order: true,
        undetermined: Axes::NONE,
    }
}

/// An odometry whose motions err as their covariance says.
fn honest_run(truth: &[Isometry3<f64>], seed: u64) -> Vec<OdometryRow> {
    let sigma = Vector6::new(0.004, 0.003, 0.008, 4e-4, 5e-4, 3e-4);
    let cov = Matrix6::from_diagonal(&sigma.component_mul(&sigma));
    let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
    let mut rows = vec![row(0, truth[0], Isometry3::identity())];
    for (i, pair) in truth.windows(2).enumerate() {
        let motion = pair[0].inv_mul(&pair[1]);
        let error = Vector6::from_fn(|k, _| {
            let z: f64 = StandardNormal.sample(&mut rng);
            sigma[k] * z
        });
        let estimate = Isometry3::from_parts(
            (motion.translation.vector + se3::translation_of(&error)).into(),
            so3::exp(&se3::rotation_of(&error)) * motion.rotation,
        );
        let before = rows[i].odom_from_camera;
        // Carried on as by the first-order chain rule about fixed axes.
        let turned = se3::cov_fixed_axes_from_right(&before, &cov);
        let mut lever = Matrix6::identity();
        let arm = before.rotation * estimate.translation.vector;
        lever
            .fixed_view_mut::<3, 3>(0, 3)
            .copy_from(&-so3::hat(&arm));
        let cov_pose = lever * rows[i].cov_pose * lever.transpose() + turned;
        let mut next = row(i as u64 + 1, before * estimate, estimate);
        next.cov_motion = cov;
        next.cov_pose = se3::symmetric(&cov_pose);
        rows.push(next);
    }
    rows
}

#[test]
fn a_scale_error_of_one_percent_is_a_drift_of_one_percent() {
    // Straight along z in steps of 0.5 m: a segment of 10 m ends at the first frame beyond, 10.5 m
    // away, so that the drift is 1 % of 10.5 m over 10 m.
    let truth: Vec<_> = (0..201)
        .map(|i| Isometry3::translation(0.0, 0.0, 0.5 * f64::from(i)))
        .collect();
    let estimate = scaled(&truth, 1.01);
    let report = segment_errors(
        [(&estimate[..], &truth[..])].into_iter(),
        &[10.0, 50.0, 200.0],
        1,
    );
    let [ten, fifty, none] = &report.by_length[..] else {
        panic!("three lengths")
    };
    assert_eq!((ten.segments, fifty.segments, none.segments), (180, 100, 0));
    assert!((ten.translation_percent.unwrap() - 1.05).abs() < 1e-12);
    assert!((fifty.translation_percent.unwrap() - 1.01).abs() < 1e-12);
    assert_eq!(none.translation_percent, None);
    assert_eq!(report.all.segments, 280);
    let all = (180.0 * 1.05 + 100.0 * 1.01) / 280.0;
    assert!((report.all.translation_percent.unwrap() - all).abs() < 1e-12);
    assert_eq!(report.all.rotation_deg_per_m, Some(0.0));
}

#[test]
fn a_constant_turn_per_metre_is_found_as_such() {
    let truth: Vec<_> = (0..301)
        .map(|i| Isometry3::translation(0.0, 0.0, f64::from(i)))
        .collect();
    let bias = se3::exp(&Vector6::new(
        0.0,
        0.0,
        1.0,
        0.0,
        0.01_f64.to_radians(),
        0.0,
    ));
    let mut estimate = vec![Isometry3::identity()];
    for i in 0..300 {
        estimate.push(estimate[i] * bias);
    }
    let report = segment_errors([(&estimate[..], &truth[..])].into_iter(), &[100.0], 10);
    // Every tenth frame up to 190: the segment from 200 would have to end beyond the last pose.
    assert_eq!(report.all.segments, 20);
    assert!((report.all.rotation_deg_per_m.unwrap() - 0.01 * 101.0 / 100.0).abs() < 1e-9);
}

#[test]
fn segments_and_motions_do_not_span_two_odometry_frames() {
    let truth = winding(61);
    let mut rows = honest_run(&truth, 1);
    let back = rows[30].odom_from_camera.inverse();
    for row in &mut rows[30..] {
        row.odom_from_camera = back * row.odom_from_camera;
        row.epoch = 1;
    }
    rows[30].status = Status::Initializing;
    let settings = Settings {
        lengths_m: vec![20.0],
        ..Settings::default()
    };
    let truth = Trajectory::by_number(truth);
    let found = evaluate(&Estimate::Odometry(rows), &truth, &settings).unwrap();
    assert_eq!(found.restarts, 1);
    assert!(found.rpe.unwrap().translation_m.max < 0.05);
    assert_eq!(found.rpe.unwrap().translation_m.count, 59);
    assert!(found.segments.all.translation_percent.unwrap() < 1.0);
    let consistency = found.consistency.unwrap();
    assert_eq!(consistency.increments.samples, 59);
    assert_eq!(consistency.increments.initializing, 2);
    assert_eq!(consistency.pose.samples, 59);
}

proptest! {
    #[test]
    fn umeyama_finds_the_similarity_that_was_applied(
        xi in prop::array::uniform6(-3.0..3.0_f64), scale in 0.1..10.0_f64, seed in 0_u64..1000,
    ) {
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
        let from: Vec<Vector3<f64>> = (0..20)
            .map(|_| Vector3::from_fn(|_, _| StandardNormal.sample(&mut rng)))
            .collect();
        let rigid = se3::exp(&Vector6::from(xi));
        let to: Vec<Vector3<f64>> = from
            .iter()
            .map(|p| rigid.rotation * (p * scale) + rigid.translation.vector)
            .collect();
        let found = umeyama(&from, &to, true).unwrap();
        prop_assert!((found.scale / scale - 1.0).abs() < 1e-12);
        prop_assert!((found.rigid.to_matrix() - rigid.to_matrix()).norm() < 1e-10);
    }

    #[test]
    fn aligned_and_relative_errors_do_not_depend_on_where_the_truth_begins(
        xi in prop::array::uniform6(-3.0..3.0_f64), seed in 0_u64..1000,
    ) {
        let truth = winding(40);
        let estimate: Vec<_> =
            honest_run(&truth, seed).iter().map(|row| row.odom_from_camera).collect();
        let elsewhere = se3::exp(&Vector6::from(xi));
        let moved: Vec<_> = truth.iter().map(|pose| elsewhere * pose).collect();
        for how in [Alignment::First, Alignment::Se3, Alignment::Sim3] {
            let a = absolute_errors(&estimate, &truth, how).unwrap();
            let b = absolute_errors(&estimate, &moved, how).unwrap();
            prop_assert!((a.translation_m.rmse - b.translation_m.rmse).abs() < 1e-10);
            prop_assert!((a.rotation_deg.rmse - b.rotation_deg.rmse).abs() < 1e-8);
        }
        let a = relative_errors([(&estimate[..], &truth[..])].into_iter()).unwrap();
        let b = relative_errors([(&estimate[..], &moved[..])].into_iter()).unwrap();
        prop_assert!((a.translation_m.rmse - b.translation_m.rmse).abs() < 1e-10);
    }
}

#[test]
fn umeyama_never_answers_with_a_reflection_or_for_a_line() {
    let from = [(1., 0., 0.), (0., 1., 0.), (0., 0., 0.), (1., 1., 0.)]
        .map(|(x, y, z)| Vector3::new(x, y, z));
    let mirrored = from.map(|p| Vector3::new(-p.x, p.y, p.z));
    let found = umeyama(&from, &mirrored, false).unwrap();
    assert!(
        (found
            .rigid
            .rotation
            .to_rotation_matrix()
            .matrix()
            .determinant()
            - 1.0)
            .abs()
            < 1e-12
    );
    let line: Vec<_> = (0..5)
        .map(|i| Vector3::new(0.0, 0.0, f64::from(i)))
        .collect();
    assert!(umeyama(&line, &line, false).is_none());
    assert!(umeyama(&from[..2], &from[..2], false).is_none());
}

#[test]
fn honest_covariances_are_found_consistent_and_shrunk_ones_overconfident() {
    let truth = winding(401);
    let rows = honest_run(&truth, 20);
    let truth: Vec<_> = truth.into_iter().map(Some).collect();
    let found = consistency::consistency(&rows, &truth, &TruthErrors::default());
    let motion = &found.increments;
    assert_eq!((motion.samples, motion.initializing), (400, 1));
    for part in [&motion.full, &motion.translation, &motion.rotation] {
        let part = part.as_ref().unwrap();
        assert_eq!(part.verdict, Verdict::Consistent, "{part:?}");
        assert!((part.coverage_interval.0..=part.coverage_interval.1).contains(&part.coverage));
    }
    let white = motion.whiteness.unwrap();
    assert!(white.autocorrelation.abs() < white.limit);

    let shrunk: Vec<_> = rows
        .iter()
        .map(|row| OdometryRow {
            cov_motion: row.cov_motion * 0.5,
            ..row.clone()
        })
        .collect();
    let found = consistency::consistency(&shrunk, &truth, &TruthErrors::default());
    assert_eq!(
        found.increments.full.unwrap().verdict,
        Verdict::Overconfident
    );
    // What the truth itself may err by explains the rest.
    let found = consistency::consistency(
        &shrunk,
        &truth,
        &TruthErrors {
            cov_motion: rows[1].cov_motion * 0.5,
            ..TruthErrors::default()
        },
    );
    assert_eq!(found.increments.full.unwrap().verdict, Verdict::Consistent);
}

#[test]
fn the_end_pose_of_independent_runs_is_consistent() {
    let truth = winding(60);
    let placed: Vec<_> = truth.iter().copied().map(Some).collect();
    let ends: Vec<f64> = (0..300)
        .map(|seed| {
            let rows = honest_run(&truth, 1000 + seed);
            let found = consistency::consistency(&rows, &placed, &TruthErrors::default());
            found.pose.end.unwrap().nees
        })
        .collect();
    let anees = ends.iter().sum::<f64>() / (6.0 * 300.0);
    let (lo, hi) = crate::uncertainty::consistency::anees_interval(6, 300, 0.95);
    assert!((lo..hi).contains(&anees), "{anees}");
}

#[test]
fn lost_frames_and_broken_covariances_are_counted_and_left_out() {
    let truth = winding(30);
    let mut rows = honest_run(&truth, 2);
    rows[5].status = Status::Lost;
    rows[6].status = Status::Lost;
    rows[9].cov_motion = Matrix6::zeros();
    rows[11].cov_pose[(2, 2)] = -1.0;
    let truth = Trajectory::by_number(truth[..28].to_vec());
    let found = evaluate(&Estimate::Odometry(rows), &truth, &Settings::default()).unwrap();
    let consistency = found.consistency.as_ref().unwrap();
    let motion = &consistency.increments;
    assert_eq!(
        (
            motion.samples,
            motion.lost,
            motion.bad_covariances,
            motion.without_truth
        ),
        (24, 2, 1, 2)
    );
    assert_eq!(motion.first_bad_covariance, Some(9));
    assert_eq!(consistency.pose.first_bad_covariance, Some(11));
    assert_eq!(found.errors.len(), 2);
    let text = found.to_string();
    assert!(text.contains(
        "error: 1 covariances of the motion are not symmetric positive definite, the first at seq 9"
    ));
    assert!(text.contains("2 of 30 poses have no true pose"));
}

#[test]
fn statistics_are_those_of_the_text_book() {
    let s = Statistics::of(&[3.0, 1.0, 2.0, 6.0]).unwrap();
    assert_eq!(
        (s.mean, s.median, s.min, s.max, s.sse),
        (3.0, 2.5, 1.0, 6.0, 50.0)
    );
    assert!((s.rmse - 12.5_f64.sqrt()).abs() < 1e-15 && (s.std - 3.5_f64.sqrt()).abs() < 1e-15);
    assert!(Statistics::of(&[]).is_none());
}

fn parse(text: &str) -> Result<Trajectory, String> {
    parse_trajectory(Path::new("truth"), text).map_err(|e| e.to_string())
}

#[test]
fn each_form_is_recognised_and_read() {
    let kitti = parse("\n1 0 0 1  0 1 0 2  0 0 1 3\n").unwrap();
    let tum =
        parse("# timestamp tx ty tz qx qy qz qw\n1403715273.262142976 1 2 3 0 0 0 1\n").unwrap();
    let euroc = parse(
        "#timestamp [ns],p_RS_R_x [m],…\n1403715273262142976,1,2,3,1,0,0,0,0.1,0,0,0,0,0,0,0,0\n",
    )
    .unwrap();
    assert_eq!(
        (kitti.form, tum.form, euroc.form),
        (Form::Kitti, Form::Tum, Form::Euroc)
    );
    for trajectory in [&kitti, &tum, &euroc] {
        let pose = Isometry3::translation(1.0, 2.0, 3.0);
        assert_eq!(trajectory.world_from_body, vec![pose]);
    }
    assert_eq!(kitti.stamps_ns, None);
    assert_eq!(tum.stamps_ns, Some(vec![1_403_715_273_262_142_976]));
    assert_eq!(euroc.stamps_ns, tum.stamps_ns);
    assert_eq!(
        parse("1.5e3 1 2 3 0 0 0 1").unwrap().stamps_ns,
        Some(vec![1_500_000_000_000])
    );
    assert_eq!(
        parse("-0.25 1 2 3 0 0 0 1").unwrap().stamps_ns,
        Some(vec![-250_000_000])
    );
}

#[test]
fn malformed_lines_are_named() {
    let good = "1 0 0 1 0 1 0 2 0 0 1 3\n";
    for (bad, said) in [
        ("", "truth: holds no pose"),
        ("# nothing\n", "truth: holds no pose"),
        ("1 2 3\n", "truth:1: has 3 columns; a pose has 12"),
        ("1,2,3\n", "truth:1: has 3 comma-separated columns"),
        (
            &format!("{good}1 0 0 1\n"),
            "truth:2: has 4 columns, but must have 12",
        ),
        (
            &format!("{good}\n1 0 0 x 0 1 0 2 0 0 1 3"),
            "truth:3: column 4 must be a number, but is 'x'",
        ),
        (
            &format!("{good}1 0 0 nan 0 1 0 2 0 0 1 3"),
            "truth:2: column 4 must be finite",
        ),
        (
            &format!("{good}2 0 0 1 0 1 0 2 0 0 1 3"),
            "truth:2: its matrix is not a rotation",
        ),
        (
            &format!("{good}-1 0 0 1 0 1 0 2 0 0 1 3"),
            "truth:2: its matrix is not a rotation: determinant -1",
        ),
        (
            "0 1 2 3 0 0 0 2\n",
            "truth:1: its quaternion must have length 1, but has 2",
        ),
        (
            "1 1 2 3 0 0 0 1\n1 1 2 3 0 0 0 1\n",
            "truth:2: its time is not after",
        ),
        (
            "t 1 2 3 0 0 0 1\n",
            "truth:1: column 1 must be a time in seconds, but is 't'",
        ),
        (
            "1.5,1,2,3,1,0,0,0\n",
            "truth:1: column 1 must be a time in whole ns, but is '1.5'",
        ),
    ] {
        let error = parse(bad).unwrap_err();
        assert!(error.starts_with(said), "{error}");
    }
}

#[test]
fn nearest_times_are_associated_one_to_one() {
    let at = |stamps: &[i64]| Trajectory {
        form: Form::Tum,
        stamps_ns: Some(stamps.to_vec()),
        world_from_body: vec![Isometry3::identity(); stamps.len()],
    };
    let found = |estimate: &[i64], truth: &[i64], limit| {
        associate(&Estimate::Trajectory(at(estimate)), &at(truth), limit)
    };
    assert_eq!(
        found(&[0, 10, 21, 40], &[1, 8, 12, 20, 25, 60], 3).unwrap(),
        [Some(0), Some(1), Some(3), None]
    );
    assert_eq!(
        found(&[0, 1, 2, 10], &[1, 9], 2).unwrap(),
        [None, Some(0), None, Some(1)]
    );
    let error = found(&[0, 1], &[5_000_000_000, 6_000_000_000], 10).unwrap_err();
    assert!(
        error.to_string().contains("the truth's 5.000 to 6.000 s"),
        "{error}"
    );
    let error = associate(
        &Estimate::Trajectory(at(&[0, 1])),
        &Trajectory::by_number(winding(3)),
        10,
    );
    assert!(matches!(
        error,
        Err(AssociationError::DifferentForms { .. })
    ));
}

#[test]
fn an_odometry_csv_is_recognised_and_its_mistakes_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("odometry.csv");
    let rows = honest_run(&winding(3), 1);
    let text = |rows: &[OdometryRow]| {
        let mut text = format!("{}\n", csv::header_line());
        for row in rows {
            csv::push_row(&mut text, row);
            text.push('\n');
        }
        text
    };
    let read = |text: String| {
        std::fs::write(&path, text).unwrap();
        read_estimate(&path).map_err(|e| e.to_string())
    };
    let Ok(Estimate::Odometry(read_back)) = read(text(&rows)) else {
        panic!("an odometry CSV")
    };
    assert_eq!(read_back.len(), 3);
    assert_eq!(read_back[2].cov_pose, rows[2].cov_pose);

    let twice = [rows[1].clone(), rows[1].clone()];
    for (text, said) in [
        (text(&[]), ": holds a header but no row"),
        (text(&twice), ": seq must rise, but 1 follows 1"),
        (
            text(&rows).replace("tracking", "happy"),
            ":3: status: must be initializing, ",
        ),
        (
            "seq,status\n1,lost\n".into(),
            ":1: timestamp_ns: is missing",
        ),
        (String::new(), ": holds no pose"),
    ] {
        let error = read(text).unwrap_err();
        let (_, cause) = error.split_once("odometry.csv").unwrap();
        assert!(cause.starts_with(said), "{error}");
    }
}

#[test]
fn a_camera_beside_the_body_is_taken_into_account() {
    let body_from_camera = se3::exp(&Vector6::new(0.1, -0.2, 0.05, 1.2, -1.0, 0.4));
    let camera = winding(50);
    let body: Vec<_> = camera
        .iter()
        .map(|pose| pose * body_from_camera.inverse())
        .collect();
    let truth = Trajectory::by_number(body).of_camera(&body_from_camera);
    let estimate = Estimate::Trajectory(Trajectory::by_number(camera));
    let found = evaluate(&estimate, &truth, &Settings::default()).unwrap();
    assert!(found.rpe.unwrap().translation_m.max < 1e-12);
    assert!(found.ate[0].rotation_deg.max < 1e-6);
}

#[test]
fn the_place_of_a_camera_is_read_from_its_sensor_file() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("sensor.yaml");
    let read = |list: &str| {
        let text = format!("%YAML:1.0\nT_BS:\n  cols: 4\n  rows: 4\n  data: {list}\nrate_hz: 20\n");
        std::fs::write(&path, text).unwrap();
        read_body_from_camera(&path).map_err(|e| e.to_string())
    };
    let pose =
        read("[0.0, -1.0, 0.0, 0.1,\n 1.0, 0.0, 0.0, 0.2,\n 0.0, 0.0, 1.0, 0.3,\n 0, 0, 0, 1]");
    let pose = pose.unwrap();
    assert_eq!(pose.translation.vector, Vector3::new(0.1, 0.2, 0.3));
    assert!((pose * Vector3::x() - Vector3::y()).norm() < 1e-12);
    for (list, said) in [
        ("[1, 2, 3]", "T_BS must have 16 numbers"),
        (
            "[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, x, 0, 0, 0, 0, 1]",
            "not a number",
        ),
        (
            "[2, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]",
            "not a rotation",
        ),
        ("none", "no data"),
    ] {
        let error = read(list).unwrap_err();
        assert!(
            error.contains("sensor.yaml:2: ") && error.contains(said),
            "{error}"
        );
    }
}

/// The truth of a sensor that is turned against the camera: the error that it seems to show is
/// within what its uncertain mounting allows, direction by direction.
#[test]
fn a_sensor_that_is_turned_errs_as_its_mounting_says() {
    let motion = Isometry3::new(Vector3::new(0.2, -0.1, 1.2), Vector3::new(0.05, -0.2, 0.1));
    let errors = TruthErrors {
        sigma_mounting_rad: 1e-4,
        ..TruthErrors::default()
    };
    let mut found = Matrix6::zeros();
    for axis in 0..3 {
        let mut turn = Vector3::zeros();
        turn[axis] = 1e-4;
        let turned = Isometry3::rotation(turn);
        let error = se3::error_fixed_axes(&(turned * motion * turned.inverse()), &motion);
        found += error * error.transpose();
    }
    let stated = errors.covariance(&motion);
    assert!(
        (found - stated).norm() < 1e-3 * stated.norm(),
        "{found} {stated}"
    );
}
