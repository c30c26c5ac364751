//! The third stage: motions to a path (thesis §3.4, figures 4.7 and 4.11).

use super::verdict::{Tally, Verdict};
use super::world::{RigDraw, World};
use super::{
    FrameEstimate, FrameEstimator, MonteCarloError, Settings, WindowOdometry, bound, for_each_run,
    rng_of_run,
};
use crate::estimation::Model;
use crate::geometry::{StereoRig, se3};
use nalgebra::{Isometry3, Matrix6, Vector6};

/// What the odometry stage found.
#[derive(Clone, Debug)]
pub struct OdometryOutcome {
    /// Errors of the pose against its covariance after each motion, the first at index 0.
    pub poses: Vec<Verdict>,
    /// Errors of all motions of all runs against their covariances.
    pub increments: Verdict,
    /// The true poses, the first pair's included.
    pub truth: Vec<Isometry3<f64>>,
    /// Each run's error of the last pose (right perturbation).
    pub last_errors: Vec<Vector6<f64>>,
    /// The first run's poses.
    pub example: Vec<Isometry3<f64>>,
    /// Runs that lost their way.
    pub failed: u64,
}

impl OdometryOutcome {
    /// The verdict on the last pose.
    #[must_use]
    pub fn last(&self) -> &Verdict {
        // A path has at least one step; its increments are the same verdict for one.
        self.poses.last().unwrap_or(&self.increments)
    }
}

const STAGE: u64 = 3;

/// Runs the path again and again with the estimator of the settings. `progress` hears of
/// each run.
///
/// # Errors
/// A setting cannot be used, or the rig sees nothing.
pub fn run_odometry(
    rig: &StereoRig,
    settings: &Settings,
    progress: &(dyn Fn(u64) + Sync),
) -> Result<OdometryOutcome, MonteCarloError> {
    if settings.windowed {
        let estimation = settings.window();
        return run_odometry_with(rig, settings, progress, || {
            WindowOdometry::new(rig, &estimation)
        });
    }
    let model = settings.model.of(rig);
    run_odometry_with(rig, settings, progress, || settings.chain(rig, model))
}

/// One step of a run.
struct Step {
    pose_error: Vector6<f64>,
    cov_pose: Matrix6<f64>,
    pose_nees: f64,
    motion_error: Vector6<f64>,
    cov_motion: Matrix6<f64>,
    motion_nees: f64,
    odom_from_camera: Isometry3<f64>,
}

/// [`run_odometry`] with any estimator: `begin` gives a new one for each run.
///
/// # Errors
/// As [`run_odometry`].
pub fn run_odometry_with<E: FrameEstimator>(
    rig: &StereoRig,
    settings: &Settings,
    progress: &(dyn Fn(u64) + Sync),
    begin: impl Fn() -> E + Sync,
) -> Result<OdometryOutcome, MonteCarloError> {
    settings.check()?;
    let rigs = RigDraw::new(rig, settings)?;
    let model = settings.model.of(rig);
    let mut rng = rng_of_run(settings.seed, STAGE, u64::MAX);
    let world = World::new(rig, settings, settings.steps, &mut rng)?;
    let truth: Vec<_> = world.frames.iter().map(|f| f.odom_from_camera).collect();
    let bounds = bound::of_batch(&world, &model);
    let freedom = model.degrees_of_freedom();
    let mut poses = vec![Tally::new(freedom); settings.steps];
    let mut increments = Tally::new(freedom);
    let (mut last_errors, mut example) = (Vec::new(), Vec::new());
    for_each_run(
        settings.runs,
        |run| {
            let mut rng = rng_of_run(settings.seed, STAGE, run);
            let rig_seen = rigs.as_ref().map(|rigs| rigs.draw(rig, &mut rng));
            let mut frames = Vec::new();
            world.measure(rig_seen.as_ref(), &mut rng, &mut frames);
            let mut estimator = begin();
            estimator.observe(&frames[0])?;
            let mut steps = Vec::with_capacity(settings.steps);
            for (k, frame) in frames.iter().enumerate().skip(1) {
                let found = estimator.observe(frame)?;
                steps.push(judge(&model, &truth[k - 1], &truth[k], &found)?);
            }
            Some(steps)
        },
        progress,
        |_, run| {
            let Some(steps) = run else { return };
            for (tally, s) in poses.iter_mut().zip(&steps) {
                tally.add(&s.pose_error, &s.cov_pose, s.pose_nees);
                increments.add(&s.motion_error, &s.cov_motion, s.motion_nees);
            }
            last_errors.extend(steps.last().map(|s| s.pose_error));
            if example.is_empty() {
                example.push(truth[0]);
                example.extend(steps.iter().map(|s| s.odom_from_camera));
            }
        },
    );
    let good = last_errors.len();
    if good < 2 {
        return Err(MonteCarloError::NoEstimates(good, settings.runs as usize));
    }
    let of_step = |k: usize| bounds.as_ref().map(|bounds| bounds[k]);
    Ok(OdometryOutcome {
        poses: poses
            .iter()
            .enumerate()
            .map(|(k, tally)| tally.verdict(of_step(k)))
            .collect(),
        increments: increments.verdict(None),
        truth,
        last_errors,
        example,
        failed: settings.runs - good as u64,
    })
}

/// Errors and their normalised squares. `None` where a covariance is none.
fn judge(
    model: &Model,
    odom_from_prev: &Isometry3<f64>,
    odom_from_now: &Isometry3<f64>,
    found: &FrameEstimate,
) -> Option<Step> {
    let prev_from_now = odom_from_prev.inverse() * odom_from_now;
    let pose_error = se3::log(&(odom_from_now.inverse() * found.odom_from_camera));
    let motion_error = se3::log(&(prev_from_now.inverse() * found.prev_from_now));
    Some(Step {
        pose_nees: model.nees(&pose_error, &found.cov_pose)?,
        motion_nees: model.nees(&motion_error, &found.cov_motion)?,
        pose_error,
        cov_pose: found.cov_pose,
        motion_error,
        cov_motion: found.cov_motion,
        odom_from_camera: found.odom_from_camera,
    })
}
