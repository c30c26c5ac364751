//! The integration tests, in one binary.

#[cfg(test)]
mod frame_source;
#[cfg(test)]
mod recordings;
mod features;
#[cfg(feature = "ipc")]
mod publication;
#[cfg(feature = "ipc")]
mod python_client;
mod evaluate;
// `cfg(test)` lets clippy know that its helpers may unwrap too.
#[cfg(test)]
#[cfg(feature = "opencv")]
mod opencv;
