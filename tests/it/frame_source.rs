//! What every frame source must keep to, and the sources from files held to it.

use crate::recordings::{Encoding, HEIGHT, Recording, WIDTH, picture, test_recording};
use std::sync::mpsc;
use std::time::Duration;
use visod::capture::dataset::{Dataset, Layout};
use visod::capture::{PairEvent, PairSource, ReadAhead, Realtime};

/// How long a source may take for anything before it counts as hanging; a slow machine needs a
/// small part of it.
const PATIENCE: Duration = Duration::from_secs(60);

/// What a source is known to hand out.
pub(crate) struct Expected {
    /// Events in all, unusable ones included.
    pub(crate) events: u64,
    /// Width and height of the left and of the right images, px.
    pub(crate) sizes_px: [(u32, u32); 2],
    /// Numbers of the pairs that are unusable.
    pub(crate) unusable: Vec<u64>,
}

/// Holds the sources that `fresh` makes, all alike, to the contract of [`PairSource`].
pub(crate) fn assert_conforms<S: PairSource + 'static>(expected: &Expected, fresh: impl Fn() -> S) {
    let events = played(fresh(), false);
    assert_in_order(expected, &events);
    // Without assert_eq: nobody wants to read all the pixels.
    assert!(events == played(fresh(), false), "a fresh source repeats");
    assert!(events == played(fresh(), true), "recycling changes nothing");
    for taken in [0, 1, expected.events / 2, expected.events] {
        assert_drops(fresh(), taken);
    }
}

/// Runs `work` on a thread of its own, as the pipeline does, and does not wait for ever.
fn patiently<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> T {
    let (done, wait) = mpsc::channel();
    let thread = std::thread::spawn(move || done.send(work()));
    let result = wait.recv_timeout(PATIENCE);
    let result = result.expect("neither a hang nor a panic in the source");
    thread.join().expect("no panic").expect("received");
    result
}

/// All events to the end, where the source must stay at its end.
fn played<S: PairSource + 'static>(mut source: S, recycle: bool) -> Vec<PairEvent> {
    patiently(move || {
        if recycle {
            source.make_room(1);
        }
        let hint = source.len_hint();
        let mut events = Vec::new();
        while let Some(event) = source.next_event() {
            events.push(event.clone());
            if let (true, PairEvent::Pair(pair)) = (recycle, event) {
                source.recycle(pair);
            }
            assert_eq!(
                source.len_hint(),
                hint,
                "the hint counts all events, not those left"
            );
        }
        for _ in 0..3 {
            assert!(
                source.next_event().is_none(),
                "after the end there is nothing"
            );
        }
        if let Some(hint) = hint {
            assert_eq!(hint, events.len() as u64, "the hint is right");
        }
        events
    })
}

fn assert_in_order(expected: &Expected, events: &[PairEvent]) {
    assert_eq!(events.len() as u64, expected.events);
    let mut last_ns = None;
    let mut unusable = Vec::new();
    for (event, sequence) in events.iter().zip(0..) {
        assert_eq!(event.sequence(), sequence, "numbers count every event");
        if let Some(now_ns) = event.timestamp_ns() {
            assert!(
                last_ns.is_none_or(|last| last < now_ns),
                "stamps rise: {sequence}"
            );
            last_ns = Some(now_ns);
        }
        match event {
            PairEvent::Pair(pair) => {
                let sizes = [&pair.left, &pair.right].map(|image| (image.width(), image.height()));
                assert_eq!(sizes, expected.sizes_px, "pair {sequence}");
            }
            PairEvent::Unusable(event) => {
                assert!(
                    !event.why.is_empty() && !event.why.contains('\n'),
                    "{}",
                    event.why
                );
                unusable.push(sequence);
            }
        }
    }
    assert_eq!(unusable, expected.unusable);
}

/// Takes a few events and drops the source, which must come back at once.
fn assert_drops<S: PairSource + 'static>(mut source: S, taken: u64) {
    patiently(move || {
        for _ in 0..taken {
            assert!(source.next_event().is_some());
        }
        drop(source);
    });
}

const LAYOUTS: [Layout; 3] = [Layout::Visod, Layout::Kitti, Layout::Euroc];

/// More than the queues hold, so that the threads have to wait for the consumer.
const COUNT: u64 = 12;

fn expected(unusable: &[u64]) -> Expected {
    Expected {
        events: COUNT,
        sizes_px: [(WIDTH, HEIGHT); 2],
        unusable: unusable.to_vec(),
    }
}

fn reading(dataset: &Dataset) -> ReadAhead {
    ReadAhead::start(dataset).expect("threads")
}

#[test]
fn files_in_every_layout_and_encoding_conform() {
    for layout in LAYOUTS {
        for encoding in Encoding::ALL {
            let recording = Recording::write(layout, encoding, COUNT);
            let dataset = recording.open();
            assert_eq!(dataset.layout, layout);
            assert_conforms(&expected(&[]), || reading(&dataset));
        }
    }
}

#[test]
fn what_was_written_is_what_is_read() {
    for layout in LAYOUTS {
        for encoding in Encoding::ALL {
            let recording = Recording::write(layout, encoding, 3);
            for event in played(reading(&recording.open()), true) {
                let PairEvent::Pair(pair) = event else {
                    panic!("{event:?}");
                };
                for (side, image) in [(0, &pair.left), (1, &pair.right)] {
                    let truth = picture(pair.sequence, side);
                    let pixels = image.pixels().iter().zip(&truth);
                    let worst = pixels.map(|(a, b)| a.abs_diff(*b)).max();
                    assert!(
                        worst <= Some(encoding.loss()),
                        "{layout} {encoding:?}: {worst:?}"
                    );
                }
            }
        }
    }
}

#[test]
fn a_source_at_its_own_pace_conforms() {
    // Stamps are a millisecond apart: a test has no time for more.
    let recording = Recording::write(Layout::Visod, Encoding::Pgm8, COUNT);
    let dataset = recording.open();
    assert_conforms(&expected(&[]), || Realtime::new(reading(&dataset)));
}

#[test]
fn broken_files_are_events_and_the_run_goes_on() {
    for layout in LAYOUTS {
        for encoding in [Encoding::Png8, Encoding::Jpeg, Encoding::Pgm16] {
            let recording = Recording::write(layout, encoding, COUNT);
            let listed = layout == Layout::Euroc;
            let missing = |other| match (listed, other) {
                (false, _) => "is missing, while",
                (true, "right") => "has no right image within",
                (true, _) => "has no left image within",
            };
            recording.remove(1, 0);
            recording.remove(2, 1);
            recording.truncate(4, 0);
            recording.truncate(5, 1);
            recording.overwrite(6, 0, b"");
            recording.overwrite(7, 1, b"hello");
            recording.resize(9, 1);
            recording.overwrite(10, 0, b"");
            recording.truncate(10, 1);
            let dataset = recording.open();
            assert_conforms(&expected(&[1, 2, 4, 5, 6, 7, 9, 10]), || reading(&dataset));
            let size = format!(
                "has {}×{HEIGHT} px, but the rig's {WIDTH}×{HEIGHT}",
                WIDTH / 2
            );
            let causes = [
                (1, missing("left")),
                (2, missing("right")),
                (4, "the file ends before the image does"),
                (5, "the file ends before the image does"),
                (6, "the file is empty"),
                (7, "is not a PNG, JPEG, PGM or PPM image"),
                (9, &size),
                (10, "the file is empty; "),
            ];
            let events = played(reading(&dataset), false);
            for (sequence, cause) in causes {
                let PairEvent::Unusable(event) = &events[sequence] else {
                    panic!("{sequence} must be unusable");
                };
                let name = recording.name(sequence as u64);
                assert!(event.why.contains(cause), "{} lacks {cause}", event.why);
                assert!(event.why.contains(&name), "{} lacks {name}", event.why);
                assert_eq!(
                    event.timestamp_ns,
                    Some(recording.stamp_ns(sequence as u64))
                );
            }
        }
    }
}

#[test]
fn a_file_that_goes_away_meanwhile_is_an_event() {
    let recording = Recording::write(Layout::Euroc, Encoding::Pgm8, COUNT);
    let dataset = recording.open();
    recording.remove(3, 1);
    assert_conforms(&expected(&[3]), || reading(&dataset));
    let events = played(reading(&dataset), false);
    let PairEvent::Unusable(event) = &events[3] else {
        panic!("it must be unusable");
    };
    assert!(
        event.why.contains("cannot be read: No such file"),
        "{}",
        event.why
    );
}

#[test]
fn a_rig_of_another_resolution_leaves_no_pair_usable() {
    let recording = Recording::write(Layout::Visod, Encoding::Png8, COUNT);
    let mut rig = recording.open().rig;
    rig.left.width *= 2;
    let dataset = Dataset::open(recording.path(), Some(rig)).expect("a recording");
    let all: Vec<u64> = (0..COUNT).collect();
    assert_conforms(&expected(&all), || reading(&dataset));
}

#[test]
fn the_test_recordings_conform() {
    for (name, events, size_px) in [
        ("kitti_straight", 51, (1226, 370)),
        ("euroc_standstill", 40, (752, 480)),
    ] {
        let Some(path) = test_recording(name) else {
            continue;
        };
        let dataset = Dataset::open(&path, None).expect("a recording");
        let expected = Expected {
            events,
            sizes_px: [size_px; 2],
            unusable: vec![],
        };
        assert_conforms(&expected, || reading(&dataset));
    }
}
