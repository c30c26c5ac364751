//! Images in, views of the board out, by OpenCV.
//!
//! Corners are those of OpenCV's `findChessboardCorners` brought to a fraction of a pixel by `cornerSubPix`; circles
//! those of `findCirclesGrid`. Pixel centres are at integers in both.

use super::{Board, Pattern, SeenPoints, View};
use crate::image::GrayImage;
use nalgebra::Vector2;
use opencv::calib3d;
use opencv::core::{self, Mat, Point2f, Ptr, Size, TermCriteria, Vector};
use opencv::features2d::{Feature2D, SimpleBlobDetector, SimpleBlobDetector_Params};
use opencv::imgproc;

/// Half the window of the sub-pixel search as a share of the least distance of neighbouring corners: it must not
/// reach the next corner.
const WINDOW_SHARE: f64 = 0.3;
/// That half window's least and largest, px.
const WINDOW_PX: std::ops::RangeInclusive<i32> = 2..=6;
/// Turns and least step, px, of the sub-pixel search.
const SUBPIXEL_TURNS: i32 = 60;
const SUBPIXEL_STEP_PX: f64 = 1e-4;
/// No image longer than this is searched: larger ones are reduced, and corners then sought in the full image. A search
/// takes as the square of the corners that it meets, of which the noise of a large image has thousands: an image without
/// a board would take half a minute.
const SEARCHED_SIDE_PX: u32 = 1024;

/// Least and largest area of a circle, px²: OpenCV's own limits suit neither small nor large images.
const MIN_CIRCLE_PX2: f32 = 10.0;
const MAX_CIRCLE_PX2: f32 = 60_000.0;
/// Least distance of two circles, px: those that are nearer OpenCV takes for one.
const MIN_CIRCLE_DISTANCE_PX: f32 = 3.0;

/// Why an image could not be searched.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("OpenCV cannot search the image: {0}")]
pub struct DetectError(String);

impl From<opencv::Error> for DetectError {
    fn from(cause: opencv::Error) -> Self {
        Self(cause.message.replace('\n', " "))
    }
}

/// The board's points in one image, px, row by row; `None` where the board is not seen whole.
///
/// # Errors
/// OpenCV fails.
pub fn detect(image: &GrayImage, board: &Board) -> Result<Option<Vec<Vector2<f64>>>, DetectError> {
    let rows = i32::try_from(image.height()).map_err(|e| DetectError(e.to_string()))?;
    let columns = i32::try_from(image.width()).map_err(|e| DetectError(e.to_string()))?;
    if rows == 0 || columns == 0 {
        return Ok(None);
    }
    let mat = Mat::new_rows_cols_with_data(rows, columns, image.pixels())?;
    let size = Size::new(board.columns as i32, board.rows as i32);
    let found = match board.pattern {
        Pattern::Chessboard => corners(&mat, size, image.width().max(image.height()))?,
        Pattern::Circles => circles(&mat, size, calib3d::CALIB_CB_SYMMETRIC_GRID)?,
        Pattern::AsymmetricCircles => circles(&mat, size, calib3d::CALIB_CB_ASYMMETRIC_GRID)?,
    };
    let to_f64 = |p: Point2f| Vector2::new(f64::from(p.x), f64::from(p.y));
    Ok(found
        .filter(|found| found.len() == board.len())
        .map(|found| found.iter().map(to_f64).collect()))
}

fn circles(
    image: &impl core::ToInputArray,
    size: Size,
    flags: i32,
) -> Result<Option<Vector<Point2f>>, DetectError> {
    let mut centres = Vector::<Point2f>::new();
    let mut settings = SimpleBlobDetector_Params::default()?;
    settings.min_area = MIN_CIRCLE_PX2;
    settings.max_area = MAX_CIRCLE_PX2;
    settings.min_dist_between_blobs = MIN_CIRCLE_DISTANCE_PX;
    let blobs: Ptr<Feature2D> = SimpleBlobDetector::create(settings)?.into();
    let is_found = calib3d::find_circles_grid(image, size, &mut centres, flags, Some(&blobs))?;
    Ok(is_found.then_some(centres))
}

fn corners(
    image: &(impl core::ToInputArray + core::MatTraitConst),
    size: Size,
    side_px: u32,
) -> Result<Option<Vector<Point2f>>, DetectError> {
    let flags = calib3d::CALIB_CB_ADAPTIVE_THRESH
        | calib3d::CALIB_CB_NORMALIZE_IMAGE
        | calib3d::CALIB_CB_FAST_CHECK;
    let mut corners = Vector::<Point2f>::new();
    let mut is_found = false;
    for factor in reductions(side_px) {
        let mut reduced = Mat::default();
        let share = 1.0 / f64::from(factor);
        let size_px = Size::default();
        imgproc::resize(
            image,
            &mut reduced,
            size_px,
            share,
            share,
            imgproc::INTER_AREA,
        )?;
        is_found = calib3d::find_chessboard_corners(&reduced, size, &mut corners, flags)?;
        if is_found {
            // The centre of a reduced pixel lies in the middle of those that it was made of.
            let full = |x: f32| factor * x + 0.5 * (factor - 1.0);
            corners = corners
                .iter()
                .map(|p| Point2f::new(full(p.x), full(p.y)))
                .collect();
            break;
        }
    }
    if !is_found || corners.len() != (size.width * size.height) as usize {
        return Ok(None);
    }
    let window = window_px(&corners, size.width as usize)?;
    let criteria = TermCriteria::new(
        core::TermCriteria_COUNT | core::TermCriteria_EPS,
        SUBPIXEL_TURNS,
        SUBPIXEL_STEP_PX,
    )?;
    imgproc::corner_sub_pix(
        image,
        &mut corners,
        Size::new(window, window),
        Size::new(-1, -1),
        criteria,
    )?;
    Ok(Some(corners))
}

/// By what an image is reduced for the search, quickest first.
fn reductions(side_px: u32) -> impl Iterator<Item = f32> {
    let mut finest = 1;
    while side_px / finest > SEARCHED_SIDE_PX {
        finest *= 2;
    }
    let coarser = (finest > 1).then_some(2 * finest);
    coarser
        .into_iter()
        .chain([finest])
        .map(|factor| factor as f32)
}

/// Half the window of the sub-pixel search, px.
fn window_px(corners: &Vector<Point2f>, columns: usize) -> Result<i32, DetectError> {
    let mut least = f64::INFINITY;
    for i in 0..corners.len() {
        let here = corners.get(i)?;
        let neighbours = [
            (i % columns + 1 < columns).then_some(i + 1),
            Some(i + columns),
        ];
        for j in neighbours
            .into_iter()
            .flatten()
            .filter(|j| *j < corners.len())
        {
            let there = corners.get(j)?;
            least = least.min(f64::from(here.x - there.x).hypot(f64::from(here.y - there.y)));
        }
    }
    let half = (WINDOW_SHARE * least).floor().min(1e3) as i32;
    Ok(half.clamp(*WINDOW_PX.start(), *WINDOW_PX.end()))
}

/// One placement of the board in the images of both cameras; the right image's points in the order of the left's.
///
/// # Errors
/// OpenCV fails.
pub fn detect_pair(
    name: &str,
    images: [&GrayImage; 2],
    board: &Board,
) -> Result<View, DetectError> {
    let left = detect(images[0], board)?;
    let right = detect(images[1], board)?;
    Ok(view(name, left, right, board))
}

/// A view of what was found in either image.
#[must_use]
pub fn view(
    name: &str,
    left: Option<Vec<Vector2<f64>>>,
    right: Option<Vec<Vector2<f64>>>,
    board: &Board,
) -> View {
    let right = match (&left, right) {
        (Some(left), Some(right)) => Some(board.in_order_of(left, &right)),
        (_, right) => right,
    };
    let seen = |points: Option<Vec<Vector2<f64>>>| -> Option<SeenPoints> {
        points.map(|points| points.into_iter().map(Some).collect())
    };
    View {
        name: name.to_owned(),
        seen: [seen(left), seen(right)],
    }
}
