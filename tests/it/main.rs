//! The integration tests, in one binary.

#[cfg(feature = "ipc")]
mod publication;
#[cfg(feature = "ipc")]
mod python_client;
