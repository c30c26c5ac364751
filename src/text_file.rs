//! A text file in, no longer than its kind may be; what is wrong with it out.

use std::fs::File;
use std::io::Read;
use std::path::Path;

/// Why a file is no text.
#[derive(Debug)]
pub(crate) struct TextFault {
    /// The line, counted from 1, where there is one.
    pub(crate) line: Option<usize>,
    /// What the system said, where it was the system.
    pub(crate) kind: Option<std::io::ErrorKind>,
    /// The cause.
    pub(crate) cause: String,
}

impl std::fmt::Display for TextFault {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        if let Some(line) = self.line {
            write!(f, "{line}: ")?;
        }
        f.write_str(&self.cause)
    }
}

/// Reads a file of at most `most_bytes`. What is no regular file, a pipe for example, is read to its end too,
/// and one that has none is given up at the limit.
pub(crate) fn read(file: &Path, most_bytes: u64) -> Result<String, TextFault> {
    let unreadable = |e: std::io::Error| TextFault {
        line: None,
        kind: Some(e.kind()),
        cause: format!("cannot be read: {e}"),
    };
    let mut bytes = Vec::new();
    let opened = File::open(file).map_err(unreadable)?;
    let length = opened.metadata().map_or(0, |meta| meta.len());
    if length <= most_bytes {
        // Room is made as bytes come, but for a file that says how many there are.
        bytes.reserve(usize::try_from(length).unwrap_or(0));
        opened
            .take(most_bytes + 1)
            .read_to_end(&mut bytes)
            .map_err(unreadable)?;
    }
    let length = length.max(bytes.len() as u64);
    if length > most_bytes {
        return Err(TextFault {
            line: None,
            kind: None,
            cause: format!("has {length} bytes, more than {most_bytes}"),
        });
    }
    String::from_utf8(bytes).map_err(|e| {
        let before = &e.as_bytes()[..e.utf8_error().valid_up_to()];
        TextFault {
            line: Some(1 + before.iter().filter(|b| **b == b'\n').count()),
            kind: None,
            cause: "is not UTF-8 text".to_owned(),
        }
    })
}

/// A word from a file as it may be shown in a message: short, on one line.
pub(crate) fn shown(word: &str) -> String {
    one_line(word, 40)
}

/// A text that comes from elsewhere as it may stand in a message: without what moves a terminal's cursor, and
/// not endless.
pub(crate) fn one_line(text: &str, longest: usize) -> String {
    let harmless = |c: char| if c.is_control() { '\u{FFFD}' } else { c };
    let mut line: String = text.chars().take(longest).map(harmless).collect();
    if text.chars().nth(longest).is_some() {
        line.push('…');
    }
    line
}

/// What is wrong with a folder that holds an image of this name; `None` where the name may stand in messages.
pub(crate) fn doubt_of_image_name(name: &str) -> Option<String> {
    (!is_one_line(name)).then(|| {
        let name = shown(name);
        format!("holds an image whose name has a control character: \"{name}\"")
    })
}

/// Whether a name may stand in a message as it is.
pub(crate) fn is_one_line(name: &str) -> bool {
    !name.contains(char::is_control)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_shown_of_a_file_stays_on_its_line() {
        assert_eq!(shown("a\x1B[2J\nb"), "a\u{FFFD}[2J\u{FFFD}b");
        assert_eq!(shown(&"x".repeat(41)), format!("{}…", "x".repeat(40)));
        assert_eq!(shown(&"ß".repeat(40)), "ß".repeat(40));
    }

    #[test]
    fn a_file_that_is_too_long_or_has_no_end_is_refused() {
        let folder = tempfile::tempdir().expect("a folder");
        let file = folder.path().join("text");
        std::fs::write(&file, "12345").expect("written");
        assert_eq!(read(&file, 5).expect("short enough"), "12345");
        let why = read(&file, 4).expect_err("too long");
        assert_eq!(why.to_string(), "has 5 bytes, more than 4");
        let endless = read(Path::new("/dev/zero"), 4096).expect_err("endless");
        assert_eq!(endless.to_string(), "has 4097 bytes, more than 4096");
        let folder = read(folder.path(), 4096).expect_err("no file");
        assert!(folder.to_string().starts_with("cannot be read"), "{folder}");
    }

    #[test]
    fn what_is_no_text_is_named_with_its_line() {
        let folder = tempfile::tempdir().expect("a folder");
        let file = folder.path().join("text");
        std::fs::write(&file, b"a\nb\xff\n").expect("written");
        let why = read(&file, 100).expect_err("no text");
        assert_eq!(why.to_string(), "2: is not UTF-8 text");
    }
}
