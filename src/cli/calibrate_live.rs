//! Views from two cameras, while somebody moves the board: what is taken, and what is missing, on the terminal.

use super::Failure;
use super::calibrate::Args;
use super::calibrate_views::Views;
use super::live::{Stop, failure, log_to_stderr};
use crate::calibration::detect::detect_pair;
use crate::calibration::guidance::{Guide, Verdict};
use crate::calibration::{Board, Lens};
use crate::capture::live::{Delivery, LiveSource, Overflow};
use crate::capture::{PairEvent, PairSource, Side, StereoPair, drivers};
use crate::config::Config;
use crate::geometry::{Camera, Distortion, StereoRig};
use nalgebra::{Isometry3, Vector2};
use std::path::Path;

/// Takes views until there are enough, `--views` are reached, or somebody stops it (Ctrl-C).
pub(super) fn views(args: &Args, file: &Path, board: &Board, lens: Lens) -> Result<Views, Failure> {
    log_to_stderr();
    let size_px = args.size.ok_or_else(|| {
        Failure::usage("--size: is missing: it says which images the cameras shall send")
    })?;
    let stop = Stop::on_signals()?;
    let mut source = open(file, size_px, &stop)?;
    let cameras = source.monitor();
    stop.end_run(source.monitor(), None)?;
    let mut guide = Guide::new(*board, lens, size_px);
    eprintln!("Show the board to both cameras and hold it still; Ctrl-C ends the capture.");
    let mut said = String::new();
    while guide.views().len() < args.views && !guide.is_content() {
        let Some(event) = source.next_event() else {
            break;
        };
        let PairEvent::Pair(pair) = event else {
            continue;
        };
        let line = look(&pair, board, &mut guide)?;
        source.recycle(pair);
        if line != said {
            eprintln!("{line}");
            said = line;
        }
    }
    cameras.stop();
    drop(source);
    Ok(Views {
        views: guide.views().to_vec(),
        size_px,
        not_seen: Vec::new(),
        notes: Vec::new(),
    })
}

/// Offers a pair to the guide; what is to be said of it.
fn look(pair: &StereoPair, board: &Board, guide: &mut Guide) -> Result<String, Failure> {
    let name = format!("{:06}", pair.sequence);
    let view = detect_pair(&name, [&pair.left, &pair.right], board).map_err(Failure::other)?;
    let wanted = |guide: &Guide| match guide.missing().first() {
        Some(what) => format!("; now show it {what}"),
        None => "; nothing is missing any more".to_owned(),
    };
    Ok(match guide.offer(view) {
        Verdict::Taken { gain } => {
            let gain = gain.map_or_else(String::new, |gain| {
                format!(
                    ", its best σ falls by {:.0} %",
                    100.0 * (1.0 - gain.sqrt().recip())
                )
            });
            let focal = guide.calibration().map_or_else(String::new, |found| {
                format!(", focal length ± {:.2} px", found.sigma(0))
            });
            format!(
                "view {} taken{gain}{focal}{}",
                guide.views().len(),
                wanted(guide)
            )
        }
        Verdict::NotSeen => "the board is not seen by both cameras".to_owned(),
        Verdict::Moving => "hold still".to_owned(),
        Verdict::Known => format!("seen already{}", wanted(guide)),
        Verdict::NothingNew { .. } => format!("adds nothing{}", wanted(guide)),
    })
}

/// The cameras of a configuration, which needs no rig yet.
fn open(file: &Path, size_px: (u32, u32), stop: &Stop) -> Result<LiveSource, Failure> {
    let config = Config::load(file).map_err(Failure::usage)?;
    // Drivers want to know the images' size alone.
    let (width, height) = size_px;
    let any = Camera::new(
        width,
        height,
        Vector2::repeat(f64::from(width)),
        Vector2::new(f64::from(width), f64::from(height)) * 0.5,
        Distortion::None,
    );
    let rig = StereoRig {
        left: any.clone(),
        right: any,
        right_from_left: Isometry3::translation(-0.1, 0.0, 0.0),
        base_from_camera: None,
        uncertainty: None,
    };
    let opener = |side, key: &str, settings: &Option<_>| {
        let settings = settings.as_ref().ok_or_else(|| {
            Failure::usage(format!(
                "{}: {key}: is missing: it says which camera is to be used",
                file.display()
            ))
        })?;
        drivers::opener(settings, side, &rig, &config.dataset)
            .map_err(|e| Failure::usage(format!("{}: {key}: {e}", file.display())))
    };
    let openers = [
        opener(Side::Left, "camera.left", &config.camera.left)?,
        opener(Side::Right, "camera.right", &config.camera.right)?,
    ];
    let delivery = Delivery {
        queue: 1,
        overflow: Overflow::Oldest,
        keeps_journal: false,
    };
    LiveSource::open(&config.capture, openers, delivery, || stop.is_asked_for()).map_err(failure)
}
