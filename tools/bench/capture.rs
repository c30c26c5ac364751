//! How long it takes to get an image out of a file, or out of a buffer: `cargo bench --bench capture`.
//!
//! One thread, a simulated image of 1280 × 960 px and one of KITTI's where that recording is there.

mod common;

use common::memory::Recording;
use common::{Times, head, line};
use image::{ColorType, ImageEncoder};
use visod::capture::decode::Decoder;
use visod::image::GrayImage;
use visod::simulation::thesis_rig;

const RUNS: usize = 60;

type Outcome = Result<(), Box<dyn std::error::Error>>;

fn main() -> Outcome {
    head("Capture: one image, one thread");
    let simulated = Recording::simulated(thesis_rig(), 1);
    measure("1280 × 960", &simulated.pairs[0].left)?;
    if let Some(kitti) = Recording::recorded("kitti_straight", 1) {
        let image = &kitti.pairs[0].left;
        measure(
            &format!("KITTI, {} × {}", image.width(), image.height()),
            image,
        )?;
    }
    Ok(())
}

fn measure(name: &str, image: &GrayImage) -> Outcome {
    let mut copy = GrayImage::default();
    let copying = Times::of(RUNS, || {
        copy.reshape(image.width(), image.height());
        copy.pixels_mut()
            .copy_from_slice(std::hint::black_box(image.pixels()));
    });
    line(&format!("{name}: copy from a buffer"), &copying, "");
    let folder = tempfile::tempdir()?;
    for ending in ["pgm", "png", "jpg"] {
        let file = folder.path().join("image").with_extension(ending);
        std::fs::write(&file, encoded(image, ending)?)?;
        let mut decoder = Decoder::default();
        let mut decoded = GrayImage::default();
        decoder.decode(&file, None, &mut decoded)?;
        assert!(
            ending == "jpg" || &decoded == image,
            "{ending} loses nothing"
        );
        let times = Times::of(RUNS, || {
            assert!(decoder.decode(&file, None, &mut decoded).is_ok());
        });
        let kib = std::fs::metadata(&file)?.len() / 1024;
        line(
            &format!("{name}: read {ending}"),
            &times,
            &format!("{kib} KiB"),
        );
    }
    Ok(())
}

fn encoded(image: &GrayImage, ending: &str) -> Result<Vec<u8>, Box<dyn std::error::Error>> {
    let (width, height) = (image.width(), image.height());
    let mut bytes = Vec::new();
    match ending {
        "png" => image::codecs::png::PngEncoder::new(&mut bytes).write_image(
            image.pixels(),
            width,
            height,
            ColorType::L8.into(),
        )?,
        "jpg" => image::codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, 90).write_image(
            image.pixels(),
            width,
            height,
            ColorType::L8.into(),
        )?,
        _ => {
            bytes.extend_from_slice(format!("P5\n{width} {height}\n255\n").as_bytes());
            bytes.extend_from_slice(image.pixels());
        }
    }
    Ok(bytes)
}
