//! Estimates and images in, an MCAP recording of ROS 2 messages out.
//!
//! Foxglove shows it as it is, ROS 2's tools play it, and `visod replay` reads it again. Its topics are those of
//! the module `topics`; images are PNG, without loss. The rig file is attached, for `CameraInfo` has no place
//! for all of it.

mod recorder;
mod writer;

pub use recorder::McapRecorder;
pub use writer::McapWriter;
