//! `visod demo`: the newcomer's first minute.

use super::session::{Session, unwritable};
use super::{Failure, summary};
use crate::config::Config;
use crate::geometry::se3;
use crate::output::row::OdometryRow;
use crate::simulation::{
    SceneName, Settings, SimulatedSource, Simulation, TrajectoryName, thesis_rig,
};
use nalgebra::Isometry3;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// See the whole of visod at work, without any hardware or configuration.
///
/// Renders what two cameras of 1280×960 pixels see on their way through a furnished room, runs the
/// whole pipeline on it, publishes each pose with its covariance over shared memory to a second
/// process, prints the trajectory with its 1 σ beside the true error, and writes a report.
#[derive(clap::Args)]
#[command(after_help = "Example: visod demo --out demo")]
pub(crate) struct Args {
    /// How many pairs to render.
    #[arg(long, value_name = "N", default_value_t = 40, value_parser = clap::value_parser!(u64).range(2..=1000))]
    frames: u64,
    /// The folder that the results are written to; made if it is not there.
    #[arg(long, value_name = "DIR", default_value = "visod-demo")]
    out: PathBuf,
    /// Print the run's figures as JSON.
    #[arg(long)]
    json: bool,
}

/// A line of the table for so many pairs.
const ROWS_PER_LINE: u64 = 4;

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let settings = Settings {
        frames: args.frames,
        ..Settings::default()
    };
    let simulation = Simulation::new(
        SceneName::Room,
        TrajectoryName::LoopRoom,
        thesis_rig(),
        settings,
    )
    .map(Arc::new)
    .map_err(Failure::other)?;
    std::fs::create_dir_all(&args.out).map_err(|e| unwritable(&args.out, &e))?;
    let (csv, truth, report) = (
        args.out.join("odometry.csv"),
        args.out.join("truth.txt"),
        args.out.join("report.html"),
    );
    write_truth(&truth, &simulation)?;

    let mut session = Session::new(Config::default(), simulation.rig().clone());
    session.write_csv(Some(&csv))?;
    session.keep_rows();
    let listener = Listener::start(&mut session, args.frames)?;
    if !args.json {
        announce(args.frames, listener.as_ref());
        show_rows(&mut session, Arc::clone(&simulation));
    }
    let finished = session.run(SimulatedSource::new(Arc::clone(&simulation)))?;
    summary::write_report(
        &report,
        &finished.rows,
        Some(&truth),
        "visod demo: a rendered room",
    )?;
    let heard = listener.map(|l| l.finish(&finished.rows)).transpose()?;

    if args.json {
        let json = summary::to_json(Path::new("demo"), &finished).map_err(Failure::other)?;
        println!("{json}");
        return Ok(());
    }
    println!("\n{}", summary::to_text(&finished));
    if let Some(heard) = heard {
        println!("{heard}");
    }
    println!(
        "Written: {}, {}, {}\nOpen the report in a browser: file://{}",
        csv.display(),
        truth.display(),
        report.display(),
        report.canonicalize().unwrap_or(report.clone()).display()
    );
    Ok(())
}

fn announce(frames: u64, listener: Option<&Listener>) {
    println!(
        "Rendering {frames} stereo pairs of 1280×960 pixels in a furnished room and following the cameras through it.\n\
         No recording is used: every pixel is computed, so the true pose is known."
    );
    match listener {
        Some(listener) => println!(
            "Poses are published over shared memory; process {} subscribes to them.\n",
            listener.pid()
        ),
        None => {
            println!("This visod was built without the feature ipc, so nothing is published.\n")
        }
    }
    println!(
        "pair  status         x m        y m        z m     1 σ mm    error mm   1 σ mdeg  error mdeg"
    );
}

/// Prints a line of the table for some of the rows.
fn show_rows(session: &mut Session, simulation: Arc<Simulation>) {
    session.on_each_row(move |row| {
        if row.sequence % ROWS_PER_LINE == 0 {
            let truth = simulation.odom_from_camera(row.sequence);
            println!("{}", table_line(row, &truth));
        }
    });
}

fn table_line(row: &OdometryRow, truth: &Isometry3<f64>) -> String {
    let t = row.odom_from_camera.translation.vector;
    let error = se3::error_fixed_axes(&row.odom_from_camera, truth);
    let sigma = |from: usize| {
        let variance: f64 = (from..from + 3).map(|i| row.cov_pose[(i, i)]).sum();
        variance.sqrt()
    };
    format!(
        "{:>4}  {:<12} {:>8.3}   {:>8.3}   {:>8.3}   {:>8.2}    {:>8.2}   {:>8.2}    {:>8.2}",
        row.sequence,
        row.status.as_str(),
        t.x,
        t.y,
        t.z,
        sigma(0) * 1e3,
        se3::translation_of(&error).norm() * 1e3,
        sigma(3).to_degrees() * 1e3,
        se3::rotation_of(&error).norm().to_degrees() * 1e3,
    )
}

/// The true poses, 3×4 row by row.
fn write_truth(file: &Path, simulation: &Simulation) -> Result<(), Failure> {
    let mut text = String::new();
    for frame in 0..simulation.settings().frames {
        let matrix = simulation.odom_from_camera(frame).to_homogeneous();
        let row: Vec<String> = (0..12)
            .map(|i| format!("{:?}", matrix[(i / 4, i % 4)]))
            .collect();
        // Writing to a String cannot fail.
        let _ = writeln!(text, "{}", row.join(" "));
    }
    std::fs::write(file, text).map_err(|e| unwritable(file, &e))
}

/// The second process: this program again, as `visod listen --json`.
struct Listener {
    #[cfg(feature = "ipc")]
    child: std::process::Child,
}

#[cfg(not(feature = "ipc"))]
impl Listener {
    fn start(_: &mut Session, _: u64) -> Result<Option<Self>, Failure> {
        Ok(None)
    }

    fn pid(&self) -> u32 {
        0
    }

    fn finish(self, _: &[OdometryRow]) -> Result<String, Failure> {
        Ok(String::new())
    }
}

#[cfg(feature = "ipc")]
impl Listener {
    /// Begins to publish, and waits until the second process has subscribed.
    fn start(session: &mut Session, frames: u64) -> Result<Option<Self>, Failure> {
        use std::process::{Command, Stdio};
        use std::time::Duration;

        let publisher = session.publish().map_err(Failure::other)?;
        let program = std::env::current_exe().map_err(Failure::other)?;
        let mut child = Command::new(program)
            .args([
                "listen",
                "--json",
                "--timeout",
                "60",
                "--count",
                &frames.to_string(),
            ])
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            // It would warn of the pauses that rendering makes.
            .stderr(Stdio::null())
            .spawn()
            .map_err(|e| Failure::other(format!("a second process cannot be started: {e}")))?;
        if !publisher.wait_for_subscribers(1, Duration::from_secs(10)) {
            let _ = child.kill();
            let _ = child.wait();
            return Err(Failure::other(
                "the second process did not subscribe within 10 s",
            ));
        }
        Ok(Some(Self { child }))
    }

    fn pid(&self) -> u32 {
        self.child.id()
    }

    /// Waits for the second process and holds what it received against what was sent.
    fn finish(self, rows: &[OdometryRow]) -> Result<String, Failure> {
        let pid = self.pid();
        let output = self.child.wait_with_output().map_err(Failure::other)?;
        let text = String::from_utf8_lossy(&output.stdout);
        let received: Vec<serde_json::Value> = text
            .lines()
            .filter_map(|line| serde_json::from_str(line).ok())
            .collect();
        let same = received.iter().zip(rows).all(|(message, row)| {
            let t = row.odom_from_camera.translation.vector;
            message["seq"] == row.sequence
                && message["tx"] == t.x
                && message["ty"] == t.y
                && message["tz"] == t.z
                && message["c00"] == row.cov_pose[(0, 0)]
        });
        if received.len() != rows.len() || !same {
            return Err(Failure::other(format!(
                "process {pid} received {} of {} poses{}",
                received.len(),
                rows.len(),
                if same {
                    ""
                } else {
                    ", and not the same numbers"
                }
            )));
        }
        Ok(format!(
            "Process {pid} received {} of {} poses with their covariances, bit for bit.",
            received.len(),
            rows.len()
        ))
    }
}
