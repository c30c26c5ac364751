//! `visod report`: one HTML page about a run.

use super::Failure;
use crate::evaluation::{
    Estimate, Settings, Trajectory, read_body_from_camera, read_estimate, read_trajectory,
};
use crate::output::report::render;
use std::path::{Path, PathBuf};

/// Write one self-contained HTML page about a run.
#[derive(clap::Args)]
#[command(
    after_help = "Example: visod report odometry.csv --ground-truth poses.txt -o report.html"
)]
pub(crate) struct Args {
    /// The odometry CSV.
    #[arg(value_name = "ODOMETRY")]
    odometry: PathBuf,
    /// The true poses, in KITTI, TUM or EuRoC form, as their content says.
    #[arg(long, value_name = "FILE")]
    ground_truth: Option<PathBuf>,
    /// EuRoC's sensor.yaml of the left camera: its T_BS says where the camera sits in the body
    /// whose poses are the truth.
    #[arg(long, value_name = "FILE", requires = "ground_truth")]
    sensor: Option<PathBuf>,
    /// Largest difference in time between an estimate and its true pose, s.
    #[arg(long, value_name = "S", default_value_t = 0.01)]
    max_difference: f64,
    /// What the page is called; the odometry's name otherwise.
    #[arg(long)]
    title: Option<String>,
    /// The page.
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    if !(0.0..=1e6).contains(&args.max_difference) {
        return Err(Failure::usage(format!(
            "--max-difference must be from 0 to 1e6, but is {}",
            args.max_difference
        )));
    }
    let settings = Settings {
        max_difference_ns: (args.max_difference * 1e9).round() as i64,
        ..Settings::default()
    };
    let name = args.odometry.display();
    let Estimate::Odometry(rows) = read_estimate(&args.odometry).map_err(Failure::other)? else {
        return Err(Failure::other(format!(
            "{name}: is a plain trajectory, but a report needs an odometry CSV"
        )));
    };
    let truth = args
        .ground_truth
        .as_ref()
        .map(|path| true_poses(path, args.sensor.as_deref()))
        .transpose()?;
    let title = args.title.clone().unwrap_or_else(|| {
        let stem = args.odometry.file_stem().unwrap_or_default();
        format!("Odometry {}", stem.to_string_lossy())
    });
    let page = render(&rows, truth.as_ref(), &settings, &title)
        .map_err(|cause| Failure::other(format!("{name}: {cause}")))?;
    std::fs::write(&args.output, page).map_err(|cause| {
        Failure::other(format!(
            "{}: cannot be written: {cause}",
            args.output.display()
        ))
    })
}

/// The true poses of the camera.
fn true_poses(path: &Path, sensor: Option<&Path>) -> Result<Trajectory, Failure> {
    let truth = read_trajectory(path).map_err(Failure::other)?;
    match sensor {
        None => Ok(truth),
        Some(sensor) => {
            let body_from_camera = read_body_from_camera(sensor).map_err(Failure::other)?;
            Ok(truth.of_camera(&body_from_camera))
        }
    }
}
