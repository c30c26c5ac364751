//! `visod rig`: looks after calibration files.

use super::{Failure, rig_convert};
use crate::calibration::epipolar::{self, Fit, Match, Matcher};
use crate::capture::Dataset;
use crate::capture::dataset::ImageFiles;
use crate::capture::decode::Decoder;
use crate::geometry::{Finding, Severity, StereoRig, check_rig, load_rig};
use crate::image::GrayImage;
use std::path::{Path, PathBuf};

/// Pairs of a recording that a rig is held against.
const PAIRS: usize = 6;

/// Look after calibration files.
#[derive(clap::Args)]
#[command(after_help = "Example: visod rig check rig.toml")]
pub(crate) struct Args {
    #[command(subcommand)]
    command: Command,
}

#[derive(clap::Subcommand)]
enum Command {
    /// Find what cannot be right in a rig file, by itself or against images.
    #[command(after_help = "Example: visod rig check rig.toml --images recording")]
    Check {
        /// The rig file.
        rig: PathBuf,
        /// A recording that the rig is said to belong to: features are matched and held against it.
        #[arg(long, value_name = "DATASET")]
        images: Option<PathBuf>,
        /// Print the findings as JSON.
        #[arg(long)]
        json: bool,
    },
    Convert(rig_convert::Args),
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    match &args.command {
        Command::Check { rig, images, json } => check(rig, images.as_deref(), *json),
        Command::Convert(args) => rig_convert::run(args),
    }
}

/// Prints the findings; one of severity `error` makes the command fail as bad configuration does.
fn check(path: &Path, images: Option<&Path>, json: bool) -> Result<(), Failure> {
    let rig = load_rig(path).map_err(Failure::usage)?;
    let mut findings = check_rig(&rig);
    let fit = match images {
        None => None,
        Some(images) => {
            let (fit, found) = against_images(&rig, images)?;
            findings.extend(found);
            fit
        }
    };
    if json {
        let text = serde_json::to_string_pretty(&findings).map_err(Failure::other)?;
        println!("{text}");
    } else {
        findings.iter().for_each(print);
        if findings.is_empty() {
            println!(
                "{}: plausible: baseline {:.4} m, {}×{} and {}×{} px",
                path.display(),
                rig.baseline_m(),
                rig.left.width,
                rig.left.height,
                rig.right.width,
                rig.right.height
            );
        }
        if let Some(fit) = fit {
            println!(
                "images: {:.0} % of {} matches agree, {:.2} px from their epipolar lines (median)",
                100.0 * fit.share,
                fit.matches,
                fit.median_px
            );
        }
    }
    let errors = findings
        .iter()
        .filter(|f| f.severity == Severity::Error)
        .count();
    if errors > 0 {
        return Err(Failure::usage(format!(
            "{}: {errors} of its values cannot be right",
            path.display()
        )));
    }
    Ok(())
}

pub(super) fn print(finding: &Finding) {
    let severity = match finding.severity {
        Severity::Warning => "warning",
        Severity::Error => "error",
    };
    println!("{severity}: {}: {}", finding.key, finding.message);
}

/// Matches features of a few pairs, spread over the recording, and holds the rig against them.
fn against_images(
    rig: &StereoRig,
    recording: &Path,
) -> Result<(Option<Fit>, Vec<Finding>), Failure> {
    let dataset = Dataset::open(recording, Some(rig.clone())).map_err(Failure::usage)?;
    let files: Vec<_> = dataset
        .pairs
        .iter()
        .filter_map(|pair| match &pair.images {
            ImageFiles::Both { left, right } => Some([left, right]),
            ImageFiles::Unpaired { .. } => None,
        })
        .collect();
    let stride = files.len().div_ceil(PAIRS).max(1);
    let mut matcher = Matcher::new().map_err(|e| Failure::other(e.cause))?;
    let mut decoder = Decoder::new(dataset.settings.white_level);
    let mut matches: Vec<Match> = Vec::new();
    let mut last = None;
    for pair in files.into_iter().step_by(stride) {
        let mut images = [GrayImage::default(), GrayImage::default()];
        let decoded = pair
            .iter()
            .zip(&mut images)
            .try_for_each(|(file, image)| decoder.decode(file, None, image));
        if let Err(cause) = decoded {
            // One image that cannot be read is no reason not to look at the others.
            last = Some(cause.to_string());
            continue;
        }
        let sizes = [&images[0], &images[1]].map(|image| (image.width(), image.height()));
        let findings = epipolar::check_size(rig, sizes);
        if !findings.is_empty() {
            return Ok((None, findings));
        }
        matcher
            .add(&images[0], &images[1], &mut matches)
            .map_err(Failure::other)?;
    }
    if let (true, Some(cause)) = (matches.is_empty(), last) {
        return Err(Failure::other(cause));
    }
    let (fit, findings) = epipolar::check(rig, &matches);
    Ok((Some(fit), findings))
}
