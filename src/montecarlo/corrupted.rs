//! Corrupted pairs amid good ones, through the whole pipeline: which poses are published all the same, and
//! whether those that are called good are.
//!
//! Every sequence is rendered once, by a rig that is as far from what the pipeline believes as it states, and
//! followed once for every [`Corruption`]: some good pairs, up to five corrupted ones, some good ones, and so on.
//! What is published is held against the truth of the instant that the left image shows. A motion or pose is
//! *wrong* where its error is beyond its covariance's 5 σ, of all six coordinates together or along one axis.

use super::images::{SEQUENCES, rendered};
use super::world::RigDraw;
use super::{MonteCarloError, RigError, Settings, for_each_run, rng_of_run};
use crate::capture::StereoPair;
use crate::config::Config;
use crate::estimation::{Odometry, PairStamp, Status};
use crate::features;
use crate::geometry::{StereoRig, se3};
use crate::pipeline::{DescribedPair, Method};
use crate::simulation::corruption::{Corruption, MAX_LAG, Material, Spoiler};
use crate::simulation::{SceneName, TrajectoryName};
use crate::uncertainty::consistency::{chi2_quantile, nees};
use nalgebra::{Isometry3, Matrix6, Vector6};
use rand::RngExt;
use std::fmt::Write;

/// The sequences that come after the images stage's own.
const MORE_SEQUENCES: [(SceneName, TrajectoryName); 3] = [
    (SceneName::Room, TrajectoryName::FastTurn),
    (SceneName::Corridor, TrajectoryName::StopAndGo),
    (SceneName::Repetitive, TrajectoryName::Slalom),
];
const STAGE: u64 = 5;
/// Features of an image and landmarks at most: fewer than by default, so that thousands of pairs take minutes.
const FEATURES: usize = 400;
const LANDMARKS: u32 = 120;
/// Pairs of a sequence.
const PAIRS: usize = 48;
/// Good pairs before the first corrupted one, and between two runs of them: what is handed on once more was then
/// handed on before.
const WARM_UP: usize = 8;
const REST: [usize; 2] = [MAX_LAG + 1, 8];
/// Corrupted pairs in a row at most.
const LONGEST: usize = 5;
/// Of a normal variable, the chance that it is beyond 5 σ.
const BEYOND_5_SIGMA: f64 = 5.733e-7;
/// Axes and the sum of all six: tests that a motion or a pose may fail by chance.
const TESTS: f64 = 7.0;

/// What one kind of corruption came to.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Tally {
    /// Corrupted pairs.
    pub corrupted: u64,
    /// Their rows by status: initializing, tracking, degraded, lost.
    pub by_status: [u64; 4],
    /// Rows called good, of corrupted pairs and of the good ones that follow.
    pub tracking: u64,
    /// Those of them whose motion is wrong.
    pub wrong_motions: u64,
    /// Those of them whose pose is wrong.
    pub wrong_poses: u64,
    /// The same of rows that are called degraded.
    pub degraded: u64,
    /// Likewise.
    pub wrong_degraded: u64,
    /// Rows of any status in which something is not a number or no covariance.
    pub invalid: u64,
    /// The sum of the good motions' normalised squared errors.
    pub nees_of_motions: f64,
    /// The sum of the good poses' normalised squared errors.
    pub nees_of_poses: f64,
}

impl Tally {
    fn add(&mut self, other: &Self) {
        self.corrupted += other.corrupted;
        for (to, from) in self.by_status.iter_mut().zip(other.by_status) {
            *to += from;
        }
        self.tracking += other.tracking;
        self.wrong_motions += other.wrong_motions;
        self.wrong_poses += other.wrong_poses;
        self.degraded += other.degraded;
        self.wrong_degraded += other.wrong_degraded;
        self.invalid += other.invalid;
        self.nees_of_motions += other.nees_of_motions;
        self.nees_of_poses += other.nees_of_poses;
    }

    /// How many wrong motions or poses chance allows, if every covariance is right.
    #[must_use]
    pub fn allowed(&self) -> f64 {
        TESTS * BEYOND_5_SIGMA * self.tracking as f64
    }
}

/// A row that is called good, or degraded, and is wrong.
#[derive(Clone, Debug)]
pub struct Wrong {
    /// What had been done to the sequence.
    pub kind: Corruption,
    /// Which sequence.
    pub run: u64,
    /// Pairs since the last run of corrupted ones began.
    pub since: usize,
    /// Whether the pair is itself corrupted.
    pub is_corrupted: bool,
    /// Normalised squared errors of motion and pose, over six.
    pub nees: [f64; 2],
    /// What was published.
    pub row: Odometry,
}

/// What corrupted pairs came to.
#[derive(Clone, Debug, Default)]
pub struct CorruptedOutcome {
    /// Kind by kind, in the order that they were asked for.
    pub kinds: Vec<(Corruption, Tally)>,
    /// All rows that are wrong.
    pub wrong: Vec<Wrong>,
}

impl CorruptedOutcome {
    /// All kinds together, good sequences left out.
    #[must_use]
    pub fn total(&self) -> Tally {
        let mut total = Tally::default();
        for (kind, tally) in &self.kinds {
            if *kind != Corruption::None {
                total.add(tally);
            }
        }
        total
    }

    /// A table of Markdown, a line a kind.
    #[must_use]
    pub fn to_table(&self) -> String {
        let mut text = String::from(
            "| corruption | pairs | tracking | degraded | lost | rows called tracking | wrong motions | wrong poses \
             | χ² allows | rows called degraded | wrong | invalid | ANEES/6 of motions | of poses |\n\
             |---|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|\n",
        );
        let total = ("all but none".to_owned(), self.total());
        let kinds = self
            .kinds
            .iter()
            .map(|(kind, tally)| (kind.to_string(), *tally));
        for (name, t) in kinds.chain([total]) {
            let share = |i: usize| 100.0 * t.by_status[i] as f64 / t.corrupted.max(1) as f64;
            let anees = |sum: f64| sum / (6 * t.tracking).max(1) as f64;
            // Writing to a String cannot fail.
            let _ = writeln!(
                text,
                "| {name} | {} | {:.0} % | {:.0} % | {:.0} % | {} | {} | {} | {:.3} | {} | {} | {} | {:.2} | {:.2} |",
                t.corrupted,
                share(1),
                share(2),
                share(3) + share(0),
                t.tracking,
                t.wrong_motions,
                t.wrong_poses,
                t.allowed(),
                t.degraded,
                t.wrong_degraded,
                t.invalid,
                anees(t.nees_of_motions),
                anees(t.nees_of_poses),
            );
        }
        text
    }
}

/// Follows `runs` sequences through each corruption of `kinds`, as configured but for fewer features and landmarks.
/// `rig` states its uncertainty, of which each sequence draws. `progress` hears of each sequence.
///
/// # Errors
/// The rig states no uncertainty.
pub fn run_corrupted(
    rig: &StereoRig,
    config: &Config,
    kinds: &[Corruption],
    runs: u64,
    seed: u64,
    progress: &(dyn Fn(u64) + Sync),
) -> Result<CorruptedOutcome, MonteCarloError> {
    let settings = Settings {
        rig_error: RigError::Considered,
        ..Settings::default()
    };
    let Some(rigs) = RigDraw::new(rig, &settings)? else {
        return Err(MonteCarloError::NoRigUncertainty);
    };
    let mut config = config.clone();
    let features = &mut config.features.surf.budget;
    *features = FEATURES.min(*features);
    let landmarks = &mut config.estimation.max_landmarks;
    *landmarks = LANDMARKS.min(*landmarks);
    let mut outcome = CorruptedOutcome {
        kinds: kinds.iter().map(|kind| (*kind, Tally::default())).collect(),
        wrong: Vec::new(),
    };
    for_each_run(
        runs,
        |run| {
            let seen = rigs.draw(rig, &mut rng_of_run(seed, STAGE, run));
            let film = Film::new(&seen, &config, run, seed)?;
            let follow =
                |kind: &Corruption| film.follow(rig, &config, *kind, [seed ^ *kind as u64, run]);
            kinds.iter().map(follow).collect::<Option<Vec<_>>>()
        },
        progress,
        |_, tallies: Option<Vec<(Tally, Vec<Wrong>)>>| {
            for ((_, sum), (tally, wrong)) in
                outcome.kinds.iter_mut().zip(tallies.into_iter().flatten())
            {
                sum.add(&tally);
                outcome.wrong.extend(wrong);
            }
        },
    );
    Ok(outcome)
}

/// A sequence without a fault, and what is found in it.
struct Film {
    pairs: Vec<StereoPair>,
    described: Vec<DescribedPair>,
    truth: Vec<Isometry3<f64>>,
    other_place: StereoPair,
}

impl Film {
    fn new(seen: &StereoRig, config: &Config, run: u64, seed: u64) -> Option<Self> {
        let of = |run: u64| {
            let sequences = [&SEQUENCES[..], &MORE_SEQUENCES].concat();
            let sequence = sequences[(run % sequences.len() as u64) as usize];
            rendered(sequence, seen.clone(), PAIRS as u64, seed.wrapping_add(run))
        };
        let simulation = of(run)?;
        let mut extractor = features::extractor(&config.features).ok()?;
        let mut film = Self {
            pairs: Vec::new(),
            described: Vec::new(),
            truth: Vec::new(),
            other_place: of(run + 1)?.pair(0).0,
        };
        for frame in 0..PAIRS as u64 {
            let (pair, truth) = simulation.pair(frame);
            let mut described = DescribedPair::default();
            described.describe(extractor.as_mut(), &pair).ok()?;
            film.pairs.push(pair);
            film.described.push(described);
            film.truth.push(truth);
        }
        Some(film)
    }

    /// The rows of the sequence with runs of corrupted pairs in it, judged.
    fn follow(
        &self,
        rig: &StereoRig,
        config: &Config,
        kind: Corruption,
        [seed, run]: [u64; 2],
    ) -> Option<(Tally, Vec<Wrong>)> {
        let mut rng = rng_of_run(seed, STAGE, run);
        let mut extractor = features::extractor(&config.features).ok()?;
        let (matching, estimation) = (config.matching.clone(), config.estimation.clone());
        let mut method =
            Method::new(rig.clone(), matching, estimation)?.watching_rig(&config.rig_watch);
        let material = Material {
            pairs: &self.pairs,
            other_place: &self.other_place,
        };
        let mut judge = Judge::new(kind, run);
        let mut described = DescribedPair::default();
        let mut next = WARM_UP;
        let mut index = 0;
        while index < PAIRS {
            let count = rng.random_range(1..=LONGEST);
            let is_spoilt = index == next && index + count + MAX_LAG < PAIRS;
            let mut spoiler = Spoiler::new(
                kind,
                material,
                [index.max(1), count],
                rng_of_run(seed + 1, STAGE, index as u64),
            );
            let last = if is_spoilt { index + count } else { index + 1 };
            for at in index..last {
                let truth = if is_spoilt {
                    let spoilt = spoiler.pair(at);
                    described.describe(extractor.as_mut(), &spoilt.pair).ok()?;
                    spoilt.truth
                } else {
                    described.clone_from(&self.described[at]);
                    at
                };
                let stamp = PairStamp {
                    sequence: described.sequence,
                    timestamp_ns: described.timestamp_ns,
                };
                let row = match method.step(&mut described) {
                    Ok(row) => row,
                    Err(_) => method.skip(stamp),
                };
                // A bridged pose is that of its stamp, whatever the images show.
                let truth = if row.status == Status::Lost && kind != Corruption::Reversed {
                    at
                } else {
                    truth
                };
                let begins = is_spoilt && at == index;
                judge.take(row, &self.truth[truth], is_spoilt, begins);
            }
            if is_spoilt {
                next = last + rng.random_range(REST[0]..=REST[1]);
            }
            index = last;
        }
        Some((judge.tally, judge.wrong))
    }
}

/// Holds rows against the truth.
struct Judge {
    kind: Corruption,
    run: u64,
    limit: f64,
    before: Option<Isometry3<f64>>,
    /// Where the odometry frame began.
    origin: Isometry3<f64>,
    since: Option<usize>,
    tally: Tally,
    wrong: Vec<Wrong>,
}

impl Judge {
    fn new(kind: Corruption, run: u64) -> Self {
        Self {
            kind,
            run,
            limit: chi2_quantile(1.0 - BEYOND_5_SIGMA, 6.0),
            before: None,
            origin: Isometry3::identity(),
            since: None,
            tally: Tally::default(),
            wrong: Vec::new(),
        }
    }

    fn take(&mut self, row: Odometry, truth: &Isometry3<f64>, is_corrupted: bool, begins: bool) {
        self.since = if begins {
            Some(0)
        } else {
            self.since.map(|since| since + 1)
        };
        // Until something has been tracked, a frame begins anew where the camera is.
        if row.status == Status::Initializing && row.epoch == 0 {
            self.origin = *truth;
        }
        let before = self.before.replace(*truth).unwrap_or(*truth);
        let tally = &mut self.tally;
        let pose_error = se3::error_fixed_axes(&row.odom_from_camera, &self.origin.inv_mul(truth));
        let motion_error = se3::error_fixed_axes(&row.prev_from_now, &before.inv_mul(truth));
        let pose = nees(&pose_error, &row.cov_pose);
        let motion = nees(&motion_error, &row.cov_motion);
        let twist = nees(&row.twist, &row.cov_twist);
        let (Some(pose), Some(motion), Some(_)) = (pose, motion, twist) else {
            tally.invalid += 1;
            return;
        };
        let Some(since) = self.since else { return };
        if is_corrupted {
            tally.corrupted += 1;
            tally.by_status[row.status as usize] += 1;
        }
        let wrong_pose = self.limit < pose || is_beyond(&pose_error, &row.cov_pose);
        let wrong_motion = self.limit < motion || is_beyond(&motion_error, &row.cov_motion);
        match row.status {
            Status::Tracking => {
                tally.tracking += 1;
                tally.nees_of_motions += motion;
                tally.nees_of_poses += pose;
                tally.wrong_poses += u64::from(wrong_pose);
                tally.wrong_motions += u64::from(wrong_motion);
            }
            Status::Degraded => {
                tally.degraded += 1;
                tally.wrong_degraded += u64::from(wrong_pose || wrong_motion);
            }
            Status::Initializing | Status::Lost => return,
        }
        if wrong_pose || wrong_motion {
            self.wrong.push(Wrong {
                kind: self.kind,
                run: self.run,
                since,
                is_corrupted,
                nees: [motion / 6.0, pose / 6.0],
                row,
            });
        }
    }
}

/// Whether an error is beyond 5 σ along an axis.
fn is_beyond(error: &Vector6<f64>, cov: &Matrix6<f64>) -> bool {
    (0..6).any(|i| error[i].abs() > 5.0 * cov[(i, i)].sqrt())
}
