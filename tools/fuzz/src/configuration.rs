//! The configuration.

use super::sentence;
use visod::config::Config;

/// Any text is a configuration or refused.
pub fn run(data: &[u8]) {
    let Ok(text) = std::str::from_utf8(data) else {
        return;
    };
    match Config::parse(text) {
        // What was read is in range, and so may be asked anything.
        Ok(config) => assert!(config.features.check().is_ok()),
        Err(why) => sentence::check(&why.to_string()),
    }
}
