//! Which cameras Aravis sees, and opening one by what its owner calls it.
#![expect(
    unsafe_code,
    reason = "calls of Aravis for which its crate has no form"
)]

use crate::capture::camera::CameraError;
use aravis::Camera;
use aravis::prelude::*;
use glib::prelude::Cast;
use serde::Serialize;
use std::collections::BTreeMap;
use std::ffi::{CStr, c_char};
use std::net::IpAddr;
use std::sync::{Mutex, PoisonError};

/// A camera on one of the host's networks or buses.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Found {
    /// Aravis' name for it.
    pub id: String,
    /// Its hardware's address.
    pub physical_id: String,
    /// Who made it.
    pub vendor: String,
    /// What it is.
    pub model: String,
    /// Its serial number.
    pub serial: String,
    /// Its network address, or where on the bus it is.
    pub address: String,
    /// `GigEVision` or `USB3Vision`.
    pub protocol: String,
}

impl Found {
    /// What tells it from any other.
    #[must_use]
    pub fn identity(&self) -> String {
        format!("{} {} {}", self.vendor, self.model, self.serial)
    }

    fn is_called(&self, name: &str) -> bool {
        [&self.id, &self.serial, &self.address, &self.physical_id]
            .into_iter()
            .any(|own| own == name)
    }
}

/// What a camera can do.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Details {
    /// Width and height of its sensor, px.
    pub sensor_px: Option<(i32, i32)>,
    /// Pixel formats by name.
    pub pixel_formats: Vec<String>,
    /// What may trigger it.
    pub trigger_sources: Vec<String>,
    /// Least and greatest frame rate, Hz.
    pub frame_rate_hz: Option<(f64, f64)>,
    /// Least and greatest exposure, µs.
    pub exposure_us: Option<(f64, f64)>,
    /// Least and greatest gain, in its own unit.
    pub gain: Option<(f64, f64)>,
    /// Whether it can set the exposure itself.
    pub has_auto_exposure: bool,
    /// Whether its clock follows PTP.
    pub has_ptp: bool,
    /// Why nothing is known, if nothing is.
    pub cause: Option<String>,
}

/// Aravis' list of devices is one for the process; here with where cameras were found, by what their
/// owner calls them.
static LIST: Mutex<BTreeMap<String, Found>> = Mutex::new(BTreeMap::new());

/// Looks for cameras on all networks and buses; takes about a second.
#[must_use]
pub fn list() -> Vec<Found> {
    let _guard = LIST.lock().unwrap_or_else(PoisonError::into_inner);
    list_locked()
}

fn list_locked() -> Vec<Found> {
    // SAFETY: the list belongs to whoever holds `LIST`; nothing else in the program touches it.
    let count = unsafe {
        aravis_sys::arv_update_device_list();
        aravis_sys::arv_get_n_devices()
    };
    (0..count)
        .map(|at| {
            // SAFETY: as above; `at` is below the number of devices, and the texts live until the next
            // update of the list.
            unsafe {
                Found {
                    id: text(aravis_sys::arv_get_device_id(at)),
                    physical_id: text(aravis_sys::arv_get_device_physical_id(at)),
                    vendor: text(aravis_sys::arv_get_device_vendor(at)),
                    model: text(aravis_sys::arv_get_device_model(at)),
                    serial: text(aravis_sys::arv_get_device_serial_nbr(at)),
                    address: text(aravis_sys::arv_get_device_address(at)),
                    protocol: text(aravis_sys::arv_get_device_protocol(at)),
                }
            }
        })
        .collect()
}

/// # Safety
/// `text` is null or a C string.
unsafe fn text(text: *const c_char) -> String {
    if text.is_null() {
        return String::new();
    }
    // SAFETY: as the caller promises.
    unsafe { CStr::from_ptr(text) }
        .to_string_lossy()
        .into_owned()
}

/// Opens the camera that is called `name`: its id, serial number, address, hardware address or the
/// name that its user gave it.
pub(super) fn open(name: &str) -> Result<(Camera, Found), CameraError> {
    let mut known = LIST.lock().unwrap_or_else(PoisonError::into_inner);
    let again = known.get(name).and_then(open_again);
    let (camera, found) = match again {
        Some(opened) => opened,
        None => open_listed(name)?,
    };
    // Whoever comes second may look, but not touch: said now, rather than by the first setting.
    if let Some(device) = camera
        .device()
        .as_ref()
        .and_then(|d| d.downcast_ref::<aravis::GvDevice>())
        && !device.is_controller()
    {
        return Err(CameraError::Busy(format!(
            "{name}: another program holds it"
        )));
    }
    known.insert(name.to_owned(), found.clone());
    Ok((camera, found))
}

/// A camera that comes back is usually where it was. One that is asked for itself answers at once; a
/// list waits a second for all that may answer.
fn open_again(known: &Found) -> Option<(Camera, Found)> {
    known.address.parse::<IpAddr>().ok()?;
    let camera = Camera::new(Some(&known.address)).ok()?;
    let is_same = described(&camera, &known.id).identity() == known.identity();
    is_same.then(|| (camera, known.clone()))
}

fn open_listed(name: &str) -> Result<(Camera, Found), CameraError> {
    let cameras = list_locked();
    let found = cameras.iter().find(|camera| camera.is_called(name));
    // Aravis itself knows names that the list does not show, and addresses beyond the next router.
    let wanted = found.map_or(name, |camera| camera.id.as_str());
    let camera = Camera::new(Some(wanted)).map_err(|e| refusal(name, &cameras, &e))?;
    let found = match found {
        Some(found) => found.clone(),
        None => described(&camera, name),
    };
    Ok((camera, found))
}

fn described(camera: &Camera, name: &str) -> Found {
    let text =
        |value: Result<glib::GString, glib::Error>| value.map(String::from).unwrap_or_default();
    Found {
        id: name.to_owned(),
        physical_id: String::new(),
        vendor: text(camera.vendor_name()),
        model: text(camera.model_name()),
        serial: text(camera.device_serial_number()),
        address: name.to_owned(),
        protocol: String::new(),
    }
}

fn refusal(name: &str, cameras: &[Found], error: &glib::Error) -> CameraError {
    if error.matches(aravis::DeviceError::NotFound) {
        let there: Vec<&str> = cameras.iter().map(|camera| camera.id.as_str()).collect();
        let there = if there.is_empty() {
            "there is none at all".to_owned()
        } else {
            format!("there are {}", there.join(", "))
        };
        return CameraError::Absent(format!("no camera is called {name}; {there}"));
    }
    of_glib(&format!("{name}: cannot be opened"), error)
}

/// A failure of Aravis as one of a camera.
pub(super) fn of_glib(what: &str, error: &glib::Error) -> CameraError {
    if error.matches(aravis::DeviceError::NotController) {
        return CameraError::Busy(format!("{what}: another program holds it"));
    }
    CameraError::Failed(format!("{what}: {}", error.message().trim_end_matches('.')))
}

/// What a camera can do.
#[must_use]
pub fn details(found: &Found) -> Details {
    let camera = match open(&found.id) {
        Ok((camera, _)) => camera,
        Err(e) => {
            return Details {
                cause: Some(e.to_string()),
                ..Details::default()
            };
        }
    };
    let texts = |list: Result<Vec<glib::GString>, glib::Error>| -> Vec<String> {
        list.map(|all| all.into_iter().map(String::from).collect())
            .unwrap_or_default()
    };
    Details {
        sensor_px: camera.sensor_size().ok(),
        pixel_formats: texts(camera.dup_available_pixel_formats_as_strings()),
        trigger_sources: texts(camera.dup_available_trigger_sources()),
        frame_rate_hz: camera.frame_rate_bounds().ok(),
        exposure_us: camera.exposure_time_bounds().ok(),
        gain: camera.gain_bounds().ok(),
        has_auto_exposure: camera.is_exposure_auto_available().unwrap_or(false),
        has_ptp: ptp_feature(&camera).is_some(),
        cause: None,
    }
}

/// The feature that makes the camera's clock follow PTP, by the names that makers give it.
pub(super) fn ptp_feature(camera: &Camera) -> Option<&'static str> {
    ["PtpEnable", "GevIEEE1588"]
        .into_iter()
        .find(|name| has(camera, name))
}

/// Whether a camera has a feature.
pub(super) fn has(camera: &Camera, feature: &str) -> bool {
    camera.is_feature_available(feature).unwrap_or(false)
}
