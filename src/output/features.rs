//! The tracked features of a pair in, the fixed layout that goes through shared memory out.
//!
//! # Layout of `visod/features`, version 1
//!
//! Type name `visod::FeaturesMessage.1`, 53376 bytes, aligned to 8, little-endian, no padding. The first
//! `count` entries of `features` are of the pair, the others are zero.
//!
//! | offset | type | field | meaning |
//! |---:|---|---|---|
//! | 0 | `u32` | `magic` | 0x464F_4956, the bytes `VIOF` |
//! | 4 | `u32` | `version` | of this layout: 1 |
//! | 8 | `u32` | `size` | of this layout, bytes |
//! | 12 | `u32` | `flags` | as in `visod/odometry` |
//! | 16 | `u64` | `sequence` | number of the stereo pair, as in `visod/odometry` |
//! | 24 | `u64` | `message_number` | of this publisher, from 0 without gaps: a gap is a lost message |
//! | 32 | `i64` | `realtime_ns` | as in `visod/odometry` |
//! | 40 | `i64` | `monotonic_ns` | as in `visod/odometry` |
//! | 48 | `i64` | `published_monotonic_ns` | when the message was handed over, CLOCK_MONOTONIC |
//! | 56 | `u32` | `epoch` | as in `visod/odometry` |
//! | 60 | `u32` | `status` | as in `visod/odometry` |
//! | 64 | `u32` | `count` | entries of `features` in use, at most 512 |
//! | 68 | `u32` | `left_out` | features of the pair for which there was no room |
//! | 72 | `[f64; 3]` | `position_m` | of the left camera in the odometry frame, m, whatever `visod/odometry` is about |
//! | 96 | `[f64; 4]` | `orientation_xyzw` | of the left camera in the odometry frame |
//! | 128 | `[Feature; 512]` | `features` | see below, with rising `id` |
//!
//! Each of them, 104 bytes:
//!
//! | within | type | field | meaning |
//! |---:|---|---|---|
//! | +0 | `u64` | `id` | names the point for as long as it is followed |
//! | +8 | `u32` | `age` | pairs before this one that showed it; 0 where it is new |
//! | +12 | `u32` | `reserved` | 0 |
//! | +16 | `[f32; 2]` | `left_px` | where the left image shows it, x to the right, y down; 0 is the middle of the first pixel |
//! | +24 | `[f32; 2]` | `right_px` | where the right image shows it |
//! | +32 | `[f64; 3]` | `point_m` | where it is in the left camera (x right, y down, z forward), m |
//! | +56 | `[f64; 6]` | `cov_m2` | of the point by the noise of pixels, the cameras' poses being given: xx, xy, xz, yy, yz, zz, m² |
//!
//! A pair whose motion could not be measured has no features.

use super::message::{
    CaptureTime, MessageError, check_code, check_header, check_unit, status_code,
};
use super::row::canonical_xyzw;
use crate::estimation::{Odometry, TrackedFeature};
#[cfg(feature = "ipc")]
use iceoryx2::prelude::ZeroCopySend;

/// First four bytes of a [`FeaturesMessage`].
pub const FEATURES_MAGIC: u32 = u32::from_le_bytes(*b"VIOF");
/// Version of the layout of [`FeaturesMessage`].
pub const FEATURES_VERSION: u32 = 1;
/// Features that a message has room for.
pub const MAX_FEATURES: usize = 512;

const SIZE: u32 = size_of::<FeaturesMessage>() as u32;

/// One feature, as it lies in shared memory; the module's documentation has the layout.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend))]
#[expect(
    missing_docs,
    reason = "the layout table of the module documents each field"
)]
pub struct Feature {
    pub id: u64,
    pub age: u32,
    pub reserved: u32,
    pub left_px: [f32; 2],
    pub right_px: [f32; 2],
    pub point_m: [f64; 3],
    pub cov_m2: [f64; 6],
}

impl From<&TrackedFeature> for Feature {
    fn from(tracked: &TrackedFeature) -> Self {
        let [left_x, left_y, right_x, right_y] = tracked.measurement.px.map(|px| px as f32).into();
        let c = &tracked.landmark.cov_m2;
        Self {
            id: tracked.id,
            age: tracked.age,
            reserved: 0,
            left_px: [left_x, left_y],
            right_px: [right_x, right_y],
            point_m: tracked.landmark.point.into(),
            cov_m2: [
                c[(0, 0)],
                c[(0, 1)],
                c[(0, 2)],
                c[(1, 1)],
                c[(1, 2)],
                c[(2, 2)],
            ],
        }
    }
}

/// The features of one pair, as they lie in shared memory; the module's documentation has the layout.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq)]
#[cfg_attr(feature = "ipc", derive(ZeroCopySend))]
#[cfg_attr(feature = "ipc", type_name("visod::FeaturesMessage.1"))]
#[expect(
    missing_docs,
    reason = "the layout table of the module documents each field"
)]
pub struct FeaturesMessage {
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
    pub count: u32,
    pub left_out: u32,
    pub position_m: [f64; 3],
    pub orientation_xyzw: [f64; 4],
    pub features: [Feature; MAX_FEATURES],
}

impl Default for FeaturesMessage {
    /// No pair yet: where the odometry frame begins, without features.
    fn default() -> Self {
        Self {
            magic: FEATURES_MAGIC,
            version: FEATURES_VERSION,
            size: SIZE,
            flags: 0,
            sequence: 0,
            message_number: 0,
            realtime_ns: 0,
            monotonic_ns: 0,
            published_monotonic_ns: 0,
            epoch: 0,
            status: 0,
            count: 0,
            left_out: 0,
            position_m: [0.0; 3],
            orientation_xyzw: [0.0, 0.0, 0.0, 1.0],
            features: [Feature::default(); MAX_FEATURES],
        }
    }
}

impl FeaturesMessage {
    /// Takes on an estimate of the camera and its features, in place: nothing is allocated.
    pub fn fill(
        &mut self,
        camera: &Odometry,
        captured: CaptureTime,
        tracked: impl Iterator<Item = TrackedFeature>,
    ) {
        (self.flags, self.realtime_ns, self.monotonic_ns) = captured.flags_and_stamps();
        self.sequence = camera.sequence;
        self.epoch = camera.epoch;
        self.status = status_code(camera.status);
        self.position_m = camera.odom_from_camera.translation.vector.into();
        self.orientation_xyzw = canonical_xyzw(&camera.odom_from_camera.rotation);
        let before = self.count as usize;
        (self.count, self.left_out) = (0, 0);
        for feature in tracked {
            match self.features.get_mut(self.count as usize) {
                Some(entry) => {
                    *entry = Feature::from(&feature);
                    self.count += 1;
                }
                None => self.left_out += 1,
            }
        }
        if let Some(stale) = self.features.get_mut(self.count as usize..before) {
            stale.fill(Feature::default());
        }
    }

    /// The features in use.
    #[must_use]
    pub fn in_use(&self) -> &[Feature] {
        &self.features[..(self.count as usize).min(MAX_FEATURES)]
    }

    /// Whether the message is one of this layout with values that a pair can have.
    ///
    /// # Errors
    /// [`MessageError`]: another kind or version of message, a status that is not defined, more features
    /// than there is room for, or a pose, point or covariance that is not finite.
    pub fn validate(&self) -> Result<(), MessageError> {
        check_header(
            (self.magic, FEATURES_MAGIC),
            (self.version, FEATURES_VERSION),
            (self.size, SIZE),
        )?;
        check_code("status", self.status, 3)?;
        check_code("count", self.count, MAX_FEATURES as u32)?;
        check_unit("orientation_xyzw", &self.orientation_xyzw)?;
        let finite = |values: &[f64]| values.iter().all(|v| v.is_finite());
        let of_feature = |f: &Feature| finite(&f.point_m) && finite(&f.cov_m2);
        let not_finite = |field| MessageError::Field {
            field,
            cause: "holds a number that is not finite".to_owned(),
        };
        if !finite(&self.position_m) {
            return Err(not_finite("position_m"));
        }
        if !self.in_use().iter().all(of_feature) {
            return Err(not_finite("features"));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimation::{Landmark, StereoMeasurement};
    use crate::output::message::tests::{assert_gapless, documented_layout, offsets};
    use crate::output::row::tests::sample_odometry;
    use nalgebra::{Matrix3, Point3, Vector4};
    use std::mem::{align_of, offset_of};

    fn feature(id: u64) -> TrackedFeature {
        let k = id as f64;
        TrackedFeature {
            id,
            age: id as u32 % 7,
            measurement: StereoMeasurement {
                px: Vector4::new(k, k + 0.25, k - 8.0, k + 0.5),
                sigma_px: Vector4::repeat(0.5),
            },
            landmark: Landmark {
                point: Point3::new(k, -k, 5.0 + k),
                cov_m2: Matrix3::from_fn(|i, j| if i == j { 1.0 + k } else { (i + j) as f64 }),
            },
        }
    }

    fn filled(count: u64) -> Box<FeaturesMessage> {
        let mut message = Box::<FeaturesMessage>::default();
        message.fill(
            &sample_odometry(4),
            CaptureTime::Recorded(9),
            (0..count).map(feature),
        );
        message
    }

    #[test]
    fn layout_is_the_documented_one() {
        let source = include_str!("features.rs");
        let documented = documented_layout(source);
        let actual = offsets!(FeaturesMessage: magic version size flags sequence message_number
            realtime_ns monotonic_ns published_monotonic_ns epoch status count left_out position_m
            orientation_xyzw features);
        let names: Vec<_> = documented.iter().map(|(o, _, f)| (*o, *f)).collect();
        assert_eq!(names, actual);
        assert_gapless(&documented, size_of::<FeaturesMessage>());
        assert_eq!(size_of::<FeaturesMessage>(), 53376);
        assert_eq!(align_of::<FeaturesMessage>(), 8);
        assert_eq!(FEATURES_MAGIC, 0x464F_4956);

        let in_each = source.replace("//! | +", "//! | ");
        let inner = &documented_layout(&in_each)[documented.len()..];
        let actual = offsets!(Feature: id age reserved left_px right_px point_m cov_m2);
        let names: Vec<_> = inner.iter().map(|(o, _, f)| (*o, *f)).collect();
        assert_eq!(names, actual);
        assert_gapless(inner, size_of::<Feature>());
        assert_eq!(size_of::<Feature>(), 104);
    }

    #[test]
    fn what_is_tracked_lies_where_it_belongs() {
        let message = filled(3);
        assert_eq!(message.validate(), Ok(()));
        assert_eq!((message.sequence, message.realtime_ns), (4, 9));
        assert_eq!((message.count, message.left_out), (3, 0));
        let last = &message.in_use()[2];
        assert_eq!((last.id, last.age), (2, 2));
        assert_eq!((last.left_px, last.right_px), ([2.0, 2.25], [-6.0, 2.5]));
        assert_eq!(last.point_m, [2.0, -2.0, 7.0]);
        assert_eq!(last.cov_m2, [3.0, 1.0, 2.0, 3.0, 3.0, 3.0]);
    }

    #[test]
    fn what_has_no_room_is_counted_and_what_is_gone_is_zero() {
        let mut message = filled(MAX_FEATURES as u64 + 5);
        assert_eq!((message.count, message.left_out), (512, 5));
        let next = sample_odometry(5);
        message.fill(&next, CaptureTime::Recorded(10), [feature(8)].into_iter());
        assert_eq!((message.count, message.left_out), (1, 0));
        assert_eq!(message.features[0].id, 8);
        assert!(
            message.features[1..]
                .iter()
                .all(|f| *f == Feature::default())
        );
    }

    #[test]
    fn what_cannot_be_a_message_is_refused_with_its_cause() {
        let refusal = |change: fn(&mut FeaturesMessage)| {
            let mut message = filled(3);
            change(&mut message);
            message.validate().unwrap_err().to_string()
        };
        assert!(refusal(|m| m.magic = 1).contains("begins with 0x00000001"));
        assert!(refusal(|m| m.size = 8).contains("of 8 bytes"));
        assert!(refusal(|m| m.count = 513).contains("field count of the message is 513"));
        assert!(refusal(|m| m.features[2].cov_m2[5] = f64::NAN).contains("field features"));
        assert!(refusal(|m| m.position_m[0] = f64::INFINITY).contains("field position_m"));
    }
}
