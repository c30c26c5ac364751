//! Many pairs through the whole daemon: does anything grow? `cargo bench --bench soak [-- PAIRS [RATE_HZ]]`.
//!
//! The daemon follows two cameras that are files of 320 × 240 px, looks for few features, publishes to a subscriber in another
//! process, answers for Prometheus and keeps its last pose. A tenth of the pairs is for warming up.

mod common;

use common::daemon::{Daemon, record, render};
use common::words;
use std::path::Path;
use visod::simulation::small_rig;

type Fallible<T> = Result<T, Box<dyn std::error::Error>>;

/// What a process holds.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Holdings {
    resident_kib: u64,
    descriptors: usize,
    /// Files of shared memory of this bench, the daemon's and the subscriber's.
    shared: usize,
    threads: u64,
}

impl Holdings {
    fn of(pid: u32) -> Fallible<Self> {
        let process = Path::new("/proc").join(pid.to_string());
        let status = std::fs::read_to_string(process.join("status"))?;
        let number = |key: &str| -> Fallible<u64> {
            let line = status.lines().find_map(|line| line.strip_prefix(key));
            let word = line.and_then(|line| line.split_whitespace().next());
            Ok(word.ok_or("the kernel does not tell")?.parse()?)
        };
        let ours = |entry: &std::fs::DirEntry| {
            entry
                .file_name()
                .to_string_lossy()
                .starts_with("visod_bench_")
        };
        Ok(Self {
            resident_kib: number("VmRSS:")?,
            threads: number("Threads:")?,
            descriptors: std::fs::read_dir(process.join("fd"))?.count(),
            shared: std::fs::read_dir("/dev/shm")?
                .flatten()
                .filter(ours)
                .count(),
        })
    }
}

fn main() -> Fallible<()> {
    let words = words();
    let pairs = words.first().map_or(Ok(2000), |word| word.parse::<u64>())?;
    let rate_hz = words.get(1).map_or(Ok(100.0), |word| word.parse::<f64>())?;
    println!("\n### Soak, {pairs} pairs of 320 × 240 px at {rate_hz} Hz\n");
    println!("| pairs | resident MB | descriptors | shared memory files | threads |");
    println!("|---:|---:|---:|---:|---:|");
    let folder = tempfile::tempdir()?;
    let recording = folder.path().join("recording");
    let times_s: Vec<f64> = (0..pairs).map(|n| n as f64 / rate_hz).collect();
    record(&render(small_rig()), &recording, &times_s)?;
    let more = format!(
        "[features.surf]\nbudget = 80\n[metrics]\nlisten = \"{0}/metrics\"\n[last_pose]\nfile = \"{0}/last_pose.toml\"\nevery_s = 1.0\n",
        folder.path().display()
    );
    let daemon = Daemon::start(folder.path(), &recording, &more)?;
    let pid = daemon.pid();
    let mut seen: Vec<(u64, Holdings)> = Vec::new();
    let mut next = pairs / 10;
    let (summary, lost) = daemon.follow(|message| {
        if message.sequence >= next {
            next += pairs / 10;
            let now = Holdings::of(pid)?;
            println!(
                "| {} | {:.2} | {} | {} | {} |",
                message.sequence,
                now.resident_kib as f64 * 1024.0 / 1e6,
                now.descriptors,
                now.shared,
                now.threads
            );
            seen.push((message.sequence, now));
        }
        Ok(())
    })?;
    let (Some((_, first)), Some((_, last))) = (seen.first(), seen.last()) else {
        return Err("nothing arrives".into());
    };
    let grown = last.resident_kib as f64 / first.resident_kib as f64 - 1.0;
    println!(
        "\nmemory: {:+.2} % from a tenth of the way to its end",
        1e2 * grown
    );
    println!(
        "descriptors {:+}, shared memory files {:+}, threads {:+}",
        last.descriptors as i64 - first.descriptors as i64,
        last.shared as i64 - first.shared as i64,
        last.threads as i64 - first.threads as i64
    );
    explain(&summary, lost);
    Ok(())
}

/// Where every left frame has gone.
fn explain(summary: &serde_json::Value, lost: u64) {
    let count = |value: &serde_json::Value| value.as_u64().unwrap_or(0);
    let frames = count(&summary["cameras"][0]["frames"]);
    let unmatched = count(&summary["cameras"][0]["unmatched"]);
    let dropped = count(&summary["dropped"]);
    let rows = count(&summary["pairs"]);
    let bridged = count(&summary["unusable_in_capture"]);
    let unexplained =
        frames as i64 - (rows as i64 - bridged as i64) - dropped as i64 - unmatched as i64;
    println!(
        "{frames} left frames: {} with a row, {dropped} dropped in the queue, {unmatched} without a partner, \
         {unexplained} unexplained; {rows} rows, {bridged} of them bridge what had no images; {} published, \
         {lost} lost on the way to the subscriber",
        rows - bridged,
        summary["published"]
    );
    println!("drops: {}", summary["drops"]);
}
