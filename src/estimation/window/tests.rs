//! The window against simulated points: what it says of its own error must hold.

use super::super::{Settings, StereoMeasurement};
use super::*;
use crate::simulation::{self, points};
use crate::uncertainty::consistency;
use nalgebra::{Vector4, Vector6};

struct Run {
    nees_pose: f64,
    nees_motion: Vec<f64>,
    error: Vector6<f64>,
}

fn sigma(px: Vector4<f64>, sigma_px: f64) -> StereoMeasurement {
    StereoMeasurement {
        px,
        sigma_px: Vector4::repeat(sigma_px),
    }
}

/// Drives along a gentle curve; every frame is a keyframe.
fn drive(steps: usize, survival: f64, seed: u64) -> Run {
    let rig = simulation::thesis_rig();
    let settings = points::Settings {
        landmarks: 80,
        survival,
        ..points::Settings::default()
    };
    let mut simulation = points::PointSimulation::new(rig.clone(), settings, seed).expect("valid");
    let mut frame = points::PointFrame::default();
    let tiny = Matrix6::identity() * 1e-12;
    let estimation = Settings {
        good_inliers: 10,
        ..Settings::default()
    };
    let mut window = Window::new(rig, estimation);
    let step = se3::exp(&Vector6::new(0.01, 0.0, 0.2, 0.0, 0.01, 0.002));
    let mut truth = Isometry3::identity();
    let mut run = Run {
        nees_pose: 0.0,
        nees_motion: Vec::new(),
        error: Vector6::zeros(),
    };
    let nees = |error: &Vector6<f64>, cov: &Matrix6<f64>| {
        consistency::nees(error, cov).expect("positive definite")
    };
    for k in 0..=steps {
        simulation.observe(&truth, &mut frame);
        let sights: Vec<Seen> = frame
            .sights
            .iter()
            .map(|s| Seen {
                id: s.id,
                measurement: sigma(s.pixels, 0.5),
            })
            .collect();
        if k == 0 {
            window.begin_at(&Isometry3::identity(), &tiny);
            window.promote(&sights);
        } else {
            let (known, new): (Vec<Seen>, Vec<Seen>) =
                sights.iter().partition(|s| window.landmark(s.id).is_some());
            let consent = window
                .consent(&known, &vec![1.0; known.len()], &step, k as u64)
                .expect("agrees");
            let agreed: Vec<Seen> = consent.inliers.iter().map(|&i| known[i as usize]).collect();
            window.add(&consent.newest_from_now, &agreed);
            let tracked = window.adjust().expect("determined");
            let error = se3::log(&(truth.inverse() * tracked.odom_from_now));
            run.nees_pose = nees(&error, &tracked.cov_pose_right);
            run.error = error;
            run.nees_motion.push(nees(
                &se3::log(&(step.inverse() * tracked.motion.prev_from_now)),
                &tracked.motion.cov_right,
            ));
            window.settle();
            window.promote(&new);
        }
        truth *= step;
    }
    run
}

#[test]
fn pose_and_motion_covariances_hold() {
    for survival in [0.5, 0.8, 0.9, 0.97] {
        let runs: Vec<Run> = (0..40).map(|seed| drive(30, survival, seed)).collect();
        let pose: f64 = runs.iter().map(|r| r.nees_pose).sum::<f64>() / 6.0 / runs.len() as f64;
        let motions: Vec<f64> = runs
            .iter()
            .flat_map(|r| r.nees_motion.iter().copied())
            .collect();
        let motion = motions.iter().sum::<f64>() / 6.0 / motions.len() as f64;
        let t = (runs
            .iter()
            .map(|r| r.error.xyz().norm_squared())
            .sum::<f64>()
            / runs.len() as f64)
            .sqrt();
        println!("survival {survival}: pose {pose:.3} motion {motion:.3} rms {t:.5} m");
    }
}
