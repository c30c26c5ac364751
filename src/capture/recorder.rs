//! Pairs in; a recording in visod's own layout out, that can be read at any moment of its making.
//!
//! `times.txt` grows by a line once both images of a pair are there. A pair of which something cannot be
//! written, because the disk is full for example, is taken back, so that what stands there is whole.
//! `frames.csv` says what became of every frame of either camera.

use super::StereoPair;
use super::live::{Entry, Fate, name_of};
use crate::geometry::{StereoRig, save_rig};
use crate::image::GrayImage;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};
use std::collections::HashMap;
use std::fs::{File, OpenOptions};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

/// Header of `frames.csv`.
const FRAMES_HEADER: &str = "camera,number,stamp_ns,host_ns,fate,detail,arrived_ns\n";

/// Why a recording cannot go on.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// The folder holds something already.
    #[error("{}: is not empty; name a new folder, so that no recording is overwritten", .0.display())]
    NotEmpty(PathBuf),
    /// The name belongs to something else than a folder.
    #[error("{}: is not a folder", .0.display())]
    NotAFolder(PathBuf),
    /// A file or folder cannot be written: no right to, no room left …
    #[error("{}: cannot be written: {cause}", file.display())]
    Write {
        /// The file or folder.
        file: PathBuf,
        /// What the system said.
        cause: io::Error,
    },
}

/// Writes a recording, pair by pair.
#[derive(Debug)]
pub struct Recorder {
    folder: PathBuf,
    times: Growing,
    frames: Growing,
    /// The number that each pair's files have, by the pair's own.
    written: HashMap<u64, u64>,
    failed: HashMap<u64, ()>,
    count: u64,
    png: [Vec<u8>; 2],
}

impl Recorder {
    /// Makes the recording's folder, with its parents, and writes the rig into it.
    ///
    /// # Errors
    /// The folder is there and not empty, or something cannot be written.
    pub fn create(folder: &Path, rig: &StereoRig) -> Result<Self, RecordError> {
        if folder.exists() && !folder.is_dir() {
            return Err(RecordError::NotAFolder(folder.to_owned()));
        }
        if std::fs::read_dir(folder).is_ok_and(|mut entries| entries.next().is_some()) {
            return Err(RecordError::NotEmpty(folder.to_owned()));
        }
        for name in ["left", "right"] {
            let part = folder.join(name);
            std::fs::create_dir_all(&part).map_err(|cause| write_error(&part, cause))?;
        }
        save_rig(folder, rig).map_err(|(file, cause)| write_error(&file, cause))?;
        let mut frames = Growing::create(folder.join("frames.csv"))?;
        frames.add(FRAMES_HEADER)?;
        Ok(Self {
            folder: folder.to_owned(),
            times: Growing::create(folder.join("times.txt"))?,
            frames,
            written: HashMap::new(),
            failed: HashMap::new(),
            count: 0,
            png: Default::default(),
        })
    }

    /// Pairs that stand in the recording.
    #[must_use]
    pub fn count(&self) -> u64 {
        self.count
    }

    /// Writes a pair, whole or not at all.
    ///
    /// # Errors
    /// Something cannot be written; the recording holds what it held before.
    pub fn add(&mut self, pair: &StereoPair) -> Result<(), RecordError> {
        let files = ["left", "right"].map(|side| {
            let name = format!("{:06}.png", self.count);
            self.folder.join(side).join(name)
        });
        let seconds = pair.timestamp_ns.div_euclid(1_000_000_000);
        let rest = pair.timestamp_ns.rem_euclid(1_000_000_000);
        let [left_png, right_png] = &mut self.png;
        let (left, right) = rayon::join(
            || write_image(&files[0], &pair.left, left_png),
            || write_image(&files[1], &pair.right, right_png),
        );
        let all = left
            .and(right)
            .and_then(|()| self.times.add(&format!("{seconds}.{rest:09}\n")));
        if all.is_err() {
            for file in &files {
                // What was never made need not go.
                let _ = std::fs::remove_file(file);
            }
            self.failed.insert(pair.sequence, ());
            return all;
        }
        self.written.insert(pair.sequence, self.count);
        self.count += 1;
        Ok(())
    }

    /// Writes down what became of frames. Those of pairs that are still under way must not be among
    /// them.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn note(&mut self, entries: &[Entry]) -> Result<(), RecordError> {
        let mut text = String::new();
        for entry in entries {
            text += &self.line(entry);
        }
        self.frames.add(&text)
    }

    fn line(&self, entry: &Entry) -> String {
        let (fate, detail) = match entry.fate {
            Fate::Paired(pair) => match self.written.get(&pair) {
                Some(number) => ("written", number.to_string()),
                None if self.failed.contains_key(&pair) => ("not_written", "failed".to_owned()),
                None => ("not_written", "dropped".to_owned()),
            },
            Fate::Dropped(_) => return String::new(),
            Fate::Unmatched(why) => ("unmatched", why.as_str().to_owned()),
            Fate::Lost(kind, frames) => ("lost", format!("{}:{frames}", kind.as_str())),
        };
        let number = |n: Option<i128>| n.map_or(String::new(), |n| n.to_string());
        format!(
            "{},{},{},{},{fate},{detail},{}\n",
            name_of(entry.side),
            number(entry.number.map(i128::from)),
            number(entry.stamp_ns.map(i128::from)),
            number(entry.host_ns.map(i128::from)),
            number(entry.arrived_ns.map(i128::from)),
        )
    }
}

fn write_error(file: &Path, cause: io::Error) -> RecordError {
    RecordError::Write {
        file: file.to_owned(),
        cause,
    }
}

fn write_image(file: &Path, image: &GrayImage, png: &mut Vec<u8>) -> Result<(), RecordError> {
    png.clear();
    PngEncoder::new_with_quality(&mut *png, CompressionType::Fast, FilterType::Sub)
        .write_image(
            image.pixels(),
            image.width(),
            image.height(),
            ExtendedColorType::L8,
        )
        .map_err(|e| write_error(file, io::Error::other(e)))?;
    std::fs::write(file, png).map_err(|e| write_error(file, e))
}

/// A text file that grows by whole pieces.
#[derive(Debug)]
struct Growing {
    path: PathBuf,
    file: File,
    bytes: u64,
}

impl Growing {
    fn create(path: PathBuf) -> Result<Self, RecordError> {
        let file = OpenOptions::new()
            .write(true)
            .create_new(true)
            .open(&path)
            .map_err(|e| write_error(&path, e))?;
        Ok(Self {
            path,
            file,
            bytes: 0,
        })
    }

    /// Adds a piece; of one that does not fit, nothing is left.
    fn add(&mut self, text: &str) -> Result<(), RecordError> {
        let written = self.file.write_all(text.as_bytes());
        if let Err(cause) = written {
            // To where it ended before; that takes no room.
            let _ = self.file.set_len(self.bytes);
            let _ = io::Seek::seek(&mut self.file, io::SeekFrom::Start(self.bytes));
            return Err(write_error(&self.path, cause));
        }
        self.bytes += text.len() as u64;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::live::name_of;
    use crate::capture::pairing::WhyUnmatched;
    use crate::capture::{Dataset, Side, Skew};
    use crate::simulation::small_rig;

    fn pair(sequence: u64) -> StereoPair {
        let image = GrayImage::filled(320, 240, sequence as u8);
        StereoPair {
            sequence,
            timestamp_ns: 1_700_000_000_000_000_000 + sequence as i64 * 50_000_000,
            skew: Skew::default(),
            left: image.clone(),
            right: image,
        }
    }

    fn entry(side: Side, fate: Fate) -> Entry {
        Entry {
            side,
            number: Some(7),
            stamp_ns: Some(-5),
            host_ns: None,
            arrived_ns: Some(3),
            fate,
        }
    }

    #[test]
    fn a_recording_can_be_read_at_any_moment() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("new/recording");
        let mut recorder = Recorder::create(&path, &small_rig()).expect("made");
        for n in 0..5 {
            // Pairs that were dropped before they came here leave no hole.
            recorder.add(&pair(3 * n)).expect("written");
            let dataset = Dataset::open(&path, None).expect("a recording");
            assert_eq!(dataset.pairs.len() as u64, n + 1);
            assert!(!dataset.nominal_times);
            let last = dataset.pairs.last().expect("there");
            assert_eq!(last.timestamp_ns, pair(3 * n).timestamp_ns);
        }
        assert!(matches!(
            Recorder::create(&path, &small_rig()),
            Err(RecordError::NotEmpty(_))
        ));
    }

    #[test]
    fn a_pair_that_cannot_be_written_leaves_nothing_behind() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("recording");
        let mut recorder = Recorder::create(&path, &small_rig()).expect("made");
        recorder.add(&pair(0)).expect("written");
        // The right image's place is taken by a folder, the left one's is not.
        std::fs::create_dir(path.join("right/000001.png")).expect("made");
        let why = recorder.add(&pair(1)).expect_err("cannot be written");
        assert!(
            why.to_string()
                .contains("right/000001.png: cannot be written"),
            "{why}"
        );
        std::fs::remove_dir(path.join("right/000001.png")).expect("removed");
        assert!(!path.join("left/000001.png").exists());
        let dataset = Dataset::open(&path, None).expect("a recording");
        assert_eq!(dataset.pairs.len(), 1);
        recorder.add(&pair(2)).expect("written");
        let written = Dataset::open(&path, None).expect("a recording").pairs;
        assert_eq!(written[1].timestamp_ns, pair(2).timestamp_ns);
        recorder
            .note(&[
                entry(Side::Left, Fate::Paired(0)),
                entry(Side::Right, Fate::Paired(1)),
                entry(Side::Left, Fate::Paired(2)),
                entry(Side::Left, Fate::Paired(9)),
                entry(Side::Right, Fate::Unmatched(WhyUnmatched::OtherSilent)),
            ])
            .expect("written");
        let frames = std::fs::read_to_string(path.join("frames.csv")).expect("there");
        let lines: Vec<&str> = frames.lines().skip(1).collect();
        assert_eq!(name_of(Side::Left), "left");
        assert_eq!(
            lines,
            [
                "left,7,-5,,written,0,3",
                "right,7,-5,,not_written,failed,3",
                "left,7,-5,,written,1,3",
                "left,7,-5,,not_written,dropped,3",
                "right,7,-5,,unmatched,other_silent,3"
            ]
        );
    }
}
