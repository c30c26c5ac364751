//! `visod features`: an image in, its SURF keypoints and descriptors as CSV out.

use super::Failure;
use crate::capture::decode::Decoder;
use crate::features::surf::{Settings, Surf};
use crate::features::{Extractor, Features};
use crate::image::GrayImage;
use std::io::Write;
use std::path::{Path, PathBuf};

/// Find and describe the SURF keypoints of one image.
///
/// Writes CSV with the columns x, y, size (px), angle (degrees from the x axis towards the y axis,
/// down), response, octave, class_id (sign of the Laplacian), d0, d1, …: one row a keypoint, the
/// strongest first. All keypoints above the threshold are written.
#[derive(clap::Args)]
#[command(after_help = "Example: visod features left.png -o features.csv --hessian 200")]
pub(crate) struct Args {
    /// The image: PNG, JPEG, PGM or PPM, grey or colour.
    image: PathBuf,
    /// The CSV file to write; `-` for standard output.
    #[arg(short, long, default_value = "-", value_name = "F.csv")]
    output: PathBuf,
    /// Determinant of the Hessian that a keypoint exceeds.
    #[arg(
        long,
        default_value_t = 400.0,
        value_name = "DETERMINANT",
        allow_negative_numbers = true
    )]
    hessian: f32,
    /// Octaves, each with half the samples of the one before.
    #[arg(long, default_value_t = 4)]
    octaves: u32,
    /// Layers an octave in which keypoints are found.
    #[arg(long, default_value_t = 3)]
    layers: usize,
    /// 128 floats a descriptor instead of 64.
    #[arg(long)]
    extended: bool,
    /// No orientation.
    #[arg(long)]
    upright: bool,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let settings = Settings {
        hessian: args.hessian,
        octaves: args.octaves,
        layers: args.layers,
        extended: args.extended,
        upright: args.upright,
        budget: 0,
        ..Settings::default()
    };
    let mut surf =
        Surf::new(settings).map_err(|e| Failure::usage(format!("--{} {}", e.key, e.cause)))?;
    let mut image = GrayImage::default();
    Decoder::new(u16::MAX)
        .decode(&args.image, None, &mut image)
        .map_err(Failure::other)?;
    let mut features = Features::default();
    surf.extract(&image, &mut features)
        .map_err(Failure::other)?;
    write(&features, &args.output)
}

fn write(features: &Features, path: &Path) -> Result<(), Failure> {
    let fail =
        |e: std::io::Error| Failure::other(format!("{}: cannot be written: {e}", path.display()));
    if path == Path::new("-") {
        let stdout = std::io::stdout().lock();
        let mut out = std::io::BufWriter::new(stdout);
        return match write_csv(features, &mut out).and_then(|()| out.flush()) {
            // Who reads has read enough, as `head` does.
            Err(e) if e.kind() == std::io::ErrorKind::BrokenPipe => Ok(()),
            result => result.map_err(|e| Failure::other(format!("standard output: {e}"))),
        };
    }
    let mut out = std::io::BufWriter::new(std::fs::File::create(path).map_err(fail)?);
    write_csv(features, &mut out)
        .and_then(|()| out.flush())
        .map_err(fail)
}

fn write_csv(features: &Features, out: &mut impl Write) -> std::io::Result<()> {
    write!(out, "x,y,size,angle,response,octave,class_id")?;
    (0..features.descriptor_len).try_for_each(|n| write!(out, ",d{n}"))?;
    writeln!(out)?;
    for (n, keypoint) in features.keypoints.iter().enumerate() {
        write!(
            out,
            "{},{},{},{},{},{},{}",
            Digits9(keypoint.x_px),
            Digits9(keypoint.y_px),
            Digits9(keypoint.size_px),
            Digits9(keypoint.angle_rad.to_degrees()),
            Digits9(keypoint.response),
            keypoint.octave,
            keypoint.laplacian
        )?;
        let mut descriptor = features.descriptor(n).iter();
        descriptor.try_for_each(|&d| write!(out, ",{}", Digits9(d)))?;
        writeln!(out)?;
    }
    Ok(())
}

/// A float with nine significant digits, enough to read the same float back, without trailing
/// zeros; below 1e-4 and from 1e9 on with an exponent of two digits.
struct Digits9(f32);

impl std::fmt::Display for Digits9 {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let scientific = format!("{:.8e}", self.0);
        let Some((mantissa, exponent)) = scientific.split_once('e') else {
            return f.write_str(&scientific); // not a finite number
        };
        let exponent: i32 = exponent.parse().map_err(|_| std::fmt::Error)?;
        let shorten = |digits: &str| -> String {
            let digits = digits.trim_end_matches('0');
            digits.trim_end_matches('.').to_owned()
        };
        if !(-4..9).contains(&exponent) {
            let sign = if exponent < 0 { '-' } else { '+' };
            return write!(f, "{}e{sign}{:02}", shorten(mantissa), exponent.abs());
        }
        let decimals = (8 - exponent) as usize;
        let plain = format!("{:.decimals$}", self.0);
        if decimals == 0 {
            return f.write_str(&plain);
        }
        f.write_str(&shorten(&plain))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_have_nine_digits_and_no_trailing_zeros() {
        let text = |v: f32| Digits9(v).to_string();
        assert_eq!(text(20.0), "20");
        assert_eq!(text(0.0), "0");
        assert_eq!(text(262.684_2), "262.684204");
        assert_eq!(text(12_369.344), "12369.3438");
        assert_eq!(text(4.311_815e-5), "4.31181506e-05");
        assert_eq!(text(-0.004_582_186_7), "-0.0045821867");
        assert_eq!(text(100_000_000.0), "100000000");
        assert_eq!(text(1e12), "9.99999996e+11");
    }
}
