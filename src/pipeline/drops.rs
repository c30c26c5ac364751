//! Everything that was lost on its way through a run: one table, by stage and reason, for whoever shows it.

use super::RunCounts;
use crate::capture::live::Snapshot;
use serde::Serialize;

/// What one stage lost for one reason.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct DropCount {
    /// Where: `capture`, `pairing`, `queue`, `features`, `matching`, `publication`, `recording` or `view`.
    pub stage: &'static str,
    /// Why, in a word.
    pub reason: &'static str,
    /// Whose frames: `left`, `right`, or `both` for pairs and what is made of them.
    pub camera: &'static str,
    /// How many.
    pub count: u64,
}

/// What did not reach those for whom it was meant, though it was there.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Undelivered {
    /// Messages that could not be published.
    pub unpublished: u64,
    /// Pairs whose images are not in the recording of this run, the disk being behind.
    pub unrecorded: u64,
    /// Pairs that a live view did not show, there being no time to.
    pub unshown: u64,
}

/// All that a run may lose, with what it has lost: of frames where there are cameras, of pairs, and of
/// messages. A reason that has not occurred counts 0.
///
/// A left frame without a partner also costs its pair, whose row is then bridged; that is told by the rows'
/// status and not counted here a second time.
#[must_use]
pub fn drops(
    cameras: Option<&Snapshot>,
    counts: &RunCounts,
    undelivered: &Undelivered,
) -> Vec<DropCount> {
    let both = |stage, reason, count| DropCount {
        stage,
        reason,
        camera: "both",
        count,
    };
    let mut drops = match cameras {
        Some(cameras) => of_cameras(cameras),
        None => vec![both("capture", "unusable", counts.unusable_in_capture)],
    };
    let dropped = cameras.map_or(0, |cameras| cameras.dropped);
    drops.extend([
        both("queue", "stages_late", dropped),
        both("features", "failed", counts.unusable_in_features),
        both("matching", "repeated", counts.unusable_as_repeats),
        both("matching", "failed", counts.unusable_in_matching),
        both("publication", "failed", undelivered.unpublished),
        both("recording", "disk_behind", undelivered.unrecorded),
        both("view", "no_time", undelivered.unshown),
    ]);
    drops
}

fn of_cameras(cameras: &Snapshot) -> Vec<DropCount> {
    let sides = ["left", "right"].into_iter().zip(&cameras.cameras);
    sides
        .flat_map(|(camera, status)| {
            let of = move |stage, reason, count| DropCount {
                stage,
                reason,
                camera,
                count,
            };
            let lost = status.losses.iter();
            let unmatched = status.unmatched.iter();
            lost.map(move |(kind, frames)| of("capture", kind.as_str(), frames))
                .chain(unmatched.map(move |(why, frames)| of("pairing", why, frames)))
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::camera::Loss;
    use crate::capture::pairing::WhyUnmatched;

    fn count(drops: &[DropCount], stage: &str, reason: &str, camera: &str) -> Option<u64> {
        let wanted = |d: &&DropCount| (d.stage, d.reason, d.camera) == (stage, reason, camera);
        drops.iter().find(wanted).map(|d| d.count)
    }

    #[test]
    fn each_loss_stands_under_its_stage_and_reason() {
        let mut cameras = Snapshot::default();
        cameras.cameras[0].losses.add(Loss::Incomplete, 3);
        cameras.cameras[1].unmatched.add(&WhyUnmatched::OtherSilent);
        cameras.dropped = 5;
        let counts = RunCounts {
            unusable: 13,
            unusable_in_capture: 2,
            unusable_in_features: 1,
            unusable_as_repeats: 4,
            unusable_in_matching: 6,
            ..RunCounts::default()
        };
        let undelivered = Undelivered {
            unpublished: 7,
            unrecorded: 8,
            unshown: 10,
        };
        let drops = drops(Some(&cameras), &counts, &undelivered);
        assert_eq!(count(&drops, "capture", "incomplete", "left"), Some(3));
        assert_eq!(count(&drops, "pairing", "other_silent", "right"), Some(1));
        assert_eq!(count(&drops, "queue", "stages_late", "both"), Some(5));
        assert_eq!(count(&drops, "features", "failed", "both"), Some(1));
        assert_eq!(count(&drops, "matching", "repeated", "both"), Some(4));
        assert_eq!(count(&drops, "matching", "failed", "both"), Some(6));
        assert_eq!(count(&drops, "publication", "failed", "both"), Some(7));
        assert_eq!(count(&drops, "recording", "disk_behind", "both"), Some(8));
        assert_eq!(count(&drops, "view", "no_time", "both"), Some(10));
        assert_eq!(drops.iter().map(|d| d.count).sum::<u64>(), 45);
    }

    #[test]
    fn a_recording_loses_pairs_and_no_frames() {
        let counts = RunCounts {
            unusable_in_capture: 4,
            ..RunCounts::default()
        };
        let drops = drops(None, &counts, &Undelivered::default());
        assert_eq!(count(&drops, "capture", "unusable", "both"), Some(4));
        assert!(drops.iter().all(|d| d.camera == "both"));
    }
}
