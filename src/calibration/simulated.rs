//! Boards before a rig that is known, as points with noise or as images: what calibrations are tested with.

use super::{Board, Pattern, SeenPoints, View};
use crate::geometry::{Camera, StereoRig};
use crate::image::GrayImage;
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector2, Vector3};
use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, Normal};
use rand_xoshiro::Xoshiro256PlusPlus;

/// How much of the image's width a board takes at its nearest and farthest.
const SHARE_OF_WIDTH: std::ops::Range<f64> = 0.3..0.75;
/// Most that a board is tilted about each of its sides, rad.
const MAX_TILT_RAD: f64 = 0.6;
/// Most that it is turned in its plane, rad.
const MAX_ROLL_RAD: f64 = 0.4;
/// Points closer to the image's edge than this are not seen, px.
const MARGIN_PX: f64 = 4.0;
/// Placements that are tried for a view.
const TRIES: usize = 1000;

/// Random placements of a board, left_from_board, that both cameras see whole.
#[must_use]
pub fn placements(rig: &StereoRig, board: &Board, count: usize, seed: u64) -> Vec<Isometry3<f64>> {
    let mut random = Xoshiro256PlusPlus::seed_from_u64(seed);
    let mut placements = Vec::with_capacity(count);
    for _ in 0..TRIES * count {
        if placements.len() == count {
            break;
        }
        let placement = random_placement(rig, board, &mut random);
        let is_whole = board.points().iter().all(|p| {
            let in_left = placement * p;
            let sees = |camera: &Camera, point: &Point3<f64>| {
                camera
                    .project(point)
                    .is_some_and(|px| camera.contains(&px, MARGIN_PX))
            };
            sees(&rig.left, &in_left) && sees(&rig.right, &(rig.right_from_left * in_left))
        });
        if is_whole {
            placements.push(placement);
        }
    }
    placements
}

fn random_placement(
    rig: &StereoRig,
    board: &Board,
    random: &mut Xoshiro256PlusPlus,
) -> Isometry3<f64> {
    let far = board.point(board.len().saturating_sub(1)).coords;
    let camera = &rig.left;
    let share: f64 = random.random_range(SHARE_OF_WIDTH);
    let depth_m = far.norm() * camera.focal_px.x / (share * f64::from(camera.width));
    let px = Vector2::new(
        random.random_range(0.0..f64::from(camera.width)),
        random.random_range(0.0..f64::from(camera.height)),
    );
    let middle = camera.ray(&px).unwrap_or_else(Vector3::z) * depth_m;
    let mut angle = |most: f64| random.random_range(-most..most);
    let turn = UnitQuaternion::from_euler_angles(
        angle(MAX_TILT_RAD),
        angle(MAX_TILT_RAD),
        angle(MAX_ROLL_RAD),
    );
    Isometry3::from_parts(Translation3::from(middle - turn * (far * 0.5)), turn)
}

/// What the rig's cameras see of the boards' points, with normal noise of `sigma_px` in each coordinate.
#[must_use]
pub fn views(
    rig: &StereoRig,
    board: &Board,
    placements: &[Isometry3<f64>],
    sigma_px: f64,
    seed: u64,
) -> Vec<View> {
    let mut random = Xoshiro256PlusPlus::seed_from_u64(seed);
    // A standard deviation that is finite and not negative makes a normal distribution; of another, no noise.
    let noise = Normal::new(0.0, sigma_px).ok();
    let mut noisy = |px: Vector2<f64>| match &noise {
        Some(noise) => px + Vector2::new(noise.sample(&mut random), noise.sample(&mut random)),
        None => px,
    };
    placements
        .iter()
        .enumerate()
        .map(|(i, placement)| {
            let mut sees = |camera: &Camera, from_left: &Isometry3<f64>| -> SeenPoints {
                let px = |p: &Point3<f64>| camera.project(&(from_left * placement * p));
                let points = board.points();
                points
                    .iter()
                    .map(|p| px(p).filter(|px| camera.contains(px, 0.0)).map(&mut noisy))
                    .collect()
            };
            View {
                name: format!("{i:03}"),
                seen: [
                    Some(sees(&rig.left, &Isometry3::identity())),
                    Some(sees(&rig.right, &rig.right_from_left)),
                ],
            }
        })
        .collect()
}

/// Grey values of the wall, of paper and of ink.
const GREYS: [f64; 3] = [110.0, 205.0, 35.0];
/// Rays a side of a pixel.
const RAYS: u32 = 3;

/// What a camera sees of a board before a grey wall: every pixel the mean over its area, with normal noise of
/// `sigma_grey`.
#[must_use]
pub fn image(
    camera: &Camera,
    camera_from_board: &Isometry3<f64>,
    board: &Board,
    sigma_grey: f64,
    seed: u64,
) -> GrayImage {
    let mut random = Xoshiro256PlusPlus::seed_from_u64(seed);
    let noise = Normal::new(0.0, sigma_grey).ok();
    let board_from_camera = camera_from_board.inverse();
    let mut image = GrayImage::filled(camera.width, camera.height, 0);
    let width = camera.width as usize;
    for (i, pixel) in image.pixels_mut().iter_mut().enumerate() {
        let corner = Vector2::new((i % width) as f64 - 0.5, (i / width) as f64 - 0.5);
        let mut sum = 0.0;
        for ray in 0..RAYS * RAYS {
            let within = Vector2::new(f64::from(ray % RAYS) + 0.5, f64::from(ray / RAYS) + 0.5)
                / f64::from(RAYS);
            sum += grey(camera, &board_from_camera, board, &(corner + within));
        }
        let noise = noise.as_ref().map_or(0.0, |n| n.sample(&mut random));
        *pixel = (sum / f64::from(RAYS * RAYS) + noise)
            .round()
            .clamp(0.0, 255.0) as u8;
    }
    image
}

fn grey(
    camera: &Camera,
    board_from_camera: &Isometry3<f64>,
    board: &Board,
    px: &Vector2<f64>,
) -> f64 {
    let [wall, paper, ink] = GREYS;
    let Some(ray) = camera.ray(px) else {
        return wall;
    };
    let (origin, direction) = (
        board_from_camera.translation.vector,
        board_from_camera.rotation * ray,
    );
    let distance = -origin.z / direction.z;
    if !(distance.is_finite() && distance > 0.0) {
        return wall;
    }
    let at = (origin + direction * distance) / board.square_m;
    let mut far = board.point(board.len().saturating_sub(1)) / board.square_m;
    if board.pattern == Pattern::AsymmetricCircles {
        // The last row need not be one of those that reach farthest.
        far.x = (2 * board.columns).saturating_sub(1) as f64;
    }
    // Squares reach one beyond the inner corners, paper half a square more.
    let beyond = (-at.x).max(-at.y).max(at.x - far.x).max(at.y - far.y);
    if beyond > 1.5 {
        return wall;
    }
    let is_ink = match board.pattern {
        Pattern::Chessboard => {
            beyond <= 1.0 && (at.x.floor() + at.y.floor()).rem_euclid(2.0) == 0.0
        }
        Pattern::Circles => {
            let nearest = Vector2::new(at.x.round(), at.y.round());
            beyond <= 0.5 && (at.xy() - nearest).norm() < 0.3
        }
        Pattern::AsymmetricCircles => {
            let row = at.y.round();
            let shift = row.rem_euclid(2.0);
            let x = ((at.x - shift) * 0.5).round() * 2.0 + shift;
            let is_on_board = (0.0..=far.y).contains(&row) && x >= 0.0 && x <= far.x;
            is_on_board && (at.xy() - Vector2::new(x, row)).norm() < 0.5
        }
    };
    if is_ink { ink } else { paper }
}
