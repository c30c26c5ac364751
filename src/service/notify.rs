//! What the service manager is told, where there is one; elsewhere all of this does nothing.

use sd_notify::NotifyState;
use std::time::Duration;

/// The service manager that started this process.
#[derive(Debug, Default)]
pub struct Manager {
    is_ready: bool,
    status: String,
}

impl Manager {
    /// How often [`alive`](Self::alive) is to be called, if at all: three times in the period after which
    /// the manager kills a silent process.
    #[must_use]
    pub fn heartbeat() -> Option<Duration> {
        sd_notify::watchdog_enabled().map(|period| period / 3)
    }

    /// Says, once, that the service does what it is there for.
    pub fn ready(&mut self) {
        if !std::mem::replace(&mut self.is_ready, true) {
            tell(&[NotifyState::Ready]);
        }
    }

    /// Whether it has been said.
    #[must_use]
    pub fn is_ready(&self) -> bool {
        self.is_ready
    }

    /// Says in one line how things are, where that has changed.
    pub fn status(&mut self, status: &str) {
        if self.status != status {
            status.clone_into(&mut self.status);
            tell(&[NotifyState::Status(status)]);
        }
    }

    /// Keeps the manager from killing this process.
    pub fn alive(&self) {
        tell(&[NotifyState::Watchdog]);
    }

    /// Says that the configuration is being read anew; [`reloaded`](Self::reloaded) ends that.
    pub fn reloading(&self) {
        // Without a stamp the manager would not take it; without the time there is no stamp.
        if let Ok(stamp) = NotifyState::monotonic_usec_now() {
            tell(&[NotifyState::Reloading, stamp]);
        }
    }

    /// Says that the configuration has been read anew.
    pub fn reloaded(&self) {
        if self.is_ready {
            tell(&[NotifyState::Ready]);
        }
    }

    /// Says that the service is about to end.
    pub fn stopping(&self) {
        tell(&[NotifyState::Stopping]);
    }
}

fn tell(states: &[NotifyState<'_>]) {
    // A manager that does not listen is none.
    if let Err(cause) = sd_notify::notify(states) {
        tracing::debug!(%cause, "the service manager cannot be told");
    }
}
