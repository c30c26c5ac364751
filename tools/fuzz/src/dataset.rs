//! Folders with recordings, of every layout.

use super::folder::Folder;
use super::sentence;
use std::path::Component;
use visod::capture::Dataset;
use visod::capture::dataset::ImageFiles;
use visod::evaluation::read_trajectory;
use visod::simulation::small_rig;

/// Any folder is a recording, whose files are its own and whose stamps rise, or refused.
pub fn run(data: &[u8]) {
    let folder = Folder::new();
    folder.unpack(data);
    for rig in [None, Some(small_rig())] {
        let dataset = match Dataset::open(folder.path(), rig) {
            Ok(dataset) => dataset,
            Err(why) => {
                sentence::check(&why.to_string());
                continue;
            }
        };
        for pair in &dataset.pairs {
            match &pair.images {
                ImageFiles::Both { left, right } => {
                    for file in [left, right] {
                        let within = file
                            .strip_prefix(folder.path())
                            .expect("a file of the recording");
                        assert!(
                            within
                                .components()
                                .all(|c| matches!(c, Component::Normal(_)))
                        );
                    }
                }
                ImageFiles::Unpaired { why } => sentence::check(why),
            }
        }
        for two in dataset.pairs.windows(2) {
            let apart = two[1].timestamp_ns.checked_sub(two[0].timestamp_ns);
            assert!(apart.is_some_and(|ns| ns > 0), "stamps do not rise");
        }
        if let Some(truth) = &dataset.ground_truth
            && let Err(why) = read_trajectory(truth)
        {
            sentence::check(&why.to_string());
        }
    }
}
