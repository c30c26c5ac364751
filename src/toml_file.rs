//! TOML files whose mistakes are reported with file, line and key.

use crate::text_file::{self, one_line};
use serde::de::DeserializeOwned;
use std::ops::Range;
use std::path::Path;

/// Longest TOML file that is read, bytes; a rig or configuration has a few thousand.
pub(crate) const MAX_BYTES: u64 = 1 << 20;

/// Longest part of a message that the file itself may make up, characters.
const MAX_MESSAGE: usize = 500;

/// What is wrong with a TOML file, and where.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TomlError {
    /// The file as it was named.
    pub file: String,
    /// The line, counted from 1, where there is one.
    pub line: Option<usize>,
    /// The key, tables first, where there is one.
    pub key: Option<String>,
    /// The cause.
    pub cause: String,
}

impl std::fmt::Display for TomlError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}", self.file)?;
        if let Some(line) = self.line {
            write!(f, ":{line}")?;
        }
        if let Some(key) = &self.key {
            write!(f, ": {key}")?;
        }
        write!(f, ": {}", self.cause)
    }
}

impl std::error::Error for TomlError {}

/// A TOML text that stays at hand, so that values found wrong later can be traced to their line.
pub(crate) struct TomlText {
    file: String,
    text: String,
}

impl TomlText {
    /// Reads a file.
    pub(crate) fn read(path: &Path) -> Result<Self, TomlError> {
        let file = path.display().to_string();
        match text_file::read(path, MAX_BYTES) {
            Ok(text) => Ok(Self { file, text }),
            Err(fault) => Err(TomlError {
                file,
                line: fault.line,
                key: None,
                cause: fault.cause,
            }),
        }
    }

    /// Takes a text that came from elsewhere, under a name for messages.
    pub(crate) fn new(file: &str, text: &str) -> Self {
        Self {
            file: file.to_owned(),
            text: text.to_owned(),
        }
    }

    /// Parses the text; unknown keys are the business of `T`'s own attributes.
    pub(crate) fn parse<T: DeserializeOwned>(&self) -> Result<T, TomlError> {
        toml::from_str(&self.text).map_err(|e| TomlError {
            file: self.file.clone(),
            line: e.span().map(|span| self.line_at(&span)),
            key: e
                .span()
                .and_then(|span| self.key_at(&span))
                .map(|key| one_line(&key, MAX_MESSAGE)),
            cause: one_line(&e.message().replace('\n', " "), MAX_MESSAGE),
        })
    }

    /// The error that the value of `key` (dotted) is wrong.
    pub(crate) fn wrong(&self, key: &str, cause: impl Into<String>) -> TomlError {
        TomlError {
            file: self.file.clone(),
            line: self.span_of(key).map(|span| self.line_at(&span)),
            key: Some(key.to_owned()),
            cause: cause.into(),
        }
    }

    fn line_at(&self, span: &Range<usize>) -> usize {
        1 + self.text.as_bytes()[..span.start.min(self.text.len())]
            .iter()
            .filter(|&&b| b == b'\n')
            .count()
    }

    /// The span of a dotted key, or of the nearest table above it that is there.
    fn span_of(&self, key: &str) -> Option<Range<usize>> {
        let root = toml::de::DeTable::parse(&self.text).ok()?;
        let mut table = root.get_ref();
        let mut span = None;
        for part in key.split('.') {
            let Some((name, value)) = table.iter().find(|(name, _)| name.get_ref() == part) else {
                break;
            };
            span = Some(name.span());
            match value.get_ref() {
                toml::de::DeValue::Table(inner) => table = inner,
                _ => break,
            }
        }
        span
    }

    /// The dotted key whose value contains a span.
    fn key_at(&self, span: &Range<usize>) -> Option<String> {
        let root = toml::de::DeTable::parse(&self.text).ok()?;
        let mut table = root.get_ref();
        let mut key = Vec::new();
        'descend: loop {
            for (name, value) in table {
                let inside = |outer: &Range<usize>| {
                    outer.start <= span.start && span.end <= outer.end.max(outer.start + 1)
                };
                if let toml::de::DeValue::Table(inner) = value.get_ref() {
                    let reaches = inner
                        .iter()
                        .any(|(n, v)| inside(&n.span()) || inside(&v.span()));
                    if reaches || inside(&value.span()) {
                        key.push(name.get_ref().to_string());
                        table = inner;
                        continue 'descend;
                    }
                } else if inside(&name.span()) || inside(&value.span()) {
                    key.push(name.get_ref().to_string());
                    break 'descend;
                }
            }
            break;
        }
        (!key.is_empty()).then(|| key.join("."))
    }
}
