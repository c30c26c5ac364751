//! `visod replay`: a recording instead of cameras, through the same pipeline.

use super::session::{Finished, Session, unwritable};
use super::{Failure, summary};
#[cfg(feature = "mcap")]
use crate::capture::mcap::McapRecording;
use crate::capture::{Dataset, PairSource, ReadAhead, Realtime};
use crate::config::Config;
use crate::geometry::{StereoRig, load_rig};
use crate::output::publication::FOXGLOVE_ADDRESS;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};

/// Run a recording through the pipeline instead of cameras.
///
/// DATASET is a folder in one of three layouts: visod's own (left/, right/, rig.toml), KITTI
/// odometry (image_0/, image_1/, calib.txt, times.txt) or EuRoC (mav0/cam0, mav0/cam1); or an MCAP
/// file with the images of two cameras as messages of ROS 2. The same
/// recording and configuration give the same output to the last bit, whatever the number of
/// workers; therefore latencies are in the summary and in the messages, and `nan` in the CSV.
#[derive(clap::Args)]
#[command(
    after_help = "Example: visod replay recording --odometry odometry.csv --report report.html"
)]
pub(crate) struct Args {
    /// The recording's folder, or an MCAP file.
    dataset: PathBuf,
    /// Settings of the pipeline [default: what `config/visod.toml` shows].
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// A calibration to use instead of the recording's own.
    #[arg(long, value_name = "FILE")]
    rig: Option<PathBuf>,
    /// Write pose and motion with covariance, one row a pair.
    #[arg(long, value_name = "F.csv")]
    odometry: Option<PathBuf>,
    /// Write the trajectory in TUM format.
    #[arg(long, value_name = "F.txt")]
    trajectory: Option<PathBuf>,
    /// Record images, poses and state as messages of ROS 2, for Foxglove and ROS 2's own tools.
    #[arg(long, value_name = "F.mcap")]
    mcap: Option<PathBuf>,
    /// The topics of an MCAP file that hold the left and the right images, where their names do not
    /// tell.
    #[arg(long, num_args = 2, value_names = ["LEFT", "RIGHT"])]
    topics: Option<Vec<String>>,
    /// Show the run to Foxglove over a WebSocket: at 127.0.0.1:8765, or at another address.
    #[arg(long, value_name = "ADDR", num_args = 0..=1, default_missing_value = FOXGLOVE_ADDRESS)]
    foxglove: Option<SocketAddr>,
    /// Write the run's figures as JSON: counts, latencies, processor time, memory.
    #[arg(long, value_name = "F.json")]
    summary: Option<PathBuf>,
    /// Write a page with figures.
    #[arg(long, value_name = "F.html")]
    report: Option<PathBuf>,
    /// As fast as it goes, or at the speed of the recording.
    #[arg(long, value_enum, default_value_t = Pace::Max)]
    pace: Pace,
    /// Do not publish over shared memory.
    #[arg(long)]
    no_publish: bool,
    /// Print the run's figures as JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum Pace {
    /// As fast as the machine can; no pair is dropped.
    Max,
    /// Each pair at its time.
    Realtime,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let config = match &args.config {
        Some(file) => Config::load(file).map_err(Failure::usage)?,
        None => Config::default(),
    };
    let rig = match args.rig.as_ref().or(config.rig.as_ref()) {
        Some(file) => Some(load_rig(file).map_err(Failure::usage)?),
        None => None,
    };
    if args.dataset.is_file() {
        return replay_mcap(args, config, rig);
    }
    if args.topics.is_some() {
        return Err(Failure::usage("--topics is for MCAP files"));
    }
    let dataset =
        Dataset::open_with(&args.dataset, rig, config.dataset.clone()).map_err(Failure::usage)?;
    if dataset.nominal_times {
        eprintln!(
            "visod: warning: {} has no times: pairs are taken to be 0.1 s apart",
            args.dataset.display()
        );
    }
    let source = ReadAhead::start(&dataset).map_err(Failure::other)?;
    let truth = dataset.ground_truth.as_deref();
    replay(args, config, dataset.rig.clone(), source, truth)
}

/// A file rather than a folder.
#[cfg(feature = "mcap")]
fn replay_mcap(args: &Args, config: Config, rig: Option<StereoRig>) -> Result<(), Failure> {
    let topics = match args.topics.as_deref() {
        Some([left, right]) => Some([left.as_str(), right.as_str()]),
        _ => None,
    };
    let recording = McapRecording::open(&args.dataset, rig, topics, config.dataset.clone())
        .map_err(Failure::usage)?;
    let source = recording.source().map_err(Failure::other)?;
    replay(args, config, recording.rig, source, None)
}

#[cfg(not(feature = "mcap"))]
fn replay_mcap(args: &Args, _: Config, _: Option<StereoRig>) -> Result<(), Failure> {
    Err(Failure::usage(format!(
        "{}: is not a folder with a recording, and this visod was built without the feature mcap",
        args.dataset.display()
    )))
}

/// Runs the pairs of a recording through the pipeline.
fn replay(
    args: &Args,
    config: Config,
    rig: StereoRig,
    source: impl PairSource,
    truth: Option<&Path>,
) -> Result<(), Failure> {
    let mut session = Session::new(config, rig);
    session.write_csv(args.odometry.as_deref())?;
    session.write_trajectory(args.trajectory.as_deref())?;
    session.write_mcap(args.mcap.as_deref())?;
    session.show(args.foxglove)?;
    if args.report.is_some() {
        session.keep_rows();
    }
    if !args.no_publish {
        publish(&mut session);
    }
    let finished = match args.pace {
        Pace::Max => session.run(source),
        Pace::Realtime => session.run(Realtime::new(source)),
    }?;
    if let Some(file) = &args.report {
        let title = args.dataset.display().to_string();
        summary::write_report(file, &finished.rows, truth, &title)?;
    }
    conclude(args, &finished)
}

/// Writes and prints the summary. A recording of which nothing could be used is a failure.
fn conclude(args: &Args, finished: &Finished) -> Result<(), Failure> {
    let json = summary::to_json(&args.dataset, finished).map_err(Failure::other)?;
    if let Some(file) = &args.summary {
        std::fs::write(file, format!("{json}\n")).map_err(|e| unwritable(file, &e))?;
    }
    if args.json {
        println!("{json}");
    } else {
        print!("{}", summary::to_text(finished));
    }
    let counts = &finished.figures.counts;
    if counts.unusable == counts.pairs {
        return Err(Failure::other(format!(
            "{}: not one of {} pairs is usable; the first: {}",
            Path::display(&args.dataset),
            counts.pairs,
            finished.first_unusable.as_deref().unwrap_or("no reason")
        )));
    }
    Ok(())
}

/// Publishes if that is possible: a replay is of use without, too.
#[cfg(feature = "ipc")]
fn publish(session: &mut Session) {
    if let Err(e) = session.publish() {
        eprintln!("visod: warning: nothing is published: {e}");
    }
}

#[cfg(not(feature = "ipc"))]
fn publish(_: &mut Session) {
    eprintln!("visod: warning: nothing is published: this visod was built without the feature ipc");
}
