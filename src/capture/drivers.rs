//! The settings of a camera in; what opens it out, whatever drives it.

use super::camera::{CameraError, FrameSource};
use super::settings::{CameraSettings, Driver};
use super::{Dataset, Opener, Side, dataset, files::FileCamera};
use crate::geometry::StereoRig;
use std::path::Path;
use std::sync::Arc;

/// What opens one camera of a rig. `files` says how recordings are read.
///
/// # Errors
/// This visod was built without the driver.
pub fn opener(
    settings: &CameraSettings,
    side: Side,
    rig: &StereoRig,
    files: &dataset::Settings,
) -> Result<Opener, CameraError> {
    let settings = settings.clone();
    let camera = match side {
        Side::Left => &rig.left,
        Side::Right => &rig.right,
    };
    let size_px = (camera.width, camera.height);
    match settings.driver {
        Driver::Files => {
            let (rig, files) = (rig.clone(), files.clone());
            Ok(Arc::new(move || open_files(&settings, side, &rig, &files)))
        }
        Driver::Aravis => aravis(settings, size_px),
        Driver::V4l2 => v4l2(settings, size_px),
    }
}

fn open_files(
    settings: &CameraSettings,
    side: Side,
    rig: &StereoRig,
    files: &dataset::Settings,
) -> Result<Box<dyn FrameSource>, CameraError> {
    let dataset = Dataset::open_with(Path::new(&settings.id), Some(rig.clone()), files.clone())
        .map_err(|e| CameraError::Absent(e.to_string()))?;
    Ok(Box::new(FileCamera::open(&dataset, side, &settings.id)?))
}

#[cfg(feature = "aravis")]
fn aravis(settings: CameraSettings, size_px: (u32, u32)) -> Result<Opener, CameraError> {
    use super::aravis::AravisCamera;
    Ok(Arc::new(move || {
        Ok(Box::new(AravisCamera::open(&settings, size_px)?))
    }))
}

#[cfg(not(feature = "aravis"))]
fn aravis(settings: CameraSettings, _: (u32, u32)) -> Result<Opener, CameraError> {
    Err(not_built(settings.driver, "aravis"))
}

#[cfg(feature = "v4l")]
fn v4l2(settings: CameraSettings, size_px: (u32, u32)) -> Result<Opener, CameraError> {
    use super::v4l2::V4l2Camera;
    Ok(Arc::new(move || {
        Ok(Box::new(V4l2Camera::open(&settings, size_px)?))
    }))
}

#[cfg(not(feature = "v4l"))]
fn v4l2(settings: CameraSettings, _: (u32, u32)) -> Result<Opener, CameraError> {
    Err(not_built(settings.driver, "v4l"))
}

#[cfg(not(all(feature = "aravis", feature = "v4l")))]
fn not_built(driver: Driver, feature: &str) -> CameraError {
    CameraError::Unsuitable(format!(
        "the driver {} is not there: this visod was built without the feature {feature}",
        driver.as_str()
    ))
}
