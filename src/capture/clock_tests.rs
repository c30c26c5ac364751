use super::*;
use crate::uncertainty::consistency::anees_interval;
use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, Exp1, Gamma};
use rand_xoshiro::Xoshiro256PlusPlus;

const PERIOD_NS: i64 = 50_000_000;
const START_NS: i64 = 9_000_000_000_000;
const LEAST_DELAY_NS: f64 = 400_000.0;

/// How long frames are held up beyond the least delay.
#[derive(Clone, Copy, Debug)]
enum Delays {
    Exponential,
    Uniform,
    /// Few are punctual: near zero the density grows with this power less one.
    Gamma(f64),
    /// What a network and a busy host do: a little jitter, and every third frame a long while.
    HeldUp,
}

impl Delays {
    const ALL: [Self; 5] = [
        Self::Exponential,
        Self::Uniform,
        Self::Gamma(1.5),
        Self::Gamma(2.0),
        Self::HeldUp,
    ];

    /// One of them, by their mean (that of the short ones is a twentieth).
    fn sample(self, rng: &mut Xoshiro256PlusPlus) -> f64 {
        let gamma = |shape: f64| Gamma::new(shape, 1.0 / shape).expect("valid");
        match self {
            Self::Exponential => Exp1.sample(rng),
            Self::Uniform => 2.0 * rng.random::<f64>(),
            Self::Gamma(shape) => gamma(shape).sample(rng),
            Self::HeldUp => {
                let long = if rng.random::<f64>() < 0.3 {
                    Distribution::<f64>::sample(&Exp1, rng)
                } else {
                    0.0
                };
                0.05 * gamma(2.0).sample(rng) + 3.0 * long
            }
        }
    }
}

/// A camera whose clock runs faster or slower, with frames that arrive late.
struct Camera {
    rng: Xoshiro256PlusPlus,
    drift: f64,
    offset_ns: i64,
    delays: Delays,
    mean_delay_ns: f64,
}

impl Camera {
    fn new(seed: u64, drift: f64, offset_ns: i64) -> Self {
        Self {
            rng: Xoshiro256PlusPlus::seed_from_u64(seed),
            drift,
            offset_ns,
            delays: Delays::Exponential,
            mean_delay_ns: 1e6,
        }
    }

    /// The stamp and arrival of a frame taken at a host time.
    fn frame(&mut self, taken_ns: i64) -> (i64, i64) {
        let camera_ns = taken_ns - START_NS
            + self.offset_ns
            + (self.drift * (taken_ns - START_NS) as f64) as i64;
        let held_up = self.delays.sample(&mut self.rng);
        let delay_ns = LEAST_DELAY_NS + self.mean_delay_ns * held_up;
        (camera_ns, taken_ns + delay_ns as i64)
    }
}

fn taken(n: i64) -> i64 {
    START_NS + n * PERIOD_NS
}

/// The errors in σ after each of `at` frames, of many cameras.
fn normalised_errors(delays: Delays, at: i64) -> Vec<f64> {
    (0..200)
        .map(|seed| {
            let mut camera = Camera::new(seed, 50e-6, 3_000_000);
            camera.delays = delays;
            let mut clock = ClockMap::new();
            let mut error = 0.0;
            for n in 0..=at {
                let (camera_ns, arrived_ns) = camera.frame(taken(n));
                let mapped = clock.map(camera_ns, arrived_ns);
                let truth = taken(n) as f64 + LEAST_DELAY_NS;
                error = (mapped.host_ns as f64 - truth) / mapped.sigma_ns;
            }
            error
        })
        .collect()
}

/// σ is honest: neither so small that errors leave it, nor so large that it says nothing.
#[test]
fn stated_sigmas_hold_for_any_delays_at_any_time() {
    for delays in Delays::ALL {
        for at in [3, 10, 30, 100, 300, 1200] {
            let errors = normalised_errors(delays, at);
            let n = errors.len() as f64;
            let rms = (errors.iter().map(|e| e * e).sum::<f64>() / n).sqrt();
            let beyond = errors.iter().filter(|e| e.abs() > 3.0).count() as f64 / n;
            println!("{delays:?} after {at}: rms {rms:.2} σ, {beyond:.3} beyond 3 σ");
            assert!(rms < 1.5, "{delays:?} after {at}: rms {rms} σ");
            assert!(beyond < 0.04, "{delays:?} after {at}: {beyond} beyond 3 σ");
            assert!(rms > 0.5, "{delays:?} after {at}: rms {rms} σ says nothing");
        }
    }
}

#[test]
fn the_drift_is_found_within_its_sigma() {
    for (seed, drift) in [(1, 50e-6), (2, -50e-6), (3, 0.0), (4, 120e-6)] {
        let mut camera = Camera::new(seed, drift, 0);
        let mut clock = ClockMap::new();
        for n in 0..2400 {
            let (camera_ns, arrived_ns) = camera.frame(taken(n));
            clock.map(camera_ns, arrived_ns);
        }
        let fit = clock.fit().expect("a fit");
        // The host's clock by the camera's is the inverse of the camera's by the host's.
        let expected = 1.0 / (1.0 + drift) - 1.0;
        let off = (fit.drift() - expected).abs();
        assert!(
            off < 3.0 * fit.sigma_drift(),
            "{off} with σ {}",
            fit.sigma_drift()
        );
        assert!(fit.sigma_drift() < 3e-6, "{}", fit.sigma_drift());
    }
}

/// Two cameras whose clocks differ by 3 ms and 50 ppm: what is estimated of their offset is off by what
/// it says, no more and no less.
#[test]
fn the_offset_between_two_cameras_is_found_within_its_sigma() {
    const RUNS: u64 = 200;
    for (seconds, delays) in [
        (8, Delays::HeldUp),
        (8, Delays::Gamma(2.0)),
        (60, Delays::HeldUp),
    ] {
        let mut squares = Vec::new();
        let mut largest_ns = 0_f64;
        for seed in 0..RUNS {
            let mut cameras = [
                Camera::new(seed, 0.0, 0),
                Camera::new(1000 + seed, 50e-6, 3_000_000),
            ];
            let mut clocks = [ClockMap::new(), ClockMap::new()];
            let mut last = [None; 2];
            for n in 0..seconds * 20 {
                for side in 0..2 {
                    cameras[side].delays = delays;
                    let (camera_ns, arrived_ns) = cameras[side].frame(taken(n));
                    last[side] = Some(clocks[side].map(camera_ns, arrived_ns));
                }
            }
            let [left, right] = last.map(|m| m.expect("mapped"));
            // Taken at the same instant: any difference is error.
            let difference_ns = (right.host_ns - left.host_ns) as f64;
            let sigma_ns = left.sigma_ns.hypot(right.sigma_ns);
            largest_ns = largest_ns.max(sigma_ns);
            squares.push((difference_ns / sigma_ns).powi(2));
        }
        let n = squares.len() as f64;
        let anees = squares.iter().sum::<f64>() / n;
        let within =
            |sigmas: f64| squares.iter().filter(|s| **s < sigmas * sigmas).count() as f64 / n;
        let (low, high) = anees_interval(1, RUNS as usize, 0.99);
        println!(
            "{delays:?} for {seconds} s: ANEES {anees:.2} of {low:.2} to {high:.2}, within 1, 2, 3 σ: \
             {:.3} {:.3} {:.3}, σ up to {:.1} µs",
            within(1.0),
            within(2.0),
            within(3.0),
            largest_ns * 1e-3
        );
        assert!(anees < high, "{delays:?} for {seconds} s: {anees}");
        assert!(
            anees > 0.5 * low,
            "{delays:?} for {seconds} s: {anees} says nothing"
        );
        assert!(
            within(3.0) >= 0.97,
            "{delays:?} for {seconds} s: {}",
            within(3.0)
        );
        assert!(largest_ns < 400_000.0, "{largest_ns} ns says nothing");
    }
}

#[test]
fn a_clock_of_few_bits_wraps_and_nothing_is_lost() {
    for modulus_ns in WRAPS_NS {
        let mut camera = Camera::new(7, 20e-6, modulus_ns - 20 * PERIOD_NS - 777);
        let mut clock = ClockMap::new();
        let mut events = Vec::new();
        for n in 0..200 {
            let (camera_ns, arrived_ns) = camera.frame(taken(n));
            let mapped = clock.map(camera_ns.rem_euclid(modulus_ns), arrived_ns);
            events.extend(mapped.event);
            let error = mapped.host_ns as f64 - (taken(n) as f64 + LEAST_DELAY_NS);
            assert!(error.abs() < 4.0 * mapped.sigma_ns, "frame {n}: {error} ns");
        }
        assert!(!events.is_empty());
        for event in events {
            assert_eq!(event, ClockEvent::Wrapped { modulus_ns });
        }
    }
}

#[test]
fn a_camera_that_restarts_is_recognised_at_once() {
    let mut camera = Camera::new(8, 20e-6, 700_000_000_123);
    let mut clock = ClockMap::new();
    for n in 0..100 {
        if n == 60 {
            camera.offset_ns = -60 * PERIOD_NS;
        }
        let (camera_ns, arrived_ns) = camera.frame(taken(n));
        let mapped = clock.map(camera_ns, arrived_ns);
        assert_eq!(
            matches!(mapped.event, Some(ClockEvent::Stepped { .. })),
            n == 60,
            "frame {n}: {mapped:?}"
        );
        let error = mapped.host_ns as f64 - (taken(n) as f64 + LEAST_DELAY_NS);
        assert!(error.abs() < 5.0 * mapped.sigma_ns, "frame {n}: {error} ns");
    }
}

#[test]
fn a_clock_that_is_set_ahead_is_recognised_at_once_and_one_set_back_soon() {
    for (step_ns, within) in [(2_000_000_000, 0), (40_000_000, 0), (-149_000_000, 12)] {
        let mut camera = Camera::new(9, 20e-6, 5_000_000_000);
        let mut clock = ClockMap::new();
        let mut recognised = None;
        for n in 0..160 {
            if n == 100 {
                camera.offset_ns += step_ns;
            }
            let (camera_ns, arrived_ns) = camera.frame(taken(n));
            let mapped = clock.map(camera_ns, arrived_ns);
            if let Some(ClockEvent::Stepped { by_ns }) = mapped.event {
                assert!(
                    (by_ns - step_ns).abs() < 60_000_000,
                    "{by_ns} for {step_ns}"
                );
                assert_eq!(recognised, None);
                recognised = Some(n);
            }
        }
        let recognised = recognised.expect("recognised");
        assert!(
            (100..=100 + within).contains(&recognised),
            "{recognised} for {step_ns}"
        );
    }
}

/// A host that is busy for a second or two at a time holds up even the most punctual frames. No fit can tell
/// that from a drift every time, but σ must know of it.
#[test]
fn a_floor_that_creeps_is_no_drift() {
    const RUNS: u64 = 200;
    for (creep_ns, seconds) in [(100e3, 8), (500e3, 8), (500e3, 50)] {
        let mut errors = Vec::new();
        for seed in 0..RUNS {
            let mut camera = Camera::new(seed, 50e-6, 3_000_000);
            camera.mean_delay_ns = 20e3;
            let mut load = Xoshiro256PlusPlus::seed_from_u64(5000 + seed);
            let mut clock = ClockMap::new();
            let (mut held_up_ns, mut until) = (0.0, 0);
            let mut last = None;
            for n in 0..seconds * 20 {
                if n == until {
                    held_up_ns = creep_ns * load.random::<f64>();
                    until = n + load.random_range(10..40);
                }
                let (camera_ns, arrived_ns) = camera.frame(taken(n));
                last = Some((n, clock.map(camera_ns, arrived_ns + held_up_ns as i64)));
            }
            let (n, mapped) = last.expect("mapped");
            let truth = taken(n) as f64 + LEAST_DELAY_NS;
            errors.push((mapped.host_ns as f64 - truth) / mapped.sigma_ns);
        }
        let n = errors.len() as f64;
        let rms = (errors.iter().map(|e| e * e).sum::<f64>() / n).sqrt();
        let beyond = errors.iter().filter(|e| e.abs() > 3.0).count() as f64 / n;
        println!("{creep_ns} ns over {seconds} s: rms {rms:.2} σ, {beyond:.3} beyond 3 σ");
        assert!(
            rms > 0.3,
            "{creep_ns} ns over {seconds} s: rms {rms} σ says nothing"
        );
        assert!(rms < 2.2, "{creep_ns} ns over {seconds} s: rms {rms} σ");
        assert!(
            beyond < 0.06,
            "{creep_ns} ns over {seconds} s: {beyond} beyond 3 σ"
        );
    }
}

/// A busy host hands over a backlog: late, but no step.
#[test]
fn a_backlog_is_no_step() {
    let mut camera = Camera::new(10, 20e-6, 0);
    let mut clock = ClockMap::new();
    for n in 0..300 {
        let (camera_ns, arrived_ns) = camera.frame(taken(n));
        let held = (100..140).contains(&n);
        let arrived_ns = if held {
            arrived_ns.max(taken(140) + n * 1000)
        } else {
            arrived_ns
        };
        let mapped = clock.map(camera_ns, arrived_ns);
        assert_eq!(mapped.event, None, "frame {n}");
        let error = mapped.host_ns as f64 - (taken(n) as f64 + LEAST_DELAY_NS);
        assert!(
            n < 20 || error.abs() < 5.0 * mapped.sigma_ns,
            "frame {n}: {error} ns"
        );
    }
}

#[test]
fn mapped_stamps_rise() {
    let mut camera = Camera::new(11, -80e-6, 0);
    camera.mean_delay_ns = 20e6;
    let mut clock = ClockMap::new();
    let mut last = i64::MIN;
    for n in 0..500 {
        let (camera_ns, arrived_ns) = camera.frame(START_NS + n * 2_000_000);
        let mapped = clock.map(camera_ns, arrived_ns);
        assert!(mapped.event.is_some() || mapped.host_ns > last, "frame {n}");
        last = mapped.host_ns;
    }
}
