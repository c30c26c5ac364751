//! The file that the run before has left.

use super::folder::Folder;
use super::sentence;
use visod::output::last_pose::{Legacy, Settings};

/// Any bytes are a last pose, or a warning and a fresh beginning.
pub fn run(data: &[u8]) {
    let folder = Folder::new();
    let settings = Settings {
        file: Some(folder.put("last-pose.toml", data)),
        restore: true,
        ..Settings::default()
    };
    let legacy = Legacy::read(&settings, 1_700_000_000_000_000_000);
    if let Some(why) = &legacy.warning {
        sentence::check(why);
    }
    if let Some(start) = &legacy.start {
        assert!(start.cov_pose.cholesky().is_some());
        assert!(
            start
                .odom_from_camera
                .to_homogeneous()
                .iter()
                .all(|v| v.is_finite())
        );
    }
}
