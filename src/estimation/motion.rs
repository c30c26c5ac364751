//! Motion: the tracks between two pairs in, the motion with covariance out, or why there is none.

use super::bundle::{self, Adjuster, TrackedPoint};
use super::closed_form::{self, MotionEstimate};
use super::consensus::{self, Search, Sighting};
use super::{Landmark, Method, Settings};
use crate::geometry::StereoRig;
use nalgebra::{Isometry3, Point3, Vector3};

/// A measured motion.
#[derive(Clone, Copy, Debug)]
pub struct MeasuredMotion {
    /// The motion, its covariance scaled by the residuals.
    pub estimate: MotionEstimate,
    /// A-posteriori variance factor.
    pub variance_factor: f64,
    /// Tracks that it rests on.
    pub inliers: u32,
}

/// Rounds of adjusting and judging the residuals again.
const ROUNDS: usize = 3;

/// Measures the motion between two pairs. `guess` is where to look first; `variance_factor` what
/// the last pairs had.
///
/// `None` if too few tracks agree, or do not determine the motion.
#[must_use]
pub fn measure(
    rig: &StereoRig,
    points: &[TrackedPoint],
    guess: Option<&Isometry3<f64>>,
    variance_factor: f64,
    seed: u64,
    settings: &Settings,
    adjuster: &mut Adjuster,
) -> Option<MeasuredMotion> {
    let search = Search {
        max_samples: settings.max_samples,
        gate: settings.gate_sigma2,
        variance_factor,
        seed,
    };
    let (kept, sightings): (Vec<u32>, Vec<Sighting>) = (0..)
        .zip(points)
        .filter_map(|(i, p)| Some((i, Sighting::of(rig, p)?)))
        .unzip();
    let consensus = consensus::find(rig, &sightings, guess, &search)?;
    let mut inliers: Vec<TrackedPoint> = consensus
        .inliers
        .iter()
        .map(|&i| points[kept[i as usize] as usize])
        .collect();
    if inliers.len() < settings.min_inliers as usize {
        return None;
    }
    match settings.method {
        Method::Svd => closed_form_motion(rig, &inliers, settings),
        Method::Bundle | Method::Window => {
            let adjusted = adjust_and_judge(
                rig,
                &consensus.prev_from_now,
                &mut inliers,
                settings,
                adjuster,
            )?;
            (inliers.len() >= settings.min_inliers as usize).then_some(())?;
            let mut estimate = adjusted.motion;
            estimate.cov_right *= adjusted.variance_factor;
            Some(MeasuredMotion {
                estimate,
                variance_factor: adjusted.variance_factor,
                inliers: inliers.len() as u32,
            })
        }
    }
}

/// Adjusts, drops tracks whose residuals are too large now that the motion is known well, and
/// adjusts again until none is.
fn adjust_and_judge(
    rig: &StereoRig,
    prev_from_now: &Isometry3<f64>,
    points: &mut Vec<TrackedPoint>,
    settings: &Settings,
    adjuster: &mut Adjuster,
) -> Option<bundle::Adjustment> {
    let mut adjusted = adjuster.adjust(rig, prev_from_now, points)?;
    for _ in 1..ROUNDS {
        let before = points.len();
        let limit = settings.gate_sigma2 * adjusted.variance_factor;
        let motion = adjusted.motion.prev_from_now;
        points.retain(|p| {
            bundle::squared_residual_sigmas(rig, &motion, p).is_some_and(|e| e <= limit)
        });
        if points.len() == before {
            break;
        }
        adjusted = adjuster.adjust(rig, &motion, points)?;
    }
    Some(adjusted)
}

/// The thesis' estimator: closed form on triangulated points, its covariance scaled by the residuals
/// in the image.
fn closed_form_motion(
    rig: &StereoRig,
    inliers: &[TrackedPoint],
    settings: &Settings,
) -> Option<MeasuredMotion> {
    let landmarks: Vec<(Landmark, Landmark)> = inliers
        .iter()
        .filter_map(|p| {
            let prev = super::triangulate(rig, &p.prev)?;
            let now = super::triangulate(rig, &p.now)?;
            // One distant point, metres off along its ray, would lead the unweighted fit.
            (prev.is_first_order() && now.is_first_order()).then_some((prev, now))
        })
        .collect();
    if landmarks.len() < settings.min_inliers as usize {
        return None;
    }
    let mut estimate = closed_form::align_with_covariance(landmarks.iter().copied())?;
    let variance_factor = cloud_variance_factor(&landmarks, &estimate.prev_from_now)?;
    estimate.cov_right *= variance_factor;
    Some(MeasuredMotion {
        estimate,
        variance_factor,
        inliers: landmarks.len() as u32,
    })
}

/// Squared distances between the clouds in units of their covariances, over degrees of freedom.
fn cloud_variance_factor(
    landmarks: &[(Landmark, Landmark)],
    prev_from_now: &Isometry3<f64>,
) -> Option<f64> {
    let rotation = prev_from_now.rotation.to_rotation_matrix();
    let mut sum = 0.0;
    for (prev, now) in landmarks {
        let gap: Vector3<f64> = prev.point - prev_from_now * Point3::from(now.point.coords);
        let cov = prev.cov_m2 + rotation.matrix() * now.cov_m2 * rotation.matrix().transpose();
        sum += gap.dot(&cov.cholesky()?.solve(&gap));
    }
    let freedom = 3 * landmarks.len() - 6;
    (freedom > 0).then(|| sum / freedom as f64)
}
