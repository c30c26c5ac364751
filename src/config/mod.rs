//! Configuration: what was typed in, a checked one out.
