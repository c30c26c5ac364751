//! The targets of fuzzing without a fuzzer: every file of `tools/fuzz/corpus`, and changes of it, goes through
//! the reader that it is for. Fuzzing itself (`tools/fuzz/run`) searches by coverage, and further.

#[path = "../../tools/fuzz/src/lib.rs"]
mod targets;

use rand::{RngExt, SeedableRng};
use rand_xoshiro::Xoshiro256PlusPlus;
use std::path::PathBuf;

/// Changes of each file.
const CHANGES: usize = 300;

/// The files of one target, in order.
fn corpus_of(target: &str) -> Vec<(PathBuf, Vec<u8>)> {
    let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tools/fuzz/corpus");
    let mut files: Vec<PathBuf> = std::fs::read_dir(folder.join(target))
        .unwrap_or_else(|e| panic!("{target}: {e}"))
        .map(|entry| entry.unwrap().path())
        .collect();
    files.sort();
    let read = |file: PathBuf| (file.clone(), std::fs::read(file).unwrap());
    files.into_iter().map(read).collect()
}

/// Changes a few places, as damage or malice would: bytes, numbers at the ends of their range, parts cut out,
/// doubled, or taken from another file.
fn change(bytes: &mut Vec<u8>, other: &[u8], random: &mut Xoshiro256PlusPlus) {
    const TELLING: [&[u8]; 8] = [
        b"\xFF\xFF\xFF\xFF",
        b"\0\0\0\0",
        b"\xFF\xFF\xFF\x7F",
        b"-1",
        b"1e308",
        b"nan",
        b"9223372036854775807",
        b"../",
    ];
    for _ in 0..random.random_range(1..=4) {
        let at = random.random_range(0..=bytes.len());
        let end = (at + random.random_range(0..=24)).min(bytes.len());
        match random.random_range(0..6) {
            0 if at < bytes.len() => bytes[at] ^= 1 << random.random_range(0..8),
            1 if at < bytes.len() => bytes[at] = random.random(),
            2 => drop(bytes.drain(at..end)),
            3 => {
                let part = bytes[at..end].to_vec();
                bytes.splice(at..at, part);
            }
            4 => {
                let telling = TELLING[random.random_range(0..TELLING.len())];
                bytes.splice(at..end, telling.iter().copied());
            }
            _ if !other.is_empty() => {
                let from = random.random_range(0..other.len());
                let part = &other[from..(from + 40).min(other.len())];
                bytes.splice(at..end, part.iter().copied());
            }
            _ => {}
        }
    }
}

/// Runs one target over its files and their changes; the seed is the same in every run.
fn replay(target: &str) {
    let (_, run) = targets::TARGETS
        .iter()
        .find(|(name, _)| *name == target)
        .expect("a target of that name");
    let files = corpus_of(target);
    assert!(!files.is_empty(), "{target}: its corpus is empty");
    let mut random = Xoshiro256PlusPlus::seed_from_u64(7);
    for (_, bytes) in &files {
        run(bytes);
        for _ in 0..CHANGES {
            let (_, other) = &files[random.random_range(0..files.len())];
            let mut changed = bytes.clone();
            change(&mut changed, other, &mut random);
            run(&changed);
        }
    }
}

/// A test a target, so that they run side by side and a failure says which.
macro_rules! replays {
    ($($test:ident: $target:literal,)*) => {
        $(#[test]
        fn $test() {
            replay($target);
        })*

        #[test]
        fn every_target_is_replayed_and_has_its_binary() {
            let replayed = [$($target),*];
            let manifest = include_str!("../../tools/fuzz/Cargo.toml");
            for (name, _) in targets::TARGETS {
                let is_of_recordings = ["mcap", "ros-message"].contains(name);
                assert!(is_of_recordings || replayed.contains(name), "{name} is not replayed");
                assert!(manifest.contains(&format!("name = \"{name}\"")), "{name} has no binary");
            }
        }
    };
}

replays! {
    any_command_line_is_taken_or_refused: "command-line",
    any_configuration_is_taken_or_refused: "configuration",
    any_points_of_a_board_are_taken_or_refused: "corners",
    any_folder_is_a_recording_or_refused: "dataset",
    any_image_is_decoded_or_refused: "image",
    any_last_pose_is_restored_or_passed_over: "last-pose",
    any_odometry_csv_is_read_or_refused: "odometry-csv",
    any_rig_file_is_read_or_refused: "rig",
    any_covariance_of_a_rig_is_read_or_refused: "rig-covariance",
    any_calibration_of_other_tools_is_imported_or_refused: "rig-import",
    any_message_in_shared_memory_is_taken_or_refused: "shared-memory",
    any_trajectory_is_read_or_refused: "trajectory",
}

#[cfg(feature = "mcap")]
mod of_recordings {
    use super::replay;

    #[test]
    fn any_mcap_file_is_replayed_or_refused() {
        replay("mcap");
    }

    #[test]
    fn any_message_of_ros_is_taken_or_refused() {
        replay("ros-message");
    }
}
