//! How long a whole pair takes, from images in memory to its row: `cargo bench --bench pipeline`.
//!
//! It also shows how the processor's time divides over the stages, and the latency of a steady stream of
//! 40 pairs a second. With words after `--` it shows something else: `growth`, how the time grows with pixels
//! and with keypoints; `endurance [PAIRS]`, whether time and memory stay flat over 10,000 pairs;
//! `paced [HZ]`, the latency at another rate; `with FILE…`, whole pairs with other configurations; `profile [PAIRS]`, the
//! simulated recording once, as a profiler likes it.

mod common;

use common::memory::{Recording, ToAndFro, with_turns};
use common::{memory_mb, ms, process_time, thread_time, words};
use std::convert::Infallible;
use std::ops::ControlFlow;
use std::path::Path;
use std::time::{Duration, Instant};
use visod::capture::{PairEvent, PairSource, StereoPair};
use visod::config::Config;
use visod::features::{self, Extractor};
use visod::geometry::StereoRig;
use visod::matching::Partners;
use visod::pipeline::{self, Delivery, DescribedPair, Method, StageLatencies};
use visod::simulation::{small_rig, thesis_rig};

/// Pairs of one measurement.
const PAIRS: u64 = 100;
/// Pairs before that, which grow the buffers.
const WARM_UP: u64 = 20;
/// Pairs of the measurement at a rate.
const PACED: u64 = 400;
/// Different pairs of a simulated recording.
const FRAMES: u64 = 12;

fn main() {
    let words = words();
    let number = words.get(1).and_then(|word| word.parse().ok());
    match words.first().map(String::as_str) {
        Some("growth") => growth(),
        Some("endurance") => endurance(number.unwrap_or(10_000.0) as u64),
        Some("with") => {
            let files = words[1..].iter();
            let cases = files.map(|file| (file.clone(), loaded(Path::new(file)), 2));
            throughput(&cases.collect::<Vec<_>>());
        }
        Some("paced") => paced(number.unwrap_or(40.0)),
        Some("profile") => {
            let recording = Recording::simulated(thesis_rig(), FRAMES);
            let run = Run::of(&recording, number.unwrap_or(300.0) as u64, &usual(), 2);
            println!("{:.2} ms of processor time a pair", run.cpu_ms);
        }
        _ => {
            throughput(&[
                ("default".to_owned(), usual(), 2),
                ("default".to_owned(), usual(), 1),
                ("partners by surroundings".to_owned(), by_surroundings(), 2),
                ("lean.toml".to_owned(), lean(), 2),
            ]);
            division();
            paced(40.0);
        }
    }
}

/// The default configuration, for a recording that turns.
fn usual() -> Config {
    turning(Config::default())
}

/// The same with another number of keypoints an image.
fn budgeted(budget: usize) -> Config {
    let mut config = usual();
    config.features.surf.budget = budget;
    config
}

/// The same, but that no features are found on the right.
fn by_surroundings() -> Config {
    let mut config = usual();
    config.matching.partners = Partners::Surroundings;
    config
}

/// What is shipped for computers with little to spare.
fn lean() -> Config {
    loaded(&Path::new(env!("CARGO_MANIFEST_DIR")).join("config/lean.toml"))
}

/// A configuration file's.
fn loaded(path: &Path) -> Config {
    turning(common::loaded(path))
}

fn turning(mut config: Config) -> Config {
    config.estimation = with_turns(config.estimation);
    config
}

/// What a run over a recording in memory came to.
struct Run {
    wall_ms: f64,
    cpu_ms: f64,
    /// Of each counted pair.
    latencies: Vec<StageLatencies>,
}

impl Run {
    fn of(recording: &Recording, pairs: u64, config: &Config, workers: usize) -> Self {
        let source = recording.source(WARM_UP + pairs);
        Self::over(&recording.rig, source, config, workers, |_| ())
    }

    /// Carries a whole source through the pipeline; `see` is told of each counted pair.
    fn over(
        rig: &StereoRig,
        source: impl PairSource,
        config: &Config,
        workers: usize,
        mut see: impl FnMut(usize),
    ) -> Self {
        let mut method = method(rig, config);
        let extractors = (0..workers).map(|_| extractor(config)).collect();
        let (mut start, mut start_cpu) = (Instant::now(), process_time());
        let mut rows = 0;
        let mut latencies = Vec::with_capacity(1 << 14);
        let deliver = |delivery: Delivery<'_>| {
            rows += 1;
            if rows == WARM_UP {
                (start, start_cpu) = (Instant::now(), process_time());
            } else if rows > WARM_UP {
                latencies.push(delivery.latencies);
                see(latencies.len());
            }
            Ok::<_, Infallible>(ControlFlow::Continue(()))
        };
        let result = pipeline::run(source, extractors, &mut method, deliver);
        assert!(result.is_ok());
        let counted = latencies.len().max(1) as f64;
        Self {
            wall_ms: ms(start.elapsed()) / counted,
            cpu_ms: ms(process_time().saturating_sub(start_cpu)) / counted,
            latencies,
        }
    }

    /// A stage's latency that a share of the pairs does not exceed, ms.
    fn quantile_ms(&self, stage: impl Fn(&StageLatencies) -> Duration, share: f64) -> f64 {
        let mut times: Vec<Duration> = self.latencies.iter().map(stage).collect();
        times.sort_unstable();
        ms(times[(share * (times.len() - 1) as f64) as usize])
    }
}

fn method(rig: &StereoRig, config: &Config) -> Method {
    match Method::new(
        rig.clone(),
        config.matching.clone(),
        config.estimation.clone(),
    ) {
        Some(method) => method,
        None => unreachable!("the cameras stand side by side"),
    }
}

fn extractor(config: &Config) -> Box<dyn Extractor> {
    match features::extractor(&config.features) {
        Ok(extractor) => extractor,
        Err(e) => unreachable!("{}: {}", e.key, e.cause),
    }
}

fn throughput(cases: &[(String, Config, usize)]) {
    println!("\n### Pipeline: whole pairs from memory\n");
    println!(
        "| recording | configuration | workers | wall ms a pair | processor ms a pair | features | matching | estimation | estimation's share | resident MB |"
    );
    println!("|---|---|---:|---:|---:|---:|---:|---:|---:|---:|");
    let simulated = Recording::simulated(thesis_rig(), FRAMES);
    let kitti = Recording::recorded("kitti_straight", 20);
    let recordings = [("1280 × 960", Some(simulated)), ("KITTI", kitti)];
    for (name, recording) in recordings {
        let Some(recording) = recording else {
            println!("| {name} | skipped: the recording is not there |");
            continue;
        };
        for (configuration, config, workers) in cases {
            // The least disturbed of three.
            let runs = [(); 3].map(|()| Run::of(&recording, PAIRS, config, *workers));
            let Some(run) = runs.iter().min_by(|a, b| a.cpu_ms.total_cmp(&b.cpu_ms)) else {
                continue;
            };
            let wall_ms = runs
                .iter()
                .map(|run| run.wall_ms)
                .fold(f64::INFINITY, f64::min);
            let median = |stage: fn(&StageLatencies) -> Duration| run.quantile_ms(stage, 0.5);
            let estimation_ms = median(|l| l.estimation);
            println!(
                "| {name} | {configuration} | {workers} | {wall_ms:.2} | {:.2} | {:.2} | {:.2} | {estimation_ms:.2} | {:.0} % | {:.0} |",
                run.cpu_ms,
                median(|l| l.features),
                median(|l| l.matching),
                100.0 * estimation_ms / run.cpu_ms,
                memory_mb("VmRSS")
            );
        }
    }
    println!(
        "\nThe stages' columns are medians on the wall; features are those of the slower image."
    );
}

/// Where the processor's time goes, pair by pair in one thread.
fn division() {
    println!("\n### Division: processor time a pair, one thread, median ms\n");
    println!(
        "| recording | configuration | features, both images | reductions, both | matching | estimation | all |"
    );
    println!("|---|---|---:|---:|---:|---:|---:|");
    let simulated = Recording::simulated(thesis_rig(), FRAMES);
    let kitti = Recording::recorded("kitti_straight", 20);
    for (name, recording) in [("1280 × 960", Some(simulated)), ("KITTI", kitti)] {
        let Some(recording) = recording else {
            println!("| {name} | skipped: the recording is not there |");
            continue;
        };
        for (configuration, config) in [("default", usual()), ("lean.toml", lean())] {
            let mut times = divided(&recording, &config);
            let all = (0..times[0].len()).map(|n| times.iter().map(|stage| stage[n]).sum());
            let mut all: Vec<f64> = all.collect();
            let median = |times: &mut Vec<f64>| {
                times.sort_unstable_by(f64::total_cmp);
                times[times.len() / 2]
            };
            let all_ms = median(&mut all);
            let [features, reductions, matching, estimation] = times.each_mut().map(median);
            println!(
                "| {name} | {configuration} | {features:.2} | {reductions:.2} | {matching:.2} | {estimation:.2} | {all_ms:.2} |"
            );
        }
    }
}

/// What each pair took in features, reductions, matching and estimation, ms.
fn divided(recording: &Recording, config: &Config) -> [Vec<f64>; 4] {
    let (mut method, mut extractor) = (method(&recording.rig, config), extractor(config));
    let mut pair = DescribedPair::default();
    let mut times: [Vec<f64>; 4] = Default::default();
    for place in 0..WARM_UP + PAIRS {
        let images = &recording.pairs[recording.index(place)];
        let begun = thread_time();
        for (image, side) in [
            (&images.left, &mut pair.left),
            (&images.right, &mut pair.right),
        ] {
            assert_eq!(extractor.extract(image, &mut side.features), Ok(()));
        }
        let found = thread_time();
        pair.left.take(&images.left);
        pair.right.take(&images.right);
        let reduced = thread_time();
        (pair.sequence, pair.timestamp_ns) = (place, 100_000_000 * place as i64);
        assert!(method.step(&mut pair).is_ok());
        let stepped = ms(thread_time() - reduced);
        // The method says what its two stages took on the wall; the processor's time is shared alike.
        let wall = method.times();
        let share = ms(wall.matching) / ms(wall.matching + wall.estimation).max(1e-9);
        if place >= WARM_UP {
            let stages = [ms(found - begun), ms(reduced - found), share * stepped];
            let stages = [stages[0], stages[1], stages[2], (1.0 - share) * stepped];
            times
                .iter_mut()
                .zip(stages)
                .for_each(|(all, one)| all.push(one));
        }
    }
    times
}

fn growth() {
    println!("\n### Growth: processor time a pair\n");
    println!(
        "| image | megapixels | keypoints | features ms | per megapixel | matching ms | per thousand keypoints | all ms |"
    );
    println!("|---|---:|---:|---:|---:|---:|---:|---:|");
    let large = Recording::simulated(thesis_rig(), 4);
    let twice = enlarged(&large);
    let small = Recording::simulated(small_rig(), 4);
    let mut cases = vec![("320 × 240", small, 1000)];
    for budget in [500, 1000, 2000, 4000] {
        cases.push(("1280 × 960", large.clone(), budget));
    }
    cases.push(("2560 × 1920", twice, 1000));
    if let Some(kitti) = Recording::recorded("kitti_straight", 20) {
        for budget in [400, 600, 1000] {
            cases.push(("KITTI", kitti.clone(), budget));
        }
    }
    for (name, recording, budget) in cases {
        let config = budgeted(budget);
        let runs = [(); 3].map(|()| Run::of(&recording, 40, &config, 1));
        let best = |stage: fn(&StageLatencies) -> Duration| {
            let times = runs.iter().map(|run| run.quantile_ms(stage, 0.1));
            times.fold(f64::INFINITY, f64::min)
        };
        let image = &recording.pairs[0].left;
        let megapixels = f64::from(image.width()) * f64::from(image.height()) * 1e-6;
        let (features_ms, matching_ms) = (best(|l| l.features), best(|l| l.matching));
        let cpu_ms = runs
            .iter()
            .map(|run| run.cpu_ms)
            .fold(f64::INFINITY, f64::min);
        println!(
            "| {name} | {megapixels:.2} | {budget} | {features_ms:.2} | {:.2} | {matching_ms:.2} | {:.2} | {cpu_ms:.2} |",
            features_ms / megapixels,
            1000.0 * matching_ms / budget as f64
        );
    }
}

/// A recording four times as large: each image beside and below itself.
fn enlarged(recording: &Recording) -> Recording {
    let tile = |image: &visod::image::GrayImage| {
        let (width, height) = (image.width() as usize, image.height() as usize);
        let mut pixels = Vec::with_capacity(4 * width * height);
        for y in 0..2 * height {
            let row = image.row((y % height) as u32);
            pixels.extend_from_slice(row);
            pixels.extend_from_slice(row);
        }
        match visod::image::GrayImage::from_vec(2 * width as u32, 2 * height as u32, pixels) {
            Some(image) => image,
            None => unreachable!("as many pixels as the size says"),
        }
    };
    let mut rig = recording.rig.clone();
    for camera in [&mut rig.left, &mut rig.right] {
        (camera.width, camera.height) = (2 * camera.width, 2 * camera.height);
    }
    let pairs = recording.pairs.iter().map(|pair| StereoPair {
        left: tile(&pair.left),
        right: tile(&pair.right),
        ..pair.clone()
    });
    Recording {
        rig,
        pairs: pairs.collect(),
    }
}

fn endurance(pairs: u64) {
    println!("\n### Endurance: {pairs} pairs of 320 × 240\n");
    println!("| pairs | processor ms a pair | resident MB |");
    println!("|---:|---:|---:|");
    let recording = Recording::simulated(small_rig(), FRAMES);
    let lap = (pairs / 10).max(1) as usize;
    let mut start = process_time();
    let see = |counted: usize| {
        if counted.is_multiple_of(lap) {
            let cpu_ms = ms(process_time() - start) / lap as f64;
            println!("| {counted} | {cpu_ms:.2} | {:.1} |", memory_mb("VmRSS"));
            start = process_time();
        }
    };
    let source = recording.source(WARM_UP + pairs);
    Run::over(&recording.rig, source, &usual(), 2, see);
}

/// Two cameras that show a recording at a rate, whether or not anybody is ready: of two pairs that wait the older
/// one is lost.
struct Cameras {
    recording: ToAndFro,
    began: Instant,
    period: Duration,
}

impl Cameras {
    /// When a pair is there.
    fn due(&self, place: u64) -> Instant {
        self.began + self.period * place as u32
    }
}

impl PairSource for Cameras {
    fn next_event(&mut self) -> Option<PairEvent> {
        while Instant::now() >= self.due(self.recording.place() + 1) {
            self.recording.skip();
        }
        let due = self.due(self.recording.place());
        let event = self.recording.next_event()?;
        std::thread::sleep(due.saturating_duration_since(Instant::now()));
        Some(event)
    }

    fn is_live(&self) -> bool {
        true
    }

    fn make_room(&mut self, pairs_held: usize) {
        self.recording.make_room(pairs_held);
    }

    fn recycle(&mut self, pair: StereoPair) {
        self.recording.recycle(pair);
    }
}

fn paced(rate_hz: f64) {
    println!("\n### Latency at {rate_hz} pairs a second, 1280 × 960, 1,000 keypoints an image\n");
    println!("| median ms | p99 ms | slowest ms | pairs a second | lost |");
    println!("|---:|---:|---:|---:|---:|");
    let recording = Recording::simulated(thesis_rig(), FRAMES);
    let config = usual();
    let mut method = method(&recording.rig, &config);
    let period = Duration::from_secs_f64(1.0 / rate_hz);
    // The threads are there by then.
    let began = Instant::now() + Duration::from_millis(100);
    let cameras = Cameras {
        recording: recording.source(WARM_UP + PACED),
        began,
        period,
    };
    let mut latencies = Vec::with_capacity(PACED as usize);
    let deliver = |delivery: Delivery<'_>| {
        let sequence = delivery.odometry.sequence;
        if sequence >= WARM_UP {
            latencies.push((began + period * sequence as u32).elapsed());
        }
        Ok::<_, Infallible>(ControlFlow::Continue(()))
    };
    let extractors = vec![extractor(&config), extractor(&config)];
    let result = pipeline::run(cameras, extractors, &mut method, deliver);
    assert!(result.is_ok());
    latencies.sort_unstable();
    let at = |share: f64| ms(latencies[(share * (latencies.len() - 1) as f64) as usize]);
    println!(
        "| {:.1} | {:.1} | {:.1} | {:.1} | {} |",
        at(0.5),
        at(0.99),
        at(1.0),
        rate_hz * latencies.len() as f64 / PACED as f64,
        PACED - latencies.len() as u64
    );
}
