//! A device of the kernel's Video4Linux held to the contract of every camera. `tools/robot-in-a-box` has
//! some, and names one by `VISOD_TEST_V4L2`; where nothing is named, the test says so and passes over.

use super::one_camera::assert_camera_conforms;
use visod::capture::camera::{CameraError, FrameSource};
use visod::capture::settings::{CameraSettings, Driver};
use visod::capture::v4l2::V4l2Camera;

#[test]
fn a_v4l2_camera_conforms() {
    let Ok(id) = std::env::var("VISOD_TEST_V4L2") else {
        println!("skipped: VISOD_TEST_V4L2 names no device");
        return;
    };
    let settings = CameraSettings {
        driver: Driver::V4l2,
        id,
        pixel_format: Some("GREY".to_owned()),
        ..CameraSettings::default()
    };
    let open = || {
        let camera = V4l2Camera::open(&settings, (1280, 960))?;
        Ok(Box::new(camera) as Box<dyn FrameSource>)
    };
    assert_camera_conforms(&open, (1280, 960), true);
    let second = open().expect("it is free");
    let refused = open().err();
    assert!(matches!(refused, Some(CameraError::Busy(_))), "{refused:?}");
    drop(second);
}
