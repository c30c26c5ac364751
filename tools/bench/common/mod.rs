//! What the benches share: clocks, tables, and recordings held in memory.

#![allow(dead_code, reason = "each bench takes what it needs")]

#[cfg(feature = "ipc")]
pub mod daemon;
pub mod memory;

use std::time::{Duration, Instant};

/// What many runs of one thing took, shortest first.
pub struct Times {
    /// Processor time of the thread, which what else the machine does lengthens little.
    cpu: Vec<Duration>,
    /// Time on the wall.
    wall: Vec<Duration>,
}

impl Times {
    /// Times `runs` runs after a first that does not count.
    pub fn of(runs: usize, mut run: impl FnMut()) -> Self {
        run();
        let (mut cpu, mut wall) = (Vec::with_capacity(runs), Vec::with_capacity(runs));
        for _ in 0..runs.max(1) {
            let (start, start_cpu) = (Instant::now(), thread_time());
            run();
            cpu.push(thread_time().saturating_sub(start_cpu));
            wall.push(start.elapsed());
        }
        cpu.sort_unstable();
        wall.sort_unstable();
        Self { cpu, wall }
    }

    /// The shortest processor time, ms.
    pub fn best_ms(&self) -> f64 {
        ms(self.cpu[0])
    }

    /// The median of the processor times, ms.
    pub fn median_ms(&self) -> f64 {
        ms(self.cpu[self.cpu.len() / 2])
    }

    /// The median of the times on the wall, ms.
    pub fn wall_ms(&self) -> f64 {
        ms(self.wall[self.wall.len() / 2])
    }
}

/// A duration, ms.
pub fn ms(time: Duration) -> f64 {
    time.as_secs_f64() * 1e3
}

/// The time that `share` of sorted times do not exceed, µs.
pub fn quantile_us(sorted: &[Duration], share: f64) -> f64 {
    let at = (share * sorted.len() as f64).ceil() as usize;
    let time = sorted.get(at.saturating_sub(1));
    time.map_or(f64::NAN, |time| time.as_secs_f64() * 1e6)
}

/// Begins a table of times.
pub fn head(title: &str) {
    println!("\n### {title}\n");
    println!("| work | best ms | median ms | on the wall ms | |");
    println!("|---|---:|---:|---:|---|");
}

/// One line of a table of times: best and median processor time, median on the wall, a remark.
pub fn line(work: &str, times: &Times, remark: &str) {
    println!(
        "| {work} | {:.2} | {:.2} | {:.2} | {remark} |",
        times.best_ms(),
        times.median_ms(),
        times.wall_ms()
    );
}

/// Processor time of this thread so far.
pub fn thread_time() -> Duration {
    clock(rustix::time::ClockId::ThreadCPUTime)
}

/// Processor time of all threads of this process so far.
pub fn process_time() -> Duration {
    clock(rustix::time::ClockId::ProcessCPUTime)
}

fn clock(id: rustix::time::ClockId) -> Duration {
    let time = rustix::time::clock_gettime(id);
    Duration::new(time.tv_sec as u64, time.tv_nsec as u32)
}

/// A line of `/proc/self/status`, MB.
pub fn memory_mb(key: &str) -> f64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix(key));
    let kib = line.and_then(|line| line.trim_start_matches(':').trim().strip_suffix("kB"));
    kib.and_then(|kib| kib.trim().parse::<f64>().ok())
        .map_or(f64::NAN, |kib| kib * 1024.0 / 1e6)
}

/// The words of the command line that are not for cargo.
pub fn words() -> Vec<String> {
    std::env::args()
        .skip(1)
        .filter(|word| !word.starts_with("--"))
        .collect()
}

/// A configuration file's settings; what is wrong with it ends the bench.
pub fn loaded(path: &std::path::Path) -> visod::config::Config {
    match visod::config::Config::load(path) {
        Ok(config) => config,
        Err(e) => unreachable!("only what loads is asked for: {e}"),
    }
}
