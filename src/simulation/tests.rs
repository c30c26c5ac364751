//! Tests of the whole simulator: geometry, sub-pixel truth, determinism.

use super::*;
use crate::capture::{PairEvent, PairSource};
use crate::geometry::parse_rig;
use std::sync::Arc;

/// A rig with everything that a real one has: distorted, toed in, rolled, of two focal lengths.
fn crooked_rig(lens: &str) -> StereoRig {
    parse_rig(&format!(
        r#"
        [left]
        width = 480
        height = 360
        focal = [420.0, 418.0]
        principal_point = [236.0, 184.0]
        {lens}
        [right]
        width = 480
        height = 360
        focal = [415.0, 416.0]
        principal_point = [244.0, 176.0]
        {lens}
        [right_from_left]
        translation_m = [-0.2, 0.01, 0.005]
        rotation_vector_rad = [0.02, 0.03, -0.04]
        "#
    ))
    .expect("a valid rig")
}

const LENSES: [&str; 3] = [
    "",
    r#"distortion = { model = "radtan", coefficients = [-0.25, 0.10, 0.0005, -0.0003, 0.0] }"#,
    r#"distortion = { model = "equidistant", coefficients = [-0.013, 0.02, -0.012, 0.0025] }"#,
];

fn noiseless(frames: u64) -> Settings {
    Settings {
        frames,
        sensor: sensor::Settings {
            noisy: false,
            ..sensor::Settings::default()
        },
        ..Settings::default()
    }
}

fn value(image: &GrayImage, x: i64, y: i64) -> f64 {
    f64::from(image.row(y as u32)[x as usize])
}

/// Bilinear value at a place inside the image.
fn value_at(image: &GrayImage, p: &Vector2<f64>) -> f64 {
    let (x, y) = (p.x.floor(), p.y.floor());
    let (fx, fy) = (p.x - x, p.y - y);
    let v = |dx: i64, dy: i64| value(image, x as i64 + dx, y as i64 + dy);
    (1.0 - fy) * ((1.0 - fx) * v(0, 0) + fx * v(1, 0)) + fy * ((1.0 - fx) * v(0, 1) + fx * v(1, 1))
}

#[test]
fn what_the_left_camera_shows_is_where_the_rig_projects_it_in_the_right_one() {
    for lens in LENSES {
        let rig = crooked_rig(lens);
        let simulation = Simulation::new(
            SceneName::Hall,
            TrajectoryName::Straight,
            rig.clone(),
            noiseless(3),
        )
        .expect("a free way");
        let (pair, _) = simulation.pair(2);
        let left = Looker::new(&simulation, 2, Side::Left);
        let right = Looker::new(&simulation, 2, Side::Right);
        let (mut left_values, mut right_values) = (Vec::new(), Vec::new());
        for j in 0..40 {
            for i in 0..40 {
                let pixel = Vector2::new(12.0 + 11.0 * f64::from(i), 12.0 + 8.5 * f64::from(j));
                let depth = left.depth_m(&pixel).expect("a hall is closed");
                let point = Point3::from(rig.left.ray(&pixel).expect("inside") * depth);
                let seen = rig.project(&point).expect("in front");
                let there = Vector2::new(seen[2], seen[3]);
                let in_right = rig.right_from_left * point;
                // Not behind something as the right camera sees it, and not near its border.
                let visible = rig.right.contains(&there, 2.0)
                    && right
                        .depth_m(&there)
                        .is_some_and(|d| (d / in_right.z - 1.0).abs() < 1e-3);
                if visible {
                    left_values.push(value_at(&pair.left, &pixel));
                    right_values.push(value_at(&pair.right, &there));
                }
            }
        }
        assert!(left_values.len() > 700, "{lens}: {}", left_values.len());
        let alike = correlation(&left_values, &right_values);
        // A pixel beside the right place correlates far less: see below.
        assert!(alike > 0.95, "{lens}: {alike}");
        let unlike = correlation(&left_values[..700], &right_values[3..703]);
        assert!(unlike < 0.5, "{lens}: {unlike}");
    }
}

fn correlation(a: &[f64], b: &[f64]) -> f64 {
    let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len() as f64;
    let (ma, mb) = (mean(a), mean(b));
    let sum = |f: &dyn Fn(f64, f64) -> f64| a.iter().zip(b).map(|(&x, &y)| f(x, y)).sum::<f64>();
    sum(&|x, y| (x - ma) * (y - mb))
        / (sum(&|x, _| (x - ma).powi(2)) * sum(&|_, y| (y - mb).powi(2))).sqrt()
}

/// An image smoothed as the first scales of a feature detector are (binomial, σ = 1 px), unrounded.
/// It has the same shift as its original, and cubic interpolation reads it without error of its own.
struct Smooth {
    width: usize,
    values: Vec<f64>,
}

impl Smooth {
    fn new(image: &GrayImage) -> Self {
        let (width, height) = (image.width() as i64, image.height() as i64);
        let kernel = [1.0, 4.0, 6.0, 4.0, 1.0].map(|k| k / 16.0);
        let mut values = Vec::new();
        for y in 0..height {
            for x in 0..width {
                let mut sum = 0.0;
                for (j, v) in (-2..=2).zip(kernel) {
                    for (i, u) in (-2..=2).zip(kernel) {
                        let (x, y) = ((x + i).clamp(0, width - 1), (y + j).clamp(0, height - 1));
                        sum += u * v * f64::from(image.row(y as u32)[x as usize]);
                    }
                }
                values.push(sum);
            }
        }
        Self {
            width: width as usize,
            values,
        }
    }

    fn get(&self, x: i64, y: i64) -> f64 {
        self.values[y as usize * self.width + x as usize]
    }
}

/// The shift of `b` against `a` within a window, px: least squares on the mean of both gradients,
/// with `b` read at its shifted place until nothing changes.
fn measured_shift(a: &Smooth, b: &Smooth, x0: i64, y0: i64, size: i64) -> Vector2<f64> {
    use nalgebra::Matrix2;
    let mut shift = Vector2::zeros();
    for _ in 0..20 {
        let (mut normal, mut right) = (Matrix2::zeros(), Vector2::zeros());
        for y in y0..y0 + size {
            for x in x0..x0 + size {
                let at =
                    |dx: f64, dy: f64| cubic(b, x as f64 + shift.x + dx, y as f64 + shift.y + dy);
                let here = at(0.0, 0.0);
                let slope_a = Vector2::new(
                    a.get(x + 1, y) - a.get(x - 1, y),
                    a.get(x, y + 1) - a.get(x, y - 1),
                ) * 0.5;
                let slope_b =
                    Vector2::new(at(1.0, 0.0) - at(-1.0, 0.0), at(0.0, 1.0) - at(0.0, -1.0)) * 0.5;
                let slope = (slope_a + slope_b) * 0.5;
                normal += slope * slope.transpose();
                right += slope * (a.get(x, y) - here);
            }
        }
        let step = normal.try_inverse().expect("texture") * right;
        shift += step;
        if step.norm() < 1e-6 {
            break;
        }
    }
    shift
}

/// Catmull–Rom interpolation.
fn cubic(image: &Smooth, x: f64, y: f64) -> f64 {
    let weights = |f: f64| {
        [
            ((2.0 - f) * f - 1.0) * f * 0.5,
            ((3.0 * f - 5.0) * f * f + 2.0) * 0.5,
            ((4.0 - 3.0 * f) * f + 1.0) * f * 0.5,
            (f - 1.0) * f * f * 0.5,
        ]
    };
    let (xi, yi) = (x.floor(), y.floor());
    let (wx, wy) = (weights(x - xi), weights(y - yi));
    let mut sum = 0.0;
    for (j, v) in wy.iter().enumerate() {
        for (i, u) in wx.iter().enumerate() {
            sum += u * v * image.get(xi as i64 + i as i64 - 1, yi as i64 + j as i64 - 1);
        }
    }
    sum
}

#[test]
fn a_sub_pixel_shift_of_the_camera_is_the_same_shift_of_the_image() {
    // A wall alone, seen squarely from several distances: magnified and minified texture. All
    // truth comes from the pinhole: shift = focal · way / distance.
    use scene::{Builder, Inside};
    let plain = scenes::plain_mosaic();
    let camera = thesis_rig().left;
    let focal = camera.focal_px;
    let small = Camera::new(240, 200, focal, Vector2::new(119.5, 99.5), Distortion::None);
    let renderer = Renderer::new(RayMap::new(&small));
    let settings = noiseless(1).sensor;
    let mut worst = 0.0_f64;
    for distance in [1.7, 3.1, 6.3, 9.0, 17.0, 35.0] {
        let inside = Inside {
            floor: plain.clone(),
            walls: plain.clone(),
            ceiling: None,
            sky: 0.0,
        };
        let high = [30.0, 30.0, distance];
        let scene = Builder::new(3, [-30.0, -30.0, -1.0], high, &inside).build();
        let image = |shift: &Vector2<f64>| {
            let way = Vector3::new(-shift.x / focal.x, -shift.y / focal.y, 0.0) * distance;
            let place = Isometry3::translation(way.x, way.y, way.z);
            let view = View::new(&scene, &place, &place, 0.0);
            let key = ImageKey {
                seed: 0,
                frame: 0,
                side: Side::Left,
            };
            Smooth::new(&renderer.render(&scene, &[view], &settings, key))
        };
        let still = image(&Vector2::zeros());
        for shift in [[0.25, 0.1], [0.5, -0.5], [0.37, 0.81], [-0.73, 0.29]] {
            let shift = Vector2::from(shift);
            let moved = image(&shift);
            for (x, y) in [(20, 20), (100, 60), (160, 120)] {
                let measured = measured_shift(&still, &moved, x, y, 48);
                let gap = (measured - shift).norm();
                println!("{distance} m, {shift:?}: {:.4?}", measured - shift);
                assert!(gap < 0.02, "{distance} m, {shift}: measured {measured}");
                worst = worst.max(gap);
            }
        }
    }
    assert!(worst > 0.0, "nothing was compared");
}

#[test]
fn the_number_of_threads_does_not_change_a_bit() {
    let render = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .expect("threads");
        pool.install(|| {
            let settings = Settings {
                exposure_ms: 20.0,
                frames: 4,
                ..Settings::default()
            };
            let simulation = Simulation::new(
                SceneName::Mover,
                TrajectoryName::Slalom,
                small_rig(),
                settings,
            )
            .expect("a free way");
            let (pair, pose) = simulation.pair(3);
            (pair.left, pair.right, pose)
        })
    };
    assert!(render(1) == render(4));
}

#[test]
fn seeds_frames_and_sides_give_different_images() {
    let render = |seed: u64, frame: u64| {
        let settings = Settings {
            seed,
            frames: 2,
            ..Settings::default()
        };
        Simulation::new(
            SceneName::Room,
            TrajectoryName::Standstill,
            small_rig(),
            settings,
        )
        .expect("a free way")
        .pair(frame)
        .0
    };
    let (a, b, c) = (render(1, 0), render(2, 0), render(1, 1));
    assert_ne!(a.left, a.right);
    assert_ne!(a.left, b.left);
    // A standing camera sees the same but for the noise.
    assert_ne!(a.left, c.left);
    let gap: f64 = a
        .left
        .pixels()
        .iter()
        .zip(c.left.pixels())
        .map(|(&p, &q)| (f64::from(p) - f64::from(q)).abs())
        .sum::<f64>()
        / a.left.pixels().len() as f64;
    assert!(gap < 4.0, "{gap}");
}

#[test]
fn every_scene_renders_with_contrast_that_suits_it() {
    for name in SceneName::ALL {
        let simulation =
            Simulation::new(name, TrajectoryName::Standstill, small_rig(), noiseless(1))
                .expect("a free place");
        let image = simulation.image(0, Side::Left);
        let values: Vec<f64> = image.pixels().iter().map(|&v| f64::from(v)).collect();
        let n = values.len() as f64;
        let mean = values.iter().sum::<f64>() / n;
        let sigma = (values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n).sqrt();
        assert!((50.0..200.0).contains(&mean), "{name}: {mean}");
        let saturated = values.iter().filter(|&&v| v <= 0.0 || v >= 255.0).count();
        assert!((saturated as f64) < 0.02 * n, "{name}: {saturated}");
        assert!(sigma > 10.0, "{name}: {sigma}");
        // Edges: pixels that differ from their neighbour by a tenth of the range.
        let edges = image
            .pixels()
            .windows(2)
            .filter(|p| p[0].abs_diff(p[1]) > 12)
            .count() as f64
            / n;
        if name == SceneName::Lowtexture {
            assert!(edges < 0.1, "{name}: {edges}");
        } else {
            assert!(edges > 0.1, "{name}: {edges}");
        }
    }
}

#[test]
fn movers_fill_about_a_third_of_the_image_and_move() {
    let simulation = Simulation::new(
        SceneName::Mover,
        TrajectoryName::Straight,
        thesis_rig(),
        noiseless(60),
    )
    .expect("a free way");
    for frame in [0, 25, 59] {
        let (mut moving, mut all) = (0.0, 0.0);
        let looker = Looker::new(&simulation, frame, Side::Left);
        for j in 0..24 {
            for i in 0..32 {
                let pixel = Vector2::new(20.0 + 40.0 * f64::from(i), 20.0 + 40.0 * f64::from(j));
                all += 1.0;
                if looker.is_moving(&pixel) {
                    moving += 1.0;
                }
            }
        }
        let share = moving / all;
        assert!((0.25..0.45).contains(&share), "frame {frame}: {share}");
    }
}

#[test]
fn black_frames_are_black_in_both_cameras_and_only_they() {
    let settings = Settings {
        blackout: Some([1, 3]),
        ..noiseless(4)
    };
    let simulation = Simulation::new(
        SceneName::Room,
        TrajectoryName::LoopRoom,
        small_rig(),
        settings,
    )
    .expect("a free way");
    for frame in 0..4 {
        let (pair, _) = simulation.pair(frame);
        for image in [pair.left, pair.right] {
            let black = image.pixels().iter().all(|&v| v == 0);
            assert_eq!(black, (1..3).contains(&frame), "frame {frame}");
        }
    }
}

#[test]
fn an_open_shutter_blurs_along_the_motion() {
    let image = |exposure_ms: f64| {
        let settings = Settings {
            exposure_ms,
            rate_hz: 5.0,
            ..noiseless(2)
        };
        Simulation::new(
            SceneName::Room,
            TrajectoryName::FastTurn,
            small_rig(),
            settings,
        )
        .expect("a free place")
        .image(1, Side::Left)
    };
    let roughness = |image: &GrayImage, dx: i64, dy: i64| {
        let mut sum = 0.0;
        for y in 0..239 {
            for x in 0..319 {
                sum += (value(image, x + dx, y + dy) - value(image, x, y)).abs();
            }
        }
        sum
    };
    let (sharp, blurred) = (image(0.0), image(40.0));
    // 7° per 200 ms are 7.3 px per 40 ms, sideways.
    let across = roughness(&blurred, 1, 0) / roughness(&sharp, 1, 0);
    let down = roughness(&blurred, 0, 1) / roughness(&sharp, 0, 1);
    assert!(across < 0.35, "{across}");
    assert!(down > 1.5 * across, "{down} {across}");
}

#[test]
fn poses_begin_with_the_identity_and_a_fast_turn_turns_seven_degrees() {
    for trajectory in TrajectoryName::ALL {
        let simulation = Simulation::new(SceneName::Hall, trajectory, small_rig(), noiseless(30))
            .expect("the hall has room for every trajectory");
        assert_eq!(simulation.odom_from_camera(0), Isometry3::identity());
        let motion = simulation.odom_from_camera(10).inverse() * simulation.odom_from_camera(11);
        if trajectory == TrajectoryName::FastTurn {
            assert!((motion.rotation.angle().to_degrees() - 7.0).abs() < 1e-9);
        }
    }
}

#[test]
fn a_way_through_a_wall_is_refused_with_the_frame() {
    let error = Simulation::new(
        SceneName::Room,
        TrajectoryName::Straight,
        small_rig(),
        noiseless(1000),
    )
    .err()
    .expect("the room ends");
    let text = error.to_string();
    assert!(matches!(error, SimulationError::Collision { frame, .. } if frame > 10));
    assert!(text.contains("straight") && text.contains("room"), "{text}");
}

#[test]
fn the_source_hands_out_every_pair_in_order() {
    let simulation = Simulation::new(
        SceneName::Corridor,
        TrajectoryName::StopAndGo,
        small_rig(),
        noiseless(3),
    )
    .expect("a free way");
    let mut source = SimulatedSource::new(Arc::new(simulation));
    assert_eq!(source.len_hint(), Some(3));
    for expected in 0..3_u64 {
        let Some(PairEvent::Pair(pair)) = source.next_event() else {
            panic!("a simulation has no unusable pairs");
        };
        assert_eq!(pair.sequence, expected);
        assert_eq!(pair.timestamp_ns, 100_000_000 * expected as i64);
        assert_eq!(pair.left, source.simulation().pair(expected).0.left);
    }
    assert!(source.next_event().is_none());
    assert_eq!(source.truth(0), Isometry3::identity());
}
