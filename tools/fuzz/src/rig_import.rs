//! Calibrations of other tools.

use super::folder::{Folder, split};
use super::sentence;
use visod::calibration::formats::{FORMATS, Hints, export, import};
use visod::geometry::check_rig;

/// The first byte says which format is claimed, if any; then come one or two files, each after a line `===`.
pub fn run(data: &[u8]) {
    let Some((&first, rest)) = data.split_first() else {
        return;
    };
    // Letters, so that inputs can be read: `a` leaves the format to be found out.
    let format = FORMATS.get(usize::from(first.wrapping_sub(b'b')));
    let folder = Folder::new();
    let ending = match first {
        b'b' => "toml",
        b'h' => "m",
        _ => "yaml",
    };
    let files: Vec<_> = split(rest, b"===\n")
        .take(3)
        .enumerate()
        .map(|(n, content)| folder.put(&format!("{n}.{ending}"), content))
        .collect();
    let hints = Hints {
        format: format.copied(),
        size_px: Some((640, 480)),
        unit_m: None,
    };
    match import(&files, &hints) {
        Ok(rig) => {
            let _ = check_rig(&rig);
            for format in FORMATS {
                if let Err(why) = export(&rig, format) {
                    sentence::check(&why);
                }
            }
        }
        Err(why) => sentence::check(&why),
    }
}
