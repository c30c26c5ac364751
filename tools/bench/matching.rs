//! How long matching takes between two synthetic stereo pairs: `cargo bench --bench matching`.
//!
//! One thread, 1280 × 960 px, for several numbers of features: left–right, then over time near a
//! prediction and over time far around; best and median of many runs. With OpenCV, FLANN as well.
//! Then patches: making them, and aligning them with an image of the same. The checksums tell whether two
//! versions found the same.

mod common;

use common::Times;
use nalgebra::{Isometry3, Matrix2, Point3, Vector2, Vector3, Vector4};
use rand::{RngExt, SeedableRng};
use rand_xoshiro::Xoshiro256PlusPlus;
use visod::features::{Features, Keypoint};
use visod::geometry::{Rectification, StereoRig};
use visod::image::GrayImage;
use visod::matching::{MatchedPair, MatcherName, Settings, StereoMatcher, TemporalMatcher};
use visod::refinement::{Pyramid, Surface, Template, Warp};
use visod::simulation::thesis_rig;

const WIDTH: f32 = 1280.0;
const HEIGHT: f32 = 960.0;
const RUNS: usize = 200;
const DESCRIPTOR_LEN: usize = 64;

fn main() {
    println!("\n### Matching: two pairs of {WIDTH} × {HEIGHT} px, one thread, best (median) ms\n");
    println!(
        "| matcher | features | left–right | over time | far around | matches | tracks | checksum |"
    );
    println!("|---|---:|---:|---:|---:|---:|---:|---|");
    for count in [1000, 2000, 4000] {
        measure("guided", Settings::default(), count, RUNS);
    }
    if cfg!(feature = "opencv") {
        let flann = Settings {
            matcher: MatcherName::Flann,
            ..Settings::default()
        };
        measure("flann", flann, 1000, RUNS / 10);
    }
    measure_patches();
}

/// 1,000 patches of an image, and each found in it again from half a pixel beside.
fn measure_patches() {
    let mut rng = Xoshiro256PlusPlus::seed_from_u64(2);
    let (width, height) = (WIDTH as u32, HEIGHT as u32);
    let noise = (0..width * height).map(|_| rng.random()).collect();
    let image = GrayImage::from_vec(width, height, noise).unwrap_or_default();
    let mut pyramid = Pyramid::default();
    pyramid.fill(&image);
    let level = pyramid.level(1);
    let warp = Warp {
        linear: Matrix2::new(0.98, 0.03, -0.02, 1.02),
        depth: Vector2::new(0.001, -0.002),
    };
    let surface = Surface {
        lever: Vector2::new(9.0, 0.5),
        spread: Matrix2::identity(),
        gap: Vector2::zeros(),
        information: Matrix2::identity() * 1e5,
    };
    let mut place = |length: u32| rng.random_range(20.0..length as f32 - 20.0);
    let centres: Vec<Vector2<f32>> = (0..1000)
        .map(|_| Vector2::new(place(level.width()), place(level.height())))
        .collect();
    let mut templates = Vec::with_capacity(centres.len());
    let making =
        time(RUNS, || {
            templates.clear();
            templates.extend(centres.iter().filter_map(|centre| {
                Some((*centre, Template::new(level, centre, &warp, &surface)?))
            }));
        });
    let mut found = Vec::with_capacity(templates.len());
    let aligning = time(RUNS, || {
        found.clear();
        found.extend(templates.iter().filter_map(|(centre, template)| {
            template.align(level, &(centre + Vector2::new(0.4, -0.3)), 4.0)
        }));
    });
    let mut checksum = Checksum::new();
    for aligned in &found {
        checksum.add(aligned.at.x.to_bits(), aligned.at.y.to_bits());
        checksum.add(
            (aligned.cov[(0, 0)] as f32).to_bits(),
            (aligned.gap.x as f32).to_bits(),
        );
    }
    println!(
        "\n### Patches: {} of an image, one thread, best (median) ms\n",
        centres.len()
    );
    println!("| made | aligned | made | found | checksum |");
    println!("|---:|---:|---:|---:|---|");
    println!(
        "| {:.2} ({:.2}) | {:.2} ({:.2}) | {} | {} | {:016x} |",
        making.0,
        making.1,
        aligning.0,
        aligning.1,
        templates.len(),
        found.len(),
        checksum.0
    );
}

/// Two stereo pairs and where the earlier one's points should be seen in the later one.
struct Scene {
    rig: StereoRig,
    before: [Features; 2],
    now: [Features; 2],
    /// By the earlier pair's left features.
    predicted: Vec<Option<Vector4<f64>>>,
}

fn measure(name: &str, settings: Settings, count: usize, runs: usize) {
    let Scene {
        rig,
        before,
        now,
        predicted,
    } = scene(count);
    let Some(rectification) = Rectification::new(&rig) else {
        unreachable!("the cameras stand side by side")
    };
    let wide_px = settings.wide_search * f64::from(rig.left.width);
    let near_px = settings.search_radius_px;
    let mut stereo = StereoMatcher::new(settings.clone(), rectification);
    let mut temporal = TemporalMatcher::new(settings);
    let (mut matches_before, mut matches) = (Vec::new(), Vec::new());
    let found = stereo.find(&before[0], &before[1], &mut matches_before);
    assert_eq!(found, Ok(()));
    let predicted: Vec<_> = matches_before
        .iter()
        .map(|m| predicted[m.left as usize])
        .collect();
    let left_right = time(runs, || {
        assert_eq!(stereo.find(&now[0], &now[1], &mut matches), Ok(()));
    });
    let mut checksum = Checksum::new();
    for m in matches_before.iter().chain(&matches) {
        checksum.add(m.left, m.right);
    }
    let mut tracks = Vec::new();
    let mut over_time = [(0.0, 0.0); 2];
    let mut track_count = 0;
    for (timed, radius_px) in over_time.iter_mut().zip([near_px, wide_px]) {
        *timed = time(runs, || {
            let found = temporal.find(
                MatchedPair {
                    left: &before[0],
                    right: &before[1],
                    matches: &matches_before,
                },
                MatchedPair {
                    left: &now[0],
                    right: &now[1],
                    matches: &matches,
                },
                &predicted,
                radius_px,
                &mut tracks,
            );
            assert_eq!(found, Ok(()));
        });
        track_count = tracks.len();
        for t in &tracks {
            checksum.add(t.before, t.now);
        }
    }
    let ms = |(best, median): (f64, f64)| format!("{best:.3} ({median:.3})");
    println!(
        "| {name} | {count} | {} | {} | {} | {} | {track_count} | {:016x} |",
        ms(left_right),
        ms(over_time[0]),
        ms(over_time[1]),
        matches.len(),
        checksum.0,
    );
}

/// Best and median time.
fn time(runs: usize, run: impl FnMut()) -> (f64, f64) {
    let times = Times::of(runs, run);
    (times.best_ms(), times.median_ms())
}

/// FNV-1a over pairs of numbers.
struct Checksum(u64);

impl Checksum {
    fn new() -> Self {
        Self(0xcbf2_9ce4_8422_2325)
    }

    fn add(&mut self, a: u32, b: u32) {
        for byte in a.to_le_bytes().into_iter().chain(b.to_le_bytes()) {
            self.0 = (self.0 ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3);
        }
    }
}

/// Points that all four images show, with noise, and one feature in four that only one image shows.
fn scene(count: usize) -> Scene {
    let rig = thesis_rig();
    let mut random = Xoshiro256PlusPlus::seed_from_u64(count as u64);
    let now_from_before = Isometry3::new(
        Vector3::new(0.01, 0.0, -0.05),
        Vector3::new(0.002, 0.005, 0.001),
    );
    let mut images: [Features; 4] = Default::default();
    for image in &mut images {
        image.descriptor_len = DESCRIPTOR_LEN;
    }
    let mut predicted = Vec::new();
    let right = |p: &Vector4<f64>| p.fixed_rows::<2>(2).into_owned();
    while predicted.len() < count {
        if predicted.len() % 4 == 3 {
            for image in &mut images {
                let at = [
                    WIDTH * random.random::<f32>(),
                    HEIGHT * random.random::<f32>(),
                ];
                let descriptor = unit(&mut random, None);
                push(image, &mut random, at, 2.0, 1, descriptor);
            }
            predicted.push(None);
            continue;
        }
        let z = 3.0 * 15_f64.powf(random.random());
        let [x, y] = [0.36, 0.27].map(|half: f64| half * random.random_range(-1.0..1.0));
        let point = Point3::new(x * z, y * z, z);
        let (Some(then), Some(next)) =
            (rig.project(&point), rig.project(&(now_from_before * point)))
        else {
            continue;
        };
        let seen: Vec<[f32; 2]> = [then.xy(), right(&then), next.xy(), right(&next)]
            .map(|p| [p.x as f32, p.y as f32])
            .to_vec();
        let inside = |p: &[f32; 2]| (0.0..WIDTH).contains(&p[0]) && (0.0..HEIGHT).contains(&p[1]);
        if !seen.iter().all(inside) {
            continue;
        }
        let own = unit(&mut random, None);
        let scale = 1.5 * 8_f32.powf(random.random::<f32>().powi(3));
        let laplacian = if random.random() { 1 } else { -1 };
        for (image, at) in images.iter_mut().zip(seen) {
            let descriptor = unit(&mut random, Some(&own));
            push(image, &mut random, at, scale, laplacian, descriptor);
        }
        predicted.push(Some(next));
    }
    let [left_before, right_before, left, right] = images;
    Scene {
        rig,
        before: [left_before, right_before],
        now: [left, right],
        predicted,
    }
}

/// Adds a feature of a scale, px, near a place.
fn push(
    image: &mut Features,
    random: &mut Xoshiro256PlusPlus,
    at: [f32; 2],
    scale: f32,
    laplacian: i8,
    descriptor: Vec<f32>,
) {
    let sigma_px = 0.2 * scale;
    let [x_px, y_px] = at.map(|v| v + sigma_px * random.random_range(-1.5..1.5));
    image.keypoints.push(Keypoint {
        x_px,
        y_px,
        size_px: 7.5 * scale,
        laplacian,
        sigma_px,
        ..Keypoint::default()
    });
    image.descriptors.extend(descriptor);
}

/// A random descriptor, or one near another.
fn unit(random: &mut Xoshiro256PlusPlus, near: Option<&[f32]>) -> Vec<f32> {
    let values: Vec<f32> = (0..DESCRIPTOR_LEN)
        .map(|i| match near {
            Some(near) => near[i] + random.random_range(-0.05..0.05),
            None => random.random_range(-1.0..1.0),
        })
        .collect();
    let norm = values.iter().map(|x| x * x).sum::<f32>().sqrt();
    values.into_iter().map(|x| x / norm).collect()
}
