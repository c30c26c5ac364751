//! Pipeline: the method itself, and the threads that carry pairs through it.

mod method;

pub use method::{DescribedPair, Method, StageTimes};
