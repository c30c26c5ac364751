//! Calibrations of rigs that are known.

use super::simulated::{placements, views};
use super::*;
use crate::geometry::rig_parameters::{EXTRINSICS, RigVector};
use crate::geometry::{StereoRig, parse_rig, so3};
use crate::uncertainty::consistency::anees_interval;
use nalgebra::{DMatrix, DVector, Vector2};

const BOARD: Board = Board {
    pattern: Pattern::Chessboard,
    columns: 9,
    rows: 6,
    square_m: 0.04,
    sigma_square_m: 0.0,
};
const SIGMA_PX: f64 = 0.15;
const SEEDS: u64 = 50;

/// A rig whose lenses are of one model.
fn rig(lens: Lens) -> StereoRig {
    let [left, right] = match lens {
        Lens::None => ["", ""].map(str::to_owned),
        Lens::Radtan4 => [
            "model = \"radtan\", coefficients = [-0.28, 0.08, 0.001, -0.0007]",
            "model = \"radtan\", coefficients = [-0.30, 0.10, -0.0005, 0.0004]",
        ]
        .map(str::to_owned),
        Lens::Radtan5 => [
            "model = \"radtan\", coefficients = [-0.28, 0.08, 0.001, -0.0007, 0.02]",
            "model = \"radtan\", coefficients = [-0.30, 0.10, -0.0005, 0.0004, -0.01]",
        ]
        .map(str::to_owned),
        Lens::Radtan8 => [
            "model = \"radtan\", coefficients = [0.3, 0.05, 0.001, -0.0007, 0.002, 0.6, 0.1, 0.01]",
            "model = \"radtan\", coefficients = [0.2, 0.06, -0.0005, 0.0004, 0.001, 0.5, 0.08, 0.005]",
        ]
        .map(str::to_owned),
        Lens::Equidistant => [
            "model = \"equidistant\", coefficients = [0.02, -0.01, 0.004, -0.001]",
            "model = \"equidistant\", coefficients = [0.01, 0.01, -0.006, 0.001]",
        ]
        .map(str::to_owned),
    };
    let lens = |text: &str| {
        if text.is_empty() {
            "model = \"none\"".to_owned()
        } else {
            text.to_owned()
        }
    };
    parse_rig(&format!(
        "left = {{ width = 640, height = 480, focal = [505.8, 504.1], principal_point = [313.2, 243.5], distortion = {{ {} }} }}
         right = {{ width = 640, height = 480, focal = [502.9, 501.2], principal_point = [326.2, 236.4], distortion = {{ {} }} }}
         right_from_left = {{ translation_m = [-0.11, -0.002, 0.001], rotation_vector_rad = [0.01, 0.02, -0.005] }}",
        lens(&left),
        lens(&right)
    ))
    .expect("valid")
}

/// estimate − truth, over the rig's slots.
fn error(estimate: &StereoRig, truth: &StereoRig) -> RigVector {
    use crate::geometry::Distortion;
    let mut error = RigVector::zeros();
    for (first, a, b) in [
        (0, &estimate.left, &truth.left),
        (12, &estimate.right, &truth.right),
    ] {
        error
            .fixed_rows_mut::<2>(first)
            .copy_from(&(a.focal_px - b.focal_px));
        error
            .fixed_rows_mut::<2>(first + 2)
            .copy_from(&(a.principal_point_px - b.principal_point_px));
        let of = |distortion: &Distortion| match distortion {
            Distortion::None => [0.0; 8],
            Distortion::Radtan(k) => *k,
            Distortion::Equidistant(k) => std::array::from_fn(|i| if i < 4 { k[i] } else { 0.0 }),
        };
        let (a, b) = (of(a.distortion()), of(b.distortion()));
        for i in 0..8 {
            error[first + 4 + i] = a[i] - b[i];
        }
    }
    let (a, b) = (&estimate.right_from_left, &truth.right_from_left);
    error
        .fixed_rows_mut::<3>(EXTRINSICS)
        .copy_from(&(a.translation.vector - b.translation.vector));
    error
        .fixed_rows_mut::<3>(EXTRINSICS + 3)
        .copy_from(&so3::log(&(a.rotation * b.rotation.inverse())));
    error
}

/// The normalised squared error over the estimated parameters.
fn nees(found: &Calibration, truth: &StereoRig) -> f64 {
    let error = error(&found.rig, truth);
    let free = &found.free;
    let scale: Vec<f64> = free.iter().map(|&i| found.sigma(i)).collect();
    let n = free.len();
    let correlation = DMatrix::from_fn(n, n, |i, j| {
        found.covariance[(free[i], free[j])] / (scale[i] * scale[j])
    });
    let whitened = DVector::from_fn(n, |i, _| error[free[i]] / scale[i]);
    let factor = correlation.cholesky().expect("a covariance");
    whitened.dot(&factor.solve(&whitened))
}

fn calibrated(board: &Board, views: &[View], lens: Lens) -> Calibration {
    calibrate(board, views, (640, 480), lens, &mut |_| {}).expect("calibrates")
}

fn assert_consistent(lens: Lens, boards: usize) {
    let truth = rig(lens);
    let mut sum = 0.0;
    for seed in 0..SEEDS {
        let placed = placements(&truth, &BOARD, boards, 1000 + seed);
        assert_eq!(placed.len(), boards);
        let found = calibrated(
            &BOARD,
            &views(&truth, &BOARD, &placed, SIGMA_PX, seed),
            lens,
        );
        assert!(found.left_out.is_empty(), "{:?}", found.left_out);
        sum += nees(&found, &truth);
    }
    let dof = lens.rig_slots().len();
    let anees = sum / (SEEDS as f64 * dof as f64);
    let (low, high) = anees_interval(dof, SEEDS as usize, 0.95);
    println!("{lens:?}, {boards} boards: ANEES {anees:.3} in [{low:.3}, {high:.3}]");
    assert!(
        (low..high).contains(&anees),
        "{lens:?}, {boards}: {anees} not in [{low}, {high}]"
    );
}

#[test]
fn the_covariance_covers_the_errors_without_distortion() {
    assert_consistent(Lens::None, 12);
}

#[test]
fn the_covariance_covers_the_errors_of_many_views() {
    assert_consistent(Lens::Radtan4, 40);
}

#[test]
fn the_covariance_covers_the_errors_of_few_views() {
    assert_consistent(Lens::Radtan5, 12);
}

#[test]
fn the_covariance_covers_the_errors_of_a_fisheye() {
    assert_consistent(Lens::Equidistant, 16);
}

#[test]
fn exact_points_give_the_rig_exactly_whatever_the_lens() {
    for lens in [
        Lens::None,
        Lens::Radtan4,
        Lens::Radtan5,
        Lens::Radtan8,
        Lens::Equidistant,
    ] {
        let mut truth = rig(lens);
        if lens == Lens::Radtan8 {
            // Only a wide lens tells so many coefficients apart.
            let mut wide = RigVector::zeros();
            wide.fixed_rows_mut::<2>(0).fill(-200.0);
            wide.fixed_rows_mut::<2>(12).fill(-200.0);
            truth = truth.with_error(&wide);
        }
        let placed = placements(&truth, &BOARD, 15, 7);
        let found = calibrated(&BOARD, &views(&truth, &BOARD, &placed, 0.0, 1), lens);
        assert!(found.rms_px[2] < 1e-7, "{lens:?}: {:?}", found.rms_px);
        if lens != Lens::Radtan8 {
            let error = error(&found.rig, &truth);
            assert!(error.amax() < 1e-4, "{lens:?}: {error}");
        }
    }
}

#[test]
fn the_squares_uncertainty_goes_to_the_baseline_alone() {
    let truth = rig(Lens::Radtan4);
    let placed = placements(&truth, &BOARD, 15, 7);
    let seen = views(&truth, &BOARD, &placed, SIGMA_PX, 1);
    let exact = calibrated(&BOARD, &seen, Lens::Radtan4);
    let measured = Board {
        sigma_square_m: 0.0004,
        ..BOARD
    };
    let ruled = calibrated(&measured, &seen, Lens::Radtan4);
    let grown = ruled.covariance - exact.covariance;
    // One per cent of 0.11 m.
    assert!((grown[(EXTRINSICS, EXTRINSICS)].sqrt() - 0.0011).abs() < 2e-5);
    let block = grown.fixed_view::<3, 3>(EXTRINSICS, EXTRINSICS).norm();
    assert!((grown.norm() - block).abs() < 1e-12 * block);
}

#[test]
fn a_wrong_view_and_wrong_points_are_named_and_left_out() {
    let truth = rig(Lens::Radtan4);
    let placed = placements(&truth, &BOARD, 16, 3);
    let mut seen = views(&truth, &BOARD, &placed, SIGMA_PX, 2);
    let clean = calibrated(&BOARD, &seen, Lens::Radtan4);
    // The board moved between the two exposures of a view, and two points of another were mistaken.
    for point in seen[5].seen[1].as_mut().expect("seen").iter_mut().flatten() {
        *point += Vector2::new(6.0, 9.0);
    }
    for i in [7, 30] {
        *seen[9].seen[0].as_mut().expect("seen")[i]
            .as_mut()
            .expect("seen") += Vector2::new(2.5, -1.0);
    }
    let found = calibrated(&BOARD, &seen, Lens::Radtan4);
    assert_eq!(found.left_out.len(), 1, "{:?}", found.left_out);
    assert_eq!(found.left_out[0].view, "005");
    let named: Vec<_> = found
        .outliers
        .iter()
        .map(|o| (o.view.as_str(), o.side, o.point))
        .collect();
    assert_eq!(named, [("009", "left", 7), ("009", "left", 30)]);
    let apart = error(&found.rig, &clean.rig);
    for &slot in &clean.free {
        assert!(apart[slot].abs() < 2.0 * clean.sigma(slot), "{slot}");
    }
}

#[test]
fn points_that_are_noisy_together_raise_the_covariance() {
    // The points of each view are displaced by a bend of the board that is not the model's.
    let truth = rig(Lens::Radtan4);
    let placed = placements(&truth, &BOARD, 25, 3);
    let mut seen = views(&truth, &BOARD, &placed, 0.1, 2);
    let plain = calibrated(&BOARD, &seen, Lens::Radtan4);
    for (i, view) in seen.iter_mut().enumerate() {
        let bend_px = 0.4 * (i as f64 * 2.4).sin();
        for points in view.seen.iter_mut().flatten() {
            for (k, point) in points.iter_mut().enumerate() {
                let across = (k % 9) as f64 / 4.0 - 1.0;
                if let Some(point) = point {
                    point.y += bend_px * across * across;
                }
            }
        }
    }
    let bent = calibrated(&BOARD, &seen, Lens::Radtan4);
    assert!(
        plain.between_views < 1.5 && !plain.is_inflated,
        "{}",
        plain.between_views
    );
    assert!(
        bent.between_views > 2.0 && bent.is_inflated,
        "{}",
        bent.between_views
    );
}

#[test]
fn views_that_do_not_suffice_are_refused_with_what_is_missing() {
    let truth = rig(Lens::Radtan4);
    let placed = placements(&truth, &BOARD, 2, 3);
    let refused = |views: &[View]| {
        calibrate(&BOARD, views, (640, 480), Lens::Radtan4, &mut |_| {}).expect_err("refused")
    };
    let two = views(&truth, &BOARD, &placed, SIGMA_PX, 2);
    assert_eq!(refused(&two), CalibrationError::TooFewViews { usable: 2 });
    // Always the same placement: the board's distance and the focal length cannot be told apart.
    let same: Vec<_> =
        std::iter::repeat_n(nalgebra::Isometry3::translation(-0.16, -0.1, 0.8), 5).collect();
    let error = refused(&views(&truth, &BOARD, &same, 0.0, 2));
    assert!(
        matches!(&error, CalibrationError::Undetermined { parameters } if !parameters.is_empty()),
        "{error}"
    );
    assert!(error.to_string().contains("tilted"), "{error}");
}
