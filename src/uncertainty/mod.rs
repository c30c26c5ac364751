//! Uncertainty: how an error travels, and how to tell whether a covariance holds.

pub mod compounding;
mod implicit;

pub use implicit::{derivative_of_minimiser, propagate};
pub mod consistency;
