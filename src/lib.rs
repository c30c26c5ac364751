//! Stereo visual odometry that knows its own error.
//!
//! The modules, in the order in which a stereo pair flows through them:
//!
//! | stage | from | to |
//! |---|---|---|
//! | [`capture`] | cameras, recordings | [`capture::StereoPair`] |
//! | [`features`] | one image | [`features::Features`] |
//! | [`matching`] | features left, right, before | matches, tracks |
//! | [`refinement`] | tracks, images | tracks to a fraction of a pixel |
//! | [`estimation`] | tracks | [`estimation::Odometry`] |
//! | [`output`] | odometry | shared memory, CSV, report |
//!
//! Below them lie [`geometry`] and [`uncertainty`], which know nothing of stages; above them
//! [`pipeline`] (threads), [`service`] (systemd, scheduling), [`config`] and `cli`. Beside them stand
//! [`rig_watch`], which looks after the rig while it works, [`simulation`], which renders recordings with known truth, [`calibration`], which finds a rig from
//! views of a board, [`montecarlo`], which holds covariances against the errors of many
//! runs, and [`evaluation`], which compares an estimate with the truth.

pub mod calibration;
pub mod capture;
pub mod config;
pub mod estimation;
pub mod evaluation;
pub mod features;
pub mod geometry;
pub mod image;
pub mod matching;
pub mod montecarlo;
pub mod output;
pub mod pipeline;
#[cfg(test)]
mod properties;
mod queue;
pub mod refinement;
pub mod rig_watch;
#[cfg(any(feature = "mcap", feature = "foxglove"))]
pub mod ros;
pub mod service;
pub mod settings;
mod simd;
pub mod simulation;
mod text_file;
mod toml_file;
pub mod uncertainty;

pub use toml_file::TomlError;

#[doc(hidden)]
pub mod cli;
