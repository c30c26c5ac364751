//! The integration tests, in one binary.

// `cfg(test)` lets clippy know that its helpers may unwrap too.
#[cfg(test)]
#[cfg(feature = "opencv")]
mod opencv;
