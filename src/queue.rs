//! The bounded queues between threads: crossbeam's, with the memory for waiting taken at the start.
//!
//! A channel keeps a list of who waits on it, and a thread a token to wait with; both are made at the
//! first wait, which may come after any number of pairs. Here it comes before the first.

use crossbeam_channel::{Receiver, Select, Sender};

/// A queue with room for `capacity` items, at least one, whose receivers may have to wait.
pub(crate) fn bounded<T>(capacity: usize) -> (Sender<T>, Receiver<T>) {
    let (to, from) = crossbeam_channel::bounded(capacity.max(1));
    let mut wait = Select::new();
    wait.recv(&from);
    begin_to_wait(&mut wait);
    drop(wait);
    (to, from)
}

/// The same, where senders may have to wait, too; `blank` makes an item that stands for none.
pub(crate) fn bounded_both_ways<T>(
    capacity: usize,
    blank: impl Fn() -> T,
) -> (Sender<T>, Receiver<T>) {
    let (to, from) = bounded(capacity);
    while to.try_send(blank()).is_ok() {}
    let mut wait = Select::new();
    wait.send(&to);
    begin_to_wait(&mut wait);
    drop(wait);
    while from.try_recv().is_ok() {}
    (to, from)
}

/// Has the calling thread begin to wait, on nothing.
pub(crate) fn prepare_thread() {
    drop(bounded::<()>(1));
}

/// Enters the calling thread in the list of those who wait for what cannot happen, and strikes it out
/// again: a select does so even where it is only to try.
fn begin_to_wait(wait: &mut Select<'_>) {
    let tried = wait.try_select();
    debug_assert!(tried.is_err(), "nobody else has an end of the queue");
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
