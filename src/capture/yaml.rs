//! YAML texts in, as other tools write calibrations; a tree that knows its lines out.
//!
//! OpenCV's dialect is read as well: its first line, `%YAML:1.0`, is no directive that YAML knows,
//! and its tags (`!!opencv-matrix`) are passed over.

use super::dataset::DatasetError;
use super::text;
use saphyr_parser::{Event, Parser};
use std::path::{Path, PathBuf};

/// Deepest nesting that a calibration may have.
const MAX_DEPTH: usize = 32;
/// Most keys of one map; those of calibrations have a dozen.
const MAX_KEYS: usize = 1000;

/// A value and the line it starts on, counted from 1.
#[derive(Debug)]
pub(crate) struct Node {
    pub(crate) line: usize,
    pub(crate) value: Value,
}

/// What a node holds.
#[derive(Debug)]
pub(crate) enum Value {
    Scalar(String),
    List(Vec<Node>),
    Map(Vec<(String, Node)>),
}

/// A file whose values are asked for by key.
#[derive(Debug)]
pub(crate) struct YamlFile {
    file: PathBuf,
    root: Node,
}

impl YamlFile {
    pub(crate) fn read(file: &Path) -> Result<Self, DatasetError> {
        Self::parse(file, &text::read_calibration(file)?)
    }

    fn parse(file: &Path, yaml: &str) -> Result<Self, DatasetError> {
        // The directive becomes a comment, so that lines keep their numbers.
        let yaml = yaml.strip_prefix('\u{FEFF}').unwrap_or(yaml);
        let yaml = match yaml.strip_prefix("%YAML:") {
            Some(rest) => format!("#{rest}"),
            None => yaml.to_owned(),
        };
        let wrong = |line, cause: &str| DatasetError::line(file, line, cause);
        let mut builder = Builder::default();
        for event in Parser::new_from_str(&yaml) {
            let (event, span) = event
                .map_err(|e| wrong(e.marker().line(), &format!("is not YAML: {}", e.info())))?;
            let line = span.start.line();
            builder
                .take(event, line)
                .map_err(|cause| wrong(line, cause))?;
            if builder.root.is_some() {
                break;
            }
        }
        let root = builder
            .root
            .ok_or_else(|| DatasetError::file(file, "holds no values"))?;
        Ok(Self {
            file: file.to_owned(),
            root,
        })
    }

    /// The value of a key of the outermost map, if it is there.
    pub(crate) fn get(&self, key: &str) -> Option<&Node> {
        self.root.get(key)
    }

    /// The value of a key of the outermost map.
    pub(crate) fn need(&self, key: &str) -> Result<&Node, DatasetError> {
        self.get(key).ok_or_else(|| DatasetError {
            key: Some(key.to_owned()),
            ..DatasetError::file(&self.file, "the key is missing")
        })
    }

    /// The error that the value of `key` at `node` is wrong.
    pub(crate) fn wrong(&self, node: &Node, key: &str, cause: impl Into<String>) -> DatasetError {
        DatasetError::key(&self.file, node.line, key, cause)
    }

    /// The text of `key`.
    pub(crate) fn word(&self, key: &str) -> Result<&str, DatasetError> {
        let node = self.need(key)?;
        match &node.value {
            Value::Scalar(word) => Ok(word),
            _ => Err(self.wrong(node, key, "a single word was expected")),
        }
    }

    /// The finite numbers in `node`, which is a list, possibly of lists.
    pub(crate) fn numbers(&self, node: &Node, key: &str) -> Result<Vec<f64>, DatasetError> {
        let Value::List(items) = &node.value else {
            return Err(self.wrong(node, key, "a list of numbers was expected"));
        };
        let mut numbers = Vec::new();
        for item in items {
            match &item.value {
                Value::List(_) => numbers.extend(self.numbers(item, key)?),
                Value::Scalar(word) => numbers.push(finite(word).ok_or_else(|| {
                    let shown = text::shown(word);
                    self.wrong(
                        item,
                        key,
                        format!("a finite number was expected, but it reads \"{shown}\""),
                    )
                })?),
                Value::Map(_) => return Err(self.wrong(item, key, "a number was expected")),
            }
        }
        Ok(numbers)
    }
}

fn finite(word: &str) -> Option<f64> {
    word.parse().ok().filter(|value: &f64| value.is_finite())
}

impl Node {
    /// The value of a key, if this is a map that has it.
    pub(crate) fn get(&self, key: &str) -> Option<&Self> {
        match &self.value {
            Value::Map(entries) => entries.iter().find(|(k, _)| k == key).map(|(_, v)| v),
            _ => None,
        }
    }
}

/// Builds the tree from the parser's events, without recursion.
#[derive(Default)]
struct Builder {
    /// Open lists and maps, outermost first, each map with the key that waits for its value.
    open: Vec<(Node, Option<String>)>,
    root: Option<Node>,
}

impl Builder {
    fn take(&mut self, event: Event<'_>, line: usize) -> Result<(), &'static str> {
        match event {
            Event::Scalar(word, ..) => self.close(Node {
                line,
                value: Value::Scalar(word.into_owned()),
            }),
            Event::SequenceStart(..) => self.open(line, Value::List(Vec::new())),
            Event::MappingStart(..) => self.open(line, Value::Map(Vec::new())),
            Event::SequenceEnd | Event::MappingEnd => match self.open.pop() {
                Some((node, _)) => self.close(node),
                None => Err("is not YAML: an end without a start"),
            },
            Event::Alias(_) => Err("aliases are not read in a calibration"),
            _ => Ok(()),
        }
    }

    fn open(&mut self, line: usize, value: Value) -> Result<(), &'static str> {
        if self.open.len() >= MAX_DEPTH {
            return Err("is nested too deeply");
        }
        self.open.push((Node { line, value }, None));
        Ok(())
    }

    /// A node is complete: it goes where it belongs.
    fn close(&mut self, node: Node) -> Result<(), &'static str> {
        let Some((parent, waiting)) = self.open.last_mut() else {
            self.root = Some(node);
            return Ok(());
        };
        match (&mut parent.value, waiting.take()) {
            (Value::List(items), _) => items.push(node),
            (Value::Map(entries), Some(key)) => {
                if entries.iter().any(|(k, _)| *k == key) {
                    return Err("a key stands twice");
                }
                if entries.len() >= MAX_KEYS {
                    return Err("has too many keys");
                }
                entries.push((key, node));
            }
            (Value::Map(_), None) => match node.value {
                Value::Scalar(key) => *waiting = Some(key),
                _ => return Err("a key must be a word"),
            },
            (Value::Scalar(_), _) => return Err("is not YAML: a value within a word"),
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(yaml: &str) -> Result<YamlFile, String> {
        YamlFile::parse(Path::new("sensor.yaml"), yaml).map_err(|e| e.to_string())
    }

    #[test]
    fn opencvs_dialect_is_read() {
        let file = parse(
            "%YAML:1.0\n---\nT: !!opencv-matrix\n  rows: 1\n  cols: 2\n  dt: d\n  data: [ 1., 2.5e-1 ]\n",
        )
        .expect("valid");
        let data = file.need("T").expect("there").get("data").expect("there");
        assert_eq!(data.line, 7);
        assert_eq!(file.numbers(data, "T").expect("numbers"), [1.0, 0.25]);
    }

    #[test]
    fn nested_lists_and_comments_are_read() {
        let file = parse("# a comment\nT_BS:\n- [1, 2]  # first row\n- [3, 4]\n").expect("valid");
        let node = file.need("T_BS").expect("there");
        assert_eq!(
            file.numbers(node, "T_BS").expect("numbers"),
            [1.0, 2.0, 3.0, 4.0]
        );
    }

    #[test]
    fn mistakes_are_named_with_their_line() {
        assert_eq!(
            parse("a: 1\nb: [1,\n nan]\n")
                .and_then(|f| f
                    .numbers(f.need("b").expect("there"), "b")
                    .map_err(|e| e.to_string()))
                .expect_err("not finite"),
            "sensor.yaml:3: b: a finite number was expected, but it reads \"nan\""
        );
        let broken = parse("a: 1\nb: [1, 2\nc: 3\n").expect_err("no closing bracket");
        assert!(broken.starts_with("sensor.yaml:"), "{broken}");
        assert!(broken.contains("is not YAML"), "{broken}");
        assert_eq!(
            parse("").expect_err("empty"),
            "sensor.yaml: holds no values"
        );
        assert_eq!(
            parse("a: 1\na: 2\n").expect_err("twice"),
            "sensor.yaml:2: a key stands twice"
        );
        let keys: String = (0..=MAX_KEYS).map(|i| format!("k{i}: 1\n")).collect();
        assert_eq!(
            parse(&keys).expect_err("many"),
            format!("sensor.yaml:{}: has too many keys", MAX_KEYS + 1)
        );
        let deep = parse(&"[".repeat(5000)).expect_err("deep");
        assert!(
            deep.contains("nested too deeply") || deep.contains("is not YAML"),
            "{deep}"
        );
    }
}
