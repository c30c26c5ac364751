//! How long SURF takes on a synthetic image: `cargo bench --bench features`.
//!
//! One thread, 1280 × 960 px, for several budgets; best and median processor time of many runs. With a number
//! after `--` only the case of that number, counted from 0, as a profiler likes it.

mod common;

use common::{Times, head, line};
use std::hint::black_box;
use visod::features::surf::{Settings, Surf};
use visod::features::{Extractor, Features};
use visod::image::GrayImage;

use rand::{RngExt, SeedableRng};
use rand_xoshiro::Xoshiro256PlusPlus;

const WIDTH: u32 = 1280;
const HEIGHT: u32 = 960;
const RUNS: usize = 100;

fn main() {
    let image = scene();
    head("Features: SURF, 1280 × 960 px, one thread");
    let cases = [
        (1e6, 0, false),
        (100.0, 1000, false),
        (100.0, 4000, false),
        (400.0, 1000, false),
        (400.0, 0, false),
        (100.0, 1000, true),
    ];
    let chosen: Option<usize> = common::words().first().and_then(|word| word.parse().ok());
    for (number, (hessian, budget, extended)) in cases.into_iter().enumerate() {
        if chosen.is_some_and(|chosen| chosen != number) {
            continue;
        }
        let settings = Settings {
            hessian,
            budget,
            extended,
            ..Settings::default()
        };
        let floats = if extended { 128 } else { 64 };
        let (times, keypoints) = time(settings, &image);
        let name = format!("{keypoints} keypoints, {floats} floats, threshold {hessian}");
        line(&name, &times, "");
    }
}

/// The times, and the number of keypoints found.
fn time(settings: Settings, image: &GrayImage) -> (Times, usize) {
    let mut features = Features::default();
    let mut surf = match Surf::new(settings) {
        Ok(surf) => surf,
        Err(e) => unreachable!("{}: {}", e.key, e.cause),
    };
    let times = Times::of(RUNS, || {
        let result = surf.extract(black_box(image), &mut features);
        assert_eq!(result, Ok(()));
    });
    (times, features.len())
}

/// Five thousand discs and rectangles of all sizes and greys on one another, softened, with noise.
fn scene() -> GrayImage {
    let mut rng = Xoshiro256PlusPlus::seed_from_u64(1);
    let mut grey = vec![128.0_f32; (WIDTH * HEIGHT) as usize];
    for _ in 0..5000 {
        let radius = 3.0 * 15_f32.powf(rng.random::<f32>());
        let (x0, y0) = (
            WIDTH as f32 * rng.random::<f32>(),
            HEIGHT as f32 * rng.random::<f32>(),
        );
        let value = 20.0 + 215.0 * rng.random::<f32>();
        let round: bool = rng.random();
        let range = |c: f32, end: u32| (c - radius).max(0.0) as u32..((c + radius) as u32).min(end);
        for y in range(y0, HEIGHT) {
            for x in range(x0, WIDTH) {
                if !round || (x as f32 - x0).hypot(y as f32 - y0) < radius {
                    grey[(y * WIDTH + x) as usize] = value;
                }
            }
        }
    }
    let width = WIDTH as usize;
    for _ in 0..2 {
        let sharp = grey.clone();
        for n in width + 1..grey.len() - width - 1 {
            grey[n] = 0.25 * sharp[n]
                + 0.125 * (sharp[n - 1] + sharp[n + 1] + sharp[n - width] + sharp[n + width])
                + 0.0625
                    * (sharp[n - width - 1]
                        + sharp[n - width + 1]
                        + sharp[n + width - 1]
                        + sharp[n + width + 1]);
        }
    }
    let pixels = grey
        .iter()
        .map(|g| (g + 4.0 * rng.random::<f32>() - 2.0).clamp(0.0, 255.0) as u8);
    match GrayImage::from_vec(WIDTH, HEIGHT, pixels.collect()) {
        Some(image) => image,
        None => unreachable!("as many pixels as the size says"),
    }
}
