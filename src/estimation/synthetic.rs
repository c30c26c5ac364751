//! For tests: a rig, points before it, and how it sees them before and after a motion.

use super::bundle::TrackedPoint;
use super::{StereoMeasurement, inverse_depth};
use crate::geometry::{StereoRig, parse_rig, se3};
use nalgebra::{Isometry3, Point3, Vector2, Vector4, Vector6};
use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, StandardNormal};
use rand_xoshiro::Xoshiro256PlusPlus;

/// The thesis' rig at the resolution its calibration belongs to, with a lens on the right.
pub(super) fn rig() -> StereoRig {
    parse_rig(
        "left = { width = 640, height = 480, focal = [885.81833, 884.10614], principal_point = [313.18805, 243.49370] }
         right = { width = 640, height = 480, focal = [882.93736, 881.18040], principal_point = [300.19781, 246.39833], distortion = { model = \"radtan\", coefficients = [-0.2, 0.1, 0.0005, -0.0003] } }
         right_from_left = { translation_m = [-0.3857, -0.0072, 0.0001], rotation_vector_rad = [0.04046, 0.01616, 0.01419] }",
    )
    .expect("valid")
}

/// A motion of every kind.
pub(super) fn step() -> Isometry3<f64> {
    se3::exp(&Vector6::new(0.02, -0.01, 0.3, 0.01, 0.04, -0.005))
}

pub(super) fn random(seed: u64) -> Xoshiro256PlusPlus {
    Xoshiro256PlusPlus::seed_from_u64(seed)
}

pub(super) fn normal4(rng: &mut Xoshiro256PlusPlus) -> Vector4<f64> {
    Vector4::from_fn(|_, _| StandardNormal.sample(rng))
}

/// Points between `depth_m`, seen before and after `prev_from_now`, with noise of `sigma_px`; they
/// are said to have one of 0.5 px, some of them one of 0.8 px.
pub(super) fn tracks(
    rig: &StereoRig,
    prev_from_now: &Isometry3<f64>,
    count: usize,
    depth_m: [f64; 2],
    sigma_px: f64,
    rng: &mut Xoshiro256PlusPlus,
) -> Vec<TrackedPoint> {
    let mut tracks = Vec::new();
    while tracks.len() < count {
        let z: f64 = rng.random_range(depth_m[0]..depth_m[1]);
        let px = Vector2::new(rng.random_range(0.0..640.0), rng.random_range(0.0..480.0));
        let prev = Point3::from(rig.left.ray(&px).expect("inside") * z);
        let now = prev_from_now.inverse() * prev;
        let scale = if tracks.len() % 3 == 0 { 1.6 } else { 1.0 };
        let mut measure = |p: &Point3<f64>| {
            let seen = rig.project(p)?;
            let inside = rig.left.contains(&Vector2::new(seen[0], seen[1]), 0.0)
                && rig.right.contains(&Vector2::new(seen[2], seen[3]), 0.0);
            inside.then(|| StereoMeasurement {
                px: seen + normal4(rng) * (sigma_px * scale),
                sigma_px: Vector4::repeat(0.5 * scale),
            })
        };
        let (Some(prev), Some(now)) = (measure(&prev), measure(&now)) else {
            continue;
        };
        if let Some(inverse_depth) = inverse_depth(rig, &prev) {
            tracks.push(TrackedPoint {
                prev,
                now,
                inverse_depth,
            });
        }
    }
    tracks
}
