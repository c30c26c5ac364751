//! A camera and its settings in; the camera set up, and what it was set to, out.
//!
//! What is asked for is done or refused; what is not asked for is done where the camera can. Whether a
//! camera has a feature is always asked, never assumed.

use super::discovery::{has, of_glib, ptp_feature};
use crate::capture::camera::{CameraError, Clock};
use crate::capture::pixels::PixelLayout;
use crate::capture::settings::{CameraSettings, ControlValue, Trigger};
use aravis::prelude::*;
use aravis::{Auto, Camera, PixelFormat};

/// Names that makers give to the ceiling of automatic exposure, µs.
const EXPOSURE_CEILINGS: [&str; 5] = [
    "AutoExposureExposureTimeUpperLimit",
    "AutoExposureTimeUpperLimit",
    "ExposureAutoUpperLimit",
    "ExposureTimeUpperLimit",
    "AutoExposureTimeAbsUpperLimit",
];
/// Formats in the order in which they are chosen where none is asked for.
const PREFERRED_FORMATS: [&str; 8] = [
    "Mono8",
    "BayerRG8",
    "BayerGB8",
    "BayerGR8",
    "BayerBG8",
    "Mono12p",
    "Mono16",
    "Mono12Packed",
];

/// What a camera was set to.
#[derive(Debug)]
pub(super) struct Configured {
    pub(super) size_px: (u32, u32),
    pub(super) format: PixelFormat,
    pub(super) layout: PixelLayout,
    /// Bytes of a frame.
    pub(super) payload: usize,
    pub(super) buffers: usize,
    pub(super) clock: Clock,
}

/// Sets the camera up.
pub(super) fn apply(
    camera: &Camera,
    settings: &CameraSettings,
    size_px: (u32, u32),
) -> Result<Configured, CameraError> {
    // A camera that somebody left running takes no settings.
    let _ = camera.stop_acquisition();
    let (format, layout) = set_format(camera, settings)?;
    set_region(camera, settings, size_px)?;
    set_trigger(camera, settings)?;
    set_frame_rate(camera, settings)?;
    set_exposure(camera, settings)?;
    set_gain(camera, settings)?;
    set_packets(camera, settings)?;
    for (name, value) in &settings.controls {
        set_control(camera, name, value)?;
    }
    if camera
        .set_acquisition_mode(aravis::AcquisitionMode::Continuous)
        .is_err()
    {
        tracing::debug!("the camera has no acquisition mode");
    }
    let payload = camera.payload().map_err(|e| of_glib("its payload", &e))?;
    Ok(Configured {
        size_px,
        format,
        layout,
        payload: payload as usize,
        buffers: settings.buffers,
        clock: follow_ptp(camera, settings)?,
    })
}

fn unsuitable(text: impl Into<String>) -> CameraError {
    CameraError::Unsuitable(text.into())
}

fn set_format(
    camera: &Camera,
    settings: &CameraSettings,
) -> Result<(PixelFormat, PixelLayout), CameraError> {
    let offered: Vec<String> = camera
        .dup_available_pixel_formats_as_strings()
        .map(|all| all.into_iter().map(String::from).collect())
        .map_err(|e| of_glib("its pixel formats", &e))?;
    let name = match &settings.pixel_format {
        Some(name) if offered.contains(name) => name.as_str(),
        Some(name) => {
            return Err(unsuitable(format!(
                "has no pixel format {name}; it has {}",
                offered.join(", ")
            )));
        }
        None => PREFERRED_FORMATS
            .into_iter()
            .find(|name| offered.iter().any(|own| own == name))
            .ok_or_else(|| {
                unsuitable(format!(
                    "has no pixel format that can be turned into grey, only {}",
                    offered.join(", ")
                ))
            })?,
    };
    let layout = PixelLayout::of_genicam(name).ok_or_else(|| {
        unsuitable(format!(
            "its pixel format {name} cannot be turned into grey"
        ))
    })?;
    camera
        .set_pixel_format_from_string(name)
        .and_then(|()| camera.pixel_format())
        .map(|format| (format, layout))
        .map_err(|e| of_glib(&format!("cannot be set to {name}"), &e))
}

fn set_region(
    camera: &Camera,
    settings: &CameraSettings,
    (width, height): (u32, u32),
) -> Result<(), CameraError> {
    let (sensor_width, sensor_height) = camera
        .sensor_size()
        .map_err(|e| of_glib("its sensor", &e))?;
    let [x, y] = settings.offset_px;
    let fits = |offset: u32, length: u32, sensor: i32| offset + length <= sensor.max(0) as u32;
    if !fits(x, width, sensor_width) || !fits(y, height, sensor_height) {
        return Err(unsuitable(format!(
            "its sensor has {sensor_width}×{sensor_height} px, in which the rig's {width}×{height} px from {x}, {y} on do not fit"
        )));
    }
    let (x, y, width, height) = (x as i32, y as i32, width as i32, height as i32);
    let set = camera
        .set_region(x, y, width, height)
        .and_then(|()| camera.region())
        .map_err(|e| of_glib(&format!("cannot give the rig's {width}×{height} px"), &e))?;
    if set != (x, y, width, height) {
        return Err(unsuitable(format!(
            "gives {}×{} px from {}, {} on instead of the rig's {width}×{height} px from {x}, {y} on",
            set.2, set.3, set.0, set.1
        )));
    }
    Ok(())
}

fn set_trigger(camera: &Camera, settings: &CameraSettings) -> Result<(), CameraError> {
    let source = match settings.trigger {
        Trigger::Free => {
            if has(camera, "TriggerMode") {
                camera
                    .clear_triggers()
                    .map_err(|e| of_glib("cannot run free", &e))?;
            }
            return Ok(());
        }
        Trigger::Hardware => settings.trigger_source.as_str(),
        Trigger::Software => "Software",
        Trigger::Action => "Action1",
    };
    if !has(camera, "TriggerMode") {
        return Err(unsuitable("cannot be triggered"));
    }
    let sources: Vec<String> = camera
        .dup_available_trigger_sources()
        .map(|all| all.into_iter().map(String::from).collect())
        .unwrap_or_default();
    if !sources.is_empty() && !sources.iter().any(|own| own == source) {
        return Err(unsuitable(format!(
            "cannot be triggered by {source}, only by {}",
            sources.join(", ")
        )));
    }
    camera
        .set_trigger(source)
        .map_err(|e| of_glib(&format!("cannot be triggered by {source}"), &e))
}

fn set_frame_rate(camera: &Camera, settings: &CameraSettings) -> Result<(), CameraError> {
    let (Some(rate_hz), Trigger::Free) = (settings.frame_rate_hz, settings.trigger) else {
        return Ok(());
    };
    if !camera.is_frame_rate_available().unwrap_or(false) {
        return Err(unsuitable("its frame rate cannot be set"));
    }
    if let Ok((least, most)) = camera.frame_rate_bounds()
        && !(least..=most).contains(&rate_hz)
    {
        return Err(unsuitable(format!(
            "its frame rate goes from {least} to {most} Hz, not to {rate_hz}"
        )));
    }
    camera
        .set_frame_rate(rate_hz)
        .map_err(|e| of_glib(&format!("cannot be set to {rate_hz} Hz"), &e))
}

/// Fixed, or automatic below a ceiling; a camera without a ceiling gets it as fixed exposure.
fn set_exposure(camera: &Camera, settings: &CameraSettings) -> Result<(), CameraError> {
    let can_set = camera.is_exposure_time_available().unwrap_or(false);
    let can_auto = camera.is_exposure_auto_available().unwrap_or(false);
    let ceiling = EXPOSURE_CEILINGS.into_iter().find(|name| has(camera, name));
    let failed = |e: glib::Error| of_glib("its exposure cannot be set", &e);
    let fixed_ms = match (settings.exposure_ms, ceiling) {
        (Some(fixed_ms), _) if can_set => fixed_ms,
        (Some(_), _) => return Err(unsuitable("its exposure cannot be set")),
        (None, Some(ceiling)) if can_auto => {
            let ceiling_us = settings.exposure_max_ms * 1e3;
            let (least, most) = camera.float_bounds(ceiling).unwrap_or((0.0, f64::MAX));
            camera
                .set_float(ceiling, ceiling_us.clamp(least, most))
                .and_then(|()| camera.set_exposure_time_auto(Auto::Continuous))
                .map_err(failed)?;
            return Ok(());
        }
        (None, _) if can_set => settings.exposure_max_ms,
        (None, _) => return Ok(()),
    };
    if can_auto {
        camera.set_exposure_time_auto(Auto::Off).map_err(failed)?;
    }
    let fixed_us = fixed_ms * 1e3;
    let (least, most) = camera.exposure_time_bounds().map_err(failed)?;
    if settings.exposure_ms.is_some() && !(least..=most).contains(&fixed_us) {
        return Err(unsuitable(format!(
            "its exposure goes from {} to {} ms, not to {fixed_ms}",
            least * 1e-3,
            most * 1e-3
        )));
    }
    camera
        .set_exposure_time(fixed_us.clamp(least, most))
        .map_err(failed)
}

fn set_gain(camera: &Camera, settings: &CameraSettings) -> Result<(), CameraError> {
    let failed = |e: glib::Error| of_glib("its gain cannot be set", &e);
    let can_auto = camera.is_gain_auto_available().unwrap_or(false);
    let Some(gain) = settings.gain else {
        if can_auto {
            camera.set_gain_auto(Auto::Continuous).map_err(failed)?;
        }
        return Ok(());
    };
    if !camera.is_gain_available().unwrap_or(false) {
        return Err(unsuitable("its gain cannot be set"));
    }
    if can_auto {
        camera.set_gain_auto(Auto::Off).map_err(failed)?;
    }
    let (least, most) = camera.gain_bounds().map_err(failed)?;
    if !(least..=most).contains(&gain) {
        return Err(unsuitable(format!(
            "its gain goes from {least} to {most}, not to {gain}"
        )));
    }
    camera.set_gain(gain).map_err(failed)
}

fn set_packets(camera: &Camera, settings: &CameraSettings) -> Result<(), CameraError> {
    if !camera.is_gv_device() {
        return Ok(());
    }
    let Some(bytes) = settings.packet_size else {
        // The largest that gets through; what the camera has remains where that cannot be found out.
        let _ = camera.gv_auto_packet_size();
        return Ok(());
    };
    camera
        .gv_set_packet_size(bytes as i32)
        .map_err(|e| of_glib(&format!("cannot send packets of {bytes} bytes"), &e))
}

fn set_control(camera: &Camera, name: &str, value: &ControlValue) -> Result<(), CameraError> {
    if !has(camera, name) {
        return Err(unsuitable(format!("has no feature {name}")));
    }
    let set = match value {
        ControlValue::Switch(v) => camera.set_boolean(name, *v),
        ControlValue::Integer(v) => camera
            .set_integer(name, *v)
            .or_else(|_| camera.set_float(name, *v as f64)),
        ControlValue::Float(v) => camera.set_float(name, *v),
        ControlValue::Word(v) => camera.set_string(name, v),
    };
    set.map_err(|e| {
        unsuitable(format!(
            "its feature {name} cannot be set to {value}: {}",
            e.message()
        ))
    })
}

/// PTP is switched on for triggers that need it; stamps of cameras that follow it are comparable.
fn follow_ptp(camera: &Camera, settings: &CameraSettings) -> Result<Clock, CameraError> {
    let is_wanted = settings.trigger == Trigger::Action;
    let Some(feature) = ptp_feature(camera) else {
        if is_wanted {
            return Err(unsuitable(
                "its clock cannot follow PTP, which scheduled triggers need",
            ));
        }
        return Ok(Clock::Own);
    };
    if is_wanted {
        camera
            .set_boolean(feature, true)
            .map_err(|e| of_glib("its clock cannot follow PTP", &e))?;
    }
    let follows = camera.boolean(feature).unwrap_or(false);
    let status = ["PtpStatus", "GevIEEE1588Status"]
        .into_iter()
        .find_map(|name| camera.string(name).ok());
    let is_synchronised = status.is_none_or(|s| s == "Slave" || s == "Master");
    Ok(if follows && is_synchronised {
        Clock::Shared
    } else {
        Clock::Own
    })
}
