//! Evaluation: an estimate and the truth in, errors and consistency out.
