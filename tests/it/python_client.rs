//! The Python client in `tools/clients/` against the publisher.
//!
//! Needs a Python with `tools/clients/requirements.txt`: that of `VISOD_PYTHON`, else `python3`.
//! Without one these tests say so and do nothing.

use crate::publication::{System, message, odometry};
use serde_json::Value;
use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::time::Duration;
use visod::output::publisher::Publisher;

fn clients() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tools/clients")
}

/// A Python that can run the client, or none.
fn python() -> Option<Command> {
    let name = std::env::var("VISOD_PYTHON").unwrap_or_else(|_| "python3".to_owned());
    let able = Command::new(&name)
        .args(["-c", "import iceoryx2"])
        .stderr(Stdio::null())
        .status()
        .is_ok_and(|status| status.success());
    if !able {
        println!("skipped: {name} cannot import iceoryx2");
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
fn python_gets_every_number_bit_for_bit() {
    let Some(mut python) = python() else { return };
    let system = System::new();
    let listener = python
        .args(["listen.py", "--json", "--count", "60", "--timeout", "30"])
        .args(["--service-root", &system.root()])
        .args(["--service-prefix", &system.prefix()])
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut publisher = Publisher::new(&system.settings).unwrap();
    assert!(publisher.wait_for_subscribers(1, Duration::from_secs(60)));
    for sequence in 0..60 {
        publisher.publish(&message(sequence)).unwrap();
    }
    // Python answers the farewell too, so nothing is lost by leaving at once.
    publisher.close();
    let output = listener.wait_with_output().unwrap();
    assert!(output.status.success());
    let text = String::from_utf8(output.stdout).unwrap();
    assert_eq!(text.lines().count(), 60);
    for (sequence, line) in (0..).zip(text.lines()) {
        let heard: Value = serde_json::from_str(line).unwrap();
        assert_same(&heard, sequence);
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
    let Some(mut python) = python() else { return };
    let script = "import visod_client as v\n\
        for s in (v.OdometryMessage, v.HealthMessage):\n\
        \x20   for f, _ in s._fields_: print(s.type_name(), f, getattr(s, f).offset)";
    let output = python.args(["-c", script]).output().unwrap();
    let python_knows = String::from_utf8(output.stdout).unwrap();
    let mut documented = String::new();
    for (name, source) in [
        (
            "visod::OdometryMessage.1",
            include_str!("../../src/output/message.rs"),
        ),
        (
            "visod::HealthMessage.1",
            include_str!("../../src/output/health.rs"),
        ),
    ] {
        for row in source.lines().filter_map(|l| l.strip_prefix("//! | ")) {
            let cells: Vec<_> = row.split(" | ").collect();
            if let Ok(offset) = cells[0].parse::<usize>() {
                let field = cells[2].trim_matches('`');
                documented.push_str(&format!("{name} {field} {offset}\n"));
            }
        }
    }
    assert_eq!(python_knows, documented);
}
