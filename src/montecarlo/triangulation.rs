//! The first stage: pixels to points (thesis §3.2, figure 4.5).

use super::verdict::{Tally, Verdict};
use super::world::RigDraw;
use super::{MonteCarloError, RigError, Settings, for_each_run, rng_of_run};
use crate::estimation::{
    Landmark, MotionModel, Plane, StereoMeasurement, Viewpoint, calibration, triangulate,
};
use crate::geometry::StereoRig;
use crate::geometry::rig_parameters::RigCovariance;
use crate::uncertainty::{consistency, propagate};
use nalgebra::{Matrix2x3, Matrix3, Matrix4, Matrix6, Point3, Vector2, Vector3, Vector4, Vector6};
use rand_xoshiro::Xoshiro256PlusPlus;

/// What the triangulation stage found of one point.
#[derive(Clone, Debug)]
pub struct PointOutcome {
    /// The true point, left camera, m.
    pub point: Point3<f64>,
    /// Its errors against their covariances.
    pub verdict: Verdict,
    /// Standard deviation of its depth over its depth; first order holds up to 0.08.
    pub relative_depth_sigma: f64,
    /// Some of the runs' points.
    pub sample: Vec<Point3<f64>>,
    /// Runs without a point.
    pub failed: u64,
}

/// What the triangulation stage found.
#[derive(Clone, Debug)]
pub struct TriangulationOutcome {
    /// Point by point, near ones first.
    pub points: Vec<PointOutcome>,
}

const STAGE: u64 = 1;
/// Points are placed at so many depths, each at so many places of the image.
const MOST_DEPTHS: usize = 5;
const PLACES: [(f64, f64); 3] = [(0.25, 0.35), (0.5, 0.5), (0.75, 0.65)];
/// Runs whose points are kept for the figure.
const SAMPLE: usize = 300;

/// Triangulates points between the settings' depths again and again: 2, 5, 10, 20 and 40 m by
/// default. `progress` hears of each run.
///
/// # Errors
/// A setting cannot be used, or the rig sees nothing.
pub fn run_triangulation(
    rig: &StereoRig,
    settings: &Settings,
    progress: &(dyn Fn(u64) + Sync),
) -> Result<TriangulationOutcome, MonteCarloError> {
    settings.check()?;
    let rigs = RigDraw::new(rig, settings)?;
    let truth = points(rig, settings)?;
    let plane = Plane::of(rig);
    let planar = settings.model == MotionModel::Planar;
    let freedom = if planar { 2 } else { 3 };
    let considered = match settings.rig_error {
        RigError::Considered => rig.covariance(),
        _ => None,
    };
    let mut tallies = vec![Tally::new(freedom); truth.len()];
    let mut samples = vec![Vec::new(); truth.len()];
    for_each_run(
        settings.runs,
        |run| {
            let mut rng = rng_of_run(settings.seed, STAGE, run);
            let rig_seen = rigs.as_ref().map(|rigs| rigs.draw(rig, &mut rng));
            let seen = rig_seen.as_ref().unwrap_or(rig);
            let measure = |p: &Point3<f64>, rng: &mut Xoshiro256PlusPlus| {
                let m = StereoMeasurement {
                    px: seen.project(p)? + settings.noise.sample(rng).0,
                    sigma_px: Vector4::repeat(settings.stated_sigma_px()),
                };
                let mut landmark = triangulate(rig, &m)?;
                if let Some(covariance) = &considered {
                    landmark.cov_m2 += of_calibration(rig, &m, &landmark, covariance)?;
                }
                let error = landmark.point - p;
                let nees = nees(&plane, planar, &error, &landmark.cov_m2)?;
                Some((landmark, error, nees))
            };
            truth
                .iter()
                .map(|p| measure(p, &mut rng))
                .collect::<Vec<_>>()
        },
        progress,
        |_, run| {
            for (i, found) in run.into_iter().enumerate() {
                let Some((landmark, error, nees)) = found else {
                    continue;
                };
                let mut cov = Matrix6::zeros();
                cov.fixed_view_mut::<3, 3>(0, 0).copy_from(&landmark.cov_m2);
                let mut six = Vector6::zeros();
                six.fixed_rows_mut::<3>(0).copy_from(&error);
                tallies[i].add(&six, &cov, nees);
                if samples[i].len() < SAMPLE {
                    samples[i].push(landmark.point);
                }
            }
        },
    );
    let points = truth
        .into_iter()
        .zip(tallies.iter().zip(samples))
        .filter(|(_, (tally, _))| tally.count() >= 2)
        .map(|(point, (tally, sample))| {
            let verdict = tally.verdict(None);
            PointOutcome {
                relative_depth_sigma: verdict.first_order[(2, 2)].sqrt() / point.z,
                point,
                verdict,
                sample,
                failed: settings.runs - tally.count(),
            }
        })
        .collect();
    Ok(TriangulationOutcome { points })
}

/// What the rig's uncertainty adds to a point's covariance: as a displacement of its pixels.
fn of_calibration(
    rig: &StereoRig,
    m: &StereoMeasurement,
    landmark: &Landmark,
    covariance: &RigCovariance,
) -> Option<Matrix3<f64>> {
    let p = landmark.point;
    let y = Vector3::new(p.x / p.z, p.y / p.z, 1.0 / p.z);
    let by_rig = calibration::sight_by_rig(rig, &Viewpoint::unmoved(rig), &y)?;
    let (_, jacobian) = rig.project_with_jacobian(&p)?;
    let info = Matrix4::from_diagonal(&m.sigma_px.map(|s| 1.0 / (s * s)));
    let by_rig = landmark.cov_m2 * jacobian.transpose() * info * by_rig;
    Some(propagate(&by_rig, covariance))
}

/// Over all three axes, or over the two of the ground.
fn nees(plane: &Plane, planar: bool, error: &Vector3<f64>, cov: &Matrix3<f64>) -> Option<f64> {
    if !planar {
        return consistency::nees(error, cov);
    }
    let columns: [Vector2<f64>; 3] =
        [Vector3::x(), Vector3::y(), Vector3::z()].map(|axis| plane.in_plane(&axis));
    let onto = Matrix2x3::from_columns(&columns);
    let reduced = onto * cov * onto.transpose();
    consistency::nees(&(onto * error), &((reduced + reduced.transpose()) * 0.5))
}

/// Points at round depths in the settings' range (1, 2, 5 times powers of ten and four times), each
/// at three places of the left image.
fn points(rig: &StereoRig, settings: &Settings) -> Result<Vec<Point3<f64>>, MonteCarloError> {
    let [near, far] = settings.depth_m;
    let mut found = Vec::new();
    for depth in depths(near, far) {
        for (across, down) in PLACES {
            let pixel = Vector2::new(
                across * f64::from(rig.left.width - 1),
                down * f64::from(rig.left.height - 1),
            );
            let point = rig.left.ray(&pixel).map(|ray| Point3::from(ray * depth));
            found.extend(point.filter(|p| {
                rig.project(p)
                    .is_some_and(|px| rig.right.contains(&Vector2::new(px[2], px[3]), 0.0))
            }));
        }
    }
    if found.is_empty() {
        return Err(MonteCarloError::NothingToSee {
            near_m: near.to_string(),
            far_m: far.to_string(),
            when: "at the same time",
        });
    }
    Ok(found)
}

/// At most five depths from `near` to `far`, both included, in equal ratios, rounded to a digit
/// or so.
fn depths(near: f64, far: f64) -> Vec<f64> {
    if far / near < 1.05 {
        return vec![near];
    }
    let ratio = (far / near).powf(1.0 / (MOST_DEPTHS - 1) as f64);
    let mut depths: Vec<f64> = (0..MOST_DEPTHS)
        .map(|i| near * ratio.powi(i as i32))
        .collect();
    for depth in &mut depths[1..MOST_DEPTHS - 1] {
        let unit = 10_f64.powf(depth.log10().floor());
        let rounded = [1.0, 2.0, 3.0, 4.0, 5.0, 7.0, 10.0]
            .into_iter()
            .map(|digit| digit * unit)
            .min_by(|a, b| (a / *depth).ln().abs().total_cmp(&(b / *depth).ln().abs()));
        *depth = rounded.unwrap_or(*depth).clamp(near, far);
    }
    depths[MOST_DEPTHS - 1] = far;
    depths.dedup();
    depths
}
