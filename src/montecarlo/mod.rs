//! Monte Carlo: a rig, a motion and a noise model in; how well first-order covariances cover the
//! errors of many runs out.
//!
//! Landmarks are drawn once; every run measures the same ones anew. So the runs' errors are a
//! sample of exactly the distribution that a covariance claims to describe (thesis §4.5). The same
//! seed gives the same bits, whatever the number of threads: each run has random numbers of its
//! own, and sums are taken in the order of the runs.
//!
//! | module | makes |
//! |---|---|
//! | `settings` | what is simulated, checked |
//! | `world` | landmarks and the path; their noisy sights, run by run |
//! | `triangulation`, `motion`, `odometry` | the three stages of the thesis |
//! | `images` | a fourth: rendered sequences through the whole pipeline |
//! | `corrupted` | such sequences with corrupted pairs in them |
//! | [`estimator`] | what the odometry stage tries out: any [`FrameEstimator`] |
//! | `chain` | such an estimator: two-frame motions, chained with their correlation |
//! | `window` | another: the window of keyframes that the pipeline runs |
//! | `bound` | the least variance that any unbiased estimator can have |
//! | [`verdict`] | trace ratio, ANEES, coverage |
//! | `table`, `figures`, `page` | CSV and text, SVG, HTML |

mod bound;
mod chain;
mod corrupted;
mod ellipse;
pub mod estimator;
mod figures;
mod images;
mod motion;
mod odometry;
mod page;
mod settings;
mod table;
#[cfg(test)]
mod tests;
mod triangulation;
pub mod verdict;
mod window;
mod world;

pub use chain::TwoFrameChain;
pub use corrupted::{CorruptedOutcome, Tally as CorruptedTally, Wrong as WrongRow, run_corrupted};
pub use estimator::{FrameEstimate, FrameEstimator, TrackedSight};
pub use images::{ImagesOutcome, SEQUENCES, Sequence, run_images};
pub use motion::{MotionOutcome, run_motion};
pub use odometry::{OdometryOutcome, run_odometry, run_odometry_with};
pub use page::{FigureFile, figure_files};
pub use settings::{Correlation, RigError, Settings};
pub use table::{Outcomes, summary_text, to_csv, to_json};
pub use triangulation::{PointOutcome, TriangulationOutcome, run_triangulation};
pub use verdict::Verdict;
pub use window::WindowOdometry;

use crate::settings::SettingError;
use rand::SeedableRng;
use rand_xoshiro::Xoshiro256PlusPlus;
use rayon::prelude::*;

/// Why an experiment could not be made.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum MonteCarloError {
    /// A setting that cannot be used.
    #[error("{}: {}", .0.key, .0.cause)]
    Setting(SettingError),
    /// The rig does not see what it should measure.
    #[error(
        "the rig sees too few landmarks at depths of {near_m} to {far_m} m in both cameras {when}"
    )]
    NothingToSee {
        /// Depths that were tried, m.
        near_m: String,
        /// Likewise.
        far_m: String,
        /// In which circumstances.
        when: &'static str,
    },
    /// The rig file does not say how well its parameters are known.
    #[error(
        "the rig states no uncertainty of its parameters, so that no error of them can be drawn"
    )]
    NoRigUncertainty,
    /// The estimator failed in nearly every run.
    #[error("only {0} runs of {1} gave an estimate: there is nothing to compare")]
    NoEstimates(usize, usize),
}

impl From<SettingError> for MonteCarloError {
    fn from(error: SettingError) -> Self {
        Self::Setting(error)
    }
}

/// Runs that are computed before their results are summed up: bounds memory, not the result.
const RUNS_AT_ONCE: u64 = 256;

/// The random numbers of one run.
fn rng_of_run(seed: u64, stage: u64, run: u64) -> Xoshiro256PlusPlus {
    // Far apart for neighbours, so that the generator's own seeding does not meet itself.
    let mixed = (seed ^ stage.rotate_left(48))
        .wrapping_mul(0xD134_2543_DE82_EF95)
        .wrapping_add(run.wrapping_mul(0xA076_1D64_78BD_642F));
    Xoshiro256PlusPlus::seed_from_u64(mixed ^ (mixed >> 29))
}

/// Computes runs on all threads and folds their results in order.
fn for_each_run<R: Send>(
    runs: u64,
    compute: impl Fn(u64) -> R + Sync,
    progress: &(dyn Fn(u64) + Sync),
    mut fold: impl FnMut(u64, R),
) {
    let mut first = 0;
    while first < runs {
        let last = (first + RUNS_AT_ONCE).min(runs);
        let results: Vec<R> = (first..last)
            .into_par_iter()
            .map(|run| {
                let result = compute(run);
                progress(1);
                result
            })
            .collect();
        for (run, result) in (first..last).zip(results) {
            fold(run, result);
        }
        first = last;
    }
}
