//! What every camera must keep to, whatever drives it, and the cameras that need no hardware held to it.

use crate::recordings::{Encoding, HEIGHT, Recording, WIDTH};
use std::sync::Arc;
use std::time::{Duration, Instant};
use visod::capture::Side;
use visod::capture::camera::{CameraError, CameraEvent, Frame, FrameSource};
use visod::capture::dataset::{Dataset, Layout};
use visod::capture::files::FileCamera;
use visod::simulation::{
    SceneName, Settings, SimulatedCamera, Simulation, TrajectoryName, small_rig,
};

/// How long a camera may take for anything; a slow machine needs a small part of it.
const PATIENCE: Duration = Duration::from_secs(120);
/// What a source may take beyond the patience that it is given: to render an image, on a busy machine.
const COPYING: Duration = Duration::from_secs(30);

/// Opens a camera, however often.
pub(crate) type Open<'a> = &'a dyn Fn() -> Result<Box<dyn FrameSource>, CameraError>;

/// Holds a camera to the contract of [`FrameSource`]: order, stamps, geometry, stop, restart, reopening.
/// `is_endless` tells a camera from a recording.
pub(crate) fn assert_camera_conforms(open: Open<'_>, size_px: (u32, u32), is_endless: bool) {
    let mut source = open().expect("it is there");
    assert_eq!(source.size_px(), size_px);
    assert!(!source.identity().is_empty());
    let quiet = source
        .next(Duration::from_millis(20))
        .expect("stopped is no error");
    assert_eq!(quiet, CameraEvent::Quiet, "nothing comes before the start");
    source.start().expect("starts");
    source.start().expect("starting twice is one start");
    assert_in_order(&frames(&mut *source, 4, true), size_px);
    source.stop();
    source.stop();
    assert_eq!(
        source.next(Duration::from_millis(20)),
        Ok(CameraEvent::Quiet)
    );
    source.start().expect("starts again");
    assert_in_order(&frames(&mut *source, 3, false), size_px);
    let identity = source.identity();
    drop(source);
    let mut again = open().expect("a camera that was dropped is free");
    assert_eq!(again.identity(), identity);
    again.start().expect("starts");
    assert_in_order(&frames(&mut *again, 2, true), size_px);
    if !is_endless {
        assert_ends(&mut *again);
    }
    drop(again);
    drop(open().expect("one that never started can be dropped, too"));
}

/// Holds a camera's refusal of what it cannot do to its contract: one sentence, and no use in trying again.
pub(crate) fn assert_unsuitable(open: Open<'_>, says: &str) {
    let error = open().err().expect("refused");
    assert!(error.is_permanent(), "{error:?}");
    assert_sentence(&error, says);
}

/// Holds a camera that `leave` takes away while it streams to the contract: its stream ends with an error
/// that says so, and opening it anew fails until it is back.
#[cfg(any(feature = "v4l", all(feature = "aravis", feature = "ipc")))]
pub(crate) fn assert_leaves(open: Open<'_>, leave: impl FnOnce(), says: &str) {
    let mut source = open().expect("it is there");
    source.start().expect("starts");
    frames(&mut *source, 2, true);
    leave();
    let started = Instant::now();
    let error = loop {
        if let Err(e) = source.next(Duration::from_millis(50)) {
            break e;
        }
        assert!(started.elapsed() < PATIENCE, "it is not noticed");
    };
    assert!(matches!(error, CameraError::Gone(_)), "{error:?}");
    assert_sentence(&error, says);
    drop(source);
    let error = open().err().expect("it is not there");
    assert!(!error.is_permanent(), "it may come back: {error:?}");
    assert_sentence(&error, "");
}

fn assert_sentence(error: &CameraError, says: &str) {
    let text = error.to_string();
    println!("{text}");
    assert!(!text.is_empty() && !text.contains('\n'), "{text}");
    assert!(text.contains(says), "no '{says}' in: {text}");
}

/// Takes some frames; giving them back changes nothing.
fn frames(source: &mut dyn FrameSource, count: usize, recycle: bool) -> Vec<Frame> {
    let started = Instant::now();
    let mut frames: Vec<Frame> = Vec::new();
    while frames.len() < count {
        assert!(started.elapsed() < PATIENCE, "only {} frames", frames.len());
        let patience = Duration::from_millis(50);
        let asked = Instant::now();
        match source.next(patience).expect("no failure") {
            CameraEvent::Frame(frame) => {
                if recycle {
                    source.recycle(frame.image.clone());
                }
                frames.push(frame);
            }
            CameraEvent::Lost { .. } | CameraEvent::Quiet => {}
            CameraEvent::End => panic!("it ends after {}", frames.len()),
        }
        assert!(
            asked.elapsed() < patience + COPYING,
            "{:?}",
            asked.elapsed()
        );
    }
    frames
}

fn assert_in_order(frames: &[Frame], size_px: (u32, u32)) {
    for frame in frames {
        assert_eq!((frame.image.width(), frame.image.height()), size_px);
    }
    for two in frames.windows(2) {
        assert!(two[0].number < two[1].number, "numbers rise");
        assert!(two[0].stamp_ns < two[1].stamp_ns, "stamps rise");
        assert!(two[0].arrived_ns <= two[1].arrived_ns, "arrivals rise");
    }
}

fn assert_ends(source: &mut dyn FrameSource) {
    let started = Instant::now();
    while source.next(Duration::from_millis(50)).expect("no failure") != CameraEvent::End {
        assert!(started.elapsed() < PATIENCE, "no end");
    }
    assert_eq!(source.next(Duration::from_millis(50)), Ok(CameraEvent::End));
}

#[test]
fn cameras_from_files_conform() {
    for layout in [Layout::Visod, Layout::Kitti, Layout::Euroc] {
        let recording = Recording::write(layout, Encoding::Pgm8, 9);
        for side in [Side::Left, Side::Right] {
            let open = || {
                let dataset = Dataset::open(recording.path(), None).expect("a recording");
                let camera = FileCamera::open(&dataset, side, "files")?;
                Ok(Box::new(camera) as Box<dyn FrameSource>)
            };
            assert_camera_conforms(&open, (WIDTH, HEIGHT), false);
        }
    }
}

#[test]
fn a_file_that_is_missing_or_broken_is_a_lost_frame() {
    let recording = Recording::write(Layout::Euroc, Encoding::Pgm8, 6);
    let dataset = recording.open();
    recording.remove(2, 0);
    let mut camera = FileCamera::open(&dataset, Side::Left, "files").expect("opens");
    camera.start().expect("starts");
    let mut numbers = Vec::new();
    let mut lost = 0;
    loop {
        match camera.next(PATIENCE).expect("no failure") {
            CameraEvent::Frame(frame) => numbers.push(frame.number),
            CameraEvent::Lost { frames, .. } => lost += frames,
            CameraEvent::Quiet => {}
            CameraEvent::End => break,
        }
    }
    assert_eq!((numbers, lost), (vec![0, 1, 3, 4, 5], 1));
}

#[test]
fn simulated_cameras_conform() {
    let settings = Settings {
        frames: 9,
        ..Settings::default()
    };
    let (scene, way) = (SceneName::Room, TrajectoryName::LoopRoom);
    let simulation = Simulation::new(scene, way, small_rig(), settings).expect("fits");
    let simulation = Arc::new(simulation);
    for side in [Side::Left, Side::Right] {
        let open = || {
            let camera = SimulatedCamera::new(Arc::clone(&simulation), side);
            Ok(Box::new(camera) as Box<dyn FrameSource>)
        };
        assert_camera_conforms(&open, (320, 240), false);
    }
}

#[test]
fn a_recording_of_another_size_than_the_rig_is_refused() {
    let recording = Recording::write(Layout::Visod, Encoding::Pgm8, 3);
    let mut rig = recording.open().rig;
    rig.right.width *= 2;
    let dataset = Dataset::open(recording.path(), Some(rig)).expect("a recording");
    let open = || {
        let camera = FileCamera::open(&dataset, Side::Right, "files")?;
        Ok(Box::new(camera) as Box<dyn FrameSource>)
    };
    let size = format!("{}×{HEIGHT}", 2 * WIDTH);
    assert_unsuitable(&open, &size);
}
