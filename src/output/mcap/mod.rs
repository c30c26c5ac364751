//! Estimates and images in, an MCAP recording of ROS 2 messages out.
//!
//! Foxglove shows it as it is, ROS 2's tools play it, and `visod replay` reads it again. Topics:
//!
//! | topic | message | holds |
//! |---|---|---|
//! | `/visod/odometry` | `nav_msgs/Odometry` | pose and velocity with their covariances |
//! | `/tf`, `/tf_static` | `tf2_msgs/TFMessage` | the same pose; where the cameras are |
//! | `/diagnostics` | `diagnostic_msgs/DiagnosticArray` | state and counts, every second and on change |
//! | `/left/image_raw/compressed`, `/right/…` | `sensor_msgs/CompressedImage` | images, as PNG without loss |
//! | `/left/camera_info`, `/right/…` | `sensor_msgs/CameraInfo` | calibrations |
//!
//! The rig file is attached, for `CameraInfo` has no place for all of it.

mod convert;
mod recorder;
mod writer;

pub use recorder::McapRecorder;
pub use writer::McapWriter;
