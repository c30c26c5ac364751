//! `visod evaluate`: an estimate beside the truth.

use super::Failure;
use crate::evaluation::{
    Alignment, Settings, evaluate, read_body_from_camera, read_estimate, read_trajectory,
};
use std::path::PathBuf;

/// Compare an odometry or trajectory with ground truth: drift, pose errors, honesty of covariances.
#[derive(clap::Args)]
#[command(
    after_help = "Example: visod evaluate --ground-truth poses.txt --odometry odometry.csv --lengths 10,20,30,40,50"
)]
pub(crate) struct Args {
    /// The true poses, in KITTI, TUM or EuRoC form, as their content says.
    #[arg(long, value_name = "FILE")]
    ground_truth: PathBuf,
    /// What to evaluate: an odometry CSV, or a trajectory in one of the forms above, for which
    /// there are no covariances to judge.
    #[arg(long, value_name = "FILE")]
    odometry: PathBuf,
    /// Lengths of KITTI's segments, m.
    #[arg(
        long,
        value_delimiter = ',',
        default_value = "100,200,300,400,500,600,700,800"
    )]
    lengths: Vec<f64>,
    /// A segment begins every so many frames; KITTI's own program takes every tenth.
    #[arg(long, default_value_t = 1)]
    step: usize,
    /// Print the absolute error after this alignment only, rather than after each.
    #[arg(long, value_enum)]
    align: Option<AlignmentArg>,
    /// Largest difference in time between an estimate and its true pose, s.
    #[arg(long, value_name = "S", default_value_t = 0.01)]
    max_difference: f64,
    /// EuRoC's sensor.yaml of the left camera: its T_BS says where the camera sits in the body
    /// whose poses are the truth.
    #[arg(long, value_name = "FILE")]
    sensor: Option<PathBuf>,
    /// 1 σ per axis of the truth's own motions from frame to frame, m: added to what the motions'
    /// covariances must explain.
    #[arg(long, value_name = "M", default_value_t = 0.0)]
    truth_sigma_m: f64,
    /// The same of rotations, deg: one for every axis, or three, for x, y, z.
    #[arg(long, value_name = "DEG", value_delimiter = ',', default_value = "0")]
    truth_sigma_deg: Vec<f64>,
    /// 1 σ per axis of how the sensor that the truth is from is turned against the camera, deg: the
    /// same error in the direction of every motion.
    #[arg(long, value_name = "DEG", default_value_t = 0.0)]
    truth_sigma_mounting_deg: f64,
    /// Print everything as JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum AlignmentArg {
    /// As it is.
    None,
    /// First poses brought together.
    First,
    /// Least squares, rigid (Umeyama).
    Se3,
    /// Least squares with scale (Umeyama).
    Sim3,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let settings = settings(args)?;
    let estimate = read_estimate(&args.odometry).map_err(Failure::other)?;
    let mut truth = read_trajectory(&args.ground_truth).map_err(Failure::other)?;
    if let Some(sensor) = &args.sensor {
        truth = truth.of_camera(&read_body_from_camera(sensor).map_err(Failure::other)?);
    }
    let evaluation = evaluate(&estimate, &truth, &settings).map_err(|cause| {
        Failure::other(format!(
            "{} against {}: {cause}",
            args.odometry.display(),
            args.ground_truth.display()
        ))
    })?;
    if args.json {
        let text = serde_json::to_string_pretty(&evaluation).map_err(Failure::other)?;
        println!("{text}");
    } else {
        print!("{evaluation}");
    }
    Ok(())
}

fn settings(args: &Args) -> Result<Settings, Failure> {
    let positive = |x: f64| x > 0.0 && x.is_finite();
    if let Some(length) = args.lengths.iter().find(|&&length| !positive(length)) {
        return Err(Failure::usage(format!(
            "--lengths must be greater than 0 m, but one is {length}"
        )));
    }
    if args.step == 0 {
        return Err(Failure::usage("--step must be at least 1"));
    }
    let sigma_deg = match args.truth_sigma_deg[..] {
        [all] => [all; 3],
        [x, y, z] => [x, y, z],
        _ => {
            return Err(Failure::usage(
                "--truth-sigma-deg must be one number or three",
            ));
        }
    };
    for (flag, value) in [
        ("--max-difference", args.max_difference),
        ("--truth-sigma-m", args.truth_sigma_m),
        ("--truth-sigma-mounting-deg", args.truth_sigma_mounting_deg),
        ("--truth-sigma-deg", sigma_deg[0]),
        ("--truth-sigma-deg", sigma_deg[1]),
        ("--truth-sigma-deg", sigma_deg[2]),
    ] {
        if !(0.0..=1e6).contains(&value) {
            return Err(Failure::usage(format!(
                "{flag} must be from 0 to 1e6, but is {value}"
            )));
        }
    }
    let mut settings = Settings {
        lengths_m: args.lengths.clone(),
        step: args.step,
        max_difference_ns: (args.max_difference * 1e9).round() as i64,
        truth_sigma_m: args.truth_sigma_m,
        truth_sigma_rad: sigma_deg.map(f64::to_radians),
        truth_sigma_mounting_rad: args.truth_sigma_mounting_deg.to_radians(),
        ..Settings::default()
    };
    if let Some(align) = args.align {
        settings.alignments = vec![match align {
            AlignmentArg::None => Alignment::None,
            AlignmentArg::First => Alignment::First,
            AlignmentArg::Se3 => Alignment::Se3,
            AlignmentArg::Sim3 => Alignment::Sim3,
        }];
    }
    Ok(settings)
}
