//! The covariance beside a rig file.

use super::sentence;
use visod::geometry::rig_parameters::{parse_rig_covariance, rig_covariance_to_csv};
use visod::simulation::small_rig;

/// Any text is a covariance of this rig, or refused.
pub fn run(data: &[u8]) {
    let Ok(text) = std::str::from_utf8(data) else {
        return;
    };
    let rig = small_rig();
    match parse_rig_covariance(&rig, text) {
        Ok(covariance) => {
            assert!(covariance.iter().all(|v| v.is_finite()));
            let written = rig_covariance_to_csv(&rig, &covariance);
            assert!(
                parse_rig_covariance(&rig, &written).is_ok(),
                "does not read back: {written}"
            );
        }
        Err(why) => sentence::check(&why),
    }
}
