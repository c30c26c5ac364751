//! Pairs that come twice as fast as they can be handled: `cargo bench --bench overload [-- SECONDS [large [HZ]]]`.
//!
//! First it is measured how fast pairs can be handled; then they come at half of that, at twice that for a
//! minute, and at half of it again. With HZ they come at that rate alone. Latencies are those of a subscriber in
//! another process: from when the left image was taken to when the message is here.

mod common;

use common::daemon::{Daemon, record, render};
use common::memory::Recording;
use common::words;
use visod::output::monotonic_ns;
use visod::simulation::{small_rig, thesis_rig};

/// Before and after the overload, s.
const CALM_S: f64 = 10.0;

type Outcome = Result<(), Box<dyn std::error::Error>>;

/// What a message says, as far as it matters here.
#[derive(Clone, Copy)]
struct Arrival {
    sequence: u64,
    taken_ns: i64,
    latency_ms: f64,
}

fn main() -> Outcome {
    let words = words();
    let seconds = words.first().map_or(Ok(60.0), |s| s.parse())?;
    // Far more than can be handled, and no more than can be read.
    let (rig, flood_hz) = match words.get(1).map(String::as_str) {
        None => (small_rig(), 400.0),
        Some("large") => (thesis_rig(), 100.0),
        Some(other) => return Err(format!("{other}: neither nothing nor `large`").into()),
    };
    let size = format!("{} × {} px", rig.left.width, rig.left.height);
    let images = render(rig);
    if let Some(rate_hz) = words.get(2) {
        return steady(&images, rate_hz.parse()?, seconds);
    }
    for trim in [false, true] {
        println!(
            "\n### Overload, {size}, trimming {}\n",
            if trim { "on" } else { "off" }
        );
        let more = format!("[service]\ntrim = {trim}\n");
        let flood: Vec<f64> = (0..10 * flood_hz as u32)
            .map(|n| f64::from(n) / flood_hz)
            .collect();
        let handled = follow(&images, &flood, "[service]\ntrim = false\n")?.0;
        let (first, last) = (handled[handled.len() / 4], handled[handled.len() - 1]);
        let span_s = (last.taken_ns - first.taken_ns) as f64 * 1e-9;
        let rate_hz = (handled.len() - handled.len() / 4 - 1) as f64 / span_s;
        let frame_ms = 1e3 / rate_hz;
        println!("{rate_hz:.1} pairs a second can be handled: {frame_ms:.2} ms a pair\n");
        overload(&images, rate_hz, seconds, &more)?;
    }
    Ok(())
}

/// The latency of pairs that come at one rate, which can be kept up with.
fn steady(images: &Recording, rate_hz: f64, seconds: f64) -> Outcome {
    let times_s: Vec<f64> = (0..(rate_hz * seconds) as u32)
        .map(|n| f64::from(n) / rate_hz)
        .collect();
    let (arrivals, summary) = follow(images, &times_s, "")?;
    if arrivals.is_empty() {
        return Err("nothing arrives".into());
    }
    let [median, p99, greatest] = latencies_ms(&arrivals);
    println!("| pairs a second | came | handled | latency: median ms | p99 ms | max ms |");
    println!("|---:|---:|---:|---:|---:|---:|");
    println!(
        "| {rate_hz} | {} | {} | {median:.1} | {p99:.1} | {greatest:.1} |\n\n{} dropped in the queue by the \
         daemon's own count",
        times_s.len(),
        arrivals.len(),
        summary["dropped"]
    );
    Ok(())
}

/// Median, p99 and greatest.
fn latencies_ms(arrivals: &[Arrival]) -> [f64; 3] {
    let mut sorted: Vec<f64> = arrivals.iter().map(|arrival| arrival.latency_ms).collect();
    sorted.sort_by(f64::total_cmp);
    [0.5, 0.99, 1.0].map(|share| sorted[(share * (sorted.len() - 1) as f64) as usize])
}

fn overload(images: &Recording, rate_hz: f64, seconds: f64, more: &str) -> Outcome {
    let phases = [
        ("half as fast as they can be handled", 0.5, CALM_S),
        ("twice as fast", 2.0, seconds),
        ("half as fast again", 0.5, CALM_S),
    ];
    let mut times_s = vec![0.0];
    let mut ends_s = Vec::new();
    let mut end_s = 0.0;
    for (_, factor, lasts_s) in phases {
        end_s += lasts_s;
        ends_s.push(end_s);
        while let Some(last_s) = times_s.last().copied().filter(|t| *t < end_s) {
            times_s.push(last_s + 1.0 / (factor * rate_hz));
        }
    }
    let (arrivals, summary) = follow(images, &times_s, more)?;
    let Some(first) = arrivals.first() else {
        return Err("nothing arrives".into());
    };
    let began_ns = first.taken_ns;
    let at_s = |arrival: &Arrival| (arrival.taken_ns - began_ns) as f64 * 1e-9;
    println!(
        "| pairs come | came | handled | one handled every ms | latency: median ms | p99 ms | max ms |"
    );
    println!("|---|---:|---:|---:|---:|---:|---:|");
    let mut began_s = f64::NEG_INFINITY;
    for ((name, ..), end_s) in phases.iter().zip(&ends_s) {
        let inside: Vec<Arrival> = arrivals
            .iter()
            .copied()
            .filter(|arrival| (began_s..*end_s).contains(&at_s(arrival)))
            .collect();
        let (Some(first), Some(last)) = (inside.first(), inside.last()) else {
            return Err(format!("{name}: nothing arrives").into());
        };
        let [median, p99, greatest] = latencies_ms(&inside);
        println!(
            "| {name} | {} | {} | {:.1} | {median:.1} | {p99:.1} | {greatest:.1} |",
            last.sequence - first.sequence + 1,
            inside.len(),
            1e3 * (at_s(last) - at_s(first)) / (inside.len() - 1).max(1) as f64
        );
        began_s = *end_s;
    }
    let late: Vec<String> = arrivals
        .iter()
        .filter(|arrival| (ends_s[0]..ends_s[1]).contains(&at_s(arrival)))
        .filter(|arrival| arrival.latency_ms > 2e3 / rate_hz)
        .map(|arrival| format!("{:.2}", at_s(arrival) - ends_s[0]))
        .collect();
    println!(
        "\n{} came later than two frame times, {:.1} ms, under overload, so many seconds after it began: {}",
        late.len(),
        2e3 / rate_hz,
        late.join(", ")
    );
    // The first pair after which none is dropped any more.
    let over_s = ends_s[1];
    let last_gap = arrivals
        .windows(2)
        .filter(|two| two[1].sequence > two[0].sequence + 1 && at_s(&two[1]) < over_s + CALM_S)
        .map(|two| at_s(&two[1]))
        .next_back();
    println!(
        "{} dropped in the queue by the daemon's own count; the last gap in what arrives ends {:.0} ms after \
         the overload",
        summary["dropped"],
        last_gap.map_or(0.0, |gap_s| 1e3 * (gap_s - over_s))
    );
    Ok(())
}

/// All that arrives of pairs that come at the given times, and the daemon's summary.
fn follow(
    images: &Recording,
    times_s: &[f64],
    more: &str,
) -> Result<(Vec<Arrival>, serde_json::Value), Box<dyn std::error::Error>> {
    let folder = tempfile::tempdir()?;
    let recording = folder.path().join("recording");
    record(images, &recording, times_s)?;
    let daemon = Daemon::start(folder.path(), &recording, more)?;
    let mut arrivals = Vec::with_capacity(times_s.len());
    let (summary, lost) = daemon.follow(|message| {
        // Rows that only bridge have no images, and took no time.
        if message.latency_total_ns > 0 {
            arrivals.push(Arrival {
                sequence: message.sequence,
                taken_ns: message.monotonic_ns,
                latency_ms: (monotonic_ns() - message.monotonic_ns) as f64 * 1e-6,
            });
        }
        Ok(())
    })?;
    if lost > 0 {
        println!("{lost} messages were lost on the way here");
    }
    Ok((arrivals, summary))
}
