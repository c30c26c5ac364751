//! Rigs that turn, and rigs that do not: on random sights, and on rendered pairs through the whole method.

use super::filter::{Equations, Filter, STATICS, STATICS as FIRST_OF_TURN, UNKNOWNS};
use super::*;
use crate::estimation::Odometry;
use crate::features;
use crate::geometry::{RigUncertainty, se3};
use crate::pipeline::{DescribedPair, Method};
use crate::simulation::points::{PixelNoise, PointFrame, PointSimulation, Settings as Points};
use crate::simulation::{SceneName, Settings as Scenery, Simulation, TrajectoryName};
use crate::simulation::{small_rig, thesis_rig};
use crate::uncertainty::consistency::{anees_interval, nees};
use nalgebra::{SVector, Translation3};
use rand::{RngExt, SeedableRng};
use rand_distr::StandardNormal;
use rand_xoshiro::Xoshiro256PlusPlus;

/// A rig whose right camera has turned about its own centre.
fn turned(rig: &StereoRig, turn_rad: &Vector3<f64>) -> StereoRig {
    let turn = Isometry3::from_parts(
        Translation3::identity(),
        crate::geometry::so3::exp(turn_rad),
    );
    StereoRig {
        right_from_left: turn * rig.right_from_left,
        ..rig.clone()
    }
}

#[test]
fn the_filters_covariance_covers_its_error_before_and_after_a_blow() {
    const RUNS: usize = 300;
    const SIGMA_PX: f64 = 0.3;
    const SIGMA_BLOW_RAD: f64 = 1e-3;
    let mut random = Xoshiro256PlusPlus::seed_from_u64(11);
    let mut normal = move || random.sample::<f64, _>(StandardNormal);
    let prior = filter::StaticsCovariance::identity() * 0.09;
    let mut sums = [0.0; 2];
    for _ in 0..RUNS {
        let mut filter = Filter::new(prior);
        let mut truth = SVector::<f64, UNKNOWNS>::zeros();
        for term in truth.iter_mut().take(STATICS) {
            *term = 0.3 * normal();
        }
        for pair in 0..40 {
            if pair == 20 {
                for axis in truth.iter_mut().skip(FIRST_OF_TURN) {
                    *axis += SIGMA_BLOW_RAD * normal();
                }
                filter.open(SIGMA_BLOW_RAD);
            }
            filter.walk(1e-5, 0.1);
            for axis in truth.iter_mut().skip(FIRST_OF_TURN) {
                *axis += 1e-5 * 0.1_f64.sqrt() * normal();
            }
            let mut said = Equations::default();
            for _ in 0..60 {
                let (x, y) = (normal().clamp(-1.0, 1.0), 0.7 * normal().clamp(-1.0, 1.0));
                let by = SVector::<f64, UNKNOWNS>::from([
                    1.0,
                    x,
                    y,
                    x * x,
                    x * y,
                    y * y,
                    -300.0 - 80.0 * y * y,
                    80.0 * x * y,
                    160.0 * x,
                ]);
                let deviation = by.dot(&(truth - filter.state)) + SIGMA_PX * normal();
                said.add(&by, deviation, 1.0 / (SIGMA_PX * SIGMA_PX));
            }
            filter.update(&said);
            if pair == 19 || pair == 39 {
                let error = filter.state - truth;
                sums[pair / 20] += nees(&error, &filter.cov).expect("positive definite");
            }
        }
    }
    for sum in sums {
        let anees = sum / (UNKNOWNS * RUNS) as f64;
        let (low, high) = anees_interval(UNKNOWNS, RUNS, 0.95);
        assert!((low..high).contains(&anees), "{anees} [{low}, {high}]");
    }
}

/// Sights of two hundred points that stand before the rig anew for each pair, a tenth of them mistaken.
struct Sights {
    simulation: PointSimulation,
    frame: PointFrame,
}

impl Sights {
    fn new(rig: StereoRig, seed: u64) -> Self {
        let settings = Points {
            landmarks: 200,
            survival: 0.9,
            noise: PixelNoise::Outliers {
                sigma_px: 0.2,
                share: 0.1,
                outlier_sigma_px: 2.0,
            },
            ..Points::default()
        };
        Self {
            simulation: PointSimulation::new(rig, settings, seed).expect("valid"),
            frame: PointFrame::default(),
        }
    }

    fn shown_to(&mut self, watch: &mut RigWatch, pair: i64) {
        self.simulation
            .observe(&Isometry3::identity(), &mut self.frame);
        watch.begin_sights();
        for sight in &self.frame.sights {
            watch.see(&StereoMeasurement {
                px: sight.pixels,
                sigma_px: Vector4::repeat(0.2),
            });
        }
        watch.conclude_sights(pair * 100_000_000);
    }
}

fn watch(rig: &StereoRig, settings: &Settings) -> RigWatch {
    RigWatch::new(rig, settings, &estimation::Settings::default()).expect("has a baseline")
}

#[test]
fn pitch_and_roll_show_in_rows_and_a_rig_that_stays_raises_no_alarm() {
    let rig = thesis_rig();
    for seed in 0..4 {
        // What calibration left from the start is no alarm, nor is it taken for a turn.
        let wrong = turned(&rig, &Vector3::new(1e-4, 0.0, -1e-4));
        let mut watch = watch(&rig, &Settings::default());
        let mut before = Sights::new(wrong.clone(), seed);
        for pair in 0..250 {
            before.shown_to(&mut watch, pair);
        }
        let state = watch.state();
        assert!(!state.has_moved && !state.misfits, "{seed} {state:?}");
        let turn_rad = Vector3::new(3e-4, 0.0, -4e-4);
        let mut after = Sights::new(turned(&wrong, &turn_rad), 100 + seed);
        for pair in 250..290 {
            after.shown_to(&mut watch, pair);
        }
        let state = watch.state();
        assert!(state.has_moved, "{seed} {state:?}");
        for axis in [0, 2] {
            let error = state.turn_rad[axis] - turn_rad[axis];
            assert!(
                error.abs() < 3.5 * state.sigma_rad[axis],
                "{seed} {state:?}"
            );
            assert!(state.sigma_rad[axis] < 5e-5, "{seed} {state:?}");
        }
    }
}

#[test]
fn images_that_never_fitted_are_told_where_the_rig_states_its_uncertainty() {
    let rig = StereoRig {
        uncertainty: Some(RigUncertainty::Sigmas {
            focal_px: 0.5,
            principal_point_px: 0.1,
            rotation_rad: 1e-4,
            translation_m: 2e-4,
        }),
        ..thesis_rig()
    };
    let mut watch = watch(&rig, &Settings::default());
    // Three pixels, where a quarter of one is stated.
    let mut sights = Sights::new(turned(&rig, &Vector3::new(1.7e-3, 0.0, 0.0)), 5);
    for pair in 0..100 {
        sights.shown_to(&mut watch, pair);
    }
    let state = watch.state();
    assert!(state.misfits, "{state:?}");
}

/// Pairs with what the method wants to know of them, and where the left camera was.
type Film = Vec<(DescribedPair, Isometry3<f64>)>;

const PAIRS: u64 = 100;
const SHIFTED_AT: u64 = 40;

/// Renders part of a drive, on two threads.
fn film(rig: &StereoRig, from: u64) -> Film {
    let settings = Scenery {
        frames: PAIRS,
        ..Scenery::default()
    };
    let simulation = Simulation::new(
        SceneName::Hall,
        TrajectoryName::Circle,
        rig.clone(),
        settings,
    )
    .expect("a free way");
    let part = |first: u64| -> Film {
        let mut extractor = features::extractor(&features::Settings::default()).expect("valid");
        let mut describe = |frame: u64| {
            let (pair, truth) = simulation.pair(frame);
            let mut described = DescribedPair::default();
            described
                .describe(extractor.as_mut(), &pair)
                .expect("features");
            (described, truth)
        };
        (from + first..PAIRS)
            .step_by(2)
            .map(&mut describe)
            .collect()
    };
    let (even, odd) = rayon::join(|| part(0), || part(1));
    let mut odd = odd.into_iter();
    even.into_iter()
        .flat_map(|pair| [Some(pair), odd.next()])
        .flatten()
        .collect()
}

fn run(film: &Film, settings: &Settings) -> (Vec<Odometry>, Vec<Option<RigState>>) {
    let mut method = Method::new(small_rig(), Default::default(), Default::default())
        .expect("has a baseline")
        .watching_rig(settings);
    film.iter()
        .map(|(pair, _)| {
            let row = method.step(&mut pair.clone()).expect("matched");
            (row, method.rig_state())
        })
        .unzip()
}

/// How far the end is from where it should be, seen from the last pair before the shift, m.
fn drift_m(film: &Film, rows: &[Odometry]) -> f64 {
    let since = |at: &dyn Fn(usize) -> Isometry3<f64>| {
        at(SHIFTED_AT as usize - 1).inv_mul(&at(PAIRS as usize - 1))
    };
    let estimated = since(&|i| rows[i].odom_from_camera);
    let true_one = since(&|i| film[i].1);
    (estimated.translation.vector - true_one.translation.vector).norm()
}

/// The average of the motions' NEES from the shift on, over its degrees of freedom.
fn anees_since_shift(film: &Film, rows: &[Odometry]) -> f64 {
    let motions = SHIFTED_AT as usize..PAIRS as usize;
    let count = motions.len() as f64;
    let of = |i: usize| {
        let truth = film[i - 1].1.inv_mul(&film[i].1);
        let error = se3::error_fixed_axes(&rows[i].prev_from_now, &truth);
        nees(&error, &rows[i].cov_motion).expect("positive definite") / 6.0
    };
    motions.map(of).sum::<f64>() / count
}

#[test]
fn a_rig_shifted_in_mid_sequence_is_warned_of_and_with_refinement_drifts_no_more() {
    let whole = film(&small_rig(), 0);
    let (watching, refining, off) = (
        Settings::default(),
        Settings {
            refine: true,
            ..Settings::default()
        },
        Settings {
            enabled: false,
            ..Settings::default()
        },
    );
    let (unwatched, _) = run(&whole, &off);
    for settings in [&watching, &refining] {
        let (rows, states) = run(&whole, settings);
        // No false alarm, and not a bit of difference before there is one.
        assert!(states.iter().flatten().all(|s| !s.has_moved && !s.misfits));
        assert_eq!(format!("{rows:?}"), format!("{unwatched:?}"));
    }
    let unshifted_m = drift_m(&whole, &unwatched);
    // Half a milliradian about all axes together.
    let turn_rad = Vector3::new(3e-4, 3e-4, -2.65e-4);
    let mut shifted = whole[..SHIFTED_AT as usize].to_vec();
    shifted.extend(film(&turned(&small_rig(), &turn_rad), SHIFTED_AT));
    let (plain, states) = run(&shifted, &watching);
    let warned = states.iter().position(|s| s.is_some_and(|s| s.has_moved));
    let (refined, states) = run(&shifted, &refining);
    let state = states.last().copied().flatten().expect("is watched");
    let (plain_m, refined_m) = (drift_m(&shifted, &plain), drift_m(&shifted, &refined));
    let anees = [&plain, &refined].map(|rows| anees_since_shift(&shifted, rows));
    println!(
        "warned at {warned:?}; {state:?}; drift {unshifted_m} m unshifted, {plain_m} m shifted, {refined_m} m refined; ANEES {anees:?}"
    );
    assert!(
        warned.is_some_and(|at| (SHIFTED_AT as usize..SHIFTED_AT as usize + 100).contains(&at))
    );
    for axis in 0..3 {
        let error = state.turn_rad[axis] - turn_rad[axis];
        assert!(
            error.abs() < 3.5 * state.sigma_rad[axis],
            "{axis} {state:?}"
        );
    }
    assert!(plain_m > 3.0 * refined_m, "{plain_m} {refined_m}");
    assert!(
        refined_m < 2.0 * unshifted_m + 0.003,
        "{refined_m} {unshifted_m}"
    );
    assert!(anees[1] < 1.5, "{anees:?}");
}
