use super::*;
use crate::capture::camera::{CameraEvent, Frame, Loss, monotonic_ns, realtime_ahead_ns};
use crate::image::GrayImage;
use std::sync::atomic::{AtomicBool, AtomicU64};

const PERIOD: Duration = Duration::from_millis(20);

/// What a scripted camera is told to do.
#[derive(Default)]
struct Script {
    /// Cannot be opened, and fails while it is open.
    is_unplugged: AtomicBool,
    /// Open, but sends nothing.
    is_silent: AtomicBool,
    opened: AtomicU64,
    /// The serial number: another camera when it changes.
    serial: AtomicU64,
    /// Frames whose number this divides are skipped; 0 for none.
    skips: AtomicU64,
}

/// A camera that takes a frame at every tick of a grid that all share, stamped by a clock of its own.
struct Scripted {
    script: Arc<Script>,
    offset_ns: i64,
    last: i64,
}

impl FrameSource for Scripted {
    fn size_px(&self) -> (u32, u32) {
        (2, 1)
    }

    fn identity(&self) -> String {
        format!(
            "{} {}",
            self.offset_ns,
            self.script.serial.load(Ordering::Relaxed)
        )
    }

    fn clock(&self) -> Clock {
        Clock::Own
    }

    fn start(&mut self) -> Result<(), CameraError> {
        Ok(())
    }

    fn next(&mut self, patience: Duration) -> Result<CameraEvent, CameraError> {
        let period_ns = PERIOD.as_nanos() as i64;
        let deadline = Instant::now() + patience;
        loop {
            if self.script.is_unplugged.load(Ordering::Relaxed) {
                return Err(CameraError::Gone("it was unplugged".to_owned()));
            }
            let tick = monotonic_ns() / period_ns;
            if tick > self.last && !self.script.is_silent.load(Ordering::Relaxed) {
                self.last = tick;
                let skips = self.script.skips.load(Ordering::Relaxed) as i64;
                if skips > 0 && tick % skips == 0 {
                    return Ok(CameraEvent::Lost {
                        kind: Loss::Skipped,
                        frames: 1,
                    });
                }
                let shown = (tick % 251) as u8;
                return Ok(CameraEvent::Frame(Frame {
                    number: tick as u64,
                    stamp_ns: tick * period_ns + self.offset_ns,
                    arrived_ns: monotonic_ns(),
                    image: GrayImage::filled(2, 1, shown),
                }));
            }
            if Instant::now() >= deadline {
                return Ok(CameraEvent::Quiet);
            }
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    fn stop(&mut self) {}
}

fn opener(script: &Arc<Script>, offset_ns: i64) -> Opener {
    let script = Arc::clone(script);
    Arc::new(move || {
        if script.is_unplugged.load(Ordering::Relaxed) {
            return Err(CameraError::Absent("it is not there".to_owned()));
        }
        script.opened.fetch_add(1, Ordering::Relaxed);
        Ok(Box::new(Scripted {
            script: Arc::clone(&script),
            offset_ns,
            last: monotonic_ns() / PERIOD.as_nanos() as i64,
        }))
    })
}

fn settings() -> Settings {
    Settings {
        stall_s: 0.3,
        retry_s: 0.25,
        patience_s: 0.0,
        ..Settings::default()
    }
}

const FRESH: Delivery = Delivery {
    queue: 2,
    overflow: Overflow::Oldest,
    keeps_journal: false,
};

fn open(scripts: &[Arc<Script>; 2], delivery: Delivery) -> Result<LiveSource, CameraError> {
    let openers = [
        opener(&scripts[0], 7_000_000_000),
        opener(&scripts[1], -3_000_000),
    ];
    LiveSource::open(&settings(), openers, delivery, || false)
}

fn events_for(source: &mut LiveSource, time: Duration) -> Vec<PairEvent> {
    let deadline = Instant::now() + time;
    let mut events = Vec::new();
    while Instant::now() < deadline {
        events.extend(source.next_event());
    }
    events
}

fn pairs(events: &[PairEvent]) -> Vec<&StereoPair> {
    let mut pairs = Vec::new();
    for event in events {
        if let PairEvent::Pair(pair) = event {
            pairs.push(pair);
        }
    }
    pairs
}

/// Images of pairs show the same tick, numbers and stamps rise.
fn assert_right(events: &[PairEvent]) {
    for pair in pairs(events) {
        assert_eq!(pair.left, pair.right, "pair {}", pair.sequence);
    }
    for two in events.windows(2) {
        assert!(two[0].sequence() < two[1].sequence());
        assert!(two[0].timestamp_ns() < two[1].timestamp_ns());
    }
}

#[test]
fn two_cameras_with_clocks_of_their_own_give_right_pairs() {
    let scripts = <[Arc<Script>; 2]>::default();
    let mut source = open(&scripts, FRESH).expect("open");
    let events = events_for(&mut source, Duration::from_millis(1000));
    assert_right(&events);
    let pairs = pairs(&events);
    assert!(pairs.len() > 20, "{}", pairs.len());
    for pair in &pairs {
        assert!(
            pair.skew.sigma_ns > 0.0 && pair.skew.ns.abs() < 10_000_000,
            "{:?}",
            pair.skew
        );
    }
    let monitor = source.monitor();
    let last = pairs.last().expect("some");
    let at = monitor.captured(last.sequence).expect("known");
    assert!(at.complete_ns >= at.monotonic_ns - 1_000_000);
    let ahead_ns = realtime_ahead_ns();
    assert!((last.timestamp_ns - at.monotonic_ns - ahead_ns).abs() < 50_000_000);
}

#[test]
fn a_camera_that_goes_and_comes_back_costs_only_its_absence() {
    let scripts = <[Arc<Script>; 2]>::default();
    let mut source = open(&scripts, FRESH).expect("open");
    let monitor = source.monitor();
    let before = events_for(&mut source, Duration::from_millis(500));
    scripts[1].is_unplugged.store(true, Ordering::Relaxed);
    let during = events_for(&mut source, Duration::from_millis(1000));
    assert_eq!(monitor.snapshot().cameras[1].state, State::Lost);
    assert_eq!(monitor.snapshot().cameras[0].state, State::Streaming);
    assert!(pairs(&during[5..]).is_empty());
    assert!(during.len() > 3, "the absence is told: {}", during.len());
    scripts[1].is_unplugged.store(false, Ordering::Relaxed);
    let after = events_for(&mut source, Duration::from_millis(1000));
    assert!(pairs(&after).len() > 10, "{}", pairs(&after).len());
    let snapshot = monitor.snapshot();
    assert_eq!(snapshot.cameras[1].state, State::Streaming);
    assert_eq!(snapshot.cameras.each_ref().map(|c| c.reconnects), [0, 1]);
    let all: Vec<PairEvent> = [before, during, after].concat();
    assert_right(&all);
}

#[test]
fn a_camera_that_falls_silent_is_opened_anew() {
    let scripts = <[Arc<Script>; 2]>::default();
    let mut source = open(&scripts, FRESH).expect("open");
    let monitor = source.monitor();
    events_for(&mut source, Duration::from_millis(200));
    scripts[0].is_silent.store(true, Ordering::Relaxed);
    events_for(&mut source, Duration::from_millis(1200));
    assert!(scripts[0].opened.load(Ordering::Relaxed) >= 2);
    scripts[0].is_silent.store(false, Ordering::Relaxed);
    let after = events_for(&mut source, Duration::from_millis(1000));
    assert!(pairs(&after).len() > 10);
    assert!(monitor.snapshot().cameras[0].reconnects >= 1);
}

#[test]
fn another_camera_in_the_place_of_one_is_not_taken_for_it() {
    let scripts = <[Arc<Script>; 2]>::default();
    let mut source = open(&scripts, FRESH).expect("open");
    let monitor = source.monitor();
    events_for(&mut source, Duration::from_millis(200));
    scripts[1].is_unplugged.store(true, Ordering::Relaxed);
    events_for(&mut source, Duration::from_millis(300));
    scripts[1].serial.store(9, Ordering::Relaxed);
    scripts[1].is_unplugged.store(false, Ordering::Relaxed);
    let during = events_for(&mut source, Duration::from_millis(800));
    assert!(pairs(&during).is_empty());
    let cause = monitor.snapshot().cameras[1].cause.clone();
    assert!(cause.contains("another camera came back"), "{cause}");
    scripts[1].serial.store(0, Ordering::Relaxed);
    let after = events_for(&mut source, Duration::from_millis(1000));
    assert!(!pairs(&after).is_empty());
}

#[test]
fn late_stages_get_fresh_pairs_and_every_drop_is_counted() {
    let scripts = <[Arc<Script>; 2]>::default();
    let mut source = open(&scripts, FRESH).expect("open");
    let monitor = source.monitor();
    let mut taken = 0;
    let mut last = None;
    for _ in 0..6 {
        std::thread::sleep(Duration::from_millis(200));
        if let Some(PairEvent::Pair(pair)) = source.next_event() {
            taken += 1;
            last = Some(pair.sequence);
            source.recycle(pair);
        }
    }
    let snapshot = monitor.snapshot();
    assert!(snapshot.dropped > 20, "{}", snapshot.dropped);
    let waiting = snapshot.pairs - snapshot.dropped - taken;
    assert!(waiting <= FRESH.queue as u64, "{waiting}");
    assert!(last.expect("pairs") + 2 * FRESH.queue as u64 + 2 >= snapshot.pairs);
}

#[test]
fn a_journal_has_every_frame() {
    let scripts = <[Arc<Script>; 2]>::default();
    scripts[1].skips.store(7, Ordering::Relaxed);
    let delivery = Delivery {
        queue: 1,
        overflow: Overflow::Newest,
        keeps_journal: true,
    };
    let mut source = open(&scripts, delivery).expect("open");
    let monitor = source.monitor();
    for _ in 0..8 {
        std::thread::sleep(Duration::from_millis(100));
        source.next_event();
    }
    drop(source);
    let (snapshot, journal) = (monitor.snapshot(), monitor.take_journal());
    let of = |side: Side, is: fn(&Fate) -> bool| {
        journal
            .iter()
            .filter(|e| e.side == side && is(&e.fate))
            .count() as u64
    };
    for side in [Side::Left, Side::Right] {
        let camera = &snapshot.cameras[side as usize];
        let paired = of(side, |f| matches!(f, Fate::Paired(_)));
        let alone = of(side, |f| matches!(f, Fate::Unmatched(_)));
        assert_eq!(paired, snapshot.pairs);
        assert_eq!(alone, camera.unmatched.total());
        // Those that still waited for their partner have no fate yet.
        assert!(camera.frames - paired - alone <= 8);
        assert_eq!(
            of(side, |f| matches!(f, Fate::Dropped(_))),
            snapshot.dropped
        );
    }
    assert!(snapshot.dropped > 5);
    let skipped = of(Side::Right, |f| matches!(f, Fate::Lost(Loss::Skipped, 1)));
    assert_eq!(skipped, snapshot.cameras[1].losses.of(Loss::Skipped));
    assert!(skipped > 2);
}

#[test]
fn what_cannot_be_opened_is_said_with_its_side() {
    let scripts = <[Arc<Script>; 2]>::default();
    scripts[1].is_unplugged.store(true, Ordering::Relaxed);
    let error = open(&scripts, FRESH).expect_err("absent");
    assert_eq!(
        error,
        CameraError::Absent("camera.right: it is not there".to_owned())
    );
    let both = [opener(&scripts[0], 0), opener(&scripts[0], 0)];
    let error = LiveSource::open(&settings(), both, FRESH, || false).expect_err("the same");
    assert!(
        error.is_permanent() && error.to_string().contains("the same camera"),
        "{error}"
    );
}

#[test]
fn the_end_of_the_run_is_the_end_of_the_events() {
    let scripts = <[Arc<Script>; 2]>::default();
    let mut source = open(&scripts, FRESH).expect("open");
    let monitor = source.monitor();
    let stopping = std::thread::spawn(move || {
        std::thread::sleep(Duration::from_millis(200));
        monitor.stop();
    });
    while source.next_event().is_some() {}
    assert!(source.next_event().is_none());
    stopping.join().expect("no panic");
    drop(source);
}
