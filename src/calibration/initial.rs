//! Views in, a rig and placements to start the adjustment from out.
//!
//! Focal lengths from the boards' homographies with the principal point in the middle of the image (Zhang 2000);
//! where these do not tell, the best of a range of them. Each camera is then adjusted by itself, and the
//! extrinsics are the median of what the views say.

use super::adjustment::{Effort, Problem, State, fit_placement};
use super::homography::{apart, homography, placement};
use super::normal::Loss;
use super::{Board, CalibrationError, Lens, View};
use crate::geometry::{Camera, StereoRig, so3};
use nalgebra::{DMatrix, Isometry3, Matrix3, Translation3, UnitQuaternion, Vector2, Vector3};

/// Views that a camera's first values are sought with.
const SEARCH_VIEWS: usize = 16;
/// Focal lengths that are tried where the homographies do not tell, in image widths.
const FOCAL_IN_WIDTHS: [f64; 8] = [0.3, 0.45, 0.6, 0.8, 1.1, 1.5, 2.2, 3.5];
/// Steps of a trial.
const TRIAL_STEPS: usize = 12;
/// A start whose root mean square miss is above this share of the image's width is worth seeking another.
const GOOD_SHARE: f64 = 2e-3;
/// Turns of the median of the extrinsics.
const MEDIAN_STEPS: usize = 30;

/// The start of the joint adjustment. A view whose board cannot be placed is left out: the views that remain come
/// along, by their numbers.
pub(super) fn start(
    board: &Board,
    views: &[View],
    size_px: (u32, u32),
    lens: Lens,
) -> Result<(State, Vec<usize>), CalibrationError> {
    let left = camera(board, views, 0, size_px, lens)?;
    let right = camera(board, views, 1, size_px, lens)?;
    let placed = |side: usize, camera: &Camera, view: &View| placed(board, view, side, camera);
    let both: Vec<_> = views
        .iter()
        .map(|v| [placed(0, &left, v), placed(1, &right, v)])
        .collect();
    let told: Vec<_> = both
        .iter()
        .filter_map(|[l, r]| Some(r.as_ref()? * l.as_ref()?.inverse()))
        .collect();
    let right_from_left = median(&told, board).ok_or(CalibrationError::NoCommonView)?;
    let rig = StereoRig {
        left,
        right,
        right_from_left,
        base_from_camera: None,
        uncertainty: None,
    };
    let placements: Vec<_> = both
        .into_iter()
        .map(|[l, r]| {
            l.or_else(|| r.map(|right_from_board| right_from_left.inverse() * right_from_board))
        })
        .collect();
    let kept: Vec<usize> = (0..views.len())
        .filter(|&i| placements[i].is_some())
        .collect();
    let placements = placements.into_iter().flatten().collect();
    Ok((State { rig, placements }, kept))
}

/// Where the board stands for one camera, camera_from_board.
pub(super) fn placed(
    board: &Board,
    view: &View,
    side: usize,
    camera: &Camera,
) -> Option<Isometry3<f64>> {
    let pairs: Vec<_> = view
        .points(side)
        .filter_map(|(i, px)| Some((board.point(i), camera.unproject(&px)?)))
        .collect();
    let start = placement(&homography(&pairs)?)?;
    let (alone, view) = by_itself(camera, view, side);
    Some(fit_placement(&alone, &start, board, &view, Loss::SQUARED))
}

/// One camera as the left one of a rig whose right one sees nothing.
fn by_itself(camera: &Camera, view: &View, side: usize) -> (StereoRig, View) {
    let rig = StereoRig {
        left: camera.clone(),
        right: camera.clone(),
        right_from_left: Isometry3::translation(-1.0, 0.0, 0.0),
        base_from_camera: None,
        uncertainty: None,
    };
    let view = View {
        name: view.name.clone(),
        seen: [view.seen[side].clone(), None],
    };
    (rig, view)
}

/// One camera, from its own views alone.
fn camera(
    board: &Board,
    views: &[View],
    side: usize,
    size_px: (u32, u32),
    lens: Lens,
) -> Result<Camera, CalibrationError> {
    let seen: Vec<&View> = views.iter().filter(|v| v.count(side) > 0).collect();
    let stride = seen.len().div_ceil(SEARCH_VIEWS).max(1);
    let some: Vec<&View> = seen.into_iter().step_by(stride).collect();
    let width = f64::from(size_px.0);
    let mut best: Option<(Camera, f64)> = None;
    let by_homographies = focal_by_homographies(board, &some, side, size_px);
    let tries = by_homographies
        .into_iter()
        .chain(FOCAL_IN_WIDTHS.map(|share| Vector2::repeat(share * width)));
    for focal_px in tries {
        let Some(found) = trial(board, &some, side, &lens.camera(size_px, focal_px), lens) else {
            continue;
        };
        if best.as_ref().is_none_or(|(_, rms_px)| found.1 < *rms_px) {
            best = Some(found);
        }
        if best
            .as_ref()
            .is_some_and(|(_, rms_px)| *rms_px < GOOD_SHARE * width)
        {
            break;
        }
    }
    best.map(|(camera, _)| camera)
        .ok_or(CalibrationError::NoStart {
            side: ["left", "right"][side],
        })
}

/// A camera adjusted from a start, with its root mean square miss, px.
fn trial(
    board: &Board,
    views: &[&View],
    side: usize,
    start: &Camera,
    lens: Lens,
) -> Option<(Camera, f64)> {
    let (mut placements, mut alone) = (Vec::new(), Vec::new());
    for view in views {
        if let Some(placement) = placed(board, view, side, start) {
            placements.push(placement);
            alone.push(by_itself(start, view, side).1);
        }
    }
    let (rig, _) = by_itself(start, alone.first()?, 0);
    let mut state = State { rig, placements };
    // Focal lengths and placements first: a lens that starts from nothing would lead them astray.
    for free in [&lens.camera_slots()[..2], &lens.camera_slots()[..]] {
        let problem = Problem {
            board,
            views: &alone,
            free,
        };
        problem.adjust(&mut state, Loss::SQUARED, Effort::Steps(TRIAL_STEPS));
    }
    let problem = Problem {
        board,
        views: &alone,
        free: &[],
    };
    let squares: Vec<f64> = problem
        .misses(&state)
        .iter()
        .map(|(_, _, _, miss)| miss.map_or(1e6, |miss| miss.norm_squared()))
        .collect();
    let rms_px = (squares.iter().sum::<f64>() / squares.len() as f64).sqrt();
    let camera = state.rig.left;
    let is_camera = camera.focal_px.iter().all(|f| f.is_finite() && *f > 0.0);
    is_camera.then_some((camera, rms_px))
}

/// Focal lengths from homographies, the principal point taken to be in the middle: each homography's columns are
/// orthogonal and of one length on the normalised plane, which is linear in 1/fx² and 1/fy².
fn focal_by_homographies(
    board: &Board,
    views: &[&View],
    side: usize,
    size_px: (u32, u32),
) -> Option<Vector2<f64>> {
    let centre = Vector2::new(f64::from(size_px.0) - 1.0, f64::from(size_px.1) - 1.0) * 0.5;
    let mut rows: Vec<[f64; 3]> = Vec::new();
    for view in views {
        let pairs: Vec<_> = view
            .points(side)
            .map(|(i, px)| (board.point(i), px - centre))
            .collect();
        let Some(h) = homography(&pairs) else {
            continue;
        };
        let scale = h.column(0).norm() * h.column(1).norm();
        rows.extend(orthogonality(&h, scale));
    }
    let matrix = DMatrix::from_fn(rows.len(), 2, |i, j| rows[i][j]);
    let right = DMatrix::from_fn(rows.len(), 1, |i, _| rows[i][2]);
    let solution = matrix.svd(true, true).solve(&right, 1e-9).ok()?;
    let focal = |inverse_square: f64| (inverse_square > 0.0).then(|| inverse_square.sqrt().recip());
    let focal_px = Vector2::new(focal(solution[0])?, focal(solution[1])?);
    let width = f64::from(size_px.0);
    focal_px
        .iter()
        .all(|f| (0.1..20.0).contains(&(f / width)))
        .then_some(focal_px)
}

/// Two rows (a, b, c) of a/fx² + b/fy² = c.
fn orthogonality(h: &Matrix3<f64>, scale: f64) -> [[f64; 3]; 2] {
    let (x, y) = (h.column(0), h.column(1));
    let product = [x[0] * y[0], x[1] * y[1], -x[2] * y[2]];
    let lengths = [
        x[0] * x[0] - y[0] * y[0],
        x[1] * x[1] - y[1] * y[1],
        -(x[2] * x[2] - y[2] * y[2]),
    ];
    [product.map(|v| v / scale), lengths.map(|v| v / scale)]
}

/// The median of motions: of each coordinate of the translation, and of the turns about the median itself.
fn median(motions: &[Isometry3<f64>], board: &Board) -> Option<Isometry3<f64>> {
    // The one that lies nearest to all others, to begin with.
    let length_m = board.square_m * f64::from(board.columns);
    let distance = |a: &Isometry3<f64>| motions.iter().map(|b| apart(a, b, length_m)).sum::<f64>();
    let nearest = motions
        .iter()
        .min_by(|a, b| distance(a).total_cmp(&distance(b)))?;
    let of = |values: &mut dyn Iterator<Item = f64>| -> f64 {
        let mut values: Vec<f64> = values.collect();
        values.sort_by(f64::total_cmp);
        values[values.len() / 2]
    };
    let shift = |axis: usize| of(&mut motions.iter().map(|m| m.translation.vector[axis]));
    let mut rotation: UnitQuaternion<f64> = nearest.rotation;
    for _ in 0..MEDIAN_STEPS {
        let turns: Vec<Vector3<f64>> = motions
            .iter()
            .map(|m| so3::log(&(m.rotation * rotation.inverse())))
            .collect();
        let turn = Vector3::from_fn(|axis, _| of(&mut turns.iter().map(|t| t[axis])));
        rotation = so3::exp(&turn) * rotation;
        if turn.norm() < 1e-12 {
            break;
        }
    }
    let translation = Vector3::from_fn(|axis, _| shift(axis));
    Some(Isometry3::from_parts(
        Translation3::from(translation),
        rotation,
    ))
}
