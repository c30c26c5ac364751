//! Messages of ROS 2, as recordings of it hold them: Rust values in, CDR bytes out, and back.
//!
//! Only what visod reads or writes. [`messages`] has the types, each with the fields of its ROS
//! definition in order; [`definitions`] the same as text, which a recording carries along so that
//! readers need nothing else.

pub mod camera_info;
pub mod definitions;
mod fixed;
pub mod messages;

pub use fixed::{Bytes, Fixed};

use cdr_encoding::{from_bytes, to_writer};
use serde::{Serialize, de::DeserializeOwned};

/// Plain CDR, little-endian: what stands before the message.
const LITTLE_ENDIAN: [u8; 4] = [0, 1, 0, 0];
/// The name of an MCAP file's attachment that holds the rig file of a recording of visod's own.
pub const RIG_ATTACHMENT: &str = "rig.toml";
const NS_PER_S: i64 = 1_000_000_000;

/// Why bytes are no message.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CdrError {
    /// Not even the header is there.
    #[error("the message has {0} bytes, too few for its header")]
    TooShort(usize),
    /// Encoded in a way that is not read here.
    #[error("the message's encoding {0:#04x} is not plain CDR")]
    UnknownEncoding(u8),
    /// The bytes end early or say what cannot be.
    #[error("the message is damaged: {0}")]
    Damaged(String),
}

/// Writes a message in CDR behind what `bytes` holds already.
///
/// # Errors
/// The message cannot be expressed: a string or sequence is too long.
pub fn encode<T: Serialize>(message: &T, bytes: &mut Vec<u8>) -> Result<(), CdrError> {
    bytes.extend_from_slice(&LITTLE_ENDIAN);
    to_writer::<_, byteorder::LittleEndian, _>(bytes, message)
        .map_err(|e| CdrError::Damaged(e.to_string()))
}

/// Reads a message of either byte order. Bytes behind it are ignored: ROS 2 pads.
///
/// # Errors
/// See the variants of [`CdrError`].
pub fn decode<T: DeserializeOwned>(bytes: &[u8]) -> Result<T, CdrError> {
    let (header, body) = bytes
        .split_first_chunk::<4>()
        .ok_or(CdrError::TooShort(bytes.len()))?;
    let damaged = |e: cdr_encoding::Error| CdrError::Damaged(e.to_string());
    match header {
        [0, 1, ..] => from_bytes::<T, byteorder::LittleEndian>(body),
        [0, 0, ..] => from_bytes::<T, byteorder::BigEndian>(body),
        [_, other, ..] => return Err(CdrError::UnknownEncoding(*other)),
    }
    .map(|(message, _)| message)
    .map_err(damaged)
}

/// A time of ROS from nanoseconds.
#[must_use]
pub fn time(timestamp_ns: i64) -> messages::Time {
    messages::Time {
        sec: i32::try_from(timestamp_ns.div_euclid(NS_PER_S)).unwrap_or(i32::MAX),
        nanosec: timestamp_ns.rem_euclid(NS_PER_S) as u32,
    }
}

/// Nanoseconds from a time of ROS.
#[must_use]
pub fn timestamp_ns(time: messages::Time) -> i64 {
    i64::from(time.sec) * NS_PER_S + i64::from(time.nanosec)
}

#[cfg(test)]
mod tests {
    use super::messages::*;
    use super::*;
    use proptest::prelude::*;

    /// The bytes that the `rosbags` Python package writes for the same message.
    #[test]
    fn a_header_is_laid_out_as_cdr_has_it() {
        let header = Header {
            stamp: Time { sec: 3, nanosec: 7 },
            frame_id: "map".to_owned(),
        };
        let mut bytes = Vec::new();
        encode(&header, &mut bytes).expect("short");
        let expected = [
            0, 1, 0, 0, 3, 0, 0, 0, 7, 0, 0, 0, 4, 0, 0, 0, b'm', b'a', b'p', 0,
        ];
        assert_eq!(bytes, expected);
        assert_eq!(decode(&bytes), Ok(header));
    }

    #[test]
    fn numbers_are_aligned_from_the_end_of_the_header() {
        let message = Pose {
            position: Vector3 {
                x: 1.0,
                y: 2.0,
                z: 3.0,
            },
            orientation: Quaternion {
                x: 0.0,
                y: 0.0,
                z: 0.0,
                w: 1.0,
            },
        };
        let odometry = Odometry {
            child_frame_id: "abcdefg".to_owned(),
            pose: PoseWithCovariance {
                pose: message,
                covariance: Fixed(std::array::from_fn(|i| i as f64)),
            },
            ..Odometry::default()
        };
        let mut bytes = Vec::new();
        encode(&odometry, &mut bytes).expect("short");
        // Stamp 8, empty frame 5 (+3), name 12, then a multiple of eight.
        assert_eq!(bytes[4 + 32..][..8], 1.0_f64.to_le_bytes());
        assert_eq!(decode(&bytes), Ok(odometry));
    }

    #[test]
    fn big_endian_messages_are_read() {
        let bytes = [0, 0, 0, 0, 0, 0, 0, 3, 0, 0, 0, 7];
        let time: Time = decode(&bytes).expect("plain");
        assert_eq!((time.sec, time.nanosec), (3, 7));
    }

    #[test]
    fn what_is_no_message_is_named() {
        assert_eq!(decode::<Time>(&[0, 1]), Err(CdrError::TooShort(2)));
        let other = decode::<Time>(&[0, 7, 0, 0, 1, 2, 3, 4]);
        assert_eq!(other, Err(CdrError::UnknownEncoding(7)));
        // A sequence that claims four thousand million bytes takes no memory for them.
        let huge = [
            0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0,
            0xFF, 0xFF, 0xFF, 0xFF,
        ];
        let damaged = decode::<CompressedImage>(&huge);
        assert!(matches!(damaged, Err(CdrError::Damaged(_))), "{damaged:?}");
    }

    proptest! {
        #[test]
        fn times_come_back(ns in 0..4_000_000_000_000_000_000_i64) {
            // 32 bits of seconds end in 2038.
            prop_assume!(ns / NS_PER_S <= i64::from(i32::MAX));
            prop_assert_eq!(timestamp_ns(time(ns)), ns);
        }

        #[test]
        fn any_bytes_are_a_message_or_an_error(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
            let _ = decode::<Image>(&bytes);
            let _ = decode::<CameraInfo>(&bytes);
            let _ = decode::<TfMessage>(&bytes);
        }
    }
}
