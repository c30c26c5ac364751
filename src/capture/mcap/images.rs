//! One image message of ROS in; a grey image out.

use super::super::decode::{Decoder, MAX_SIDE_PX};
use super::super::pixels::{Converter, PixelLayout};
use crate::image::GrayImage;
use crate::ros::messages::{CompressedImage, Image};

/// Turns one camera's messages into images.
pub(super) struct Images {
    size_px: (u32, u32),
    white_level: u16,
    decoder: Decoder,
    converter: Option<(PixelLayout, u32, Converter)>,
}

impl Images {
    /// For images of one size. `white_level` is the 16-bit sample that becomes white.
    pub(super) fn new(size_px: (u32, u32), white_level: u16) -> Self {
        Self {
            size_px,
            white_level,
            decoder: Decoder::new(white_level),
            converter: None,
        }
    }

    /// Raw pixels.
    ///
    /// # Errors
    /// One sentence: the size is not the rig's, or the encoding is not read.
    pub(super) fn raw(&mut self, message: &Image, image: &mut GrayImage) -> Result<(), String> {
        let size_px = (message.width, message.height);
        if size_px != self.size_px || message.width.max(message.height) > MAX_SIDE_PX {
            return Err(format!(
                "the image has {}×{} px, but the rig's {}×{}",
                size_px.0, size_px.1, self.size_px.0, self.size_px.1
            ));
        }
        let layout = layout(&message.encoding).ok_or_else(|| {
            format!(
                "the pixel encoding \"{}\" is not read",
                super::super::text::shown(&message.encoding)
            )
        })?;
        if message.is_bigendian != 0 && layout.row_bytes(8) > 8 && is_16_bit(layout) {
            return Err("16-bit pixels in big-endian order are not read".to_owned());
        }
        let step = message.step;
        let is_same = |(l, s, _): &(PixelLayout, u32, Converter)| (*l, *s) == (layout, step);
        if !self.converter.as_ref().is_some_and(is_same) {
            let white = is_16_bit(layout).then_some(self.white_level);
            let converter = Converter::new(layout, size_px, step as usize, white);
            self.converter = Some((layout, step, converter));
        }
        match &mut self.converter {
            Some((_, _, converter)) => converter.convert(&message.data.0, image),
            None => Ok(()),
        }
    }

    /// An image file.
    ///
    /// # Errors
    /// One sentence: what is wrong with it.
    pub(super) fn compressed(
        &mut self,
        topic: &str,
        message: &CompressedImage,
        image: &mut GrayImage,
    ) -> Result<(), String> {
        self.decoder
            .decode_bytes(topic, &message.data.0, Some(self.size_px), image)
            .map_err(|e| e.to_string())
    }
}

fn is_16_bit(layout: PixelLayout) -> bool {
    matches!(
        layout,
        PixelLayout::Mono16 { .. } | PixelLayout::Bayer16 { .. }
    )
}

/// The layout that a ROS encoding names.
fn layout(encoding: &str) -> Option<PixelLayout> {
    Some(match encoding {
        "mono8" | "8UC1" => PixelLayout::Mono8,
        "mono16" | "16UC1" => PixelLayout::Mono16 { bits: 16 },
        "rgb8" => PixelLayout::Rgb8,
        "bgr8" | "8UC3" => PixelLayout::Bgr8,
        "yuv422_yuy2" | "yuyv" => PixelLayout::Yuyv,
        "yuv422" | "uyvy" => PixelLayout::Uyvy,
        "bayer_rggb8" | "bayer_bggr8" | "bayer_gbrg8" | "bayer_grbg8" => PixelLayout::Bayer8,
        "bayer_rggb16" | "bayer_bggr16" | "bayer_gbrg16" | "bayer_grbg16" => {
            PixelLayout::Bayer16 { bits: 16 }
        }
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ros::Bytes;

    fn message(encoding: &str, step: u32, data: Vec<u8>) -> Image {
        Image {
            height: 2,
            width: 2,
            encoding: encoding.to_owned(),
            step,
            data: Bytes(data),
            ..Image::default()
        }
    }

    #[test]
    fn pixels_of_each_encoding_become_grey() {
        let mut images = Images::new((2, 2), u16::MAX);
        let mut image = GrayImage::default();
        for (encoding, step, data, grey) in [
            // Rows may be longer than their pixels.
            ("mono8", 3, vec![1, 2, 99, 3, 4], [1, 2, 3, 4]),
            (
                "mono16",
                4,
                vec![0, 1, 0, 2, 0, 3, 255, 255],
                [1, 2, 3, 255],
            ),
            (
                "rgb8",
                6,
                vec![255, 255, 255, 0, 0, 0, 255, 0, 0, 0, 0, 255],
                [255, 0, 76, 29],
            ),
            (
                "bgr8",
                6,
                vec![255, 255, 255, 0, 0, 0, 255, 0, 0, 0, 0, 255],
                [255, 0, 29, 76],
            ),
        ] {
            let raw = message(encoding, step, data);
            assert_eq!(images.raw(&raw, &mut image), Ok(()), "{encoding}");
            assert_eq!(image.pixels(), grey, "{encoding}");
        }
    }

    #[test]
    fn what_is_no_image_of_the_rig_is_named() {
        let mut images = Images::new((2, 2), u16::MAX);
        let mut image = GrayImage::default();
        let mut refused = |message: &Image| images.raw(message, &mut image).expect_err("refused");
        let why = refused(&message("32FC1", 8, vec![0; 16]));
        assert!(why.contains("\"32FC1\""), "{why}");
        let why = refused(&message("mono8", 2, vec![0; 3]));
        assert!(why.contains("3 bytes"), "{why}");
        let mut large = message("mono8", 2, vec![0; 4]);
        large.width = 1 << 31;
        assert!(refused(&large).contains("2×2"));
    }
}
