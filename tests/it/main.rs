//! The integration tests, in one binary.
//!
//! A line of `cfg(test)` of its own on each lets clippy know that helpers may unwrap too.

#[cfg(test)]
mod accuracy;
#[cfg(test)]
#[cfg(feature = "ipc")]
mod bridge;
#[cfg(test)]
mod c_header;
#[cfg(test)]
mod calibrate;
#[cfg(test)]
mod corpora;
#[cfg(test)]
mod cuts;
#[cfg(test)]
mod evaluate;
#[cfg(test)]
mod features;
#[cfg(test)]
#[cfg(all(feature = "foxglove", feature = "ipc"))]
mod foxglove;
#[cfg(test)]
mod frame_source;
#[cfg(test)]
#[cfg(all(feature = "aravis", feature = "ipc"))]
mod gige;
#[cfg(test)]
mod manners;
#[cfg(test)]
#[cfg(feature = "mcap")]
mod mcap;
#[cfg(test)]
mod mistakes;
#[cfg(test)]
mod montecarlo;
#[cfg(test)]
mod one_camera;
#[cfg(test)]
#[cfg(feature = "opencv")]
mod opencv;
#[cfg(test)]
#[cfg(feature = "ipc")]
mod publication;
#[cfg(test)]
#[cfg(feature = "ipc")]
mod python_client;
#[cfg(test)]
mod recordings;
#[cfg(test)]
mod replay;
#[cfg(test)]
#[cfg(feature = "ipc")]
mod replay_publication;
#[cfg(test)]
mod report;
#[cfg(test)]
mod samples;
#[cfg(test)]
mod scenarios;
#[cfg(test)]
#[cfg(all(feature = "aravis", feature = "ipc"))]
mod service;
#[cfg(test)]
#[cfg(feature = "ipc")]
mod strangers;
#[cfg(test)]
mod supply_chain;
#[cfg(test)]
#[cfg(feature = "v4l")]
mod v4l2;
