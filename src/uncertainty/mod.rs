//! Uncertainty: how an error travels, and how to tell whether a covariance holds.

pub mod compounding;
pub mod consider;
pub mod consistency;
mod implicit;
pub mod planar;

pub use implicit::{derivative_of_minimiser, propagate};
