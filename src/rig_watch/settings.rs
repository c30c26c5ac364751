//! How the rig is watched.

use crate::settings::SettingError;
use serde::{Deserialize, Serialize};

/// How the rig is watched.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// Watch whether the cameras have turned against each other, and warn. Default true: it costs a
    /// millisecond a pair, and changes no estimate.
    pub enabled: bool,
    /// Correct measurements for the turn once it is certain. Default false: until then nothing differs, but
    /// a rig that moves wants to be looked at.
    pub refine: bool,
    /// Chance of a false alarm, of each test of a pair. 1e-12 to 0.1, default 1e-6: less than one a day at
    /// 10 Hz, as what pairs say is counted tenfold too carefully.
    pub false_alarm: f64,
    /// How far the cameras may creep against each other in a second, 1 σ, growing with the root of
    /// time. rad, 0 to 0.01, default 1e-6: a tenth of a milliradian in three hours, as warming does.
    pub walk_rad: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            enabled: true,
            refine: false,
            false_alarm: 1e-6,
            walk_rad: 1e-6,
        }
    }
}

impl Settings {
    /// Refuses values out of range.
    ///
    /// # Errors
    /// The first setting out of range.
    pub fn check(&self) -> Result<(), SettingError> {
        SettingError::unless_in("false_alarm", self.false_alarm, 1e-12..=0.1)?;
        SettingError::unless_in("walk_rad", self.walk_rad, 0.0..=0.01)
    }
}
