//! Odometry in, the fixed layout that goes through shared memory out.
//!
//! # Layout of `visod/odometry`, version 1
//!
//! Type name `visod::OdometryMessage.1`, 1848 bytes, aligned to 8, little-endian on every machine
//! that visod runs on, no padding. Transforms map a point from the second frame named into the
//! first. Quaternions are x, y, z, w of unit length with w ≥ 0.
//!
//! | offset | type | field | meaning |
//! |---:|---|---|---|
//! | 0 | `u32` | `magic` | 0x444F_4956, the bytes `VIOD` |
//! | 4 | `u32` | `version` | of this layout: 1 |
//! | 8 | `u32` | `size` | of this layout, bytes |
//! | 12 | `u32` | `flags` | see [`flags`] |
//! | 16 | `u64` | `sequence` | number of the stereo pair in its recording, or since the start |
//! | 24 | `u64` | `message_number` | of this publisher, from 0 without gaps: a gap is a lost message |
//! | 32 | `i64` | `realtime_ns` | when the left image was taken, CLOCK_REALTIME; a recording's own stamp in a replay |
//! | 40 | `i64` | `monotonic_ns` | the same instant, CLOCK_MONOTONIC; 0 in a replay |
//! | 48 | `i64` | `published_monotonic_ns` | when the message was handed over, CLOCK_MONOTONIC |
//! | 56 | `u32` | `epoch` | rises whenever the odometry frame begins anew |
//! | 60 | `u32` | `status` | 0 initializing, 1 tracking, 2 degraded, 3 lost |
//! | 64 | `u32` | `frame` | whose pose this is: 0 left camera (x right, y down, z forward), 1 robot base |
//! | 68 | `u32` | `budget_modelled` | bit i: part i of the error budget is modelled; others are zero |
//! | 72 | `u32` | `keypoints_left` | keypoints of the left image |
//! | 76 | `u32` | `keypoints_right` | keypoints of the right image |
//! | 80 | `u32` | `stereo_matches` | left–right matches |
//! | 84 | `u32` | `tracks` | stereo matches found again from the pair before |
//! | 88 | `u32` | `inliers` | tracks that the estimate rests on |
//! | 92 | `u32` | `undetermined` | axes of the motion that the images leave open, as bits: 1, 2, 4 along x, y, z of the frame (σ above 0.1 m); 8, 16, 32 about them (above 0.01 rad); 63 where it was bridged |
//! | 96 | `f64` | `variance_factor` | a-posteriori variance factor; not a number where nothing was measured |
//! | 104 | `[f64; 3]` | `position_m` | of the frame in the odometry frame, m |
//! | 128 | `[f64; 4]` | `orientation_xyzw` | of the frame in the odometry frame |
//! | 160 | `[f64; 3]` | `motion_translation_m` | since the pair before, in the frame then, m |
//! | 184 | `[f64; 4]` | `motion_rotation_xyzw` | since the pair before |
//! | 216 | `[f64; 6]` | `twist` | velocity in the frame itself: m/s, then rad/s |
//! | 264 | `[f64; 36]` | `cov_pose` | of the pose, row by row |
//! | 552 | `[f64; 36]` | `cov_motion` | of the motion, row by row |
//! | 840 | `[f64; 36]` | `cov_twist` | of the velocity, row by row |
//! | 1128 | `[f64; 21]` | `budget_detection` | part 0 of `cov_pose`: from the detection of keypoints |
//! | 1296 | `[f64; 21]` | `budget_calibration` | part 1: from the calibration of the rig |
//! | 1464 | `[f64; 21]` | `budget_synchronisation` | part 2: from images not taken at the same instant |
//! | 1632 | `[f64; 21]` | `budget_bridging` | part 3: from motions that had to be bridged |
//! | 1800 | `u64` | `latency_capture_ns` | exposure to pair complete; 0 where not measured, here and below |
//! | 1808 | `u64` | `latency_features_ns` | detection and description |
//! | 1816 | `u64` | `latency_matching_ns` | left–right and over time |
//! | 1824 | `u64` | `latency_estimation_ns` | triangulation to pose |
//! | 1832 | `u64` | `latency_total_ns` | pair complete to message ready |
//! | 1840 | `f64` | `innovation_ratio` | of the noise model: below 0.5 fine, above 1 it does not hold; not a number where nothing was measured |
//!
//! Covariances are ordered x, y, z, rx, ry, rz (m², m·rad, rad²) with the conventions of
//! [`Odometry`]: about the fixed axes of the odometry frame for the pose. The parts of the error
//! budget are upper triangles, row by row.

use super::mounting::in_base_frame;
use super::row::{canonical_xyzw, upper_triangle};
use crate::estimation::{Axes, Odometry, Status};
#[cfg(feature = "ipc")]
use iceoryx2::prelude::ZeroCopySend;
use nalgebra::{Isometry3, Matrix6};

/// First four bytes of an [`OdometryMessage`].
pub const ODOMETRY_MAGIC: u32 = u32::from_le_bytes(*b"VIOD");
/// Version of the layout of [`OdometryMessage`].
pub const ODOMETRY_VERSION: u32 = 1;

/// Bits of `flags`.
pub mod flags {
    /// A recording is replayed: `realtime_ns` is the recording's own stamp, `monotonic_ns` is 0.
    pub const REPLAY: u32 = 1;
    /// `monotonic_ns` holds the capture time.
    pub const MONOTONIC: u32 = 2;
    /// The rotation is so uncertain that the covariance does not describe the pose's error any more.
    pub const BEYOND_FIRST_ORDER: u32 = 4;
}

/// Bits of `budget_modelled`.
pub mod budget_parts {
    /// From the detection of keypoints.
    pub const DETECTION: u32 = 1;
    /// From the calibration of the rig.
    pub const CALIBRATION: u32 = 2;
    /// From images that were not taken at the same instant.
    pub const SYNCHRONISATION: u32 = 4;
    /// From motions that had to be bridged.
    pub const BRIDGING: u32 = 8;
    /// All of them.
    pub const ALL: u32 = DETECTION | CALIBRATION | SYNCHRONISATION | BRIDGING;
}

/// Whose pose a message holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PoseFrame {
    /// The left camera: x right, y down, z forward.
    LeftCamera,
    /// The robot's base: x forward, y left, z up.
    Base,
}

/// When the left image was taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CaptureTime {
    /// By a camera, in both clocks of this host, ns.
    Live {
        /// CLOCK_REALTIME, ns.
        realtime_ns: i64,
        /// CLOCK_MONOTONIC, ns.
        monotonic_ns: i64,
    },
    /// In a recording, by the recording's own clock, ns.
    Recorded(i64),
}

impl CaptureTime {
    /// As messages have it: flags, CLOCK_REALTIME and CLOCK_MONOTONIC, ns.
    pub(super) fn flags_and_stamps(self) -> (u32, i64, i64) {
        match self {
            Self::Live {
                realtime_ns,
                monotonic_ns,
            } => (flags::MONOTONIC, realtime_ns, monotonic_ns),
            Self::Recorded(stamp_ns) => (flags::REPLAY, stamp_ns, 0),
        }
    }
}

/// How long each stage took for one pair, ns; 0 where that was not measured.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Latencies {
    /// From the exposure until the pair was complete.
    pub capture_ns: u64,
    /// Detection and description.
    pub features_ns: u64,
    /// Left–right and over time.
    pub matching_ns: u64,
    /// Triangulation to pose.
    pub estimation_ns: u64,
    /// From the complete pair to the message.
    pub total_ns: u64,
}

/// One estimate, as it lies in shared memory; the module's documentation has the layout.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend))]
#[cfg_attr(feature = "ipc", type_name("visod::OdometryMessage.1"))]
#[expect(
    missing_docs,
    reason = "the layout table of the module documents each field"
)]
pub struct OdometryMessage {
    pub magic: u32,
    pub version: u32,
    pub size: u32,
    pub flags: u32,
    pub sequence: u64,
    pub message_number: u64,
    pub realtime_ns: i64,
    pub monotonic_ns: i64,
    pub published_monotonic_ns: i64,
    pub epoch: u32,
    pub status: u32,
    pub frame: u32,
    pub budget_modelled: u32,
    pub keypoints_left: u32,
    pub keypoints_right: u32,
    pub stereo_matches: u32,
    pub tracks: u32,
    pub inliers: u32,
    pub undetermined: u32,
    pub variance_factor: f64,
    pub position_m: [f64; 3],
    pub orientation_xyzw: [f64; 4],
    pub motion_translation_m: [f64; 3],
    pub motion_rotation_xyzw: [f64; 4],
    pub twist: [f64; 6],
    pub cov_pose: [f64; 36],
    pub cov_motion: [f64; 36],
    pub cov_twist: [f64; 36],
    pub budget_detection: [f64; 21],
    pub budget_calibration: [f64; 21],
    pub budget_synchronisation: [f64; 21],
    pub budget_bridging: [f64; 21],
    pub latency_capture_ns: u64,
    pub latency_features_ns: u64,
    pub latency_matching_ns: u64,
    pub latency_estimation_ns: u64,
    pub latency_total_ns: u64,
    pub innovation_ratio: f64,
}

/// Why a message cannot be used.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum MessageError {
    /// The first bytes are not those of such a message.
    #[error(
        "not a visod message of this kind: it begins with {found:#010x} instead of {expected:#010x}"
    )]
    Magic {
        /// What was there.
        found: u32,
        /// What should have been there.
        expected: u32,
    },
    /// The layout is another version's.
    #[error(
        "the message has layout version {found} of {found_size} bytes, but this program knows version {expected} of {expected_size} bytes"
    )]
    Layout {
        /// The message's version.
        found: u32,
        /// The message's size, bytes.
        found_size: u32,
        /// The version known here.
        expected: u32,
        /// The size known here, bytes.
        expected_size: u32,
    },
    /// A field's value cannot be.
    #[error("field {field} of the message {cause}")]
    Field {
        /// The field.
        field: &'static str,
        /// What is wrong with it.
        cause: String,
    },
}

const SIZE: u32 = size_of::<OdometryMessage>() as u32;

impl OdometryMessage {
    /// The message of an estimate: the camera's pose, or the base's where its mounting is given.
    ///
    /// `message_number` and `published_monotonic_ns` are 0 until a publisher fills them in.
    #[must_use]
    pub fn new(
        camera: &Odometry,
        base_from_camera: Option<&Isometry3<f64>>,
        captured: CaptureTime,
        latencies: Latencies,
    ) -> Self {
        let in_base = base_from_camera.map(|mounting| in_base_frame(camera, mounting));
        let odometry = in_base.as_ref().unwrap_or(camera);
        let (flags, realtime_ns, monotonic_ns) = captured.flags_and_stamps();
        let beyond_first_order = if odometry.is_first_order() {
            0
        } else {
            flags::BEYOND_FIRST_ORDER
        };
        Self {
            magic: ODOMETRY_MAGIC,
            version: ODOMETRY_VERSION,
            size: SIZE,
            flags: flags | beyond_first_order,
            sequence: odometry.sequence,
            message_number: 0,
            realtime_ns,
            monotonic_ns,
            published_monotonic_ns: 0,
            epoch: odometry.epoch,
            status: status_code(odometry.status),
            frame: u32::from(in_base.is_some()),
            budget_modelled: budget_parts::ALL,
            keypoints_left: odometry.counts.keypoints_left,
            keypoints_right: odometry.counts.keypoints_right,
            stereo_matches: odometry.counts.stereo_matches,
            tracks: odometry.counts.tracks,
            inliers: odometry.counts.inliers,
            undetermined: odometry.undetermined().bits(),
            variance_factor: odometry.variance_factor,
            position_m: odometry.odom_from_camera.translation.vector.into(),
            orientation_xyzw: canonical_xyzw(&odometry.odom_from_camera.rotation),
            motion_translation_m: odometry.prev_from_now.translation.vector.into(),
            motion_rotation_xyzw: canonical_xyzw(&odometry.prev_from_now.rotation),
            twist: odometry.twist.into(),
            cov_pose: rows(&odometry.cov_pose),
            cov_motion: rows(&odometry.cov_motion),
            cov_twist: rows(&odometry.cov_twist),
            budget_detection: upper_triangle(&odometry.budget.detection),
            budget_calibration: upper_triangle(&odometry.budget.calibration),
            budget_synchronisation: upper_triangle(&odometry.budget.synchronisation),
            budget_bridging: upper_triangle(&odometry.budget.bridging),
            latency_capture_ns: latencies.capture_ns,
            latency_features_ns: latencies.features_ns,
            latency_matching_ns: latencies.matching_ns,
            latency_estimation_ns: latencies.estimation_ns,
            latency_total_ns: latencies.total_ns,
            innovation_ratio: odometry.innovation_ratio,
        }
    }

    /// Whether the message is one of this layout with values that an estimate can have.
    ///
    /// # Errors
    /// [`MessageError`]: another kind or version of message, a status or frame that is not defined,
    /// or a pose, motion, velocity or covariance that is not finite.
    pub fn validate(&self) -> Result<(), MessageError> {
        check_header(
            (self.magic, ODOMETRY_MAGIC),
            (self.version, ODOMETRY_VERSION),
            (self.size, SIZE),
        )?;
        check_code("status", self.status, 3)?;
        check_code("frame", self.frame, 1)?;
        check_code("undetermined", self.undetermined, Axes::ALL.bits())?;
        for (field, values) in self.float_fields() {
            if let Some(i) = values.iter().position(|v| !v.is_finite()) {
                return Err(MessageError::Field {
                    field,
                    cause: format!("is {} at index {i}", values[i]),
                });
            }
        }
        check_unit("orientation_xyzw", &self.orientation_xyzw)?;
        check_unit("motion_rotation_xyzw", &self.motion_rotation_xyzw)
    }

    /// How far the estimate can be trusted; `None` for a code that is not defined.
    #[must_use]
    pub fn status(&self) -> Option<Status> {
        match self.status {
            0 => Some(Status::Initializing),
            1 => Some(Status::Tracking),
            2 => Some(Status::Degraded),
            3 => Some(Status::Lost),
            _ => None,
        }
    }

    /// Whose pose this is; `None` for a code that is not defined.
    #[must_use]
    pub fn frame(&self) -> Option<PoseFrame> {
        match self.frame {
            0 => Some(PoseFrame::LeftCamera),
            1 => Some(PoseFrame::Base),
            _ => None,
        }
    }

    /// Whether a recording is replayed.
    #[must_use]
    pub fn is_replay(&self) -> bool {
        self.flags & flags::REPLAY != 0
    }

    /// The parts of the error budget: name, bit in `budget_modelled`, upper triangle.
    #[must_use]
    pub fn budget(&self) -> [(&'static str, u32, &[f64; 21]); 4] {
        use budget_parts::{BRIDGING, CALIBRATION, DETECTION, SYNCHRONISATION};
        [
            ("detection", DETECTION, &self.budget_detection),
            ("calibration", CALIBRATION, &self.budget_calibration),
            (
                "synchronisation",
                SYNCHRONISATION,
                &self.budget_synchronisation,
            ),
            ("bridging", BRIDGING, &self.budget_bridging),
        ]
    }

    /// The stages' latencies.
    #[must_use]
    pub fn latencies(&self) -> Latencies {
        Latencies {
            capture_ns: self.latency_capture_ns,
            features_ns: self.latency_features_ns,
            matching_ns: self.latency_matching_ns,
            estimation_ns: self.latency_estimation_ns,
            total_ns: self.latency_total_ns,
        }
    }

    /// The fields that must be finite.
    fn float_fields(&self) -> [(&'static str, &[f64]); 12] {
        [
            ("position_m", &self.position_m),
            ("orientation_xyzw", &self.orientation_xyzw),
            ("motion_translation_m", &self.motion_translation_m),
            ("motion_rotation_xyzw", &self.motion_rotation_xyzw),
            ("twist", &self.twist),
            ("cov_pose", &self.cov_pose),
            ("cov_motion", &self.cov_motion),
            ("cov_twist", &self.cov_twist),
            ("budget_detection", &self.budget_detection),
            ("budget_calibration", &self.budget_calibration),
            ("budget_synchronisation", &self.budget_synchronisation),
            ("budget_bridging", &self.budget_bridging),
        ]
    }
}

/// Refuses a message of another kind or layout; each pair is (found, expected).
pub(super) fn check_header(
    magic: (u32, u32),
    version: (u32, u32),
    size: (u32, u32),
) -> Result<(), MessageError> {
    if magic.0 != magic.1 {
        return Err(MessageError::Magic {
            found: magic.0,
            expected: magic.1,
        });
    }
    if version.0 != version.1 || size.0 != size.1 {
        return Err(MessageError::Layout {
            found: version.0,
            found_size: size.0,
            expected: version.1,
            expected_size: size.1,
        });
    }
    Ok(())
}

/// Refuses a code above the greatest that is defined.
pub(super) fn check_code(field: &'static str, code: u32, max: u32) -> Result<(), MessageError> {
    if code <= max {
        return Ok(());
    }
    Err(MessageError::Field {
        field,
        cause: format!("is {code}, but must be from 0 to {max}"),
    })
}

pub(super) fn check_unit(field: &'static str, xyzw: &[f64; 4]) -> Result<(), MessageError> {
    let norm = xyzw.iter().map(|v| v * v).sum::<f64>().sqrt();
    if (norm - 1.0).abs() <= 1e-6 {
        return Ok(());
    }
    Err(MessageError::Field {
        field,
        cause: format!("is no unit quaternion: its length is {norm}"),
    })
}

/// The code of a status in messages.
pub(crate) fn status_code(status: Status) -> u32 {
    match status {
        Status::Initializing => 0,
        Status::Tracking => 1,
        Status::Degraded => 2,
        Status::Lost => 3,
    }
}

fn rows(m: &Matrix6<f64>) -> [f64; 36] {
    std::array::from_fn(|k| m[(k / 6, k % 6)])
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::output::row::tests::{any_odometry, sample_odometry};
    use proptest::prelude::*;
    use std::mem::{align_of, offset_of};

    /// The rows `| offset | type | field |` of a layout table in a module's documentation.
    pub(crate) fn documented_layout(source: &str) -> Vec<(usize, &str, &str)> {
        source
            .lines()
            .filter_map(|line| line.strip_prefix("//! | "))
            // A `+` would be parsed too: it marks the fields of what is in a message.
            .filter(|row| !row.starts_with('+'))
            .filter_map(|row| {
                let mut cells = row.split(" | ");
                let offset = cells.next()?.trim().parse().ok()?;
                let kind = cells.next()?.trim_matches('`');
                let field = cells.next()?.trim_matches('`');
                Some((offset, kind, field))
            })
            .collect()
    }

    /// Size of a type named in a layout table, bytes.
    pub(crate) fn size_of_named(kind: &str) -> usize {
        match kind {
            "u32" | "i32" | "f32" => 4,
            "u64" | "i64" | "f64" => 8,
            "Feature" => size_of::<crate::output::features::Feature>(),
            other => {
                let inner = other.trim_matches(['[', ']']);
                let (element, count) = inner.split_once("; ").unwrap();
                size_of_named(element) * count.parse::<usize>().unwrap()
            }
        }
    }

    /// Rows without holes or overlaps, up to `size`.
    pub(crate) fn assert_gapless(layout: &[(usize, &str, &str)], size: usize) {
        let mut end = 0;
        for (offset, kind, field) in layout {
            assert_eq!(*offset, end, "{field}");
            end += size_of_named(kind);
        }
        assert_eq!(end, size);
    }

    macro_rules! offsets {
        ($type:ty: $($field:ident)*) => { vec![$((offset_of!($type, $field), stringify!($field))),*] };
    }
    pub(crate) use offsets;

    #[test]
    fn layout_is_the_documented_one() {
        let documented = documented_layout(include_str!("message.rs"));
        let actual = offsets!(OdometryMessage: magic version size flags sequence message_number
            realtime_ns monotonic_ns published_monotonic_ns epoch status frame budget_modelled
            keypoints_left keypoints_right stereo_matches tracks inliers undetermined variance_factor
            position_m orientation_xyzw motion_translation_m motion_rotation_xyzw twist cov_pose
            cov_motion cov_twist budget_detection budget_calibration budget_synchronisation
            budget_bridging latency_capture_ns latency_features_ns latency_matching_ns
            latency_estimation_ns latency_total_ns innovation_ratio);
        let names: Vec<_> = documented.iter().map(|(o, _, f)| (*o, *f)).collect();
        assert_eq!(names, actual);
        assert_gapless(&documented, size_of::<OdometryMessage>());
        assert_eq!(size_of::<OdometryMessage>(), 1848);
        assert_eq!(align_of::<OdometryMessage>(), 8);
        assert_eq!(ODOMETRY_MAGIC, 0x444F_4956);
    }

    proptest! {
        #[test]
        fn every_finite_estimate_makes_a_valid_message(odometry in any_odometry()) {
            let stamp = CaptureTime::Recorded(odometry.timestamp_ns);
            let message = OdometryMessage::new(&odometry, None, stamp, Latencies::default());
            prop_assert_eq!(message.validate(), Ok(()));
            prop_assert_eq!(message.status(), Some(odometry.status));
            prop_assert_eq!(message.frame(), Some(PoseFrame::LeftCamera));
            prop_assert!(message.orientation_xyzw[3] >= 0.0);
            prop_assert_eq!(message.cov_pose[6], odometry.cov_pose[(1, 0)]);
            prop_assert_eq!(message.budget_bridging[20], odometry.budget.bridging[(5, 5)]);
        }
    }

    fn sample() -> OdometryMessage {
        let stamp = CaptureTime::Live {
            realtime_ns: 5,
            monotonic_ns: 7,
        };
        OdometryMessage::new(&sample_odometry(1), None, stamp, Latencies::default())
    }

    fn refusal(change: impl Fn(&mut OdometryMessage)) -> String {
        let mut message = sample();
        change(&mut message);
        message.validate().unwrap_err().to_string()
    }

    #[test]
    fn what_cannot_be_a_message_is_refused_with_its_cause() {
        assert!(refusal(|m| m.magic = 1).contains("begins with 0x00000001"));
        assert!(refusal(|m| m.version = 2).contains("layout version 2"));
        assert!(refusal(|m| m.size = 8).contains("of 8 bytes"));
        assert!(refusal(|m| m.status = 4).contains("field status of the message is 4"));
        assert!(refusal(|m| m.frame = 2).contains("frame"));
        assert!(
            refusal(|m| m.cov_twist[35] = f64::NAN).contains("cov_twist of the message is NaN")
        );
        assert!(refusal(|m| m.position_m[1] = f64::INFINITY).contains("inf at index 1"));
        assert!(refusal(|m| m.orientation_xyzw = [0.0; 4]).contains("unit quaternion"));
    }

    #[test]
    fn stamps_say_where_they_come_from() {
        let live = sample();
        assert_eq!((live.realtime_ns, live.monotonic_ns), (5, 7));
        assert_eq!(live.flags, flags::MONOTONIC);
        let replay = OdometryMessage::new(
            &sample_odometry(1),
            None,
            CaptureTime::Recorded(11),
            Latencies::default(),
        );
        assert_eq!((replay.realtime_ns, replay.monotonic_ns), (11, 0));
        assert!(replay.is_replay());
    }

    #[test]
    fn mounting_makes_it_the_pose_of_the_base() {
        let mounting = Isometry3::translation(0.4, 0.2, 0.8);
        let message = OdometryMessage::new(
            &sample_odometry(1),
            Some(&mounting),
            CaptureTime::Recorded(0),
            Latencies::default(),
        );
        assert_eq!(message.frame(), Some(PoseFrame::Base));
        assert_eq!(message.validate(), Ok(()));
    }
}
