//! JPEG bytes in; grey (or, for a file that stores RGB, colour) samples out, whole or not at all.

use super::decode_error::Fault;
use zune_jpeg::errors::DecodeErrors;
use zune_jpeg::zune_core::{bytestream::ZCursor, colorspace::ColorSpace, options::DecoderOptions};

/// A JPEG whose header has been read.
pub(super) struct Jpeg<'a> {
    bytes: &'a [u8],
    decoder: zune_jpeg::JpegDecoder<ZCursor<&'a [u8]>>,
    size_px: (u32, u32),
    bytes_per_pixel: u8,
}

impl<'a> Jpeg<'a> {
    pub(super) fn open(bytes: &'a [u8]) -> Result<Self, Fault> {
        // Limits on the sides are the caller's, who has a better sentence for them. Strictness
        // turns damaged entropy-coded data into an error instead of grey blocks.
        let options = DecoderOptions::default()
            .set_strict_mode(true)
            .set_max_width(usize::MAX)
            .set_max_height(usize::MAX);
        let mut decoder = zune_jpeg::JpegDecoder::new_with_options(ZCursor::new(bytes), options);
        decoder.decode_headers().map_err(|e| fault(bytes, &e))?;
        // The luma of the usual YCbCr file *is* the grey image: no way round by colour.
        let (output, bytes_per_pixel) = match decoder.input_colorspace() {
            Some(ColorSpace::Luma | ColorSpace::YCbCr) => (ColorSpace::Luma, 1),
            _ => (ColorSpace::RGB, 3),
        };
        decoder.set_options(options.jpeg_set_out_colorspace(output));
        let Some(info) = decoder.info() else {
            return Err(Fault::Damaged("it has no frame header".to_owned()));
        };
        Ok(Self {
            bytes,
            decoder,
            size_px: (u32::from(info.width), u32::from(info.height)),
            bytes_per_pixel,
        })
    }

    pub(super) fn size_px(&self) -> (u32, u32) {
        self.size_px
    }

    /// 1 for grey, 3 for RGB.
    pub(super) fn bytes_per_pixel(&self) -> u8 {
        self.bytes_per_pixel
    }

    /// Decodes into `samples`, which has exactly the room for them.
    pub(super) fn read(&mut self, samples: &mut [u8]) -> Result<(), Fault> {
        // The decoder does not miss what lacks within the last row of blocks.
        if !reaches_end_marker(self.bytes) {
            return Err(Fault::Truncated);
        }
        self.decoder
            .decode_into(samples)
            .map_err(|e| fault(self.bytes, &e))
    }
}

fn fault(bytes: &[u8], error: &DecodeErrors) -> Fault {
    if reaches_end_marker(bytes) {
        Fault::Damaged(error.to_string().replace('\n', " "))
    } else {
        Fault::Truncated
    }
}

/// Whether the chain of segments runs from the start of the image to its end marker.
///
/// Segments are skipped by their length, so that the end of a thumbnail in a header is not taken
/// for the image's own (ITU-T T.81, annex B).
fn reaches_end_marker(bytes: &[u8]) -> bool {
    const END_OF_IMAGE: u8 = 0xD9;
    let mut at = 2;
    loop {
        // To the next marker: 0xFF and neither a stuffed zero, nor a fill byte, nor a restart.
        let Some(marker_at) = next_marker(bytes, at) else {
            return false;
        };
        let marker = bytes[marker_at];
        if marker == END_OF_IMAGE {
            return true;
        }
        let Some(&[high, low]) = bytes.get(marker_at + 1..marker_at + 3) else {
            return false;
        };
        let length = usize::from(u16::from_be_bytes([high, low]));
        // Behind the header of a scan come its data, which are searched for the next marker.
        at = marker_at + 1 + length;
    }
}

/// Where the code of the next marker that carries a segment or ends the image stands.
fn next_marker(bytes: &[u8], from: usize) -> Option<usize> {
    let mut at = from;
    loop {
        at += bytes.get(at..)?.iter().position(|&b| b == 0xFF)? + 1;
        match bytes.get(at)? {
            // A stuffed zero, a temporary marker, a restart, a start: no segment follows.
            0x00 | 0x01 | 0xD0..=0xD8 => at += 1,
            0xFF => {}
            _ => return Some(at),
        }
    }
}
