//! `visod record`: cameras in, a recording out.

use super::live::{Setup, Stop};
use super::{Failure, progress, summary};
use crate::capture::clock::ClockEstimate;
use crate::capture::live::{Delivery, Entry, Fate, Monitor, Overflow, Snapshot};
use crate::capture::recorder::{RecordError, Recorder};
use crate::capture::{PairEvent, PairSource};
use crate::service::log;
use std::path::PathBuf;

/// Pairs that may wait for the disk; at 1280×960 px, 160 MB.
const QUEUE: usize = 64;

/// Record two cameras as a dataset that `visod replay` reads.
///
/// OUT gets left/, right/, rig.toml, times.txt and frames.csv, which says of every frame of either
/// camera whether it was written, and why not. Stopped by SIGINT (Ctrl-C) or SIGTERM, by --pairs or
/// --seconds, or by a full disk: what is written is whole in any case.
#[derive(clap::Args)]
#[command(after_help = "Example: visod record --config visod.toml recording")]
pub(crate) struct Args {
    /// The configuration.
    #[arg(long, value_name = "FILE")]
    config: PathBuf,
    /// Stop after that many pairs.
    #[arg(long, value_name = "N")]
    pairs: Option<u64>,
    /// Stop after that many seconds.
    #[arg(long, value_name = "S")]
    seconds: Option<f64>,
    /// Print what was recorded as JSON.
    #[arg(long)]
    json: bool,
    /// The folder to write to; it must be new or empty.
    out: PathBuf,
}

/// What a recording came to.
#[derive(serde::Serialize)]
struct Recorded {
    out: String,
    pairs: u64,
    dropped: u64,
    frames: [u64; 2],
    written: [u64; 2],
    unmatched: [u64; 2],
    lost: [u64; 2],
    clocks: [Option<ClockEstimate>; 2],
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    log::start();
    let stop = Stop::on_signals()?;
    let setup = Setup::load(&args.config)?;
    let mut recorder = Recorder::create(&args.out, &setup.rig).map_err(failure)?;
    let delivery = Delivery {
        queue: QUEUE,
        overflow: Overflow::Newest,
        keeps_journal: true,
    };
    let mut source = setup.open(delivery, &stop)?;
    let cameras = source.monitor();
    stop.end_run(source.monitor(), args.seconds)?;
    let written = record(&mut source, &cameras, &mut recorder, args.pairs);
    cameras.stop();
    drop(source);
    // The last frames' fates; a disk that is full has room for them, the last pair having gone.
    let noted = recorder.note(&cameras.take_journal());
    print(args, &recorder, &cameras.snapshot())?;
    written.and(noted).map_err(failure)
}

/// Writes pairs until there are no more.
fn record(
    source: &mut impl PairSource,
    cameras: &Monitor,
    recorder: &mut Recorder,
    pairs: Option<u64>,
) -> Result<(), RecordError> {
    let bar = progress::pairs(pairs);
    let mut held: Vec<Entry> = Vec::new();
    source.make_room(1);
    while pairs.is_none_or(|pairs| recorder.count() < pairs) {
        let Some(event) = source.next_event() else {
            break;
        };
        let sequence = event.sequence();
        if let PairEvent::Pair(pair) = event {
            recorder.add(&pair)?;
            source.recycle(pair);
            bar.inc(1);
        }
        // What is decided goes to the file; pairs that wait for the disk stay for later.
        held.extend(cameras.take_journal());
        let (decided, later): (Vec<_>, Vec<_>) = held
            .into_iter()
            .partition(|entry| !matches!(entry.fate, Fate::Paired(n) if n > sequence));
        held = later;
        recorder.note(&decided)?;
    }
    bar.finish_and_clear();
    recorder.note(&held)
}

fn print(args: &Args, recorder: &Recorder, cameras: &Snapshot) -> Result<(), Failure> {
    let of = |count: fn(&crate::capture::live::CameraStatus) -> u64| {
        cameras.cameras.each_ref().map(count)
    };
    let recorded = Recorded {
        out: args.out.display().to_string(),
        pairs: recorder.count(),
        dropped: cameras.pairs - recorder.count(),
        frames: of(|c| c.frames),
        written: [recorder.count(); 2],
        unmatched: of(|c| c.unmatched.total()),
        lost: of(|c| c.losses.in_transport() + c.losses.unusable()),
        clocks: cameras.cameras.each_ref().map(|c| c.clock),
    };
    if args.json {
        let text = serde_json::to_string_pretty(&recorded).map_err(Failure::other)?;
        println!("{text}");
        return Ok(());
    }
    println!(
        "{}: {} pairs, {} not written",
        recorded.out, recorded.pairs, recorded.dropped
    );
    print!("{}", summary::cameras_to_text(cameras));
    Ok(())
}

/// A folder that cannot be used is bad usage; a disk that cannot be written to is not.
fn failure(error: RecordError) -> Failure {
    match error {
        RecordError::NotEmpty(_) | RecordError::NotAFolder(_) => Failure::usage(error),
        RecordError::Write { .. } => Failure::other(error),
    }
}
