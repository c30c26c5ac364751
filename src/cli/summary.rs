//! What a run came to, as text, as JSON, and as a page.

use super::Failure;
use super::session::{Finished, unwritable};
use crate::capture::live::{CameraStatus, Snapshot};
use crate::evaluation::{self, Trajectory};
use crate::output::report;
use crate::output::row::OdometryRow;
use crate::pipeline::DropCount;
use crate::rig_watch::RigState;
use std::fmt::Write;
use std::path::Path;

/// The summary's JSON.
#[derive(serde::Serialize)]
struct Summary<'a> {
    dataset: String,
    #[serde(flatten)]
    figures: &'a crate::pipeline::RunFigures,
    published: u64,
    publish_failures: u64,
    drops: Vec<&'a DropCount>,
    end_position_m: Option<[f64; 3]>,
    end_sigma_m: Option<[f64; 3]>,
    #[serde(skip_serializing_if = "Option::is_none")]
    rig: Option<RigState>,
    #[serde(skip_serializing_if = "Option::is_none")]
    cameras: Option<[CameraSummary<'a>; 2]>,
}

/// One camera in it.
#[derive(serde::Serialize)]
struct CameraSummary<'a> {
    side: &'static str,
    identity: &'a str,
    state: &'static str,
    frames: u64,
    unmatched: u64,
    reconnects: u64,
    clock_steps: u64,
    #[serde(skip_serializing_if = "Option::is_none")]
    clock: Option<crate::capture::clock::ClockEstimate>,
    lost: std::collections::BTreeMap<&'static str, u64>,
}

impl<'a> CameraSummary<'a> {
    fn of(side: &'static str, camera: &'a CameraStatus) -> Self {
        Self {
            side,
            identity: &camera.identity,
            state: camera.state.as_str(),
            frames: camera.frames,
            unmatched: camera.unmatched.total(),
            reconnects: camera.reconnects,
            clock_steps: camera.clock_steps,
            clock: camera.clock,
            lost: camera.losses.iter().map(|(k, n)| (k.as_str(), n)).collect(),
        }
    }
}

/// A line a camera: how many frames came, and what became of the others.
pub(crate) fn cameras_to_text(cameras: &Snapshot) -> String {
    let mut text = String::new();
    for (side, camera) in ["left", "right"].into_iter().zip(&cameras.cameras) {
        let lost = camera.losses.iter().filter(|(_, frames)| *frames > 0);
        let lost: Vec<String> = lost.map(|(k, n)| format!(", {n} {}", k.as_str())).collect();
        // Writing to a String cannot fail.
        let _ = writeln!(
            text,
            "  {side:<6} {}: {} frames, {} unmatched{}, opened anew {} times",
            camera.identity,
            camera.frames,
            camera.unmatched.total(),
            lost.concat(),
            camera.reconnects
        );
    }
    text
}

/// How the rig is.
fn rig_to_text(rig: &RigState) -> String {
    match (rig.has_moved, rig.misfits) {
        (true, _) => turn_to_text(rig),
        (_, true) => "the images miss each other by more than its uncertainty".to_owned(),
        _ => "as calibrated".to_owned(),
    }
}

/// That the cameras have turned against each other, and by how much.
pub(crate) fn turn_to_text(rig: &RigState) -> String {
    let mrad = |i: usize| {
        format!(
            "{:.3} ± {:.3}",
            rig.turn_rad[i] * 1e3,
            rig.sigma_rad[i] * 1e3
        )
    };
    format!(
        "the cameras have turned against each other, pitch {}, yaw {}, roll {} mrad",
        mrad(0),
        mrad(1),
        mrad(2)
    )
}

/// The summary as JSON.
pub(crate) fn to_json(dataset: &Path, finished: &Finished) -> serde_json::Result<String> {
    serde_json::to_string_pretty(&Summary {
        dataset: dataset.display().to_string(),
        figures: &finished.figures,
        published: finished.published,
        publish_failures: finished.publish_failures,
        drops: occurred(finished).collect(),
        end_position_m: finished.last.as_ref().map(position_m),
        end_sigma_m: finished.last.as_ref().map(sigma_m),
        rig: finished.rig,
        cameras: finished.cameras.as_ref().map(|cameras| {
            let [left, right] = &cameras.cameras;
            [
                CameraSummary::of("left", left),
                CameraSummary::of("right", right),
            ]
        }),
    })
}

/// What was lost at all.
fn occurred(finished: &Finished) -> impl Iterator<Item = &DropCount> {
    finished.drops.iter().filter(|drop| drop.count > 0)
}

/// The summary for a person.
pub(crate) fn to_text(finished: &Finished) -> String {
    let f = &finished.figures;
    let c = &f.counts;
    let mut text = String::new();
    // Writing to a String cannot fail.
    let _ = writeln!(
        text,
        "{} pairs: {} tracking, {} degraded, {} lost, {} initializing; {} unusable, {} dropped",
        c.pairs, c.tracking, c.degraded, c.lost, c.initializing, c.unusable, c.dropped
    );
    if let Some(last) = &finished.last {
        let ([x, y, z], [sx, sy, sz]) = (position_m(last), sigma_m(last));
        let _ = writeln!(
            text,
            "path {:.3} m in {:.1} s; ends at x {x:.3} ± {sx:.3}, y {y:.3} ± {sy:.3}, z {z:.3} ± {sz:.3} m (1 σ)",
            f.path_m, f.recorded_s
        );
    }
    let _ = writeln!(
        text,
        "{:.1} pairs/s, {:.1} ms of processor time a pair, peak memory {:.0} MB, {} published",
        f.pairs_per_s, f.cpu_ms_per_pair, f.peak_memory_mb, finished.published
    );
    for stage in &f.latency_ms {
        let _ = writeln!(
            text,
            "  {:<10} median {:>8.2} ms   p99 {:>8.2} ms",
            stage.stage, stage.median, stage.p99
        );
    }
    for drop in occurred(finished) {
        let DropCount {
            stage,
            reason,
            camera,
            count,
        } = drop;
        let _ = writeln!(text, "  lost in {stage}: {count} {reason} ({camera})");
    }
    if let Some(rig) = &finished.rig {
        let _ = writeln!(text, "  rig: {}", rig_to_text(rig));
    }
    if let Some(cameras) = &finished.cameras {
        text += &cameras_to_text(cameras);
    }
    text
}

/// Writes the page with figures; the truth is shown where the recording has it and it can be read.
pub(crate) fn write_report(
    file: &Path,
    rows: &[OdometryRow],
    ground_truth: Option<&Path>,
    title: &str,
) -> Result<(), Failure> {
    let truth = ground_truth.and_then(|path| match true_poses(path) {
        Ok(truth) => Some(truth),
        Err(e) => {
            eprintln!("visod: warning: the report goes without the truth: {e}");
            None
        }
    });
    let settings = evaluation::Settings::default();
    let page = report::render(rows, truth.as_ref(), &settings, title).or_else(|e| {
        eprintln!("visod: warning: the report goes without the truth: {e}");
        report::render(rows, None, &settings, title)
    });
    let page = page.map_err(|e| Failure::other(format!("{}: {e}", file.display())))?;
    std::fs::write(file, page).map_err(|e| unwritable(file, &e))
}

/// A recording's true poses, of its left camera: EuRoC's are those of the body, and the camera's
/// place in it stands in the recording too.
fn true_poses(path: &Path) -> Result<Trajectory, evaluation::FileError> {
    let truth = evaluation::read_trajectory(path)?;
    let sensor = path
        .ancestors()
        .nth(2)
        .map(|mav0| mav0.join("cam0").join("sensor.yaml"));
    match sensor {
        Some(sensor) if path.ends_with("data.csv") && sensor.is_file() => {
            Ok(truth.of_camera(&evaluation::read_body_from_camera(&sensor)?))
        }
        _ => Ok(truth),
    }
}

fn position_m(row: &OdometryRow) -> [f64; 3] {
    row.odom_from_camera.translation.vector.into()
}

fn sigma_m(row: &OdometryRow) -> [f64; 3] {
    [0, 1, 2].map(|i| row.cov_pose[(i, i)].sqrt())
}
