//! The second stage: points to one motion (thesis §3.3, figure 4.6).

use super::verdict::{Tally, Verdict};
use super::world::{RigDraw, World};
use super::{
    FrameEstimator, MonteCarloError, RigError, Settings, TwoFrameChain, bound, for_each_run,
    rng_of_run,
};
use crate::estimation;
use crate::estimation::two_frame::Estimator;
use crate::geometry::{StereoRig, se3};
use nalgebra::{Isometry3, Vector6};

/// What the motion stage found.
#[derive(Clone, Debug)]
pub struct MotionOutcome {
    /// Errors of the motion against its covariance.
    pub verdict: Verdict,
    /// The true motion.
    pub prev_from_now: Isometry3<f64>,
    /// Each run's error (right perturbation).
    pub errors: Vec<Vector6<f64>>,
    /// Runs without an estimate.
    pub failed: u64,
}

const STAGE: u64 = 2;

/// Estimates one motion again and again. `progress` hears of each run.
///
/// # Errors
/// A setting cannot be used, or the rig sees nothing.
pub fn run_motion(
    rig: &StereoRig,
    settings: &Settings,
    progress: &(dyn Fn(u64) + Sync),
) -> Result<MotionOutcome, MonteCarloError> {
    settings.check()?;
    let rigs = RigDraw::new(rig, settings)?;
    let model = settings.model.of(rig);
    let world = World::new(
        rig,
        settings,
        1,
        &mut rng_of_run(settings.seed, STAGE, u64::MAX),
    )?;
    let prev_from_now = world.frames[1].odom_from_camera;
    let bound = bound::of_batch(&world, &model).and_then(|poses| poses.first().copied());
    let mut tally = Tally::new(model.degrees_of_freedom());
    let mut errors = Vec::new();
    for_each_run(
        settings.runs,
        |run| {
            let mut rng = rng_of_run(settings.seed, STAGE, run);
            let rig_seen = rigs.as_ref().map(|rigs| rigs.draw(rig, &mut rng));
            let mut frames = Vec::new();
            world.measure(rig_seen.as_ref(), &mut rng, &mut frames);
            let mut chain = settings.chain(rig, model);
            chain.observe(&frames[0])?;
            let found = chain.observe(&frames[1])?;
            let error = se3::log(&(prev_from_now.inverse() * found.prev_from_now));
            let nees = model.nees(&error, &found.cov_pose)?;
            Some((error, found.cov_pose, nees))
        },
        progress,
        |_, result| {
            if let Some((error, cov, nees)) = result {
                tally.add(&error, &cov, nees);
                errors.push(error);
            }
        },
    );
    let failed = settings.runs - tally.count();
    if tally.count() < 2 {
        return Err(MonteCarloError::NoEstimates(
            tally.count() as usize,
            settings.runs as usize,
        ));
    }
    Ok(MotionOutcome {
        verdict: tally.verdict(bound),
        prev_from_now,
        errors,
        failed,
    })
}

impl Settings {
    /// The window's settings: few landmarks suffice, and the rig is taken as exact unless it says
    /// otherwise.
    pub(super) fn window(&self) -> estimation::Settings {
        estimation::Settings {
            min_inliers: 6,
            // A rig that states its errors is as uncertain as that; else it is exact.
            calibration_sigma_px: 0.0,
            consider_calibration: self.rig_error == RigError::Considered,
            gate_sigma2: self.gate_sigma2,
            keyframes: self.keyframes,
            ..estimation::Settings::default()
        }
    }

    /// The whole pipeline's settings for images.
    pub(super) fn of_images(&self) -> estimation::Settings {
        let method = match self.estimator {
            _ if self.windowed => estimation::Method::Window,
            Estimator::Svd => estimation::Method::Svd,
            Estimator::Weighted => estimation::Method::Weighted,
            Estimator::Bundle => estimation::Method::Bundle,
        };
        estimation::Settings {
            method,
            model: self.model,
            calibration_sigma_px: 0.0,
            consider_calibration: self.rig_error == RigError::Considered,
            gate_sigma2: self.gate_sigma2,
            keyframes: self.keyframes,
            ..estimation::Settings::default()
        }
    }

    /// The two-frame estimator that the settings name.
    pub(super) fn chain<'a>(
        &self,
        rig: &'a StereoRig,
        model: estimation::Model,
    ) -> TwoFrameChain<'a> {
        let chain = TwoFrameChain::new(
            rig,
            self.estimator,
            model,
            self.gate_sigma2,
            self.correlation,
        );
        match rig.covariance() {
            Some(covariance) if self.rig_error == RigError::Considered => {
                chain.considering(covariance)
            }
            _ => chain,
        }
    }
}
