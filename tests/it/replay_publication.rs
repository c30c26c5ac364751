//! `visod replay` publishes what `visod listen`, a second process, receives.

use super::accuracy::test_recording;
use super::publication::{PATIENCE, System};
use super::replay::{PAIRS, Recording, Replayed, replay, stderr_of};
use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion, Vector4};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::time::Duration;
use visod::geometry::{load_rig, rig_to_toml};
use visod::output::health::CameraState;
use visod::output::publisher::Publisher;
use visod::output::subscriber::{FeaturesSubscriber, HealthSubscriber, Wake};

/// A configuration that publishes in `system`.
fn config_for(system: &System, folder: &Path) -> PathBuf {
    let config = folder.join("visod.toml");
    let publish = format!(
        "[publish]\nroot = \"{}\"\nprefix = \"{}\"\n",
        system.root(),
        system.prefix()
    );
    std::fs::write(&config, publish).unwrap();
    config
}

/// Replays a recording in an iceoryx2 of its own, to a listener that was there first.
fn heard(recording: &Path, pairs: u64) -> (Replayed, Vec<String>) {
    let system = System::new();
    let folder = tempfile::tempdir().unwrap();
    let config = config_for(&system, folder.path());
    let listener = system.listen(&["--json", "--count", &pairs.to_string(), "--timeout", "60"]);
    // Another publisher, which leaves before the replay comes, tells when the listener is there.
    let publisher = Publisher::new(&system.settings).unwrap();
    assert!(publisher.wait_for_subscribers(1, PATIENCE));
    publisher.close();
    let run = replay(recording, &["--config", config.to_str().unwrap()]);
    assert_eq!(stderr_of(&run.output), "");
    assert_eq!(run.summary["published"].as_u64(), Some(pairs));
    assert_eq!(run.summary["publish_failures"].as_u64(), Some(0));
    let output = listener.wait_with_output().unwrap();
    assert!(output.status.success(), "{}", stderr_of(&output));
    let text = String::from_utf8(output.stdout).unwrap();
    (run, text.lines().map(str::to_owned).collect())
}

/// The features that a replay by one method publishes: each pair's, with what its row rests on.
#[test]
fn features_of_a_replay_are_where_both_images_show_them() {
    let recording = Recording::shared();
    let rig = load_rig(&recording.path().join("rig.toml")).unwrap();
    for method in ["window", "bundle"] {
        let system = System::new();
        let folder = tempfile::tempdir().unwrap();
        let config = config_for(&system, folder.path());
        let mut text = std::fs::read_to_string(&config).unwrap();
        text.push_str(&format!(
            "features = true\n[estimation]\nmethod = \"{method}\"\n"
        ));
        std::fs::write(&config, text).unwrap();
        let mut subscriber = FeaturesSubscriber::new("test", &system.settings).unwrap();
        let heard = std::thread::spawn(move || {
            let mut heard = Vec::new();
            while (heard.len() as u64) < PAIRS {
                assert_eq!(subscriber.wait(PATIENCE), Ok(Wake::Message));
                let received = subscriber.receive().unwrap().unwrap();
                assert_eq!(received.lost_before, 0);
                heard.push(Box::new(received.message));
            }
            heard
        });
        let run = replay(recording.path(), &["--config", config.to_str().unwrap()]);
        assert_eq!(stderr_of(&run.output), "");
        let mut oldest = 0;
        for (message, row) in heard.join().unwrap().iter().zip(&run.rows) {
            assert_eq!(message.sequence, row.sequence);
            assert!(message.count + message.left_out >= row.counts.inliers);
            assert!(message.in_use().is_sorted_by_key(|f| f.id));
            let mut off_px = 0.0;
            for f in message.in_use() {
                assert!(u64::from(f.age) <= row.sequence);
                assert!(
                    [f.cov_m2[0], f.cov_m2[3], f.cov_m2[5]]
                        .iter()
                        .all(|v| *v > 0.0)
                );
                let seen = rig.project(&f.point_m.into()).unwrap();
                let [x, y] = f.left_px.map(f64::from);
                let [right_x, right_y] = f.right_px.map(f64::from);
                off_px += (seen - Vector4::new(x, y, right_x, right_y)).norm();
                oldest = oldest.max(f.age);
            }
            assert!(
                off_px <= 0.5 * f64::from(message.count),
                "{method}: {off_px} px"
            );
        }
        assert!(oldest >= 3, "{method}: {oldest}");
    }
}

/// Every column of the CSV stands in the message with the same text.
fn assert_same_text(run: &Replayed, messages: &[String]) {
    let mut lines = run.csv.lines();
    let header: Vec<&str> = lines.next().unwrap().split(',').collect();
    assert_eq!(messages.len(), run.rows.len());
    for (line, message) in lines.zip(messages) {
        for (name, text) in header.iter().zip(line.split(',')) {
            let expected = match (*name, text) {
                (_, "nan") => format!("\"{name}\":null"),
                ("status", word) => format!("\"{name}\":\"{word}\""),
                (_, number) => format!("\"{name}\":{number}"),
            };
            let at = message.find(&expected);
            let end = at.and_then(|at| message[at + expected.len()..].chars().next());
            assert!(
                matches!(end, Some(',' | '}')),
                "{expected} is not in {message}"
            );
        }
    }
}

#[test]
fn a_listener_hears_every_row_of_a_replay_digit_by_digit() {
    let recording = Recording::shared();
    let (run, messages) = heard(recording.path(), PAIRS);
    assert_same_text(&run, &messages);
    for message in &messages {
        let message: Value = serde_json::from_str(message).unwrap();
        assert_eq!(message["replay"], true);
        assert_eq!(message["frame"], "left_camera");
        for stage in ["features", "matching", "estimation", "total"] {
            let ns = message["latencies_ns"][stage].as_u64();
            assert!(ns > Some(0), "{stage}: {message}");
        }
    }
}

#[test]
fn a_listener_hears_every_row_of_a_drive_of_kitti_digit_by_digit() {
    let Some(recording) = test_recording("kitti_straight") else {
        return;
    };
    let (run, messages) = heard(&recording, 51);
    assert_same_text(&run, &messages);
}

#[test]
fn with_a_mounting_the_pose_of_the_base_is_published() {
    let recording = Recording::shared();
    let copy = recording.copy();
    let mut rig = load_rig(&copy.path().join("rig.toml")).unwrap();
    let base_from_camera = Isometry3::from_parts(
        Translation3::new(0.4, 0.1, 0.8),
        UnitQuaternion::from_euler_angles(-1.6, 0.1, -1.5),
    );
    rig.base_from_camera = Some(base_from_camera);
    std::fs::write(copy.path().join("rig.toml"), rig_to_toml(&rig)).unwrap();
    let (run, messages) = heard(copy.path(), PAIRS);
    for (row, message) in run.rows.iter().zip(&messages) {
        let message: Value = serde_json::from_str(message).unwrap();
        assert_eq!(message["frame"], "base");
        let number = |name: &str| message[name].as_f64().unwrap();
        let [x, y, z, i, j, k, w] = ["tx", "ty", "tz", "qx", "qy", "qz", "qw"].map(number);
        let published = Isometry3::from_parts(
            Translation3::new(x, y, z),
            UnitQuaternion::new_normalize(Quaternion::new(w, i, j, k)),
        );
        let expected = base_from_camera * row.odom_from_camera * base_from_camera.inverse();
        let off = published.inverse() * expected;
        assert!(off.translation.vector.norm() < 1e-9 && off.rotation.angle() < 1e-9);
    }
    // The file keeps the camera's pose.
    let plain = super::replay::replay_quietly(recording.path(), &[]);
    assert!(run.csv == plain.csv);
}

#[test]
fn health_is_published_with_every_change_of_status() {
    let system = System::new();
    let folder = tempfile::tempdir().unwrap();
    let config = config_for(&system, folder.path());
    let mut health = HealthSubscriber::new("health test", &system.settings).unwrap();
    let recording = Recording::shared();
    let mut heard = Vec::new();
    let run = std::thread::scope(|scope| {
        let replaying =
            scope.spawn(|| replay(recording.path(), &["--config", config.to_str().unwrap()]));
        // A subscriber connects as it receives, so it must do so while the replay runs.
        while !replaying.is_finished() {
            health.wait(Duration::from_millis(100)).unwrap();
            while let Some(received) = health.receive().unwrap() {
                received.message.validate().unwrap();
                heard.push(received.message);
            }
        }
        replaying.join().unwrap()
    });
    // The first pair initializes, the second tracks: two changes at least.
    assert!(heard.len() >= 2, "{heard:?}");
    assert_eq!(heard[0].odometry_status, 0);
    assert_eq!(heard[1].odometry_status, 1);
    for (n, message) in heard.iter().enumerate() {
        assert_eq!(message.left_state, CameraState::Streaming as u32);
        assert!(message.pairs_processed > n as u64);
        assert!(message.pairs_processed <= PAIRS);
        assert_eq!(
            message.left_frames + message.pairs_unusable,
            message.pairs_processed
        );
        assert_eq!(message.subscribers, 0, "odometry had none");
    }
    assert_eq!(run.summary["published"].as_u64(), Some(PAIRS));
}
