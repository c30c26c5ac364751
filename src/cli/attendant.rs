//! What goes on beside a run: systemd is told how things are, and SIGHUP has settings read anew.

use super::Failure;
use crate::capture::camera::monotonic_ns;
use crate::capture::live::{Monitor, Snapshot, State};
use crate::config::Config;
use crate::output::last_pose::Keeper;
use crate::service::notify::Manager;
use crate::service::vitals::{CameraSigns, Limits, Signs, judge};
use crate::service::{self, realtime};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicI64, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

/// How often is looked, where systemd does not want it more often.
const GLANCE: Duration = Duration::from_millis(200);
/// How long a driver, or a pair, may keep a thread, besides the deadline of pairs.
const PATIENCE: Duration = Duration::from_secs(5);

/// What the pipeline shows of itself, and is told, row by row.
#[derive(Clone)]
pub(crate) struct Pulse(Arc<Inner>);

struct Inner {
    last_row_ns: AtomicI64,
    rows: AtomicU64,
    settings: Mutex<(Duration, bool)>,
}

impl Pulse {
    pub(crate) fn new(settings: &service::Settings) -> Self {
        Self(Arc::new(Inner {
            last_row_ns: AtomicI64::new(monotonic_ns()),
            rows: AtomicU64::new(0),
            settings: Mutex::new((settings.deadline(), settings.trim)),
        }))
    }

    /// A row has left the pipeline; the deadline, and whether features may be trimmed, from now on.
    pub(crate) fn beat(&self) -> (Duration, bool) {
        self.0.last_row_ns.store(monotonic_ns(), Ordering::Relaxed);
        self.0.rows.fetch_add(1, Ordering::Relaxed);
        *self.settings()
    }

    fn settings(&self) -> std::sync::MutexGuard<'_, (Duration, bool)> {
        self.0
            .settings
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
    }
}

/// Looks after a run.
pub(crate) struct Attendant {
    config_file: PathBuf,
    config: Config,
    pulse: Pulse,
    hang_up: Arc<AtomicBool>,
    manager: Manager,
    hangs: bool,
}

impl Attendant {
    /// Listens to SIGHUP from now on.
    pub(crate) fn new(config_file: PathBuf, config: Config) -> Result<Self, Failure> {
        let hang_up = Arc::new(AtomicBool::new(false));
        signal_hook::flag::register(signal_hook::consts::SIGHUP, Arc::clone(&hang_up))
            .map_err(|e| Failure::other(format!("signals cannot be listened to: {e}")))?;
        let mut manager = Manager::default();
        manager.status("waiting for the cameras");
        Ok(Self {
            pulse: Pulse::new(&config.service),
            config_file,
            config,
            hang_up,
            manager,
            hangs: false,
        })
    }

    /// What the pipeline is to show itself by.
    pub(crate) fn pulse(&self) -> Pulse {
        self.pulse.clone()
    }

    /// Looks after the run of `cameras` on a thread of its own, which ends after the run has.
    /// Meanwhile `keeper` keeps the last pose.
    pub(crate) fn attend(
        mut self,
        cameras: Monitor,
        keeper: Option<Keeper>,
    ) -> Result<JoinHandle<()>, Failure> {
        let heartbeat = Manager::heartbeat().map_or(GLANCE, |period| period.min(GLANCE));
        std::thread::Builder::new()
            .name("attendant".to_owned())
            .spawn(move || {
                while !cameras.waits_out(heartbeat) {
                    self.look(&cameras.snapshot());
                    if let Some(Err(e)) = keeper.as_ref().map(Keeper::write_if_due) {
                        tracing::warn!("{e}");
                    }
                }
                self.manager.stopping();
            })
            .map_err(|e| Failure::other(format!("a thread cannot be started: {e}")))
    }

    fn look(&mut self, cameras: &Snapshot) {
        if self.hang_up.swap(false, Ordering::Relaxed) {
            self.reload();
        }
        let alive = judge(&self.signs(cameras), &self.limits());
        match &alive {
            Ok(()) => self.manager.alive(),
            Err(_) if self.hangs => {}
            Err(what) => tracing::error!("something hangs, the watchdog is not fed: {what}"),
        }
        self.hangs = alive.is_err();
        if cameras
            .cameras
            .iter()
            .all(|camera| camera.state == State::Streaming)
        {
            self.manager.ready();
        }
        let status = alive.err().unwrap_or_else(|| self.status(cameras));
        self.manager.status(&status);
    }

    fn signs(&self, cameras: &Snapshot) -> Signs {
        let now_ns = monotonic_ns();
        let since = |then_ns: i64| Duration::from_nanos((now_ns - then_ns).max(0) as u64);
        Signs {
            cameras: cameras.cameras.each_ref().map(|camera| CameraSigns {
                streams: camera.state == State::Streaming,
                since_frame: since(camera.last_arrived_ns),
                since_look: since(camera.last_look_ns),
            }),
            since_row: since(self.pulse.0.last_row_ns.load(Ordering::Relaxed)),
        }
    }

    fn limits(&self) -> Limits {
        let capture = &self.config.capture;
        let limits = Limits::new(
            Duration::from_secs_f64(capture.stall_s),
            PATIENCE.max(5 * self.config.service.deadline()),
        );
        Limits {
            // A camera that is away is looked at as often as `retry_s` says.
            look: limits.look + Duration::from_secs_f64(capture.retry_s),
            // Before the first row there is none for as long as cameras are silent.
            row: limits.row + Duration::from_secs_f64(capture.stall_s),
            ..limits
        }
    }

    fn status(&self, cameras: &Snapshot) -> String {
        let [left, right] = cameras.cameras.each_ref().map(|camera| {
            if camera.cause.is_empty() {
                camera.state.as_str().to_owned()
            } else {
                format!("{} ({})", camera.state.as_str(), camera.cause)
            }
        });
        // Whole hundreds, so that the line does not change with every pair.
        let hundreds = self.pulse.0.rows.load(Ordering::Relaxed) / 100 * 100;
        format!(
            "left camera {left}, right camera {right}; {hundreds} rows or more, {} pairs dropped",
            cameras.dropped
        )
    }

    /// Takes over what can be taken over; a file that cannot be used changes nothing.
    fn reload(&mut self) {
        self.manager.reloading();
        match Config::load(&self.config_file) {
            Err(cause) => tracing::error!(%cause, "the configuration stays as it was"),
            Ok(new) => self.take_over(new),
        }
        self.manager.reloaded();
    }

    fn take_over(&mut self, new: Config) {
        *self.pulse.settings() = (new.service.deadline(), new.service.trim);
        self.config.service.deadline_s = new.service.deadline_s;
        self.config.service.trim = new.service.trim;
        if self.config == new {
            tracing::info!("the configuration has been read anew");
        } else {
            tracing::warn!(
                "the configuration has been read anew; what changed besides service.deadline_s and \
                 service.trim holds from the next start"
            );
        }
    }
}

/// Asks the kernel for what the settings say; what it refuses is a warning.
pub(crate) fn ask_for_resources(settings: &service::Settings) {
    let refused = [
        realtime::bind(&settings.processors).err(),
        settings
            .lock_memory
            .then(realtime::lock_memory)
            .and_then(Result::err),
    ];
    for cause in refused.into_iter().flatten() {
        tracing::warn!("not granted: {cause}");
    }
}
