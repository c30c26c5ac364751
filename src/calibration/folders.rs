//! Two folders, or a recording, in; pairs of image files out.

use crate::text_file;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// The images of one instant.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ImagePair {
    /// What the pair is called: the left image's file name.
    pub name: String,
    /// Left, right.
    pub files: [PathBuf; 2],
}

/// Endings of files that are images.
const ENDINGS: [&str; 6] = ["png", "jpg", "jpeg", "pgm", "ppm", "pnm"];

/// Where recordings keep their left and right images.
const LAYOUTS: [[&str; 2]; 3] = [
    ["left", "right"],
    ["mav0/cam0/data", "mav0/cam1/data"],
    ["image_0", "image_1"],
];

/// Pairs the images of two folders: by equal names, or, where no name is in both, in their order. Images without
/// a partner come along.
///
/// # Errors
/// One sentence: a folder cannot be read, has no images, or the images cannot be told to belong together.
pub fn pairs(left: &Path, right: &Path) -> Result<(Vec<ImagePair>, Vec<PathBuf>), String> {
    let lists = [images(left)?, images(right)?];
    let mut common: BTreeMap<&str, [Option<&PathBuf>; 2]> = BTreeMap::new();
    for (side, list) in lists.iter().enumerate() {
        for (name, file) in list {
            common.entry(name).or_default()[side] = Some(file);
        }
    }
    let mut pairs = Vec::new();
    let mut alone = Vec::new();
    for (name, files) in &common {
        match files {
            [Some(left), Some(right)] => pairs.push(ImagePair {
                name: (*name).to_owned(),
                files: [(*left).clone(), (*right).clone()],
            }),
            [file, other] => alone.extend(file.iter().chain(other).map(|file| (*file).clone())),
        }
    }
    if !pairs.is_empty() {
        return Ok((pairs, alone));
    }
    if lists[0].len() != lists[1].len() {
        return Err(format!(
            "{} and {}: no image has the same name in both, and they hold {} and {} images: which belong together?",
            left.display(),
            right.display(),
            lists[0].len(),
            lists[1].len()
        ));
    }
    let in_order = lists[0]
        .iter()
        .zip(&lists[1])
        .map(|((name, left), (_, right))| ImagePair {
            name: name.clone(),
            files: [left.clone(), right.clone()],
        });
    Ok((in_order.collect(), Vec::new()))
}

/// The folders of a recording's left and right images.
///
/// # Errors
/// One sentence: the folder has none of the layouts that are known.
pub fn of_recording(folder: &Path) -> Result<[PathBuf; 2], String> {
    let known = LAYOUTS.map(|names| names.map(|name| folder.join(name)));
    let found = known
        .into_iter()
        .find(|folders| folders.iter().all(|f| f.is_dir()));
    found.ok_or_else(|| {
        format!(
            "{}: holds neither left/ and right/, nor mav0/cam0 and cam1, nor image_0/ and image_1/",
            folder.display()
        )
    })
}

fn images(folder: &Path) -> Result<Vec<(String, PathBuf)>, String> {
    let fail =
        |cause: &dyn std::fmt::Display| format!("{}: cannot be read: {cause}", folder.display());
    let mut images = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(|e| fail(&e))? {
        let file = entry.map_err(|e| fail(&e))?.path();
        let ending = file
            .extension()
            .and_then(|e| e.to_str())
            .unwrap_or_default()
            .to_lowercase();
        let Some(name) = file.file_name().and_then(|n| n.to_str()) else {
            continue;
        };
        if ENDINGS.contains(&ending.as_str()) && !name.starts_with('.') {
            if let Some(why) = text_file::doubt_of_image_name(name) {
                return Err(format!("{}: {why}", folder.display()));
            }
            images.push((name.to_owned(), file.clone()));
        }
    }
    if images.is_empty() {
        return Err(format!(
            "{}: holds no images ({})",
            folder.display(),
            ENDINGS.join(", ")
        ));
    }
    images.sort();
    Ok(images)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn folder_with(parent: &Path, name: &str, files: &[&str]) -> PathBuf {
        let folder = parent.join(name);
        std::fs::create_dir_all(&folder).unwrap();
        for file in files {
            std::fs::write(folder.join(file), "").unwrap();
        }
        folder
    }

    #[test]
    fn images_are_paired_by_name_or_else_by_order() {
        let parent = tempfile::tempdir().unwrap();
        let left = folder_with(
            parent.path(),
            "left",
            &["2.png", "1.png", "3.png", "notes.txt"],
        );
        let right = folder_with(parent.path(), "right", &["1.png", "2.png"]);
        let (found, alone) = pairs(&left, &right).unwrap();
        let names: Vec<_> = found.iter().map(|p| p.name.as_str()).collect();
        assert_eq!(names, ["1.png", "2.png"]);
        assert_eq!(alone, [left.join("3.png")]);
        let right = folder_with(parent.path(), "other", &["r1.png", "r2.png", "r3.png"]);
        let (found, alone) = pairs(&left, &right).unwrap();
        assert_eq!((found.len(), alone.len()), (3, 0));
        assert_eq!(found[2].files[1], right.join("r3.png"));
        let few = folder_with(parent.path(), "few", &["r1.png"]);
        assert!(
            pairs(&left, &few)
                .unwrap_err()
                .contains("which belong together?")
        );
        assert!(
            pairs(&left, &folder_with(parent.path(), "none", &[]))
                .unwrap_err()
                .contains("holds no images")
        );
        assert_eq!(of_recording(parent.path()).unwrap()[0], left);
        assert!(of_recording(&left).is_err());
    }
}
