//! Matching as a whole: scenes of known correspondences in, exactly those out.

use super::synthetic::{Scene, View, each_matcher, lookalikes, rig};
use super::*;
use crate::features::Features;
use crate::geometry::Rectification;
use nalgebra::{Vector2, Vector4};
use proptest::prelude::*;
use std::sync::LazyLock;

fn stereo_matcher(settings: &Settings) -> StereoMatcher {
    let rectification = Rectification::new(&rig()).expect("has a baseline");
    StereoMatcher::new(settings.clone(), rectification)
}

fn stereo(settings: &Settings, left: &Features, right: &Features) -> Vec<StereoMatch> {
    // What the list held before must not matter.
    let mut matches = vec![StereoMatch { left: 7, right: 9 }];
    let found = stereo_matcher(settings).find(left, right, &mut matches);
    assert_eq!(found, Ok(()));
    matches
}

fn in_order(mut matches: Vec<StereoMatch>) -> Vec<StereoMatch> {
    matches.sort_by_key(|m| m.left);
    matches
}

fn matched<'a>([left, right]: &'a [View; 2], matches: &'a [StereoMatch]) -> MatchedPair<'a> {
    MatchedPair {
        left: &left.features,
        right: &right.features,
        matches,
    }
}

/// Tracks between the true matches of a scene.
fn tracks(
    settings: &Settings,
    scene: &Scene,
    predicted: &[Option<Vector4<f64>>],
    radius_px: f64,
) -> Vec<Track> {
    let mut tracks = vec![Track { before: 7, now: 9 }];
    let found = TemporalMatcher::new(settings.clone()).find(
        matched(&scene.before, &scene.matches_before()),
        matched(&scene.now, &scene.matches_now()),
        predicted,
        radius_px,
        &mut tracks,
    );
    assert_eq!(found, Ok(()));
    tracks
}

fn all_seen(scene: &Scene) -> Vec<Option<Vector4<f64>>> {
    scene.seen_now.iter().copied().map(Some).collect()
}

/// Matches are listed by point, so that each is tracked to its own number.
fn own_numbers(points: impl IntoIterator<Item = u32>) -> Vec<Track> {
    points
        .into_iter()
        .map(|n| Track { before: n, now: n })
        .collect()
}

#[test]
fn every_point_is_matched_left_to_right_and_nothing_else() {
    for settings in each_matcher() {
        for seed in 0..4 {
            let scene = Scene::new(seed, 300, 200);
            let [left, right] = &scene.now;
            assert_eq!(
                stereo(&settings, &left.features, &right.features),
                in_order(scene.matches_now())
            );
        }
    }
}

#[test]
fn every_point_is_tracked_and_nothing_else() {
    for settings in each_matcher() {
        for seed in 0..4 {
            let scene = Scene::new(seed, 300, 200);
            for radius_px in [5.0, 40.0, 400.0] {
                assert_eq!(
                    tracks(&settings, &scene, &all_seen(&scene), radius_px),
                    own_numbers(0..300)
                );
            }
        }
    }
}

#[test]
fn a_row_too_far_or_an_impossible_disparity_is_no_match() {
    for settings in each_matcher() {
        let scene = Scene::new(5, 100, 50);
        let [left, right] = &scene.now;
        let shifted = |x_px: f32, y_px: f32| {
            let mut right = right.features.clone();
            for k in &mut right.keypoints {
                k.x_px += x_px;
                k.y_px += y_px;
            }
            stereo(&settings, &left.features, &right).len()
        };
        assert_eq!(shifted(0.0, 0.0), 100);
        // The band is ±2 px, of which noise takes 0.8.
        assert_eq!(shifted(0.0, 1.0), 100);
        assert_eq!(shifted(0.0, 4.0), 0);
        assert_eq!(shifted(0.0, -4.0), 0);
        // Disparities of 3 to 45 m: 15 to 228 px, where −1 to 1361 px are possible.
        assert_eq!(shifted(260.0, 0.0), 0);
        assert_eq!(shifted(-1500.0, 0.0), 0);
    }
}

#[test]
fn polarity_and_size_must_agree() {
    for settings in each_matcher() {
        let scene = Scene::new(6, 100, 50);
        let [left, right] = &scene.now;
        let mut flipped = right.features.clone();
        for k in &mut flipped.keypoints {
            k.laplacian = -k.laplacian;
        }
        assert_eq!(stereo(&settings, &left.features, &flipped), []);
        // Sizes differ by 0.9 / 1.1 to 1.1 / 0.9 by noise; up to 1.6 is allowed.
        for (factor, wanted) in [(1.3, 100), (0.77, 100), (2.0, 0), (0.5, 0)] {
            let mut resized = right.features.clone();
            for k in &mut resized.keypoints {
                k.size_px *= factor;
            }
            let found = stereo(&settings, &left.features, &resized).len();
            assert_eq!(found, wanted, "factor {factor}");
        }
    }
}

#[test]
fn without_features_there_are_no_matches() {
    let nothing = Features::default();
    for settings in each_matcher() {
        let scene = Scene::new(7, 20, 0);
        let full = &scene.now[0].features;
        for (left, right) in [(&nothing, &nothing), (full, &nothing), (&nothing, full)] {
            assert_eq!(stereo(&settings, left, right), []);
        }
        let empty = Scene::new(7, 0, 20);
        assert_eq!(tracks(&settings, &empty, &[], 40.0), []);
    }
}

#[test]
fn what_was_matched_before_leaves_no_trace() {
    for settings in each_matcher() {
        let (one, other) = (Scene::new(8, 150, 100), Scene::new(9, 40, 10));
        let mut matcher = stereo_matcher(&settings);
        let mut matches = Vec::new();
        for scene in [&one, &other, &one] {
            let [left, right] = &scene.now;
            let found = matcher.find(&left.features, &right.features, &mut matches);
            assert_eq!(found, Ok(()));
            assert_eq!(matches, stereo(&settings, &left.features, &right.features));
        }
        let mut matcher = TemporalMatcher::new(settings.clone());
        let mut found_tracks = Vec::new();
        for scene in [&one, &other, &one] {
            let found = matcher.find(
                matched(&scene.before, &scene.matches_before()),
                matched(&scene.now, &scene.matches_now()),
                &all_seen(scene),
                40.0,
                &mut found_tracks,
            );
            assert_eq!(found, Ok(()));
            assert_eq!(
                found_tracks,
                tracks(&settings, scene, &all_seen(scene), 40.0)
            );
        }
    }
}

#[test]
fn tracks_lie_near_their_prediction() {
    for settings in each_matcher() {
        let scene = Scene::new(10, 100, 50);
        // Even points are predicted 30 px off, every fifth one not at all.
        let mut predicted = all_seen(&scene);
        for (n, p) in predicted.iter_mut().enumerate() {
            let off_px = if n % 2 == 0 { 30.0 } else { 0.0 };
            *p = p
                .filter(|_| n % 5 != 0)
                .map(|p| p + Vector4::new(off_px, 0.0, off_px, 0.0));
        }
        let narrow = tracks(&settings, &scene, &predicted, 20.0);
        assert_eq!(
            narrow,
            own_numbers((0..100).filter(|n| n % 2 != 0 && n % 5 != 0))
        );
        let wide = tracks(&settings, &scene, &predicted, 35.0);
        assert_eq!(wide, own_numbers((0..100).filter(|n| n % 5 != 0)));
        // A prediction that fails on one side alone is enough to lose a track.
        for p in predicted.iter_mut().flatten() {
            p.w += 100.0;
        }
        assert_eq!(tracks(&settings, &scene, &predicted, 35.0), []);
    }
}

/// Two points exchange what they look like in the right image of now: the left side still tracks
/// both, the right side leads to the other.
#[test]
fn a_track_whose_circle_stays_open_is_dropped() {
    for settings in each_matcher() {
        let mut scene = Scene::new(11, 60, 20);
        let matches = scene.matches_now();
        let right = &mut scene.now[1].features;
        let len = right.descriptor_len;
        let exchanged = [3_usize, 4, 20, 50];
        for two in exchanged.chunks_exact(2) {
            let [a, b] = [two[0], two[1]].map(|n| matches[n].right as usize);
            for c in 0..len {
                right.descriptors.swap(a * len + c, b * len + c);
            }
            let (one, other) = (right.keypoints[a], right.keypoints[b]);
            (right.keypoints[a].laplacian, right.keypoints[b].laplacian) =
                (other.laplacian, one.laplacian);
            (right.keypoints[a].size_px, right.keypoints[b].size_px) = (other.size_px, one.size_px);
        }
        let found = tracks(&settings, &scene, &all_seen(&scene), 3000.0);
        let others = (0..60).filter(|&n| !exchanged.contains(&(n as usize)));
        assert_eq!(found, own_numbers(others));
    }
}

/// The gates of a left and a right feature, from their definition.
fn may_match(settings: &Settings, left: &Features, right: &Features, i: usize, j: usize) -> bool {
    static RECTIFICATION: LazyLock<Rectification> =
        LazyLock::new(|| Rectification::new(&rig()).expect("has a baseline"));
    let rectification = &*RECTIFICATION;
    let (l, r) = (&left.keypoints[i], &right.keypoints[j]);
    let px = |k: &crate::features::Keypoint| Vector2::new(f64::from(k.x_px), f64::from(k.y_px));
    let (Some(a), Some(b)) = (rectification.left(&px(l)), rectification.right(&px(r))) else {
        return false;
    };
    let band_px = settings
        .row_band_px
        .max(settings.row_band_sigmas * f64::from(l.sigma_px));
    let nearest_px = rectification.disparity_px(settings.min_depth_m);
    let size_ratio = (l.size_px / r.size_px).max(r.size_px / l.size_px);
    (a.y - b.y).abs() <= band_px
        && (settings.min_disparity_px..=nearest_px).contains(&(a.x - b.x))
        && l.laplacian == r.laplacian
        && size_ratio <= settings.max_size_ratio
}

fn squared(a: &[f32], b: &[f32]) -> f32 {
    a.iter().zip(b).map(|(x, y)| (x - y) * (x - y)).sum()
}

/// Matches by comparing everything with everything.
fn plain_stereo(settings: &Settings, left: &Features, right: &Features) -> Vec<StereoMatch> {
    let mut squares = vec![vec![f32::INFINITY; right.len()]; left.len()];
    for (i, row) in squares.iter_mut().enumerate() {
        for (j, square) in row.iter_mut().enumerate() {
            if may_match(settings, left, right, i, j) {
                *square = squared(left.descriptor(i), right.descriptor(j));
            }
        }
    }
    let chosen = |all: Vec<f32>| {
        let mut order: Vec<usize> = (0..all.len()).collect();
        order.sort_by(|&a, &b| all[a].total_cmp(&all[b]));
        let best = *order.first()?;
        let second = order.get(1).map_or(f32::INFINITY, |&n| all[n]);
        let near = all[best].sqrt() <= settings.max_distance;
        (near && all[best].sqrt() <= settings.max_ratio * second.sqrt()).then_some(best)
    };
    (0..left.len())
        .filter_map(|i| {
            let j = chosen(squares[i].clone())?;
            let back = chosen(squares.iter().map(|row| row[j]).collect())?;
            (back == i).then_some(StereoMatch {
                left: i as u32,
                right: j as u32,
            })
        })
        .collect()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn the_guided_search_finds_what_comparing_everything_finds(
        seed: u64, max_ratio in 0.5..1.0_f32, max_distance in 0.1..1.5_f32,
    ) {
        let settings = Settings { max_ratio, max_distance, ..Settings::default() };
        let [left, right] = lookalikes(seed, 120);
        prop_assert_eq!(
            stereo(&settings, &left, &right),
            plain_stereo(&settings, &left, &right)
        );
    }

    #[test]
    fn every_match_passes_every_gate_and_each_feature_is_in_one_at_most(seed: u64) {
        for settings in each_matcher() {
            // Nothing is too much alike: many candidates become matches.
            let settings = Settings { max_ratio: 1.0, ..settings };
            let [left, right] = lookalikes(seed, 200);
            let matches = stereo(&settings, &left, &right);
            for m in &matches {
                let (i, j) = (m.left as usize, m.right as usize);
                prop_assert!(may_match(&settings, &left, &right, i, j));
                let distance = squared(left.descriptor(i), right.descriptor(j)).sqrt();
                prop_assert!(distance <= settings.max_distance);
            }
            prop_assert!(matches.is_sorted_by(|a, b| a.left < b.left));
            let mut rights: Vec<u32> = matches.iter().map(|m| m.right).collect();
            rights.sort_unstable();
            prop_assert!(rights.is_sorted_by(|a, b| a < b));
        }
    }
}

#[cfg(feature = "opencv")]
#[test]
fn descriptors_that_flann_refuses_are_an_error() {
    let settings = Settings {
        matcher: MatcherName::Flann,
        ..Settings::default()
    };
    let scene = Scene::new(12, 20, 0);
    let left = &scene.now[0].features;
    let mut right = scene.now[1].features.clone();
    right.descriptor_len = 32;
    let mut matches = scene.matches_now();
    let found = stereo_matcher(&settings).find(left, &right, &mut matches);
    assert_eq!(
        found.expect_err("refused").to_string(),
        "descriptors of 64 and of 32 numbers cannot be compared; are they of different detectors?"
    );
    assert_eq!(matches, []);
}

fn parsed(text: &str) -> Result<(), SettingError> {
    let settings: Settings = toml::from_str(text).expect("has the right types");
    settings.check()
}

#[cfg(feature = "opencv")]
#[test]
fn flann_can_be_chosen_and_set() {
    assert_eq!(parsed("matcher = \"guided\""), Ok(()));
    assert_eq!(
        parsed("matcher = \"flann\"\nflann = { checks = 64 }"),
        Ok(())
    );
    let error = parsed("flann = { trees = 0 }").expect_err("refused");
    assert_eq!(error.key, "flann.trees");
}

#[cfg(not(feature = "opencv"))]
#[test]
fn flann_is_refused_where_it_was_not_built_in() {
    assert_eq!(parsed("matcher = \"guided\""), Ok(()));
    for text in ["matcher = \"flann\"", "flann = { checks = 64 }"] {
        let error = parsed(text).expect_err("refused");
        assert_eq!(error.key, "matcher");
        assert!(
            error.cause.contains("cargo feature `opencv`"),
            "{}",
            error.cause
        );
    }
    let settings = Settings {
        matcher: MatcherName::Flann,
        ..Settings::default()
    };
    let nothing = Features::default();
    let found = stereo_matcher(&settings).find(&nothing, &nothing, &mut Vec::new());
    assert_eq!(found, Err(MatchError::NotBuiltIn));
}
