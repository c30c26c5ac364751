//! The settings of `[service]`.

use crate::settings::SettingError;
use serde::{Deserialize, Serialize};
use std::time::Duration;

/// How the daemon behaves as a service.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// Time from a pair's arrival to its pose after which it counts as an overrun. s, 0.01 to 60, default
    /// 1: what a slow robot can still use. Taken over on SIGHUP.
    pub deadline_s: f64,
    /// Look for fewer features when pairs begin to queue, before any is dropped. Yes or no, default yes: a
    /// pose of fewer features is better than none, and its covariance says so. Taken over on SIGHUP.
    pub trim: bool,
    /// Real-time priority (SCHED_FIFO) of the threads that take frames from the cameras; 0 for none. 0 to
    /// 99, default 0: it takes a privilege. 20 is enough to go before everything that is not real-time.
    pub priority: u32,
    /// Keep all of the daemon's memory from being paged out. Yes or no, default no: it takes a privilege.
    pub lock_memory: bool,
    /// The processors that the daemon may run on, by number. Default none: all.
    pub processors: Vec<usize>,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            deadline_s: 1.0,
            trim: true,
            priority: 0,
            lock_memory: false,
            processors: Vec::new(),
        }
    }
}

impl Settings {
    /// Refuses values out of range.
    ///
    /// # Errors
    /// The first setting out of range.
    pub fn check(&self) -> Result<(), SettingError> {
        SettingError::unless_in("deadline_s", self.deadline_s, 0.01..=60.0)?;
        SettingError::unless_in("priority", self.priority, 0..=99)?;
        for processor in &self.processors {
            SettingError::unless_in("processors", *processor, 0..=1023)?;
        }
        Ok(())
    }

    /// Time from a pair's arrival to its pose after which it counts as an overrun.
    #[must_use]
    pub fn deadline(&self) -> Duration {
        Duration::from_secs_f64(self.deadline_s)
    }
}
