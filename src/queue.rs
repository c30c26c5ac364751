//! The bounded queues between threads: crossbeam's, with the memory for waiting taken at the start.
//!
//! A channel keeps a list of who waits on it, and a thread a token to wait with; both are made at the
//! first wait, which may come after any number of pairs. Here it comes before the first.

use crossbeam_channel::{Receiver, Sender};
use std::time::Duration;

/// Long enough for a thread to give up trying and wait, even where other work keeps it from trying.
const WAIT: Duration = Duration::from_millis(2);
const WAITS: usize = 2;

/// A queue with room for `capacity` items, at least one, whose receivers may have to wait.
pub(crate) fn bounded<T>(capacity: usize) -> (Sender<T>, Receiver<T>) {
    let (to, from) = crossbeam_channel::bounded(capacity.max(1));
    for _ in 0..WAITS {
        // Nothing can come.
        let _ = from.recv_timeout(WAIT);
    }
    (to, from)
}

/// The same, where senders may have to wait, too; `blank` makes an item that stands for none.
pub(crate) fn bounded_both_ways<T>(
    capacity: usize,
    blank: impl Fn() -> T,
) -> (Sender<T>, Receiver<T>) {
    let (to, from) = bounded(capacity);
    while to.try_send(blank()).is_ok() {}
    for _ in 0..WAITS {
        // Nobody makes room.
        let _ = to.send_timeout(blank(), WAIT);
    }
    while from.try_recv().is_ok() {}
    (to, from)
}

/// Has the calling thread wait once, on nothing.
pub(crate) fn prepare_thread() {
    // Held, for a channel that nobody can send to lets nobody wait.
    let (_to, nothing) = crossbeam_channel::bounded::<()>(1);
    for _ in 0..WAITS {
        let _ = nothing.recv_timeout(WAIT);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_new_queue_is_empty_and_has_its_room() {
        for (to, from) in [bounded(3), bounded_both_ways(3, || 0)] {
            assert!(from.is_empty());
            assert!((1..=3).all(|n| to.try_send(n).is_ok()));
            assert!(to.try_send(4).is_err());
            drop(to);
            assert_eq!(from.iter().collect::<Vec<_>>(), [1, 2, 3]);
        }
    }

    #[test]
    fn no_room_at_all_is_room_for_one() {
        let (to, from) = bounded_both_ways(0, || 0);
        assert!(to.try_send(1).is_ok());
        assert_eq!(from.recv(), Ok(1));
    }
}
