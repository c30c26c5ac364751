//! The daemon in a process of its own, on two cameras that are files, with a subscriber here.

use super::memory::Recording;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;
use visod::geometry::{StereoRig, rig_to_toml};
use visod::output::message::OdometryMessage;
use visod::output::publication::Settings as Publication;
use visod::output::subscriber::{OdometrySubscriber, Wake};

type Fallible<T> = Result<T, Box<dyn std::error::Error>>;

/// Pairs that are rendered; the cameras show them forth and back.
const RENDERED: u64 = 24;

/// Images of a rig, rendered once for many recordings.
pub fn render(rig: StereoRig) -> Recording {
    Recording::simulated(rig, RENDERED)
}

/// A recording of these images whose pairs come at the given times; they are files that cost little to read.
///
/// # Errors
/// The disk is full, or has no hard links.
pub fn record(recording: &Recording, folder: &Path, times_s: &[f64]) -> Fallible<()> {
    let name = |side: &str, n: u64| folder.join(format!("{side}/{n:06}.pgm"));
    for side in ["left", "right"] {
        std::fs::create_dir_all(folder.join(side))?;
    }
    for n in 0..times_s.len() as u64 {
        let at = recording.index(n) as u64;
        for side in ["left", "right"] {
            if n >= RENDERED {
                std::fs::hard_link(name(side, at), name(side, n))?;
                continue;
            }
            let pair = &recording.pairs[at as usize];
            let image = if side == "left" {
                &pair.left
            } else {
                &pair.right
            };
            let mut pgm = format!("P5\n{} {}\n255\n", image.width(), image.height()).into_bytes();
            pgm.extend_from_slice(image.pixels());
            std::fs::write(name(side, n), pgm)?;
        }
    }
    let times: String = times_s.iter().map(|time| format!("{time:.9}\n")).collect();
    std::fs::write(folder.join("times.txt"), times)?;
    std::fs::write(folder.join("rig.toml"), rig_to_toml(&recording.rig))?;
    Ok(())
}

/// The daemon, following the cameras until their recording is over.
pub struct Daemon {
    process: Child,
    subscriber: OdometrySubscriber,
    summary: PathBuf,
}

impl Daemon {
    /// Starts it on a recording; `more` is what the configuration says besides.
    ///
    /// # Errors
    /// Files or shared memory cannot be used.
    pub fn start(folder: &Path, recording: &Path, more: &str) -> Fallible<Self> {
        let root = folder.join("iox");
        let publication = Publication {
            root: Some(root.clone()),
            prefix: Some("visod_bench_".to_owned()),
            ..Publication::default()
        };
        let subscriber = OdometrySubscriber::new("bench", &publication)?;
        let recording = recording.display();
        let camera = |side| format!("[camera.{side}]\ndriver = \"files\"\nid = \"{recording}\"\n");
        let config = format!(
            "rig = \"{recording}/rig.toml\"\n{}{}\
             [estimation]\nrepeats = 1\n\
             [publish]\nroot = \"{}\"\nprefix = \"visod_bench_\"\n{more}",
            camera("left"),
            camera("right"),
            root.display()
        );
        let file = folder.join("visod.toml");
        std::fs::write(&file, config)?;
        let summary = folder.join("summary.json");
        let process = Command::new(env!("CARGO_BIN_EXE_visod"))
            .arg("run")
            .arg("--config")
            .arg(file)
            .arg("--summary")
            .arg(&summary)
            .env("RUST_LOG", "error")
            .stdout(Stdio::null())
            .spawn()?;
        Ok(Self {
            process,
            subscriber,
            summary,
        })
    }

    /// Its number.
    pub fn pid(&self) -> u32 {
        self.process.id()
    }

    /// Hands every message to `see` until the daemon ends; then its summary, and how many messages were lost
    /// on the way here.
    ///
    /// # Errors
    /// It fails, or shared memory is gone.
    pub fn follow(
        mut self,
        mut see: impl FnMut(&OdometryMessage) -> Fallible<()>,
    ) -> Fallible<(serde_json::Value, u64)> {
        let mut lost = 0;
        let status = loop {
            let wake = self.subscriber.wait(Duration::from_millis(200))?;
            while let Some(received) = self.subscriber.receive()? {
                lost += received.lost_before;
                see(&received.message)?;
            }
            if wake != Wake::Message
                && let Some(status) = self.process.try_wait()?
            {
                break status;
            }
        };
        if !status.success() {
            return Err(format!("the daemon ended with {status}").into());
        }
        let summary = std::fs::read_to_string(&self.summary)?;
        Ok((serde_json::from_str(&summary)?, lost))
    }
}
