//! Pipeline: the method itself, and the threads that carry pairs through it.

mod driver;
mod drops;
#[cfg(test)]
mod estimator_tests;
mod gallery;
mod histogram;
mod method;
mod occupancy;
mod overlap;
mod repeats;
mod statistics;
mod trim;
mod two_frame;
mod unlikeness;
mod windowed;

pub use driver::{Delivery, Fault, PipelineError, Settings, Stage, StageLatencies, run};
pub use drops::{DropCount, Undelivered, drops};
pub use method::{Described, DescribedPair, Method, StageTimes, StepError};
pub use repeats::Repeated;
pub use statistics::{RunCounts, RunFigures, StageFigures, Statistics};
pub use trim::Share;
