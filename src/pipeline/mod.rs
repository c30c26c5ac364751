//! Pipeline: the method itself, and the threads that carry pairs through it.

mod driver;
mod method;

pub use driver::{Delivery, PipelineError, Settings, StageLatencies, run};
pub use method::{DescribedPair, Method, StageTimes};
