//! An MCAP file in; its records out, front to back, one at a time.

use crate::text_file::one_line;
use mcap::records::Record;
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
                    let record = mcap::parse_record(opcode, data).map_err(|e| sentence(&e))?;
                    return Ok(Some(take(record)));
                }
            }
        }
        Ok(None)
    }
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
