//! Output: odometry in, shared memory, files and reports out.
//!
//! | module | writes |
//! |---|---|
//! | [`message`], [`features`], [`health`] | the fixed layouts that go through shared memory |
//! | [`mounting`] | odometry of the camera as odometry of the robot's base |
//! | `publisher`, `subscriber` (feature `ipc`) | those layouts to and from iceoryx2 services |
//! | [`row`], [`csv`], [`json`] | one odometry estimate as a row or an object, number for number the same text |
//! | `topics` | the messages of ROS 2 that recordings hold and Foxglove is shown |
//! | `foxglove` (feature `foxglove`) | the same and more, live, to whoever connects |
//! | `mcap` (feature `mcap`) | a recording that ROS 2 and Foxglove read |
//! | [`last_pose`] | where a run ended, for the next one |
//! | [`report`] | one HTML page about a run |
//! | [`tum`] | the trajectory for other tools |

#[cfg(any(feature = "mcap", feature = "foxglove"))]
mod background;
pub mod csv;
pub mod features;
#[cfg(feature = "foxglove")]
pub mod foxglove;
pub mod health;
#[cfg(feature = "ipc")]
mod ipc;
pub mod json;
pub mod last_pose;
#[cfg(feature = "mcap")]
pub mod mcap;
pub mod message;
pub mod mounting;
pub mod number;
pub mod publication;
#[cfg(feature = "ipc")]
pub mod publisher;
pub mod report;
#[cfg(feature = "ipc")]
mod room;
pub mod row;
#[cfg(feature = "ipc")]
pub mod subscriber;
#[cfg(any(feature = "mcap", feature = "foxglove"))]
mod topics;
pub mod tum;

#[cfg(feature = "ipc")]
pub use ipc::{IpcError, Payload, monotonic_ns, realtime_ns};
