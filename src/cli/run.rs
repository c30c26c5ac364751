//! `visod run`: the daemon. Cameras in, poses over shared memory out, until it is told to stop.

use super::attendant::{Attendant, ask_for_resources};
use super::live::{Setup, Stop};
use super::session::{Session, unwritable};
use super::{Failure, summary};
use crate::capture::camera::realtime_ns;
use crate::capture::live::{Delivery, Overflow};
use crate::output::last_pose::{Keeper, Legacy};
use crate::output::publication::FOXGLOVE_ADDRESS;
use crate::service::log;
use std::net::SocketAddr;
use std::path::PathBuf;

/// Follow two cameras and publish pose and covariance until stopped.
///
/// The configuration names the rig and the cameras: `rig`, `[camera.left]` and `[camera.right]`. A
/// camera that fails is opened anew while the other one and the publication go on. Stopped by SIGINT
/// (Ctrl-C) or SIGTERM, it prints what the run came to. SIGHUP has service.deadline_s and service.trim read
/// anew. Started by systemd, it tells it when it is ready, how it is, and that it is alive.
#[derive(clap::Args)]
#[command(after_help = "Example: visod run --config visod.toml")]
pub(crate) struct Args {
    /// The configuration.
    #[arg(long, value_name = "FILE")]
    config: PathBuf,
    /// Write the odometry as CSV.
    #[arg(long, value_name = "F.csv")]
    odometry: Option<PathBuf>,
    /// Write the trajectory in TUM format.
    #[arg(long, value_name = "F.txt")]
    trajectory: Option<PathBuf>,
    /// Record images, poses and state as messages of ROS 2, for Foxglove and ROS 2's own tools.
    #[arg(long, value_name = "F.mcap")]
    mcap: Option<PathBuf>,
    /// Show the run to Foxglove over a WebSocket: at 127.0.0.1:8765, or at another address.
    #[arg(long, value_name = "ADDR", num_args = 0..=1, default_missing_value = FOXGLOVE_ADDRESS)]
    foxglove: Option<SocketAddr>,
    /// Write the run's figures as JSON.
    #[arg(long, value_name = "F.json")]
    summary: Option<PathBuf>,
    /// Stop after that many seconds.
    #[arg(long, value_name = "S")]
    seconds: Option<f64>,
    /// Do not publish over shared memory.
    #[arg(long)]
    no_publish: bool,
    /// Print the run's figures as JSON.
    #[arg(long)]
    json: bool,
    /// Hang after that many rows, so that tests see the watchdog bite.
    #[arg(long, value_name = "N", hide = true)]
    hang_after: Option<u64>,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    log::start();
    let stop = Stop::on_signals()?;
    let setup = Setup::load(&args.config)?;
    let attendant = Attendant::new(args.config.clone(), setup.config.clone())?;
    ask_for_resources(&setup.config.service);
    let legacy = Legacy::read(&setup.config.last_pose, realtime_ns());
    if let Some(warning) = &legacy.warning {
        tracing::warn!("{warning}");
    } else if legacy.start.is_some() {
        let epoch = legacy.epoch;
        tracing::info!(epoch, "the odometry frame of the run before is continued");
    }
    // A robot whose disk is full drives on.
    let keeper = Keeper::start(&setup.config.last_pose, &legacy).unwrap_or_else(|e| {
        tracing::warn!("{e}");
        None
    });
    let mut session = Session::new(setup.config.clone(), setup.rig.clone());
    session.continuing(legacy, keeper.clone());
    session.write_csv(args.odometry.as_deref())?;
    session.write_trajectory(args.trajectory.as_deref())?;
    if !args.no_publish {
        publish(&mut session)?;
    }
    let delivery = Delivery {
        queue: setup.config.capture.queue,
        overflow: Overflow::Oldest,
        keeps_journal: false,
    };
    let source = setup.open(delivery, &stop)?;
    session.watch(source.monitor(), attendant.pulse());
    session.serve_metrics()?;
    session.write_mcap(args.mcap.as_deref())?;
    session.show(args.foxglove)?;
    if let Some(rows) = args.hang_after {
        session.on_each_row(hang_after(rows));
    }
    let attending = attendant.attend(source.monitor(), keeper.clone())?;
    stop.end_run(source.monitor(), args.seconds)?;
    let finished = session.run(source);
    // The last thing that systemd is told; a panic in it has been reported already.
    let _ = attending.join();
    if let Some(Err(e)) = keeper.as_ref().map(Keeper::close) {
        tracing::warn!("{e}");
    }
    let finished = finished?;
    let json = summary::to_json(&args.config, &finished).map_err(Failure::other)?;
    if let Some(file) = &args.summary {
        std::fs::write(file, format!("{json}\n")).map_err(|e| unwritable(file, &e))?;
    }
    if args.json {
        println!("{json}");
    } else {
        print!("{}", summary::to_text(&finished));
    }
    Ok(())
}

/// What hangs at the given row.
fn hang_after(rows: u64) -> impl FnMut(&crate::output::row::OdometryRow) {
    let mut seen = 0;
    move |_| {
        seen += 1;
        if seen >= rows {
            loop {
                std::thread::park();
            }
        }
    }
}

/// Publishing is what the daemon is for: without, it does not start.
#[cfg(feature = "ipc")]
fn publish(session: &mut Session) -> Result<(), Failure> {
    session.publish().map(drop).map_err(Failure::other)
}

#[cfg(not(feature = "ipc"))]
fn publish(_: &mut Session) -> Result<(), Failure> {
    Err(Failure::usage(
        "this visod was built without the feature ipc and cannot publish: run it with --no-publish",
    ))
}
