//! Messages in shared memory, where another process may write what it likes.
#![expect(
    unsafe_code,
    reason = "any bytes become a message, as they do in shared memory"
)]

use super::sentence;
use visod::output::features::FeaturesMessage;
use visod::output::health::HealthMessage;
use visod::output::message::{MessageError, OdometryMessage};

/// Any bytes are a message that says what it may, or refused. The first byte chooses the kind.
pub fn run(data: &[u8]) {
    let Some((&kind, rest)) = data.split_first() else {
        return;
    };
    match kind {
        b'o' => {
            // SAFETY: the layout has no padding and no field of which any bit pattern is invalid.
            let message = unsafe { message_of::<OdometryMessage>(rest) };
            if accepted(message.validate()) {
                assert!(message.status().is_some() && message.frame().is_some());
                assert!(message.cov_pose.iter().all(|v| v.is_finite()));
                assert!(message.position_m.iter().all(|v| v.is_finite()));
            }
            let _ = (message.budget(), message.latencies(), message.is_replay());
        }
        b'h' => {
            // SAFETY: as above.
            let message = unsafe { message_of::<HealthMessage>(rest) };
            accepted(message.validate());
        }
        _ => {
            // SAFETY: as above.
            let message = unsafe { message_of::<FeaturesMessage>(rest) };
            accepted(message.validate());
            // Whatever the count says, only what is there is looked at.
            let _ = message.in_use().iter().map(|f| f.point_m[0]).sum::<f64>();
        }
    }
}

fn accepted(result: Result<(), MessageError>) -> bool {
    match result {
        Ok(()) => true,
        Err(why) => {
            sentence::check(&why.to_string());
            false
        }
    }
}

/// The message that these bytes are, with zeros behind them.
///
/// # Safety
/// Every bit pattern is a `T`.
unsafe fn message_of<T>(bytes: &[u8]) -> Box<T> {
    let mut message = Box::<T>::new_uninit();
    let length = bytes.len().min(size_of::<T>());
    // SAFETY: all of the box is written before it is taken for a `T`, and every bit pattern is one.
    unsafe {
        let place = message.as_mut_ptr().cast::<u8>();
        place.write_bytes(0, size_of::<T>());
        place.copy_from_nonoverlapping(bytes.as_ptr(), length);
        message.assume_init()
    }
}
