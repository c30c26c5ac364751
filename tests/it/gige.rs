//! Two GigE Vision cameras that serve a recording over the real protocol, and `visod run` on them.
//!
//! Each test runs in a network namespace of its own, made by `unshare`, where discovery reaches nobody
//! else. Where that is not allowed, the tests say so and pass over.
#![expect(
    unsafe_code,
    reason = "what a process does before it becomes the program"
)]

use super::one_camera::{assert_camera_conforms, assert_leaves, assert_unsuitable};
use super::publication::System;
use super::replay::{replay_quietly, stderr_of, visod};
use serde_json::Value;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::Arc;
use std::time::{Duration, Instant};
use tempfile::TempDir;
use visod::capture::aravis::AravisCamera;
use visod::capture::camera::FrameSource;
use visod::capture::settings::{CameraSettings, Trigger};
use visod::capture::{Dataset, PairEvent, PairSource, ReadAhead, Side};
use visod::geometry::rig_to_toml;
use visod::output::health::{CameraState, HealthMessage};
use visod::output::subscriber::HealthSubscriber;
use visod::simulation::gige::{CameraClock, GigeCamera, RecordedImages, Shows, Together};
use visod::simulation::{
    DatasetWriter, SceneName, Settings, Simulation, TrajectoryName, small_rig,
};

/// Set in the process that a test starts anew inside its namespace.
const INSIDE: &str = "VISOD_TEST_IN_NAMESPACE";
/// Frames a second of the cameras.
const RATE_HZ: f64 = 20.0;
/// Pairs that are rendered; cameras show them forth and back for as long as it takes.
const RENDERED: u64 = 24;

/// Runs the rest of the test in a namespace: true inside it, false where it has been run, or cannot be.
fn in_namespace(test: &str) -> bool {
    if std::env::var_os(INSIDE).is_some() {
        return true;
    }
    let is_allowed = Command::new("unshare")
        .args(["--map-root-user", "--net", "--mount", "true"])
        .stderr(Stdio::null())
        .status();
    if !is_allowed.is_ok_and(|status| status.success()) {
        println!("skipped: network namespaces may not be made here");
        return false;
    }
    let script = "ip link set lo up && ip addr add 127.0.0.2/8 dev lo && exec \"$@\"";
    let status = Command::new("unshare")
        .args([
            "--map-root-user",
            "--net",
            "--mount",
            "sh",
            "-c",
            script,
            "sh",
        ])
        .arg(std::env::current_exe().unwrap())
        .args(["--exact", test, "--nocapture"])
        .env(INSIDE, "1")
        .status()
        .unwrap();
    assert!(status.success(), "{test} failed in its namespace");
    false
}

/// A recording of `pairs` pairs that goes forth and back over a few rendered ones.
pub(crate) fn recording(pairs: u64) -> TempDir {
    let settings = Settings {
        frames: RENDERED,
        rate_hz: RATE_HZ,
        ..Settings::default()
    };
    let (scene, way) = (SceneName::Room, TrajectoryName::LoopRoom);
    let simulation = Simulation::new(scene, way, small_rig(), settings).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let mut writer = DatasetWriter::create(folder.path(), simulation.rig()).unwrap();
    for frame in 0..RENDERED {
        let (pair, pose) = simulation.pair(frame);
        writer.add(&pair, &pose).unwrap();
    }
    writer.finish().unwrap();
    let there_and_back = 2 * (RENDERED - 1);
    for n in RENDERED..pairs {
        let at = n % there_and_back;
        let at = at.min(there_and_back - at);
        for side in ["left", "right"] {
            let name = |n: u64| folder.path().join(format!("{side}/{n:06}.png"));
            std::fs::hard_link(name(at), name(n)).unwrap();
        }
    }
    let times: String = (0..pairs)
        .map(|n| format!("{:.9}\n", n as f64 / RATE_HZ))
        .collect();
    std::fs::write(folder.path().join("times.txt"), times).unwrap();
    std::fs::remove_file(folder.path().join("poses.txt")).unwrap();
    folder
}

/// What the cameras do where the machine is too busy for their rate.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Late {
    /// They leave numbers out, as cameras do: what comes is of the time that its stamp says.
    Skip,
    /// They fall behind and leave none out, so that every pair of the recording can be compared.
    FallBehind,
}

/// Two cameras that serve a recording, each plugged in or not.
struct Rig {
    recording: TempDir,
    images: Arc<RecordedImages>,
    together: Arc<Together>,
    clocks: [CameraClock; 2],
    rate_hz: f64,
    plugged: [Option<GigeCamera>; 2],
}

impl Rig {
    fn serve(pairs: u64) -> Self {
        Self::with(pairs, RATE_HZ, CameraClock::default(), Late::Skip)
    }

    /// `clock` is the right camera's.
    fn with(pairs: u64, rate_hz: f64, clock: CameraClock, late: Late) -> Self {
        Self::with_clocks(pairs, rate_hz, [CameraClock::default(), clock], late)
    }

    fn with_clocks(pairs: u64, rate_hz: f64, clocks: [CameraClock; 2], late: Late) -> Self {
        let recording = recording(pairs);
        let dataset = Dataset::open(recording.path(), None).unwrap();
        let mut rig = Self {
            recording,
            images: Arc::new(RecordedImages::decode(&dataset).unwrap()),
            together: Arc::new(match late {
                Late::Skip => Together::default(),
                Late::FallBehind => Together::leaving_none_out(),
            }),
            clocks,
            rate_hz,
            plugged: [None, None],
        };
        rig.plug(Side::Left);
        rig.plug(Side::Right);
        rig
    }

    fn plug(&mut self, side: Side) {
        let place = match side {
            Side::Left => ("127.0.0.1", "LEFT"),
            Side::Right => ("127.0.0.2", "RIGHT"),
        };
        let clock = self.clocks[side as usize];
        let camera = GigeCamera::serve(
            self.images.clone(),
            side,
            place,
            self.rate_hz,
            clock,
            Arc::clone(&self.together),
        );
        self.plugged[side as usize] = Some(camera.unwrap());
    }

    fn unplug(&mut self, side: Side) {
        self.plugged[side as usize] = None;
    }

    fn lose_packets(&self, share: f64) {
        for camera in self.plugged.iter().flatten() {
            camera.lose_packets(share);
        }
    }

    fn path(&self) -> &Path {
        self.recording.path()
    }

    /// A configuration in a folder of its own; `more` goes to `[capture]`, `left` to the left camera.
    fn config(&self, folder: &Path, system: Option<&System>, more: &str, left: &str) -> PathBuf {
        let rate_hz = self.rate_hz;
        let publish = system.map_or(String::new(), |s| {
            format!(
                "[publish]\nroot = \"{}\"\nprefix = \"{}\"\n",
                s.root(),
                s.prefix()
            )
        });
        let text = format!(
            "rig = \"{}\"\n\
             [camera.left]\nid = \"Aravis-Fake-LEFT\"\nframe_rate_hz = {rate_hz:?}\n{left}\n\
             [camera.right]\nid = \"127.0.0.2\"\nframe_rate_hz = {rate_hz:?}\n\
             [capture]\npatience_s = 0.0\n{more}\n\
             [features.surf]\nbudget = 200\n[estimation]\nrepeats = 1\n{publish}",
            self.path().join("rig.toml").display()
        );
        let file = folder.join("visod.toml");
        std::fs::write(&file, text).unwrap();
        file
    }
}

/// A running `visod`. If the test fails while it runs, it is killed, and what it has said is printed.
pub(crate) struct Running(Option<Child>);

impl Running {
    /// Ends it as a crash would.
    pub(crate) fn kill(mut self) {
        let mut child = self.0.take().unwrap();
        child.kill().unwrap();
        child.wait().unwrap();
    }

    /// Asks it to end, and waits until it has; how long that took.
    pub(crate) fn stop(mut self) -> (Output, f64) {
        let asked = Instant::now();
        self.signal(rustix::process::Signal::TERM);
        let child = self.0.take().unwrap();
        let output = child.wait_with_output().unwrap();
        (output, asked.elapsed().as_secs_f64())
    }

    /// Asks it to read its configuration anew.
    pub(crate) fn hang_up(&self) {
        self.signal(rustix::process::Signal::HUP);
    }

    fn signal(&self, signal: rustix::process::Signal) {
        let pid = rustix::process::Pid::from_child(self.0.as_ref().unwrap());
        rustix::process::kill_process(pid, signal).unwrap();
    }

    /// Waits until it ends of itself.
    pub(crate) fn end(mut self) -> Output {
        self.0.take().unwrap().wait_with_output().unwrap()
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let Some(mut child) = self.0.take() else {
            return;
        };
        let _ = child.kill();
        if let Ok(output) = child.wait_with_output() {
            println!("visod said: {}", stderr_of(&output));
        }
    }
}

/// `visod COMMAND --config FILE …`.
fn start(command: &str, config: &Path, args: &[&str]) -> Running {
    start_with(command, config, args, |_| ())
}

/// The same, with whatever else `prepare` gives it.
pub(crate) fn start_with(
    command: &str,
    config: &Path,
    args: &[&str],
    prepare: impl FnOnce(&mut Command),
) -> Running {
    let mut visod = visod();
    prepare(&mut visod);
    visod.arg(command).arg("--config").arg(config).args(args);
    visod.stdout(Stdio::piped()).stderr(Stdio::piped());
    // SAFETY: nothing but one system call happens between fork and exec.
    unsafe {
        visod.pre_exec(|| {
            let killed = rustix::process::set_parent_process_death_signal(Some(
                rustix::process::Signal::KILL,
            ));
            killed.map_err(std::io::Error::from)
        });
    }
    Running(Some(visod.spawn().unwrap()))
}

fn run(command: &str, config: &Path, args: &[&str]) -> Output {
    start(command, config, args).end()
}

fn json(output: &Output) -> Value {
    assert!(output.status.success(), "{}", stderr_of(output));
    serde_json::from_slice(&output.stdout).unwrap()
}

/// The seconds of the long tests: a minute where the time is there (`VISOD_TEST_SECONDS`), else a few.
fn seconds() -> u64 {
    let set = std::env::var("VISOD_TEST_SECONDS").ok();
    // As many pairs as may wait: however busy the machine is, none is dropped.
    set.and_then(|s| s.parse().ok()).unwrap_or(3)
}

/// The names of the columns that [`without_latency`] keeps.
fn columns(csv: &Path) -> Vec<String> {
    let text = std::fs::read_to_string(csv).unwrap();
    let header = text.lines().next().unwrap().split(',');
    header
        .filter(|name| *name != "latency_ms")
        .map(str::to_owned)
        .collect()
}

/// All columns but those that name the run rather than what was seen.
fn without_latency(csv: &str) -> Vec<Vec<String>> {
    let mut lines = csv
        .lines()
        .map(|l| l.split(',').map(str::to_owned).collect::<Vec<_>>());
    let header = lines.next().unwrap();
    let latency = header.iter().position(|name| name == "latency_ms").unwrap();
    let rows = lines.map(|mut row| {
        row.remove(latency);
        row
    });
    rows.collect()
}

#[test]
fn a_gige_camera_conforms() {
    if !in_namespace("gige::a_gige_camera_conforms") {
        return;
    }
    let _rig = Rig::serve(RENDERED);
    for (id, trigger) in [
        ("Aravis-Fake-LEFT", Trigger::Free),
        ("RIGHT", Trigger::Software),
    ] {
        let settings = CameraSettings {
            id: id.to_owned(),
            frame_rate_hz: Some(RATE_HZ),
            trigger,
            ..CameraSettings::default()
        };
        let open = || {
            let camera = AravisCamera::open(&settings, (320, 240))?;
            Ok(Box::new(camera) as Box<dyn FrameSource>)
        };
        assert_camera_conforms(&open, (320, 240), true);
        let wrong = CameraSettings {
            pixel_format: Some("Mono7".to_owned()),
            ..settings.clone()
        };
        let open = || {
            let camera = AravisCamera::open(&wrong, (320, 240))?;
            Ok(Box::new(camera) as Box<dyn FrameSource>)
        };
        assert_unsuitable(&open, "has no pixel format Mono7");
    }
}

#[test]
fn a_gige_camera_that_is_unplugged_is_gone() {
    if !in_namespace("gige::a_gige_camera_that_is_unplugged_is_gone") {
        return;
    }
    let mut rig = Rig::serve(RENDERED);
    let settings = CameraSettings {
        id: "Aravis-Fake-LEFT".to_owned(),
        ..CameraSettings::default()
    };
    let open = || {
        let camera = AravisCamera::open(&settings, (320, 240))?;
        Ok(Box::new(camera) as Box<dyn FrameSource>)
    };
    assert_leaves(&open, || rig.unplug(Side::Left), "control was lost");
}

/// What the cameras show is what `record` writes, and what `run` makes of it is what `replay` does.
#[test]
fn recorded_pixels_are_those_served_and_the_trajectory_is_that_of_a_replay() {
    let name = "gige::recorded_pixels_are_those_served_and_the_trajectory_is_that_of_a_replay";
    if !in_namespace(name) {
        return;
    }
    let seconds = seconds();
    let pairs = (seconds + 20) * RATE_HZ as u64;
    let rig = Rig::with(pairs, RATE_HZ, CameraClock::default(), Late::FallBehind);
    let folder = tempfile::tempdir().unwrap();
    let shared = "clocks = \"shared\"\nstamps = \"camera\"\nqueue = 64";
    let config = rig.config(folder.path(), None, shared, "");
    // A busy machine must not be given less work than the replay has; and a recording does not know how far
    // apart its images may have been taken.
    let untrimmed = std::fs::read_to_string(&config).unwrap()
        + "consider_synchronisation = false\n[service]\ntrim = false\n";
    std::fs::write(&config, untrimmed).unwrap();
    let csv = folder.path().join("odometry.csv");
    let time = seconds.to_string();
    let args = [
        "--json",
        "--no-publish",
        "--seconds",
        &time,
        "--odometry",
        csv.to_str().unwrap(),
    ];
    let summary = json(&run("run", &config, &args));
    println!("{summary}");
    assert_eq!(summary["dropped"], 0);
    for camera in summary["cameras"].as_array().unwrap() {
        let lost = camera["lost"].as_object().unwrap();
        assert!(lost.values().all(|frames| *frames == 0), "{camera}");
        assert_eq!(camera["reconnects"], 0);
    }
    let live = without_latency(&std::fs::read_to_string(&csv).unwrap());
    // A busy machine may follow more slowly than the cameras send: what waits when the time is up has no row.
    assert!(live.len() as u64 >= 2 * seconds, "{} rows", live.len());
    let mut replay_config = folder.path().to_owned();
    replay_config.push("replay.toml");
    let settings = "[features.surf]\nbudget = 200\n[estimation]\nrepeats = 1\n";
    std::fs::write(&replay_config, settings).unwrap();
    let args = ["--config", replay_config.to_str().unwrap()];
    let replayed = without_latency(&replay_quietly(rig.path(), &args).csv);
    let equal = live
        .iter()
        .zip(&replayed)
        .take_while(|(a, b)| a == b)
        .count();
    let differ =
        |(name, (a, b)): (&String, (&String, &String))| (a != b).then(|| format!("{name} {a} {b}"));
    let gaps: Vec<String> = match (live.get(equal), replayed.get(equal)) {
        (Some(a), Some(b)) => columns(&csv)
            .iter()
            .zip(a.iter().zip(b))
            .filter_map(differ)
            .collect(),
        _ => Vec::new(),
    };
    assert_eq!(
        equal,
        live.len(),
        "rows equal to those of the replay; {gaps:?}"
    );

    let out = folder.path().join("recording");
    let args = ["--json", "--pairs", "60", out.to_str().unwrap()];
    let recorded = json(&run("record", &config, &args));
    println!("{recorded}");
    assert_eq!(recorded["pairs"], 60);
    assert_served(&rig, &out);
    assert_accounted_for(&out, &recorded);
}

/// Every recorded pair is the one that was served with its stamp.
fn assert_served(rig: &Rig, recording: &Path) {
    use visod::simulation::gige::Images;
    let dataset = Dataset::open(recording, None).unwrap();
    let mut source = ReadAhead::start(&dataset).unwrap();
    while let Some(event) = source.next_event() {
        let PairEvent::Pair(pair) = event else {
            panic!("every pair is whole");
        };
        let number = (pair.timestamp_ns as f64 * 1e-9 * RATE_HZ).round() as usize;
        let served = |side| rig.images.image(number % rig.images.len(), side);
        assert!(pair.left == *served(Side::Left), "left {number}");
        assert!(pair.right == *served(Side::Right), "right {number}");
    }
}

/// `frames.csv` has a line for every frame that arrived, and for every loss.
fn assert_accounted_for(recording: &Path, summary: &Value) {
    let frames = std::fs::read_to_string(recording.join("frames.csv")).unwrap();
    for (at, side) in ["left", "right"].iter().enumerate() {
        let of_side = |line: &&str| line.starts_with(side);
        let written = frames
            .lines()
            .filter(of_side)
            .filter(|l| l.contains(",written,"));
        assert_eq!(Some(written.count() as u64), summary["pairs"].as_u64());
        let arrived = frames
            .lines()
            .filter(of_side)
            .filter(|l| !l.contains(",lost,"))
            .count() as u64;
        let counted = summary["frames"][at].as_u64().unwrap();
        // Frames that wait for their partner when the recording ends have no fate.
        assert!(
            arrived <= counted && counted <= arrived + 8,
            "{side}: {arrived} of {counted}"
        );
    }
}

/// A disk that fills up ends a recording in good order: what is written can be read.
#[test]
fn a_full_disk_stops_a_recording_cleanly() {
    if !in_namespace("gige::a_full_disk_stops_a_recording_cleanly") {
        return;
    }
    let rig = Rig::serve(200);
    let folder = tempfile::tempdir().unwrap();
    let disk = folder.path().join("disk");
    std::fs::create_dir(&disk).unwrap();
    let mounted = Command::new("mount")
        .args(["-t", "tmpfs", "-o", "size=2m", "tmpfs"])
        .arg(&disk)
        .status();
    assert!(mounted.unwrap().success());
    let config = rig.config(folder.path(), None, "", "");
    let out = disk.join("recording");
    let output = run("record", &config, &["--json", out.to_str().unwrap()]);
    assert_refused(&output, 1, &["cannot be written: No space left on device"]);
    let summary: Value = serde_json::from_slice(&output.stdout).unwrap();
    println!("{summary}");
    let dataset = Dataset::open(&out, None).unwrap();
    assert_eq!(Some(dataset.pairs.len() as u64), summary["pairs"].as_u64());
    assert!(dataset.pairs.len() > 3 && !dataset.nominal_times);
    assert_readable(&out);
}

/// Every pair of a recording can be read.
fn assert_readable(recording: &Path) {
    let dataset = Dataset::open(recording, None).unwrap();
    let mut source = ReadAhead::start(&dataset).unwrap();
    while let Some(event) = source.next_event() {
        assert!(matches!(event, PairEvent::Pair(_)), "{event:?}");
    }
}

/// At twice the rate nothing is lost unseen: frames are in rows, dropped, or counted otherwise.
#[test]
fn at_forty_hertz_every_frame_is_counted() {
    if !in_namespace("gige::at_forty_hertz_every_frame_is_counted") {
        return;
    }
    let rig = Rig::with(RENDERED, 40.0, CameraClock::default(), Late::Skip);
    let folder = tempfile::tempdir().unwrap();
    let config = rig.config(folder.path(), None, "", "");
    let time = seconds().max(6).to_string();
    let args = ["--json", "--no-publish", "--seconds", &time];
    let summary = json(&run("run", &config, &args));
    println!("{summary}");
    for at in 0..2 {
        let camera = &summary["cameras"][at];
        let frames = camera["frames"].as_u64().unwrap();
        let rows = summary["pairs"].as_u64().unwrap() - summary["unusable"].as_u64().unwrap();
        let counted =
            rows + summary["dropped"].as_u64().unwrap() + camera["unmatched"].as_u64().unwrap();
        // Some are under way when the run ends.
        assert!(
            counted <= frames && frames <= counted + 16,
            "{counted} of {frames}"
        );
        assert!(frames > 100, "{frames}");
    }
}

/// Clocks that differ by 3 ms and 50 ppm: all pairs are of one instant.
#[test]
fn clocks_that_differ_do_not_part_pairs() {
    if !in_namespace("gige::clocks_that_differ_do_not_part_pairs") {
        return;
    }
    let clock = CameraClock {
        offset_ns: 3_000_000,
        drift: 50e-6,
        ..CameraClock::default()
    };
    let rig = Rig::with(400, RATE_HZ, clock, Late::Skip);
    let folder = tempfile::tempdir().unwrap();
    let config = rig.config(folder.path(), None, "stamps = \"camera\"", "");
    let out = folder.path().join("recording");
    let args = ["--json", "--pairs", "150", out.to_str().unwrap()];
    let recorded = json(&run("record", &config, &args));
    println!("{recorded}");
    // The images of a pair show the same number.
    assert_served(&rig, &out);
}

/// The difference between two clocks, 3 ms and 50 ppm apart, is estimated as well as the estimate says.
///
/// But for the least delay, that is, which stamps cannot show: where this machine is so busy that not one
/// frame of a camera is punctual, it is not that of the cable. So it is taken from what arrived.
#[test]
fn the_offset_between_clocks_is_known_as_well_as_it_says() {
    if !in_namespace("gige::the_offset_between_clocks_is_known_as_well_as_it_says") {
        return;
    }
    // Stamps that say when a frame was really taken: a busy machine takes it late, as no camera does.
    let since_ns = visod::capture::camera::monotonic_ns();
    let shows = Shows::Host { since_ns };
    let left = CameraClock {
        shows,
        ..CameraClock::default()
    };
    let right = CameraClock {
        offset_ns: 3_000_000,
        drift: 50e-6,
        shows,
    };
    let rig = Rig::with_clocks(RENDERED, RATE_HZ, [left, right], Late::Skip);
    let folder = tempfile::tempdir().unwrap();
    let config = rig.config(folder.path(), None, "tolerance_s = 0.02", "");
    let out = folder.path().join("recording");
    let args = ["--json", "--seconds", "8", out.to_str().unwrap()];
    let recorded = json(&run("record", &config, &args));
    println!("{recorded}");
    let [(left_ns, left_sigma_ns), (right_ns, right_sigma_ns)] = [0, 1].map(|at| {
        let estimate = &recorded["clocks"][at];
        let (clock, side) = [(left, "left"), (right, "right")][at];
        let arrivals = arrivals(&out, side, &clock, since_ns);
        let delays = arrivals.iter().map(|(taken, arrived)| arrived - taken);
        let least_ns = delays.fold(f64::INFINITY, f64::min);
        let (last_ns, _) = arrivals[arrivals.len() - 1];
        let ahead_ns = clock.offset_ns as f64 + clock.drift * (last_ns - since_ns as f64);
        let wrong_ns = estimate["offset_ns"].as_f64().unwrap() + ahead_ns - least_ns;
        let sigma_ns = estimate["sigma_offset_ns"].as_f64().unwrap();
        println!(
            "{side}: least delay {:.1} µs; offset wrong by {:.1} µs, 1 σ {:.1} µs",
            least_ns * 1e-3,
            wrong_ns * 1e-3,
            sigma_ns * 1e-3
        );
        (wrong_ns, sigma_ns)
    });
    let sigma_ns = left_sigma_ns.hypot(right_sigma_ns);
    let wrong_ns = left_ns - right_ns;
    assert!(sigma_ns < 2e6, "that says nothing: {sigma_ns} ns");
    assert!(
        wrong_ns.abs() < 3.0 * sigma_ns,
        "{wrong_ns} of {sigma_ns} ns"
    );
}

/// When each frame of a side in `frames.csv` was taken and when it arrived, CLOCK_MONOTONIC, ns.
fn arrivals(recording: &Path, side: &str, clock: &CameraClock, since_ns: i64) -> Vec<(f64, f64)> {
    let frames = std::fs::read_to_string(recording.join("frames.csv")).unwrap();
    let of_side = frames.lines().filter(|line| line.starts_with(side));
    let times = of_side.filter_map(|line| {
        let columns: Vec<&str> = line.split(',').collect();
        let stamp_ns: f64 = columns[2].parse().ok()?;
        let arrived_ns: f64 = columns[6].parse().ok()?;
        let own_ns = stamp_ns - since_ns as f64 - clock.offset_ns as f64;
        Some((since_ns as f64 + own_ns / (1.0 + clock.drift), arrived_ns))
    });
    times.collect()
}

/// Health as it is heard, with when.
struct Listener {
    health: HealthSubscriber,
}

impl Listener {
    fn new(system: &System) -> Self {
        Self {
            health: HealthSubscriber::new("gige test", &system.settings).unwrap(),
        }
    }

    /// Waits for health that fulfils a condition; how long that took.
    fn wait(&mut self, what: &str, patience_s: u64, is: impl Fn(&HealthMessage) -> bool) -> f64 {
        let started = Instant::now();
        let mut last = None;
        while started.elapsed() < Duration::from_secs(patience_s) {
            let _ = self.health.wait(Duration::from_millis(50));
            while let Some(received) = self.health.receive().unwrap() {
                if is(&received.message) {
                    println!("{what}: after {:.2} s", started.elapsed().as_secs_f64());
                    return started.elapsed().as_secs_f64();
                }
                last = Some(received.message);
            }
        }
        panic!("{what}: not within {patience_s} s; last {last:?}");
    }
}

const STREAMING: u32 = CameraState::Streaming as u32;
const TRACKING: u32 = 1;
const LOST: u32 = 3;

fn is_well(m: &HealthMessage) -> bool {
    (m.left_state, m.right_state) == (STREAMING, STREAMING) && m.odometry_status == TRACKING
}

/// One camera away for five seconds: the other goes on, the status says so, and all is well within two
/// seconds of its return.
#[test]
fn a_camera_that_is_unplugged_for_five_seconds_comes_back() {
    if !in_namespace("gige::a_camera_that_is_unplugged_for_five_seconds_comes_back") {
        return;
    }
    let mut rig = Rig::serve(RENDERED);
    let (system, folder) = (System::new(), tempfile::tempdir().unwrap());
    let config = rig.config(folder.path(), Some(&system), "", "");
    let mut listener = Listener::new(&system);
    let daemon = start("run", &config, &["--json"]);
    listener.wait("tracking", 15, is_well);
    rig.unplug(Side::Right);
    let gone = Instant::now();
    listener.wait("lost", 10, |m| {
        m.right_state != STREAMING && m.odometry_status == LOST && m.left_state == STREAMING
    });
    std::thread::sleep(Duration::from_secs(5).saturating_sub(gone.elapsed()));
    rig.plug(Side::Right);
    let took = listener.wait("streaming", 8, |m| m.right_state == STREAMING);
    assert!(took < 2.0, "{took} s");
    listener.wait("well", 8, is_well);
    let (output, _) = daemon.stop();
    let summary = json(&output);
    println!("{summary}");
    assert_eq!(summary["cameras"][0]["reconnects"], 0);
    assert!(summary["cameras"][1]["reconnects"].as_u64() >= Some(1));
}

#[test]
fn a_link_that_is_down_for_five_seconds_and_lost_packets_are_survived() {
    if !in_namespace("gige::a_link_that_is_down_for_five_seconds_and_lost_packets_are_survived") {
        return;
    }
    let rig = Rig::serve(RENDERED);
    let (system, folder) = (System::new(), tempfile::tempdir().unwrap());
    let config = rig.config(folder.path(), Some(&system), "", "");
    let mut listener = Listener::new(&system);
    let daemon = start("run", &config, &["--json"]);
    listener.wait("tracking", 15, is_well);
    let link = |state: &str| {
        let done = Command::new("ip")
            .args(["link", "set", "lo", state])
            .status();
        assert!(done.unwrap().success());
    };
    link("down");
    listener.wait("lost", 10, |m| {
        m.right_state != STREAMING && m.left_state != STREAMING
    });
    std::thread::sleep(Duration::from_secs(3));
    link("up");
    let took = listener.wait("well", 12, is_well);
    assert!(took < 8.0, "{took} s");
    rig.lose_packets(0.002);
    listener.wait("losses", 15, |m| {
        m.left_lost_in_transport > 3 && m.right_lost_in_transport > 3
    });
    rig.lose_packets(0.0);
    listener.wait("well", 8, is_well);
    println!("{}", json(&daemon.stop().0));
}

/// A daemon that is killed cannot let go of its cameras; the next one has them all the same, soon.
#[test]
fn a_daemon_that_is_killed_and_restarted_at_once_has_its_cameras() {
    if !in_namespace("gige::a_daemon_that_is_killed_and_restarted_at_once_has_its_cameras") {
        return;
    }
    let rig = Rig::serve(RENDERED);
    let (system, folder) = (System::new(), tempfile::tempdir().unwrap());
    let config = rig.config(folder.path(), Some(&system), "", "");
    let patient = std::fs::read_to_string(&config)
        .unwrap()
        .replace("patience_s = 0.0", "patience_s = 15.0");
    std::fs::write(&config, patient).unwrap();
    let mut listener = Listener::new(&system);
    let first = start("run", &config, &["--json"]);
    listener.wait("tracking", 15, is_well);
    first.kill();
    drop(listener);
    let second = start("run", &config, &["--json"]);
    let mut listener = Listener::new(&system);
    let took = listener.wait("tracking again", 15, is_well);
    assert!(took < 8.0, "{took} s");
    let (output, took) = second.stop();
    println!("stopped after {took:.2} s");
    json(&output);
}

/// The error: one sentence after what the log says.
fn assert_refused(output: &Output, code: i32, says: &[&str]) {
    let said = stderr_of(output);
    assert_eq!(output.status.code(), Some(code), "{said}");
    let sentences: Vec<&str> = said
        .lines()
        .filter(|l| l.starts_with("visod: ") && !l.starts_with("visod: warning: "))
        .collect();
    assert_eq!(sentences.len(), 1, "{said}");
    println!("{}", sentences[0]);
    for part in says {
        assert!(sentences[0].contains(part), "no '{part}' in: {said}");
    }
}

#[test]
fn mistakes_with_cameras_are_one_sentence_each() {
    if !in_namespace("gige::mistakes_with_cameras_are_one_sentence_each") {
        return;
    }

    let rig = Rig::serve(RENDERED);
    let folder = tempfile::tempdir().unwrap();
    let refuse = |config: &Path| run("run", config, &["--no-publish", "--seconds", "1"]);
    let wrong_format = rig.config(folder.path(), None, "", "pixel_format = \"Mono7\"");
    assert_refused(
        &refuse(&wrong_format),
        2,
        &["camera.left", "has no pixel format Mono7", "Mono8"],
    );
    let wrong_rate = rig.config(folder.path(), None, "", "gain = 999.0");
    assert_refused(
        &refuse(&wrong_rate),
        2,
        &["camera.left", "its gain goes from"],
    );
    let no_ptp = rig.config(folder.path(), None, "", "trigger = \"action\"");
    assert_refused(&refuse(&no_ptp), 2, &["camera.left"]);
    let right = rig.config(folder.path(), None, "", "");
    let absent = std::fs::read_to_string(&right)
        .unwrap()
        .replace("Fake-LEFT", "Fake-UP");
    let file = folder.path().join("absent.toml");
    std::fs::write(&file, absent).unwrap();
    assert_refused(
        &refuse(&file),
        1,
        &[
            "camera.left: no camera is called Aravis-Fake-UP; there are",
            "Aravis-Fake-LEFT",
        ],
    );
    // A rig whose images no camera of this kind can give.
    let mut big = small_rig();
    big.left.width = 9000;
    std::fs::write(rig.path().join("rig.toml"), rig_to_toml(&big)).unwrap();
    let right = rig.config(folder.path(), None, "", "");
    assert_refused(
        &refuse(&right),
        2,
        &["camera.left", "do not fit", "9000×240"],
    );
    std::fs::write(rig.path().join("rig.toml"), rig_to_toml(&small_rig())).unwrap();
    let settings = CameraSettings {
        id: "Aravis-Fake-LEFT".to_owned(),
        ..CameraSettings::default()
    };
    let mut held = AravisCamera::open(&settings, (320, 240)).unwrap();
    held.start().unwrap();
    assert_refused(
        &refuse(&right),
        1,
        &["camera.left", "another program holds it"],
    );
    let checked = run("check", &right, &[]);
    let text = String::from_utf8(checked.stdout.clone()).unwrap();
    assert_eq!(checked.status.code(), Some(1), "{text}");
    assert!(
        text.contains("left camera") && text.contains("another program holds it"),
        "{text}"
    );
    assert!(
        text.contains("right camera: Aravis Fake RIGHT sends frames"),
        "{text}"
    );
    drop(held);
    let checked = run("check", &right, &["--json"]);
    let findings = json(&checked);
    assert!(findings.as_array().unwrap().len() > 5, "{findings}");
    let listed = visod()
        .args(["cameras", "--json", "--details"])
        .output()
        .unwrap();
    let listed = json(&listed);
    let ids: Vec<&str> = listed["aravis"]
        .as_array()
        .unwrap()
        .iter()
        .filter_map(|c| c["id"].as_str())
        .collect();
    assert_eq!(ids.len(), 2, "{listed}");
    assert!(ids.contains(&"Aravis-Fake-RIGHT"), "{listed}");
    assert!(
        listed["aravis"][0]["details"]["pixel_formats"]
            .as_array()
            .unwrap()
            .contains(&"Mono8".into())
    );
}
