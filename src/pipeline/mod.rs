//! Pipeline: the threads that carry a pair from capture to output.
