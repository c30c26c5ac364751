//! Uncertainty: how an error travels, and how to tell whether a covariance holds.

pub mod consistency;
