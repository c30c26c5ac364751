//! Recordings that were cut off at any byte: power failed, the disk was full, the daemon was killed. Every pair
//! that was whole before the cut replays, bit for bit, and nothing else.

use rand::{RngExt, SeedableRng};
use rand_xoshiro::Xoshiro256PlusPlus;
use std::path::{Path, PathBuf};
use visod::capture::recorder::Recorder;
use visod::capture::{Dataset, PairEvent, PairSource, ReadAhead, Skew, StereoPair};
use visod::geometry::StereoRig;
use visod::image::GrayImage;
use visod::simulation::small_rig;

const CUTS: usize = 1000;
const PAIRS: u64 = 8;
/// px.
const SIZE: (u32, u32) = (24, 16);

/// A rig with images so small that a thousand recordings take a moment.
fn tiny_rig() -> StereoRig {
    let mut rig = small_rig();
    for camera in [&mut rig.left, &mut rig.right] {
        (camera.width, camera.height) = SIZE;
    }
    rig
}

/// Pairs of noise, which no format makes small.
fn noisy_pairs() -> Vec<StereoPair> {
    let mut random = Xoshiro256PlusPlus::seed_from_u64(1);
    let mut image = || {
        let pixels = (0..SIZE.0 * SIZE.1).map(|_| random.random()).collect();
        GrayImage::from_vec(SIZE.0, SIZE.1, pixels).unwrap()
    };
    let pair = |sequence: u64| StereoPair {
        sequence,
        // From 9.8 s on: the seconds gain a digit on the way.
        timestamp_ns: 9_800_000_000 + 50_000_001 * sequence as i64,
        skew: Skew::default(),
        left: image(),
        right: image(),
    };
    (0..PAIRS).map(pair).collect()
}

/// The pairs that come out before `source` ends or breaks off.
fn pairs_of(mut source: impl PairSource) -> Vec<StereoPair> {
    std::iter::from_fn(|| source.next_event())
        .filter_map(|event| match event {
            PairEvent::Pair(pair) => Some(pair),
            PairEvent::Unusable(_) => None,
        })
        .collect()
}

/// A folder's files in the order in which they were written, as pieces of one stream of bytes.
struct Stream {
    pieces: Vec<(PathBuf, Vec<u8>)>,
    /// After how many bytes each pair is whole.
    whole_at: Vec<usize>,
}

impl Stream {
    /// Records pairs into a folder and takes down what every step added.
    fn of(pairs: &[StereoPair], rig: &StereoRig) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("recording");
        let mut recorder = Recorder::create(&path, rig).unwrap();
        let mut stream = Self {
            pieces: Vec::new(),
            whole_at: Vec::new(),
        };
        let read = |name: &str| std::fs::read(path.join(name)).unwrap();
        stream.push("rig.toml", read("rig.toml"));
        stream.push("frames.csv", read("frames.csv"));
        stream.push("times.txt", Vec::new());
        let mut times = 0;
        for (n, pair) in pairs.iter().enumerate() {
            recorder.add(pair).unwrap();
            let mut images = ["left", "right"].map(|side| format!("{side}/{n:06}.png"));
            // Both are written at once: either may be there first.
            if n % 2 == 1 {
                images.reverse();
            }
            for image in images {
                stream.push(&image, read(&image));
            }
            let all = read("times.txt");
            stream.push("times.txt", all[times..].to_vec());
            times = all.len();
            // The number says it all; that the line ends makes no difference.
            stream.whole_at.push(stream.bytes() - 1);
        }
        stream
    }

    fn push(&mut self, name: &str, bytes: Vec<u8>) {
        self.pieces.push((name.into(), bytes));
    }

    fn bytes(&self) -> usize {
        self.pieces.iter().map(|(_, bytes)| bytes.len()).sum()
    }

    /// Writes the first `left` bytes into a folder.
    fn write(&self, folder: &Path, mut left: usize) {
        use std::io::Write;
        for (name, bytes) in &self.pieces {
            if left == 0 && !bytes.is_empty() {
                return;
            }
            let file = folder.join(name);
            std::fs::create_dir_all(file.parent().unwrap()).unwrap();
            let mut options = std::fs::OpenOptions::new();
            let mut file = options.append(true).create(true).open(file).unwrap();
            let take = left.min(bytes.len());
            file.write_all(&bytes[..take]).unwrap();
            left -= take;
        }
    }
}

#[test]
fn a_folder_cut_at_any_of_a_thousand_bytes_replays_every_whole_pair() {
    let (pairs, rig) = (noisy_pairs(), tiny_rig());
    let stream = Stream::of(&pairs, &rig);
    let mut random = Xoshiro256PlusPlus::seed_from_u64(2);
    let mut most = 0;
    // Lines of times are short beside images: every byte of the last two, too.
    let line = stream.whole_at[PAIRS as usize - 2];
    let cuts = (0..CUTS).map(|_| random.random_range(0..=stream.bytes()));
    let end = stream.bytes();
    for cut in cuts.chain(line - 14..line + 3).chain(end - 14..=end) {
        let folder = tempfile::tempdir().unwrap();
        stream.write(folder.path(), cut);
        let whole = stream.whole_at.iter().filter(|at| **at <= cut).count();
        let found = match Dataset::open(folder.path(), None) {
            Ok(dataset) => pairs_of(ReadAhead::start(&dataset).unwrap()),
            // Before the first pair is whole it may be no recording at all.
            Err(why) => {
                assert_eq!(whole, 0, "cut at {cut}: {why}");
                continue;
            }
        };
        assert!(
            found == pairs[..whole],
            "cut at {cut}: {} of {whole}",
            found.len()
        );
        most = most.max(whole);
    }
    assert_eq!(most as u64, PAIRS);
}

#[cfg(feature = "mcap")]
mod of_mcap {
    use super::*;
    use std::io::{self, Seek, SeekFrom, Write};
    use std::sync::{Arc, Mutex};
    use visod::capture::dataset::Settings;
    use visod::capture::mcap::McapRecording;
    use visod::estimation::{self, Counts, Odometer, PairStamp, sources::RigErrors};
    use visod::output::mcap::McapWriter;

    /// A file that remembers what was written where, in order.
    #[derive(Clone, Default)]
    struct Log(Arc<Mutex<Written>>);

    #[derive(Default)]
    struct Written {
        pieces: Vec<(usize, Vec<u8>)>,
        at: usize,
        end: usize,
    }

    impl Log {
        fn bytes(&self) -> usize {
            let written = self.0.lock().unwrap();
            written.pieces.iter().map(|(_, bytes)| bytes.len()).sum()
        }

        /// What the file held when so many bytes had been written.
        fn held_after(&self, mut left: usize) -> Vec<u8> {
            let mut file = Vec::new();
            for (at, bytes) in &self.0.lock().unwrap().pieces {
                let take = left.min(bytes.len());
                file.resize(file.len().max(at + take), 0);
                file[*at..at + take].copy_from_slice(&bytes[..take]);
                left -= take;
            }
            file
        }
    }

    impl Write for Log {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            let mut written = self.0.lock().unwrap();
            let at = written.at;
            written.pieces.push((at, bytes.to_vec()));
            written.at += bytes.len();
            written.end = written.end.max(written.at);
            Ok(bytes.len())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    impl Seek for Log {
        fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
            let mut written = self.0.lock().unwrap();
            let at = match to {
                SeekFrom::Start(at) => at as i64,
                SeekFrom::Current(by) => written.at as i64 + by,
                SeekFrom::End(by) => written.end as i64 + by,
            };
            written.at = usize::try_from(at).map_err(io::Error::other)?;
            Ok(at as u64)
        }
    }

    /// Writes pairs; also says after how many bytes each was there.
    fn written(pairs: &[StereoPair], rig: &StereoRig) -> (Log, Vec<usize>) {
        let log = Log::default();
        let mut writer = McapWriter::new(log.clone(), rig).unwrap();
        let settings = estimation::Settings::default();
        let stamp = |pair: &StereoPair| PairStamp {
            sequence: pair.sequence,
            timestamp_ns: pair.timestamp_ns,
        };
        let errors = RigErrors::of(rig, &settings);
        let mut odometer = Odometer::new(settings, errors, stamp(&pairs[0]));
        let mut whole_at = Vec::new();
        for pair in pairs {
            let estimate = odometer.begin(stamp(pair), Counts::default());
            let images = [&pair.left, &pair.right];
            writer.add(&estimate, &[], Some(images)).unwrap();
            whole_at.push(log.bytes());
        }
        writer.finish().unwrap();
        (log, whole_at)
    }

    fn found_in(file: &Path) -> Option<Vec<StereoPair>> {
        let recording = McapRecording::open(file, None, None, Settings::default()).ok()?;
        Some(pairs_of(recording.source().unwrap()))
    }

    /// Both the file that a daemon leaves that is killed while it writes, and a whole one that is cut.
    #[test]
    fn an_mcap_file_cut_at_any_of_a_thousand_bytes_replays_every_whole_pair() {
        let (pairs, rig) = (noisy_pairs(), tiny_rig());
        let (log, whole_at) = written(&pairs, &rig);
        let finished = log.held_after(usize::MAX);
        let ends = ends_of_images(&finished, &pairs);
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("cut.mcap");
        let mut random = Xoshiro256PlusPlus::seed_from_u64(3);
        let mut most = [0; 2];
        for _ in 0..CUTS {
            let killed_at = random.random_range(0..=log.bytes());
            std::fs::write(&file, log.held_after(killed_at)).unwrap();
            let whole = whole_at.iter().filter(|at| **at <= killed_at).count();
            let found = found_in(&file).unwrap_or_default();
            // The last one may be complete although its chunk is not.
            let more = found.len().saturating_sub(whole);
            assert!(
                found.len() >= whole && more <= 1,
                "killed at {killed_at}: {} of {whole}",
                found.len()
            );
            assert!(found == pairs[..found.len()], "killed at {killed_at}");
            most[0] = most[0].max(whole);

            let cut = random.random_range(0..=finished.len());
            std::fs::write(&file, &finished[..cut]).unwrap();
            let found = found_in(&file).unwrap_or_default();
            // What a pair's second image takes comes before what its chunk ends with.
            let whole = ends.iter().filter(|end| **end <= cut).count();
            assert!(
                found == pairs[..whole],
                "cut at {cut}: {} of {whole}",
                found.len()
            );
            most[1] = most[1].max(whole);
        }
        assert_eq!(most, [PAIRS as usize; 2]);
    }

    /// Where the right image of each pair ends, found by the bytes of its PNG themselves.
    fn ends_of_images(file: &[u8], pairs: &[StereoPair]) -> Vec<usize> {
        let end_of_png = *b"IEND\xAE\x42\x60\x82";
        let ends = file.windows(end_of_png.len()).enumerate();
        let ends: Vec<usize> = ends
            .filter(|(_, bytes)| **bytes == end_of_png)
            .map(|(at, _)| at + end_of_png.len())
            .collect();
        assert_eq!(ends.len(), 2 * pairs.len());
        ends.into_iter().skip(1).step_by(2).collect()
    }
}
