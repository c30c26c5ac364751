//! What a robot meets: bodies that move along, turning on the spot, stopping and going, darkness. Rendered in
//! full size, carried through `visod replay`, and held to the truth.

use super::replay::{
    Replayed, assert_covariances_hold, errors_m, replay_quietly, stderr_of, true_poses, visod,
};
use nalgebra::Isometry3;
use std::path::{Path, PathBuf};
use visod::estimation::Status::{Initializing, Lost, Tracking};

/// A rendered recording, replayed.
struct Drive {
    _folder: tempfile::TempDir,
    recording: PathBuf,
    run: Replayed,
}

impl Drive {
    fn new(arguments: &[&str]) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let recording = folder.path().join("drive");
        let output = visod()
            .arg("simulate")
            .args(arguments)
            .arg(&recording)
            .output()
            .unwrap();
        assert!(output.status.success(), "{}", stderr_of(&output));
        let run = replay_quietly(&recording, &[]);
        assert_covariances_hold(&run.rows);
        Self {
            _folder: folder,
            recording,
            run,
        }
    }

    fn truth(&self) -> Vec<Isometry3<f64>> {
        true_poses(&self.recording)
    }

    /// Distance of the last pose from the truth, over the length of the way.
    fn drift(&self) -> f64 {
        let truth = self.truth();
        let way_m: f64 = truth
            .windows(2)
            .map(|two| (two[1].translation.vector - two[0].translation.vector).norm())
            .sum();
        let errors_m = errors_m(&self.run.rows, &truth);
        println!(
            "{} ends {errors_m:?} off after {way_m} m",
            name(&self.recording)
        );
        errors_m[errors_m.len() - 1] / way_m
    }
}

fn name(path: &Path) -> String {
    path.display().to_string()
}

#[test]
fn bodies_that_move_along_do_not_lead_the_estimate() {
    let drive = Drive::new(&[
        "--scene",
        "mover",
        "--trajectory",
        "slalom",
        "--frames",
        "16",
    ]);
    assert!(drive.run.rows[1..].iter().all(|row| row.status == Tracking));
    let drift = drive.drift();
    assert!(drift < 0.001, "{drift}");
}

#[test]
fn turning_on_the_spot_by_seven_degrees_from_pair_to_pair_is_followed() {
    let drive = Drive::new(&[
        "--scene",
        "hall",
        "--trajectory",
        "fast-turn",
        "--frames",
        "15",
    ]);
    assert!(drive.run.rows[1..].iter().all(|row| row.status == Tracking));
    let truth = drive.truth();
    let turned_rad: f64 = truth
        .windows(2)
        .map(|two| two[0].rotation.angle_to(&two[1].rotation))
        .sum();
    assert!(turned_rad > 14.0 * 6.9_f64.to_radians(), "{turned_rad}");
    let last = drive.run.rows.last().unwrap();
    let off_rad = last.odom_from_camera.rotation.angle_to(&truth[14].rotation);
    assert!(
        off_rad < 0.001 * turned_rad,
        "{off_rad} of {turned_rad} rad"
    );
    assert!(errors_m(&drive.run.rows, &truth)[14] < 0.005);
}

#[test]
fn a_robot_that_stops_neither_drifts_nor_grows_its_covariance() {
    // At 2 Hz: stands from second 6 to second 8.
    let arguments = [
        "--scene",
        "hall",
        "--trajectory",
        "stop-and-go",
        "--rate",
        "2",
        "--frames",
        "20",
    ];
    let drive = Drive::new(&arguments);
    let rows = &drive.run.rows;
    assert!(rows[1..].iter().all(|row| row.status == Tracking));
    let drift = drive.drift();
    assert!(drift < 0.001, "{drift}");
    let truth = drive.truth();
    let stands = |k: &usize| {
        let moved = truth[*k].translation.vector - truth[*k - 1].translation.vector;
        moved.norm() < 1e-6
    };
    let standing: Vec<usize> = (1..truth.len()).filter(stands).collect();
    assert!(standing.len() >= 3, "{standing:?}");
    let (first, last) = (&rows[standing[0]], &rows[standing[standing.len() - 1]]);
    let moved =
        last.odom_from_camera.translation.vector - first.odom_from_camera.translation.vector;
    assert!(moved.norm() < 1e-3, "{moved}");
    let grown = last.cov_pose.trace() / first.cov_pose.trace();
    assert!(grown < 1.1, "{grown}");
}

#[test]
fn ten_black_pairs_are_lost_with_an_honest_covariance_and_found_again() {
    let arguments = [
        "--scene",
        "hall",
        "--trajectory",
        "circle",
        "--frames",
        "22",
        "--blackout",
        "8..18",
    ];
    let drive = Drive::new(&arguments);
    for row in &drive.run.rows {
        let expected = match row.sequence {
            0 => Initializing,
            8..18 => Lost,
            _ => Tracking,
        };
        // After a loss a few pairs must agree before a status is good again.
        let is_rising = (18..21).contains(&row.sequence) && row.status != Lost;
        assert!(
            row.status == expected || is_rising,
            "{}: {:?}",
            row.sequence,
            row.status
        );
        assert_eq!(row.epoch, drive.run.rows[0].epoch, "{}", row.sequence);
    }
    let errors_m = errors_m(&drive.run.rows, &drive.truth());
    for row in &drive.run.rows[8..18] {
        let sigma_m = row.cov_pose.fixed_view::<3, 3>(0, 0).trace().sqrt();
        let error_m = errors_m[row.sequence as usize];
        assert!(
            error_m < 4.0 * sigma_m,
            "{}: {error_m} m, σ {sigma_m} m",
            row.sequence
        );
    }
    let drift = drive.drift();
    assert!(drift < 0.001, "{drift}");
}
