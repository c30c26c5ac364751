//! `visod check`: what would be wrong with a configuration on this machine.

use super::Failure;
use super::live::Setup;
use crate::capture::settings::Driver;
use crate::geometry::{Severity, check_rig};
use crate::service::realtime;
use std::path::PathBuf;
use std::time::Duration;

/// Find out what would be wrong on this machine, before it matters.
///
/// Looks at the configuration, the rig, both cameras (which are opened and take a frame), what this
/// user may do, and what the network's buffers hold. Exit code 2 if the configuration is wrong, 1 if
/// something else would keep `visod run` from working.
#[derive(clap::Args)]
#[command(after_help = "Example: visod check --config visod.toml")]
pub(crate) struct Args {
    /// The configuration.
    #[arg(long, value_name = "FILE")]
    config: PathBuf,
    /// Leave the cameras alone.
    #[arg(long)]
    no_cameras: bool,
    /// Print the findings as JSON.
    #[arg(long)]
    json: bool,
}

/// How bad a finding is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, serde::Serialize)]
#[serde(rename_all = "lowercase")]
enum Verdict {
    Good,
    Warning,
    Error,
}

/// One thing that was looked at.
#[derive(Debug, serde::Serialize)]
struct Finding {
    what: &'static str,
    verdict: Verdict,
    text: String,
}

fn finding(what: &'static str, verdict: Verdict, text: impl Into<String>) -> Finding {
    Finding {
        what,
        verdict,
        text: text.into(),
    }
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let setup = Setup::load(&args.config)?;
    let mut findings = vec![finding("configuration", Verdict::Good, "can be used")];
    findings.extend(rig_findings(&setup));
    if !args.no_cameras {
        findings.extend(camera_findings(&setup));
    }
    findings.extend(machine_findings(&setup));
    if args.json {
        let text = serde_json::to_string_pretty(&findings).map_err(Failure::other)?;
        println!("{text}");
    } else {
        for f in &findings {
            let verdict = match f.verdict {
                Verdict::Good => "good",
                Verdict::Warning => "warning",
                Verdict::Error => "error",
            };
            println!("{verdict:<8} {}: {}", f.what, f.text);
        }
    }
    let errors = |what: &str| {
        let wrong = |f: &&Finding| f.verdict == Verdict::Error && f.what == what;
        findings.iter().filter(wrong).count()
    };
    let all = findings
        .iter()
        .filter(|f| f.verdict == Verdict::Error)
        .count();
    let message = format!(
        "{}: {all} things would keep visod from running",
        args.config.display()
    );
    match (errors("rig") + errors("camera settings"), all) {
        (_, 0) => Ok(()),
        (0, _) => Err(Failure::other(message)),
        _ => Err(Failure::usage(message)),
    }
}

fn rig_findings(setup: &Setup) -> Vec<Finding> {
    let mut findings: Vec<Finding> = check_rig(&setup.rig)
        .into_iter()
        .map(|f| {
            let verdict = match f.severity {
                Severity::Warning => Verdict::Warning,
                Severity::Error => Verdict::Error,
            };
            finding("rig", verdict, format!("{}: {}", f.key, f.message))
        })
        .collect();
    if findings.is_empty() {
        let text = format!("plausible, baseline {:.4} m", setup.rig.baseline_m());
        findings.push(finding("rig", Verdict::Good, text));
    }
    findings
}

/// Opens each camera and waits for a frame.
fn camera_findings(setup: &Setup) -> Vec<Finding> {
    let names = ["left camera", "right camera"];
    let look = |(what, opener): (&'static str, &crate::capture::Opener)| {
        let mut source = match opener() {
            Ok(source) => source,
            Err(e) if e.is_permanent() => {
                return finding("camera settings", Verdict::Error, format!("{what}: {e}"));
            }
            Err(e) => return finding(what, Verdict::Error, e.to_string()),
        };
        let identity = source.identity();
        match first_frame(&mut *source, setup.config.capture.stall_s) {
            Ok(true) => finding(what, Verdict::Good, format!("{identity} sends frames")),
            Ok(false) => finding(
                what,
                Verdict::Warning,
                format!("{identity} sends no frames: is it waiting for a trigger?"),
            ),
            Err(e) => finding(what, Verdict::Error, e.to_string()),
        }
    };
    names.into_iter().zip(&setup.openers).map(look).collect()
}

fn first_frame(
    source: &mut dyn crate::capture::camera::FrameSource,
    patience_s: f64,
) -> Result<bool, crate::capture::camera::CameraError> {
    use crate::capture::camera::CameraEvent;
    source.start()?;
    let started = std::time::Instant::now();
    while started.elapsed().as_secs_f64() < patience_s {
        if let CameraEvent::Frame(_) = source.next(Duration::from_millis(100))? {
            return Ok(true);
        }
    }
    Ok(false)
}

/// What this user may do and what the kernel grants.
fn machine_findings(setup: &Setup) -> Vec<Finding> {
    let cameras = [&setup.config.camera.left, &setup.config.camera.right];
    let on_network = cameras
        .into_iter()
        .flatten()
        .any(|c| c.driver == Driver::Aravis);
    let mut findings = Vec::new();
    if on_network {
        findings.push(packet_socket());
        findings.push(receive_buffer());
    }
    let service = &setup.config.service;
    findings.push(limit(
        "real-time priority",
        "Max realtime priority",
        u64::from(service.priority),
        "the scheduler may hold frames up: give the unit LimitRTPRIO=, or this user rtprio in limits.conf",
    ));
    if service.lock_memory {
        findings.push(limit(
            "locked memory",
            "Max locked memory",
            512 << 20,
            "memory may be paged out: give the unit LimitMEMLOCK=, or this user memlock in limits.conf",
        ));
    }
    // On a thread of its own: a binding would stay.
    let bound = std::thread::scope(|scope| {
        let binding = scope.spawn(|| realtime::bind(&service.processors));
        binding.join().unwrap_or(Ok(()))
    });
    if let Err(cause) = bound {
        findings.push(finding("bound processors", Verdict::Warning, cause));
    }
    let processors = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
    let verdict = if processors < 4 {
        Verdict::Warning
    } else {
        Verdict::Good
    };
    findings.push(finding("processors", verdict, format!("{processors}")));
    findings
}

/// Whether GigE Vision packets can be taken past the kernel's own socket buffers.
fn packet_socket() -> Finding {
    const CAP_NET_RAW: u32 = 13;
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let effective = status
        .lines()
        .find_map(|line| line.strip_prefix("CapEff:"))
        .and_then(|hex| u64::from_str_radix(hex.trim(), 16).ok())
        .unwrap_or(0);
    let what = "packet sockets";
    if effective >> CAP_NET_RAW & 1 == 1 {
        return finding(what, Verdict::Good, "may be used");
    }
    finding(
        what,
        Verdict::Warning,
        "may not be used: frames may be lost; give the unit AmbientCapabilities=CAP_NET_RAW",
    )
}

/// Whether a socket may hold as much as is asked for where packet sockets may not be used.
fn receive_buffer() -> Finding {
    const WANTED_BYTES: u64 = 4 << 20;
    let file = "/proc/sys/net/core/rmem_max";
    let text = std::fs::read_to_string(file).unwrap_or_default();
    let bytes: u64 = text.trim().parse().unwrap_or(0);
    let what = "receive buffers";
    if bytes >= WANTED_BYTES {
        return finding(what, Verdict::Good, format!("up to {bytes} bytes"));
    }
    finding(
        what,
        Verdict::Warning,
        format!("up to {bytes} bytes: set net.core.rmem_max to {WANTED_BYTES} or more"),
    )
}

fn limit(what: &'static str, name: &str, wanted: u64, otherwise: &str) -> Finding {
    let limits = std::fs::read_to_string("/proc/self/limits").unwrap_or_default();
    let soft = limits
        .lines()
        .find_map(|line| line.strip_prefix(name))
        .and_then(|rest| rest.split_whitespace().next());
    let granted = match soft {
        Some("unlimited") => u64::MAX,
        Some(number) => number.parse().unwrap_or(0),
        None => 0,
    };
    if wanted == 0 {
        return finding(what, Verdict::Good, "not asked for");
    }
    // Root is not held to the limit.
    if granted >= wanted || rustix::process::geteuid().is_root() {
        return finding(what, Verdict::Good, "granted");
    }
    finding(what, Verdict::Warning, format!("not granted: {otherwise}"))
}
