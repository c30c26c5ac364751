//! visod's SURF beside OpenCV's SIFT, ORB and AKAZE, and its `remap`, of a textured image of
//! 1280 × 960 pixels, in one thread and one run.
//!
//! `. tools/env && cargo bench --features opencv --bench opencv` prints a table; a number of runs may
//! follow, ` -- 40`. The last column is how many times as long as visod's SURF.

mod common;

use common::{Times, head, line, ratio};
use opencv::core::{BORDER_CONSTANT, Mat, Scalar};
use opencv::imgproc::{INTER_LINEAR, remap};
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

fn main() -> Outcome<()> {
    let runs = common::words()
        .first()
        .map_or(Ok(RUNS), |word| word.parse())?;
    let image = texture();
    let mut surf = Surf::new(surf::Settings::default()).map_err(|e| e.key)?;
    let mut features = Features::default();
    let ours = Times::of(runs, || {
        assert_eq!(surf.extract(&image, &mut features), Ok(()));
    });
    head(&format!(
        "Beside OpenCV: {WIDTH} × {HEIGHT} px, one thread, {runs} runs"
    ));
    let name = format!("visod's SURF, {} features", features.len());
    line(&name, &ours, "1 ×");
    for detector in [Detector::Sift, Detector::Orb, Detector::Akaze] {
        let mut extractor = OpencvExtractor::new(detector, &Settings::default())?;
        let times = Times::of(runs, || {
            assert_eq!(extractor.extract(&image, &mut features), Ok(()));
        });
        let name = format!(
            "OpenCV's {}, {} features",
            detector.as_str(),
            features.len()
        );
        line(&name, &times, &ratio(&times, &ours));
    }
    let remap = time_remap(runs, &image)?;
    line(
        "OpenCV's remap, bilinear, one image",
        &remap,
        &ratio(&remap, &ours),
    );
    Ok(())
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
