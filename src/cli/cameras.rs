//! `visod cameras`: what Aravis and V4L2 see.

use super::Failure;

/// List the cameras of this machine and its networks, with what they can do.
///
/// The first column is what `id` of `[camera.left]` or `[camera.right]` takes.
#[derive(clap::Args)]
#[command(after_help = "Example: visod cameras --details")]
pub(crate) struct Args {
    /// Open each camera and say what it can do; one that is in use stays closed.
    #[arg(long)]
    details: bool,
    /// Print as JSON.
    #[arg(long)]
    json: bool,
}

/// All cameras, by driver.
#[derive(Default, serde::Serialize)]
struct Seen {
    #[cfg(feature = "aravis")]
    aravis: Vec<aravis::Seen>,
    #[cfg(feature = "v4l")]
    v4l2: Vec<crate::capture::v4l2::Found>,
    /// Drivers that this visod was built without.
    not_built: Vec<&'static str>,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let seen = look(args.details);
    if args.json {
        let text = serde_json::to_string_pretty(&seen).map_err(Failure::other)?;
        println!("{text}");
    } else {
        print!("{}", text(&seen));
    }
    Ok(())
}

fn look(details: bool) -> Seen {
    let mut not_built = Vec::new();
    for (driver, is_built) in [
        ("aravis", cfg!(feature = "aravis")),
        ("v4l2", cfg!(feature = "v4l")),
    ] {
        if !is_built {
            not_built.push(driver);
        }
    }
    let _ = details;
    Seen {
        #[cfg(feature = "aravis")]
        aravis: aravis::look(details),
        #[cfg(feature = "v4l")]
        v4l2: crate::capture::v4l2::list(),
        not_built,
    }
}

fn text(seen: &Seen) -> String {
    let mut lines = Vec::new();
    #[cfg(feature = "aravis")]
    lines.extend(seen.aravis.iter().map(aravis::Seen::text));
    #[cfg(feature = "v4l")]
    lines.extend(seen.v4l2.iter().map(crate::capture::v4l2::Found::text));
    if lines.is_empty() {
        lines.push("no cameras\n".to_owned());
    }
    for driver in &seen.not_built {
        lines.push(format!("(this visod was built without {driver})\n"));
    }
    lines.concat()
}

#[cfg(feature = "aravis")]
mod aravis {
    use crate::capture::aravis::discovery::{Details, Found, details, list};
    use std::fmt::Write;

    /// A camera with what it can do, where that was asked for.
    #[derive(serde::Serialize)]
    pub(super) struct Seen {
        #[serde(flatten)]
        found: Found,
        #[serde(skip_serializing_if = "Option::is_none")]
        details: Option<Details>,
    }

    pub(super) fn look(with_details: bool) -> Vec<Seen> {
        let seen = list().into_iter().map(|found| Seen {
            details: with_details.then(|| details(&found)),
            found,
        });
        seen.collect()
    }

    impl Seen {
        pub(super) fn text(&self) -> String {
            let f = &self.found;
            let mut text = format!(
                "{}  aravis  {} {}, serial number {}, {} at {}\n",
                f.id, f.vendor, f.model, f.serial, f.protocol, f.address
            );
            let Some(d) = &self.details else {
                return text;
            };
            let range = |range: Option<(f64, f64)>, unit: &str| {
                range.map_or("-".to_owned(), |(least, most)| {
                    format!("{least} to {most} {unit}")
                })
            };
            // Writing to a String cannot fail.
            if let Some(cause) = &d.cause {
                let _ = writeln!(text, "  {cause}");
                return text;
            }
            let (width, height) = d.sensor_px.unwrap_or_default();
            let _ = writeln!(text, "  sensor: {width}×{height} px");
            let _ = writeln!(text, "  pixel formats: {}", d.pixel_formats.join(", "));
            let _ = writeln!(text, "  frame rate: {}", range(d.frame_rate_hz, "Hz"));
            let _ = writeln!(
                text,
                "  exposure: {}{}",
                range(d.exposure_us, "µs"),
                if d.has_auto_exposure {
                    ", or automatic"
                } else {
                    ""
                }
            );
            let _ = writeln!(text, "  gain: {}", range(d.gain, ""));
            let _ = writeln!(text, "  triggers: {}", d.trigger_sources.join(", "));
            let _ = writeln!(text, "  PTP: {}", if d.has_ptp { "yes" } else { "no" });
            text
        }
    }
}
