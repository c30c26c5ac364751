//! A device of the kernel's Video4Linux held to the contract of every camera. `tools/robot-in-a-box` has
//! some, and names one by `VISOD_TEST_V4L2`; where nothing is named, the tests say so and pass over.

use super::one_camera::{assert_camera_conforms, assert_leaves, assert_unsuitable};
use visod::capture::camera::{CameraError, FrameSource};
use visod::capture::settings::{CameraSettings, ControlValue, Driver};
use visod::capture::v4l2::V4l2Camera;

const SIZE_PX: (u32, u32) = (1280, 960);
/// One of each layout; a JPEG no driver of the kernel's makes up.
const FORMATS: [&str; 6] = ["GREY", "Y16", "YUYV", "UYVY", "RGGB", "RGB3"];

fn settings() -> Option<CameraSettings> {
    let Ok(id) = std::env::var("VISOD_TEST_V4L2") else {
        println!("skipped: VISOD_TEST_V4L2 names no device");
        return None;
    };
    Some(CameraSettings {
        driver: Driver::V4l2,
        id,
        pixel_format: Some("GREY".to_owned()),
        ..CameraSettings::default()
    })
}

fn open(settings: &CameraSettings) -> Result<Box<dyn FrameSource>, CameraError> {
    Ok(Box::new(V4l2Camera::open(settings, SIZE_PX)?))
}

#[test]
fn a_v4l2_camera_conforms_in_every_format() {
    let Some(settings) = settings() else {
        return;
    };
    for format in FORMATS {
        println!("{format}");
        let settings = CameraSettings {
            pixel_format: Some(format.to_owned()),
            ..settings.clone()
        };
        assert_camera_conforms(&|| open(&settings), SIZE_PX, true);
    }
    let wrong = CameraSettings {
        pixel_format: Some("H264".to_owned()),
        ..settings.clone()
    };
    assert_unsuitable(&|| open(&wrong), "has no pixel format H264; it has ");
    let second = open(&settings).expect("it is free");
    let refused = open(&settings).err();
    assert!(matches!(refused, Some(CameraError::Busy(_))), "{refused:?}");
    drop(second);
}

/// Controls are found however their names are written, and what was asked for is what they have.
#[test]
fn controls_are_set_by_name() {
    let Some(settings) = settings() else {
        return;
    };
    let with = |name: &str, value: ControlValue| CameraSettings {
        controls: [(name.to_owned(), value)].into(),
        ..settings.clone()
    };
    let device = v4l::Device::with_path(&settings.id).expect("it is there");
    let value_of = |name: &str| {
        let controls = device.query_controls().expect("listed");
        let control = controls.iter().find(|c| c.name == name).expect(name);
        device.control(control.id).expect("read").value
    };
    for (name, value, own_name, expected) in [
        (
            "boolean",
            ControlValue::Switch(false),
            "Boolean",
            v4l::control::Value::Boolean(false),
        ),
        (
            "Boolean",
            ControlValue::Switch(true),
            "Boolean",
            v4l::control::Value::Boolean(true),
        ),
        (
            "integer_32_bits",
            ControlValue::Integer(-5),
            "Integer 32 Bits",
            v4l::control::Value::Integer(-5),
        ),
        (
            "OSD Text Mode",
            ControlValue::Word("counters_only".to_owned()),
            "OSD Text Mode",
            v4l::control::Value::Integer(1),
        ),
        (
            "osd_text_mode",
            ControlValue::Word("None".to_owned()),
            "OSD Text Mode",
            v4l::control::Value::Integer(2),
        ),
    ] {
        drop(open(&with(name, value)).expect("set"));
        assert_eq!(value_of(own_name), expected, "{name}");
    }
    let gain = CameraSettings {
        gain: Some(77.0),
        ..settings.clone()
    };
    drop(open(&gain).expect("set"));
    assert_eq!(value_of("Gain"), v4l::control::Value::Integer(77));
    let refused =
        |settings: CameraSettings, says: &str| assert_unsuitable(&|| open(&settings), says);
    refused(
        with("shutter_speed", ControlValue::Integer(1)),
        "has no control shutter_speed; it has ",
    );
    refused(
        with("osd_text_mode", ControlValue::Word("some".to_owned())),
        "its control osd_text_mode cannot be set to \"some\": it has no such entry",
    );
    let gain = CameraSettings {
        gain: Some(1e6),
        ..settings.clone()
    };
    refused(gain, "its gain goes from 0 to 255, not to 1000000");
}

/// The device must be one that a control of the driver's unplugs: vivid, which plugs it in again as soon as
/// its last user is gone.
#[test]
fn a_v4l2_camera_that_is_unplugged_is_gone() {
    let Some(settings) = settings() else {
        return;
    };
    // So that it stays unplugged, whatever else that has it open does when it goes.
    let _user = std::fs::File::open(&settings.id).expect("it is there");
    let unplug = || {
        let unplugged = std::process::Command::new("v4l2-ctl")
            .args(["-d", &settings.id, "-c", "disconnect=1"])
            .status();
        assert!(unplugged.expect("v4l2-ctl").success());
    };
    assert_leaves(&|| open(&settings), unplug, "");
}
