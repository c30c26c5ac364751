//! `visod run` as a service: what it tells systemd, played here by a socket, about two cameras that are
//! files.

use super::gige::{Running, recording, start_with};
use super::replay::stderr_of;
use std::os::unix::net::UnixDatagram;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};
use tempfile::TempDir;

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
