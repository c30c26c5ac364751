//! Matching: features in, left–right matches and tracks over time out.
