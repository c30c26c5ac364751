//! Odometry, features and health in, the iceoryx2 services `visod/odometry`, `visod/features` and
//! `visod/health` out.
//!
//! Each message is written straight into shared memory (all that is allocated is one small block of
//! iceoryx2's own), and an event of the service of the same name wakes those who wait. A subscriber that is slow loses its oldest
//! messages and never holds the publisher up; one that comes late gets the last message.
//!
//! # Who may listen
//!
//! iceoryx2 creates its files for the publisher's own user (mode 0600, directories 0750). A process
//! of another user is refused, or, where it may create a root of its own, receives nothing; run
//! consumers as the daemon's user. The only wider access that iceoryx2 offers is its Cargo feature
//! `dev_permissions`, which lets every local user read *and write*, and is not used here: whoever
//! can write could forge poses.

use super::features::FeaturesMessage;
use super::health::HealthMessage;
use super::ipc::{Ipc, IpcError, Payload, Services, monotonic_ns, open_node};
use super::message::OdometryMessage;
use super::publication::{Settings, events};
use super::room;
use iceoryx2::port::{
    notifier::Notifier, publisher::Publisher as Port, update_connections::UpdateConnections,
};
use iceoryx2::prelude::{EventId, Node, PortFactory, SignalHandlingMode};
use std::time::{Duration, Instant};

/// How often something that has no event is looked at.
const POLL: Duration = Duration::from_millis(5);

/// Publishes odometry and health. Dropping it leaves in good order: see [`close`](Self::close).
pub struct Publisher {
    odometry: Channel<OdometryMessage>,
    features: Option<Channel<FeaturesMessage>>,
    health: Channel<HealthMessage>,
    linger: Duration,
    // Last, so that it goes after everything that lives on it.
    _node: Node<Ipc>,
}

impl Publisher {
    /// Opens the services for publishing, that of features where the settings want it, and removes what killed processes left in them.
    ///
    /// # Errors
    /// [`IpcError`]: unusable settings, no access to shared memory, or another publisher while
    /// `exclusive` is set.
    pub fn new(settings: &Settings) -> Result<Self, IpcError> {
        let node = open_node("visod", settings, SignalHandlingMode::Disabled)?;
        let odometry = Channel::open(&node, settings.exclusive)?;
        let health = Channel::open(&node, settings.exclusive)?;
        let features = settings
            .features
            .then(|| Channel::open(&node, settings.exclusive))
            .transpose()?;
        let global = &node.config().global;
        room::take(&global.prefix.to_string()).map_err(|cause| IpcError::Node {
            root: global.root_path().to_string(),
            cause,
        })?;
        Ok(Self {
            odometry,
            features,
            health,
            linger: Duration::from_millis(settings.linger_ms),
            _node: node,
        })
    }

    /// Publishes an estimate to all subscribers, whose number comes back. Never waits for them.
    ///
    /// # Errors
    /// [`IpcError`]: the message is not valid, or shared memory is gone.
    pub fn publish(&mut self, message: &OdometryMessage) -> Result<usize, IpcError> {
        self.odometry.send(message)
    }

    /// Whether features are wanted at all.
    #[must_use]
    pub fn publishes_features(&self) -> bool {
        self.features.is_some()
    }

    /// Publishes the features that an estimate rests on; nobody gets them unless the settings want it.
    ///
    /// # Errors
    /// As [`publish`](Self::publish).
    pub fn publish_features(&mut self, message: &FeaturesMessage) -> Result<usize, IpcError> {
        self.features
            .as_mut()
            .map_or(Ok(0), |features| features.send(message))
    }

    /// Publishes the state of the daemon; stamps are filled in here.
    ///
    /// # Errors
    /// As [`publish`](Self::publish).
    pub fn publish_health(&mut self, message: &HealthMessage) -> Result<usize, IpcError> {
        self.health.send(message)
    }

    /// Hands the last messages to those who came since. Each `publish` does it too; while there is
    /// nothing to publish, call this now and then.
    ///
    /// # Errors
    /// [`IpcError`]: shared memory is gone.
    pub fn serve_late_joiners(&self) -> Result<(), IpcError> {
        self.odometry.serve_late_joiners()?;
        if let Some(features) = &self.features {
            features.serve_late_joiners()?;
        }
        self.health.serve_late_joiners()
    }

    /// How many subscribers odometry has.
    #[must_use]
    pub fn subscribers(&self) -> usize {
        self.odometry.subscribers()
    }

    /// How many subscribers features have.
    #[must_use]
    pub fn features_subscribers(&self) -> usize {
        self.features.as_ref().map_or(0, Channel::subscribers)
    }

    /// Waits until odometry has that many subscribers; false if the time ran out first.
    #[must_use]
    pub fn wait_for_subscribers(&self, count: usize, timeout: Duration) -> bool {
        let start = Instant::now();
        while self.subscribers() < count {
            if start.elapsed() >= timeout {
                return false;
            }
            std::thread::sleep(POLL);
        }
        true
    }

    /// Leaves: waits, at most `linger_ms`, until every subscriber has connected to what was sent,
    /// since messages of a publisher that is gone reach only those who had connected before.
    pub fn close(self) {}
}

impl Drop for Publisher {
    fn drop(&mut self) {
        let deadline = Instant::now() + self.linger;
        self.odometry.linger(deadline);
        if let Some(features) = &self.features {
            features.linger(deadline);
        }
        self.health.linger(deadline);
    }
}

/// The publishing ends of one name.
struct Channel<T: Payload> {
    messages: Port<Ipc, T, ()>,
    notifier: Notifier<Ipc>,
    services: Services<T>,
    next_number: u64,
}

impl<T: Payload> Channel<T> {
    fn open(node: &Node<Ipc>, exclusive: bool) -> Result<Self, IpcError> {
        let services = Services::<T>::open(node)?;
        if exclusive {
            wait_until_alone(&services, node)?;
        }
        let messages = services
            .messages
            .publisher_builder()
            .create()
            .map_err(Services::<T>::transfer_error)?;
        let notifier = services
            .events
            .notifier_builder()
            .default_event_id(EventId::new(events::PUBLISHED))
            .create()
            .map_err(Services::<T>::transfer_error)?;
        Ok(Self {
            messages,
            notifier,
            services,
            next_number: 0,
        })
    }

    fn send(&mut self, message: &T) -> Result<usize, IpcError> {
        message.check()?;
        let sample = self
            .messages
            .loan_uninit()
            .map_err(Services::<T>::transfer_error)?;
        let mut sample = sample.write_payload(*message);
        sample.payload_mut().stamp(self.next_number, monotonic_ns());
        let receivers = sample.send().map_err(Services::<T>::transfer_error)?;
        self.next_number += 1;
        self.notifier
            .notify()
            .map_err(Services::<T>::transfer_error)?;
        Ok(receivers)
    }

    fn serve_late_joiners(&self) -> Result<(), IpcError> {
        self.messages
            .update_connections()
            .map_err(Services::<T>::transfer_error)
    }

    fn subscribers(&self) -> usize {
        self.services
            .messages
            .dynamic_config()
            .number_of_subscribers()
    }

    /// Tells subscribers that this publisher leaves, and waits until all have answered.
    fn linger(&self, deadline: Instant) {
        let expected = self.subscribers() as u64;
        if expected == 0 || self.next_number == 0 || self.serve_late_joiners().is_err() {
            return;
        }
        // Made only now: nobody would read what a listener of the publisher's own collects before.
        let Ok(answers) = self.services.events.listener_builder().create() else {
            return;
        };
        let leaving = EventId::new(events::LEAVING);
        if self.notifier.notify_with_custom_event_id(leaving).is_err() {
            return;
        }
        let mut connected = 0;
        // Those who leave instead of answering are not waited for, once all have left.
        while connected < expected && self.subscribers() > 0 {
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return;
            }
            let waited = answers.timed_wait(
                |event| {
                    if event.id.as_value() == events::CONNECTED {
                        connected += event.count;
                    }
                },
                left.min(POLL),
            );
            if waited.is_err() {
                return;
            }
        }
    }
}

/// Waits a moment for a publisher that is just leaving.
fn wait_until_alone<T: Payload>(services: &Services<T>, node: &Node<Ipc>) -> Result<(), IpcError> {
    let patience = Instant::now() + Duration::from_secs(1);
    while services.messages.dynamic_config().number_of_publishers() > 0 {
        if Instant::now() >= patience {
            let config = node.config();
            return Err(IpcError::AnotherPublisher {
                service: T::SERVICE,
                root: config.global.root_path().to_string(),
                prefix: config.global.prefix.to_string(),
            });
        }
        std::thread::sleep(POLL);
    }
    Ok(())
}
