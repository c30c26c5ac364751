//! Small text files in; lines, numbers and stamps out, with file and line of what is wrong.

use super::MAX_STAMP_NS;
use super::dataset::DatasetError;
use crate::text_file;
pub(super) use crate::text_file::{doubt_of_image_name, is_one_line, shown};
use std::path::Path;

/// Longest text file that is read, bytes: stamps of millions of frames.
const MAX_BYTES: u64 = 256 << 20;

/// Longest calibration that is read, bytes; the usual ones have a few thousand.
const MAX_CALIBRATION_BYTES: u64 = 1 << 20;

/// Reads a list of stamps.
pub(super) fn read(file: &Path) -> Result<String, DatasetError> {
    read_at_most(file, MAX_BYTES)
}

/// Reads a calibration.
pub(crate) fn read_calibration(file: &Path) -> Result<String, DatasetError> {
    read_at_most(file, MAX_CALIBRATION_BYTES)
}

fn read_at_most(file: &Path, most_bytes: u64) -> Result<String, DatasetError> {
    // Nothing but a file stands in a recording; a pipe would be waited for.
    if std::fs::metadata(file).is_ok_and(|meta| !meta.is_file()) {
        return Err(DatasetError::file(file, "is not a file"));
    }
    text_file::read(file, most_bytes).map_err(|fault| DatasetError {
        line: fault.line,
        ..DatasetError::file(file, fault.cause)
    })
}

/// The lines that say something, with their numbers from 1: no blank ones, no `#` comments.
pub(super) fn lines(text: &str) -> impl Iterator<Item = (usize, &str)> {
    text.lines()
        .enumerate()
        .map(|(index, line)| (index + 1, line.trim()))
        .filter(|(_, line)| !line.is_empty() && !line.starts_with('#'))
}

/// The stamps of a recording.
pub(super) struct Times {
    /// When each pair was taken, ns, strictly rising.
    pub(super) ns: Vec<i64>,
    /// Whether all are written as visod's recorder writes them, to the nanosecond. Such a file may have been
    /// cut off together with its images.
    pub(super) is_recorders: bool,
}

/// The stamps of a file with one time in seconds a line.
///
/// A last line of the recorder's that breaks off says nothing: its pair was not whole.
pub(super) fn times(file: &Path) -> Result<Times, DatasetError> {
    let text = read(file)?;
    let whole = text.rfind('\n').map_or(0, |end| end + 1);
    let (before, last) = text.split_at(whole);
    let is_recorders = lines(before).all(|(_, word)| is_to_the_nanosecond(word));
    let breaks_off = is_recorders && !last.is_empty() && !is_to_the_nanosecond(last);
    let told = if breaks_off { before } else { &text };
    Ok(Times {
        ns: times_ns(file, told)?,
        is_recorders: is_recorders
            && (breaks_off || lines(last).all(|(_, w)| is_to_the_nanosecond(w))),
    })
}

/// Whether a time is written with nine digits behind the point.
fn is_to_the_nanosecond(word: &str) -> bool {
    let is_digits = |part: &str| part.bytes().all(|b| b.is_ascii_digit());
    word.split_once('.').is_some_and(|(whole, fraction)| {
        is_digits(whole.strip_prefix('-').unwrap_or(whole))
            && fraction.len() == 9
            && is_digits(fraction)
    })
}

fn times_ns(file: &Path, text: &str) -> Result<Vec<i64>, DatasetError> {
    let mut times: Vec<i64> = Vec::new();
    for (line, word) in lines(text) {
        let time = ns_from_seconds(word).ok_or_else(|| {
            DatasetError::line(
                file,
                line,
                format!(
                    "a time in seconds was expected, but it reads \"{}\"",
                    shown(word)
                ),
            )
        })?;
        if times.last().is_some_and(|&last| time <= last) {
            return Err(DatasetError::line(
                file,
                line,
                format!("the time {} does not lie after the one before", shown(word)),
            ));
        }
        times.push(time);
    }
    Ok(times)
}

/// Seconds as nanoseconds, to the last digit where they are written without an exponent.
pub(super) fn ns_from_seconds(word: &str) -> Option<i64> {
    let (sign, digits) = match word.strip_prefix('-') {
        Some(rest) => (-1, rest),
        None => (1, word.strip_prefix('+').unwrap_or(word)),
    };
    let (whole, fraction) = digits.split_once('.').unwrap_or((digits, ""));
    let plain = |part: &str| part.bytes().all(|b| b.is_ascii_digit());
    if plain(whole) && plain(fraction) && !whole.is_empty() {
        // Ten digits of the fraction: nine and the one that rounds.
        let mut tenths_of_ns = 0_i64;
        for place in 0..10 {
            let digit = fraction.as_bytes().get(place).map_or(0, |b| b - b'0');
            tenths_of_ns = tenths_of_ns * 10 + i64::from(digit);
        }
        let whole_ns = whole.parse::<i64>().ok()?.checked_mul(1_000_000_000)?;
        return whole_ns
            .checked_add((tenths_of_ns + 5) / 10)
            .filter(|ns| *ns < MAX_STAMP_NS)
            .map(|ns| sign * ns);
    }
    let ns = (word.parse::<f64>().ok()? * 1e9).round();
    (ns.abs() < MAX_STAMP_NS as f64).then_some(ns as i64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn plain_seconds_keep_every_nanosecond() {
        for (word, ns) in [
            ("1403715273.262142976", 1_403_715_273_262_142_976),
            ("0", 0),
            ("0.1", 100_000_000),
            ("-1.5", -1_500_000_000),
            ("2.0000000005", 2_000_000_001),
            ("1.036224e-01", 103_622_400),
            ("5.", 5_000_000_000),
            ("4611686018.427387903", MAX_STAMP_NS - 1),
        ] {
            assert_eq!(ns_from_seconds(word), Some(ns), "{word}");
        }
    }

    #[test]
    fn what_is_no_time_is_refused() {
        for word in [
            "",
            ".",
            "nan",
            "inf",
            "1e300",
            "12:30",
            "1 2",
            "99999999999999999999",
            "9300000000",
            "4611686018.427387904",
        ] {
            assert_eq!(ns_from_seconds(word), None, "{word}");
        }
    }
}
