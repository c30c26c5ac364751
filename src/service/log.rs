//! Where the log goes: to systemd's journal, with its fields, where that is where stderr leads; else to
//! stderr as text. What repeats itself is held back: ten lines of one kind in ten seconds are enough.

use std::collections::HashMap;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};
use tracing::callsite::Identifier;
use tracing::{Event, Metadata};
use tracing_subscriber::layer::{Context, Filter, Layer, SubscriberExt};
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{EnvFilter, registry};

/// Lines of one kind that pass within [`WINDOW`].
const BURST: u32 = 10;
/// After that long, as many pass again.
const WINDOW: Duration = Duration::from_secs(10);

/// Starts the log; `RUST_LOG` says how much of it there is, by default INFO and above. Whoever has set up a
/// log already keeps it.
pub fn start() {
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("info"));
    // systemd sets this where stderr is connected to the journal.
    let journal = std::env::var_os("JOURNAL_STREAM").and_then(|_| tracing_journald::layer().ok());
    let Some(journal) = journal else {
        let text = tracing_subscriber::fmt::layer()
            .with_writer(std::io::stderr)
            .with_ansi(false)
            .with_target(false)
            .with_filter(Calm::default());
        let _ = registry().with(filter).with(text).try_init();
        return;
    };
    let journal = journal
        .with_field_prefix(Some("VISOD".to_owned()))
        .with_filter(Calm::default());
    let _ = registry().with(filter).with(journal).try_init();
}

/// Holds back what repeats itself.
#[derive(Debug, Default)]
struct Calm(Mutex<HashMap<Identifier, Burst>>);

impl<S> Filter<S> for Calm {
    fn enabled(&self, _: &Metadata<'_>, _: &Context<'_, S>) -> bool {
        true
    }

    fn event_enabled(&self, event: &Event<'_>, _: &Context<'_, S>) -> bool {
        let mut bursts = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let now = Instant::now();
        bursts
            .entry(event.metadata().callsite())
            .or_insert(Burst::new(now))
            .passes(now)
    }
}

/// The lines of one kind.
#[derive(Clone, Copy, Debug)]
struct Burst {
    began: Instant,
    lines: u32,
}

impl Burst {
    fn new(began: Instant) -> Self {
        Self { began, lines: 0 }
    }

    /// Whether one more may pass.
    fn passes(&mut self, now: Instant) -> bool {
        if now.duration_since(self.began) >= WINDOW {
            *self = Self::new(now);
        }
        self.lines += 1;
        self.lines <= BURST
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_repeats_itself_is_held_back_for_a_while() {
        let start = Instant::now();
        let mut burst = Burst::new(start);
        let passed = (0..100)
            .filter(|n| burst.passes(start + Duration::from_millis(10 * n)))
            .count();
        assert_eq!(passed, BURST as usize);
        assert!(burst.passes(start + WINDOW));
    }
}
