//! Small recordings in every layout and encoding, written for a test; and where the real ones are.

use image::codecs::{jpeg::JpegEncoder, png::PngEncoder};
use image::{ExtendedColorType, ImageEncoder};
use std::path::{Path, PathBuf};
use visod::capture::dataset::{Dataset, Layout};

/// Width of every written image, px.
pub(crate) const WIDTH: u32 = 48;
/// Height of every written image, px.
pub(crate) const HEIGHT: u32 = 32;

/// Stamps of a EuRoC recording begin here, ns: more digits than an f64 has.
const EUROC_START_NS: i64 = 1_403_715_273_262_142_976;

/// How images are stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Encoding {
    Png8,
    Png16,
    PngColour,
    Jpeg,
    Pgm8,
    Pgm16,
}

impl Encoding {
    pub(crate) const ALL: [Self; 6] = [
        Self::Png8,
        Self::Png16,
        Self::PngColour,
        Self::Jpeg,
        Self::Pgm8,
        Self::Pgm16,
    ];

    fn ending(self) -> &'static str {
        match self {
            Self::Png8 | Self::Png16 | Self::PngColour => "png",
            Self::Jpeg => "jpg",
            Self::Pgm8 | Self::Pgm16 => "pgm",
        }
    }

    /// By how much a pixel may come back wrong.
    pub(crate) fn loss(self) -> u8 {
        // At quality 100 coefficients are rounded to whole numbers: a grey value or two.
        if self == Self::Jpeg { 2 } else { 0 }
    }

    fn encode(self, width: u32, height: u32, pixels: &[u8]) -> Vec<u8> {
        let mut bytes = Vec::new();
        // A sample v·257 of 16 bits is v of 8.
        let wide = |order: fn(u16) -> [u8; 2]| -> Vec<u8> {
            let wide = pixels.iter().map(|&v| u16::from(v) * 257);
            wide.flat_map(order).collect()
        };
        let mut png = |samples: &[u8], color| {
            PngEncoder::new(&mut bytes).write_image(samples, width, height, color)
        };
        match self {
            Self::Png8 => png(pixels, ExtendedColorType::L8).expect("encoded"),
            Self::Png16 => png(&wide(u16::to_ne_bytes), ExtendedColorType::L16).expect("encoded"),
            Self::PngColour => {
                let rgb: Vec<u8> = pixels.iter().flat_map(|&v| [v; 3]).collect();
                png(&rgb, ExtendedColorType::Rgb8).expect("encoded");
            }
            Self::Jpeg => JpegEncoder::new_with_quality(&mut bytes, 100)
                .encode(pixels, width, height, ExtendedColorType::L8)
                .expect("encoded"),
            Self::Pgm8 => {
                bytes = format!("P5\n{width} {height}\n255\n").into_bytes();
                bytes.extend(pixels);
            }
            Self::Pgm16 => {
                bytes = format!("P5\n{width} {height}\n65535\n").into_bytes();
                bytes.extend(wide(u16::to_be_bytes));
            }
        }
        bytes
    }
}

/// The pixels of image `sequence` of side 0 or 1: no two are the same.
pub(crate) fn picture(sequence: u64, side: u32) -> Vec<u8> {
    let base = 20 + sequence as u32 * 5 + side * 60;
    let pixels = (0..HEIGHT).flat_map(|y| (0..WIDTH).map(move |x| (base + x + y) as u8));
    pixels.collect()
}

/// A recording in a folder that goes with it.
pub(crate) struct Recording {
    dir: tempfile::TempDir,
    layout: Layout,
    encoding: Encoding,
}

impl Recording {
    /// Writes `count` pairs, a millisecond apart.
    pub(crate) fn write(layout: Layout, encoding: Encoding, count: u64) -> Self {
        let dir = tempfile::tempdir().expect("a folder");
        let recording = Self {
            dir,
            layout,
            encoding,
        };
        for side in [0, 1] {
            let folder = recording.file(0, side);
            std::fs::create_dir_all(folder.parent().expect("a folder")).expect("made");
            for sequence in 0..count {
                let bytes = encoding.encode(WIDTH, HEIGHT, &picture(sequence, side));
                recording.overwrite(sequence, side, &bytes);
            }
        }
        recording.write_calibration();
        if layout != Layout::Euroc {
            let times = (0..count).map(|n| format!("{:.9}\n", n as f64 * 1e-3));
            recording.put("times.txt", &times.collect::<String>());
        }
        recording
    }

    fn put(&self, name: &str, text: &str) {
        std::fs::write(self.path().join(name), text).expect("written");
    }

    fn write_calibration(&self) {
        let (cx, cy) = (f64::from(WIDTH - 1) / 2.0, f64::from(HEIGHT - 1) / 2.0);
        match self.layout {
            Layout::Visod => {
                let camera = format!(
                    "width = {WIDTH}\nheight = {HEIGHT}\nfocal = [40.0, 40.0]\nprincipal_point = [{cx}, {cy}]\n"
                );
                let extrinsics =
                    "translation_m = [-0.1, 0.0, 0.0]\nrotation_vector_rad = [0.0, 0.0, 0.0]\n";
                self.put(
                    "rig.toml",
                    &format!("[left]\n{camera}[right]\n{camera}[right_from_left]\n{extrinsics}"),
                );
            }
            Layout::Kitti => self.put(
                "calib.txt",
                &format!(
                    "P0: 40 0 {cx} 0 0 40 {cy} 0 0 0 1 0\nP1: 40 0 {cx} -4 0 40 {cy} 0 0 0 1 0\n"
                ),
            ),
            Layout::Euroc => {
                for (side, x) in [0.0, 0.1].into_iter().enumerate() {
                    self.put(
                        &format!("mav0/cam{side}/sensor.yaml"),
                        &format!(
                            "T_BS:\n  cols: 4\n  rows: 4\n  data: [1, 0, 0, {x}, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]\nresolution: [{WIDTH}, {HEIGHT}]\ncamera_model: pinhole\nintrinsics: [40, 40, {cx}, {cy}]\ndistortion_model: radial-tangential\ndistortion_coefficients: [0.0, 0.0, 0.0, 0.0]\n"
                        ),
                    );
                }
            }
        }
    }

    pub(crate) fn path(&self) -> &Path {
        self.dir.path()
    }

    pub(crate) fn open(&self) -> Dataset {
        Dataset::open(self.path(), None).expect("a recording")
    }

    /// When pair `sequence` was taken, ns.
    pub(crate) fn stamp_ns(&self, sequence: u64) -> i64 {
        let since_start_ns = sequence as i64 * 1_000_000;
        match self.layout {
            // Far enough apart for the tolerance of pairing.
            Layout::Euroc => EUROC_START_NS + since_start_ns * 50,
            _ => since_start_ns,
        }
    }

    /// The name that both images of a pair have.
    pub(crate) fn name(&self, sequence: u64) -> String {
        let ending = self.encoding.ending();
        match self.layout {
            Layout::Euroc => format!("{}.{ending}", self.stamp_ns(sequence)),
            _ => format!("{sequence:06}.{ending}"),
        }
    }

    fn file(&self, sequence: u64, side: u32) -> PathBuf {
        let folder = match (self.layout, side) {
            (Layout::Visod, 0) => "left",
            (Layout::Visod, _) => "right",
            (Layout::Kitti, 0) => "image_0",
            (Layout::Kitti, _) => "image_1",
            (Layout::Euroc, 0) => "mav0/cam0/data",
            (Layout::Euroc, _) => "mav0/cam1/data",
        };
        self.path().join(folder).join(self.name(sequence))
    }

    /// Removes an image.
    pub(crate) fn remove(&self, sequence: u64, side: u32) {
        std::fs::remove_file(self.file(sequence, side)).expect("removed");
    }

    /// Cuts an image's file in half.
    pub(crate) fn truncate(&self, sequence: u64, side: u32) {
        let bytes = std::fs::read(self.file(sequence, side)).expect("read");
        self.overwrite(sequence, side, &bytes[..bytes.len() / 2]);
    }

    /// Puts an image of half the width in an image's place.
    pub(crate) fn resize(&self, sequence: u64, side: u32) {
        let (width, height) = (WIDTH / 2, HEIGHT);
        let pixels = vec![90; width as usize * height as usize];
        self.overwrite(
            sequence,
            side,
            &self.encoding.encode(width, height, &pixels),
        );
    }

    /// Puts other bytes in an image's place.
    pub(crate) fn overwrite(&self, sequence: u64, side: u32, bytes: &[u8]) {
        std::fs::write(self.file(sequence, side), bytes).expect("written");
    }
}

/// The folder of a real recording, where it is there.
pub(crate) fn test_recording(name: &str) -> Option<PathBuf> {
    let beside = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data");
    let data = std::env::var_os("VISOD_TEST_DATA").map_or(beside, PathBuf::from);
    let path = Some(data.join(name)).filter(|path| path.is_dir());
    if path.is_none() {
        println!("skipped: the test recording {name} is not there");
    }
    path
}
