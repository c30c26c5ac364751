//! `visod rig convert`: other tools' calibrations in, a rig file out, and back.

use super::Failure;
use crate::calibration::formats::{FORMATS, Format, Hints, export, import};
use crate::geometry::rig_parameters::rig_covariance_to_csv;
use crate::geometry::{RigUncertainty, StereoRig, check_rig};
use std::path::{Path, PathBuf};

/// Convert a calibration from or to another tool's format.
///
/// The format is told by the files: OpenCV's YAML (one file or two), a pair of ROS camera_info, Kalibr's camchain, a
/// pair of EuRoC sensor.yaml, KITTI's calib.txt, values of the camera calibration toolbox for MATLAB, or a rig.toml.
#[derive(clap::Args)]
#[command(after_help = "Example: visod rig convert camchain.yaml -o rig.toml")]
pub(crate) struct Args {
    /// The calibration: one file, or two, left and right.
    #[arg(required = true, num_args = 1..=2)]
    files: Vec<PathBuf>,
    /// The file to write; a folder for formats with a file a camera.
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// The format of the calibration, where its files do not tell.
    #[arg(long, value_name = "FORMAT", value_parser = format)]
    from: Option<Format>,
    /// The format to write: visod, opencv, ros, kalibr, euroc, kitti or matlab.
    #[arg(long, value_name = "FORMAT", value_parser = format, default_value = "visod")]
    to: Format,
    /// The images' size, where the calibration does not state it: WIDTHxHEIGHT, px.
    #[arg(long, value_name = "WxH", value_parser = super::calibrate::size)]
    size: Option<(u32, u32)>,
    /// How many metres the calibration's unit of length has; 1, and 0.001 for MATLAB, where it is not given.
    #[arg(long, value_name = "M")]
    unit: Option<f64>,
}

fn format(name: &str) -> Result<Format, String> {
    let known = FORMATS.into_iter().find(|format| format.as_str() == name);
    known.ok_or_else(|| format!("is none of {}", FORMATS.map(Format::as_str).join(", ")))
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    if args
        .unit
        .is_some_and(|unit| !(unit.is_finite() && unit > 0.0))
    {
        return Err(Failure::usage("--unit: must be above 0 m"));
    }
    let hints = Hints {
        format: args.from,
        size_px: args.size,
        unit_m: args.unit,
    };
    let mut rig = import(&args.files, &hints).map_err(Failure::usage)?;
    if args.to == Format::Visod {
        write_covariance(&mut rig, &args.output)?;
    }
    for file in export(&rig, args.to).map_err(Failure::usage)? {
        let path = match file.name {
            "" => args.output.clone(),
            name => args.output.join(name),
        };
        if let Some(folder) = path.parent() {
            std::fs::create_dir_all(folder).map_err(|e| {
                Failure::other(format!("{}: cannot be made: {e}", folder.display()))
            })?;
        }
        write(&path, &file.text)?;
    }
    // What looks wrong is said, but the conversion was what was asked for.
    check_rig(&rig).iter().for_each(super::rig::print);
    Ok(())
}

/// A rig whose covariance stands in a file takes it along.
fn write_covariance(rig: &mut StereoRig, output: &Path) -> Result<(), Failure> {
    let Some(RigUncertainty::Covariance { covariance, .. }) = &rig.uncertainty else {
        return Ok(());
    };
    let covariance = covariance.clone();
    let path = output.with_extension("cov.csv");
    write(&path, &rig_covariance_to_csv(rig, &covariance))?;
    rig.uncertainty = Some(RigUncertainty::Covariance {
        file: path.file_name().unwrap_or_default().into(),
        covariance,
    });
    Ok(())
}

fn write(file: &Path, text: &str) -> Result<(), Failure> {
    std::fs::write(file, text)
        .map_err(|e| Failure::other(format!("{}: cannot be written: {e}", file.display())))
}
