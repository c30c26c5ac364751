//! Matching: features in, left–right matches and tracks over time out.

#[cfg(feature = "opencv")]
pub mod flann;
