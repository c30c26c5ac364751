use super::*;
use image::codecs::{jpeg::JpegEncoder, png::PngEncoder};
use image::{ExtendedColorType, ImageEncoder};
use proptest::prelude::*;

/// Decodes bytes as if they were the content of a file named `image`.
fn decode_with(white_level: u16, bytes: &[u8]) -> Result<GrayImage, String> {
    let mut image = GrayImage::default();
    let mut target = Target {
        file_bytes: bytes.len(),
        expected_px: None,
        white_level,
        samples: &mut Vec::new(),
        image: &mut image,
    };
    match target.decode(bytes) {
        Ok(()) => Ok(image),
        Err(fault) => Err(fault.within(Path::new("image")).to_string()),
    }
}

fn decode(bytes: &[u8]) -> Result<GrayImage, String> {
    decode_with(u16::MAX, bytes)
}

fn png_of(width: u32, height: u32, samples: &[u8], color: ExtendedColorType) -> Vec<u8> {
    let mut bytes = Vec::new();
    PngEncoder::new(&mut bytes)
        .write_image(samples, width, height, color)
        .expect("encoded");
    bytes
}

fn jpeg_of(width: u32, height: u32, samples: &[u8], color: ExtendedColorType) -> Vec<u8> {
    let mut bytes = Vec::new();
    JpegEncoder::new_with_quality(&mut bytes, 95)
        .encode(samples, width, height, color)
        .expect("encoded");
    bytes
}

/// A picture with structure everywhere, so that no two rows are the same.
fn pattern(width: u32, height: u32) -> Vec<u8> {
    (0..height)
        .flat_map(|y| (0..width).map(move |x| ((x * 7) ^ (y * 13)) as u8))
        .collect()
}

fn ne16(samples: &[u16]) -> Vec<u8> {
    samples.iter().flat_map(|s| s.to_ne_bytes()).collect()
}

#[test]
fn grey_png_comes_back_bit_for_bit() {
    let pixels = pattern(37, 23);
    let image = decode(&png_of(37, 23, &pixels, ExtendedColorType::L8)).expect("valid");
    assert_eq!((image.width(), image.height()), (37, 23));
    assert_eq!(image.pixels(), pixels);
}

#[test]
fn sixteen_bits_become_eight_by_rounding() {
    let samples = ne16(&[0, 128, 129, 32768, 65406, 65407, 65535]);
    let image = decode(&png_of(7, 1, &samples, ExtendedColorType::L16)).expect("valid");
    // 255/65535 = 1/257: the border lies between 128 and 129.
    assert_eq!(image.pixels(), [0, 0, 1, 128, 254, 255, 255]);
}

#[test]
fn the_white_level_is_that_of_the_camera() {
    let png = png_of(4, 1, &ne16(&[0, 2048, 4095, 65535]), ExtendedColorType::L16);
    let image = decode_with(4095, &png).expect("valid");
    assert_eq!(image.pixels(), [0, 128, 255, 255]);
    let eight_bits = png_of(2, 1, &[7, 255], ExtendedColorType::L8);
    assert_eq!(
        decode_with(4095, &eight_bits).expect("valid").pixels(),
        [7, 255]
    );
}

#[test]
fn colour_becomes_grey_with_the_weights_of_luma_and_alpha_is_ignored() {
    // 76.245, 149.685, 29.07, and 0.299·10 + 0.587·20 + 0.114·30 = 18.15.
    let grey = [76, 150, 29, 18];
    let rgb = [[255, 0, 0], [0, 255, 0], [0, 0, 255], [10, 20, 30]];
    let rgb8: Vec<u8> = rgb.concat();
    let rgba8: Vec<u8> = rgb.iter().flat_map(|p| [p[0], p[1], p[2], 3]).collect();
    let rgb16 = ne16(&rgb8.iter().map(|&v| u16::from(v) * 257).collect::<Vec<_>>());
    let rgba16 = ne16(
        &rgba8
            .iter()
            .map(|&v| u16::from(v) * 257)
            .collect::<Vec<_>>(),
    );
    let la8: Vec<u8> = grey.iter().flat_map(|&g| [g, 9]).collect();
    let la16 = ne16(&la8.iter().map(|&v| u16::from(v) * 257).collect::<Vec<_>>());
    for (samples, color) in [
        (&rgb8, ExtendedColorType::Rgb8),
        (&rgba8, ExtendedColorType::Rgba8),
        (&rgb16, ExtendedColorType::Rgb16),
        (&rgba16, ExtendedColorType::Rgba16),
        (&la8, ExtendedColorType::La8),
        (&la16, ExtendedColorType::La16),
    ] {
        let image = decode(&png_of(4, 1, samples, color)).expect("valid");
        assert_eq!(image.pixels(), grey, "{color:?}");
    }
}

/// The checksum of a chunk.
fn png_crc(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(u32::MAX, |mut crc, &byte| {
        crc ^= u32::from(byte);
        for _ in 0..8 {
            crc = (crc >> 1) ^ (0xEDB8_8320 & (crc & 1).wrapping_neg());
        }
        crc
    })
}

/// A PNG of a palette (1 bit a pixel: black and RGB 10, 20, 30), written by hand with no
/// compression, as the encoder at hand writes none.
fn palette_png() -> Vec<u8> {
    let mut png = b"\x89PNG\r\n\x1a\n".to_vec();
    let mut chunk = |name: &[u8], data: &[u8]| {
        png.extend((data.len() as u32).to_be_bytes());
        let body = [name, data].concat();
        png.extend(&body);
        png.extend(png_crc(&body).to_be_bytes());
    };
    chunk(b"IHDR", &[0, 0, 0, 4, 0, 0, 0, 1, 1, 3, 0, 0, 0]);
    chunk(b"PLTE", &[0, 0, 0, 10, 20, 30]);
    // A stored block of two bytes: filter 0, then the bits 0110; its Adler-32 follows.
    chunk(
        b"IDAT",
        &[
            0x78, 0x01, 1, 2, 0, 0xFD, 0xFF, 0, 0x60, 0x00, 0x62, 0x00, 0x61,
        ],
    );
    chunk(b"IEND", &[]);
    png
}

#[test]
fn a_palette_is_looked_up() {
    assert_eq!(
        decode(&palette_png()).expect("valid").pixels(),
        [0, 18, 18, 0]
    );
}

#[test]
fn grey_and_colour_jpeg_come_back_as_their_luma() {
    let (width, height) = (64, 48);
    let smooth: Vec<u8> = (0..width * height)
        .map(|i| (40 + (i % width) * 2 + (i / width)) as u8)
        .collect();
    let rgb: Vec<u8> = smooth.iter().flat_map(|&v| [v, v / 2, 255 - v]).collect();
    let luma: Vec<u8> = rgb
        .chunks(3)
        .map(|p| {
            let [r, g, b] = [p[0], p[1], p[2]].map(f64::from);
            (0.299 * r + 0.587 * g + 0.114 * b).round() as u8
        })
        .collect();
    for (samples, color, truth) in [
        (&smooth, ExtendedColorType::L8, &smooth),
        (&rgb, ExtendedColorType::Rgb8, &luma),
    ] {
        let image = decode(&jpeg_of(width, height, samples, color)).expect("valid");
        let worst = image
            .pixels()
            .iter()
            .zip(truth.iter())
            .map(|(a, b)| a.abs_diff(*b))
            .max();
        // Quality 95 quantises the coefficients that matter here in steps of 1 to 3.
        assert!(worst <= Some(3), "{color:?}: {worst:?}");
    }
}

#[test]
fn plain_and_binary_grey_and_pixel_maps_are_read() {
    let grey = |bytes: &[u8]| decode(bytes).map(|i| i.pixels().to_vec());
    assert_eq!(
        grey(b"P2\n# made by hand\n3 1\n255\n0 128 255\n"),
        Ok(vec![0, 128, 255])
    );
    assert_eq!(grey(b"P5\n3 1\n255\n\x00\x80\xff"), Ok(vec![0, 128, 255]));
    assert_eq!(grey(b"P5 2 1 65535\n\x80\x00\xff\xff"), Ok(vec![128, 255]));
    assert_eq!(grey(b"P2 2 1 65535 32768 65535"), Ok(vec![128, 255]));
    assert_eq!(grey(b"P3 1 1 255 10 20 30"), Ok(vec![18]));
    assert_eq!(grey(b"P6 1 1 255\n\x0a\x14\x1e"), Ok(vec![18]));
    // The file's own white counts, whatever the camera's.
    let twelve_bits = b"P5 2 1 4095\n\x08\x00\x0f\xff";
    assert_eq!(grey(twelve_bits), Ok(vec![128, 255]));
    let image = decode_with(1023, twelve_bits).expect("valid");
    assert_eq!(image.pixels(), [128, 255]);
}

#[test]
fn a_file_that_is_no_image_says_so_in_one_sentence() {
    assert_eq!(
        decode(b"GIF89a"),
        Err("image: is not a PNG, JPEG, PGM or PPM image".to_owned())
    );
    let mut image = GrayImage::default();
    let mut decoder = Decoder::default();
    let missing = decoder.decode(Path::new("no/such.png"), None, &mut image);
    let text = missing.expect_err("missing").to_string();
    assert!(
        text.starts_with("no/such.png: cannot be read: No such file"),
        "{text}"
    );
    let dir = tempfile::tempdir().expect("a folder");
    let empty = dir.path().join("empty.png");
    std::fs::write(&empty, "").expect("written");
    let text = decoder
        .decode(&empty, None, &mut image)
        .expect_err("empty")
        .to_string();
    assert!(text.ends_with("empty.png: the file is empty"), "{text}");
    let folder = decoder.decode(dir.path(), None, &mut image);
    assert!(matches!(folder, Err(DecodeError::NotAFile { .. })));
}

#[test]
fn a_header_that_promises_too_much_is_refused_before_memory_is_taken() {
    for header in ["P5 16385 1 255\n", "P6 16384 16384 65535\n"] {
        let text = decode(header.as_bytes()).expect_err("too large");
        assert!(text.ends_with("px are more than can be decoded"), "{text}");
    }
    let zero = decode(b"P5 0 4 255\n").expect_err("no pixel");
    assert!(zero.contains("is damaged"), "{zero}");
}

/// Both headers are within the limits of images, but what should follow cannot fit into so few bytes.
#[test]
fn a_header_without_its_image_takes_no_memory() {
    let (width, height) = (MAX_SIDE_PX, MAX_SIDE_PX);
    let mut image = GrayImage::default();
    let tiny = png_of(8, 8, &pattern(8, 8), ExtendedColorType::L8);
    let mut png = tiny.clone();
    png[16..20].copy_from_slice(&width.to_be_bytes());
    png[20..24].copy_from_slice(&height.to_be_bytes());
    let crc = png_crc(&png[12..29]);
    png[29..33].copy_from_slice(&crc.to_be_bytes());
    let pgm = format!("P5\n{width} {height}\n65535\n").into_bytes();
    for bytes in [png, pgm] {
        let decoded = Decoder::default().decode_bytes("image", &bytes, None, &mut image);
        let why = decoded.expect_err("no image").to_string();
        assert!(why.contains("ends before the image does"), "{why}");
        assert_eq!(image.pixels().len(), 0);
    }
    // All black, and as short as the format allows.
    let black = png_of(2048, 2048, &vec![0; 2048 * 2048], ExtendedColorType::L8);
    assert!(decode(&black).is_ok(), "{} bytes", black.len());
}

#[test]
fn a_file_longer_than_any_image_is_refused_unread() {
    let dir = tempfile::tempdir().expect("a folder");
    let file = dir.path().join("long.png");
    // A hole: no disk is taken.
    let made = File::create(&file).and_then(|f| f.set_len(MAX_FILE_BYTES + 1));
    made.expect("a sparse file");
    let result = Decoder::default().decode(&file, None, &mut GrayImage::default());
    assert!(matches!(result, Err(DecodeError::FileTooLong { .. })));
}

#[test]
fn another_size_than_expected_is_named() {
    let dir = tempfile::tempdir().expect("a folder");
    let file = dir.path().join("small.png");
    let png = png_of(4, 2, &[0; 8], ExtendedColorType::L8);
    std::fs::write(&file, png).expect("written");
    let mut decoder = Decoder::default();
    let wrong = decoder.decode(&file, Some((8, 2)), &mut GrayImage::default());
    let text = wrong.expect_err("another size").to_string();
    assert!(
        text.ends_with("small.png: the image has 4×2 px, but the rig's 8×2"),
        "{text}"
    );
    assert_eq!(decoder.size_px(&file).expect("a header"), (4, 2));
}

#[test]
fn the_end_of_a_thumbnail_is_not_the_end_of_the_image() {
    let pixels = pattern(64, 64);
    let whole = jpeg_of(64, 64, &pixels, ExtendedColorType::L8);
    // An application segment that holds a whole image, behind the start marker.
    let thumbnail = jpeg_of(8, 8, &pixels[..64], ExtendedColorType::L8);
    let length = (thumbnail.len() as u16 + 2).to_be_bytes();
    let segment = [&[0xFF, 0xED][..], &length, &thumbnail].concat();
    let with = [&whole[..2], &segment, &whole[2..]].concat();
    assert_eq!(decode(&with), decode(&whole));
    let cut = decode(&with[..with.len() - whole.len() / 4]);
    assert_eq!(
        cut,
        Err("image: the file ends before the image does".to_owned())
    );
}

#[test]
fn bytes_behind_the_end_of_a_jpeg_do_no_harm() {
    let whole = jpeg_of(32, 32, &pattern(32, 32), ExtendedColorType::L8);
    let padded = [whole.as_slice(), &[0; 512]].concat();
    assert_eq!(decode(&padded), decode(&whole));
}

/// Every cut of a file is refused, unless only what follows the pixels is missing.
fn assert_no_cut_passes(whole: &[u8]) {
    let image = decode(whole).expect("valid");
    for length in 1..whole.len() {
        match decode(&whole[..length]) {
            Err(_) => {}
            Ok(cut) => assert_eq!(cut, image, "{length} of {} bytes", whole.len()),
        }
    }
    let half = decode(&whole[..whole.len() / 2]).expect_err("half of it is missing");
    assert_eq!(half, "image: the file ends before the image does");
}

#[test]
fn a_truncated_file_never_passes_for_another_picture() {
    let pixels = pattern(48, 40);
    let rgb: Vec<u8> = pixels.iter().flat_map(|&v| [v, v / 2, 255 - v]).collect();
    assert_no_cut_passes(&png_of(48, 40, &pixels, ExtendedColorType::L8));
    assert_no_cut_passes(&png_of(48, 40, &rgb, ExtendedColorType::Rgb8));
    assert_no_cut_passes(&jpeg_of(48, 40, &pixels, ExtendedColorType::L8));
    assert_no_cut_passes(&jpeg_of(48, 40, &rgb, ExtendedColorType::Rgb8));
    assert_no_cut_passes(&[b"P5 48 40 255\n", pixels.as_slice()].concat());
    assert_no_cut_passes(&[b"P6 48 40 255\n", rgb.as_slice()].concat());
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(300))]

    #[test]
    fn damaged_bytes_never_panic(
        kind in 0..4_usize,
        hits in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..6),
    ) {
        let pixels = pattern(24, 16);
        let mut bytes = match kind {
            0 => png_of(24, 16, &pixels, ExtendedColorType::L8),
            1 => jpeg_of(24, 16, &pixels, ExtendedColorType::L8),
            2 => [b"P5 24 16 255\n", pixels.as_slice()].concat(),
            _ => b"P2 4 2 255 1 2 3 4 5 6 7 8".to_vec(),
        };
        for (at, value) in hits {
            let at = at.index(bytes.len());
            bytes[at] = value;
        }
        if let Err(text) = decode(&bytes) {
            prop_assert!(!text.contains('\n'), "{text}");
        }
    }
}
