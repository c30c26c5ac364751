//! The integration tests, in one binary.

#[cfg(test)]
mod frame_source;
#[cfg(test)]
mod recordings;
mod features;
