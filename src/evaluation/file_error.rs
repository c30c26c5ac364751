//! What is wrong with a file that was to be evaluated, and where.

use std::path::{Path, PathBuf};

/// What is wrong with a file, and where.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FileError {
    /// The file as it was named.
    pub file: PathBuf,
    /// The line, counted from 1, where there is one.
    pub line: Option<usize>,
    /// The cause.
    pub cause: String,
}

impl FileError {
    pub(super) fn new(file: &Path, line: Option<usize>, cause: impl Into<String>) -> Self {
        Self {
            file: file.to_owned(),
            line,
            cause: cause.into(),
        }
    }
}

impl std::fmt::Display for FileError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}", self.file.display())?;
        if let Some(line) = self.line {
            write!(f, ":{line}")?;
        }
        write!(f, ": {}", self.cause)
    }
}

impl std::error::Error for FileError {}

/// Reads a whole text file.
pub(super) fn read_text(path: &Path) -> Result<String, FileError> {
    let bytes = std::fs::read(path)
        .map_err(|e| FileError::new(path, None, format!("cannot be read: {e}")))?;
    String::from_utf8(bytes).map_err(|e| {
        let before = &e.as_bytes()[..e.utf8_error().valid_up_to()];
        let line = before.iter().filter(|&&b| b == b'\n').count() + 1;
        FileError::new(path, Some(line), "is not text in UTF-8")
    })
}
