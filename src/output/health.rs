//! The daemon's own state in, the fixed layout that tells consumers of it out.
//!
//! # Layout of `visod/health`, version 1
//!
//! Type name `visod::HealthMessage.1`, 280 bytes, aligned to 8, no padding. Counters count from the
//! start of the daemon and never fall; `left_` and `right_` name the camera.
//!
//! | offset | type | field | meaning |
//! |---:|---|---|---|
//! | 0 | `u32` | `magic` | 0x484F_4956, the bytes `VIOH` |
//! | 4 | `u32` | `version` | of this layout: 1 |
//! | 8 | `u32` | `size` | of this layout, bytes |
//! | 12 | `u32` | `odometry_status` | status of the last estimate, as in `visod/odometry` |
//! | 16 | `u64` | `message_number` | of this publisher, from 0 without gaps |
//! | 24 | `i64` | `realtime_ns` | when this was written, CLOCK_REALTIME |
//! | 32 | `i64` | `monotonic_ns` | the same instant, CLOCK_MONOTONIC |
//! | 40 | `u32` | `left_state` | see [`CameraState`] |
//! | 44 | `u32` | `right_state` | see [`CameraState`] |
//! | 48 | `u64` | `left_frames` | images received |
//! | 56 | `u64` | `right_frames` | images received |
//! | 64 | `u64` | `left_reconnects` | times that the camera had to be opened again |
//! | 72 | `u64` | `right_reconnects` | times that the camera had to be opened again |
//! | 80 | `i64` | `left_last_monotonic_ns` | when the last image arrived, CLOCK_MONOTONIC; 0 before the first |
//! | 88 | `i64` | `right_last_monotonic_ns` | when the last image arrived, CLOCK_MONOTONIC; 0 before the first |
//! | 96 | `u64` | `left_lost_in_transport` | images that the camera sent but that arrived not or not whole |
//! | 104 | `u64` | `right_lost_in_transport` | images that the camera sent but that arrived not or not whole |
//! | 112 | `u64` | `left_unreadable` | images that could not be decoded or had the wrong size |
//! | 120 | `u64` | `right_unreadable` | images that could not be decoded or had the wrong size |
//! | 128 | `u64` | `left_unmatched` | images without a partner from the other camera |
//! | 136 | `u64` | `right_unmatched` | images without a partner from the other camera |
//! | 144 | `u64` | `pairs_processed` | stereo pairs that gave an estimate |
//! | 152 | `u64` | `pairs_unusable` | stereo pairs that could not be handed on |
//! | 160 | `u64` | `pairs_dropped` | stereo pairs dropped because the stages were busy |
//! | 168 | `u64` | `pairs_degraded` | estimates of status degraded |
//! | 176 | `u64` | `pairs_lost` | estimates of status lost |
//! | 184 | `u64` | `restarts` | times that the odometry frame began anew |
//! | 192 | `u64` | `over_budget` | pairs that took the stages longer than `budget_ns`; they overlap, so that this alone delays nothing |
//! | 200 | `u64` | `publish_failures` | messages that could not be handed over |
//! | 208 | `u64` | `budget_ns` | time between two pairs that the stages may use; 0 without one |
//! | 216 | `u64` | `busy_mean_ns` | time used a pair, mean since the last of these messages |
//! | 224 | `u64` | `busy_max_ns` | time used a pair, greatest since the last of these messages |
//! | 232 | `u64` | `uptime_ns` | since the daemon's start |
//! | 240 | `u64` | `subscribers` | subscribers of `visod/odometry` |
//! | 248 | `u32` | `degraded_mode` | 0 none, 1 fewer features are looked for, since pairs had to wait |
//! | 252 | `u32` | `features_permille` | share of the features that is looked for, thousandths |
//! | 256 | `u64` | `overruns` | pairs whose estimate came after the deadline |
//! | 264 | `u32` | `rig_state` | see [`RigCondition`] |
//! | 268 | `i32` | `rig_pitch_nrad` | turn of the right camera since the start, about its x axis, 1e-9 rad |
//! | 272 | `i32` | `rig_yaw_nrad` | the same, about its y axis |
//! | 276 | `i32` | `rig_roll_nrad` | the same, about its z axis |

use super::message::{MessageError, check_code, check_header};
#[cfg(feature = "ipc")]
use iceoryx2::prelude::ZeroCopySend;

/// First four bytes of a [`HealthMessage`].
pub const HEALTH_MAGIC: u32 = u32::from_le_bytes(*b"VIOH");
/// Version of the layout of [`HealthMessage`].
pub const HEALTH_VERSION: u32 = 1;

const SIZE: u32 = size_of::<HealthMessage>() as u32;

/// What a camera is doing.
#[repr(u32)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum CameraState {
    /// Not asked for yet.
    #[default]
    Closed = 0,
    /// Being looked for or opened.
    Opening = 1,
    /// Sending images.
    Streaming = 2,
    /// Open, but silent for longer than it should be.
    Stalled = 3,
    /// Gone; it will be opened again when it comes back.
    Lost = 4,
}

/// Whether the rig is as it was calibrated.
#[repr(u32)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum RigCondition {
    /// Nobody looks.
    #[default]
    Unwatched = 0,
    /// As calibrated, as far as can be told.
    Good = 1,
    /// The cameras have turned against each other since the start, beyond doubt.
    Moved = 2,
    /// From the start images missed each other by more than the rig's uncertainty.
    Misfits = 3,
}

/// How the daemon is, as it lies in shared memory; the module's documentation has the layout.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend))]
#[cfg_attr(feature = "ipc", type_name("visod::HealthMessage.1"))]
#[expect(
    missing_docs,
    reason = "the layout table of the module documents each field"
)]
pub struct HealthMessage {
    pub magic: u32,
    pub version: u32,
    pub size: u32,
    pub odometry_status: u32,
    pub message_number: u64,
    pub realtime_ns: i64,
    pub monotonic_ns: i64,
    pub left_state: u32,
    pub right_state: u32,
    pub left_frames: u64,
    pub right_frames: u64,
    pub left_reconnects: u64,
    pub right_reconnects: u64,
    pub left_last_monotonic_ns: i64,
    pub right_last_monotonic_ns: i64,
    pub left_lost_in_transport: u64,
    pub right_lost_in_transport: u64,
    pub left_unreadable: u64,
    pub right_unreadable: u64,
    pub left_unmatched: u64,
    pub right_unmatched: u64,
    pub pairs_processed: u64,
    pub pairs_unusable: u64,
    pub pairs_dropped: u64,
    pub pairs_degraded: u64,
    pub pairs_lost: u64,
    pub restarts: u64,
    pub over_budget: u64,
    pub publish_failures: u64,
    pub budget_ns: u64,
    pub busy_mean_ns: u64,
    pub busy_max_ns: u64,
    pub uptime_ns: u64,
    pub subscribers: u64,
    pub degraded_mode: u32,
    pub features_permille: u32,
    pub overruns: u64,
    pub rig_state: u32,
    pub rig_pitch_nrad: i32,
    pub rig_yaw_nrad: i32,
    pub rig_roll_nrad: i32,
}

impl Default for HealthMessage {
    /// A daemon that has just started: cameras closed, every counter 0.
    fn default() -> Self {
        Self {
            magic: HEALTH_MAGIC,
            version: HEALTH_VERSION,
            size: SIZE,
            odometry_status: 0,
            message_number: 0,
            realtime_ns: 0,
            monotonic_ns: 0,
            left_state: CameraState::Closed as u32,
            right_state: CameraState::Closed as u32,
            left_frames: 0,
            right_frames: 0,
            left_reconnects: 0,
            right_reconnects: 0,
            left_last_monotonic_ns: 0,
            right_last_monotonic_ns: 0,
            left_lost_in_transport: 0,
            right_lost_in_transport: 0,
            left_unreadable: 0,
            right_unreadable: 0,
            left_unmatched: 0,
            right_unmatched: 0,
            pairs_processed: 0,
            pairs_unusable: 0,
            pairs_dropped: 0,
            pairs_degraded: 0,
            pairs_lost: 0,
            restarts: 0,
            over_budget: 0,
            publish_failures: 0,
            budget_ns: 0,
            busy_mean_ns: 0,
            busy_max_ns: 0,
            uptime_ns: 0,
            subscribers: 0,
            degraded_mode: 0,
            features_permille: 1000,
            overruns: 0,
            rig_state: RigCondition::Unwatched as u32,
            rig_pitch_nrad: 0,
            rig_yaw_nrad: 0,
            rig_roll_nrad: 0,
        }
    }
}

impl HealthMessage {
    /// Whether the message is one of this layout with values that it can have.
    ///
    /// # Errors
    /// [`MessageError`]: another kind or version of message, or a state that is not defined.
    pub fn validate(&self) -> Result<(), MessageError> {
        check_header(
            (self.magic, HEALTH_MAGIC),
            (self.version, HEALTH_VERSION),
            (self.size, SIZE),
        )?;
        check_code("odometry_status", self.odometry_status, 3)?;
        check_code("left_state", self.left_state, CameraState::Lost as u32)?;
        check_code("right_state", self.right_state, CameraState::Lost as u32)?;
        check_code("rig_state", self.rig_state, RigCondition::Misfits as u32)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::output::message::tests::{assert_gapless, documented_layout, offsets};
    use std::mem::{align_of, offset_of};

    #[test]
    fn layout_is_the_documented_one() {
        let documented = documented_layout(include_str!("health.rs"));
        let actual = offsets!(HealthMessage: magic version size odometry_status message_number
            realtime_ns monotonic_ns left_state right_state left_frames right_frames
            left_reconnects right_reconnects left_last_monotonic_ns right_last_monotonic_ns
            left_lost_in_transport right_lost_in_transport left_unreadable right_unreadable
            left_unmatched right_unmatched pairs_processed pairs_unusable pairs_dropped
            pairs_degraded pairs_lost restarts over_budget publish_failures budget_ns busy_mean_ns
            busy_max_ns uptime_ns subscribers degraded_mode features_permille overruns
            rig_state rig_pitch_nrad rig_yaw_nrad rig_roll_nrad);
        let names: Vec<_> = documented.iter().map(|(o, _, f)| (*o, *f)).collect();
        assert_eq!(names, actual);
        assert_gapless(&documented, size_of::<HealthMessage>());
        assert_eq!(size_of::<HealthMessage>(), 280);
        assert_eq!(align_of::<HealthMessage>(), 8);
        assert_eq!(HEALTH_MAGIC, 0x484F_4956);
    }

    #[test]
    fn undefined_states_are_refused() {
        assert_eq!(HealthMessage::default().validate(), Ok(()));
        let wrong = HealthMessage {
            right_state: 5,
            ..HealthMessage::default()
        };
        assert!(
            wrong
                .validate()
                .unwrap_err()
                .to_string()
                .contains("right_state")
        );
    }
}
