//! Every estimator and model through the whole method, on rendered pairs.

use super::{DescribedPair, Method};
use crate::capture::{Side, Skew, StereoPair};
use crate::estimation::{self, MotionModel, Odometry, Status};
use crate::features;
use crate::geometry::{StereoRig, se3};
use crate::simulation::{SceneName, Settings, Simulation, TrajectoryName, small_rig};
use crate::uncertainty::consistency::nees;
use nalgebra::Isometry3;

/// Rendered pairs with features and true poses.
struct Film {
    rig: StereoRig,
    pairs: Vec<DescribedPair>,
    truth: Vec<Isometry3<f64>>,
}

impl Film {
    fn of(pairs: impl Iterator<Item = (StereoPair, Isometry3<f64>)>) -> Self {
        let mut extractor = features::extractor(&features::Settings::default()).expect("valid");
        let mut film = Self {
            rig: small_rig(),
            pairs: Vec::new(),
            truth: Vec::new(),
        };
        for (pair, truth) in pairs {
            let mut described = DescribedPair::default();
            described
                .describe(extractor.as_mut(), &pair)
                .expect("features");
            film.pairs.push(described);
            film.truth.push(truth);
        }
        film
    }
}

fn in_the_hall(trajectory: TrajectoryName, settings: Settings) -> Simulation {
    Simulation::new(SceneName::Hall, trajectory, small_rig(), settings).expect("a free way")
}

fn film(trajectory: TrajectoryName, frames: u64, shake: f64) -> Film {
    let settings = Settings {
        frames,
        shake,
        ..Settings::default()
    };
    let simulation = in_the_hall(trajectory, settings);
    Film::of((0..frames).map(|frame| simulation.pair(frame)))
}

fn run(film: &Film, settings: &estimation::Settings) -> Vec<Odometry> {
    let mut method = Method::new(film.rig.clone(), Default::default(), settings.clone())
        .expect("has a baseline");
    let step = |pair: &DescribedPair| method.step(&mut pair.clone()).expect("matched");
    film.pairs.iter().map(step).collect()
}

/// The average of the motions' NEES, over `freedom`.
fn anees(film: &Film, rows: &[Odometry]) -> f64 {
    let of = |i: usize| {
        let truth = film.truth[i - 1].inv_mul(&film.truth[i]);
        let error = se3::error_fixed_axes(&rows[i].prev_from_now, &truth);
        nees(&error, &rows[i].cov_motion).expect("positive definite") / 6.0
    };
    (1..rows.len()).map(of).sum::<f64>() / (rows.len() - 1) as f64
}

#[test]
fn every_estimator_follows_and_knows_its_error() {
    let film = film(TrajectoryName::Slalom, 14, 1.0);
    for (method, limit_m) in [
        (estimation::Method::Window, 0.01),
        (estimation::Method::Bundle, 0.02),
        (estimation::Method::Weighted, 0.03),
        (estimation::Method::Svd, 0.4),
    ] {
        let settings = estimation::Settings {
            method,
            calibration_sigma_px: 0.0,
            ..estimation::Settings::default()
        };
        let rows = run(&film, &settings);
        for row in &rows[1..] {
            assert_eq!(row.status, Status::Tracking, "{method:?} {}", row.sequence);
            assert!(row.innovation_ratio < 1.0, "{method:?}");
            let parts = row.budget.total() - row.cov_pose;
            assert!(parts.norm() <= 1e-12 * row.cov_pose.norm());
        }
        let last = rows.len() - 1;
        let gap =
            rows[last].odom_from_camera.translation.vector - film.truth[last].translation.vector;
        assert!(gap.norm() < limit_m, "{method:?} {} m", gap.norm());
        // One short run: from far too careful to twice too sure.
        let anees = anees(&film, &rows);
        assert!((0.1..2.5).contains(&anees), "{method:?} {anees}");
    }
}

#[test]
fn on_flat_ground_the_planar_model_keeps_to_the_plane_and_elsewhere_it_says_so() {
    let (flat, rough) = (
        film(TrajectoryName::Slalom, 10, 0.0),
        film(TrajectoryName::Slalom, 10, 20.0),
    );
    for method in [estimation::Method::Window, estimation::Method::Bundle] {
        let settings = estimation::Settings {
            method,
            model: MotionModel::Planar,
            // Millimetres and tenths of a degree of shaking, times twenty, are far beyond these.
            flat_sigma_m: 5e-4,
            flat_sigma_rad: 5e-4,
            ..estimation::Settings::default()
        };
        let rows = run(&flat, &settings);
        for (row, truth) in rows.iter().zip(&flat.truth).skip(1) {
            assert_eq!(row.status, Status::Tracking, "{method:?} {}", row.sequence);
            let error = se3::error_fixed_axes(&row.odom_from_camera, truth);
            assert!(error.norm() < 0.02, "{method:?} {error}");
            assert!(error[1].abs() < 2e-3, "{method:?} {error}");
        }
        let rows = run(&rough, &settings);
        let is_doubted = |row: &&Odometry| [Status::Degraded, Status::Lost].contains(&row.status);
        let doubted = rows.iter().filter(is_doubted).count();
        assert!(doubted >= 7, "{method:?} {doubted}");
    }
}

/// Images whose lower part is still of the pair before show two motions, each of them without a contradiction.
#[test]
fn a_pair_of_two_instants_is_not_taken_for_one_of_them() {
    const LATE: usize = 9;
    let settings = Settings {
        frames: 13,
        ..Settings::default()
    };
    let simulation = in_the_hall(TrajectoryName::Slalom, settings);
    let pairs: Vec<_> = (0..13).map(|frame| simulation.pair(frame)).collect();
    for upper in [0.3, 0.4, 0.5, 0.6, 0.7] {
        let mut pairs_seen = pairs.clone();
        let before = &pairs[LATE - 1].0;
        let late = &mut pairs_seen[LATE].0;
        for (now, before) in [
            (&mut late.left, &before.left),
            (&mut late.right, &before.right),
        ] {
            let from = (upper * f64::from(now.height())) as usize * now.width() as usize;
            let below = now.pixels_mut()[from..].iter_mut();
            for (grey, before) in below.zip(&before.pixels()[from..]) {
                // Not the same bytes: those would be found out by themselves.
                *grey = before ^ 1;
            }
        }
        let film = Film::of(pairs_seen.into_iter());
        let rows = run(&film, &estimation::Settings::default());
        for (i, row) in rows.iter().enumerate().skip(1) {
            let is_tracked = row.status == Status::Tracking;
            assert_eq!(is_tracked, i != LATE, "from {upper} on, pair {i}");
        }
        let end = se3::error_fixed_axes(&rows[12].odom_from_camera, &film.truth[12]);
        let nees = nees(&end, &rows[12].cov_pose).expect("positive definite") / 6.0;
        assert!(nees < 4.0, "from {upper} on, {nees}");
    }
}

/// A right image that is late by a known time is as good as one in time; what its time is uncertain
/// by stands in the budget.
#[test]
fn a_known_skew_is_compensated_and_its_uncertainty_stands_in_the_budget() {
    const SKEW_NS: i64 = 4_000_000;
    let film_at = |skew_ns: i64| {
        // At 250 Hz the next image is 4 ms late; every 25th pair is used.
        let settings = Settings {
            frames: 200,
            rate_hz: 250.0,
            shake: 0.0,
            speed_m_s: Some(1.5),
            ..Settings::default()
        };
        let simulation = in_the_hall(TrajectoryName::Circle, settings);
        Film::of((0..8_u64).map(|i| {
            let left = 25 * i;
            let late = left + u64::from(skew_ns > 0);
            let (mut pair, truth) = simulation.pair(left);
            pair.right = simulation.image(late, Side::Right);
            pair.sequence = i;
            pair.skew = Skew {
                ns: skew_ns,
                sigma_ns: 100_000.0,
            };
            (pair, truth)
        }))
    };
    let late = film_at(SKEW_NS);
    for method in [estimation::Method::Window, estimation::Method::Bundle] {
        let rows = |consider_synchronisation: bool| {
            let settings = estimation::Settings {
                method,
                consider_synchronisation,
                calibration_sigma_px: 0.0,
                ..estimation::Settings::default()
            };
            run(&late, &settings)
        };
        let end_m = |rows: &[Odometry]| {
            let gap =
                rows[7].odom_from_camera.translation.vector - late.truth[7].translation.vector;
            gap.norm()
        };
        let (with, without) = (rows(true), rows(false));
        assert!(
            end_m(&with) < 0.6 * end_m(&without),
            "{method:?} {} {}",
            end_m(&with),
            end_m(&without)
        );
        assert!(with[7].budget.synchronisation.trace() > 0.0, "{method:?}");
        assert_eq!(without[7].budget.synchronisation.trace(), 0.0);
        assert!(with[7].cov_twist[(2, 2)] > without[7].cov_twist[(2, 2)]);
    }
}
