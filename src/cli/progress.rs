//! The progress bar of long work: on a terminal, and nowhere else.

use indicatif::{ProgressBar, ProgressStyle};

/// A bar over `pairs` stereo pairs; a spinner where their number is not known.
pub(crate) fn pairs(pairs: Option<u64>) -> ProgressBar {
    match pairs {
        Some(pairs) => {
            let style = ProgressStyle::with_template("{bar:40} {pos}/{len} pairs, {eta} left");
            ProgressBar::new(pairs)
                .with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()))
        }
        None => ProgressBar::new_spinner(),
    }
}

/// A bar over `runs` runs of an experiment.
pub(crate) fn runs(runs: u64) -> ProgressBar {
    let style = ProgressStyle::with_template("{bar:40} {pos}/{len} runs, {eta} left");
    ProgressBar::new(runs).with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()))
}

/// A spinner beside what is being done.
pub(crate) fn steps() -> ProgressBar {
    let style = ProgressStyle::with_template("{spinner} {msg}");
    ProgressBar::new_spinner()
        .with_style(style.unwrap_or_else(|_| ProgressStyle::default_spinner()))
}
