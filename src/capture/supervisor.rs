//! One camera in; its frames out for as long as the run lasts, whatever happens to the camera.
//!
//! A camera that fails or falls silent is closed, and opened anew after a pause that grows from
//! attempt to attempt, until it sends frames again. The other camera does not notice.

use super::Side;
use super::camera::{CameraError, CameraEvent, FrameSource};
use super::live::{Shared, State};
use super::settings::Settings;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Opens a camera, however often.
pub type Opener = Arc<dyn Fn() -> Result<Box<dyn FrameSource>, CameraError> + Send + Sync>;

/// How long a camera is waited for before looking whether the run is over.
const GLANCE: Duration = Duration::from_millis(50);
/// First pause between two attempts to open a camera.
const FIRST_PAUSE: Duration = Duration::from_millis(250);

/// Opens a camera that may have to be waited for.
pub(super) fn open_patiently(
    opener: &Opener,
    patience: Duration,
    is_over: impl Fn() -> bool,
) -> Result<Box<dyn FrameSource>, CameraError> {
    let deadline = Instant::now() + patience;
    loop {
        match opener() {
            Ok(source) => return Ok(source),
            Err(e) if e.is_permanent() || is_over() || Instant::now() >= deadline => {
                return Err(e);
            }
            Err(e) => {
                tracing::info!(cause = %e, "waiting for a camera");
                std::thread::sleep(FIRST_PAUSE);
            }
        }
    }
}

/// Why a camera's stream ended.
enum Ended {
    /// The run is over.
    Stopped,
    /// The recording is.
    AtEnd,
    /// It was silent for too long.
    Stalled,
    /// It failed.
    Failed(CameraError),
}

/// What keeps one camera going.
pub(super) struct Supervisor {
    pub(super) side: Side,
    pub(super) opener: Opener,
    pub(super) shared: Arc<Shared>,
    pub(super) settings: Settings,
}

impl Supervisor {
    /// Hands on everything that the camera sends, until the run or the recording is over.
    pub(super) fn run(&self, mut source: Box<dyn FrameSource>) {
        let identity = source.identity();
        let mut pause = FIRST_PAUSE;
        loop {
            let before = self.shared.frames(self.side);
            match self.stream(&mut *source) {
                Ended::Stopped => return,
                Ended::AtEnd => return self.shared.end(self.side),
                Ended::Stalled => {
                    let cause = format!("no frame for {} s", self.settings.stall_s);
                    self.shared.set_state(self.side, State::Stalled, &cause);
                }
                Ended::Failed(e) => {
                    self.shared
                        .set_state(self.side, State::Lost, &e.to_string());
                }
            }
            if self.shared.frames(self.side) > before {
                pause = FIRST_PAUSE;
            }
            // Closed before it is opened anew: a camera has one controller.
            drop(source);
            match self.reopen(&identity, &mut pause) {
                Some(reopened) => source = reopened,
                None => return,
            }
            self.shared.reopened(self.side, source.clock());
        }
    }

    fn stream(&self, source: &mut dyn FrameSource) -> Ended {
        if let Err(e) = source.start() {
            return Ended::Failed(e);
        }
        let mut last_frame = Instant::now();
        while !self.shared.look(self.side) {
            while let Some(image) = self.shared.take_spare(self.side) {
                source.recycle(image);
            }
            match source.next(GLANCE) {
                Ok(CameraEvent::Frame(frame)) => {
                    last_frame = Instant::now();
                    self.shared.frame(self.side, frame);
                }
                Ok(CameraEvent::Lost { kind, frames }) => {
                    self.shared.lost(self.side, kind, frames);
                }
                Ok(CameraEvent::Quiet) if last_frame.elapsed() >= self.settings.stall() => {
                    return Ended::Stalled;
                }
                Ok(CameraEvent::Quiet) => {}
                Ok(CameraEvent::End) => return Ended::AtEnd,
                Err(e) => return Ended::Failed(e),
            }
            // Frames that arrive but are all unusable are as good as none.
            if last_frame.elapsed() >= 2 * self.settings.stall() {
                return Ended::Stalled;
            }
        }
        source.stop();
        Ended::Stopped
    }

    /// Opens the camera as soon as it is back; `None` if the run is over before.
    fn reopen(&self, identity: &str, pause: &mut Duration) -> Option<Box<dyn FrameSource>> {
        let mut told = String::new();
        loop {
            if self.shared.look(self.side) || self.shared.waits_out(*pause) {
                return None;
            }
            *pause = (*pause * 2).min(self.settings.retry().max(FIRST_PAUSE));
            let why = match (self.opener)() {
                Ok(source) if source.identity() == identity => return Some(source),
                Ok(other) => format!(
                    "another camera came back: {} instead of {identity}",
                    other.identity()
                ),
                Err(e) => e.to_string(),
            };
            if why != told {
                self.shared.set_state(self.side, State::Lost, &why);
                told = why;
            }
        }
    }
}
