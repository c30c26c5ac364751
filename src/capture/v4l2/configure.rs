//! A video device and the settings of a camera in; the device set up, and what it was set to, out.

use super::of_io;
use crate::capture::camera::CameraError;
use crate::capture::pixels::PixelLayout;
use crate::capture::settings::{CameraSettings, ControlValue, Trigger};
use v4l::control::{Control, Description, MenuItem, Value};
use v4l::video::Capture;
use v4l::{Device, Format, FourCC};

/// Formats in the order in which they are chosen where none is asked for.
const PREFERRED_FORMATS: [&str; 12] = [
    "GREY", "Y12 ", "Y10 ", "Y16 ", "RGGB", "GRBG", "GBRG", "BA81", "YUYV", "UYVY", "MJPG", "RGB3",
];
/// Identifiers of standard controls (linux/v4l2-controls.h).
const EXPOSURE_AUTO: u32 = 0x009A_0901;
const EXPOSURE_ABSOLUTE: u32 = 0x009A_0902;
const AUTO_GAIN: u32 = 0x0098_0912;
const GAIN: u32 = 0x0098_0913;
/// The entry of `EXPOSURE_AUTO` that switches it off, and the unit of `EXPOSURE_ABSOLUTE`, ms.
const EXPOSURE_MANUAL: i64 = 1;
const EXPOSURE_UNIT_MS: f64 = 0.1;

/// What a device was set to.
#[derive(Debug)]
pub(super) struct Configured {
    pub(super) size_px: (u32, u32),
    pub(super) layout: PixelLayout,
    /// Bytes a row; 0 where rows have no padding.
    pub(super) stride: usize,
}

fn unsuitable(name: &str, text: impl std::fmt::Display) -> CameraError {
    CameraError::Unsuitable(format!("{name}: {text}"))
}

/// Sets the device up.
pub(super) fn apply(
    device: &Device,
    settings: &CameraSettings,
    size_px: (u32, u32),
) -> Result<Configured, CameraError> {
    let name = &settings.id;
    if settings.trigger != Trigger::Free {
        return Err(unsuitable(
            name,
            "triggers of V4L2 cameras are set by `controls`, if they have any: trigger must be free",
        ));
    }
    if settings.offset_px != [0, 0] {
        return Err(unsuitable(name, "offset_px is for Aravis only"));
    }
    let configured = set_format(device, settings, size_px)?;
    set_frame_rate(device, settings)?;
    let controls = device.query_controls().unwrap_or_default();
    set_exposure(device, settings, &controls)?;
    set_gain(device, settings, &controls)?;
    for (control, value) in &settings.controls {
        set_by_name(device, name, &controls, control, value)?;
    }
    Ok(configured)
}

fn set_format(
    device: &Device,
    settings: &CameraSettings,
    (width, height): (u32, u32),
) -> Result<Configured, CameraError> {
    let name = &settings.id;
    let offered: Vec<String> = device
        .enum_formats()
        .map_err(|e| of_io(name, "its formats cannot be listed", &e))?
        .iter()
        .map(|format| format.fourcc.to_string())
        .collect();
    let wanted = match &settings.pixel_format {
        // Trailing spaces are part of a format's name that nobody types.
        Some(wanted) => offered
            .iter()
            .find(|own| own.trim_end() == wanted.trim_end())
            .ok_or_else(|| {
                unsuitable(
                    name,
                    format_args!("has no pixel format {wanted}; it has {}", usable(&offered)),
                )
            })?,
        None => PREFERRED_FORMATS
            .iter()
            .find_map(|wanted| offered.iter().find(|own| own == wanted))
            .ok_or_else(|| {
                unsuitable(
                    name,
                    format_args!(
                        "has no pixel format that can be turned into grey, only {}",
                        offered.join(", ")
                    ),
                )
            })?,
    };
    let layout = PixelLayout::of_fourcc(wanted).ok_or_else(|| {
        unsuitable(
            name,
            format_args!("its pixel format {wanted} cannot be turned into grey"),
        )
    })?;
    let fourcc = fourcc_of(wanted);
    let set = device
        .set_format(&Format::new(width, height, fourcc))
        .map_err(|e| of_io(name, "its format cannot be set", &e))?;
    if (set.width, set.height) != (width, height) {
        return Err(unsuitable(
            name,
            format_args!(
                "gives {}×{} px instead of the rig's {width}×{height}",
                set.width, set.height
            ),
        ));
    }
    if set.fourcc != fourcc {
        return Err(unsuitable(
            name,
            format_args!("gives {} instead of {wanted}", set.fourcc),
        ));
    }
    Ok(Configured {
        size_px: (width, height),
        layout,
        stride: set.stride as usize,
    })
}

/// Those of the formats that can be turned into grey, for people.
fn usable(offered: &[String]) -> String {
    let usable = offered
        .iter()
        .filter(|f| PixelLayout::of_fourcc(f).is_some());
    let names: Vec<&str> = usable.map(|format| format.trim_end()).collect();
    if names.is_empty() {
        return "none that can be turned into grey".to_owned();
    }
    names.join(", ")
}

fn fourcc_of(text: &str) -> FourCC {
    let mut characters = [b' '; 4];
    for (own, given) in characters.iter_mut().zip(text.bytes()) {
        *own = given;
    }
    FourCC::new(&characters)
}

fn set_frame_rate(device: &Device, settings: &CameraSettings) -> Result<(), CameraError> {
    let (name, Some(rate_hz)) = (&settings.id, settings.frame_rate_hz) else {
        return Ok(());
    };
    let interval = v4l::Fraction::new(1000, (rate_hz * 1000.0).round() as u32);
    let wanted = v4l::video::capture::Parameters::new(interval);
    let set = device
        .set_params(&wanted)
        .map_err(|_| unsuitable(name, "its frame rate cannot be set"))?;
    let set_hz = f64::from(set.interval.denominator) / f64::from(set.interval.numerator.max(1));
    if (set_hz / rate_hz - 1.0).abs() > 0.01 {
        return Err(unsuitable(
            name,
            format_args!("gives {set_hz:.3} frames a second instead of {rate_hz}"),
        ));
    }
    Ok(())
}

fn set(device: &Device, id: u32, value: i64) -> std::io::Result<()> {
    device.set_control(Control {
        id,
        value: Value::Integer(value),
    })
}

/// Video4Linux knows no ceiling of automatic exposure: it is fixed at the ceiling, and the gain left
/// to the camera.
fn set_exposure(
    device: &Device,
    settings: &CameraSettings,
    controls: &[Description],
) -> Result<(), CameraError> {
    let name = &settings.id;
    let Some(control) = controls.iter().find(|c| c.id == EXPOSURE_ABSOLUTE) else {
        return match settings.exposure_ms {
            Some(_) => Err(unsuitable(name, "its exposure cannot be set")),
            None => Ok(()),
        };
    };
    let wanted_ms = settings.exposure_ms.unwrap_or(settings.exposure_max_ms);
    let value = (wanted_ms / EXPOSURE_UNIT_MS).round() as i64;
    if settings.exposure_ms.is_some() && !(control.minimum..=control.maximum).contains(&value) {
        return Err(unsuitable(
            name,
            format_args!(
                "its exposure goes from {} to {} ms, not to {wanted_ms}",
                control.minimum as f64 * EXPOSURE_UNIT_MS,
                control.maximum as f64 * EXPOSURE_UNIT_MS
            ),
        ));
    }
    if controls.iter().any(|c| c.id == EXPOSURE_AUTO) {
        set(device, EXPOSURE_AUTO, EXPOSURE_MANUAL)
            .map_err(|e| of_io(name, "its automatic exposure cannot be switched off", &e))?;
    }
    set(
        device,
        EXPOSURE_ABSOLUTE,
        value.clamp(control.minimum, control.maximum),
    )
    .map_err(|e| of_io(name, "its exposure cannot be set", &e))
}

fn set_gain(
    device: &Device,
    settings: &CameraSettings,
    controls: &[Description],
) -> Result<(), CameraError> {
    let name = &settings.id;
    let automatic = controls.iter().find(|c| c.id == AUTO_GAIN);
    if let Some(automatic) = automatic {
        let value = Value::Boolean(settings.gain.is_none());
        device
            .set_control(Control {
                id: automatic.id,
                value,
            })
            .map_err(|e| of_io(name, "its automatic gain cannot be set", &e))?;
    }
    let Some(gain) = settings.gain else {
        return Ok(());
    };
    let control = controls
        .iter()
        .find(|c| c.id == GAIN)
        .ok_or_else(|| unsuitable(name, "its gain cannot be set"))?;
    let value = gain.round() as i64;
    if !(control.minimum..=control.maximum).contains(&value) {
        return Err(unsuitable(
            name,
            format_args!(
                "its gain goes from {} to {}, not to {gain}",
                control.minimum, control.maximum
            ),
        ));
    }
    set(device, GAIN, value).map_err(|e| of_io(name, "its gain cannot be set", &e))
}

/// The form in which control names are compared: `Exposure, Auto` is `exposure_auto`.
fn plain(name: &str) -> String {
    let words = name.split(|c: char| !c.is_ascii_alphanumeric());
    let words: Vec<String> = words
        .filter(|w| !w.is_empty())
        .map(str::to_ascii_lowercase)
        .collect();
    words.join("_")
}

fn set_by_name(
    device: &Device,
    camera: &str,
    controls: &[Description],
    name: &str,
    value: &ControlValue,
) -> Result<(), CameraError> {
    let wanted = plain(name);
    let control = controls
        .iter()
        .find(|c| plain(&c.name) == wanted)
        .ok_or_else(|| {
            let there: Vec<String> = controls.iter().map(|c| plain(&c.name)).collect();
            unsuitable(
                camera,
                format_args!("has no control {name}; it has {}", there.join(", ")),
            )
        })?;
    let refused = |why: String| {
        unsuitable(
            camera,
            format_args!("its control {name} cannot be set to {value}: {why}"),
        )
    };
    let value = match value {
        ControlValue::Switch(v) => Value::Boolean(*v),
        ControlValue::Integer(v) => Value::Integer(*v),
        ControlValue::Float(v) => Value::Integer(v.round() as i64),
        ControlValue::Word(v) => Value::Integer(
            entry(control, v).ok_or_else(|| refused("it has no such entry".to_owned()))?,
        ),
    };
    device
        .set_control(Control {
            id: control.id,
            value,
        })
        .map_err(|e| refused(e.to_string()))
}

/// The number of a menu's entry.
fn entry(control: &Description, word: &str) -> Option<i64> {
    let items = control.items.as_ref()?;
    let found = items.iter().find(|(_, item)| match item {
        MenuItem::Name(name) => plain(name) == plain(word),
        MenuItem::Value(value) => value.to_string() == word,
    });
    found.map(|(index, _)| i64::from(*index))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_compared_without_case_and_punctuation() {
        assert_eq!(plain("Exposure Time, Absolute"), "exposure_time_absolute");
        assert_eq!(plain("white_balance_automatic"), "white_balance_automatic");
        assert_eq!(fourcc_of("Y16"), FourCC::new(b"Y16 "));
    }
}
