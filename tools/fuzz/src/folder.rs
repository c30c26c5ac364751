//! Files for readers that want paths.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

/// What stands before the name of each file within the bytes of one input.
const MARK: &[u8] = b"=== ";
/// Most files of one input.
const MOST_FILES: usize = 16;

static NEXT: AtomicU64 = AtomicU64::new(0);

/// A folder that goes when it is dropped.
pub struct Folder(PathBuf);

impl Folder {
    /// An empty folder, in memory where there is such a place.
    pub fn new() -> Self {
        let memory = Path::new("/dev/shm");
        let parent = if memory.is_dir() {
            memory.to_owned()
        } else {
            std::env::temp_dir()
        };
        let number = NEXT.fetch_add(1, Ordering::Relaxed);
        let path = parent.join(format!("visod-fuzz-{}-{number}", std::process::id()));
        std::fs::create_dir_all(&path).expect("a folder can be made");
        Self(path)
    }

    /// Its path.
    pub fn path(&self) -> &Path {
        &self.0
    }

    /// Writes a file into it.
    pub fn put(&self, name: &str, content: &[u8]) -> PathBuf {
        let file = self.0.join(name);
        std::fs::write(&file, content).expect("a file can be written");
        file
    }

    /// Writes files of lines `=== name` each followed by what the file holds; names that do not stay within
    /// the folder are passed over.
    pub fn unpack(&self, bytes: &[u8]) {
        for part in split(bytes, MARK).take(MOST_FILES) {
            let end = part.iter().position(|b| *b == b'\n').unwrap_or(part.len());
            let name = String::from_utf8_lossy(&part[..end]);
            let content = part.get(end + 1..).unwrap_or_default();
            let is_plain = |word: &str| {
                !word.is_empty()
                    && word.len() < 64
                    && !word.starts_with("..")
                    && !word.contains('\0')
            };
            if name.split('/').count() > 4 || !name.split('/').all(is_plain) {
                continue;
            }
            let file = self.0.join(&*name);
            // A name may be that of a folder already, or below a file's.
            if let Some(folder) = file.parent()
                && std::fs::create_dir_all(folder).is_ok()
            {
                let _ = std::fs::write(file, content);
            }
        }
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// The parts of `bytes` that follow a mark at the beginning of a line.
pub fn split<'a>(bytes: &'a [u8], mark: &'a [u8]) -> impl Iterator<Item = &'a [u8]> {
    let mut rest = bytes;
    let starts = move |at: usize, bytes: &[u8]| {
        bytes[at..].starts_with(mark) && (at == 0 || bytes[at - 1] == b'\n')
    };
    std::iter::from_fn(move || {
        let start = (0..rest.len()).find(|at| starts(*at, rest))? + mark.len();
        let end = (start..rest.len())
            .find(|at| starts(*at, rest))
            .unwrap_or(rest.len());
        let part = &rest[start..end];
        rest = &rest[end..];
        Some(part)
    })
}
