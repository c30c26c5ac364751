//! The integration tests, in one binary.
//!
//! `cfg(test)` on each lets clippy know that helpers may unwrap too.

#[cfg(test)]
mod evaluate;
#[cfg(test)]
mod features;
#[cfg(test)]
mod frame_source;
#[cfg(all(test, feature = "opencv"))]
mod opencv;
#[cfg(all(test, feature = "ipc"))]
mod publication;
#[cfg(all(test, feature = "ipc"))]
mod python_client;
#[cfg(test)]
mod recordings;
#[cfg(test)]
mod report;
