//! How long it takes from matches to a pose with its covariance: `cargo bench --bench estimation`.
//!
//! One thread, the features of recordings held in memory. The same run says what matching real
//! features takes, left–right and over time, with 1,000 keypoints an image, and what motion and
//! covariance take when the window follows 500 landmarks.

mod common;

use common::memory::{Recording, estimation};
use common::ms;
use visod::estimation::Settings;
use visod::features::{self, Features};
use visod::pipeline::{DescribedPair, Method};
use visod::simulation::thesis_rig;

/// Landmarks to follow so that a pair sees about 500 of them.
const MANY_LANDMARKS: u32 = 530;

/// Pairs that are stepped through.
const PAIRS: u64 = 200;

fn main() {
    println!("\n### Matching and estimation of real features, one thread\n");
    println!("| recording | stage | best ms | median ms | p99 ms | tracks | inliers |");
    println!("|---|---|---:|---:|---:|---:|---:|");
    let simulated = Recording::simulated(thesis_rig(), 12);
    measure("simulated, 1280 × 960", &simulated, estimation());
    let many = Settings {
        max_landmarks: MANY_LANDMARKS,
        ..estimation()
    };
    measure("the same, 500 tracks", &simulated, many);
    if let Some(kitti) = Recording::recorded("kitti_straight", 20) {
        measure("KITTI", &kitti, estimation());
    }
}

fn measure(name: &str, recording: &Recording, settings: Settings) {
    let described = described(recording);
    let rig = recording.rig.clone();
    let Some(mut method) = Method::new(rig, Default::default(), settings) else {
        unreachable!("the cameras stand side by side")
    };
    let mut pair = DescribedPair::default();
    let mut times = [Vec::new(), Vec::new()];
    let (mut tracks, mut inliers) = (0, 0);
    for place in 0..PAIRS {
        let [left, right] = &described[recording.index(place)];
        let images = &recording.pairs[recording.index(place)];
        for (side, features, image) in [
            (&mut pair.left, left, &images.left),
            (&mut pair.right, right, &images.right),
        ] {
            side.features.clone_from(features);
            side.take(image);
        }
        pair.sequence = place;
        pair.timestamp_ns = 100_000_000 * place as i64;
        let Ok(row) = method.step(&mut pair) else {
            unreachable!("the guided matcher always answers")
        };
        if place > 0 {
            times[0].push(method.times().matching);
            times[1].push(method.times().estimation);
            tracks += u64::from(row.counts.tracks);
            inliers += u64::from(row.counts.inliers);
        }
    }
    for (stage, times) in ["matching", "estimation"].iter().zip(&mut times) {
        times.sort_unstable();
        let at = |share: f64| ms(times[(share * (times.len() - 1) as f64) as usize]);
        println!(
            "| {name} | {stage} | {:.2} | {:.2} | {:.2} | {} | {} |",
            at(0.0),
            at(0.5),
            at(0.99),
            tracks / (PAIRS - 1),
            inliers / (PAIRS - 1)
        );
    }
}

fn described(recording: &Recording) -> Vec<[Features; 2]> {
    let Ok(mut extractor) = features::extractor(&features::Settings::default()) else {
        unreachable!("the defaults are in range")
    };
    let mut describe = |image| {
        let mut features = Features::default();
        assert_eq!(extractor.extract(image, &mut features), Ok(()));
        features
    };
    recording
        .pairs
        .iter()
        .map(|pair| [&pair.left, &pair.right].map(&mut describe))
        .collect()
}
