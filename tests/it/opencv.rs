//! OpenCV's detectors and FLANN through this crate's types, on a texture that is known everywhere.

use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, Normal};
use rand_xoshiro::Xoshiro256PlusPlus;
use std::f32::consts::{PI, TAU};
use visod::features::opencv::{Detector, OpencvExtractor, Settings};
use visod::features::{Extractor, Features, Keypoint};
use visod::image::GrayImage;
use visod::matching::flann::FlannMatcher;

const WIDTH: u32 = 480;
const HEIGHT: u32 = 360;
const DETECTORS: [Detector; 3] = [Detector::Sift, Detector::Orb, Detector::Akaze];

/// Gaussian blobs, some long and some round: (x, y, grey, σ along, σ across, direction).
struct Texture(Vec<[f64; 6]>);

impl Texture {
    fn new(seed: u64) -> Self {
        let mut random = Xoshiro256PlusPlus::seed_from_u64(seed);
        let count = 1500;
        Self(
            (0..count)
                .map(|_| {
                    let sigma = random.random_range(1.2..5.0);
                    [
                        random.random_range(-20.0..f64::from(WIDTH) + 20.0),
                        random.random_range(-20.0..f64::from(HEIGHT) + 20.0),
                        random.random_range(-90.0..90.0),
                        sigma,
                        sigma * random.random_range(0.4..1.0),
                        random.random_range(0.0..std::f64::consts::PI),
                    ]
                })
                .collect(),
        )
    }

    /// The texture moved by (dx, dy) px, under noise of `sigma` grey levels.
    fn image(&self, [dx, dy]: [f64; 2], sigma: f64, seed: u64) -> GrayImage {
        let (width, height) = (WIDTH as usize, HEIGHT as usize);
        let mut grey = vec![128.0; width * height];
        for &[x, y, weight, along, across, direction] in &self.0 {
            let (x, y, (sin, cos)) = (x + dx, y + dy, direction.sin_cos());
            let reach = 5.0 * along;
            let span = |centre: f64, end: usize| {
                (centre - reach).max(0.0) as usize..((centre + reach).max(0.0) as usize).min(end)
            };
            for row in span(y, height) {
                for column in span(x, width) {
                    let (u, v) = (column as f64 - x, row as f64 - y);
                    let (a, b) = ((u * cos + v * sin) / along, (v * cos - u * sin) / across);
                    grey[row * width + column] += weight * (-0.5 * (a * a + b * b)).exp();
                }
            }
        }
        let mut random = Xoshiro256PlusPlus::seed_from_u64(seed);
        let noise = Normal::new(0.0, sigma).unwrap();
        let pixels = grey
            .iter()
            .map(|grey| (grey + noise.sample(&mut random)).round().clamp(0.0, 255.0) as u8)
            .collect();
        GrayImage::from_vec(WIDTH, HEIGHT, pixels).unwrap()
    }
}

fn extract(detector: Detector, image: &GrayImage) -> Features {
    let mut extractor = OpencvExtractor::new(detector, &Settings::default()).unwrap();
    let mut features = Features::default();
    extractor.extract(image, &mut features).unwrap();
    features
}

/// Keypoints that belong together.
fn pairs(a: &Features, b: &Features) -> Vec<(Keypoint, Keypoint)> {
    let matches = FlannMatcher::default().matches(a, b, 0.8).unwrap();
    let pairs: Vec<_> = matches
        .iter()
        .map(|found| (a.keypoints[found.query], b.keypoints[found.nearest.index]))
        .collect();
    assert!(pairs.len() > 100, "only {} matches", pairs.len());
    pairs
}

fn median(values: impl IntoIterator<Item = f32>) -> f32 {
    let mut values: Vec<_> = values.into_iter().collect();
    values.sort_by(f32::total_cmp);
    values[values.len() / 2]
}

/// The mean of what lies about the median: mismatches lie far from it.
fn centre(values: impl Iterator<Item = f32> + Clone) -> f32 {
    let median = median(values.clone());
    let near: Vec<_> = values
        .filter(|value| (value - median).abs() < 3.0)
        .collect();
    near.iter().sum::<f32>() / near.len() as f32
}

#[test]
fn each_detector_recovers_a_shift_to_a_fraction_of_a_pixel() {
    let texture = Texture::new(1);
    let shift = [3.3, -2.6];
    let here = texture.image([0.0; 2], 0.0, 0);
    let there = texture.image(shift, 0.0, 0);
    for detector in DETECTORS {
        let pairs = pairs(&extract(detector, &here), &extract(detector, &there));
        let dx_px = centre(pairs.iter().map(|(a, b)| b.x_px - a.x_px));
        let dy_px = centre(pairs.iter().map(|(a, b)| b.y_px - a.y_px));
        // ORB's positions are whole pixels of a level; those of the others are interpolated.
        let tolerance_px = if detector == Detector::Orb {
            0.05
        } else {
            0.01
        };
        for (found, wanted) in [dx_px, dy_px].into_iter().zip(shift) {
            assert!(
                (f64::from(found) - wanted).abs() < tolerance_px,
                "{detector:?}: {found} instead of {wanted} px"
            );
        }
    }
}

/// A bias of the positions is the same in the turned image, and so shows in the sum of the two.
#[test]
fn turning_the_image_by_half_turns_its_features_in_every_octave() {
    let image = Texture::new(2).image([0.0; 2], 0.0, 0);
    let turned = GrayImage::from_vec(
        WIDTH,
        HEIGHT,
        image.pixels().iter().rev().copied().collect(),
    )
    .unwrap();
    for detector in DETECTORS {
        let pairs = pairs(&extract(detector, &image), &extract(detector, &turned));
        for octave in 0..8 {
            let found: Vec<_> = pairs.iter().filter(|(a, _)| a.octave == octave).collect();
            if found.len() < 15 {
                continue;
            }
            let x_px = centre(found.iter().map(|(a, b)| a.x_px + b.x_px)) - (WIDTH - 1) as f32;
            let y_px = centre(found.iter().map(|(a, b)| a.y_px + b.y_px)) - (HEIGHT - 1) as f32;
            let turn_rad = median(
                found
                    .iter()
                    .map(|(a, b)| (b.angle_rad - a.angle_rad).rem_euclid(TAU)),
            );
            let what = format!("{detector:?}, octave {octave}: {x_px} {y_px} px, {turn_rad} rad");
            // Twice the bias; a quarter of a pixel forgotten in SIFT would give 0.5.
            assert!(x_px.abs() < 0.05 && y_px.abs() < 0.05, "{what}");
            assert!((turn_rad - PI).abs() < 0.02, "{what}");
        }
    }
}

#[test]
fn the_stated_sigma_is_that_of_the_positions() {
    let texture = Texture::new(3);
    let here = texture.image([0.0; 2], 2.0, 10);
    for detector in DETECTORS {
        let first = extract(detector, &here);
        let mut in_sigmas = Vec::new();
        for step in 1..6_u8 {
            let shift = [0.37 * f64::from(step), -0.23 * f64::from(step)];
            let there = texture.image(shift, 2.0, 10 + u64::from(step));
            for (a, b) in pairs(&first, &extract(detector, &there)) {
                let sigma_px = a.sigma_px.hypot(b.sigma_px);
                in_sigmas.push((b.x_px - a.x_px - shift[0] as f32).abs() / sigma_px);
                in_sigmas.push((b.y_px - a.y_px - shift[1] as f32).abs() / sigma_px);
            }
        }
        // The median of |N(0, 1)| is 0.6745. Other textures, other noise: a quarter either way.
        let ratio = median(in_sigmas) / 0.6745;
        assert!((0.75..1.25).contains(&ratio), "{detector:?}: {ratio}");
    }
}

#[test]
fn the_same_image_gives_the_same_bits() {
    let image = Texture::new(4).image([0.0; 2], 2.0, 4);
    for detector in DETECTORS {
        let first = extract(detector, &image);
        assert!(first.len() > 100, "{detector:?}: {}", first.len());
        assert_eq!(first.descriptors.len(), first.len() * first.descriptor_len);
        // In other threads, and in an extractor that has just seen another image.
        std::thread::scope(|scope| {
            for _ in 0..2 {
                scope.spawn(|| assert_eq!(extract(detector, &image), first));
            }
        });
        let mut extractor = OpencvExtractor::new(detector, &Settings::default()).unwrap();
        let mut features = Features::default();
        for image in [&GrayImage::filled(100, 80, 7), &image] {
            extractor.extract(image, &mut features).unwrap();
        }
        assert_eq!(features, first);
    }
}

#[test]
fn what_is_without_features_gives_none_and_no_error() {
    let images = [
        GrayImage::default(),
        GrayImage::filled(1, 1, 0),
        GrayImage::filled(7, 5, 200),
        GrayImage::filled(8, 8, 30),
        GrayImage::filled(WIDTH, 1, 90),
        GrayImage::filled(9, HEIGHT, 90),
        GrayImage::filled(WIDTH, HEIGHT, 128),
    ];
    for detector in DETECTORS {
        let mut extractor = OpencvExtractor::new(detector, &Settings::default()).unwrap();
        for image in &images {
            let mut features = extract(detector, &Texture::new(5).image([0.0; 2], 0.0, 0));
            let size = (image.width(), image.height());
            let result = extractor.extract(image, &mut features);
            assert_eq!(result, Ok(()), "{detector:?} {size:?}");
            assert!(features.is_empty(), "{detector:?} {size:?}");
            assert!(features.descriptors.is_empty(), "{detector:?} {size:?}");
        }
    }
}

#[test]
fn the_budget_keeps_the_strongest_features() {
    let image = Texture::new(6).image([0.0; 2], 0.0, 0);
    for detector in DETECTORS {
        let settings = Settings {
            budget: 50,
            ..Settings::default()
        };
        let mut few = Features::default();
        OpencvExtractor::new(detector, &settings)
            .and_then(|mut extractor| extractor.extract(&image, &mut few))
            .unwrap();
        assert_eq!(few.len(), 50, "{detector:?}");
        // ORB shares the budget out among its levels; the others choose from all.
        if detector != Detector::Orb {
            let mut all: Vec<_> = extract(detector, &image)
                .keypoints
                .iter()
                .map(|keypoint| keypoint.response)
                .collect();
            all.sort_by(|a, b| b.total_cmp(a));
            let weakest = few.keypoints.iter().map(|keypoint| keypoint.response);
            assert_eq!(weakest.fold(f32::INFINITY, f32::min), all[49]);
        }
    }
}
