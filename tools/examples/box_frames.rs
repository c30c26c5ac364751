//! What `tools/robot-in-a-box` does with images: `raw` turns a recording into the bytes that a V4L2 device
//! is fed with, `same` says whether every image of a recording is one of those.

use std::collections::HashSet;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use visod::capture::{Dataset, PairEvent, PairSource, ReadAhead, StereoPair};

fn pairs(path: &Path) -> Result<Vec<StereoPair>, String> {
    let dataset = Dataset::open(path, None).map_err(|e| e.to_string())?;
    let mut source = ReadAhead::start(&dataset).map_err(|e| e.to_string())?;
    let mut pairs = Vec::new();
    while let Some(event) = source.next_event() {
        match event {
            PairEvent::Pair(pair) => pairs.push(pair),
            PairEvent::Unusable(unusable) => return Err(unusable.why),
        }
    }
    Ok(pairs)
}

/// Writes the first pair as `left.0.raw` and `right.0.raw`, a byte a pixel.
fn raw(recording: &Path, out: &Path) -> Result<(), String> {
    for (n, pair) in pairs(recording)?.iter().take(1).enumerate() {
        for (side, image) in [("left", &pair.left), ("right", &pair.right)] {
            let file = out.join(format!("{side}.{n}.raw"));
            std::fs::write(&file, image.pixels())
                .map_err(|e| format!("{}: {e}", file.display()))?;
        }
    }
    Ok(())
}

/// Counts images that are byte for byte one of those in `folder`, side by side.
fn same(recording: &Path, folder: &Path) -> Result<(), String> {
    let fed = |side: &str| -> Result<HashSet<Vec<u8>>, String> {
        let entries = std::fs::read_dir(folder).map_err(|e| e.to_string())?;
        let files = entries.flatten().map(|entry| entry.path());
        let of_side = |path: &PathBuf| {
            let name = path.file_name().and_then(|name| name.to_str());
            name.is_some_and(|name| name.starts_with(side) && name.ends_with(".raw"))
        };
        let bytes = files.filter(of_side).map(std::fs::read);
        bytes.collect::<Result<_, _>>().map_err(|e| e.to_string())
    };
    let (left, right) = (fed("left")?, fed("right")?);
    let recorded = pairs(recording)?;
    let count =
        |is_same: &dyn Fn(&StereoPair) -> bool| recorded.iter().filter(|p| is_same(p)).count();
    let same_left = count(&|pair| left.contains(pair.left.pixels()));
    let same_right = count(&|pair| right.contains(pair.right.pixels()));
    let all = recorded.len();
    println!(
        "{same_left} of {all} left and {same_right} of {all} right images are bit-equal to what was fed"
    );
    if all > 0 && (same_left, same_right) == (all, all) {
        Ok(())
    } else {
        Err("images differ".to_owned())
    }
}

fn main() -> ExitCode {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let done = match args.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        ["raw", recording, out] => raw(Path::new(recording), Path::new(out)),
        ["same", recording, folder] => same(Path::new(recording), Path::new(folder)),
        _ => Err("usage: box-frames raw RECORDING OUT | same RECORDING FOLDER".to_owned()),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => {
            eprintln!("box-frames: {e}");
            ExitCode::FAILURE
        }
    }
}
