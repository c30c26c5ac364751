//! Recordings held in memory: pairs to and fro as often as they are asked for, read from no disk.

use std::path::PathBuf;
use std::sync::Arc;
use visod::capture::{Dataset, PairEvent, PairSource, ReadAhead, StereoPair};
use visod::estimation;
use visod::geometry::StereoRig;
use visod::simulation::{SceneName, Settings, Simulation, TrajectoryName};

/// Pairs of one rig.
#[derive(Clone)]
pub struct Recording {
    /// The rig that took them.
    pub rig: StereoRig,
    /// The pairs, in order.
    pub pairs: Arc<[StereoPair]>,
}

impl Recording {
    /// Pairs that a rig takes in the simulated hall, going straight ahead.
    pub fn simulated(rig: StereoRig, frames: u64) -> Self {
        let settings = Settings {
            frames,
            ..Settings::default()
        };
        let hall = (SceneName::Hall, TrajectoryName::Straight);
        let simulation = match Simulation::new(hall.0, hall.1, rig, settings) {
            Ok(simulation) => simulation,
            Err(e) => unreachable!("the hall is free: {e}"),
        };
        Self {
            rig: simulation.rig().clone(),
            pairs: (0..frames).map(|frame| simulation.pair(frame).0).collect(),
        }
    }

    /// The first `frames` pairs of a test recording, if it is there.
    pub fn recorded(name: &str, frames: usize) -> Option<Self> {
        let data = match std::env::var_os("VISOD_TEST_DATA") {
            Some(folder) => PathBuf::from(folder),
            None => PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/data"),
        };
        let dataset = Dataset::open(&data.join(name), None).ok()?;
        let mut source = ReadAhead::start(&dataset).ok()?;
        let events = std::iter::from_fn(|| source.next_event());
        let pairs = events.filter_map(|event| match event {
            PairEvent::Pair(pair) => Some(pair),
            PairEvent::Unusable(_) => None,
        });
        Some(Self {
            pairs: pairs.take(frames).collect(),
            rig: dataset.rig.clone(),
        })
    }

    /// A source of `count` pairs: the recording forwards, backwards, forwards, …
    pub fn source(&self, count: u64) -> ToAndFro {
        ToAndFro {
            pairs: Arc::clone(&self.pairs),
            next: 0,
            count,
            spare: Vec::with_capacity(16),
        }
    }

    /// Which of the recording's pairs comes at place `place` of a source.
    pub fn index(&self, place: u64) -> usize {
        to_and_fro(place, self.pairs.len())
    }
}

/// The estimator's defaults, for a source that [turns](with_turns).
pub fn estimation() -> estimation::Settings {
    with_turns(estimation::Settings::default())
}

/// The same settings, but that pairs may come again after the next one, where a source turns.
pub fn with_turns(settings: estimation::Settings) -> estimation::Settings {
    estimation::Settings {
        repeats: 1,
        ..settings
    }
}

fn to_and_fro(place: u64, len: usize) -> usize {
    let period = (2 * len - 2).max(1);
    let at = place as usize % period;
    at.min(period - at)
}

/// Hands out copies of pairs in memory, as a camera does: into buffers that come back.
pub struct ToAndFro {
    pairs: Arc<[StereoPair]>,
    next: u64,
    count: u64,
    spare: Vec<StereoPair>,
}

impl ToAndFro {
    /// The place of the next pair.
    pub fn place(&self) -> u64 {
        self.next
    }

    /// Leaves the next pair out.
    pub fn skip(&mut self) {
        self.next += 1;
    }
}

impl PairSource for ToAndFro {
    fn next_event(&mut self) -> Option<PairEvent> {
        if self.next >= self.count {
            return None;
        }
        let from = &self.pairs[to_and_fro(self.next, self.pairs.len())];
        let mut pair = self.spare.pop().unwrap_or_else(|| from.clone());
        pair.sequence = self.next;
        pair.timestamp_ns = 100_000_000 * self.next as i64;
        for (to, from) in [(&mut pair.left, &from.left), (&mut pair.right, &from.right)] {
            to.reshape(from.width(), from.height());
            to.pixels_mut().copy_from_slice(from.pixels());
        }
        self.next += 1;
        Some(PairEvent::Pair(pair))
    }

    fn len_hint(&self) -> Option<u64> {
        Some(self.count)
    }

    fn recycle(&mut self, pair: StereoPair) {
        if self.spare.len() < self.spare.capacity() {
            self.spare.push(pair);
        }
    }
}
