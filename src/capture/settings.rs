//! The settings of `[capture]` and of `[camera.left]`, `[camera.right]`.

use super::pairing::PairBy;
use crate::settings::SettingError;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::time::Duration;

/// How the frames of two cameras become pairs, and what happens when one fails.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// How frames find their partners: `stamp`, the nearest in time; `trigger`, the same count of
    /// triggers, for cameras on one trigger line. Default `stamp`: needs no wiring.
    pub pair_by: PairBy,
    /// How far apart in time the images of a pair may be taken, beyond three σ of their stamps. s, 0 to
    /// 0.1, default 0.005: a robot at 1 m/s moves 5 mm.
    pub tolerance_s: f64,
    /// Whether the cameras' clocks run apart, `own`, or are kept together by PTP or the like, `shared`.
    /// Default `own`: stamps are compared in this computer's clock, which costs some precision.
    pub clocks: Clocks,
    /// Whose clock stamps the results: `host`, this computer's; `camera`, the left camera's, for
    /// cameras whose clock means something, such as PTP's. Default `host`.
    pub stamps: Stamps,
    /// 1 σ of the difference between the least delays of the two cameras' frames, which stamps cannot
    /// show. s, 0 to 0.1, default 0.0001: like cameras on like cables, on a computer that has a processor
    /// for each when it comes (`service.priority`).
    pub sigma_transit_s: f64,
    /// Time without a frame after which a camera counts as stalled, and is opened anew. s, 0.1 to 60,
    /// default 2: longer than any exposure or hiccup.
    pub stall_s: f64,
    /// Longest pause between two attempts to open a camera that is gone; they begin with a quarter of a
    /// second and double. s, 0.25 to 60, default 0.5: back soon, without a storm of discoveries.
    pub retry_s: f64,
    /// How long a start waits for cameras that are absent or held by another program. s, 0 to 3600,
    /// default 10: a camera lets go of a killed daemon only after some seconds.
    pub patience_s: f64,
    /// Pairs that wait for the stages before the oldest is dropped. Pairs, 1 to 64, default 1: a fresh pair is
    /// worth more than an old one.
    pub queue: usize,
}

/// Whether the cameras' clocks run apart.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Clocks {
    /// Each has its own, unless the driver knows better.
    #[default]
    Own,
    /// They are kept together, by PTP or the like.
    Shared,
}

/// Whose clock stamps the results.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Stamps {
    /// This computer's CLOCK_REALTIME, as it was when the run began, going on with CLOCK_MONOTONIC.
    #[default]
    Host,
    /// The left camera's.
    Camera,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            pair_by: PairBy::Stamp,
            tolerance_s: 0.005,
            clocks: Clocks::Own,
            stamps: Stamps::Host,
            sigma_transit_s: 0.0001,
            stall_s: 2.0,
            retry_s: 0.5,
            patience_s: 10.0,
            queue: 1,
        }
    }
}

impl Settings {
    /// Refuses values out of range.
    ///
    /// # Errors
    /// The first setting out of range.
    pub fn check(&self) -> Result<(), SettingError> {
        SettingError::unless_in("tolerance_s", self.tolerance_s, 0.0..=0.1)?;
        SettingError::unless_in("sigma_transit_s", self.sigma_transit_s, 0.0..=0.1)?;
        SettingError::unless_in("stall_s", self.stall_s, 0.1..=60.0)?;
        SettingError::unless_in("retry_s", self.retry_s, 0.25..=60.0)?;
        SettingError::unless_in("patience_s", self.patience_s, 0.0..=3600.0)?;
        SettingError::unless_in("queue", self.queue, 1..=64)
    }

    pub(super) fn tolerance_ns(&self) -> i64 {
        (self.tolerance_s * 1e9).round() as i64
    }

    pub(super) fn stall(&self) -> Duration {
        Duration::from_secs_f64(self.stall_s)
    }

    pub(super) fn retry(&self) -> Duration {
        Duration::from_secs_f64(self.retry_s)
    }

    pub(super) fn patience(&self) -> Duration {
        Duration::from_secs_f64(self.patience_s)
    }
}

/// The two cameras of `[camera]`.
#[derive(Clone, Debug, Default, PartialEq, Deserialize, Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct Cameras {
    /// The left camera, whose frame is the reference.
    pub left: Option<CameraSettings>,
    /// The right camera.
    pub right: Option<CameraSettings>,
}

/// What drives a camera.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Driver {
    /// Aravis: GigE Vision and USB3 Vision.
    #[default]
    Aravis,
    /// The kernel's Video4Linux.
    V4l2,
    /// One side of a recording, at its own pace.
    Files,
}

impl Driver {
    /// The word of the configuration.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Aravis => "aravis",
            Self::V4l2 => "v4l2",
            Self::Files => "files",
        }
    }
}

/// What makes a camera take a frame.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Trigger {
    /// Its own clock.
    #[default]
    Free,
    /// A pulse on a line.
    Hardware,
    /// A command of this host, sent to both cameras at the same ticks.
    Software,
    /// A command of this host for a time of the clock that PTP keeps in both cameras.
    Action,
}

/// The value of a control.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(untagged)]
pub enum ControlValue {
    /// On or off.
    Switch(bool),
    /// A whole number.
    Integer(i64),
    /// A number.
    Float(f64),
    /// A word, such as an entry of a menu.
    Word(String),
}

impl std::fmt::Display for ControlValue {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Switch(v) => v.fmt(f),
            Self::Integer(v) => v.fmt(f),
            Self::Float(v) => v.fmt(f),
            Self::Word(v) => write!(f, "\"{v}\""),
        }
    }
}

/// One camera. The size of its images is the rig's.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct CameraSettings {
    /// What drives it: `aravis`, `v4l2` or `files`. Default `aravis`.
    pub driver: Driver,
    /// Which camera. Aravis: its id, serial number, address or user-defined name; V4L2: its device, such as
    /// `/dev/v4l/by-id/…`; files: a recording's folder. Text, no default: a robot that takes any
    /// camera takes the wrong one.
    pub id: String,
    /// Format of its pixels, by the driver's name for it. Default none: 8-bit grey, else what the camera
    /// has that can be turned into grey.
    pub pixel_format: Option<String>,
    /// Frames a second, of a free or software-triggered camera. Hz, 0.1 to 1000, default none: as the
    /// camera is set.
    pub frame_rate_hz: Option<f64>,
    /// Fixed exposure. ms, 0.001 to 10000, default none: automatic, up to `exposure_max_ms`.
    pub exposure_ms: Option<f64>,
    /// Longest automatic exposure, which bounds motion blur. ms, 0.001 to 10000, default 10: at 1 rad/s
    /// and 1770 px focal length, 18 px.
    pub exposure_max_ms: f64,
    /// Fixed gain, in the camera's unit (usually dB). -100 to 1000, default none: automatic where the
    /// camera can.
    pub gain: Option<f64>,
    /// What makes it take a frame: `free`, `hardware`, `software` or `action`. Default `free`.
    pub trigger: Trigger,
    /// The line of a hardware trigger. Text, default `Line0`.
    pub trigger_source: String,
    /// Upper left corner of the image on the sensor. px, default 0, 0.
    pub offset_px: [u32; 2],
    /// Size of a GigE Vision packet. Bytes, 576 to 9000, default none: the largest that gets through.
    pub packet_size: Option<u32>,
    /// Images that may be under way between camera and stages. Count, 2 to 64, default 8.
    pub buffers: usize,
    /// The sample that becomes white, of formats with more than 8 bits. Sample value, 1 to 65535,
    /// default none: the format's largest.
    pub white_level: Option<u16>,
    /// Any other features or controls, by the driver's names. Default none.
    pub controls: BTreeMap<String, ControlValue>,
}

impl Default for CameraSettings {
    fn default() -> Self {
        Self {
            driver: Driver::Aravis,
            id: String::new(),
            pixel_format: None,
            frame_rate_hz: None,
            exposure_ms: None,
            exposure_max_ms: 10.0,
            gain: None,
            trigger: Trigger::Free,
            trigger_source: "Line0".to_owned(),
            offset_px: [0, 0],
            packet_size: None,
            buffers: 8,
            white_level: None,
            controls: BTreeMap::new(),
        }
    }
}

impl CameraSettings {
    /// Refuses values out of range, and cameras without a name.
    ///
    /// # Errors
    /// The first setting that cannot be.
    pub fn check(&self) -> Result<(), SettingError> {
        if self.id.trim().is_empty() {
            return Err(SettingError {
                key: "id",
                cause: "must name the camera; `visod cameras` lists those there are".to_owned(),
            });
        }
        let within = |key, value: Option<f64>, least, most| match value {
            Some(value) => SettingError::unless_in(key, value, least..=most),
            None => Ok(()),
        };
        within("frame_rate_hz", self.frame_rate_hz, 0.1, 1000.0)?;
        within("exposure_ms", self.exposure_ms, 0.001, 10_000.0)?;
        within(
            "exposure_max_ms",
            Some(self.exposure_max_ms),
            0.001,
            10_000.0,
        )?;
        within("gain", self.gain, -100.0, 1000.0)?;
        if let Some(bytes) = self.packet_size {
            SettingError::unless_in("packet_size", bytes, 576..=9000)?;
        }
        if let Some(white) = self.white_level {
            SettingError::unless_in("white_level", white, 1..=u16::MAX)?;
        }
        if matches!(self.trigger, Trigger::Software | Trigger::Action)
            && self.frame_rate_hz.is_none()
        {
            return Err(SettingError {
                key: "frame_rate_hz",
                cause: "must be set for a camera that this host triggers".to_owned(),
            });
        }
        SettingError::unless_in("buffers", self.buffers, 2..=64)
    }
}
