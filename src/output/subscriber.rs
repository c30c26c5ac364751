//! The iceoryx2 services `visod/odometry`, `visod/features` and `visod/health` in, checked messages out.

use super::features::FeaturesMessage;
use super::health::HealthMessage;
use super::ipc::{Ipc, IpcError, Payload, Services, open_node};
use super::message::OdometryMessage;
use super::publication::{Settings, events};
use iceoryx2::identifiers::UniquePublisherId;
use iceoryx2::port::{
    listener::{Listener, ListenerWaitError},
    notifier::Notifier,
    subscriber::Subscriber as Port,
    update_connections::UpdateConnections,
};
use iceoryx2::prelude::{EventId, Node, PortFactory, SignalHandlingMode};
use std::time::{Duration, Instant};

/// Receives odometry.
pub type OdometrySubscriber = Subscriber<OdometryMessage>;
/// Receives the features that estimates rest on, where they are published.
pub type FeaturesSubscriber = Subscriber<FeaturesMessage>;
/// Receives the state of the daemon.
pub type HealthSubscriber = Subscriber<HealthMessage>;

/// Longest time between two looks at what has no event: signals, and a last message that was
/// handed to a late joiner.
const SLICE: Duration = Duration::from_millis(100);

/// A message, and what went before it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Received<T> {
    /// The message, checked.
    pub message: T,
    /// How many messages of the same publisher were lost right before this one.
    pub lost_before: u64,
    /// Whether this is the first message of its publisher.
    pub new_publisher: bool,
}

/// Why a wait ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Wake {
    /// There is a message to receive.
    Message,
    /// There was none in time.
    Timeout,
    /// The process was asked to end (SIGINT or SIGTERM); only where it
    /// [handles signals](Subscriber::handling_signals).
    Terminated,
}

/// Receives messages of one kind. It may be opened before any publisher is there.
pub struct Subscriber<T: Payload> {
    messages: Port<Ipc, T, ()>,
    listener: Listener<Ipc>,
    notifier: Notifier<Ipc>,
    services: Services<T>,
    last: Option<(UniquePublisherId, u64)>,
    // Last, so that it goes after everything that lives on it.
    node: Node<Ipc>,
}

impl<T: Payload> Subscriber<T> {
    /// Opens the service, or creates it for a publisher to come. `name` is shown by iceoryx2's tools.
    ///
    /// # Errors
    /// [`IpcError`]: unusable settings, no access to shared memory, or too many subscribers.
    pub fn new(name: &str, settings: &Settings) -> Result<Self, IpcError> {
        Self::open(name, settings, SignalHandlingMode::Disabled)
    }

    /// As [`new`](Self::new), and takes over SIGINT and SIGTERM, which then end a wait.
    ///
    /// # Errors
    /// As [`new`](Self::new).
    pub fn handling_signals(name: &str, settings: &Settings) -> Result<Self, IpcError> {
        Self::open(
            name,
            settings,
            SignalHandlingMode::HandleTerminationRequests,
        )
    }

    fn open(
        name: &str,
        settings: &Settings,
        signals: SignalHandlingMode,
    ) -> Result<Self, IpcError> {
        let node = open_node(name, settings, signals)?;
        let services = Services::<T>::open(&node)?;
        // The listener first: once the subscriber is counted, it can also be woken.
        let listener = services
            .events
            .listener_builder()
            .create()
            .map_err(Services::<T>::transfer_error)?;
        let notifier = services
            .events
            .notifier_builder()
            .default_event_id(EventId::new(events::CONNECTED))
            .create()
            .map_err(Services::<T>::transfer_error)?;
        let messages = services
            .messages
            .subscriber_builder()
            .create()
            .map_err(Services::<T>::transfer_error)?;
        Ok(Self {
            messages,
            listener,
            notifier,
            services,
            last: None,
            node,
        })
    }

    /// The next message, if there is one.
    ///
    /// # Errors
    /// [`IpcError`]: a publisher could not be connected to, or sent what is not valid. The next
    /// call goes on behind it.
    pub fn receive(&mut self) -> Result<Option<Received<T>>, IpcError> {
        let sample = self
            .messages
            .receive()
            .map_err(Services::<T>::transfer_error)?;
        let Some(sample) = sample else {
            return Ok(None);
        };
        let message = *sample.payload();
        message.check()?;
        let publisher = sample.header().publisher_id();
        let number = message.message_number();
        let before = self.last.replace((publisher, number));
        let (new_publisher, lost_before) = match before {
            Some((same, last)) if same == publisher => {
                (false, number.saturating_sub(last).saturating_sub(1))
            }
            // Of a publisher met after another every message was meant for us.
            Some(_) => (true, number),
            // What went by before this subscriber came is not lost.
            None => (true, 0),
        };
        Ok(Some(Received {
            message,
            lost_before,
            new_publisher,
        }))
    }

    /// Waits for a message, without polling.
    ///
    /// # Errors
    /// [`IpcError`]: a publisher could not be connected to, or shared memory is gone.
    pub fn wait(&self, timeout: Duration) -> Result<Wake, IpcError> {
        // A deadline beyond what the clock can hold is none.
        let deadline = Instant::now().checked_add(timeout);
        loop {
            // Before the messages: a stream that never pauses must not keep the process from ending.
            if self.node.wait(Duration::ZERO).is_err() {
                return Ok(Wake::Terminated);
            }
            let waiting = self.messages.has_samples();
            if waiting.map_err(Services::<T>::transfer_error)? {
                return Ok(Wake::Message);
            }
            let left = deadline.map_or(SLICE, |d| d.saturating_duration_since(Instant::now()));
            if left.is_zero() {
                return Ok(Wake::Timeout);
            }
            self.wait_for_event(left.min(SLICE))?;
        }
    }

    /// How many publishers there are, after those that were killed have been removed.
    #[must_use]
    pub fn publishers(&self) -> usize {
        self.node.try_cleanup_dead_nodes();
        self.services
            .messages
            .dynamic_config()
            .number_of_publishers()
    }

    /// Waits for an event, and answers a publisher that leaves once nothing can be lost any more.
    fn wait_for_event(&self, timeout: Duration) -> Result<(), IpcError> {
        let mut leaving = false;
        let waited = self.listener.timed_wait(
            |event| leaving |= event.id.as_value() == events::LEAVING,
            timeout,
        );
        match waited {
            // The loop around this looks at signals.
            Ok(_) | Err(ListenerWaitError::InterruptSignal) => {}
            Err(e) => return Err(Services::<T>::transfer_error(e)),
        }
        if leaving {
            let connected = self.messages.update_connections();
            connected.map_err(Services::<T>::transfer_error)?;
            self.notifier
                .notify()
                .map_err(Services::<T>::transfer_error)?;
        }
        Ok(())
    }
}
