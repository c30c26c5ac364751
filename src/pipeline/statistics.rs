//! What a run came to: counts, latencies stage by stage, processor time and memory.

use super::histogram::Histogram;
use super::{Fault, Stage, StageLatencies};
use crate::estimation::{Odometry, Status};
use serde::Serialize;
use std::time::{Duration, Instant};

/// Gathers a run's figures.
#[derive(Debug)]
pub struct Statistics {
    started: Instant,
    cpu_at_start: Duration,
    counts: RunCounts,
    latencies: [Histogram; STAGES.len()],
    inliers: u64,
    path_m: f64,
    first_epoch: Option<u32>,
    first_ns: Option<i64>,
    last_ns: i64,
}

/// How many pairs had which fate.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct RunCounts {
    /// Rows written: all pairs of the recording.
    pub pairs: u64,
    /// Pairs that could not be used.
    pub unusable: u64,
    /// Those of them whose images never came, or could not be read.
    pub unusable_in_capture: u64,
    /// Those of them in which no features could be looked for.
    pub unusable_in_features: u64,
    /// Those of them of which an image is one that the camera had shown before.
    pub unusable_as_repeats: u64,
    /// Those of them whose features could not be matched.
    pub unusable_in_matching: u64,
    /// Pairs that began an odometry frame.
    pub initializing: u64,
    /// Pairs with a measured motion.
    pub tracking: u64,
    /// Pairs with a motion measured from little.
    pub degraded: u64,
    /// Pairs that were bridged.
    pub lost: u64,
    /// Pairs dropped because the pipeline was late: none in a replay at maximum pace.
    pub dropped: u64,
    /// How often the odometry frame began anew.
    pub restarts: u64,
}

/// The figures of a run.
#[derive(Clone, Debug, Serialize)]
pub struct RunFigures {
    /// Pairs by fate.
    #[serde(flatten)]
    pub counts: RunCounts,
    /// Length of the estimated path, m.
    pub path_m: f64,
    /// Time between the first and the last pair of the recording, s.
    pub recorded_s: f64,
    /// Time that the run took, s.
    pub wall_s: f64,
    /// Pairs a second.
    pub pairs_per_s: f64,
    /// Processor time a pair, all threads, reading included, ms.
    pub cpu_ms_per_pair: f64,
    /// Largest resident memory of the process, MB; 0 where the system does not tell.
    pub peak_memory_mb: f64,
    /// Mean number of tracks that a measured motion rests on.
    pub mean_inliers: f64,
    /// Latencies stage by stage.
    pub latency_ms: Vec<StageFigures>,
}

/// One stage's latencies, ms.
#[derive(Clone, Debug, Serialize)]
pub struct StageFigures {
    /// The stage.
    pub stage: &'static str,
    /// Half of the pairs took less.
    pub median: f64,
    /// One of a hundred took more.
    pub p99: f64,
    /// The slowest.
    pub max: f64,
}

const STAGES: [&str; 4] = ["features", "matching", "estimation", "total"];

impl Statistics {
    /// Starts the clocks.
    #[must_use]
    pub fn start() -> Self {
        Self {
            started: Instant::now(),
            cpu_at_start: cpu_time(),
            counts: RunCounts::default(),
            latencies: Default::default(),
            inliers: 0,
            path_m: 0.0,
            first_epoch: None,
            first_ns: None,
            last_ns: 0,
        }
    }

    /// Takes note of a pair.
    pub fn add(
        &mut self,
        odometry: &Odometry,
        latencies: &StageLatencies,
        fault: Option<Fault<'_>>,
    ) {
        let counts = &mut self.counts;
        counts.pairs += 1;
        match odometry.status {
            Status::Initializing => counts.initializing += 1,
            Status::Tracking => counts.tracking += 1,
            Status::Degraded => counts.degraded += 1,
            Status::Lost => counts.lost += 1,
        }
        let first_epoch = *self.first_epoch.get_or_insert(odometry.epoch);
        counts.restarts = u64::from(odometry.epoch.saturating_sub(first_epoch));
        self.inliers += u64::from(odometry.counts.inliers);
        self.path_m += odometry.prev_from_now.translation.vector.norm();
        self.first_ns.get_or_insert(odometry.timestamp_ns);
        self.last_ns = odometry.timestamp_ns;
        if let Some(fault) = fault {
            counts.unusable += 1;
            match fault.stage {
                Stage::Capture => counts.unusable_in_capture += 1,
                Stage::Features => counts.unusable_in_features += 1,
                Stage::Repeats => counts.unusable_as_repeats += 1,
                Stage::Matching => counts.unusable_in_matching += 1,
            }
            return;
        }
        let stages = [
            latencies.features,
            latencies.matching,
            latencies.estimation,
            latencies.total,
        ];
        for (latencies, took) in self.latencies.iter_mut().zip(stages) {
            latencies.add(took);
        }
    }

    /// Pairs so far, by fate.
    #[must_use]
    pub fn counts(&self) -> &RunCounts {
        &self.counts
    }

    /// The figures up to now.
    #[must_use]
    pub fn figures(&self) -> RunFigures {
        let wall_s = self.started.elapsed().as_secs_f64();
        let pairs = self.counts.pairs.max(1) as f64;
        let measured = (self.counts.tracking + self.counts.degraded).max(1) as f64;
        RunFigures {
            counts: self.counts,
            path_m: self.path_m,
            recorded_s: self
                .first_ns
                .map_or(0.0, |first| (self.last_ns - first) as f64 * 1e-9),
            wall_s,
            pairs_per_s: self.counts.pairs as f64 / wall_s.max(1e-9),
            cpu_ms_per_pair: (cpu_time().saturating_sub(self.cpu_at_start)).as_secs_f64() * 1e3
                / pairs,
            peak_memory_mb: peak_memory_mb(),
            mean_inliers: self.inliers as f64 / measured,
            latency_ms: STAGES
                .iter()
                .zip(&self.latencies)
                .map(|(stage, latencies)| StageFigures::of(stage, latencies))
                .collect(),
        }
    }
}

impl StageFigures {
    fn of(stage: &'static str, latencies: &Histogram) -> Self {
        let ms = |time: Duration| time.as_secs_f64() * 1e3;
        Self {
            stage,
            median: ms(latencies.quantile(0.5)),
            p99: ms(latencies.quantile(0.99)),
            max: ms(latencies.greatest()),
        }
    }
}

/// Processor time of all threads of this process so far.
fn cpu_time() -> Duration {
    let t = rustix::time::clock_gettime(rustix::time::ClockId::ProcessCPUTime);
    Duration::new(
        u64::try_from(t.tv_sec).unwrap_or(0),
        u32::try_from(t.tv_nsec).unwrap_or(0),
    )
}

/// The kernel's own record of the largest resident memory, MB.
fn peak_memory_mb() -> f64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"));
    let kib = line.and_then(|l| l.trim().trim_end_matches("kB").trim().parse::<f64>().ok());
    kib.unwrap_or(0.0) * 1024.0 / 1e6
}
