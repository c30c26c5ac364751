//! Room in shared memory. What is there on paper only is a bus error when it is first written to, so that room is
//! looked for, and taken, beforehand.

use rustix::fs::{FallocateFlags, StatVfs, fallocate, statvfs};
use std::fs::{File, OpenOptions};
use std::io;
use std::path::Path;

/// Where POSIX shared memory lies.
const SHARED_MEMORY: &str = "/dev/shm";
/// What opening services takes at most, bytes: some tables, a page each.
const TO_OPEN: u64 = 256 * 1024;

/// Refuses to open what there is no room for.
///
/// # Errors
/// One sentence.
pub(super) fn check() -> Result<(), String> {
    let free = statvfs(SHARED_MEMORY).map(|s: StatVfs| s.f_bavail * s.f_frsize);
    match free {
        Ok(free) if free < TO_OPEN => Err(format!(
            "shared memory is full: {SHARED_MEMORY} has {free} bytes left, and opening takes up to {TO_OPEN}"
        )),
        // Where it does not lie there, nothing is known of it.
        _ => Ok(()),
    }
}

/// Takes the room that this process's shared memory, by `prefix`, has on paper only.
///
/// # Errors
/// One sentence: there is not enough.
pub(super) fn take(prefix: &str) -> Result<(), String> {
    let Ok(entries) = std::fs::read_dir(SHARED_MEMORY) else {
        return Ok(());
    };
    for entry in entries.flatten() {
        if entry.file_name().to_string_lossy().starts_with(prefix) {
            take_of(&entry.path()).map_err(|(bytes, cause)| {
                format!(
                    "shared memory is too small: {bytes} bytes cannot be had of {SHARED_MEMORY}: {cause}"
                )
            })?;
        }
    }
    Ok(())
}

/// Takes the room of one file, if it is ours and still there.
fn take_of(path: &Path) -> Result<(), (u64, io::Error)> {
    let file: io::Result<File> = OpenOptions::new().read(true).write(true).open(path);
    let Ok(file) = file else { return Ok(()) };
    let bytes = file.metadata().map_or(0, |m| m.len());
    if bytes == 0 {
        return Ok(());
    }
    match fallocate(&file, FallocateFlags::KEEP_SIZE, 0, bytes) {
        Err(e) if e == rustix::io::Errno::NOSPC => Err((bytes, e.into())),
        // Where the file system cannot promise it, it is as it was.
        _ => Ok(()),
    }
}
