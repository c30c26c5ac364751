//! visod's SURF beside OpenCV's SIFT, ORB and AKAZE, its `remap` and its brute-force matcher: a textured
//! image of 1280 × 960 pixels, in one thread and one run.
//!
//! `. tools/env && cargo bench --features opencv --bench opencv` prints tables; a number of runs may
//! follow, ` -- 40`. OpenCV as packaged has no SURF. What it would take is derived from each yardstick of
//! this run: on a machine with OpenCV's SURF one run gave the times of [`YARDSTICKS`] and [`SURF`].

mod common;

use common::{Times, head, line};
use opencv::core::{BORDER_CONSTANT, DMatch, Mat, NORM_L2, Scalar, Vector};
use opencv::features2d::BFMatcher;
use opencv::imgproc::{INTER_LINEAR, remap};
use opencv::prelude::DescriptorMatcherTraitConst;
use rand::{RngExt, SeedableRng};
use rand_xoshiro::Xoshiro256PlusPlus;
use visod::features::opencv::{Detector, OpencvExtractor, Settings};
use visod::features::surf::{self, Surf};
use visod::features::{Extractor, Features};
use visod::image::GrayImage;

const WIDTH: usize = 1280;
const HEIGHT: usize = 960;
const RUNS: usize = 20;

type Outcome<T> = Result<T, Box<dyn std::error::Error>>;

/// OpenCV's SURF on an image of this size where the yardsticks took what [`YARDSTICKS`] says: keypoints,
/// and median, least and most ms.
const SURF: [(usize, [f64; 3]); 2] = [(1000, [281.0, 183.0, 342.0]), (4000, [564.0, 411.0, 717.0])];
/// The yardsticks, ms.
const YARDSTICKS: [(&str, f64); 4] = [
    ("SIFT, 2,000 features", 220.0),
    ("ORB", 13.0),
    ("remap", 3.3),
    ("brute force, 2,000 × 2,000 × 64", 26.0),
];

fn main() -> Outcome<()> {
    let runs = common::words()
        .first()
        .map_or(Ok(RUNS), |word| word.parse())?;
    let image = texture();
    head(&format!(
        "Beside OpenCV: {WIDTH} × {HEIGHT} px, one thread, {runs} runs"
    ));
    let mut ours = Vec::new();
    for (budget, _) in SURF {
        let mut surf = Surf::new(surf::Settings {
            budget,
            ..surf::Settings::default()
        })
        .map_err(|e| e.key)?;
        let times = time_extractor(runs, &mut surf, &image, "visod's SURF")?;
        ours.push(times);
    }
    let opencv = |detector: Detector| {
        let mut extractor = OpencvExtractor::new(detector, &Settings::default())?;
        let name = format!("OpenCV's {}", detector.as_str());
        time_extractor(runs, &mut extractor, &image, &name)
    };
    let (sift, orb, _) = (
        opencv(Detector::Sift)?,
        opencv(Detector::Orb)?,
        opencv(Detector::Akaze)?,
    );
    let remap = time_remap(runs, &image)?;
    line("OpenCV's remap, bilinear, one image", &remap, "");
    let brute_force = time_brute_force(runs)?;
    line("OpenCV's brute force, 2,000 × 2,000 × 64", &brute_force, "");
    derive_surf(
        &ours,
        [sift, orb, remap, brute_force].map(|t| t.median_ms()),
    );
    Ok(())
}

fn time_extractor(
    runs: usize,
    extractor: &mut dyn Extractor,
    image: &GrayImage,
    name: &str,
) -> Outcome<Times> {
    let mut features = Features::default();
    extractor.extract(image, &mut features)?;
    let times = Times::of(runs, || {
        assert_eq!(extractor.extract(image, &mut features), Ok(()));
    });
    line(&format!("{name}, {} features", features.len()), &times, "");
    Ok(times)
}

/// What OpenCV's SURF would take, by each yardstick, and how many times as long that is as ours.
fn derive_surf(ours: &[Times], now_ms: [f64; 4]) {
    println!(
        "\n### OpenCV's SURF, derived: its time on another machine × the yardstick's here / there\n"
    );
    println!(
        "| yardstick | there ms | here ms | SURF, 1,000 keypoints, ms | × ours | 4,000, ms | × ours |"
    );
    println!("|---|---:|---:|---:|---:|---:|---:|");
    for ((name, there_ms), here_ms) in YARDSTICKS.into_iter().zip(now_ms) {
        let factor = here_ms / there_ms;
        print!("| {name} | {there_ms:.1} | {here_ms:.1} |");
        for ((_, times_ms), ours) in SURF.into_iter().zip(ours) {
            let [median, least, most] = times_ms.map(|ms| ms * factor);
            let ratio = |ms: f64| ms / ours.median_ms();
            print!(
                " {median:.0} ({least:.0}–{most:.0}) | {:.1} ({:.1}–{:.1}) |",
                ratio(median),
                ratio(least),
                ratio(most)
            );
        }
        println!();
    }
}

/// The nearest of 2,000 descriptors of 64 floats for each of 2,000.
fn time_brute_force(runs: usize) -> Outcome<Times> {
    let mut random = Xoshiro256PlusPlus::seed_from_u64(2);
    let mut floats = || -> Vec<f32> { (0..2000 * 64).map(|_| random.random()).collect() };
    let (query, train) = (floats(), floats());
    let query = Mat::new_rows_cols_with_data(2000, 64, &query)?;
    let train = Mat::new_rows_cols_with_data(2000, 64, &train)?;
    let matcher = BFMatcher::new(NORM_L2, false)?;
    let mut matches = Vector::<DMatch>::new();
    Ok(Times::of(runs, || {
        let result = matcher.train_match_def(&query, &train, &mut matches);
        assert!(result.is_ok());
    }))
}

/// With float maps that bend the image as a lens does.
fn time_remap(runs: usize, image: &GrayImage) -> Outcome<Times> {
    let (rows, cols) = (i32::try_from(HEIGHT)?, i32::try_from(WIDTH)?);
    let (mut xs, mut ys) = (Vec::new(), Vec::new());
    for row in 0..HEIGHT {
        for column in 0..WIDTH {
            let x = (column as f32 - 640.0) / 1000.0;
            let y = (row as f32 - 480.0) / 1000.0;
            let radial = 1.0 - 0.2 * (x * x + y * y);
            xs.push(640.0 + 1000.0 * x * radial);
            ys.push(480.0 + 1000.0 * y * radial);
        }
    }
    let source = Mat::new_rows_cols_with_data(rows, cols, image.pixels())?;
    let xs = Mat::new_rows_cols_with_data(rows, cols, &xs)?;
    let ys = Mat::new_rows_cols_with_data(rows, cols, &ys)?;
    let mut straight = Mat::default();
    Ok(Times::of(runs, || {
        let result = remap(
            &source,
            &mut straight,
            &xs,
            &ys,
            INTER_LINEAR,
            BORDER_CONSTANT,
            Scalar::default(),
        );
        assert!(result.is_ok());
    }))
}

/// Value noise of five octaves, from 64 pixels down to 4: detail at every scale, as in a photograph.
fn texture() -> GrayImage {
    let mut random = Xoshiro256PlusPlus::seed_from_u64(1);
    let mut grey = vec![0.0_f32; WIDTH * HEIGHT];
    for cell in [64, 32, 16, 8, 4] {
        let columns = WIDTH / cell + 2;
        let corners: Vec<f32> = (0..columns * (HEIGHT / cell + 2))
            .map(|_| random.random_range(-30.0..30.0))
            .collect();
        for (index, grey) in grey.iter_mut().enumerate() {
            let (row, column) = (index / WIDTH, index % WIDTH);
            let corner = row / cell * columns + column / cell;
            let u = (column % cell) as f32 / cell as f32;
            let v = (row % cell) as f32 / cell as f32;
            let above = corners[corner] * (1.0 - u) + corners[corner + 1] * u;
            let below = corners[corner + columns] * (1.0 - u) + corners[corner + columns + 1] * u;
            *grey += above * (1.0 - v) + below * v;
        }
    }
    let mut image = GrayImage::filled(WIDTH as u32, HEIGHT as u32, 0);
    for (pixel, grey) in image.pixels_mut().iter_mut().zip(grey) {
        // Saturates at black and white.
        *pixel = (128.0 + grey).round() as u8;
    }
    image
}
