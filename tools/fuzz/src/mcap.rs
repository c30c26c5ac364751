//! MCAP recordings.

use super::folder::Folder;
use super::sentence;
use visod::capture::dataset::Settings;
use visod::capture::mcap::McapRecording;
use visod::capture::{PairEvent, PairSource};
use visod::geometry::StereoRig;
use visod::simulation::small_rig;

/// Any bytes are a recording that comes to an end, or refused.
pub fn run(data: &[u8]) {
    let folder = Folder::new();
    let file = folder.put("recording.mcap", data);
    for rig in [None, Some(tiny_rig())] {
        let recording = match McapRecording::open(&file, rig, None, Settings::default()) {
            Ok(recording) => recording,
            Err(why) => {
                sentence::check(&why.to_string());
                continue;
            }
        };
        let mut source = recording.source().expect("a file that was there");
        let mut last_ns = None;
        while let Some(event) = source.next_event() {
            match event {
                PairEvent::Pair(pair) => {
                    assert!(
                        last_ns.is_none_or(|last| pair.timestamp_ns > last),
                        "stamps do not rise"
                    );
                    last_ns = Some(pair.timestamp_ns);
                    source.recycle(pair);
                }
                PairEvent::Unusable(unusable) => sentence::check(&unusable.why),
            }
        }
    }
}

/// A rig whose images have few pixels.
fn tiny_rig() -> StereoRig {
    let mut rig = small_rig();
    for camera in [&mut rig.left, &mut rig.right] {
        (camera.width, camera.height) = (16, 12);
    }
    rig
}
