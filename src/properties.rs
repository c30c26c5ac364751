//! How properties are tested: cases that failed once are kept beside the tests and tried first.

use proptest::test_runner::{Config, FileFailurePersistence};

/// As many cases as usual.
pub(crate) fn remembered() -> Config {
    let kept = FileFailurePersistence::SourceParallel("tests/regressions");
    Config {
        failure_persistence: Some(Box::new(kept)),
        ..Config::default()
    }
}
