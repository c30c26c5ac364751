//! MCAP recordings: what visod writes is what it reads, and what ROS 2's own tools read and write.
//!
//! The latter needs a Python with `mcap` and `mcap-ros2-support`: that of `VISOD_PYTHON`, else
//! `python3`. Without one these tests say so and do nothing.

use super::frame_source::{Expected, assert_conforms};
use super::replay::{Recording, replay_quietly, stderr_of, visod};
use nalgebra::{Point3, Vector4};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;
use tempfile::TempDir;
use visod::capture::dataset::Settings;
use visod::capture::mcap::McapRecording;
use visod::capture::{Dataset, PairEvent, PairSource, ReadAhead, StereoPair};
use visod::image::GrayImage;
use visod::output::csv::read_odometry_csv;
use visod::output::row::OdometryRow;

/// A recording and the MCAP file that its replay wrote.
struct Written {
    recording: Arc<Recording>,
    folder: TempDir,
    csv: String,
}

impl Written {
    fn new() -> Self {
        let recording = Recording::shared();
        let folder = tempfile::tempdir().unwrap();
        let mut written = Self {
            recording,
            folder,
            csv: String::new(),
        };
        let file = written.file();
        let args = ["--mcap", file.to_str().unwrap()];
        written.csv = replay_quietly(written.recording.path(), &args).csv;
        written
    }

    fn file(&self) -> PathBuf {
        self.folder.path().join("run.mcap")
    }
}

/// The pairs of an MCAP file, until it ends or breaks off; and whether it broke off.
fn pairs_of(file: &Path) -> Option<(Vec<StereoPair>, bool)> {
    let recording = McapRecording::open(file, None, None, Settings::default()).ok()?;
    let mut source = recording.source().unwrap();
    let (mut pairs, mut is_cut) = (Vec::new(), false);
    while let Some(event) = source.next_event() {
        match event {
            PairEvent::Pair(pair) => pairs.push(pair),
            PairEvent::Unusable(_) => is_cut = true,
        }
    }
    Some((pairs, is_cut))
}

fn pairs_of_folder(folder: &Path) -> Vec<StereoPair> {
    let mut source = ReadAhead::start(&Dataset::open(folder, None).unwrap()).unwrap();
    let mut pairs = Vec::new();
    while let Some(PairEvent::Pair(pair)) = source.next_event() {
        pairs.push(pair);
    }
    pairs
}

#[test]
fn a_replay_of_what_a_replay_wrote_gives_the_same_bytes() {
    let written = Written::new();
    let (pairs, is_cut) = pairs_of(&written.file()).unwrap();
    assert!(!is_cut);
    assert!(pairs == pairs_of_folder(written.recording.path()));
    let again = replay_quietly(&written.file(), &[]);
    assert_eq!(again.csv, written.csv);
}

#[test]
fn a_source_from_mcap_conforms() {
    let written = Written::new();
    let events = pairs_of_folder(written.recording.path());
    let size_px = |image: &GrayImage| (image.width(), image.height());
    let expected = Expected {
        events: events.len() as u64,
        sizes_px: [size_px(&events[0].left), size_px(&events[0].right)],
        unusable: vec![],
    };
    let file = written.file();
    let recording = McapRecording::open(&file, None, None, Settings::default()).unwrap();
    assert_conforms(&expected, || recording.source().unwrap());
}

#[test]
fn the_same_replay_writes_the_same_file() {
    let (a, b) = (Written::new(), Written::new());
    let read = |w: &Written| std::fs::read(w.file()).unwrap();
    assert!(read(&a) == read(&b));
}

/// Wherever a file is cut, the pairs that are whole before the cut come out, and no others.
#[test]
fn a_file_that_was_cut_gives_what_is_whole() {
    let written = Written::new();
    let bytes = std::fs::read(written.file()).unwrap();
    let (whole, _) = pairs_of(&written.file()).unwrap();
    let cut_file = written.folder.path().join("cut.mcap");
    // A linear congruential generator is random enough, and the same everywhere.
    let mut random = 1_u64;
    let mut most = 0;
    for _ in 0..60 {
        random = random
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1);
        let at = (random >> 20) as usize % bytes.len();
        std::fs::write(&cut_file, &bytes[..at]).unwrap();
        let Some((pairs, _)) = pairs_of(&cut_file) else {
            continue;
        };
        assert!(pairs.len() <= whole.len());
        assert!(pairs == whole[..pairs.len()], "cut at {at}");
        // What an image takes at most, twice, for what is under way.
        let per_pair = bytes.len() / whole.len();
        let expected = (at / per_pair).saturating_sub(2);
        assert!(
            pairs.len() >= expected,
            "{} of {expected} at {at}",
            pairs.len()
        );
        most = most.max(pairs.len());
    }
    assert!(most + 3 > whole.len(), "{most}");
}

#[test]
fn mistakes_with_files_are_one_sentence_each() {
    let folder = tempfile::tempdir().unwrap();
    let refused = |name: &str, bytes: &[u8], args: &[&str], says: &[&str]| {
        let file = folder.path().join(name);
        std::fs::write(&file, bytes).unwrap();
        let output = visod()
            .arg("replay")
            .arg(&file)
            .args(args)
            .output()
            .unwrap();
        let said = stderr_of(&output);
        assert_eq!(output.status.code(), Some(2), "{said}");
        assert_eq!(said.lines().count(), 1, "{said}");
        for part in [name].iter().chain(says) {
            assert!(said.contains(part), "no '{part}' in: {said}");
        }
    };
    refused(
        "text.mcap",
        b"hello, this is no recording",
        &[],
        &["no MCAP file either"],
    );
    refused("empty.mcap", b"", &[], &["no MCAP file either"]);
    let written = Written::new();
    let bytes = std::fs::read(written.file()).unwrap();
    let topics = ["--topics", "/left/image_raw/compressed", "/nowhere"];
    refused(
        "topics.mcap",
        &bytes,
        &topics,
        &["on the topic /nowhere", "/right/image_raw/compressed"],
    );
    let output = visod()
        .arg("replay")
        .arg(written.recording.path())
        .args(["--no-publish", "--mcap", "/nowhere/run.mcap"])
        .output()
        .unwrap();
    assert_eq!(output.status.code(), Some(1));
    assert!(stderr_of(&output).contains("/nowhere/run.mcap: cannot be written"));
}

/// A Python that reads and writes recordings of ROS 2, or none.
fn python(script: &str) -> Option<Command> {
    let name = std::env::var("VISOD_PYTHON").unwrap_or_else(|_| "python3".to_owned());
    let able = Command::new(&name)
        .args(["-c", "import mcap, mcap_ros2, PIL, numpy"])
        .output()
        .is_ok_and(|output| output.status.success());
    if !able {
        println!("skipped: {name} cannot import mcap, mcap_ros2, PIL and numpy");
        return None;
    }
    let mut command = Command::new(name);
    command.args(["-c", script]);
    Some(command)
}

fn json_of(command: &mut Command) -> Value {
    let output = command.output().unwrap();
    assert!(output.status.success(), "{}", stderr_of(&output));
    serde_json::from_slice(&output.stdout).unwrap()
}

/// Everything that ROS 2's readers make of a file, as JSON.
const READ: &str = r#"
import hashlib, io, json, sys, numpy as np
from mcap_ros2.reader import read_ros2_messages
from PIL import Image

def xyz(v): return [v.x, v.y, v.z]
def xyzw(q): return [q.x, q.y, q.z, q.w]

counts, poses, images, frames, infos, clouds = {}, [], {}, [], {}, []
for m in read_ros2_messages(sys.argv[1]):
    topic, r = m.channel.topic, m.ros_msg
    counts[topic] = counts.get(topic, 0) + 1
    if topic == '/visod/odometry':
        stamp = r.header.stamp.sec * 10**9 + r.header.stamp.nanosec
        poses.append(dict(stamp=stamp, t=xyz(r.pose.pose.position), q=xyzw(r.pose.pose.orientation),
                          c=list(r.pose.covariance), twist=xyz(r.twist.twist.linear)))
    elif topic.endswith('compressed'):
        pixels = Image.open(io.BytesIO(bytes(r.data))).tobytes()
        images.setdefault(topic, []).append(hashlib.sha256(pixels).hexdigest())
    elif topic == '/tf_static':
        frames += [[t.header.frame_id, t.child_frame_id] for t in r.transforms]
    elif topic.endswith('camera_info'):
        infos[topic] = dict(k=list(r.k), p=list(r.p), width=r.width)
    elif topic == '/visod/features':
        kinds = {6: '<u4', 7: '<f4'}
        names = np.dtype([(f.name, kinds[f.datatype]) for f in r.fields])
        points = np.frombuffer(bytes(r.data), names)
        assert [f.offset for f in r.fields] == [4 * i for i in range(len(r.fields))]
        assert (len(points), names.itemsize, r.row_step) == (r.width, r.point_step, len(r.data))
        clouds.append([[float(v) for v in p] for p in points])
    elif topic == '/diagnostics':
        assert r.status[0].name == 'visod: odometry', r
json.dump(dict(counts=counts, poses=poses, images=images, frames=frames, infos=infos, clouds=clouds), sys.stdout)
"#;

#[test]
fn the_readers_of_ros_2_find_every_value() {
    let Some(mut python) = python(READ) else {
        return;
    };
    let written = Written::new();
    let read = json_of(python.arg(written.file()));
    let csv = written.folder.path().join("odometry.csv");
    std::fs::write(&csv, &written.csv).unwrap();
    let rows = read_odometry_csv(&csv).unwrap();
    let n = rows.len() as u64;
    for (topic, count) in [
        ("/visod/odometry", n),
        ("/visod/features", n),
        ("/tf", n),
        ("/tf_static", 1),
        ("/left/image_raw/compressed", n),
        ("/right/image_raw/compressed", n),
        ("/left/camera_info", n),
        ("/right/camera_info", n),
    ] {
        assert_eq!(read["counts"][topic].as_u64(), Some(count), "{topic}");
    }
    assert!(
        read["counts"]["/diagnostics"].as_u64() >= Some(2),
        "{}",
        read["counts"]
    );
    let number = |v: &Value| v.as_f64().unwrap().to_bits();
    for (pose, row) in read["poses"].as_array().unwrap().iter().zip(&rows) {
        assert_eq!(pose["stamp"].as_i64(), Some(row.timestamp_ns));
        let t = row.odom_from_camera.translation.vector;
        let q = row.odom_from_camera.rotation;
        for (value, expected) in pose["t"].as_array().unwrap().iter().zip([t.x, t.y, t.z]) {
            assert_eq!(number(value), expected.to_bits());
        }
        for (value, expected) in pose["q"]
            .as_array()
            .unwrap()
            .iter()
            .zip([q.i, q.j, q.k, q.w])
        {
            assert_eq!(number(value), expected.to_bits());
        }
        for (i, value) in pose["c"].as_array().unwrap().iter().enumerate() {
            let (i, j) = (i / 6, i % 6);
            let expected = row.cov_pose[(i.min(j), i.max(j))];
            // The CSV holds the upper triangle alone.
            let gap = (value.as_f64().unwrap() - expected).abs();
            assert!(gap <= 1e-12 * expected.abs().max(1e-12), "{i} {j}");
        }
    }
    let frames = serde_json::json!([["odom", "odom_optical"], ["left_optical", "right_optical"]]);
    assert_eq!(read["frames"], frames);
    assert_eq!(read["infos"]["/left/camera_info"]["width"], 320);
    check_clouds(&read["clouds"], &rows);
    assert!(read["infos"]["/right/camera_info"]["p"][3].as_f64() < Some(0.0));
}

/// Each pair's features are as many as its estimate rests on, older from pair to pair, and where both
/// images show them.
fn check_clouds(clouds: &Value, rows: &[OdometryRow]) {
    let rig = visod::simulation::small_rig();
    let mut oldest = 0.0;
    for (cloud, row) in clouds.as_array().unwrap().iter().zip(rows) {
        let points: Vec<Vec<f64>> = serde_json::from_value(cloud.clone()).unwrap();
        assert!(points.len() as u64 >= u64::from(row.counts.inliers).max(20));
        let mut off_px = 0.0;
        for p in &points {
            assert!(p[9] > 0.0 && p[12] > 0.0 && p[14] > 0.0, "{p:?}");
            let seen = rig.project(&Point3::new(p[0], p[1], p[2])).unwrap();
            off_px += (seen - Vector4::new(p[5], p[6], p[7], p[8])).norm() / points.len() as f64;
        }
        assert!(off_px < 0.5, "{off_px} px");
        oldest = points.iter().map(|p| p[3]).fold(oldest, f64::max);
    }
    assert!(oldest >= 3.0, "{oldest}");
}

/// Writes a folder's images as ROS 2's stereo drivers do: raw pixels and calibrations, the right
/// image a moment after the left.
const WRITE: &str = r#"
import sys, numpy as np
from mcap_ros2.writer import Writer
from pathlib import Path
from PIL import Image

folder, out, encoding = Path(sys.argv[1]), sys.argv[2], sys.argv[3]
f, cx, cy, baseline = (float(v) for v in sys.argv[4:8])
HEADER = 'std_msgs/Header header\n'
PARTS = ('=' * 80 + '\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n' +
         '=' * 80 + '\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n')
IMAGE = HEADER + 'uint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\nuint8[] data\n' + PARTS
INFO = (HEADER + 'uint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\nfloat64[9] k\nfloat64[9] r\n'
        'float64[12] p\nuint32 binning_x\nuint32 binning_y\nsensor_msgs/RegionOfInterest roi\n' +
        '=' * 80 + '\nMSG: sensor_msgs/RegionOfInterest\nuint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify\n' + PARTS)
with open(out, 'wb') as file, Writer(file) as writer:
    image = writer.register_msgdef('sensor_msgs/msg/Image', IMAGE)
    info = writer.register_msgdef('sensor_msgs/msg/CameraInfo', INFO)
    times = [int(round(float(t) * 1e9)) for t in (folder / 'times.txt').read_text().split()]
    for n, (left, t) in enumerate(zip(sorted((folder / 'left').iterdir()), times)):
        for side, late in (('left', 0), ('right', 300_000)):
            pixels = np.array(Image.open(folder / side / left.name))
            h, w = pixels.shape
            if encoding == 'rgb8':
                pixels = np.repeat(pixels[:, :, None], 3, axis=2)
            stamp = dict(sec=(t + late) // 10**9, nanosec=(t + late) % 10**9)
            header = dict(stamp=stamp, frame_id=side)
            shift = -f * baseline if side == 'right' else 0.0
            calibration = dict(header=header, height=h, width=w, distortion_model='plumb_bob', d=[0.0] * 5,
                               k=[f, 0.0, cx, 0.0, f, cy, 0.0, 0.0, 1.0], r=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
                               p=[f, 0.0, cx, shift, 0.0, f, cy, 0.0, 0.0, 0.0, 1.0, 0.0], binning_x=0, binning_y=0,
                               roi=dict(x_offset=0, y_offset=0, height=0, width=0, do_rectify=False))
            data = dict(header=header, height=h, width=w, encoding=encoding, is_bigendian=0,
                        step=pixels.strides[0], data=pixels.tobytes())
            # The last right image is missing.
            if side == 'left' or n + 1 < len(times):
                writer.write_message(f'/stereo/{side}/image_raw', image, data, t + late, t + late, n)
            writer.write_message(f'/stereo/{side}/camera_info', info, calibration, t + late, t + late, n)
"#;

#[test]
fn a_stereo_recording_of_ros_2_is_replayed() {
    let recording = Recording::shared();
    for encoding in ["mono8", "rgb8"] {
        let Some(mut python) = python(WRITE) else {
            return;
        };
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("ros.mcap");
        let rig = visod::simulation::small_rig();
        let (f, c) = (rig.left.focal_px.x, rig.left.principal_point_px);
        let numbers = [f, c.x, c.y, rig.baseline_m()].map(|v| v.to_string());
        let made = python
            .arg(recording.path())
            .arg(&file)
            .arg(encoding)
            .args(numbers)
            .output()
            .unwrap();
        assert!(made.status.success(), "{}", stderr_of(&made));
        let opened = McapRecording::open(&file, None, None, Settings::default()).unwrap();
        assert_eq!(opened.topics[0].name, "/stereo/left/image_raw");
        let (pairs, is_unpaired) = pairs_of(&file).unwrap();
        let mut expected = pairs_of_folder(recording.path());
        expected.pop();
        assert!(is_unpaired, "the last left image has no partner");
        assert!(pairs == expected, "{encoding}");
    }
}
