//! Pipeline: the method itself, and the threads that carry pairs through it.

mod driver;
mod histogram;
mod method;
mod statistics;

pub use driver::{Delivery, PipelineError, Settings, StageLatencies, run};
pub use method::{DescribedPair, Method, StageTimes};
pub use statistics::{RunCounts, RunFigures, StageFigures, Statistics};
