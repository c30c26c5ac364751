//! Image files in; 8-bit grey images out, or one sentence why not.
//!
//! PNG, JPEG, PGM and PPM, 8 or 16 bits a sample, grey or colour; alpha is ignored. Only whole
//! images come out: a truncated file is an error, never a picture with a grey end. Damage within a
//! file is found as far as its format lets one: by checksums in PNG, where the code breaks in JPEG.

use super::decode_error::Fault;
use super::jpeg;
use crate::image::GrayImage;
use image::codecs::{png::PngDecoder, pnm::PnmDecoder};
use image::{ColorType, ImageDecoder, Limits};
use std::fs::File;
use std::io::{Cursor, Read};
use std::path::Path;

pub use super::decode_error::DecodeError;

/// Longest image side that is decoded, px.
pub const MAX_SIDE_PX: u32 = 16_384;
/// Longest file that is read, bytes.
pub const MAX_FILE_BYTES: u64 = 1 << 30;
/// Most memory that the decoded samples of one image may take, bytes.
const MAX_SAMPLE_BYTES: u64 = 1 << 30;
/// Most bytes of pixels that a byte of a file can stand for: 1032 in PNG, fewer in the others. A header that
/// claims more is not followed by its image, and must not take memory for it.
const MAX_COMPRESSION: u64 = 1032;

/// Decodes one file after the other with the same buffers.
#[derive(Debug)]
pub struct Decoder {
    white_level: u16,
    file_bytes: Vec<u8>,
    samples: Vec<u8>,
}

impl Default for Decoder {
    fn default() -> Self {
        Self::new(u16::MAX)
    }
}

impl Decoder {
    /// A decoder that maps the 16-bit sample `white_level` (at least 1) to 255, and what lies above
    /// it as well.
    ///
    /// A camera that stores 12 bits in 16 has the white level 4095. Samples of 8 bits, and those of
    /// a PGM or PPM that states another white than 65535, are not affected.
    #[must_use]
    pub fn new(white_level: u16) -> Self {
        Self {
            white_level: white_level.max(1),
            file_bytes: Vec::new(),
            samples: Vec::new(),
        }
    }

    /// Decodes `file` into `image`, whose memory is used again; its pixels are unspecified after an
    /// error. `expected_px` is the width and height that the image must have, if any.
    ///
    /// # Errors
    /// See the variants of [`DecodeError`].
    pub fn decode(
        &mut self,
        file: &Path,
        expected_px: Option<(u32, u32)>,
        image: &mut GrayImage,
    ) -> Result<(), DecodeError> {
        self.file_bytes.clear();
        read(file, &mut self.file_bytes)?;
        let mut target = Target {
            file_bytes: self.file_bytes.len(),
            expected_px,
            white_level: self.white_level,
            samples: &mut self.samples,
            image,
        };
        target
            .decode(&self.file_bytes)
            .map_err(|fault| fault.within(file))
    }

    /// Decodes an image that is in memory already, as [`decode`](Self::decode) does; `name` stands for
    /// the file in what goes wrong.
    ///
    /// # Errors
    /// See the variants of [`DecodeError`].
    pub fn decode_bytes(
        &mut self,
        name: &str,
        bytes: &[u8],
        expected_px: Option<(u32, u32)>,
        image: &mut GrayImage,
    ) -> Result<(), DecodeError> {
        let mut target = Target {
            file_bytes: bytes.len(),
            expected_px,
            white_level: self.white_level,
            samples: &mut self.samples,
            image,
        };
        target
            .decode(bytes)
            .map_err(|fault| fault.within(Path::new(name)))
    }

    /// The width and height of the image in `file`, px, from its header.
    ///
    /// # Errors
    /// The file cannot be read or its header makes no sense.
    pub fn size_px(&mut self, file: &Path) -> Result<(u32, u32), DecodeError> {
        self.file_bytes.clear();
        read(file, &mut self.file_bytes)?;
        header_size_px(&self.file_bytes).map_err(|fault| fault.within(file))
    }
}

/// The length of `file`, bytes, unless it cannot hold an image.
fn checked_length(file: &Path) -> Result<u64, DecodeError> {
    let meta = std::fs::metadata(file).map_err(|cause| DecodeError::Unreadable {
        file: file.to_owned(),
        cause,
    })?;
    let named = || file.to_owned();
    match meta.len() {
        _ if !meta.is_file() => Err(DecodeError::NotAFile { file: named() }),
        0 => Err(DecodeError::Empty { file: named() }),
        bytes if bytes > MAX_FILE_BYTES => Err(DecodeError::FileTooLong {
            file: named(),
            bytes,
        }),
        bytes => Ok(bytes),
    }
}

fn read(file: &Path, bytes: &mut Vec<u8>) -> Result<(), DecodeError> {
    let length = checked_length(file)?;
    let unreadable = |cause| DecodeError::Unreadable {
        file: file.to_owned(),
        cause,
    };
    bytes.reserve(usize::try_from(length).unwrap_or(0));
    let opened = File::open(file).map_err(unreadable)?;
    // A file that grows meanwhile does not get past the limit.
    opened
        .take(MAX_FILE_BYTES)
        .read_to_end(bytes)
        .map_err(unreadable)?;
    Ok(())
}

enum Format {
    Png,
    Jpeg,
    Pnm,
}

fn format_of(bytes: &[u8]) -> Result<Format, Fault> {
    match bytes {
        [0x89, b'P', b'N', b'G', ..] => Ok(Format::Png),
        [0xFF, 0xD8, ..] => Ok(Format::Jpeg),
        [b'P', b'2' | b'3' | b'5' | b'6', ..] => Ok(Format::Pnm),
        _ => Err(Fault::UnknownFormat),
    }
}

fn png(bytes: &[u8]) -> Result<PngDecoder<Cursor<&[u8]>>, Fault> {
    // The sides are checked by `Target::admit`, with a better sentence.
    let mut limits = Limits::no_limits();
    limits.max_alloc = Some(MAX_SAMPLE_BYTES);
    Ok(PngDecoder::with_limits(Cursor::new(bytes), limits)?)
}

fn header_size_px(bytes: &[u8]) -> Result<(u32, u32), Fault> {
    match format_of(bytes)? {
        Format::Png => Ok(png(bytes)?.dimensions()),
        Format::Pnm => Ok(PnmDecoder::new(Cursor::new(bytes))?.dimensions()),
        Format::Jpeg => Ok(jpeg::Jpeg::open(bytes)?.size_px()),
    }
}

/// The width, the height and the pixels of a whole binary PGM of 8 bits without comments, which is
/// what cameras' raw images are kept as; it is read without any memory taken. `None` for all others.
fn plain_grey(bytes: &[u8]) -> Option<((u32, u32), &[u8])> {
    let mut rest = bytes.strip_prefix(b"P5")?;
    let mut numbers = [0_u32; 3];
    for number in &mut numbers {
        let digits = rest.trim_ascii_start();
        let end = digits.iter().position(|b| !b.is_ascii_digit())?;
        let is_apart = digits.len() < rest.len();
        *number = str::from_utf8(&digits[..end]).ok()?.parse().ok()?;
        rest = is_apart.then_some(&digits[end..])?;
    }
    let [width, height, white] = numbers;
    let (b' ' | b'\n' | b'\r' | b'\t', pixels) = rest.split_first()? else {
        return None;
    };
    let count = usize::try_from(u64::from(width) * u64::from(height)).ok()?;
    let pixels = pixels.get(..count).filter(|_| white == 255)?;
    Some(((width, height), pixels))
}

/// Where an image goes, and under which conditions.
struct Target<'a> {
    file_bytes: usize,
    expected_px: Option<(u32, u32)>,
    white_level: u16,
    samples: &'a mut Vec<u8>,
    image: &'a mut GrayImage,
}

impl Target<'_> {
    fn decode(&mut self, bytes: &[u8]) -> Result<(), Fault> {
        match format_of(bytes)? {
            Format::Png => {
                let decoder = png(bytes)?;
                self.fill(decoder, self.white_level)
            }
            Format::Pnm => {
                if let Some((size, pixels)) = plain_grey(bytes) {
                    self.admit(size, 1, 8)?;
                    self.image.pixels_mut().copy_from_slice(pixels);
                    return Ok(());
                }
                let decoder = PnmDecoder::new(Cursor::new(bytes))?;
                // The decoder has already stretched the samples to the white that the file states.
                let own_white = decoder.header().maximal_sample() != u32::from(u16::MAX);
                let white_level = if own_white {
                    u16::MAX
                } else {
                    self.white_level
                };
                self.fill(decoder, white_level)
            }
            Format::Jpeg => {
                let mut decoder = jpeg::Jpeg::open(bytes)?;
                let size = decoder.size_px();
                self.admit(size, decoder.bytes_per_pixel(), 8)?;
                if decoder.bytes_per_pixel() == 1 {
                    return decoder.read(self.image.pixels_mut());
                }
                resize(self.samples, size, decoder.bytes_per_pixel());
                decoder.read(self.samples)?;
                grey_from_colour8(self.samples, 3, self.image.pixels_mut());
                Ok(())
            }
        }
    }

    /// Refuses an image by its header, before memory is taken, and makes room for its pixels.
    /// `stored_bits` are those of a pixel in the file, before compression.
    fn admit(
        &mut self,
        size: (u32, u32),
        bytes_per_pixel: u8,
        stored_bits: u16,
    ) -> Result<(), Fault> {
        let (width, height) = size;
        if let Some(expected) = self.expected_px
            && expected != size
        {
            return Err(Fault::WrongSize(size, expected));
        }
        let sample_bytes = u64::from(width) * u64::from(height) * u64::from(bytes_per_pixel);
        if width.max(height) > MAX_SIDE_PX || sample_bytes > MAX_SAMPLE_BYTES {
            return Err(Fault::TooLarge(width, height));
        }
        if width.min(height) == 0 {
            return Err(Fault::Damaged(format!("it has {width}×{height} px")));
        }
        let stored_bytes = u64::from(width) * u64::from(height) * u64::from(stored_bits) / 8;
        if stored_bytes > self.file_bytes as u64 * MAX_COMPRESSION {
            return Err(Fault::Truncated);
        }
        self.image.reshape(width, height);
        Ok(())
    }

    fn fill(&mut self, decoder: impl ImageDecoder, white_level: u16) -> Result<(), Fault> {
        let (size, color) = (decoder.dimensions(), decoder.color_type());
        let stored_bits = decoder.original_color_type().bits_per_pixel();
        self.admit(size, color.bytes_per_pixel(), stored_bits)?;
        if color == ColorType::L8 {
            return Ok(decoder.read_image(self.image.pixels_mut())?);
        }
        resize(self.samples, size, color.bytes_per_pixel());
        decoder.read_image(self.samples)?;
        let (samples, grey) = (self.samples.as_slice(), self.image.pixels_mut());
        match color {
            ColorType::La8 => grey_from_first8(samples, 2, grey),
            ColorType::Rgb8 => grey_from_colour8(samples, 3, grey),
            ColorType::Rgba8 => grey_from_colour8(samples, 4, grey),
            ColorType::L16 => grey_from_grey16(samples, 1, white_level, grey),
            ColorType::La16 => grey_from_grey16(samples, 2, white_level, grey),
            ColorType::Rgb16 => grey_from_colour16(samples, 3, white_level, grey),
            ColorType::Rgba16 => grey_from_colour16(samples, 4, white_level, grey),
            other => {
                return Err(Fault::Damaged(format!(
                    "samples of {other:?} are not known"
                )));
            }
        }
        Ok(())
    }
}

fn resize(samples: &mut Vec<u8>, (width, height): (u32, u32), bytes_per_pixel: u8) {
    let length = width as usize * height as usize * usize::from(bytes_per_pixel);
    samples.resize(length, 0);
}

/// Luma in thousandths of a sample, with the weights of ITU-R BT.601 that OpenCV uses.
fn luma_thousandths(r: u32, g: u32, b: u32) -> u32 {
    299 * r + 587 * g + 114 * b
}

fn grey_from_first8(samples: &[u8], channels: usize, grey: &mut [u8]) {
    for (pixel, out) in samples.chunks_exact(channels).zip(grey) {
        *out = pixel[0];
    }
}

fn grey_from_colour8(samples: &[u8], channels: usize, grey: &mut [u8]) {
    for (pixel, out) in samples.chunks_exact(channels).zip(grey) {
        let [r, g, b] = [pixel[0], pixel[1], pixel[2]].map(u32::from);
        // At most 255, as the weights add up to one.
        *out = ((luma_thousandths(r, g, b) + 500) / 1000) as u8;
    }
}

fn grey_from_grey16(samples: &[u8], channels: usize, white_level: u16, grey: &mut [u8]) {
    let white = u32::from(white_level);
    for (pixel, out) in samples.chunks_exact(2 * channels).zip(grey) {
        let sample = u32::from(u16::from_ne_bytes([pixel[0], pixel[1]]));
        *out = u8::try_from((sample * 255 + white / 2) / white).unwrap_or(u8::MAX);
    }
}

fn grey_from_colour16(samples: &[u8], channels: usize, white_level: u16, grey: &mut [u8]) {
    let white = u64::from(white_level) * 1000;
    for (pixel, out) in samples.chunks_exact(2 * channels).zip(grey) {
        let sample = |at: usize| u32::from(u16::from_ne_bytes([pixel[at], pixel[at + 1]]));
        let luma = u64::from(luma_thousandths(sample(0), sample(2), sample(4)));
        *out = u8::try_from((luma * 255 + white / 2) / white).unwrap_or(u8::MAX);
    }
}

#[cfg(test)]
#[path = "decode_tests.rs"]
mod tests;
