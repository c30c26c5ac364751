//! Where the views of a calibration come from: images in folders, a recording, cameras, or a file of points.

use super::Failure;
use super::calibrate::Args;
use crate::calibration::{Board, Lens, View, views_from_csv};
use crate::text_file;
use std::path::Path;

/// Longest file of points that is read, bytes: a thousand views of a large board.
const MAX_BYTES: u64 = 256 << 20;

/// Views, and what is to be said of them.
pub(super) struct Views {
    pub(super) views: Vec<View>,
    pub(super) size_px: (u32, u32),
    /// Pairs in which no camera, or only one, saw the board.
    pub(super) not_seen: Vec<String>,
    /// What went wrong on the way, a sentence each.
    pub(super) notes: Vec<String>,
}

/// Points that were found before.
pub(super) fn from_corners(
    file: &Path,
    size_px: Option<(u32, u32)>,
    board: &Board,
) -> Result<Views, Failure> {
    let text = text_file::read(file, MAX_BYTES)
        .map_err(|why| Failure::usage(format!("{}: {why}", file.display())))?;
    let views = views_from_csv(&text, board)
        .map_err(|e| Failure::usage(format!("{}:{e}", file.display())))?;
    let size_px = size_px.ok_or_else(|| Failure::usage("--size: is missing"))?;
    Ok(Views {
        views,
        size_px,
        not_seen: Vec::new(),
        notes: Vec::new(),
    })
}

/// Without OpenCV nobody finds the board's points.
#[cfg(not(feature = "opencv"))]
pub(super) fn from_images(_: &Args, _: &Board, _: Lens) -> Result<Views, Failure> {
    Err(Failure::usage(
        "finding a board's points in images needs OpenCV, and this visod was built without the feature opencv; --corners takes points that were found elsewhere",
    ))
}

#[cfg(feature = "opencv")]
pub(super) use with_opencv::from_images;

#[cfg(feature = "opencv")]
mod with_opencv {
    use super::{Args, Board, Failure, Lens, Views};
    use crate::calibration::detect::{detect, view};
    use crate::calibration::folders::{ImagePair, of_recording, pairs};
    use crate::capture::decode::Decoder;
    use crate::cli::progress;
    use crate::image::GrayImage;
    use nalgebra::Vector2;
    use rayon::prelude::*;
    use std::path::Path;

    /// A board's points, and the image's size.
    type Found = (Option<Vec<Vector2<f64>>>, (u32, u32));

    pub(in crate::cli) fn from_images(
        args: &Args,
        board: &Board,
        lens: Lens,
    ) -> Result<Views, Failure> {
        if let Some(config) = &args.config {
            return crate::cli::calibrate_live::views(args, config, board, lens);
        }
        let [left, right] = match (&args.recording, &args.left, &args.right) {
            (Some(recording), ..) => of_recording(recording).map_err(Failure::usage)?,
            (None, Some(left), Some(right)) => [left.clone(), right.clone()],
            _ => {
                return Err(Failure::usage(
                    "where are the images? Give --left and --right, or --recording, --config or --corners",
                ));
            }
        };
        let (pairs, alone) = pairs(&left, &right).map_err(Failure::usage)?;
        let mut views = search(&pairs, board)?;
        let alone = alone
            .iter()
            .map(|file| format!("{}: has no partner", file.display()));
        views.notes.extend(alone);
        Ok(views)
    }

    /// Searches all images, as many at a time as there are cores.
    fn search(pairs: &[ImagePair], board: &Board) -> Result<Views, Failure> {
        let bar = progress::pairs(Some(pairs.len() as u64));
        let found: Vec<[Result<Found, String>; 2]> = pairs
            .par_iter()
            .map(|pair| {
                let [left, right] = &pair.files;
                let both = [in_file(left, board), in_file(right, board)];
                bar.inc(1);
                both
            })
            .collect();
        bar.finish_and_clear();
        let mut views = Views {
            views: Vec::new(),
            size_px: (0, 0),
            not_seen: Vec::new(),
            notes: Vec::new(),
        };
        for (pair, both) in pairs.iter().zip(found) {
            let mut points = [None, None];
            for (side, result) in both.into_iter().enumerate() {
                match result {
                    Err(cause) => views.notes.push(cause),
                    Ok((found, size_px)) => {
                        if views.size_px == (0, 0) {
                            views.size_px = size_px;
                        }
                        if size_px != views.size_px {
                            return Err(Failure::usage(format!(
                                "{}: has {}×{} px, but the first image has {}×{}",
                                pair.files[side].display(),
                                size_px.0,
                                size_px.1,
                                views.size_px.0,
                                views.size_px.1
                            )));
                        }
                        points[side] = found;
                    }
                }
            }
            let [left, right] = points;
            if left.is_none() || right.is_none() {
                views.not_seen.push(pair.name.clone());
            }
            if left.is_some() || right.is_some() {
                views.views.push(view(&pair.name, left, right, board));
            }
        }
        Ok(views)
    }

    fn in_file(file: &Path, board: &Board) -> Result<Found, String> {
        let mut image = GrayImage::default();
        Decoder::default()
            .decode(file, None, &mut image)
            .map_err(|e| e.to_string())?;
        let found = detect(&image, board).map_err(|e| format!("{}: {e}", file.display()))?;
        Ok((found, (image.width(), image.height())))
    }
}
