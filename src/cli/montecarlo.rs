//! `visod montecarlo`: first-order covariances against the errors of many runs.

use super::{Failure, progress};
use crate::estimation::MotionModel;
use crate::estimation::two_frame::Estimator;
use crate::geometry::{StereoRig, load_rig};
use crate::montecarlo::{
    Correlation, MonteCarloError, Outcomes, RigError, Settings, figure_files, run_images,
    run_motion, run_odometry, run_triangulation, summary_text, to_csv, to_json,
};
use crate::simulation::{points::PixelNoise, small_rig, thesis_rig};
use std::path::PathBuf;

/// Hold first-order covariances against the errors of many simulated runs.
///
/// Landmarks are drawn once, and every run measures them anew. Printed are the ANEES (average
/// normalised squared error; 1 is honest, above is overconfident, below pessimistic) with the
/// interval in which it should lie, how many errors the 95 % ellipsoid covers, σ by first order and
/// by Monte Carlo with the ratio of their traces, and how far the errors are above the Cramér–Rao
/// bound: of a motion that of its own two pairs, of a path that of all its pairs at once.
#[derive(clap::Args)]
#[command(after_help = "\
Example: visod montecarlo --runs 1000 -o montecarlo
         visod montecarlo --stage motion --method svd --model planar
         visod montecarlo --stage odometry --survival 0.5 --noise student --freedom 5
         visod montecarlo --stage images --method window --runs 50 --steps 50")]
pub(crate) struct Args {
    /// Pixels to points, points to a motion, motions to a path, all three otherwise; or whole image
    /// sequences, rendered in several scenes.
    #[arg(long, value_enum)]
    stage: Option<Stage>,
    /// Motions of any kind, or on flat ground: x, y and heading.
    #[arg(long, value_enum, default_value_t = Settings::default().model)]
    model: MotionModel,
    /// The estimator; motions of their own are bundle-adjusted where it is the window.
    #[arg(long, value_enum, default_value_t = Method::Bundle)]
    method: Method,
    /// The rig, from a rig.toml [default: the thesis' two cameras of 1280×960 pixels; for images two
    /// of 320×240].
    #[arg(long, value_name = "FILE")]
    rig: Option<PathBuf>,
    /// How many runs.
    #[arg(long, value_name = "N", default_value_t = Settings::default().runs)]
    runs: u64,
    /// What landmarks and noise are drawn from: the same seed gives the same bits.
    #[arg(long, value_name = "S", default_value_t = Settings::default().seed)]
    seed: u64,
    /// Features that a motion rests on.
    #[arg(long, value_name = "N", default_value_t = Settings::default().features)]
    features: usize,
    /// Depths at which landmarks appear, m.
    #[arg(
        long,
        value_name = "NEAR,FAR",
        value_delimiter = ',',
        num_args = 1,
        default_value = "2,40"
    )]
    depth: Vec<f64>,
    /// Keyframes in the window, where the method is one.
    #[arg(long, value_name = "N", default_value_t = Settings::default().keyframes)]
    keyframes: u32,
    /// Chance that a feature of one motion serves the next one too.
    #[arg(long, value_name = "SHARE", default_value_t = Settings::default().survival)]
    survival: f64,
    /// Motions of a path.
    #[arg(long, value_name = "N", default_value_t = Settings::default().steps)]
    steps: usize,
    /// Length of a motion, m.
    #[arg(long, value_name = "M", default_value_t = Settings::default().step_m)]
    step: f64,
    /// Turn of a motion, deg, to the left.
    #[arg(long, value_name = "DEG", default_value_t = -0.9, allow_negative_numbers = true)]
    turn: f64,
    /// How measured pixels deviate.
    #[arg(long, value_enum, default_value_t = Noise::Gaussian)]
    noise: Noise,
    /// Standard deviation of the pixels (of Student's t: its scale), px.
    #[arg(long, value_name = "PX", default_value_t = 0.5)]
    sigma_px: f64,
    /// Degrees of freedom of Student's t.
    #[arg(long, value_name = "NU", default_value_t = 5.0)]
    freedom: f64,
    /// Share of the sights that are outliers, for a mixture.
    #[arg(long, value_name = "SHARE", default_value_t = 0.02)]
    outliers: f64,
    /// Standard deviation of outliers, px.
    #[arg(long, value_name = "PX", default_value_t = 5.0)]
    outlier_sigma_px: f64,
    /// Largest scale of a feature over the smallest: deviations grow with it.
    #[arg(long, value_name = "RATIO", default_value_t = Settings::default().scales)]
    scales: f64,
    /// Share of a feature's noise that stays with it from pair to pair.
    #[arg(long, value_name = "SHARE", default_value_t = Settings::default().persistence)]
    persistence: f64,
    /// Standard deviation that the estimator is told, px [default: the true one].
    #[arg(long, value_name = "PX")]
    stated_sigma_px: Option<f64>,
    /// Draw an error of the rig in each run from the uncertainty that its file states.
    #[arg(long, value_enum, default_value_t = Settings::default().rig_error)]
    rig_error: RigError,
    /// Largest squared residual of a track that counts, σ².
    #[arg(long, value_name = "SIGMA2", default_value_t = Settings::default().gate_sigma2)]
    gate: f64,
    /// What is assumed of consecutive motions, which share pixels.
    #[arg(long, value_enum, default_value_t = Settings::default().correlation)]
    correlation: Correlation,
    /// Threads [default: one a core].
    #[arg(long, value_name = "N")]
    threads: Option<usize>,
    /// Print every verdict as JSON.
    #[arg(long)]
    json: bool,
    /// A folder to write montecarlo.csv, the figures as SVG and montecarlo.html to.
    #[arg(short, long, value_name = "DIR")]
    output: Option<PathBuf>,
}

#[derive(Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Stage {
    /// Pixels to points.
    Triangulation,
    /// Points to one motion.
    Motion,
    /// Motions to a path.
    Odometry,
    /// Rendered images to a path, through the whole pipeline.
    Images,
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum Noise {
    /// Normal.
    Gaussian,
    /// Student's t: heavier tails.
    Student,
    /// Normal but for a share of outliers.
    Mixture,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let rig = match &args.rig {
        Some(file) => load_rig(file).map_err(Failure::usage)?,
        None if args.stage == Some(Stage::Images) => small_rig(),
        None => thesis_rig(),
    };
    let settings = args.settings()?;
    if args.threads == Some(0) {
        return Err(Failure::usage("--threads must be at least 1"));
    }
    let mut pool = rayon::ThreadPoolBuilder::new();
    if let Some(threads) = args.threads {
        pool = pool.num_threads(threads);
    }
    let pool = pool.build().map_err(Failure::other)?;
    let outcomes = pool
        .install(|| run_stages(args, &rig, &settings))
        .map_err(failure)?;
    if args.json {
        println!("{}", to_json(&outcomes).map_err(Failure::other)?);
    } else {
        print!("{}", summary_text(&outcomes));
    }
    if let Some(folder) = &args.output {
        std::fs::create_dir_all(folder).map_err(|e| unwritable(folder, &e))?;
        let file = folder.join("montecarlo.csv");
        std::fs::write(&file, to_csv(&outcomes)).map_err(|e| unwritable(&file, &e))?;
        for figure in figure_files(&outcomes, &settings) {
            let file = folder.join(figure.name);
            std::fs::write(&file, figure.content).map_err(|e| unwritable(&file, &e))?;
        }
    }
    Ok(())
}

fn run_stages(
    args: &Args,
    rig: &StereoRig,
    settings: &Settings,
) -> Result<Outcomes, MonteCarloError> {
    let wanted = |stage: Stage| args.stage.is_none_or(|only| only == stage);
    let stages = [Stage::Triangulation, Stage::Motion, Stage::Odometry];
    let count = stages.iter().filter(|s| wanted(**s)).count().max(1) as u64;
    let bar = progress::runs(count * settings.runs);
    let progress = |runs: u64| bar.inc(runs);
    let mut outcomes = Outcomes::default();
    if wanted(Stage::Triangulation) {
        outcomes.triangulation = Some(run_triangulation(rig, settings, &progress)?);
    }
    if wanted(Stage::Motion) {
        outcomes.motion = Some(run_motion(rig, settings, &progress)?);
    }
    if wanted(Stage::Odometry) {
        outcomes.odometry = Some(run_odometry(rig, settings, &progress)?);
    }
    if args.stage == Some(Stage::Images) {
        outcomes.images = Some(run_images(rig, settings, &progress)?);
    }
    bar.finish_and_clear();
    Ok(outcomes)
}

/// The flag that sets a setting.
fn flag_of(key: &str) -> String {
    match key {
        "noise.sigma_px" | "noise.scale_px" => "sigma-px".to_owned(),
        "noise.degrees_of_freedom" => "freedom".to_owned(),
        "noise.share" => "outliers".to_owned(),
        "noise.outlier_sigma_px" => "outlier-sigma-px".to_owned(),
        other => other.replace(' ', "-"),
    }
}

fn unwritable(path: &std::path::Path, cause: &std::io::Error) -> Failure {
    Failure::other(format!("{}: cannot be written: {cause}", path.display()))
}

fn failure(error: MonteCarloError) -> Failure {
    match error {
        MonteCarloError::NoEstimates(..) => Failure::other(error),
        _ => Failure::usage(error),
    }
}

/// Which estimator is tried out.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Method {
    /// Closed form on triangulated points, as the thesis has it: simple, and coarse.
    Svd,
    /// Triangulated points weighted by their own covariances.
    Weighted,
    /// Reprojection bundle adjustment in the images, from pair to pair.
    Bundle,
    /// Bundle adjustment over a window of keyframes, as the pipeline does it.
    Window,
}

impl Method {
    fn of_motions(self) -> Estimator {
        match self {
            Self::Svd => Estimator::Svd,
            Self::Weighted => Estimator::Weighted,
            Self::Bundle | Self::Window => Estimator::Bundle,
        }
    }
}

impl Args {
    fn settings(&self) -> Result<Settings, Failure> {
        let [near, far] = self.depth[..] else {
            return Err(Failure::usage("--depth must be two numbers, NEAR,FAR"));
        };
        let settings = Settings {
            runs: self.runs,
            seed: self.seed,
            model: self.model,
            estimator: self.method.of_motions(),
            windowed: self.method == Method::Window,
            keyframes: self.keyframes,
            features: self.features,
            depth_m: [near, far],
            survival: self.survival,
            steps: self.steps,
            step_m: self.step,
            turn_rad: self.turn.to_radians(),
            noise: self.noise(),
            scales: self.scales,
            persistence: self.persistence,
            stated_sigma_px: self.stated_sigma_px,
            rig_error: self.rig_error,
            gate_sigma2: self.gate,
            correlation: self.correlation,
        };
        settings
            .check()
            .map_err(|e| Failure::usage(format!("--{}: {}", flag_of(e.key), e.cause)))?;
        Ok(settings)
    }

    fn noise(&self) -> PixelNoise {
        match self.noise {
            Noise::Gaussian => PixelNoise::Gaussian {
                sigma_px: self.sigma_px,
            },
            Noise::Student => PixelNoise::StudentT {
                scale_px: self.sigma_px,
                degrees_of_freedom: self.freedom,
            },
            Noise::Mixture => PixelNoise::Outliers {
                sigma_px: self.sigma_px,
                share: self.outliers,
                outlier_sigma_px: self.outlier_sigma_px,
            },
        }
    }
}
