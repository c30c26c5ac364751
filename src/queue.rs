//! A queue between threads that takes all of its memory when it is made.
//!
//! Other channels take memory when a thread has to wait for the first time, which may come after
//! any number of pairs; here a thread waits on what has been there from the beginning.

use std::collections::VecDeque;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};

/// A queue with room for `capacity` items, at least one, and its two ends, which can be cloned.
pub(crate) fn bounded<T>(capacity: usize) -> (Sender<T>, Receiver<T>) {
    let capacity = capacity.max(1);
    let shared = Arc::new(Shared {
        state: Mutex::new(State {
            items: VecDeque::with_capacity(capacity),
            senders: 1,
            receivers: 1,
        }),
        capacity,
        has_item: Condvar::new(),
        has_room: Condvar::new(),
    });
    (Sender(Arc::clone(&shared)), Receiver(shared))
}

/// Where items go in.
#[derive(Debug)]
pub(crate) struct Sender<T>(Arc<Shared<T>>);

/// Where they come out, in their order.
#[derive(Debug)]
pub(crate) struct Receiver<T>(Arc<Shared<T>>);

/// There is no receiver any more.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Closed;

#[derive(Debug)]
struct Shared<T> {
    state: Mutex<State<T>>,
    capacity: usize,
    has_item: Condvar,
    has_room: Condvar,
}

#[derive(Debug)]
struct State<T> {
    items: VecDeque<T>,
    senders: usize,
    receivers: usize,
}

impl<T> Shared<T> {
    fn lock(&self) -> MutexGuard<'_, State<T>> {
        // Nothing panics while it holds the lock; if it did, the state would still be whole.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits until the state is no longer as `is_so` says.
    fn wait_while<'a>(
        &'a self,
        changed: &Condvar,
        is_so: impl Fn(&State<T>) -> bool,
    ) -> MutexGuard<'a, State<T>> {
        changed
            .wait_while(self.lock(), |state| is_so(state))
            .unwrap_or_else(PoisonError::into_inner)
    }
}

impl<T> Sender<T> {
    /// Appends an item, waiting while there is no room.
    ///
    /// # Errors
    /// There is no receiver any more; the item is dropped.
    pub(crate) fn send(&self, item: T) -> Result<(), Closed> {
        let capacity = self.0.capacity;
        let is_full = |s: &State<T>| s.receivers > 0 && s.items.len() >= capacity;
        let mut state = self.0.wait_while(&self.0.has_room, is_full);
        if state.receivers == 0 {
            return Err(Closed);
        }
        state.items.push_back(item);
        drop(state);
        self.0.has_item.notify_one();
        Ok(())
    }
}

impl<T> Receiver<T> {
    /// The next item, waiting for it; `None` when there is none and no sender any more.
    pub(crate) fn recv(&self) -> Option<T> {
        let is_idle = |s: &State<T>| s.senders > 0 && s.items.is_empty();
        let item = self
            .0
            .wait_while(&self.0.has_item, is_idle)
            .items
            .pop_front();
        self.0.has_room.notify_one();
        item
    }
}

impl<T> Clone for Sender<T> {
    fn clone(&self) -> Self {
        self.0.lock().senders += 1;
        Self(Arc::clone(&self.0))
    }
}

impl<T> Clone for Receiver<T> {
    fn clone(&self) -> Self {
        self.0.lock().receivers += 1;
        Self(Arc::clone(&self.0))
    }
}

impl<T> Drop for Sender<T> {
    fn drop(&mut self) {
        self.0.lock().senders -= 1;
        self.0.has_item.notify_all();
    }
}

impl<T> Drop for Receiver<T> {
    fn drop(&mut self) {
        let mut state = self.0.lock();
        state.receivers -= 1;
        if state.receivers == 0 {
            // Nobody will take them: what they hold, such as the end of another queue, is let go now.
            let abandoned = std::mem::take(&mut state.items);
            drop(state);
            drop(abandoned);
        }
        self.0.has_room.notify_all();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    #[test]
    fn items_of_one_sender_come_in_order_whoever_waits() {
        for capacity in [1, 3, 1000] {
            let (to, from) = bounded(capacity);
            std::thread::scope(|scope| {
                scope.spawn(move || {
                    for n in 0..500 {
                        assert_eq!(to.send(n), Ok(()));
                    }
                });
                let received: Vec<i32> = std::iter::from_fn(|| from.recv()).collect();
                assert_eq!(received, Vec::from_iter(0..500));
            });
        }
    }

    #[test]
    fn every_item_goes_to_one_of_several_receivers() {
        let (to, from) = bounded(2);
        let takers: Vec<_> = (0..3)
            .map(|_| {
                let from = from.clone();
                std::thread::spawn(move || Vec::from_iter(std::iter::from_fn(|| from.recv())))
            })
            .collect();
        drop(from);
        let givers: Vec<_> = (0..3)
            .map(|giver| {
                let to = to.clone();
                std::thread::spawn(move || {
                    (0..100).for_each(|n| assert_eq!(to.send(100 * giver + n), Ok(())));
                })
            })
            .collect();
        drop(to);
        assert!(givers.into_iter().all(|giver| giver.join().is_ok()));
        let taken = takers.into_iter().flat_map(|taker| taker.join());
        let mut taken: Vec<i32> = taken.flatten().collect();
        taken.sort_unstable();
        assert_eq!(taken, Vec::from_iter(0..300));
    }

    #[test]
    fn what_was_sent_is_received_after_the_last_sender_has_gone() {
        let (to, from) = bounded(2);
        assert_eq!(to.send(1), Ok(()));
        drop(to);
        assert_eq!((from.recv(), from.recv()), (Some(1), None));
    }

    #[test]
    fn no_more_than_the_capacity_waits() {
        let (to, from) = bounded(2);
        let sent = Arc::new(Mutex::new(0));
        let counter = Arc::clone(&sent);
        let count = move || *counter.lock().unwrap_or_else(PoisonError::into_inner);
        let giver = std::thread::spawn(move || {
            for n in 0..4 {
                assert_eq!(to.send(n), Ok(()));
                *sent.lock().unwrap_or_else(PoisonError::into_inner) += 1;
            }
        });
        while count() < 2 {
            std::thread::yield_now();
        }
        std::thread::sleep(Duration::from_millis(20));
        assert_eq!(count(), 2);
        assert_eq!(
            Vec::from_iter(std::iter::from_fn(|| from.recv())),
            [0, 1, 2, 3]
        );
        assert!(giver.join().is_ok());
    }

    #[test]
    fn a_sender_that_waits_learns_that_nobody_receives() {
        let (to, from) = bounded(1);
        let giver = std::thread::spawn(move || [to.send(1), to.send(2), to.send(3)]);
        std::thread::sleep(Duration::from_millis(20));
        drop(from);
        let sent = giver.join().unwrap_or([Ok(()); 3]);
        assert_eq!(sent[1..], [Err(Closed); 2]);
    }

    #[test]
    fn what_is_left_is_dropped_with_the_last_receiver() {
        let (to, from) = bounded(1);
        let item = Arc::new(());
        assert_eq!(to.send(Arc::clone(&item)), Ok(()));
        drop(from);
        assert_eq!(Arc::strong_count(&item), 1);
    }
}
