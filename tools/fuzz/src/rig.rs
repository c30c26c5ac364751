//! Rig files.

use super::sentence;
use visod::geometry::{check_rig, parse_rig, rig_to_toml};

/// Any text is a rig, which is written so that it reads back, or refused.
pub fn run(data: &[u8]) {
    let Ok(text) = std::str::from_utf8(data) else {
        return;
    };
    match parse_rig(text) {
        Ok(rig) => {
            let _ = check_rig(&rig);
            let written = rig_to_toml(&rig);
            assert!(parse_rig(&written).is_ok(), "does not read back: {written}");
        }
        Err(why) => sentence::check(&why.to_string()),
    }
}
