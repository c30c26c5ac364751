//! What is wrong with a file that was to be evaluated, and where.

use crate::text_file;
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

/// Longest file that is evaluated, bytes: two hours of rows at a hundred a second.
const MAX_BYTES: u64 = 1 << 30;

/// Reads a whole text file.
pub(super) fn read_text(path: &Path) -> Result<String, FileError> {
    text_file::read(path, MAX_BYTES).map_err(|fault| FileError::new(path, fault.line, fault.cause))
}
