//! The live view for Foxglove, to a client that speaks its protocol over a WebSocket.
//!
//! Needs a Python with `websockets`, `mcap` and `mcap-ros2-support`: that of `VISOD_PYTHON`, else `python3`.
//! Without one these tests say so and do nothing.

use super::publication::odometry;
use super::python_client::python;
use super::replay::{Recording, stderr_of, visod};
use serde_json::Value;
use std::io::{BufRead, BufReader};
use std::net::SocketAddr;
use std::process::Stdio;
use std::time::{Duration, Instant};
use visod::capture::{Dataset, PairEvent, PairSource, ReadAhead, StereoPair};
use visod::estimation::{Landmark, StereoMeasurement, TrackedFeature};
use visod::output::foxglove::FoxgloveServer;
use visod::output::message::Latencies;

const ANYWHERE: &str = "127.0.0.1:0";
const LATENCIES: Latencies = Latencies {
    capture_ns: 0,
    features_ns: 3_000_000,
    matching_ns: 2_000_000,
    estimation_ns: 1_000_000,
    total_ns: 7_000_000,
};

fn server() -> FoxgloveServer {
    let loopback: SocketAddr = ANYWHERE.parse().unwrap();
    FoxgloveServer::start(loopback, &visod::simulation::small_rig()).unwrap()
}

fn pair() -> StereoPair {
    // Its files go with the last who has it.
    let recording = Recording::shared();
    let dataset = Dataset::open(recording.path(), None).unwrap();
    let mut source = ReadAhead::start(&dataset).unwrap();
    match source.next_event() {
        Some(PairEvent::Pair(pair)) => pair,
        _ => unreachable!("the recording is whole"),
    }
}

fn tracked(count: u32) -> impl Iterator<Item = TrackedFeature> {
    (0..count).map(|i| TrackedFeature {
        id: u64::from(i),
        age: i,
        measurement: StereoMeasurement {
            px: nalgebra::Vector4::repeat(f64::from(i)),
            sigma_px: nalgebra::Vector4::repeat(0.5),
        },
        landmark: Landmark {
            point: nalgebra::Point3::new(0.0, 0.0, 1.0 + f64::from(i)),
            cov_m2: nalgebra::Matrix3::identity() * 1e-4,
        },
    })
}

/// Subscribes to everything that is advertised and tells of three messages of each topic.
const CLIENT: &str = r#"
import json, struct, sys
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from websockets.sync.client import connect

with connect(sys.argv[1], subprotocols=['foxglove.sdk.v1'], max_size=None) as socket:
    channels = {}
    while len(channels) < 12:
        said = json.loads(socket.recv(timeout=30))
        if said['op'] == 'advertise':
            channels.update({c['id']: c for c in said['channels']})
    subscriptions = [dict(id=i, channelId=i) for i in channels]
    socket.send(json.dumps(dict(op='subscribe', subscriptions=subscriptions)))
    print('subscribed', flush=True)
    heard = {i: [] for i in channels}
    while any(len(h) < 3 for h in heard.values()):
        data = socket.recv(timeout=30)
        if isinstance(data, bytes) and data[0] == 1:
            channel, time_ns = struct.unpack('<IQ', data[1:13])
            heard[channel].append((time_ns, data[13:]))

told = {}
for i, c in channels.items():
    times, (_, last) = [t for t, _ in heard[i]], heard[i][-1]
    t = told[c['topic']] = dict(schema=c['schemaName'], encoding=c['encoding'], times=times, size=len(last))
    if c['encoding'] == 'json':
        t['json'] = json.loads(last)
    elif c['encoding'] == 'cdr':
        schema = Schema(id=1, name=c['schemaName'], encoding='ros2msg', data=c['schema'].encode())
        m = DecoderFactory().decoder_for('cdr', schema)(last)
        if 'image' in c['topic']:
            t.update(format=m.format, jpeg=bytes(m.data)[:3] == b'\xff\xd8\xff')
        elif c['topic'] == '/visod/odometry':
            p = m.pose.pose.position
            t.update(position=[p.x, p.y, p.z], stamp=m.header.stamp.sec * 10**9 + m.header.stamp.nanosec)
        elif c['topic'] == '/visod/features':
            t.update(points=m.width)
json.dump(told, sys.stdout)
"#;

#[test]
fn a_client_is_shown_every_topic() {
    let Some(mut python) = python("websockets, mcap, mcap_ros2") else {
        return;
    };
    let mut server = server();
    let mut client = python
        .args(["-c", CLIENT, &server.url()])
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(client.stdout.take().unwrap()).lines();
    assert_eq!(lines.next().unwrap().unwrap(), "subscribed");
    let pair = pair();
    // Until the client has enough: a minute of recording.
    for sequence in 0..1200 {
        server
            .add(&odometry(sequence), LATENCIES, tracked(40), Some(&pair))
            .unwrap();
        std::thread::sleep(Duration::from_millis(20));
        if client.try_wait().unwrap().is_some() {
            break;
        }
    }
    let told: Value = serde_json::from_str(&lines.next().unwrap().unwrap()).unwrap();
    assert!(client.wait().unwrap().success());
    let topics = told.as_object().unwrap();
    assert_eq!(topics.len(), 12);
    for (topic, schema, encoding) in [
        ("/visod/odometry", "nav_msgs/msg/Odometry", "cdr"),
        ("/visod/features", "sensor_msgs/msg/PointCloud2", "cdr"),
        ("/tf_static", "tf2_msgs/msg/TFMessage", "cdr"),
        ("/right/camera_info", "sensor_msgs/msg/CameraInfo", "cdr"),
        (
            "/visod/annotations",
            "foxglove.ImageAnnotations",
            "protobuf",
        ),
        ("/visod/scene", "foxglove.SceneUpdate", "protobuf"),
        ("/visod/state", "visod.State", "json"),
    ] {
        assert_eq!(topics[topic]["schema"], schema, "{topic}");
        assert_eq!(topics[topic]["encoding"], encoding, "{topic}");
    }
    for (topic, told) in topics {
        let times: Vec<u64> = serde_json::from_value(told["times"].clone()).unwrap();
        assert!(times.is_sorted(), "{topic}: {times:?}");
        assert!(told["size"].as_u64() > Some(20), "{topic}");
    }
    let told = &topics["/visod/odometry"];
    let at_ns = told["stamp"].as_i64().unwrap();
    let sequence = (at_ns - odometry(0).timestamp_ns) / 50_000_000;
    let t = odometry(sequence as u64)
        .odom_from_camera
        .translation
        .vector;
    assert_eq!(told["position"], serde_json::json!([t.x, t.y, t.z]));
    assert_eq!(told["times"][2].as_i64(), Some(at_ns));
    assert_eq!(topics["/visod/features"]["points"], 40);
    assert_eq!(topics["/left/image_raw/compressed"]["jpeg"], true);
    assert_eq!(topics["/visod/state"]["json"]["latency_ms"]["total"], 7.0);
}

/// Subscribes to everything and never reads again.
const SLEEPER: &str = r#"
import json, sys, time
from websockets.sync.client import connect
socket = connect(sys.argv[1], subprotocols=['foxglove.sdk.v1'], max_size=None)
channels = []
while len(channels) < 12:
    said = json.loads(socket.recv(timeout=30))
    if said['op'] == 'advertise':
        channels += [c['id'] for c in said['channels']]
socket.send(json.dumps(dict(op='subscribe', subscriptions=[dict(id=i, channelId=i) for i in channels])))
print('subscribed', flush=True)
sys.stdin.read()
"#;

#[test]
fn a_client_that_sleeps_holds_nobody_up() {
    let Some(mut python) = python("websockets") else {
        return;
    };
    let mut server = server();
    let mut sleeper = python
        .args(["-c", SLEEPER, &server.url()])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(sleeper.stdout.take().unwrap()).lines();
    assert_eq!(lines.next().unwrap().unwrap(), "subscribed");
    let pair = pair();
    let mut longest = Duration::ZERO;
    // Far faster than JPEGs are made: what is left out is counted, nothing is waited for.
    for sequence in 0..3000 {
        let begun = Instant::now();
        server
            .add(&odometry(sequence), LATENCIES, tracked(300), Some(&pair))
            .unwrap();
        longest = longest.max(begun.elapsed());
    }
    assert!(server.left_out() > 100, "{}", server.left_out());
    // What is waited for at most is the processor, on a machine that is busy.
    assert!(longest < Duration::from_secs(1), "{longest:?}");
    println!("the longest hand-over took {longest:?}");
    drop(server);
    drop(sleeper.stdin.take());
    sleeper.wait().unwrap();
}

#[test]
fn a_replay_says_where_it_is_shown() {
    let recording = Recording::shared();
    let replay = |address: &str| {
        visod()
            .arg("replay")
            .arg(recording.path())
            .args(["--no-publish", "--foxglove", address])
            .output()
            .unwrap()
    };
    let output = replay(ANYWHERE);
    let said = stderr_of(&output);
    assert!(output.status.success(), "{said}");
    assert!(
        said.starts_with("visod: Foxglove finds this run at ws://127.0.0.1:"),
        "{said}"
    );
    let taken = std::net::TcpListener::bind(ANYWHERE).unwrap();
    let address = taken.local_addr().unwrap().to_string();
    let output = replay(&address);
    let said = stderr_of(&output);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(
        said.contains(&format!("cannot listen at {address}")),
        "{said}"
    );
    assert_eq!(said.lines().count(), 1, "{said}");
}

/// What the layout shows is what there is to be shown.
#[test]
fn the_layout_names_topics_that_exist() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/config/foxglove-layout.json");
    let text = std::fs::read_to_string(path).unwrap();
    let layout: Value = serde_json::from_str(&text).unwrap();
    let documented = concat!(
        include_str!("../../src/output/topics/mod.rs"),
        include_str!("../../src/output/foxglove/mod.rs"),
    );
    let state = include_str!("../../src/output/foxglove/state.rs");
    let mut topics = 0;
    for word in text.split('"').filter(|word| word.starts_with('/')) {
        let (topic, path) = word.split_once('.').unwrap_or((word, ""));
        assert!(
            documented.contains(&format!("{topic}`")) || documented.contains(topic),
            "{topic}"
        );
        for name in path.split('.').filter(|name| !name.is_empty()) {
            let is_part =
                ["detection", "calibration", "synchronisation", "bridging"].contains(&name);
            assert!(is_part || state.contains(&format!("\"{name}\"")), "{word}");
        }
        topics += 1;
    }
    assert!(topics > 15, "{topics}");
    let panels = layout["configById"].as_object().unwrap();
    for panel in panels.keys() {
        let arranged = layout["layout"].to_string();
        assert!(arranged.contains(&format!("\"{panel}\"")), "{panel}");
    }
}
