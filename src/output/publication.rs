//! Where odometry is published: service names, sizes and the settings of `[publish]`.
//!
//! Publisher and subscriber read the same settings, since iceoryx2 lets two processes meet only
//! where root and prefix agree. What is not set comes from iceoryx2's own configuration: the file
//! `config/iceoryx2.toml` below the working directory, the user's `iceoryx2/iceoryx2.toml` or
//! `/etc/iceoryx2/iceoryx2.toml`, whichever is found first.

use crate::settings::SettingError;
use std::net::SocketAddr;
use std::path::PathBuf;

/// Service of [`OdometryMessage`](super::message::OdometryMessage) and of the events beside it.
pub const ODOMETRY_SERVICE: &str = "visod/odometry";
/// Service of [`FeaturesMessage`](super::features::FeaturesMessage) and of the events beside it; there only
/// where `publish.features` is set.
pub const FEATURES_SERVICE: &str = "visod/features";
/// Service of [`HealthMessage`](super::health::HealthMessage) and of the events beside it.
pub const HEALTH_SERVICE: &str = "visod/health";

/// Where Foxglove looks for a server of its own accord.
pub const FOXGLOVE_ADDRESS: &str = "127.0.0.1:8765";

/// Messages that wait for a subscriber before the oldest is overwritten.
pub const ODOMETRY_BUFFER: usize = 512;
/// As [`ODOMETRY_BUFFER`], for features: each message is large.
pub const FEATURES_BUFFER: usize = 8;
/// As [`ODOMETRY_BUFFER`], for health.
pub const HEALTH_BUFFER: usize = 16;
/// Subscribers that a service has room for.
pub const MAX_SUBSCRIBERS: usize = 16;
/// Publishers that a service has room for: one that runs, others that were killed and are not
/// cleaned up yet.
pub const MAX_PUBLISHERS: usize = 4;
/// Processes that may have a service open.
pub const MAX_NODES: usize = 40;

/// Numbers of the events that go with each service.
pub mod events {
    /// A message was published.
    pub const PUBLISHED: usize = 0;
    /// The publisher will leave: connect to what it has sent and answer.
    pub const LEAVING: usize = 1;
    /// A subscriber's answer: it is connected, and what was sent can no longer be lost.
    pub const CONNECTED: usize = 2;
    /// Greatest of these numbers.
    pub const MAX: usize = 7;
}

/// The settings of `[publish]`.
#[derive(Clone, Debug, PartialEq, serde::Deserialize, serde::Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// Directory below which iceoryx2 keeps its files; under systemd the unit's runtime directory.
    /// Path, absolute, at most 60 bytes together with the prefix, default none: as iceoryx2 is
    /// configured, else `/tmp/iceoryx2`, where every consumer looks.
    pub root: Option<PathBuf>,
    /// Prefix of iceoryx2's files and shared memory, which keeps several systems on one host apart.
    /// Letters, digits, `_`, `-` and `.`, at most 32, default none: as iceoryx2 is configured, else
    /// `iox2_`.
    pub prefix: Option<String>,
    /// Refuse to start while another process publishes odometry, since consumers would get both
    /// mixed. Yes or no, default yes: a second daemon or a replay must not steer a robot by accident.
    pub exclusive: bool,
    /// Publish the pose of the robot's base where the rig has a mounting, else that of the left
    /// camera. Yes or no, default yes: it is what navigation works with.
    pub base_frame: bool,
    /// Publish the features that each estimate rests on, in the image and in space, as the service
    /// `visod/features`. Yes or no, default no: 53 kB a pair, which only somebody who looks at them wants.
    pub features: bool,
    /// Show every run to Foxglove at this address, over a WebSocket, where visod has the feature foxglove.
    /// ADDRESS:PORT, default none; 127.0.0.1:8765 is where Foxglove looks, and nobody from elsewhere.
    pub foxglove: Option<SocketAddr>,
    /// Longest time that a publisher waits on leaving for subscribers that have not yet connected to
    /// it. ms, 0 to 10000, default 500: long enough on a busy machine, short enough to restart.
    pub linger_ms: u64,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            root: None,
            prefix: None,
            exclusive: true,
            base_frame: true,
            features: false,
            foxglove: None,
            linger_ms: 500,
        }
    }
}

impl Settings {
    /// Refuses what iceoryx2 could not use.
    ///
    /// # Errors
    /// The first setting that cannot be.
    pub fn check(&self) -> Result<(), SettingError> {
        if let Some(prefix) = &self.prefix {
            check_prefix(prefix)?;
        }
        if let Some(root) = &self.root {
            check_root(root, self.prefix.as_deref().unwrap_or("iox2_"))?;
        }
        SettingError::unless_in("linger_ms", self.linger_ms, 0..=10_000)
    }
}

/// Longest root and prefix together, bytes. A socket's path, of at most 107 bytes, adds a slash, a
/// number of up to 39 digits and `.event`.
const MAX_ROOT_AND_PREFIX_BYTES: usize = 60;
/// Longest prefix, bytes.
const MAX_PREFIX_BYTES: usize = 32;

fn check_root(root: &std::path::Path, prefix: &str) -> Result<(), SettingError> {
    let cause = if !root.is_absolute() {
        "must be an absolute path"
    } else if root.as_os_str().len() + prefix.len() > MAX_ROOT_AND_PREFIX_BYTES {
        "must be, together with the prefix, at most 60 bytes long, since sockets lie below it"
    } else if root.to_str().is_none() {
        "must be text in UTF-8"
    } else {
        return Ok(());
    };
    Err(SettingError {
        key: "root",
        cause: format!("{cause}, but is {}", root.display()),
    })
}

fn check_prefix(prefix: &str) -> Result<(), SettingError> {
    let usable = |c: char| c.is_ascii_alphanumeric() || "_-.".contains(c);
    if (1..=MAX_PREFIX_BYTES).contains(&prefix.len()) && prefix.chars().all(usable) {
        return Ok(());
    }
    Err(SettingError {
        key: "prefix",
        cause: format!("must be 1 to 32 letters, digits, '_', '-' or '.', but is '{prefix}'"),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn key_of(settings: &Settings) -> Option<&'static str> {
        settings.check().err().map(|e| e.key)
    }

    #[test]
    fn what_iceoryx2_cannot_use_is_refused() {
        let ok = Settings::default();
        assert_eq!(key_of(&ok), None);
        let with_root = |root: &str| Settings {
            root: Some(root.into()),
            ..Settings::default()
        };
        assert_eq!(key_of(&with_root("/run/visod")), None);
        assert_eq!(key_of(&with_root("run")), Some("root"));
        assert_eq!(key_of(&with_root(&format!("/{}", "x".repeat(54)))), None);
        assert_eq!(
            key_of(&with_root(&format!("/{}", "x".repeat(55)))),
            Some("root")
        );
        let with_prefix = |prefix: &str| Settings {
            prefix: Some(prefix.into()),
            ..Settings::default()
        };
        assert_eq!(key_of(&with_prefix("robot2_")), None);
        assert_eq!(key_of(&with_prefix("")), Some("prefix"));
        assert_eq!(key_of(&with_prefix("a/b")), Some("prefix"));
        let patient = Settings {
            linger_ms: 10_001,
            ..Settings::default()
        };
        assert_eq!(key_of(&patient), Some("linger_ms"));
    }

    #[test]
    fn unknown_keys_are_refused() {
        assert!(toml::from_str::<Settings>("rooot = '/run'").is_err());
        let set: Settings = toml::from_str("root = '/run/visod'").unwrap();
        assert_eq!(set.prefix, None);
    }
}
