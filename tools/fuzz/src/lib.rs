//! Every reader of visod that takes what others wrote, each as a function of any bytes.
//!
//! Whatever the bytes, a reader must end soon, take no more memory than its limits say, and give either
//! something that holds what it promises or one sentence that says why not. libFuzzer calls these
//! functions (`tools/fuzz/run`), and so do the tests of visod, with every file of `corpus` and changes of it.

mod folder;
mod sentence;

pub mod command_line;
pub mod configuration;
pub mod corners;
pub mod dataset;
pub mod image;
pub mod last_pose;
#[cfg(feature = "mcap")]
pub mod mcap;
pub mod odometry_csv;
pub mod rig;
pub mod rig_covariance;
pub mod rig_import;
#[cfg(feature = "mcap")]
pub mod ros_message;
pub mod shared_memory;
pub mod trajectory;

/// A reader under test.
pub type Target = fn(&[u8]);

/// All of them, by the names that their binaries and their folders in `corpus` have.
pub const TARGETS: &[(&str, Target)] = &[
    ("command-line", command_line::run),
    ("configuration", configuration::run),
    ("corners", corners::run),
    ("dataset", dataset::run),
    ("image", image::run),
    ("last-pose", last_pose::run),
    #[cfg(feature = "mcap")]
    ("mcap", mcap::run),
    ("odometry-csv", odometry_csv::run),
    ("rig", rig::run),
    ("rig-covariance", rig_covariance::run),
    ("rig-import", rig_import::run),
    #[cfg(feature = "mcap")]
    ("ros-message", ros_message::run),
    ("shared-memory", shared_memory::run),
    ("trajectory", trajectory::run),
];
