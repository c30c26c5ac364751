//! The window against simulated points: what it says of its own error must hold.

use super::super::{Settings, StereoMeasurement};
use super::memory::UnknownsBySources;
use super::system::At;
use super::*;
use crate::simulation::{self, points};
use crate::uncertainty::consistency;
use nalgebra::{DVector, Vector2, Vector3, Vector4, Vector6};
use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, StandardNormal};
use rand_xoshiro::Xoshiro256PlusPlus;
use std::collections::HashMap;

/// One run's errors over their covariances.
struct Run {
    nees_pose: f64,
    nees_motion: Vec<f64>,
    warp_px: f64,
    sigma_warp_px: f64,
    dispersion: f64,
}

const SIGMA_PX: f64 = 0.5;

/// Errors that stay with a landmark: each sight is off by so much more, the same way on both sides.
struct Relief {
    per_sight_px: f64,
    /// Whether the window is told.
    is_stated: bool,
    /// How often each landmark was seen, and which way it is off.
    landmarks: HashMap<LandmarkId, (f64, Vector2<f64>)>,
    rng: Xoshiro256PlusPlus,
}

impl Relief {
    fn new(per_sight_px: f64, is_stated: bool, seed: u64) -> Self {
        Self {
            per_sight_px,
            is_stated,
            landmarks: HashMap::new(),
            rng: Xoshiro256PlusPlus::seed_from_u64(seed),
        }
    }

    /// Adds what stays with a landmark to a sight of it.
    fn add_to(&mut self, seen: &mut Seen) {
        let rng = &mut self.rng;
        let (count, way) = self.landmarks.entry(seen.id).or_insert_with(|| {
            let mut normal = || StandardNormal.sample(rng);
            (0.0, Vector2::new(normal(), normal()))
        });
        let px = *count * self.per_sight_px;
        *count += 1.0;
        seen.measurement.px += px * Vector4::new(way.x, way.y, way.x, way.y);
        if self.is_stated {
            seen.relief_px = Vector2::repeat(px);
        }
    }
}

fn sights(frame: &points::PointFrame, displaced_px: f64, relief: &mut Relief) -> Vec<Seen> {
    let seen = |s: &points::Sight| {
        let mut seen = Seen {
            id: s.id,
            measurement: StereoMeasurement {
                px: s.pixels + Vector4::new(0.0, 0.0, displaced_px, 0.0),
                sigma_px: Vector4::repeat(SIGMA_PX),
            },
            relief_px: Vector2::zeros(),
        };
        relief.add_to(&mut seen);
        seen
    };
    frame.sights.iter().map(seen).collect()
}

fn step() -> Isometry3<f64> {
    se3::exp(&Vector6::new(0.01, 0.0, 0.2, 0.0, 0.01, 0.002))
}

/// Drives along a gentle curve with a right image that is displaced; every frame is a keyframe.
fn drive(steps: usize, survival: f64, displaced_px: f64, settings: &Settings, seed: u64) -> Run {
    let mut relief = Relief::new(0.0, false, seed);
    drive_over(steps, survival, displaced_px, &mut relief, settings, seed).0
}

/// The same where landmarks are off in a way of their own; and the window at its end.
fn drive_over(
    steps: usize,
    survival: f64,
    displaced_px: f64,
    relief: &mut Relief,
    settings: &Settings,
    seed: u64,
) -> (Run, Window) {
    let rig = simulation::thesis_rig();
    let world = points::Settings {
        landmarks: 80,
        survival,
        ..points::Settings::default()
    };
    let mut simulation = points::PointSimulation::new(rig.clone(), world, seed).expect("valid");
    let mut frame = points::PointFrame::default();
    let mut window = Window::new(rig, settings.clone());
    let mut truth = Isometry3::identity();
    let mut run = Run {
        nees_pose: 0.0,
        nees_motion: Vec::new(),
        warp_px: 0.0,
        sigma_warp_px: 0.0,
        dispersion: 0.0,
    };
    let nees = |error: &Vector6<f64>, cov: &Matrix6<f64>| {
        consistency::nees(error, cov).expect("positive definite")
    };
    simulation.observe(&truth, &mut frame);
    window.begin_at(&truth, &(Matrix6::identity() * 1e-16), &BySources::zeros());
    window.promote(&sights(&frame, displaced_px, relief));
    for k in 1..=steps {
        truth *= step();
        simulation.observe(&truth, &mut frame);
        let (known, new): (Vec<Seen>, Vec<Seen>) = sights(&frame, displaced_px, relief)
            .iter()
            .partition(|s| window.landmark(s.id).is_some());
        let weights = vec![1.0; known.len()];
        let mut inliers = Vec::new();
        let newest_from_now = window
            .consent(&known, &weights, &step(), k as u64, &mut inliers)
            .expect("agrees");
        let agreed: Vec<Seen> = inliers.iter().map(|&i| known[i as usize]).collect();
        window.add(&newest_from_now, &agreed);
        let tracked = window.adjust(1.0).expect("determined");
        let motion_error = se3::log(&(step().inverse() * tracked.motion.prev_from_now));
        run.nees_motion
            .push(nees(&motion_error, &tracked.motion.cov_right));
        let pose_error = se3::log(&(truth.inverse() * tracked.odom_from_now));
        run.nees_pose = nees(&pose_error, &tracked.cov_pose_right);
        window.settle();
        window.promote(&new);
    }
    // Along the baseline, which points to the left.
    run.warp_px = -window.warp_px()[0];
    run.sigma_warp_px = window.sigma_warp_px()[0];
    run.dispersion = window.dispersion.smoothed();
    (run, window)
}

fn exact() -> Settings {
    Settings {
        calibration_sigma_px: 0.0,
        ..Settings::default()
    }
}

/// The averages over runs of the pose's and of the motions' NEES, over six.
fn anees(runs: &[Run]) -> (f64, f64) {
    let pose = runs.iter().map(|r| r.nees_pose).sum::<f64>() / (6 * runs.len()) as f64;
    let motions: Vec<f64> = runs.iter().flat_map(|r| r.nees_motion.clone()).collect();
    (
        pose,
        motions.iter().sum::<f64>() / (6 * motions.len()) as f64,
    )
}

/// The average of the runs' dispersion.
fn dispersion(runs: &[Run]) -> f64 {
    runs.iter().map(|r| r.dispersion).sum::<f64>() / runs.len() as f64
}

#[test]
fn covariances_of_pose_and_motion_hold_whatever_the_length_of_tracks() {
    const RUNS: u64 = 60;
    for survival in [0.5, 0.9] {
        let runs: Vec<Run> = (0..RUNS)
            .map(|seed| drive(30, survival, 0.0, &exact(), seed))
            .collect();
        let (pose, motion) = anees(&runs);
        // χ²(360)/360: 99.7 % lie within 1 ± 0.22; the motions' share their landmarks.
        let (low, high) = consistency::anees_interval(6, RUNS as usize, 0.997);
        assert!((low..high).contains(&pose), "survival {survival}: {pose}");
        assert!(
            (0.94..1.06).contains(&motion),
            "survival {survival}: {motion}"
        );
        // Scores scatter as the theory has it, what the fit takes out included.
        let dispersion = dispersion(&runs);
        println!("survival {survival}: pose {pose}, motion {motion}, dispersion {dispersion}");
        assert!(
            (0.95..1.05).contains(&dispersion),
            "survival {survival}: {dispersion}"
        );
    }
}

#[test]
fn what_stays_with_a_landmark_does_not_average_out() {
    const RUNS: u64 = 60;
    // All in the window, so that no landmark begins anew.
    let settings = Settings {
        keyframes: 12,
        // What is off by far must not be taken for wrong.
        gate_sigma2: 1e3,
        ..exact()
    };
    let drive_by = |is_stated| {
        let runs = (0..RUNS).map(|seed| {
            let mut relief = Relief::new(0.3, is_stated, seed);
            drive_over(10, 0.9, 0.0, &mut relief, &settings, seed).0
        });
        let runs: Vec<Run> = runs.collect();
        (anees(&runs), dispersion(&runs))
    };
    let ((pose, motion), stated) = drive_by(true);
    let (low, high) = consistency::anees_interval(6, RUNS as usize, 0.997);
    assert!((low..high).contains(&pose), "{pose}");
    assert!((0.9..1.1).contains(&motion), "{motion}");
    assert!((0.9..1.1).contains(&stated), "{stated}");
    let ((ignored, _), noticed) = drive_by(false);
    println!("{ignored} beside {pose}; dispersion {noticed} beside {stated}");
    assert!(ignored > 1.3 * pose, "{ignored} beside {pose}");
    assert!(noticed > 1.2 * stated, "{noticed} beside {stated}");
}

#[test]
fn a_displaced_right_image_is_found_and_the_pose_covers_it() {
    const RUNS: u64 = 40;
    // As far off as the settings suppose; each run has its own.
    let supposed = Settings::default();
    let sigma_px = supposed.calibration_sigma_px;
    let runs: Vec<(f64, Run)> = (0..RUNS)
        .map(|seed| {
            let displaced_px = sigma_px * (2.0 * seed as f64 / (RUNS - 1) as f64 - 1.0);
            (displaced_px, drive(30, 0.9, displaced_px, &supposed, seed))
        })
        .collect();
    let mut squares = 0.0;
    for (displaced_px, run) in &runs {
        assert!(run.sigma_warp_px < 0.5 * sigma_px, "{}", run.sigma_warp_px);
        let error = run.warp_px - displaced_px;
        squares += (error / run.sigma_warp_px).powi(2) / RUNS as f64;
    }
    // χ²(40)/40: 99.7 % lie within [0.43, 1.82].
    assert!((0.43..1.82).contains(&squares), "{squares}");
    let runs: Vec<Run> = runs.into_iter().map(|(_, run)| run).collect();
    let (pose, motion) = anees(&runs);
    let (low, high) = consistency::anees_interval(6, RUNS as usize, 0.997);
    assert!((low..high).contains(&pose), "{pose}");
    assert!((0.9..1.1).contains(&motion), "{motion}");
}

#[test]
fn nothing_is_lost_of_precision_over_many_keyframes() {
    let run = drive(300, 0.8, 0.0, &exact(), 7);
    let motion = run.nees_motion.iter().sum::<f64>() / (6 * run.nees_motion.len()) as f64;
    let late = &run.nees_motion[200..];
    let late = late.iter().sum::<f64>() / (6 * late.len()) as f64;
    assert!((0.85..1.15).contains(&motion), "{motion}");
    assert!((0.75..1.25).contains(&late), "{late}");
}

/// All that a window says of its unknowns where they stand: information, right side, and by how much that moves
/// with each source of error.
fn said(window: &Window) -> (DMatrix<f64>, DVector<f64>, UnknownsBySources) {
    let (mut system, mut memory) = (System::default(), Memory::default());
    let (hessian, gradient, _) = window.equations(&mut system, &mut memory, 0.0);
    let at = At::new(
        &window.rig,
        &window.warp,
        &window.frames,
        window.variance.smoothed,
    );
    let by_sources =
        Sensitivity::with_room(0).right_side(&at, &window.errors, &system, &window.landmarks);
    (hessian, gradient, by_sources + window.prior.by_sources)
}

#[test]
fn what_is_retired_says_the_same_of_the_poses() {
    let mut relief = Relief::new(0.0, false, 5);
    let (_, mut window) = drive_over(40, 0.97, 0.1, &mut relief, &Settings::default(), 5);
    // A third of the landmarks has been out of view for a while.
    let recent: Vec<u64> = window.keyframe_serials().skip(11).collect();
    let old = window.landmarks.iter_mut().filter(|l| l.anchor < recent[0]);
    for landmark in old.step_by(3) {
        for serial in &recent {
            landmark.forget(*serial);
        }
    }
    let landmarks = window.landmarks.len();
    let (hessian, gradient, by_sources) = said(&window);
    window.retire_landmarks();
    assert!(window.landmarks.len() + 10 < landmarks, "{landmarks}");
    let (hessian_after, gradient_after, by_sources_after) = said(&window);
    let gap = (hessian_after - &hessian).norm() / hessian.norm();
    assert!(gap < 1e-12, "{gap}");
    let gap = (gradient_after - &gradient).norm() / gradient.norm();
    assert!(gap < 1e-6, "{gap} of {}", gradient.norm());
    let gap = (by_sources_after - by_sources).norm() / by_sources.norm();
    assert!(gap < 1e-9, "{gap}");
}

#[test]
fn a_standing_robot_neither_drifts_nor_grows_its_covariance() {
    let rig = simulation::thesis_rig();
    let world = points::Settings {
        landmarks: 80,
        survival: 1.0,
        ..points::Settings::default()
    };
    let mut simulation = points::PointSimulation::new(rig.clone(), world, 3).expect("valid");
    let mut frame = points::PointFrame::default();
    let mut window = Window::new(rig, exact());
    let still = Isometry3::identity();
    simulation.observe(&still, &mut frame);
    window.begin_at(&still, &(Matrix6::identity() * 1e-16), &BySources::zeros());
    let mut relief = Relief::new(0.0, false, 0);
    window.promote(&sights(&frame, 0.0, &mut relief));
    let mut first_cov = None;
    for k in 1..=60 {
        simulation.observe(&still, &mut frame);
        let seen = sights(&frame, 0.0, &mut relief);
        window.add(&still, &seen);
        let tracked = window.adjust(1.0).expect("determined");
        window.settle();
        let sigma_m = tracked.cov_pose_right[(2, 2)].sqrt();
        let first = *first_cov.get_or_insert(sigma_m);
        assert!(sigma_m < 1.3 * first, "pair {k}: {sigma_m} after {first}");
        assert!(
            tracked.odom_from_now.translation.z.abs() < 5.0 * sigma_m,
            "pair {k}: {}",
            tracked.odom_from_now
        );
    }
}

#[test]
fn what_cannot_be_adjusted_leaves_the_window_as_it_was() {
    let rig = simulation::thesis_rig();
    let mut window = Window::new(rig, exact());
    window.begin_at(
        &Isometry3::identity(),
        &(Matrix6::identity() * 1e-12),
        &BySources::zeros(),
    );
    window.promote(&[]);
    let before = window.newest_serial();
    window.add(&step(), &[]);
    assert!(window.adjust(1.0).is_none());
    assert_eq!(window.newest_serial(), before);
    assert!(
        window
            .consent(&[], &[], &step(), 1, &mut Vec::new())
            .is_none()
    );
}

#[test]
fn a_frame_that_shows_two_motions_is_refused_and_a_few_wrong_sights_are_left_out() {
    let rig = simulation::thesis_rig();
    let world = points::Settings {
        landmarks: 80,
        ..points::Settings::default()
    };
    let mut simulation = points::PointSimulation::new(rig.clone(), world, 5).expect("valid");
    let mut frame = points::PointFrame::default();
    let mut relief = Relief::new(0.0, false, 5);
    simulation.observe(&Isometry3::identity(), &mut frame);
    let first = sights(&frame, 0.0, &mut relief);
    simulation.observe(&step(), &mut frame);
    for (wrong, is_refused) in [(0.1, false), (0.3, true)] {
        let mut window = Window::new(rig.clone(), exact());
        let begin = Isometry3::identity();
        window.begin_at(&begin, &(Matrix6::identity() * 1e-16), &BySources::zeros());
        window.promote(&first);
        let before = window.newest_serial();
        let mut seen = sights(&frame, 0.0, &mut relief);
        seen.retain(|s| window.landmark(s.id).is_some());
        let wrong = (wrong * seen.len() as f64) as usize;
        for s in &mut seen[..wrong] {
            s.measurement.px += Vector4::new(0.0, 8.0, 0.0, 8.0);
        }
        window.add(&step(), &seen);
        let tracked = window.adjust(0.2);
        assert_eq!(tracked.is_none(), is_refused, "{wrong} of {}", seen.len());
        assert_eq!(window.newest_serial() == before, is_refused);
        // Of a frame that is not believed nobody is to blame.
        let blamed = seen.iter().filter(|s| {
            window
                .landmark(s.id)
                .is_some_and(|landmark| landmark.wrong > 0)
        });
        assert_eq!(blamed.count(), if is_refused { 0 } else { wrong });
    }
}

/// Depths, m: all far, all near, all on a plane, a few hundred metres, or the usual.
const DEPTHS_M: [[f64; 2]; 5] = [
    [800.0, 5000.0],
    [0.8, 1.5],
    [8.0, 8.001],
    [100.0, 400.0],
    [2.0, 40.0],
];

/// Few landmarks, which need not determine anything, seen by a robot that stands, drives or turns.
#[test]
fn every_covariance_is_one_under_ten_thousand_configurations() {
    let rig = simulation::thesis_rig();
    let (mut given, mut refused) = (0, 0);
    for seed in 0..560 {
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(seed);
        let world = points::Settings {
            landmarks: rng.random_range(6..30),
            depth_m: DEPTHS_M[seed as usize % DEPTHS_M.len()],
            survival: rng.random_range(0.3..1.0),
            ..points::Settings::default()
        };
        let mut simulation = points::PointSimulation::new(rig.clone(), world, seed).expect("valid");
        let mut frame = points::PointFrame::default();
        let settings = Settings {
            min_inliers: 3,
            ..Settings::default()
        };
        let mut window = Window::new(rig.clone(), settings);
        let mut truth = Isometry3::identity();
        let mut relief = Relief::new(0.0, false, seed);
        let mut begins = true;
        for _ in 0..25 {
            let step = match rng.random_range(0..3) {
                0 => Isometry3::identity(),
                1 => step(),
                _ => se3::exp(&Vector6::new(0.0, 0.0, 0.05, 0.02, 0.2, -0.05)),
            };
            truth *= step;
            simulation.observe(&truth, &mut frame);
            let seen = sights(&frame, 0.0, &mut relief);
            if begins {
                window.begin_at(&truth, &(Matrix6::identity() * 1e-12), &BySources::zeros());
                window.promote(&seen);
                begins = false;
                continue;
            }
            let (known, new): (Vec<Seen>, Vec<Seen>) =
                seen.iter().partition(|s| window.landmark(s.id).is_some());
            window.add(&step, &known);
            let Some(tracked) = window.adjust(1.0) else {
                refused += 1;
                begins = true;
                continue;
            };
            given += 1;
            for (what, cov) in [
                ("pose", tracked.cov_pose_right),
                ("motion", tracked.motion.cov_right),
            ] {
                let is_one = consistency::nees(&Vector6::repeat(1e-3), &cov).is_some();
                assert!(is_one, "{what}, run {seed}: {cov}");
            }
            window.settle();
            if rng.random_bool(0.7) {
                window.promote(&new);
            }
        }
    }
    println!("{given} given, {refused} refused");
    assert!(given >= 10_000, "{given}, {refused}");
}

/// What two frames that see these points say of the motion between them.
fn motion_by(points: &[Vector3<f64>]) -> Tracked {
    let rig = simulation::thesis_rig();
    let mut window = Window::new(rig.clone(), exact());
    window.begin_at(
        &Isometry3::identity(),
        &(Matrix6::identity() * 1e-16),
        &BySources::zeros(),
    );
    let seen_after = |motion: &Isometry3<f64>| -> Vec<Seen> {
        let seen = (0..).zip(points).filter_map(|(id, point)| {
            let inverse_depth = Vector3::new(point.x / point.z, point.y / point.z, 1.0 / point.z);
            Some(Seen {
                id,
                measurement: StereoMeasurement {
                    px: crate::estimation::seen_at(&rig, &motion.inverse(), &inverse_depth)?,
                    sigma_px: Vector4::repeat(SIGMA_PX),
                },
                relief_px: Vector2::zeros(),
            })
        });
        seen.collect()
    };
    window.promote(&seen_after(&Isometry3::identity()));
    window.add(&step(), &seen_after(&step()));
    window.adjust(1.0).expect("determined")
}

/// A hundred points, spread over what the cameras see from 0 to 1 across and down, at these depths.
fn spread_over(at: impl Fn(f64, f64) -> Vector3<f64>) -> Vec<Vector3<f64>> {
    let place = |n: u32| (f64::from(n % 10) / 9.0, f64::from(n / 10) / 9.0);
    (0..100).map(place).map(|(u, v)| at(u, v)).collect()
}

fn in_view(u: f64, v: f64, depth_m: f64) -> Vector3<f64> {
    Vector3::new(
        (u - 0.5) * 0.6 * depth_m,
        (v - 0.5) * 0.45 * depth_m,
        depth_m,
    )
}

#[test]
fn what_the_points_leave_open_is_told_axis_by_axis() {
    let open = |points: &[Vector3<f64>]| -> Vec<&str> {
        let cov = motion_by(points).motion.cov_right;
        crate::estimation::Axes::left_open_by(&cov)
            .names()
            .collect()
    };
    let depth = |u: f64, v: f64, near_m: f64, far_m: f64| {
        near_m + (far_m - near_m) * ((7.0 * u + 3.0 * v) % 1.0)
    };
    let room = spread_over(|u, v| in_view(u, v, depth(u, v, 3.0, 20.0)));
    assert_eq!(open(&room), [""; 0]);
    // To two cameras a wall is enough.
    assert_eq!(open(&spread_over(|u, v| in_view(u, v, 6.0))), [""; 0]);
    // Mountains tell how the robot turns, and little of how it goes.
    let mountains = spread_over(|u, v| in_view(u, v, depth(u, v, 3000.0, 10_000.0)));
    assert_eq!(open(&mountains), ["x", "y", "z"]);
    // Around a post the robot may have gone without seeing it.
    let post = spread_over(|u, v| Vector3::new(0.01 * (u - 0.5), 2.0 * (v - 0.5), 6.0));
    assert_eq!(open(&post), ["x", "ry"]);
}
