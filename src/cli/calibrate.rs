//! `visod calibrate`: images of a board in, a rig with its covariance out.

use super::Failure;
use super::calibrate_views::{Views, from_corners, from_images};
use crate::calibration::depth::{DEPTHS_M, depth_error};
use crate::calibration::{
    Board, Calibration, Lens, Pattern, Stage, calibrate, report, views_to_csv,
};
use crate::geometry::rig_parameters::rig_covariance_to_csv;
use crate::geometry::{RigUncertainty, rig_to_toml};
use std::path::{Path, PathBuf};

/// Find a rig, and how well it is known, from images of a flat board.
///
/// Both cameras' focal lengths, principal points, distortion and how they stand to each other are adjusted together.
/// Beside the rig file its covariance is written, `rig.cov.csv` for `rig.toml`, which names it. Views and points that
/// cannot be right are left out and named. Finding the board's points in images needs the feature `opencv`.
#[derive(clap::Args)]
#[command(
    after_help = "Example: visod calibrate --left left --right right --pattern 9x6 --square 0.025 -o rig.toml --report calibration.html"
)]
pub(crate) struct Args {
    /// The folder of the left camera's images.
    #[arg(long, value_name = "DIR", requires = "right", group = "source")]
    pub(super) left: Option<PathBuf>,
    /// The folder of the right camera's images, of the same names or in the same order.
    #[arg(long, value_name = "DIR", requires = "left")]
    pub(super) right: Option<PathBuf>,
    /// A recording of the board instead; it needs no rig.
    #[arg(long, value_name = "DIR", group = "source")]
    pub(super) recording: Option<PathBuf>,
    /// Two cameras instead, as this configuration names them: views are taken while the board is moved.
    #[arg(long, value_name = "FILE", requires = "size", group = "source")]
    pub(super) config: Option<PathBuf>,
    /// Points that were found before instead, as --save-corners writes them.
    #[arg(long, value_name = "FILE", requires = "size", group = "source")]
    pub(super) corners: Option<PathBuf>,
    /// The images' size, where no image tells: WIDTHxHEIGHT, px.
    #[arg(long, value_name = "WxH", value_parser = size)]
    pub(super) size: Option<(u32, u32)>,
    /// Inner corners (or circles) in a row, and rows: COLUMNSxROWS.
    #[arg(long, value_name = "CxR", value_parser = size)]
    pattern: (u32, u32),
    /// What is printed on the board.
    #[arg(long, value_enum, default_value_t = BoardName::Chessboard)]
    board: BoardName,
    /// The side of a square, or the distance of neighbouring circles, m; of asymmetric circles, of neighbouring rows.
    #[arg(long, value_name = "M")]
    square: f64,
    /// 1 σ of that length, m, as the mean over the board: the baseline is no better known.
    #[arg(long, value_name = "M", default_value_t = 0.0)]
    square_sigma: f64,
    /// The lens model, with its number of coefficients.
    #[arg(long, value_enum, default_value_t = LensName::Radtan5)]
    lens: LensName,
    /// Most views that are taken from cameras.
    #[arg(long, value_name = "N", default_value_t = 30)]
    pub(super) views: usize,
    /// The rig file.
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Write one self-contained HTML page about the calibration.
    #[arg(long, value_name = "FILE")]
    report: Option<PathBuf>,
    /// Write the points that were found, for another time.
    #[arg(long, value_name = "FILE")]
    save_corners: Option<PathBuf>,
    /// Print the result as JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum BoardName {
    Chessboard,
    Circles,
    AsymmetricCircles,
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum LensName {
    None,
    Radtan4,
    Radtan5,
    Radtan8,
    Equidistant,
}

/// Two whole numbers with an x between.
pub(super) fn size(text: &str) -> Result<(u32, u32), String> {
    let numbers = text.split_once(['x', 'X', '×']);
    let parsed = numbers.and_then(|(a, b)| Some((a.trim().parse().ok()?, b.trim().parse().ok()?)));
    parsed.ok_or_else(|| "two whole numbers with an x between are wanted, such as 9x6".to_owned())
}

impl Args {
    fn board(&self) -> Result<Board, Failure> {
        let board = Board {
            pattern: match self.board {
                BoardName::Chessboard => Pattern::Chessboard,
                BoardName::Circles => Pattern::Circles,
                BoardName::AsymmetricCircles => Pattern::AsymmetricCircles,
            },
            columns: self.pattern.0,
            rows: self.pattern.1,
            square_m: self.square,
            sigma_square_m: self.square_sigma,
        };
        let flag = |key: &str| match key {
            "square_m" => "--square",
            "sigma_square_m" => "--square-sigma",
            _ => "--pattern",
        };
        board
            .check()
            .map_err(|e| Failure::usage(format!("{}: {}", flag(e.key), e.cause)))?;
        Ok(board)
    }

    fn lens(&self) -> Lens {
        match self.lens {
            LensName::None => Lens::None,
            LensName::Radtan4 => Lens::Radtan4,
            LensName::Radtan5 => Lens::Radtan5,
            LensName::Radtan8 => Lens::Radtan8,
            LensName::Equidistant => Lens::Equidistant,
        }
    }
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let board = args.board()?;
    let views = match &args.corners {
        Some(file) => from_corners(file, args.size, &board)?,
        None => from_images(args, &board, args.lens())?,
    };
    if let Some(file) = &args.save_corners {
        write(file, &views_to_csv(&views.views))?;
    }
    for what in &views.notes {
        eprintln!("visod: {what}");
    }
    let bar = super::progress::steps();
    let found = calibrate(
        &board,
        &views.views,
        views.size_px,
        args.lens(),
        &mut |stage| {
            bar.tick();
            bar.set_message(match stage {
                Stage::Start => "seeking a start".to_owned(),
                Stage::Adjust { round } => format!("adjusting, round {round}"),
                Stage::Covariance => "covariance".to_owned(),
            });
        },
    );
    bar.finish_and_clear();
    let mut found = found.map_err(Failure::other)?;
    write_rig(&args.output, &mut found)?;
    if let Some(file) = &args.report {
        write(file, &report::render(&found, &views.not_seen))?;
    }
    print(args, &found, &views)
}

/// Writes the rig, and beside it its covariance, whose file the rig names.
fn write_rig(output: &Path, found: &mut Calibration) -> Result<(), Failure> {
    let covariance_file = output.with_extension("cov.csv");
    let name = covariance_file.file_name().unwrap_or_default();
    found.rig.uncertainty = Some(RigUncertainty::Covariance {
        file: name.into(),
        covariance: Box::new(found.covariance),
    });
    write(
        &covariance_file,
        &rig_covariance_to_csv(&found.rig, &found.covariance),
    )?;
    write(output, &rig_to_toml(&found.rig))
}

fn write(file: &Path, text: &str) -> Result<(), Failure> {
    std::fs::write(file, text)
        .map_err(|e| Failure::other(format!("{}: cannot be written: {e}", file.display())))
}

/// A parameter with its 1 σ.
#[derive(serde::Serialize)]
struct Parameter {
    name: String,
    value: f64,
    sigma: f64,
}

fn parameters(found: &Calibration) -> Vec<Parameter> {
    report::parameters(found)
        .into_iter()
        .map(|(name, value, sigma)| Parameter { name, value, sigma })
        .collect()
}

fn print(args: &Args, found: &Calibration, views: &Views) -> Result<(), Failure> {
    let depths: Vec<_> = DEPTHS_M
        .iter()
        .filter_map(|&depth_m| depth_error(&found.rig, &found.covariance, depth_m))
        .collect();
    if args.json {
        let all = serde_json::json!({
            "rig": args.output,
            "views": found.views.iter().map(|v| serde_json::json!({"view": v.name, "rms_px": v.rms_px})).collect::<Vec<_>>(),
            "board_not_seen": views.not_seen,
            "views_left_out": found.left_out,
            "points": found.residuals.len(),
            "points_left_out": found.outliers,
            "rms_left_px": found.rms_px[0],
            "rms_right_px": found.rms_px[1],
            "rms_px": found.rms_px[2],
            "sigma_px": found.sigma_px,
            "between_views": found.between_views,
            "covariance_inflated": found.is_inflated,
            "baseline_m": found.rig.baseline_m(),
            "parameters": parameters(found),
            "depth_errors": depths,
            "advice": found.advice(),
        });
        println!(
            "{}",
            serde_json::to_string_pretty(&all).map_err(Failure::other)?
        );
        return Ok(());
    }
    println!(
        "{}: {} views, {} points; rms {:.4} px (left {:.4}, right {:.4}); a point's σ {:.4} px",
        args.output.display(),
        found.views.len(),
        found.residuals.len(),
        found.rms_px[2],
        found.rms_px[0],
        found.rms_px[1],
        found.sigma_px
    );
    for name in &views.not_seen {
        println!("board not found: {name}");
    }
    for out in &found.left_out {
        println!("left out: view {}: {}", out.view, out.why);
    }
    for out in &found.outliers {
        println!(
            "left out: point {} of the {} image of {}: {:.2} px off",
            out.point, out.side, out.view, out.miss_px
        );
    }
    for parameter in parameters(found) {
        println!(
            "{:>9} {:>14.6} ± {:.2e}",
            parameter.name, parameter.value, parameter.sigma
        );
    }
    println!("depth, m          σ by calibration, m    σ by 0.1 px, m");
    for depth in depths {
        println!(
            "{:>8.0} {:>25.4} {:>17.4}",
            depth.depth_m, depth.sigma_rig_m, depth.sigma_tenth_px_m
        );
    }
    for advice in found.advice() {
        println!("advice: {advice}");
    }
    Ok(())
}
