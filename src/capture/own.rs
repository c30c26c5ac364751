//! visod's own layout, and what KITTI's shares with it: two folders of images with the same names.

use super::dataset::{DatasetError, ImageFiles, Layout, NOMINAL_PERIOD_NS, PairFiles, Parts};
use super::text;
use crate::geometry::{StereoRig, load_rig};
use std::collections::BTreeMap;
use std::ffi::{OsStr, OsString};
use std::path::{Path, PathBuf};

/// Endings of files that are taken for images, whatever their case.
const IMAGE_ENDINGS: [&str; 6] = ["png", "jpg", "jpeg", "pgm", "ppm", "pnm"];

pub(super) fn open(
    path: &Path,
    left: &Path,
    right: &Path,
    rig_override: Option<StereoRig>,
) -> Result<Parts, DatasetError> {
    let rig = match rig_override {
        Some(rig) => rig,
        None => load_rig(&path.join("rig.toml"))?,
    };
    let (pairs, nominal_times) = stamped_pairs(path, left, right)?;
    Ok(Parts {
        layout: Layout::Visod,
        rig,
        pairs,
        nominal_times,
        ground_truth: Some(path.join("poses.txt")).filter(|file| file.is_file()),
    })
}

/// The pairs of two image folders with the stamps of `times.txt`, or nominal ones (`true`).
pub(super) fn stamped_pairs(
    path: &Path,
    left: &Path,
    right: &Path,
) -> Result<(Vec<PairFiles>, bool), DatasetError> {
    let named = paired_by_stem(left, right)?;
    let times_file = path.join("times.txt");
    if !times_file.try_exists().unwrap_or(true) {
        let pairs = (0..).zip(named).map(|(index, (_, images))| PairFiles {
            timestamp_ns: index * NOMINAL_PERIOD_NS,
            images,
        });
        return Ok((pairs.collect(), true));
    }
    let text::Times {
        ns: times,
        is_recorders,
    } = text::times(&times_file)?;
    let named = if is_recorders {
        without_cut_pair(named, times.len())
    } else {
        named
    };
    if named.is_empty() {
        return Err(DatasetError::file(
            &times_file,
            "has no time yet: the recording was cut off within its first pair",
        ));
    }
    if times.len() == named.len() {
        let pairs = times
            .into_iter()
            .zip(named)
            .map(|(timestamp_ns, (_, images))| PairFiles {
                timestamp_ns,
                images,
            });
        return Ok((pairs.collect(), false));
    }
    numbered_pairs(&times, &named, left)
        .map(|pairs| (pairs, false))
        .ok_or_else(|| {
            DatasetError::file(
                &times_file,
                format!(
                    "has {} times, but there are {} image pairs in {} and {}",
                    times.len(),
                    named.len(),
                    left.display(),
                    right.display()
                ),
            )
        })
}

/// The recorder writes a pair's images first, numbered from 0, then its time: the one pair that has images
/// but no time was being written when the recording was cut off.
fn without_cut_pair(mut named: Vec<(Stem, ImageFiles)>, times: usize) -> Vec<(Stem, ImageFiles)> {
    let is_cut = |(stem, _): &mut (Stem, ImageFiles)| stem.number == Some(times as u64);
    named.pop_if(is_cut);
    named
}

/// Part of a recording whose `times.txt` is that of the whole: the image's number is its line.
///
/// A number within the part that neither folder has still counts as a pair, so that numbers and
/// ground truth do not slip against each other. `None` if the names do not fit the times.
fn numbered_pairs(
    times: &[i64],
    named: &[(Stem, ImageFiles)],
    left: &Path,
) -> Option<Vec<PairFiles>> {
    let mut by_number = BTreeMap::new();
    for (stem, images) in named {
        let number = usize::try_from(stem.number?).ok()?;
        if number >= times.len() || by_number.insert(number, images).is_some() {
            return None;
        }
    }
    let (&first, &last) = (by_number.keys().next()?, by_number.keys().next_back()?);
    let pairs = (first..=last).map(|number| PairFiles {
        timestamp_ns: times[number],
        images: match by_number.get(&number) {
            Some(&images) => images.clone(),
            None => ImageFiles::Unpaired {
                why: format!(
                    "{}: neither camera has an image number {number}",
                    left.display()
                ),
            },
        },
    });
    Some(pairs.collect())
}

/// A file's name without its ending; ordered by number where it is one, else by name.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Stem {
    number: Option<u64>,
    name: OsString,
}

impl Stem {
    fn of(file: &Path) -> Option<Self> {
        let name = file.file_stem()?.to_owned();
        let digits = |text: &&str| text.bytes().all(|b| b.is_ascii_digit());
        let number = name.to_str().filter(digits).and_then(|n| n.parse().ok());
        Some(Self { number, name })
    }
}

/// The images of one folder by the stems of their names.
pub(super) fn images_in(folder: &Path) -> Result<BTreeMap<Stem, PathBuf>, DatasetError> {
    let unreadable = |e: std::io::Error| DatasetError::file(folder, format!("cannot be read: {e}"));
    let mut images = BTreeMap::new();
    for entry in std::fs::read_dir(folder).map_err(unreadable)? {
        let file = entry.map_err(unreadable)?.path();
        let hidden = |name: &OsStr| name.as_encoded_bytes().starts_with(b".");
        if !has_image_ending(&file) || file.file_name().is_none_or(hidden) {
            continue;
        }
        let Some(stem) = Stem::of(&file) else {
            continue;
        };
        if let Some(why) = text::doubt_of_image_name(&stem.name.to_string_lossy()) {
            return Err(DatasetError::file(folder, why));
        }
        if let Some(other) = images.insert(stem, file.clone()) {
            let [first, second] = if other < file {
                [other, file]
            } else {
                [file, other]
            };
            return Err(DatasetError::file(
                &second,
                format!("has the same name as {}", first.display()),
            ));
        }
    }
    Ok(images)
}

fn has_image_ending(file: &Path) -> bool {
    file.extension()
        .and_then(OsStr::to_str)
        .is_some_and(|ending| IMAGE_ENDINGS.iter().any(|e| ending.eq_ignore_ascii_case(e)))
}

/// All stems of both folders in order, each with its two images or the one that is missing.
fn paired_by_stem(left: &Path, right: &Path) -> Result<Vec<(Stem, ImageFiles)>, DatasetError> {
    let mut lefts = images_in(left)?;
    let mut rights = images_in(right)?;
    for (folder, images) in [(left, &lefts), (right, &rights)] {
        if images.is_empty() {
            return Err(DatasetError::file(
                folder,
                "holds no PNG, JPEG, PGM or PPM image",
            ));
        }
    }
    if !lefts.keys().any(|stem| rights.contains_key(stem)) {
        return Err(DatasetError::file(
            right,
            format!("has no image of the same name as one in {}", left.display()),
        ));
    }
    let mut stems: Vec<Stem> = lefts.keys().chain(rights.keys()).cloned().collect();
    stems.sort();
    stems.dedup();
    let pairs = stems.into_iter().map(|stem| {
        let images = match (lefts.remove(&stem), rights.remove(&stem)) {
            (Some(left), Some(right)) => ImageFiles::Both { left, right },
            (Some(there), None) => missing(right, &stem, &there),
            (None, Some(there)) => missing(left, &stem, &there),
            (None, None) => missing(left, &stem, right),
        };
        (stem, images)
    });
    Ok(pairs.collect())
}

fn missing(folder: &Path, stem: &Stem, there: &Path) -> ImageFiles {
    let mut name = stem.name.clone();
    if let Some(ending) = there.extension() {
        name.push(".");
        name.push(ending);
    }
    ImageFiles::Unpaired {
        why: format!(
            "{}: is missing, while {} is there",
            folder.join(name).display(),
            there.display()
        ),
    }
}
