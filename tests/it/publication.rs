//! Publisher and `visod listen` as two processes.

use nalgebra::{Isometry3, Matrix3, Matrix6, Point3, Vector3, Vector4, Vector6};
use std::io::{BufRead, BufReader, Read};
use std::process::{Child, Command, Output, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;
use visod::estimation::{
    Counts, ErrorBudget, Landmark, Odometry, Status, StereoMeasurement, TrackedFeature,
};
use visod::output::csv::{HEADER, OdometryCsvWriter, push_row};
use visod::output::features::FeaturesMessage;
use visod::output::health::{CameraState, HealthMessage};
use visod::output::message::{CaptureTime, Latencies, OdometryMessage};
use visod::output::publication::Settings;
use visod::output::publisher::Publisher;
use visod::output::row::OdometryRow;
use visod::output::subscriber::{FeaturesSubscriber, HealthSubscriber, OdometrySubscriber, Wake};

/// Longer than anything here takes, even on a busy machine.
pub(crate) const PATIENCE: Duration = Duration::from_secs(60);

/// An iceoryx2 of its own: nothing outside this test meets what is published in it.
pub(crate) struct System {
    directory: tempfile::TempDir,
    pub(crate) settings: Settings,
}

impl System {
    pub(crate) fn new() -> Self {
        static NUMBER: AtomicU32 = AtomicU32::new(0);
        let number = NUMBER.fetch_add(1, Ordering::Relaxed);
        let directory = tempfile::tempdir().unwrap();
        let settings = Settings {
            root: Some(directory.path().join("iox")),
            prefix: Some(format!("vt{}_{number}_", std::process::id())),
            ..Settings::default()
        };
        Self {
            directory,
            settings,
        }
    }

    /// The settings, with features published.
    pub(crate) fn with_features(&self) -> Settings {
        Settings {
            features: true,
            ..self.settings.clone()
        }
    }

    pub(crate) fn root(&self) -> String {
        self.settings.root.as_ref().unwrap().display().to_string()
    }

    pub(crate) fn prefix(&self) -> String {
        self.settings.prefix.clone().unwrap()
    }

    pub(crate) fn listen(&self, args: &[&str]) -> Child {
        Command::new(env!("CARGO_BIN_EXE_visod"))
            .arg("listen")
            .args(["--service-root", &self.root()])
            .args(["--service-prefix", &self.prefix()])
            .args(args)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap()
    }

    /// This test binary once more, as a process that publishes.
    fn publisher_process(&self, count: u64) -> Child {
        Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "publication::child_publisher", "--ignored"])
            .env("VISOD_TEST_ROOT", self.root())
            .env("VISOD_TEST_PREFIX", self.prefix())
            .env("VISOD_TEST_COUNT", count.to_string())
            .stdout(Stdio::null())
            .spawn()
            .unwrap()
    }
}

impl Drop for System {
    fn drop(&mut self) {
        // What killed processes left in shared memory lies outside the directory.
        let Ok(entries) = std::fs::read_dir("/dev/shm") else {
            return;
        };
        for entry in entries.flatten() {
            if entry.file_name().to_string_lossy().contains(&self.prefix()) {
                let _ = std::fs::remove_file(entry.path());
            }
        }
    }
}

pub(crate) fn odometry(sequence: u64) -> Odometry {
    let s = sequence as f64;
    let spread = Matrix6::from_fn(|i, j| if i == j { 0.01 } else { 1e-4 / (3.0 + s) });
    let statuses = [
        Status::Initializing,
        Status::Tracking,
        Status::Degraded,
        Status::Lost,
    ];
    Odometry {
        sequence,
        timestamp_ns: 1_700_000_000_123_456_789 + 50_000_000 * sequence as i64,
        epoch: 1,
        status: statuses[sequence as usize % 4],
        odom_from_camera: Isometry3::new(
            Vector3::new(0.1 * s, -0.003 * s, s.sqrt()),
            Vector3::new(0.01 * s, 0.3, -0.2),
        ),
        cov_pose: spread * (1.0 + s),
        prev_from_now: Isometry3::new(
            Vector3::new(0.1, -0.003, 1e-300),
            Vector3::new(0.01, 0.0, 0.0),
        ),
        cov_motion: spread / 3.0,
        twist: Vector6::new(2.0, 0.0, 0.4 / 3.0, 0.2, 0.0, -0.1),
        cov_twist: spread * 3.0,
        budget: ErrorBudget {
            detection: spread,
            calibration: spread * 0.1,
            synchronisation: spread * 1e-3,
            bridging: spread * s,
        },
        counts: Counts {
            keypoints_left: 900 + sequence as u32,
            keypoints_right: 880,
            stereo_matches: 500,
            tracks: 300,
            inliers: 260,
        },
        variance_factor: 1.0 + 1.0 / (3.0 + s),
        innovation_ratio: 0.25 + 1.0 / (7.0 + s),
    }
}

pub(crate) fn message(sequence: u64) -> OdometryMessage {
    let odometry = odometry(sequence);
    let latencies = Latencies {
        capture_ns: 1,
        features_ns: 2,
        matching_ns: 3,
        estimation_ns: 4,
        total_ns: 5,
    };
    let stamp = CaptureTime::Recorded(odometry.timestamp_ns);
    OdometryMessage::new(&odometry, None, stamp, latencies)
}

/// As many features as are asked for, none like another.
pub(crate) fn features(sequence: u64, count: u64) -> Box<FeaturesMessage> {
    let odometry = odometry(sequence);
    let tracked = (0..count).map(|i| {
        let v = i as f64;
        TrackedFeature {
            id: 1000 + i,
            age: i as u32 % 9,
            measurement: StereoMeasurement {
                px: Vector4::new(v, v / 3.0, v - 20.0, v / 3.0 + 0.1),
                sigma_px: Vector4::repeat(0.3),
            },
            landmark: Landmark {
                point: Point3::new(v / 7.0, -v / 9.0, 3.0 + v),
                cov_m2: Matrix3::from_fn(|i, j| if i == j { v } else { (i + j) as f64 / 7.0 }),
            },
        }
    });
    let mut message = Box::<FeaturesMessage>::default();
    message.fill(
        &odometry,
        CaptureTime::Recorded(odometry.timestamp_ns),
        tracked,
    );
    message
}

fn finished(child: Child) -> Output {
    child.wait_with_output().unwrap()
}

fn stdout_of(output: &Output) -> String {
    String::from_utf8(output.stdout.clone()).unwrap()
}

fn stderr_of(output: &Output) -> String {
    String::from_utf8(output.stderr.clone()).unwrap()
}

/// The sequence numbers of JSON lines, each of which must hold the CSV row's very digits.
fn sequences(json_lines: &str) -> Vec<u64> {
    json_lines
        .lines()
        .map(|line| {
            let parsed: serde_json::Value = serde_json::from_str(line).unwrap();
            let sequence = parsed["seq"].as_u64().unwrap();
            let mut row = String::new();
            push_row(&mut row, &OdometryRow::new(&odometry(sequence), None));
            for (name, text) in HEADER.iter().zip(row.split(',')) {
                match (*name, text) {
                    ("latency_ms", "nan") => assert!(parsed["latency_ms"].is_null()),
                    ("status", word) => assert_eq!(parsed["status"], *word),
                    (_, digits) => {
                        assert!(
                            line.contains(&format!("\"{name}\":{digits}")),
                            "{name} {line}"
                        );
                    }
                }
            }
            sequence
        })
        .collect()
}

fn signal(child: &Child, name: &str) {
    let status = Command::new("kill")
        .args([format!("-{name}"), child.id().to_string()])
        .status()
        .unwrap();
    assert!(status.success());
}

/// Not a test: the publishing process of the tests below.
#[test]
#[ignore = "run by other tests as a process of its own"]
fn child_publisher() {
    let Ok(root) = std::env::var("VISOD_TEST_ROOT") else {
        return;
    };
    let settings = Settings {
        root: Some(root.into()),
        prefix: std::env::var("VISOD_TEST_PREFIX").ok(),
        ..Settings::default()
    };
    let count: u64 = std::env::var("VISOD_TEST_COUNT").unwrap().parse().unwrap();
    let mut publisher = Publisher::new(&settings).unwrap();
    assert!(publisher.wait_for_subscribers(1, PATIENCE));
    for sequence in 0..count {
        publisher.publish(&message(sequence)).unwrap();
        if count > 1000 {
            std::thread::sleep(Duration::from_millis(1));
        }
    }
}

#[test]
fn a_listener_that_waits_gets_every_message_bit_for_bit() {
    let system = System::new();
    let listener = system.listen(&["--json", "--count", "400"]);
    let mut publisher = Publisher::new(&system.settings).unwrap();
    assert!(publisher.wait_for_subscribers(1, PATIENCE));
    for sequence in 0..400 {
        assert_eq!(publisher.publish(&message(sequence)), Ok(1));
    }
    let output = finished(listener);
    assert!(output.status.success(), "{}", stderr_of(&output));
    assert_eq!(sequences(&stdout_of(&output)), (0..400).collect::<Vec<_>>());
    assert_eq!(stderr_of(&output), "");
}

#[test]
fn csv_of_a_listener_is_the_csv_of_the_writer() {
    let system = System::new();
    let listener = system.listen(&["--csv", "--count", "51"]);
    let mut publisher = Publisher::new(&system.settings).unwrap();
    assert!(publisher.wait_for_subscribers(1, PATIENCE));
    let mut expected = Vec::new();
    let mut writer = OdometryCsvWriter::new(&mut expected).unwrap();
    for sequence in 0..51 {
        writer.write(&odometry(sequence), None).unwrap();
        publisher.publish(&message(sequence)).unwrap();
    }
    writer.finish().unwrap();
    drop(publisher);
    let output = finished(listener);
    assert!(output.status.success(), "{}", stderr_of(&output));
    assert_eq!(stdout_of(&output), String::from_utf8(expected).unwrap());
}

#[test]
fn lines_for_the_eye_hold_pose_sigma_rate_and_latency() {
    let system = System::new();
    let listener = system.listen(&["--count", "3"]);
    let mut publisher = Publisher::new(&system.settings).unwrap();
    assert!(publisher.wait_for_subscribers(1, PATIENCE));
    for sequence in 0..3 {
        publisher.publish(&message(sequence)).unwrap();
    }
    let text = stdout_of(&finished(listener));
    let last = text.lines().last().unwrap();
    for part in ["2 degraded", "x +0.200 ±0.173", "rx", "Hz", "transport"] {
        assert!(last.contains(part), "{part} is not in {last}");
    }
}

/// What a terminal of 120 columns is sent.
fn on_a_terminal(system: &System, environment: &[(&str, &str)], messages: u64) -> String {
    let command = format!(
        "stty cols 120 rows 40; exec {} listen --count {messages} --service-root {} --service-prefix {}",
        env!("CARGO_BIN_EXE_visod"),
        system.root(),
        system.prefix()
    );
    let listener = Command::new("script")
        .args(["--quiet", "--return", "--command", &command, "/dev/null"])
        .env("TERM", "xterm-256color")
        .env_remove("NO_COLOR")
        .envs(environment.iter().copied())
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut publisher = Publisher::new(&system.settings).unwrap();
    assert!(publisher.wait_for_subscribers(1, PATIENCE));
    for sequence in 0..messages {
        publisher.publish(&message(sequence)).unwrap();
    }
    let output = finished(listener);
    assert!(output.status.success(), "{}", stderr_of(&output));
    stdout_of(&output)
}

#[test]
fn a_terminal_is_shown_a_picture_in_place() {
    let system = System::new();
    let sent = on_a_terminal(&system, &[], 30);
    let last = &sent[sent.rfind("visod").unwrap()..];
    for part in [
        "pair 29",
        "± 0.",
        "Hz",
        "latency",
        "position",
        "rotation",
        "detection",
    ] {
        assert!(last.contains(part), "{part} is not in {last}");
    }
    assert!(sent.contains("\x1b[36m"), "no colour in {sent}");
    // Less than a line a message: pictures are drawn over one another, and not each message is.
    assert!(sent.matches("variance factor").count() < 30);
    assert_eq!(
        sent.matches("variance factor").count(),
        sent.matches("\x1b[0J").count()
    );
}

#[test]
fn no_color_means_no_colour() {
    let system = System::new();
    let sent = on_a_terminal(&system, &[("NO_COLOR", "1")], 5);
    assert!(sent.contains("pair 4"));
    assert!(!sent.contains("\x1b[3"), "{sent}");
    // A terminal that cannot move its cursor gets lines.
    let sent = on_a_terminal(&System::new(), &[("TERM", "dumb")], 5);
    assert_eq!(sent.lines().count(), 5, "{sent}");
    assert!(!sent.contains('\x1b'), "{sent}");
}

#[test]
fn nothing_is_lost_when_the_publishing_process_ends_at_once() {
    for _ in 0..20 {
        let system = System::new();
        let listener = system.listen(&["--json", "--count", "60", "--timeout", "20"]);
        let mut publisher = system.publisher_process(60);
        let output = finished(listener);
        assert!(publisher.wait().unwrap().success());
        assert!(output.status.success(), "{}", stderr_of(&output));
        assert_eq!(sequences(&stdout_of(&output)), (0..60).collect::<Vec<_>>());
    }
}

#[test]
fn a_consumer_that_sleeps_while_the_publisher_leaves_still_gets_all() {
    let system = System::new();
    let sleeper = system.listen(&["--json", "--count", "60", "--timeout", "20"]);
    let patient = Settings {
        linger_ms: 10_000,
        ..system.settings.clone()
    };
    let mut publisher = Publisher::new(&patient).unwrap();
    assert!(publisher.wait_for_subscribers(1, PATIENCE));
    signal(&sleeper, "STOP");
    for sequence in 0..60 {
        publisher.publish(&message(sequence)).unwrap();
    }
    let leaving = std::thread::spawn(move || publisher.close());
    // Without the farewell the publisher would be gone long before this.
    std::thread::sleep(Duration::from_millis(300));
    assert!(!leaving.is_finished());
    signal(&sleeper, "CONT");
    leaving.join().unwrap();
    let output = finished(sleeper);
    assert!(output.status.success(), "{}", stderr_of(&output));
    assert_eq!(sequences(&stdout_of(&output)), (0..60).collect::<Vec<_>>());
}

#[test]
fn a_late_joiner_gets_the_last_message() {
    let system = System::new();
    let mut publisher = Publisher::new(&system.settings).unwrap();
    for sequence in 0..5 {
        publisher.publish(&message(sequence)).unwrap();
    }
    let mut listener = system.listen(&["--json", "--count", "1"]);
    while listener.try_wait().unwrap().is_none() {
        publisher.serve_late_joiners().unwrap();
        std::thread::sleep(Duration::from_millis(5));
    }
    assert_eq!(sequences(&stdout_of(&finished(listener))), [4]);
}

#[test]
fn a_late_joiner_gets_the_last_message_of_a_publisher_that_leaves() {
    let system = System::new();
    let mut publisher = Publisher::new(&system.settings).unwrap();
    for sequence in 0..5 {
        publisher.publish(&message(sequence)).unwrap();
    }
    let listener = system.listen(&["--json", "--count", "1", "--timeout", "20"]);
    assert!(publisher.wait_for_subscribers(1, PATIENCE));
    publisher.close();
    assert_eq!(sequences(&stdout_of(&finished(listener))), [4]);
}

#[test]
fn a_killed_publisher_makes_room_for_the_next_and_the_listener_stays() {
    let system = System::new();
    let mut listener = system.listen(&["--json"]);
    let mut lines = BufReader::new(listener.stdout.take().unwrap()).lines();
    // More often than there are places for publishers.
    for _ in 0..6 {
        let mut killed = system.publisher_process(1_000_000);
        let first = loop {
            let line = lines.next().unwrap().unwrap();
            if sequences(&line) == [0] {
                break line;
            }
        };
        assert!(first.contains("\"message_number\":0"));
        lines.next().unwrap().unwrap();
        killed.kill().unwrap();
        killed.wait().unwrap();
    }
    let mut publisher = Publisher::new(&system.settings).unwrap();
    publisher.publish(&message(0)).unwrap();
    while sequences(&lines.next().unwrap().unwrap()) != [0] {}
    signal(&listener, "TERM");
    assert!(listener.wait().unwrap().success());
    let mut told = String::new();
    let mut stderr = listener.stderr.take().unwrap();
    stderr.read_to_string(&mut told).unwrap();
    assert_eq!(told, "");
}

#[test]
fn a_stopped_consumer_holds_nobody_up_and_learns_what_it_lost() {
    let system = System::new();
    let mut stopped = system.listen(&["--json", "--count", "300"]);
    let mut lines = BufReader::new(stopped.stdout.take().unwrap()).lines();
    let mut publisher = Publisher::new(&system.settings).unwrap();
    assert!(publisher.wait_for_subscribers(1, PATIENCE));
    publisher.publish(&message(0)).unwrap();
    assert_eq!(sequences(&lines.next().unwrap().unwrap()), [0]);
    signal(&stopped, "STOP");
    for sequence in 1..3000 {
        publisher.publish(&message(sequence)).unwrap();
    }
    let awake = system.listen(&["--json", "--count", "101"]);
    assert!(publisher.wait_for_subscribers(2, PATIENCE));
    for sequence in 3000..3100 {
        publisher.publish(&message(sequence)).unwrap();
    }
    // The last message before it came, then all.
    let heard = sequences(&stdout_of(&finished(awake)));
    assert_eq!(heard, (2999..3100).collect::<Vec<_>>());

    signal(&stopped, "CONT");
    let heard: Vec<_> = lines.flat_map(|line| sequences(&line.unwrap())).collect();
    let lost = 3100 - 512 - 1;
    assert_eq!(heard, (lost + 1..=lost + 299).collect::<Vec<_>>());
    let output = finished(stopped);
    assert!(output.status.success());
    let told = format!("visod: {lost} messages lost before seq {}", lost + 1);
    assert!(stderr_of(&output).contains(&told), "{}", stderr_of(&output));
}

#[test]
fn the_longest_root_and_prefix_that_are_allowed_work() {
    let mut system = System::new();
    let mut root = system.root();
    let prefix_bytes = system.prefix().len();
    assert!(
        root.len() + prefix_bytes <= 60,
        "the temporary directory lies too deep"
    );
    root.extend(std::iter::repeat_n('x', 60 - prefix_bytes - root.len()));
    system.settings.root = Some(root.into());
    let mut subscriber = OdometrySubscriber::new("test", &system.settings).unwrap();
    let mut publisher = Publisher::new(&system.settings).unwrap();
    publisher.publish(&message(7)).unwrap();
    assert_eq!(subscriber.wait(PATIENCE), Ok(Wake::Message));
    assert_eq!(subscriber.receive().unwrap().unwrap().message.sequence, 7);
}

#[test]
fn two_publishers_are_refused_unless_allowed() {
    let system = System::new();
    let _first = Publisher::new(&system.settings).unwrap();
    let refusal = Publisher::new(&system.settings).err().unwrap().to_string();
    assert!(refusal.contains("another process already publishes visod/odometry"));
    assert!(refusal.contains(&system.prefix()));
    let tolerant = Settings {
        exclusive: false,
        ..system.settings.clone()
    };
    assert!(Publisher::new(&tolerant).is_ok());
}

#[test]
fn signals_end_a_listener_well() {
    for name in ["INT", "TERM"] {
        let system = System::new();
        let publisher = Publisher::new(&system.settings).unwrap();
        let listener = system.listen(&[]);
        assert!(publisher.wait_for_subscribers(1, PATIENCE));
        signal(&listener, name);
        let output = finished(listener);
        assert_eq!(output.status.code(), Some(0), "{name}");
        assert_eq!(stderr_of(&output), "");
    }
}

#[test]
fn without_data_a_listener_fails_after_its_timeout() {
    let system = System::new();
    let output = finished(system.listen(&["--timeout", "0.2"]));
    assert_eq!(output.status.code(), Some(1));
    assert_eq!(
        stderr_of(&output),
        "visod: no odometry for 0.2 s: there is no publisher\n"
    );
    let _publisher = Publisher::new(&system.settings).unwrap();
    let output = finished(system.listen(&["--timeout", "1.3"]));
    assert_eq!(output.status.code(), Some(1));
    let told = stderr_of(&output);
    assert_eq!(told.matches("no data for 1.0 s").count(), 1, "{told}");
    assert!(told.contains("no odometry for 1.3 s: although there is a publisher"));
}

#[test]
fn a_reader_that_goes_ends_a_listener_well() {
    let system = System::new();
    let mut listener = system.listen(&["--csv"]);
    let mut publisher = Publisher::new(&system.settings).unwrap();
    assert!(publisher.wait_for_subscribers(1, PATIENCE));
    drop(listener.stdout.take());
    let mut sequence = 0;
    while listener.try_wait().unwrap().is_none() {
        publisher.publish(&message(sequence)).unwrap();
        sequence += 1;
        std::thread::sleep(Duration::from_millis(2));
    }
    let output = finished(listener);
    assert_eq!(output.status.code(), Some(0));
    assert_eq!(stderr_of(&output), "");
}

#[test]
fn wrong_usage_of_listen_is_told_with_code_2() {
    let run = |args: &[&str]| {
        Command::new(env!("CARGO_BIN_EXE_visod"))
            .arg("listen")
            .args(args)
            .output()
            .unwrap()
    };
    let output = run(&["--service-root", "relative"]);
    assert_eq!(output.status.code(), Some(2));
    assert!(stderr_of(&output).contains("--service-root: must be an absolute path"));
    assert_eq!(run(&["--timeout", "-1"]).status.code(), Some(2));
    assert_eq!(run(&["--count", "0"]).status.code(), Some(2));
    assert_eq!(run(&["--json", "--csv"]).status.code(), Some(2));
}

#[test]
fn publishing_into_shared_memory_that_is_gone_is_no_crash() {
    let system = System::new();
    let mut publisher = Publisher::new(&system.settings).unwrap();
    let subscriber = OdometrySubscriber::new("test", &system.settings).unwrap();
    publisher.publish(&message(0)).unwrap();
    std::fs::remove_dir_all(system.directory.path().join("iox")).unwrap();
    // Either it still arrives, since both have it mapped, or there is an error to look at.
    let _ = publisher.publish(&message(1));
    drop(subscriber);
    let _ = publisher.publish(&message(2));
    drop(publisher);
    std::fs::write(system.directory.path().join("iox"), "a file").unwrap();
    let refusal = Publisher::new(&system.settings).err().unwrap().to_string();
    assert!(refusal.contains(&system.root()), "{refusal}");
}

#[test]
fn what_is_not_valid_is_not_published() {
    let system = System::new();
    let mut publisher = Publisher::new(&system.settings).unwrap();
    let mut broken = message(0);
    broken.cov_pose[7] = f64::NAN;
    let refusal = publisher.publish(&broken).unwrap_err().to_string();
    assert_eq!(refusal, "field cov_pose of the message is NaN at index 7");
}

#[test]
fn features_arrive_where_they_are_wanted() {
    let system = System::new();
    let mut subscriber = FeaturesSubscriber::new("test", &system.settings).unwrap();
    let mut without = Publisher::new(&system.settings).unwrap();
    assert!(!without.publishes_features());
    assert_eq!(without.publish_features(&features(0, 5)), Ok(0));
    drop(without);
    let mut publisher = Publisher::new(&system.with_features()).unwrap();
    // More than wait for a subscriber: the oldest are overwritten, and counted.
    for sequence in 0..11 {
        assert_eq!(
            publisher.publish_features(&features(sequence, 40 * sequence)),
            Ok(1)
        );
    }
    for sequence in 3..11 {
        assert_eq!(subscriber.wait(PATIENCE), Ok(Wake::Message));
        let received = subscriber.receive().unwrap().unwrap();
        assert_eq!(received.message.message_number, sequence);
        let mut sent = features(sequence, 40 * sequence);
        sent.message_number = sequence;
        sent.published_monotonic_ns = received.message.published_monotonic_ns;
        assert_eq!(received.message, *sent);
    }
}

#[test]
fn health_arrives_with_its_counters() {
    let system = System::new();
    let mut subscriber = HealthSubscriber::new("test", &system.settings).unwrap();
    let mut publisher = Publisher::new(&system.settings).unwrap();
    let sent = HealthMessage {
        left_state: CameraState::Streaming as u32,
        pairs_lost: 3,
        ..HealthMessage::default()
    };
    for _ in 0..2 {
        publisher.publish_health(&sent).unwrap();
    }
    assert_eq!(subscriber.wait(PATIENCE), Ok(Wake::Message));
    let first = subscriber.receive().unwrap().unwrap();
    assert!(first.new_publisher);
    let second = subscriber.receive().unwrap().unwrap().message;
    assert_eq!((second.message_number, second.pairs_lost), (1, 3));
    assert!(second.realtime_ns > 1_700_000_000_000_000_000);
    assert!(second.monotonic_ns >= first.message.monotonic_ns);
    assert_eq!(subscriber.receive(), Ok(None));
}
