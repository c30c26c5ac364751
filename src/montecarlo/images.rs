//! The fourth stage: rendered sequences through the whole pipeline, from grey values to poses.
//!
//! Every run is another scene, path and seed; an image's noise, its texture, the features that are
//! found and the matches that are wrong are all in its errors. Motions that were measured are
//! judged, and the last pose of each run.

use super::verdict::{LEVEL, Tally, Verdict};
use super::world::RigDraw;
use super::{MonteCarloError, Settings, for_each_run, rng_of_run};
use crate::estimation::{Odometry, Status};
use crate::features;
use crate::geometry::{StereoRig, se3};
use crate::pipeline::{DescribedPair, Method};
use crate::simulation::{self, SceneName, Simulation, TrajectoryName};
use crate::uncertainty::consistency::{autocorrelation, autocorrelation_limit, nees, whiten};
use nalgebra::{Isometry3, Matrix6, Vector6};

/// What is rendered, one after the other: each as the path goes through it without running into
/// anything for five seconds.
pub const SEQUENCES: [(SceneName, TrajectoryName); 6] = [
    (SceneName::Hall, TrajectoryName::Slalom),
    (SceneName::Corridor, TrajectoryName::Straight),
    (SceneName::Hall, TrajectoryName::Circle),
    (SceneName::Street, TrajectoryName::Straight),
    (SceneName::Room, TrajectoryName::LoopRoom),
    (SceneName::Hall, TrajectoryName::Arc),
];

/// What one sequence came to.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct Sequence {
    /// The scene.
    pub scene: SceneName,
    /// The path through it.
    pub trajectory: TrajectoryName,
    /// What texture and noise are drawn from.
    pub seed: u64,
    /// Motions that were measured.
    pub motions: u64,
    /// Pairs whose motion was not measured.
    pub lost: u64,
    /// Average normalised squared error of its motions, over six.
    pub anees_of_motions: f64,
    /// Normalised squared error of its last pose, over six.
    pub nees_of_end: f64,
}

/// What the images stage found.
#[derive(Clone, Debug)]
pub struct ImagesOutcome {
    /// Sequence by sequence.
    pub sequences: Vec<Sequence>,
    /// All motions of all sequences.
    pub increments: Verdict,
    /// The last pose of each sequence.
    pub last: Verdict,
    /// Correlation of neighbouring motions' errors in units of their covariance, from −1 to 1, and
    /// what it stays below in 95 of 100 experiments with independent motions.
    pub whiteness: (f64, f64),
    /// Runs that gave nothing to judge.
    pub failed: u64,
}

const STAGE: u64 = 4;
const RATE_HZ: f64 = 10.0;

/// An error with its covariance: fixed axes.
type Sample = (Vector6<f64>, Matrix6<f64>, f64);

struct Run {
    sequence: Sequence,
    motions: Vec<Sample>,
    neighbours: Vec<(Vector6<f64>, Vector6<f64>)>,
    end: Sample,
}

/// Renders sequences and runs the pipeline on each. `progress` hears of each run.
///
/// # Errors
/// A setting cannot be used, or hardly any sequence could be followed.
pub fn run_images(
    rig: &StereoRig,
    settings: &Settings,
    progress: &(dyn Fn(u64) + Sync),
) -> Result<ImagesOutcome, MonteCarloError> {
    settings.check()?;
    let rigs = RigDraw::new(rig, settings)?;
    let (mut increments, mut last) = (Tally::new(6), Tally::new(6));
    let mut neighbours = Vec::new();
    let mut sequences = Vec::new();
    for_each_run(
        settings.runs,
        |run| {
            let mut rng = rng_of_run(settings.seed, STAGE, run);
            let seen = rigs
                .as_ref()
                .map_or_else(|| rig.clone(), |rigs| rigs.draw(rig, &mut rng));
            follow(rig, seen, settings, run)
        },
        progress,
        |_, run| {
            let Some(run) = run else { return };
            for (error, cov, nees) in &run.motions {
                increments.add(error, cov, *nees);
            }
            last.add(&run.end.0, &run.end.1, run.end.2);
            neighbours.extend(run.neighbours);
            sequences.push(run.sequence);
        },
    );
    let good = sequences.len();
    if good < 2 || increments.count() < 2 {
        return Err(MonteCarloError::NoEstimates(good, settings.runs as usize));
    }
    Ok(ImagesOutcome {
        whiteness: (
            autocorrelation(&neighbours),
            autocorrelation_limit(6 * neighbours.len().max(1), LEVEL),
        ),
        failed: settings.runs - good as u64,
        increments: increments.verdict(None),
        last: last.verdict(None),
        sequences,
    })
}

/// A sequence of so many frames, as `seen` sees it.
pub(super) fn rendered(
    (scene, trajectory): (SceneName, TrajectoryName),
    seen: StereoRig,
    frames: u64,
    seed: u64,
) -> Option<Simulation> {
    let settings = simulation::Settings {
        frames,
        rate_hz: RATE_HZ,
        seed,
        ..simulation::Settings::default()
    };
    Simulation::new(scene, trajectory, seen, settings).ok()
}

/// One sequence, seen by `seen`, followed by a pipeline that believes in `rig`.
fn follow(rig: &StereoRig, seen: StereoRig, settings: &Settings, run: u64) -> Option<Run> {
    let (scene, trajectory) = SEQUENCES[(run % SEQUENCES.len() as u64) as usize];
    let seed = settings.seed.wrapping_add(run);
    let simulation = rendered((scene, trajectory), seen, settings.steps as u64 + 1, seed)?;
    let mut extractor = features::extractor(&features::Settings::default()).ok()?;
    let mut method = Method::new(rig.clone(), Default::default(), settings.of_images())?;
    let mut judge = Judge::default();
    let mut described = DescribedPair::default();
    for frame in 0..=settings.steps as u64 {
        let (pair, truth) = simulation.pair(frame);
        described.describe(extractor.as_mut(), &pair).ok()?;
        let row = method.step(&mut described).ok()?;
        judge.take(&row, truth);
    }
    judge.verdict(scene, trajectory, seed)
}

/// Holds the rows of one sequence against the truth.
#[derive(Default)]
struct Judge {
    before: Option<(u32, Isometry3<f64>)>,
    whitened: Option<Vector6<f64>>,
    motions: Vec<Sample>,
    neighbours: Vec<(Vector6<f64>, Vector6<f64>)>,
    end: Option<Sample>,
    lost: u64,
}

impl Judge {
    fn take(&mut self, row: &Odometry, truth: Isometry3<f64>) {
        let before = self.before.replace((row.epoch, truth));
        let is_measured = matches!(row.status, Status::Tracking | Status::Degraded);
        self.lost += u64::from(row.status == Status::Lost);
        let mut whitened = None;
        if let Some((epoch, prev)) = before.filter(|_| is_measured)
            && epoch == row.epoch
        {
            let error = se3::error_fixed_axes(&row.prev_from_now, &prev.inv_mul(&truth));
            whitened = whiten(&error, &row.cov_motion);
            if let Some(w) = whitened {
                self.motions.push((error, row.cov_motion, w.norm_squared()));
                self.neighbours
                    .extend(self.whitened.map(|before| (before, w)));
            }
        }
        self.whitened = whitened;
        // The truth begins with the odometry frame, at the origin.
        let error = se3::error_fixed_axes(&row.odom_from_camera, &truth);
        self.end = nees(&error, &row.cov_pose).map(|value| (error, row.cov_pose, value));
    }

    fn verdict(self, scene: SceneName, trajectory: TrajectoryName, seed: u64) -> Option<Run> {
        let end = self.end?;
        let count = self.motions.len();
        if count == 0 {
            return None;
        }
        let sum: f64 = self.motions.iter().map(|(_, _, nees)| nees).sum();
        Some(Run {
            sequence: Sequence {
                scene,
                trajectory,
                seed,
                motions: count as u64,
                lost: self.lost,
                anees_of_motions: sum / (6 * count) as f64,
                nees_of_end: end.2 / 6.0,
            },
            motions: self.motions,
            neighbours: self.neighbours,
            end,
        })
    }
}
