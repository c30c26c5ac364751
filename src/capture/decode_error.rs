//! What is wrong with an image file in; one sentence that names the file out.

use super::decode::MAX_FILE_BYTES;
use image::ImageError;
use std::error::Error;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

/// Why a file did not become an image.
#[derive(Debug, thiserror::Error)]
pub enum DecodeError {
    /// The file is missing, or the system refuses to read it.
    #[error("{}: cannot be read: {cause}", file.display())]
    Unreadable {
        /// The file.
        file: PathBuf,
        /// What the system says.
        cause: std::io::Error,
    },
    /// The path leads to a folder, a pipe or a device.
    #[error("{}: is not a file", file.display())]
    NotAFile {
        /// The path.
        file: PathBuf,
    },
    /// The file holds nothing.
    #[error("{}: the file is empty", file.display())]
    Empty {
        /// The file.
        file: PathBuf,
    },
    /// The file is longer than any image that is read.
    #[error("{}: has {bytes} bytes, more than {MAX_FILE_BYTES}", file.display())]
    FileTooLong {
        /// The file.
        file: PathBuf,
        /// Its length, bytes.
        bytes: u64,
    },
    /// The first bytes are those of no image that is read.
    #[error("{}: is not a PNG, JPEG, PGM or PPM image", file.display())]
    UnknownFormat {
        /// The file.
        file: PathBuf,
    },
    /// The image is larger than any that is decoded.
    #[error("{}: {width}×{height} px are more than can be decoded", file.display())]
    TooLarge {
        /// The file.
        file: PathBuf,
        /// Width, px.
        width: u32,
        /// Height, px.
        height: u32,
    },
    /// The image is not of the size that was asked for.
    #[error(
        "{}: the image has {width}×{height} px, but the rig's {expected_width}×{expected_height}",
        file.display()
    )]
    WrongSize {
        /// The file.
        file: PathBuf,
        /// Width, px.
        width: u32,
        /// Height, px.
        height: u32,
        /// Width that was asked for, px.
        expected_width: u32,
        /// Height that was asked for, px.
        expected_height: u32,
    },
    /// The file ends before the image does.
    #[error("{}: the file ends before the image does", file.display())]
    Truncated {
        /// The file.
        file: PathBuf,
    },
    /// The file's content breaks the rules of its format.
    #[error("{}: is damaged: {cause}", file.display())]
    Damaged {
        /// The file.
        file: PathBuf,
        /// What the decoder says.
        cause: String,
    },
}

/// What goes wrong inside a file; the file's name is added where it is known.
pub(super) enum Fault {
    Truncated,
    TooLarge(u32, u32),
    WrongSize((u32, u32), (u32, u32)),
    UnknownFormat,
    Damaged(String),
}

impl Fault {
    /// The fault as that of `file`.
    pub(super) fn within(self, file: &Path) -> DecodeError {
        let file = file.to_owned();
        match self {
            Self::Truncated => DecodeError::Truncated { file },
            Self::UnknownFormat => DecodeError::UnknownFormat { file },
            Self::Damaged(cause) => DecodeError::Damaged { file, cause },
            Self::TooLarge(width, height) => DecodeError::TooLarge {
                file,
                width,
                height,
            },
            Self::WrongSize((width, height), (expected_width, expected_height)) => {
                DecodeError::WrongSize {
                    file,
                    width,
                    height,
                    expected_width,
                    expected_height,
                }
            }
        }
    }
}

impl From<ImageError> for Fault {
    fn from(error: ImageError) -> Self {
        let is_end = |e: &std::io::Error| e.kind() == ErrorKind::UnexpectedEof;
        // A decoder hands the end of its input on, or wraps it in an error of its own.
        let mut wrapped = error.source();
        let mut ends = matches!(&error, ImageError::IoError(e) if is_end(e));
        while let Some(inner) = wrapped {
            ends |= inner.downcast_ref().is_some_and(is_end);
            wrapped = inner.source();
        }
        if ends {
            return Self::Truncated;
        }
        Self::Damaged(error.to_string().replace('\n', " "))
    }
}
