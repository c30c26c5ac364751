//! `visod run` as a service: what it tells systemd, played here by a socket, about two cameras that are
//! files.

use super::gige::{Running, recording, start_with};
use super::publication::System;
use super::replay::{stderr_of, visod};
use std::io::{Read, Write};
use std::os::unix::net::{UnixDatagram, UnixStream};
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::{Duration, Instant};
use tempfile::TempDir;
use visod::output::subscriber::{OdometrySubscriber, Wake};

/// Longer than anything here takes, even on a busy machine.
const PATIENCE: Duration = Duration::from_secs(60);
/// Pairs at 20 Hz, more than any test plays.
const PAIRS: u64 = 20 * 180;

/// The service manager's side.
struct Manager {
    socket: UnixDatagram,
    folder: TempDir,
    recording: TempDir,
}

impl Manager {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let socket = UnixDatagram::bind(folder.path().join("notify")).unwrap();
        Self {
            socket,
            folder,
            recording: recording(PAIRS),
        }
    }

    fn config(&self, more: &str) -> PathBuf {
        let recording = self.recording.path().display();
        let camera = |side| format!("[camera.{side}]\ndriver = \"files\"\nid = \"{recording}\"\n");
        let text = format!(
            "rig = \"{recording}/rig.toml\"\n{}{}[capture]\nstall_s = 0.5\n[features.surf]\nbudget = 100\n{more}",
            camera("left"),
            camera("right")
        );
        let file = self.folder.path().join("visod.toml");
        std::fs::write(&file, text).unwrap();
        file
    }

    /// Starts the daemon with a watchdog of one second.
    fn start(&self, config: &Path, args: &[&str]) -> Running {
        let socket = self.folder.path().join("notify");
        let args: Vec<&str> = ["--no-publish"].iter().chain(args).copied().collect();
        start_with("run", config, &args, |visod| {
            visod.env("NOTIFY_SOCKET", &socket);
            visod.env("WATCHDOG_USEC", "1000000");
        })
    }

    /// The next thing that is said within `patience`.
    fn hear(&self, patience: Duration) -> Option<String> {
        let mut text = [0; 4096];
        self.socket.set_read_timeout(Some(patience)).unwrap();
        let bytes = self.socket.recv(&mut text).ok()?;
        Some(String::from_utf8(text[..bytes].to_vec()).unwrap())
    }

    /// Waits until something is said that contains `words`; everything that was said until then.
    fn wait(&self, words: &str) -> Vec<String> {
        let started = Instant::now();
        let mut said = Vec::new();
        while started.elapsed() < PATIENCE {
            let Some(text) = self.hear(PATIENCE) else {
                break;
            };
            let is_it = text.contains(words);
            said.push(text);
            if is_it {
                return said;
            }
        }
        panic!("never said: {words}; said: {said:?}");
    }
}

#[test]
fn systemd_is_told_that_the_daemon_is_ready_alive_reloading_and_stopping() {
    let manager = Manager::new();
    let config = manager.config("[service]\ndeadline_s = 1.0\n");
    let daemon = manager.start(&config, &[]);
    let before = manager.wait("READY=1");
    assert!(before[0].contains("STATUS=waiting for the cameras"));
    for _ in 0..3 {
        manager.wait("WATCHDOG=1");
    }
    manager.config("[service]\ndeadline_s = 0.5\n");
    daemon.hang_up();
    manager.wait("RELOADING=1");
    manager.wait("READY=1");
    // A file that cannot be used changes nothing, and ends nothing.
    manager.config("[service]\ndeadline_s = -1.0\n");
    daemon.hang_up();
    manager.wait("RELOADING=1");
    manager.wait("READY=1");
    manager.wait("WATCHDOG=1");
    let (output, took_s) = daemon.stop();
    println!("stopped after {took_s:.2} s");
    manager.wait("STOPPING=1");
    let said = stderr_of(&output);
    assert!(output.status.success(), "{said}");
    assert!(
        said.contains("the configuration has been read anew"),
        "{said}"
    );
    assert!(said.contains("the configuration stays as it was"), "{said}");
    assert!(
        said.contains("service.deadline_s: must be from 0.01"),
        "{said}"
    );
}

#[test]
fn a_pipeline_that_hangs_is_not_said_to_be_alive() {
    let manager = Manager::new();
    let config = manager.config("[service]\ndeadline_s = 0.5\n");
    let daemon = manager.start(&config, &["--hang-after", "5"]);
    manager.wait("READY=1");
    manager.wait("STATUS=no row has left the pipeline");
    let watched = Instant::now();
    while watched.elapsed() < Duration::from_secs(2) {
        let said = manager.hear(Duration::from_millis(200)).unwrap_or_default();
        assert!(!said.contains("WATCHDOG=1"), "{said}");
    }
    daemon.kill();
}

/// A configuration that asks for what the kernel does not grant runs all the same, and says so.
#[test]
fn what_is_not_granted_is_a_warning() {
    let manager = Manager::new();
    let config = manager.config("[service]\nprocessors = [1023]\n");
    let daemon = manager.start(&config, &[]);
    manager.wait("READY=1");
    let (output, _) = daemon.stop();
    let said = stderr_of(&output);
    assert!(output.status.success(), "{said}");
    assert!(said.contains("WARN not granted"), "{said}");
    assert!(
        said.contains("the processors [1023] cannot be bound to"),
        "{said}"
    );
}

/// The answer of the daemon's socket to one request for figures.
fn fetch(socket: &Path) -> Option<String> {
    let mut stream = UnixStream::connect(socket).ok()?;
    stream
        .write_all(b"GET /metrics HTTP/1.1\r\nHost: visod\r\n\r\n")
        .ok()?;
    let mut answer = String::new();
    stream.read_to_string(&mut answer).ok()?;
    Some(answer)
}

/// The value of one line of Prometheus' text.
fn figure(answer: &str, series: &str) -> Option<f64> {
    let of = |line: &str| line.strip_prefix(series)?.strip_prefix(' ')?.parse().ok();
    answer.lines().find_map(of)
}

#[test]
fn prometheus_fetches_rows_drops_and_latencies_while_it_runs() {
    let manager = Manager::new();
    let socket = manager.folder.path().join("metrics");
    let config = manager.config(&format!("[metrics]\nlisten = \"{}\"\n", socket.display()));
    let daemon = manager.start(&config, &["--json"]);
    manager.wait("READY=1");
    let started = Instant::now();
    let tracking = |answer: &str| figure(answer, "visod_rows_total{status=\"tracking\"}");
    let answer = loop {
        let answer = fetch(&socket).unwrap_or_default();
        if tracking(&answer).is_some_and(|rows| rows >= 10.0) {
            break answer;
        }
        assert!(started.elapsed() < PATIENCE, "{answer}");
        std::thread::sleep(Duration::from_millis(50));
    };
    assert!(
        answer.contains("\r\nContent-Type: text/plain; version=0.0.4"),
        "{answer}"
    );
    assert!(
        answer.contains("# TYPE visod_stage_seconds histogram"),
        "{answer}"
    );
    let value =
        |series: &str| figure(&answer, series).unwrap_or_else(|| panic!("{series}: {answer}"));
    let rows = value("visod_rows_total{status=\"tracking\"}");
    assert!(value("visod_stage_seconds_count{stage=\"features\"}") >= rows);
    assert!(value("visod_stage_seconds_bucket{stage=\"total\",le=\"+Inf\"}") >= rows);
    assert!(value("visod_frames_total{camera=\"right\"}") >= rows);
    assert_eq!(value("visod_camera_streams{camera=\"left\"}"), 1.0);
    assert_eq!(
        value("visod_drops_total{stage=\"pairing\",reason=\"too_far\",camera=\"left\"}"),
        0.0
    );
    let late = "visod_drops_total{stage=\"queue\",reason=\"stages_late\",camera=\"both\"}";
    assert!(value(late) >= 0.0);
    let (output, _) = daemon.stop();
    assert!(output.status.success(), "{}", stderr_of(&output));
    assert!(!socket.exists(), "a clean end leaves no socket");
}

#[test]
fn figures_are_for_this_computer_alone() {
    let manager = Manager::new();
    let config = manager.config("[metrics]\nlisten = \"0.0.0.0:9477\"\n");
    let output = manager.start(&config, &[]).end();
    let said = stderr_of(&output);
    assert_eq!(output.status.code(), Some(2), "{said}");
    assert!(
        said.contains("metrics.listen: must be an address of loopback"),
        "{said}"
    );
}

/// One row of an odometry CSV: epoch, position, and the variances of the position.
fn place(row: &csv::StringRecord, header: &csv::StringRecord) -> (u32, [f64; 3], [f64; 3]) {
    let number = |name: &str| -> f64 {
        let at = header.iter().position(|column| column == name).unwrap();
        row[at].parse().unwrap()
    };
    let of = |names: [&str; 3]| names.map(number);
    (
        number("epoch") as u32,
        of(["tx", "ty", "tz"]),
        of(["c00", "c11", "c22"]),
    )
}

#[test]
fn a_restart_goes_on_where_the_last_run_ended_with_a_covariance_that_covers_the_gap() {
    /// After each run.
    const PAUSE: Duration = Duration::from_millis(200);
    let manager = Manager::new();
    let config = manager
        .config("[last_pose]\nfile = \"last_pose.toml\"\nrestore = true\nsigma_speed_m_s = 0.5\n");
    let runs = ["first.csv", "second.csv"].map(|name| {
        let file = manager.folder.path().join(name);
        // Without a service manager, for nobody here would listen to what it is told.
        let args = ["--no-publish", "--odometry", file.to_str().unwrap()];
        let daemon = start_with("run", &config, &args, |_| ());
        let started = Instant::now();
        let rows = || {
            let text = std::fs::read_to_string(&file).unwrap_or_default();
            text.matches("tracking").count()
        };
        while rows() < 20 {
            assert!(started.elapsed() < PATIENCE);
            std::thread::sleep(Duration::from_millis(50));
        }
        let (output, _) = daemon.stop();
        assert!(output.status.success(), "{}", stderr_of(&output));
        std::thread::sleep(PAUSE);
        let mut reader = csv::Reader::from_path(&file).unwrap();
        let header = reader.headers().unwrap().clone();
        let rows: Vec<_> = reader
            .records()
            .map(|row| place(&row.unwrap(), &header))
            .collect();
        (rows, stderr_of(&output))
    });
    let [(first, _), (second, said)] = &runs;
    assert!(
        said.contains("the odometry frame of the run before is continued"),
        "{said}"
    );
    let ((_, ended_m, _), (epoch, begins_m, variances_m2)) = (first[first.len() - 1], second[0]);
    assert_eq!((first[0].0, first[0].1, epoch), (0, [0.0; 3], 1));
    for axis in 0..3 {
        assert!(
            (ended_m[axis] - begins_m[axis]).abs() < 1e-9,
            "{ended_m:?} {begins_m:?}"
        );
        // Between the runs lies the pause, and what it takes to stop and to start.
        let gap_s = variances_m2[axis].sqrt() / 0.5;
        assert!((PAUSE.as_secs_f64()..60.0).contains(&gap_s), "{gap_s}");
    }
    let last = second[second.len() - 1];
    assert!(
        last.0 == 1 && last.2[0] >= variances_m2[0],
        "it stays as unsure"
    );
}

#[test]
fn a_last_pose_that_is_damaged_is_one_warning() {
    let manager = Manager::new();
    let config = manager.config("[last_pose]\nfile = \"last_pose.toml\"\nrestore = true\n");
    std::fs::write(
        manager.folder.path().join("last_pose.toml"),
        "version = 1\nepo",
    )
    .unwrap();
    let daemon = manager.start(&config, &[]);
    manager.wait("READY=1");
    let (output, _) = daemon.stop();
    let said = stderr_of(&output);
    assert!(output.status.success(), "{said}");
    let warnings: Vec<_> = said.lines().filter(|line| line.contains("WARN")).collect();
    assert_eq!(warnings.len(), 1, "{said}");
    assert!(
        warnings[0].contains("the last pose cannot be read"),
        "{said}"
    );
}

/// Resident memory, KiB, and open file descriptors of a process.
fn holdings(pid: u32) -> Option<(u64, usize)> {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).ok()?;
    let line = status
        .lines()
        .find_map(|line| line.strip_prefix("VmRSS:"))?;
    let resident_kib = line.trim().strip_suffix(" kB")?.parse().ok()?;
    let descriptors = std::fs::read_dir(format!("/proc/{pid}/fd")).ok()?.count();
    Some((resident_kib, descriptors))
}

/// The short form of `cargo bench --bench soak`, at the pace of the machine.
#[test]
fn neither_memory_nor_descriptors_grow_with_the_pairs() {
    let system = System::new();
    let recording = recording(1000);
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("visod.toml");
    let text = format!(
        "[features.surf]\nbudget = 50\n[publish]\nroot = \"{}\"\nprefix = \"{}\"\n",
        system.root(),
        system.prefix()
    );
    std::fs::write(&config, text).unwrap();
    let mut subscriber = OdometrySubscriber::new("soak", &system.settings).unwrap();
    let mut replay = visod()
        .arg("replay")
        .arg(recording.path())
        .arg("--config")
        .arg(&config)
        .stdout(Stdio::null())
        .spawn()
        .unwrap();
    let mut at = Vec::new();
    let mut received = 0;
    while subscriber.wait(PATIENCE).unwrap() == Wake::Message {
        while subscriber.receive().unwrap().is_some() {
            received += 1;
            if received == 250 || received == 950 {
                at.push(holdings(replay.id()).unwrap());
            }
        }
        if received == 1000 {
            break;
        }
    }
    assert!(replay.wait().unwrap().success());
    let [(before_kib, before), (after_kib, after)] = at[..] else {
        panic!("{received} messages");
    };
    println!("{before_kib} KiB, then {after_kib} KiB");
    // The images that are just being read are open, or are not.
    assert!(after <= before + 2, "{before} {after} file descriptors");
    // One percent; the allocator rounds to pages.
    assert!(
        after_kib <= before_kib + before_kib / 100 + 128,
        "{before_kib} {after_kib}"
    );
}
