//! What every command that works with cameras does first: configuration, rig, cameras.

use super::Failure;
use crate::capture::camera::CameraError;
use crate::capture::live::{Delivery, LiveSource, Monitor};
use crate::capture::{Opener, Side, drivers};
use crate::config::Config;
use crate::geometry::{StereoRig, load_rig};
use crate::service::realtime;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

/// A configuration with what it leads to.
pub(crate) struct Setup {
    pub(crate) config: Config,
    pub(crate) rig: StereoRig,
    pub(crate) openers: [Opener; 2],
}

impl Setup {
    /// Reads the configuration and its rig.
    pub(crate) fn load(file: &Path) -> Result<Self, Failure> {
        let config = Config::load(file).map_err(Failure::usage)?;
        let lacks = |key: &str, what: &str| {
            Failure::usage(format!("{}: {key}: is missing: {what}", file.display()))
        };
        let rig = config
            .rig
            .as_ref()
            .ok_or_else(|| lacks("rig", "cameras need a rig file"))?;
        let rig = load_rig(rig).map_err(Failure::usage)?;
        let opener = |side, key: &str, settings: &Option<_>| {
            let settings = settings
                .as_ref()
                .ok_or_else(|| lacks(key, "it says which camera is to be used"))?;
            drivers::opener(settings, side, &rig, &config.dataset)
                .map_err(|e| Failure::usage(format!("{}: {key}: {e}", file.display())))
        };
        let openers = [
            opener(Side::Left, "camera.left", &config.camera.left)?,
            opener(Side::Right, "camera.right", &config.camera.right)?,
        ];
        Ok(Self {
            config,
            rig,
            openers,
        })
    }

    /// Opens the cameras.
    pub(crate) fn open(&self, delivery: Delivery, stop: &Stop) -> Result<LiveSource, Failure> {
        let priority = self.config.service.priority;
        // The cameras' threads inherit it.
        let (source, granted) = realtime::with_priority(priority, || {
            LiveSource::open(&self.config.capture, self.openers.clone(), delivery, || {
                stop.is_asked_for()
            })
        });
        if let Err(cause) = granted {
            tracing::warn!("not granted: {cause}");
        }
        source.map_err(failure)
    }
}

/// A camera that cannot do what is asked for is bad configuration.
pub(crate) fn failure(error: CameraError) -> Failure {
    if error.is_permanent() {
        Failure::usage(error)
    } else {
        Failure::other(error)
    }
}

/// Whether somebody wants the run to end: Ctrl-C, `kill`, or the time set for it.
pub(crate) struct Stop(Arc<AtomicBool>);

impl Stop {
    /// Listens to SIGINT and SIGTERM; the second of them ends the process at once.
    pub(crate) fn on_signals() -> Result<Self, Failure> {
        let asked = Arc::new(AtomicBool::new(false));
        for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM] {
            signal_hook::flag::register_conditional_shutdown(signal, 1, Arc::clone(&asked))
                .and_then(|_| signal_hook::flag::register(signal, Arc::clone(&asked)))
                .map_err(|e| Failure::other(format!("signals cannot be listened to: {e}")))?;
        }
        Ok(Self(asked))
    }

    pub(crate) fn is_asked_for(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }

    /// Ends the cameras' run when asked to, or after `seconds`.
    pub(crate) fn end_run(&self, cameras: Monitor, seconds: Option<f64>) -> Result<(), Failure> {
        let asked = Arc::clone(&self.0);
        let started = std::time::Instant::now();
        let is_over = move || {
            asked.load(Ordering::Relaxed)
                || seconds.is_some_and(|s| started.elapsed().as_secs_f64() >= s)
        };
        std::thread::Builder::new()
            .name("stop".to_owned())
            .spawn(move || {
                while !is_over() {
                    std::thread::sleep(Duration::from_millis(20));
                }
                cameras.stop();
            })
            .map(drop)
            .map_err(|e| Failure::other(format!("a thread cannot be started: {e}")))
    }
}
