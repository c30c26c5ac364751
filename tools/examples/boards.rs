//! Renders a chessboard before the two cameras of a rig, for `visod calibrate` without any hardware:
//!
//!     cargo run --release --example boards -- rig.toml boards 50
//!
//! writes boards/left and boards/right: 9×6 inner corners, squares of 40 mm.

use std::path::Path;
use std::process::ExitCode;
use visod::calibration::simulated::{image, placements};
use visod::calibration::{Board, Pattern};
use visod::geometry::load_rig;
use visod::image::GrayImage;

/// 1 σ of the images' noise, grey levels.
const SIGMA_GREY: f64 = 1.5;
/// The seed of placements and noise.
const SEED: u64 = 1;

fn main() -> ExitCode {
    match run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(cause) => {
            eprintln!("boards: {cause}");
            ExitCode::FAILURE
        }
    }
}

fn run() -> Result<(), Box<dyn std::error::Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let [rig, out, count] = args.as_slice() else {
        return Err("wanted: RIG OUT COUNT".into());
    };
    let rig = load_rig(Path::new(rig))?;
    let board = Board {
        pattern: Pattern::Chessboard,
        columns: 9,
        rows: 6,
        square_m: 0.04,
        sigma_square_m: 0.0,
    };
    let folders = ["left", "right"].map(|side| Path::new(out).join(side));
    for folder in &folders {
        std::fs::create_dir_all(folder)?;
    }
    for (i, left_from_board) in placements(&rig, &board, count.parse()?, SEED)
        .iter()
        .enumerate()
    {
        let right_from_board = rig.right_from_left * left_from_board;
        let seed = SEED + 2 * i as u64;
        let images = [
            image(&rig.left, left_from_board, &board, SIGMA_GREY, seed),
            image(&rig.right, &right_from_board, &board, SIGMA_GREY, seed + 1),
        ];
        for (folder, image) in folders.iter().zip(&images) {
            std::fs::write(folder.join(format!("{i:03}.pgm")), pgm(image))?;
        }
    }
    Ok(())
}

/// The image as a PGM file.
fn pgm(image: &GrayImage) -> Vec<u8> {
    let mut bytes = format!("P5\n{} {}\n255\n", image.width(), image.height()).into_bytes();
    bytes.extend_from_slice(image.pixels());
    bytes
}
