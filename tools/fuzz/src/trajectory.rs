//! Trajectories: truths and others' estimates.

use super::sentence;
use std::path::Path;
use visod::evaluation::trajectory::parse_trajectory;

/// Any text is a trajectory of finite poses, whose stamps rise, or refused.
pub fn run(data: &[u8]) {
    let Ok(text) = std::str::from_utf8(data) else {
        return;
    };
    match parse_trajectory(Path::new("poses.txt"), text) {
        Ok(trajectory) => {
            for pose in &trajectory.world_from_body {
                assert!(pose.to_homogeneous().iter().all(|v| v.is_finite()));
            }
            if let Some(stamps) = &trajectory.stamps_ns {
                assert_eq!(stamps.len(), trajectory.world_from_body.len());
                for two in stamps.windows(2) {
                    assert!(
                        two[1].checked_sub(two[0]).is_some_and(|ns| ns > 0),
                        "stamps do not rise"
                    );
                }
            }
        }
        Err(why) => sentence::check(&why.to_string()),
    }
}
