//! The Python client in `tools/clients/` against the publisher.
//!
//! Needs a Python with `tools/clients/requirements.txt`: that of `VISOD_PYTHON`, else `python3`.
//! Without one these tests say so and do nothing.

use crate::publication::{System, features, message, odometry};
use serde_json::Value;
use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};
use visod::output::features::Feature;
use visod::output::publisher::Publisher;

fn clients() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tools/clients")
}

/// A Python in the clients' folder that has the given modules, or none.
pub(crate) fn python(modules: &str) -> Option<Command> {
    let name = std::env::var("VISOD_PYTHON").unwrap_or_else(|_| "python3".to_owned());
    let able = Command::new(&name)
        .args(["-c", &format!("import {modules}")])
        .stderr(Stdio::null())
        .status()
        .is_ok_and(|status| status.success());
    if !able {
        println!("skipped: {name} cannot import {modules}");
        return None;
    }
    let mut command = Command::new(name);
    command
        .current_dir(clients())
        .env("PYTHONDONTWRITEBYTECODE", "1");
    Some(command)
}

/// Numbers of a JSON array, nested or not, as bits.
fn bits(value: &Value) -> Vec<u64> {
    match value {
        Value::Array(values) => values.iter().flat_map(bits).collect(),
        number => vec![number.as_f64().unwrap().to_bits()],
    }
}

fn bits_of<'a>(values: impl IntoIterator<Item = &'a f64>) -> Vec<u64> {
    values.into_iter().map(|v| v.to_bits()).collect()
}

#[test]
fn python_gets_a_thousand_of_a_thousand_at_100_hz_bit_for_bit() {
    let Some(mut python) = python("iceoryx2, numpy") else {
        return;
    };
    let system = System::new();
    let folder = tempfile::tempdir().unwrap();
    let heard = folder.path().join("heard");
    let mut listener = python
        .args(["listen.py", "--json", "--count", "1000", "--timeout", "30"])
        .args(["--service-root", &system.root()])
        .args(["--service-prefix", &system.prefix()])
        // Not a pipe: it would be full long before anybody reads it.
        .stdout(std::fs::File::create(&heard).unwrap())
        .spawn()
        .unwrap();
    let mut publisher = Publisher::new(&system.settings).unwrap();
    assert!(publisher.wait_for_subscribers(1, Duration::from_secs(60)));
    let begun = Instant::now();
    for sequence in 0..1000 {
        let due = begun + Duration::from_millis(10) * sequence as u32;
        std::thread::sleep(due.saturating_duration_since(Instant::now()));
        publisher.publish(&message(sequence)).unwrap();
    }
    // Python answers the farewell too, so nothing is lost by leaving at once.
    publisher.close();
    assert!(listener.wait().unwrap().success());
    let text = std::fs::read_to_string(&heard).unwrap();
    assert_eq!(text.lines().count(), 1000);
    for (sequence, line) in (0..).zip(text.lines()) {
        let heard: Value = serde_json::from_str(line).unwrap();
        assert_same(&heard, sequence);
    }
}

/// Features as numpy has them, which nobody can write into.
#[test]
fn python_gets_features_as_arrays() {
    let Some(mut python) = python("iceoryx2, numpy") else {
        return;
    };
    let system = System::new();
    let script = "import json, sys, visod_client as v\n\
        with v.FeaturesSubscriber(sys.argv[1], sys.argv[2]) as features:\n\
        \x20   m = features.wait(30)\n\
        a = m.features\n\
        assert not a.flags.writeable and not m.position_m.flags.writeable\n\
        json.dump([m.sequence, m.position_m.tolist(), {n: a[n].tolist() for n in a.dtype.names}], sys.stdout)";
    let listener = python
        .args(["-c", script, &system.root(), &system.prefix()])
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut publisher = Publisher::new(&system.with_features()).unwrap();
    let sent = features(7, 300);
    while publisher.features_subscribers() == 0 {
        std::thread::sleep(Duration::from_millis(5));
    }
    publisher.publish_features(&sent).unwrap();
    publisher.close();
    let output = listener.wait_with_output().unwrap();
    assert!(output.status.success());
    let heard: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(heard[0], 7);
    assert_eq!(bits(&heard[1]), bits_of(&sent.position_m));
    let heard = &heard[2];
    assert_eq!(heard["id"].as_array().unwrap().len(), 300);
    for (i, feature) in sent.in_use().iter().enumerate() {
        assert_eq!(heard["id"][i], feature.id);
        assert_eq!(heard["age"][i], feature.age);
        let right_px = feature.right_px.map(f64::from);
        assert_eq!(bits(&heard["right_px"][i]), bits_of(&right_px));
        assert_eq!(bits(&heard["point_m"][i]), bits_of(&feature.point_m));
        assert_eq!(bits(&heard["cov_m2"][i]), bits_of(&feature.cov_m2));
    }
}

fn assert_same(heard: &Value, sequence: u64) {
    let (sent, estimate) = (message(sequence), odometry(sequence));
    assert_eq!(heard["sequence"], sequence);
    assert_eq!(heard["message_number"], sequence);
    assert_eq!(heard["realtime_ns"], estimate.timestamp_ns);
    assert!(heard["monotonic_ns"].is_null());
    assert_eq!(heard["replay"], true);
    assert_eq!(heard["frame"], "left_camera");
    assert_eq!(heard["status"], estimate.status.as_str());
    assert_eq!(heard["keypoints_left"], estimate.counts.keypoints_left);
    assert_eq!(heard["latencies_ns"]["total"], 5);
    let floats: [(&str, &[f64]); 9] = [
        ("position_m", &sent.position_m),
        ("orientation_xyzw", &sent.orientation_xyzw),
        ("motion_translation_m", &sent.motion_translation_m),
        ("motion_rotation_xyzw", &sent.motion_rotation_xyzw),
        ("twist", &sent.twist),
        ("cov_pose", &sent.cov_pose),
        ("cov_motion", &sent.cov_motion),
        ("cov_twist", &sent.cov_twist),
        ("variance_factor", &[sent.variance_factor]),
    ];
    for (field, values) in floats {
        assert_eq!(bits(&heard[field]), bits_of(values), "{field}");
    }
    let budget = &estimate.budget;
    for (part, covariance) in [
        ("detection", &budget.detection),
        ("calibration", &budget.calibration),
        ("synchronisation", &budget.synchronisation),
        ("bridging", &budget.bridging),
    ] {
        let expected = bits_of(covariance.transpose().iter());
        assert_eq!(bits(&heard["budget"][part]), expected, "{part}");
    }
}

/// `struct field offset` of every field that Python knows.
#[test]
fn python_has_the_documented_layouts() {
    let Some(mut python) = python("iceoryx2, numpy") else {
        return;
    };
    let script = "import visod_client as v\n\
        for s in (v.OdometryMessage, v.FeaturesMessage, v.HealthMessage):\n\
        \x20   for f, _ in s._fields_: print(s.type_name(), f, getattr(s, f).offset)\n\
        for f in v.FEATURE.names: print('each', f, v.FEATURE.fields[f][1])\n\
        print('each', v.FEATURE.itemsize)";
    let output = python.args(["-c", script]).output().unwrap();
    let python_knows = String::from_utf8(output.stdout).unwrap();
    let features = include_str!("../../src/output/features.rs");
    let mut documented = String::new();
    for (name, source) in [
        (
            "visod::OdometryMessage.1",
            include_str!("../../src/output/message.rs"),
        ),
        ("visod::FeaturesMessage.1", features),
        (
            "visod::HealthMessage.1",
            include_str!("../../src/output/health.rs"),
        ),
    ] {
        let rows = source.lines().filter_map(|l| l.strip_prefix("//! | "));
        for row in rows.filter(|row| !row.starts_with('+')) {
            let cells: Vec<_> = row.split(" | ").collect();
            if let Ok(offset) = cells[0].parse::<usize>() {
                let field = cells[2].trim_matches('`');
                documented.push_str(&format!("{name} {field} {offset}\n"));
            }
        }
    }
    for row in features.lines().filter_map(|l| l.strip_prefix("//! | +")) {
        let cells: Vec<_> = row.split(" | ").collect();
        let field = cells[2].trim_matches('`');
        documented.push_str(&format!("each {field} {}\n", cells[0]));
    }
    documented.push_str(&format!("each {}\n", size_of::<Feature>()));
    assert_eq!(python_knows, documented);
}
