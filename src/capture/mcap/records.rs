//! An MCAP file in; its records out, front to back, one at a time.

use crate::text_file::one_line;
use mcap::records::{Record, op};
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
use std::fs::File;
use std::io::{Read, Seek};
use std::path::Path;

/// Longest record that is read, bytes: an image of the largest size, and what stands around it.
const MAX_RECORD_BYTES: u64 = 1 << 30;
/// Longest record that a file may hold that is short itself, bytes: chunks may be compressed.
const MAX_RECORD_OF_SHORT_FILE_BYTES: u64 = 64 << 20;
/// What is asked of the system at once, bytes, so that a length that is not true takes no memory.
const PIECE_BYTES: usize = 1 << 20;

/// Reads records.
pub(super) struct Records {
    file: File,
    reader: LinearReader,
}

impl Records {
    pub(super) fn open(path: &Path) -> Result<Self, String> {
        let unreadable = |e| format!("cannot be read: {e}");
        let mut file = File::open(path).map_err(unreadable)?;
        let mut magic = Vec::with_capacity(mcap::MAGIC.len());
        let beginning = file.by_ref().take(mcap::MAGIC.len() as u64);
        { beginning }.read_to_end(&mut magic).map_err(unreadable)?;
        if magic != mcap::MAGIC {
            return Err("is not a folder with a recording, and no MCAP file either".to_owned());
        }
        file.rewind().map_err(unreadable)?;
        let length = file.metadata().map_err(unreadable)?.len();
        let limit = length.clamp(MAX_RECORD_OF_SHORT_FILE_BYTES, MAX_RECORD_BYTES);
        let options = LinearReaderOptions::default()
            .with_validate_chunk_crcs(true)
            .with_record_length_limit(usize::try_from(limit).unwrap_or(usize::MAX));
        Ok(Self {
            file,
            reader: LinearReader::new_with_options(options),
        })
    }

    /// Hands the next record to `take`; `None` after the last.
    ///
    /// # Errors
    /// One sentence: the file ends early, or is damaged from here on.
    pub(super) fn next<T>(
        &mut self,
        take: impl FnOnce(Record<'_>) -> T,
    ) -> Result<Option<T>, String> {
        while let Some(event) = self.reader.next_event() {
            match event.map_err(|e| sentence(&e))? {
                LinearReadEvent::ReadRequest(need) => {
                    let read = self
                        .file
                        .read(self.reader.insert(need.min(PIECE_BYTES)))
                        .map_err(|e| format!("cannot be read: {e}"))?;
                    self.reader.notify_read(read);
                }
                LinearReadEvent::Record { opcode, data } => {
                    // What a recording says besides, nobody here asks for.
                    if ![op::SCHEMA, op::CHANNEL, op::MESSAGE, op::ATTACHMENT].contains(&opcode) {
                        continue;
                    }
                    // The library would take the memory before it looks.
                    if !holds_its_texts(opcode, data) {
                        return Err("is damaged: a text is longer than its record".to_owned());
                    }
                    let record = mcap::parse_record(opcode, data).map_err(|e| sentence(&e))?;
                    return Ok(Some(take(record)));
                }
            }
        }
        Ok(None)
    }
}

/// Whether the texts in a record end within it.
fn holds_its_texts(opcode: u8, data: &[u8]) -> bool {
    let rest = match opcode {
        op::SCHEMA => data.get(2..).and_then(after_text).and_then(after_text),
        op::CHANNEL => data
            .get(4..)
            .and_then(after_text)
            .and_then(after_text)
            .and_then(after_map),
        // Its length and its checksum follow.
        op::ATTACHMENT => data
            .get(16..)
            .and_then(after_text)
            .and_then(after_text)
            .filter(|rest| rest.len() >= 12),
        _ => Some(data),
    };
    rest.is_some()
}

/// What follows a text, which begins with its length.
fn after_text(data: &[u8]) -> Option<&[u8]> {
    let (length, rest) = data.split_first_chunk()?;
    rest.get(usize::try_from(u32::from_le_bytes(*length)).ok()?..)
}

/// What follows pairs of texts, before which their length in bytes stands.
fn after_map(data: &[u8]) -> Option<&[u8]> {
    let (length, mut rest) = data.split_first_chunk()?;
    let length = usize::try_from(u32::from_le_bytes(*length)).ok()?;
    let end = rest.len().checked_sub(length)?;
    while rest.len() > end {
        rest = after_text(after_text(rest)?)?;
    }
    Some(rest)
}

fn sentence(error: &mcap::McapError) -> String {
    match error {
        mcap::McapError::BadMagic
        | mcap::McapError::UnexpectedEof
        | mcap::McapError::UnexpectedEoc => {
            "ends in the middle of a record: it was cut off".to_owned()
        }
        other => format!("is damaged: {}", one_line(&other.to_string(), 200)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn text(length: u32, bytes: &str) -> Vec<u8> {
        [&length.to_le_bytes()[..], bytes.as_bytes()].concat()
    }

    #[test]
    fn a_text_that_is_longer_than_its_record_is_found_before_memory_is_taken() {
        let good = text(3, "abc");
        let long = text(0x4400_0003, "abc");
        let none = text(0, "");
        let pair = [text(14, ""), good.clone(), good.clone()].concat();
        let torn = [text(14, ""), good.clone(), long.clone()].concat();
        let begun = |fixed: usize, texts: &[&[u8]]| [vec![0; fixed], texts.concat()].concat();
        for (opcode, data, is_whole) in [
            (op::SCHEMA, begun(2, &[&good, &good, &none]), true),
            (op::SCHEMA, begun(2, &[&long, &good, &none]), false),
            (op::SCHEMA, begun(2, &[&good, &long]), false),
            (op::SCHEMA, begun(1, &[]), false),
            (op::CHANNEL, begun(4, &[&good, &good, &none]), true),
            (op::CHANNEL, begun(4, &[&good, &good, &pair]), true),
            (op::CHANNEL, begun(4, &[&good, &good, &torn]), false),
            (op::CHANNEL, begun(4, &[&good, &good, &long]), false),
            (op::ATTACHMENT, begun(16, &[&good, &none, &[0; 12]]), true),
            (op::ATTACHMENT, begun(16, &[&good, &none, &[0; 11]]), false),
            (op::ATTACHMENT, begun(16, &[&good, &long, &[0; 12]]), false),
        ] {
            assert_eq!(
                holds_its_texts(opcode, &data),
                is_whole,
                "{opcode} {data:?}"
            );
        }
    }
}
