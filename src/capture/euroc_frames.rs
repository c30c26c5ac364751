//! The stamped images of two EuRoC cameras in; pairs by stamp out.

use super::MAX_STAMP_NS;
use super::dataset::{DatasetError, ImageFiles, PairFiles};
use super::own::images_in;
use super::text;
use std::path::{Component, Path, PathBuf};

/// The stamped images of one camera, stamps strictly rising.
pub(super) struct Frames(Vec<(i64, PathBuf)>);

impl Frames {
    /// Reads `data.csv` beside the images, or takes their names where there is none.
    pub(super) fn read(camera: &Path) -> Result<Self, DatasetError> {
        let (data, csv) = (camera.join("data"), camera.join("data.csv"));
        if !data.is_dir() {
            return Err(DatasetError::file(&data, "the folder of images is missing"));
        }
        if csv.try_exists().unwrap_or(true) {
            Self::from_csv(&csv, &data)
        } else {
            Self::from_names(&data)
        }
    }

    /// Lines of `stamp in ns,file name`.
    fn from_csv(csv: &Path, data: &Path) -> Result<Self, DatasetError> {
        let text = text::read(csv)?;
        let mut frames: Vec<(i64, PathBuf)> = Vec::new();
        for (line, row) in text::lines(&text) {
            let wrong = |cause: String| DatasetError::line(csv, line, cause);
            let (stamp, name) = row.split_once(',').ok_or_else(|| {
                wrong("a stamp in ns, a comma and a file name were expected".to_owned())
            })?;
            let stamp_ns = stamp_ns(stamp.trim()).ok_or_else(|| {
                let shown = text::shown(stamp);
                wrong(format!(
                    "a stamp in ns was expected, but it reads \"{shown}\""
                ))
            })?;
            let name = name.split(',').next().unwrap_or_default().trim();
            if !is_plain_name(name) {
                let shown = text::shown(name);
                return Err(wrong(format!(
                    "the name of a file in data/ was expected, but it reads \"{shown}\""
                )));
            }
            if frames.last().is_some_and(|&(last, _)| stamp_ns <= last) {
                return Err(wrong(format!(
                    "the stamp {stamp_ns} does not lie after the one before"
                )));
            }
            frames.push((stamp_ns, data.join(name)));
        }
        if frames.is_empty() {
            return Err(DatasetError::file(csv, "lists no image"));
        }
        Ok(Self(frames))
    }

    /// Without a list the file names are the stamps.
    fn from_names(data: &Path) -> Result<Self, DatasetError> {
        let mut frames = Vec::new();
        for file in images_in(data)?.into_values() {
            let stamp = file.file_stem().and_then(|stem| stamp_ns(stem.to_str()?));
            let stamp = stamp.ok_or_else(|| {
                DatasetError::file(&file, "without data.csv the name must be the stamp in ns")
            })?;
            frames.push((stamp, file));
        }
        frames.sort();
        if frames.is_empty() {
            return Err(DatasetError::file(
                data,
                "holds no PNG, JPEG, PGM or PPM image",
            ));
        }
        match frames.windows(2).find(|two| two[0].0 == two[1].0) {
            Some(two) => Err(DatasetError::file(
                &two[1].1,
                format!("has the same stamp as {}", two[0].1.display()),
            )),
            None => Ok(Self(frames)),
        }
    }
}

fn stamp_ns(word: &str) -> Option<i64> {
    let is_in_range = |ns: &i64| ns.unsigned_abs() < MAX_STAMP_NS.unsigned_abs();
    word.parse().ok().filter(is_in_range)
}

/// One name that stays in its folder: no separator, no `..`, no root.
fn is_plain_name(name: &str) -> bool {
    let mut parts = Path::new(name).components();
    let single = matches!(
        (parts.next(), parts.next()),
        (Some(Component::Normal(_)), None)
    );
    single && !name.contains(['/', '\\']) && text::is_one_line(name)
}

/// Pairs the images whose stamps are nearest to each other, both ways, within the tolerance.
pub(super) fn paired_by_stamp(left: &Frames, right: &Frames, tolerance_ns: i64) -> Vec<PairFiles> {
    let apart_ns = |l: usize, r: usize| match (left.0.get(l), right.0.get(r)) {
        (Some((left_ns, _)), Some((right_ns, _))) => (left_ns - right_ns).abs(),
        _ => i64::MAX,
    };
    let stamp_ns = |frames: &Frames, at: usize| frames.0.get(at).map_or(i64::MAX, |frame| frame.0);
    let (mut l, mut r) = (0, 0);
    let mut pairs = Vec::with_capacity(left.0.len());
    while l < left.0.len() || r < right.0.len() {
        let apart = apart_ns(l, r);
        if apart <= tolerance_ns && apart <= apart_ns(l + 1, r) && apart <= apart_ns(l, r + 1) {
            pairs.push(both(&left.0[l], &right.0[r]));
            l += 1;
            r += 1;
        } else if stamp_ns(left, l) < stamp_ns(right, r) {
            pairs.push(alone(&left.0[l], "right", tolerance_ns));
            l += 1;
        } else {
            pairs.push(alone(&right.0[r], "left", tolerance_ns));
            r += 1;
        }
    }
    pairs
}

fn both(left: &(i64, PathBuf), right: &(i64, PathBuf)) -> PairFiles {
    PairFiles {
        timestamp_ns: left.0,
        images: ImageFiles::Both {
            left: left.1.clone(),
            right: right.1.clone(),
        },
    }
}

fn alone((timestamp_ns, file): &(i64, PathBuf), other: &str, tolerance_ns: i64) -> PairFiles {
    PairFiles {
        timestamp_ns: *timestamp_ns,
        images: ImageFiles::Unpaired {
            why: format!(
                "{}: has no {other} image within {} ms",
                file.display(),
                tolerance_ns as f64 * 1e-6
            ),
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::collections::BTreeSet;

    const TOLERANCE_NS: i64 = 5;

    fn frames(stamps: &BTreeSet<i64>) -> Frames {
        Frames(
            stamps
                .iter()
                .map(|&ns| (ns, ns.to_string().into()))
                .collect(),
        )
    }

    fn stamp(file: &Path) -> i64 {
        file.to_string_lossy().parse().expect("named by its stamp")
    }

    proptest! {
        #[test]
        fn every_image_is_used_once_and_with_the_nearest(
            left in prop::collection::btree_set(0..200_i64, 0..30),
            right in prop::collection::btree_set(0..200_i64, 0..30),
        ) {
            let pairs = paired_by_stamp(&frames(&left), &frames(&right), TOLERANCE_NS);
            prop_assert!(pairs.windows(2).all(|p| p[0].timestamp_ns < p[1].timestamp_ns));
            let mut images = 0;
            for pair in &pairs {
                let ImageFiles::Both { left: l, right: r } = &pair.images else {
                    images += 1;
                    continue;
                };
                images += 2;
                let (l, r) = (stamp(l), stamp(r));
                let apart = (l - r).abs();
                prop_assert!(apart <= TOLERANCE_NS);
                // One that comes later would fit no better.
                prop_assert!(left.range(l + 1..).all(|other| (other - r).abs() >= apart));
                prop_assert!(right.range(r + 1..).all(|other| (other - l).abs() >= apart));
            }
            prop_assert_eq!(images, left.len() + right.len());
        }

        #[test]
        fn synchronous_cameras_lose_only_what_was_dropped(
            left in prop::collection::btree_set(0..100_i64, 1..60),
            right in prop::collection::btree_set(0..100_i64, 1..60),
            lag_ns in -TOLERANCE_NS..=TOLERANCE_NS,
        ) {
            let spread = |set: &BTreeSet<i64>, lag| set.iter().map(|n| n * 1000 + lag).collect();
            let pairs = paired_by_stamp(
                &frames(&spread(&left, 0)),
                &frames(&spread(&right, lag_ns)),
                TOLERANCE_NS,
            );
            let both = |pair: &&PairFiles| matches!(pair.images, ImageFiles::Both { .. });
            prop_assert_eq!(pairs.iter().filter(both).count(), left.intersection(&right).count());
            prop_assert_eq!(pairs.len(), left.union(&right).count());
        }
    }

    #[test]
    fn names_that_leave_the_folder_are_no_names() {
        for name in [
            "", ".", "..", "/x.png", "../x.png", "a/x.png", "a\\x.png", "x.png/",
        ] {
            assert!(!is_plain_name(name), "{name}");
        }
        assert!(is_plain_name("1403715273262142976.png"));
    }
}
