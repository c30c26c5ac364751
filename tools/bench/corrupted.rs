//! What is published of corrupted pairs, and whether it is right: `cargo bench --bench corrupted [SEQUENCES [SEED [WORD…]]]`.
//!
//! Rendered sequences through the whole pipeline, once for every kind of corruption: black, frozen or torn images,
//! swapped cameras, wrong order, noise and so on. 34 sequences hold more than 10,000 corrupted pairs; the word `rows`
//! prints every row that is wrong, one that ends in `.toml` names a configuration, others, such as `mover`, the kinds that
//! are run.

mod common;

use std::path::Path;
use visod::config::Config;
use visod::estimation::Odometry;
use visod::geometry::{RigUncertainty, StereoRig};
use visod::montecarlo::run_corrupted;
use visod::simulation::corruption::Corruption;
use visod::simulation::small_rig;

/// Sequences where none are asked for.
const SEQUENCES: u64 = 34;

fn main() {
    let words = common::words();
    let number = |at: usize, or: u64| {
        words
            .get(at)
            .and_then(|word| word.parse().ok())
            .unwrap_or(or)
    };
    let named = |kind: &Corruption| words.iter().any(|word| *word == kind.to_string());
    let mut kinds: Vec<Corruption> = Corruption::ALL.into_iter().filter(named).collect();
    if kinds.is_empty() {
        kinds.extend(Corruption::ALL);
    }
    let (sequences, seed) = (number(0, SEQUENCES), number(1, 1));
    let config = match words.iter().find(|word| word.ends_with(".toml")) {
        Some(file) => common::loaded(Path::new(file)),
        None => Config::default(),
    };
    let outcome = match run_corrupted(&rig(), &config, &kinds, sequences, seed, &|_| eprint!(".")) {
        Ok(outcome) => outcome,
        Err(e) => unreachable!("the rig states its uncertainty: {e}"),
    };
    println!("{}", outcome.to_table());
    if words.iter().any(|word| word == "rows") {
        for wrong in &outcome.wrong {
            let Odometry {
                sequence,
                status,
                counts,
                innovation_ratio,
                variance_factor,
                ..
            } = &wrong.row;
            println!(
                "{:?} run {} pair {sequence} +{}{} {status:?} nees/6 of motion {:.1}, of pose {:.1}; matches {} tracks {} \
                 inliers {} innovation {innovation_ratio:.2} variance factor {variance_factor:.2}",
                wrong.kind,
                wrong.run,
                wrong.since,
                if wrong.is_corrupted { " corrupted" } else { "" },
                wrong.nees[0],
                wrong.nees[1],
                counts.stereo_matches,
                counts.tracks,
                counts.inliers,
            );
        }
    }
}

/// The small rig, about as well known as a careful calibration leaves it.
fn rig() -> StereoRig {
    StereoRig {
        uncertainty: Some(RigUncertainty::Sigmas {
            focal_px: 0.3,
            principal_point_px: 0.3,
            rotation_rad: 1e-4,
            translation_m: 2e-4,
        }),
        ..small_rig()
    }
}
