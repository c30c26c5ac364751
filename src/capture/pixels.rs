//! A camera's raw pixels in, an 8-bit grey image out.
//!
//! Colour filter arrays become grey by the kernel (1 2 1)ᵀ(1 2 1)/16: whatever the colour of the
//! middle pixel, red, green and blue weigh 1 : 2 : 1 in the sum, and nothing is shifted, as it would
//! be by the mean of 2×2 pixels.

use super::decode;
use crate::image::GrayImage;

/// How a camera's bytes are to be read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PixelLayout {
    /// One byte a pixel.
    Mono8,
    /// Two bytes a pixel, little endian; the largest sample has that many bits.
    Mono16 {
        /// Significant bits, from the lowest.
        bits: u32,
    },
    /// Ten or twelve bits a pixel in a row, lowest first (GenICam `Mono10p`, `Mono12p`).
    MonoP {
        /// 10 or 12.
        bits: u32,
    },
    /// Two pixels in three bytes: their high eight bits, with the low ones between (GigE Vision's
    /// `Mono10Packed`, `Mono12Packed`).
    MonoPacked {
        /// 10 or 12.
        bits: u32,
    },
    /// A colour filter array of one byte a pixel.
    Bayer8,
    /// The same with two bytes a pixel, little endian.
    Bayer16 {
        /// Significant bits, from the lowest.
        bits: u32,
    },
    /// Grey and colour alternating: Y U Y V.
    Yuyv,
    /// Colour and grey alternating: U Y V Y.
    Uyvy,
    /// Three bytes a pixel: red, green, blue.
    Rgb8,
    /// Three bytes a pixel: blue, green, red.
    Bgr8,
    /// A JPEG an image.
    Mjpg,
}

impl PixelLayout {
    /// The GenICam name's layout.
    #[must_use]
    pub fn of_genicam(name: &str) -> Option<Self> {
        Some(match name {
            "Mono8" => Self::Mono8,
            "Mono10" => Self::Mono16 { bits: 10 },
            "Mono12" => Self::Mono16 { bits: 12 },
            "Mono14" => Self::Mono16 { bits: 14 },
            "Mono16" => Self::Mono16 { bits: 16 },
            "Mono10p" => Self::MonoP { bits: 10 },
            "Mono12p" => Self::MonoP { bits: 12 },
            "Mono10Packed" => Self::MonoPacked { bits: 10 },
            "Mono12Packed" => Self::MonoPacked { bits: 12 },
            "RGB8" | "RGB8Packed" => Self::Rgb8,
            "BGR8" | "BGR8Packed" => Self::Bgr8,
            "YUV422Packed" | "YUV422_8_UYVY" | "YCbCr422_8_CbYCrY" => Self::Uyvy,
            "YUYVPacked" | "YUV422_8" | "YUV422_YUYV_Packed" | "YCbCr422_8" => Self::Yuyv,
            _ => {
                let bits = name.strip_prefix("Bayer")?.get(2..)?;
                match bits {
                    "8" => Self::Bayer8,
                    "10" | "12" | "16" => Self::Bayer16 {
                        bits: bits.parse().ok()?,
                    },
                    _ => return None,
                }
            }
        })
    }

    /// The layout of a V4L2 pixel format, by its four characters.
    #[must_use]
    pub fn of_fourcc(fourcc: &str) -> Option<Self> {
        Some(match fourcc {
            "GREY" => Self::Mono8,
            "Y10 " => Self::Mono16 { bits: 10 },
            "Y12 " => Self::Mono16 { bits: 12 },
            "Y16 " => Self::Mono16 { bits: 16 },
            "YUYV" => Self::Yuyv,
            "UYVY" => Self::Uyvy,
            "RGB3" => Self::Rgb8,
            "BGR3" => Self::Bgr8,
            "MJPG" | "JPEG" => Self::Mjpg,
            "BA81" | "GBRG" | "GRBG" | "RGGB" => Self::Bayer8,
            "BYR2" | "GB16" | "GR16" | "RG16" => Self::Bayer16 { bits: 16 },
            "BG10" | "GB10" | "BA10" | "RG10" => Self::Bayer16 { bits: 10 },
            "BG12" | "GB12" | "BA12" | "RG12" => Self::Bayer16 { bits: 12 },
            _ => return None,
        })
    }

    /// Least bytes of an image, `stride` bytes a row; 1 for compressed ones.
    #[must_use]
    pub fn bytes(self, (width, height): (u32, u32), stride: usize) -> usize {
        match self {
            Self::Mjpg => 1,
            _ => stride * (height as usize - 1) + self.row_bytes(width),
        }
    }

    /// Least bytes of a row.
    #[must_use]
    pub fn row_bytes(self, width: u32) -> usize {
        let width = width as usize;
        match self {
            Self::Mono8 | Self::Bayer8 => width,
            Self::Mono16 { .. } | Self::Bayer16 { .. } | Self::Yuyv | Self::Uyvy => 2 * width,
            Self::MonoP { bits } => (width * bits as usize).div_ceil(8),
            Self::MonoPacked { .. } => (3 * width).div_ceil(2),
            Self::Rgb8 | Self::Bgr8 => 3 * width,
            Self::Mjpg => 1,
        }
    }
}

/// Turns one raw image after the other into grey.
#[derive(Debug)]
pub struct Converter {
    layout: PixelLayout,
    size_px: (u32, u32),
    stride: usize,
    white_level: u32,
    mosaic: GrayImage,
    jpeg: decode::Decoder,
}

impl Converter {
    /// For images of one layout and size, with `stride` bytes a row. `white_level` is the sample that
    /// becomes 255 where there are more than 8 bits; without, the layout's largest.
    #[must_use]
    pub fn new(
        layout: PixelLayout,
        size_px: (u32, u32),
        stride: usize,
        white_level: Option<u16>,
    ) -> Self {
        let largest = match layout {
            PixelLayout::Mono16 { bits }
            | PixelLayout::Bayer16 { bits }
            | PixelLayout::MonoP { bits }
            | PixelLayout::MonoPacked { bits } => (1 << bits) - 1,
            _ => 255,
        };
        Self {
            layout,
            size_px,
            stride: stride.max(layout.row_bytes(size_px.0)),
            white_level: white_level.map_or(largest, u32::from),
            mosaic: GrayImage::default(),
            jpeg: decode::Decoder::default(),
        }
    }

    /// Converts `raw` into `image`, whose memory is used again.
    ///
    /// # Errors
    /// One sentence: there are too few bytes, or the JPEG cannot be decoded.
    pub fn convert(&mut self, raw: &[u8], image: &mut GrayImage) -> Result<(), String> {
        let (width, height) = self.size_px;
        let least = self.layout.bytes(self.size_px, self.stride);
        if raw.len() < least {
            return Err(format!("{} bytes are no image of {least}", raw.len()));
        }
        if self.layout == PixelLayout::Mjpg {
            return self
                .jpeg
                .decode_bytes("the camera's JPEG", raw, Some(self.size_px), image)
                .map_err(|e| e.to_string());
        }
        image.reshape(width, height);
        if matches!(
            self.layout,
            PixelLayout::Bayer8 | PixelLayout::Bayer16 { .. }
        ) {
            let mut mosaic = std::mem::take(&mut self.mosaic);
            mosaic.reshape(width, height);
            self.rows(raw, &mut mosaic);
            smooth(&mosaic, image);
            self.mosaic = mosaic;
        } else {
            self.rows(raw, image);
        }
        Ok(())
    }

    fn rows(&self, raw: &[u8], image: &mut GrayImage) {
        let width = self.size_px.0 as usize;
        let bytes = self.layout.row_bytes(self.size_px.0);
        let white = self.white_level;
        let scaled = |sample: u32| ((sample * 255 + white / 2) / white).min(255) as u8;
        let rows = raw.chunks(self.stride).filter(|row| row.len() >= bytes);
        for (row, out) in rows.zip(image.pixels_mut().chunks_exact_mut(width)) {
            let row = &row[..bytes];
            match self.layout {
                PixelLayout::Mono8 | PixelLayout::Bayer8 => out.copy_from_slice(row),
                PixelLayout::Mono16 { .. } | PixelLayout::Bayer16 { .. } => {
                    for (b, out) in row.chunks_exact(2).zip(out) {
                        *out = scaled(u32::from(u16::from_le_bytes([b[0], b[1]])));
                    }
                }
                PixelLayout::MonoP { bits } => {
                    for (x, out) in out.iter_mut().enumerate() {
                        *out = scaled(bits_at(row, x * bits as usize, bits));
                    }
                }
                PixelLayout::MonoPacked { bits } => {
                    let low_mask = (1 << (bits - 8)) - 1;
                    for (x, out) in out.iter_mut().enumerate() {
                        let triple = &row[3 * (x / 2)..];
                        let (high, low) = if x % 2 == 0 {
                            (triple[0], triple[1])
                        } else {
                            (triple[2], triple[1] >> 4)
                        };
                        *out = scaled(u32::from(high) << (bits - 8) | u32::from(low) & low_mask);
                    }
                }
                PixelLayout::Yuyv => every_other(row, out),
                PixelLayout::Uyvy => every_other(&row[1..], out),
                PixelLayout::Rgb8 => {
                    for (p, out) in row.chunks_exact(3).zip(out) {
                        *out = luma(p[0], p[1], p[2]);
                    }
                }
                PixelLayout::Bgr8 => {
                    for (p, out) in row.chunks_exact(3).zip(out) {
                        *out = luma(p[2], p[1], p[0]);
                    }
                }
                PixelLayout::Mjpg => {}
            }
        }
    }
}

fn every_other(row: &[u8], out: &mut [u8]) {
    for (byte, out) in row.iter().step_by(2).zip(out) {
        *out = *byte;
    }
}

/// Luma with the weights of ITU-R BT.601, rounded.
fn luma(r: u8, g: u8, b: u8) -> u8 {
    let sum = 299 * u32::from(r) + 587 * u32::from(g) + 114 * u32::from(b);
    ((sum + 500) / 1000) as u8
}

/// `bits` bits from bit `at` on, the lowest first.
fn bits_at(row: &[u8], at: usize, bits: u32) -> u32 {
    let byte = |n: usize| u32::from(row.get(n).copied().unwrap_or(0));
    let word = byte(at / 8) | byte(at / 8 + 1) << 8;
    (word >> (at % 8)) & ((1 << bits) - 1)
}

/// The kernel (1 2 1)ᵀ(1 2 1)/16; at the border the image is mirrored about its outermost pixels, which
/// keeps the colours in their places.
fn smooth(mosaic: &GrayImage, image: &mut GrayImage) {
    let (width, height) = (mosaic.width() as usize, mosaic.height() as usize);
    let mirrored = |at: usize, last: usize| (at.saturating_sub(1), (at + 1).min(last));
    for y in 0..height {
        let (above, below) = match mirrored(y, height - 1) {
            (_, below) if y == 0 => (below, below),
            (above, below) if below == y => (above, above),
            both => both,
        };
        let [a, m, b] = [above, y, below].map(|row| mosaic.row(row as u32));
        let column = |x: usize| u32::from(a[x]) + 2 * u32::from(m[x]) + u32::from(b[x]);
        let out = &mut image.pixels_mut()[y * width..][..width];
        for (x, out) in out.iter_mut().enumerate() {
            let (left, right) = match mirrored(x, width - 1) {
                (_, right) if x == 0 => (right, right),
                (left, right) if right == x => (left, left),
                both => both,
            };
            *out = ((column(left) + 2 * column(x) + column(right) + 8) / 16) as u8;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn converted(layout: PixelLayout, width: u32, raw: &[u8]) -> Vec<u8> {
        let height = raw.len() / layout.row_bytes(width);
        let size = (width, height as u32);
        let mut image = GrayImage::default();
        let mut converter = Converter::new(layout, size, 0, None);
        converter.convert(raw, &mut image).expect("converted");
        image.pixels().to_vec()
    }

    /// Samples of `bits` bits, lowest first, one after the other.
    fn packed(samples: &[u32], bits: u32) -> Vec<u8> {
        let mut bytes = vec![0_u8; (samples.len() * bits as usize).div_ceil(8)];
        for (n, sample) in samples.iter().enumerate() {
            for bit in 0..bits as usize {
                let at = n * bits as usize + bit;
                bytes[at / 8] |= ((sample >> bit & 1) as u8) << (at % 8);
            }
        }
        bytes
    }

    #[test]
    fn each_layout_gives_the_grey_it_stands_for() {
        assert_eq!(
            converted(PixelLayout::Mono8, 2, &[1, 2, 3, 4]),
            [1, 2, 3, 4]
        );
        let sixteen: Vec<u8> = [0_u16, 32_768, 65_535, 257]
            .iter()
            .flat_map(|v| v.to_le_bytes())
            .collect();
        assert_eq!(
            converted(PixelLayout::Mono16 { bits: 16 }, 4, &sixteen),
            [0, 128, 255, 1]
        );
        let samples = [0, 4095, 2048, 16];
        assert_eq!(
            converted(PixelLayout::MonoP { bits: 12 }, 4, &packed(&samples, 12)),
            [0, 255, 128, 1]
        );
        let samples = [0, 1023, 512, 4];
        assert_eq!(
            converted(PixelLayout::MonoP { bits: 10 }, 4, &packed(&samples, 10)),
            [0, 255, 128, 1]
        );
        // High byte, both low nibbles, high byte.
        assert_eq!(
            converted(PixelLayout::MonoPacked { bits: 12 }, 2, &[0x80, 0xF0, 0xFF]),
            [128, 255]
        );
        assert_eq!(
            converted(PixelLayout::MonoPacked { bits: 10 }, 2, &[0x80, 0x30, 0xFF]),
            [128, 255]
        );
        assert_eq!(converted(PixelLayout::Yuyv, 2, &[7, 128, 9, 128]), [7, 9]);
        assert_eq!(converted(PixelLayout::Uyvy, 2, &[128, 7, 128, 9]), [7, 9]);
        assert_eq!(converted(PixelLayout::Rgb8, 1, &[255, 0, 0]), [76]);
        assert_eq!(converted(PixelLayout::Bgr8, 1, &[255, 0, 0]), [29]);
    }

    #[test]
    fn a_white_level_stretches_what_has_more_than_eight_bits() {
        let raw: Vec<u8> = [2048_u16, 4095]
            .iter()
            .flat_map(|v| v.to_le_bytes())
            .collect();
        let layout = PixelLayout::Mono16 { bits: 16 };
        let mut image = GrayImage::default();
        let mut converter = Converter::new(layout, (2, 1), 0, Some(4095));
        converter.convert(&raw, &mut image).expect("converted");
        assert_eq!(image.pixels(), [128, 255]);
    }

    #[test]
    fn padding_at_the_end_of_rows_is_skipped() {
        let mut image = GrayImage::default();
        let mut converter = Converter::new(PixelLayout::Mono8, (2, 2), 4, None);
        // The padding of the last row need not be there.
        converter
            .convert(&[1, 2, 0, 0, 3, 4], &mut image)
            .expect("converted");
        assert_eq!(image.pixels(), [1, 2, 3, 4]);
        assert!(converter.convert(&[1, 2, 0, 0, 3], &mut image).is_err());
    }

    /// A grey scene behind a colour filter array is that grey in every pixel, and a coloured one is
    /// the same grey in every pixel, borders included.
    #[test]
    fn a_mosaic_of_an_even_scene_is_even() {
        let (width, height) = (6, 4);
        let rggb = |x: usize, y: usize| match (x % 2, y % 2) {
            (0, 0) => 40,
            (1, 1) => 200,
            _ => 100,
        };
        let raw: Vec<u8> = (0..width * height)
            .map(|n| rggb(n % width, n / width))
            .collect();
        let grey = converted(PixelLayout::Bayer8, width as u32, &raw);
        assert_eq!(grey, vec![110; width * height]);
    }

    #[test]
    fn a_mosaic_is_not_shifted() {
        let mut raw = vec![0_u8; 49];
        raw[3 * 7 + 3] = 160;
        let grey = converted(PixelLayout::Bayer8, 7, &raw);
        let sum: u32 = grey.iter().map(|v| u32::from(*v)).sum();
        let centre: u32 = (0_u32..)
            .zip(&grey)
            .map(|(n, v)| n % 7 * u32::from(*v))
            .sum();
        assert_eq!(centre, 3 * sum);
    }

    #[test]
    fn names_of_formats_are_known() {
        for (name, layout) in [
            ("Mono8", PixelLayout::Mono8),
            ("Mono12p", PixelLayout::MonoP { bits: 12 }),
            ("Mono12Packed", PixelLayout::MonoPacked { bits: 12 }),
            ("BayerRG8", PixelLayout::Bayer8),
            ("BayerGB12", PixelLayout::Bayer16 { bits: 12 }),
        ] {
            assert_eq!(PixelLayout::of_genicam(name), Some(layout), "{name}");
        }
        assert_eq!(PixelLayout::of_genicam("Coord3D_ABC32f"), None);
        assert_eq!(PixelLayout::of_genicam("BayerRG"), None);
        assert_eq!(PixelLayout::of_fourcc("MJPG"), Some(PixelLayout::Mjpg));
        assert_eq!(PixelLayout::of_fourcc("H264"), None);
    }

    /// A grey gradient as a camera's JPEG, and its pixels.
    fn jpeg() -> (Vec<u8>, GrayImage) {
        let mut image = GrayImage::filled(32, 16, 0);
        for (n, pixel) in image.pixels_mut().iter_mut().enumerate() {
            *pixel = (5 * (n % 32) + 3 * (n / 32)) as u8;
        }
        let mut bytes = Vec::new();
        image::codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, 95)
            .encode(image.pixels(), 32, 16, image::ExtendedColorType::L8)
            .expect("encoded");
        (bytes, image)
    }

    /// The same as many cameras send it: marked as a frame of a video, without the Huffman tables that all
    /// of those share.
    fn without_tables(jpeg: &[u8]) -> Vec<u8> {
        let mut bytes = b"\xFF\xD8\xFF\xE0\x00\x10AVI1\0\0\0\0\0\0\0\0\0\0".to_vec();
        let mut at = 2;
        loop {
            let end = at + 2 + usize::from(u16::from_be_bytes([jpeg[at + 2], jpeg[at + 3]]));
            match jpeg[at + 1] {
                0xC4 | 0xE0 => {}
                0xDA => {
                    bytes.extend(&jpeg[at..]);
                    return bytes;
                }
                _ => bytes.extend(&jpeg[at..end]),
            }
            at = end;
        }
    }

    #[test]
    fn a_jpeg_is_the_grey_that_went_into_it_with_its_tables_or_without() {
        let (jpeg, truth) = jpeg();
        let bare = without_tables(&jpeg);
        assert!(bare.len() + 100 < jpeg.len(), "the tables are gone");
        for bytes in [jpeg, bare] {
            let mut converter = Converter::new(PixelLayout::Mjpg, (32, 16), 0, None);
            let mut image = GrayImage::default();
            converter.convert(&bytes, &mut image).expect("converted");
            let pixels = image.pixels().iter().zip(truth.pixels());
            let worst = pixels.map(|(a, b)| a.abs_diff(*b)).max();
            assert!(worst <= Some(3), "{worst:?}");
        }
    }

    #[test]
    fn a_jpeg_of_the_wrong_size_or_that_is_none_is_refused() {
        let mut converter = Converter::new(PixelLayout::Mjpg, (8, 8), 0, None);
        let mut image = GrayImage::default();
        let why = converter
            .convert(b"no jpeg", &mut image)
            .expect_err("refused");
        assert!(why.starts_with("the camera's JPEG"), "{why}");
        let why = converter
            .convert(&jpeg().0, &mut image)
            .expect_err("refused");
        assert!(why.contains("32×16"), "{why}");
    }
}
