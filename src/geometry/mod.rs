//! Geometry: rotations, rigid motions, cameras and the stereo rig.
//!
//! Conventions, stated here once and held by tests:
//!
//! * Camera axes: x right, y down, z forward, metres.
//! * Pixels: the centre of the top left pixel is (0, 0).
//! * A transform `a_from_b` maps a point given in frame b into frame a, so that neighbours meet in
//!   a product: `odom_from_prev * prev_from_now`.
//! * A twist or a covariance is ordered translation, then rotation: x, y, z, rx, ry, rz.

mod camera;
pub(crate) mod definite;
mod distortion;
mod plausibility;
pub(crate) mod product;
mod rectification;
mod rig;
mod rig_file;
pub mod rig_parameters;
pub mod se2;
pub mod se3;
pub mod so3;

pub use camera::Camera;
pub use distortion::Distortion;
pub use plausibility::{Finding, Severity, check_rig};
pub use rectification::Rectification;
pub use rig::{RigUncertainty, StereoRig};
pub(crate) use rig_file::save_rig;
#[cfg(feature = "mcap")]
pub(crate) use rig_file::{COVARIANCE_FILE, parse_rig_with_covariance, with_covariance_beside};
pub use rig_file::{RigFileError, load_rig, parse_rig, rig_to_toml};
