//! The bridge in `tools/clients/` to other systems: conventions, and MAVLink over loopback.
//!
//! Needs a Python with `tools/clients/requirements.txt`, as the tests of the Python client do.

use crate::publication::{System, message, odometry};
use crate::python_client::python;
use serde_json::Value;
use std::io::{BufRead, BufReader};
use std::process::Stdio;
use std::time::Duration;
use visod::output::publisher::Publisher;

#[test]
fn conventions_are_mapped_rightly() {
    let Some(mut python) = python("numpy") else {
        return;
    };
    let output = python
        .args(["-m", "unittest", "test_conventions"])
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}");
    assert!(said.contains("Ran 1"), "{said}");
}

/// Prints its port, then what arrives there: first a heartbeat, then every ODOMETRY.
const RECEIVER: &str = r#"
import json, math, socket, sys
from pymavlink import mavutil
free = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
free.bind(('127.0.0.1', 0))
port = free.getsockname()[1]
free.close()
link = mavutil.mavlink_connection(f'udpin:127.0.0.1:{port}', dialect='common')
print(port, flush=True)
beat = link.recv_match(type='HEARTBEAT', blocking=True, timeout=60)
print(json.dumps([beat.get_srcSystem(), beat.get_srcComponent()]))
for _ in range(int(sys.argv[1])):
    m = link.recv_match(type='ODOMETRY', blocking=True, timeout=60).to_dict()
    print(json.dumps({k: str(v) if isinstance(v, float) and math.isnan(v) else v for k, v in m.items()}))
"#;

#[test]
fn an_autopilot_receives_odometry_over_udp() {
    const COUNT: u64 = 30;
    let (Some(mut receiver), Some(mut bridge)) =
        (python("pymavlink, iceoryx2"), python("pymavlink, iceoryx2"))
    else {
        return;
    };
    let system = System::new();
    let mut receiver = receiver
        .env("MAVLINK20", "1")
        .args(["-c", RECEIVER, &COUNT.to_string()])
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(receiver.stdout.take().unwrap()).lines();
    let port = lines.next().unwrap().unwrap();
    let mut bridge = bridge
        .args([
            "bridge.py",
            "--mavlink",
            &format!("udpout:127.0.0.1:{port}"),
        ])
        .args(["--count", &COUNT.to_string()])
        .args([
            "--service-root",
            &system.root(),
            "--service-prefix",
            &system.prefix(),
        ])
        .spawn()
        .unwrap();
    let mut publisher = Publisher::new(&system.settings).unwrap();
    assert!(publisher.wait_for_subscribers(1, Duration::from_secs(60)));
    for sequence in 0..COUNT {
        publisher.publish(&message(sequence)).unwrap();
    }
    assert!(bridge.wait().unwrap().success());
    let beat = lines.next().unwrap().unwrap();
    // The autopilot's own system; the component of a visual odometry.
    assert_eq!(beat, "[1, 197]");
    for sequence in 0..COUNT {
        let heard: Value = serde_json::from_str(&lines.next().unwrap().unwrap()).unwrap();
        let sent = odometry(sequence);
        assert_eq!(heard["time_usec"], sent.timestamp_ns / 1000);
        assert_eq!(
            (&heard["frame_id"], &heard["child_frame_id"]),
            (&20.into(), &12.into())
        );
        assert_eq!(heard["reset_counter"], 1);
        let quality = [0, 87, 87, -1][sequence as usize % 4];
        assert_eq!(heard["quality"], quality);
        // The camera's right, down and forward are the body's y, z and x. MAVLink has single precision.
        let close = |name: &str, value: f64| {
            let heard = heard[name].as_f64().unwrap();
            assert!(
                (heard - value).abs() <= 1e-6 * value.abs().max(1e-3),
                "{name}: {heard} {value}"
            );
        };
        let t = sent.odom_from_camera.translation.vector;
        close("x", t.z);
        close("y", t.x);
        close("z", t.y);
        close("vx", sent.twist[2]);
        close("vy", sent.twist[0]);
        close("rollspeed", sent.twist[5]);
        let q = sent.odom_from_camera.rotation;
        let sign = if q.w < 0.0 { -1.0 } else { 1.0 };
        for (i, value) in [q.w, q.k, q.i, q.j].into_iter().enumerate() {
            let heard = heard["q"][i].as_f64().unwrap();
            assert!((heard - sign * value).abs() < 1e-6, "q[{i}]");
        }
        let velocity = &heard["velocity_covariance"];
        let variance = sent.cov_twist[(2, 2)];
        assert!((velocity[0].as_f64().unwrap() - variance).abs() < 1e-6 * variance);
    }
    assert!(receiver.wait().unwrap().success());
}

#[test]
fn what_is_missing_is_said_in_one_sentence() {
    let Some(mut bridge) = python("iceoryx2, numpy") else {
        return;
    };
    if python("rclpy").is_some() {
        println!("skipped: there is a ROS 2");
        return;
    }
    let output = bridge.args(["bridge.py", "--ros"]).output().unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(2), "{said}");
    assert_eq!(said, "bridge.py: rclpy is not here: source a ROS 2\n");
}
