//! Image files.

use super::sentence;
use visod::capture::decode::{Decoder, MAX_SIDE_PX};
use visod::image::GrayImage;

/// Any bytes are an image within the limits, or refused.
pub fn run(data: &[u8]) {
    let mut decoder = Decoder::new(4095);
    let mut image = GrayImage::default();
    for expected in [None, Some((16, 16))] {
        match decoder.decode_bytes("image", data, expected, &mut image) {
            Ok(()) => {
                assert!(image.width().max(image.height()) <= MAX_SIDE_PX);
                assert_eq!(
                    image.pixels().len(),
                    image.width() as usize * image.height() as usize
                );
                assert!(expected.is_none_or(|size| size == (image.width(), image.height())));
            }
            Err(why) => sentence::check(&why.to_string()),
        }
    }
}
