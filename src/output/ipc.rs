//! What publisher and subscriber share: an iceoryx2 node, and the two services of each name.

use super::features::FeaturesMessage;
use super::health::HealthMessage;
use super::message::{MessageError, OdometryMessage};
use super::publication::{
    FEATURES_BUFFER, FEATURES_SERVICE, HEALTH_BUFFER, HEALTH_SERVICE, MAX_NODES, MAX_PUBLISHERS,
    MAX_SUBSCRIBERS, ODOMETRY_BUFFER, ODOMETRY_SERVICE, Settings, events,
};
use super::room;
use crate::settings::SettingError;
use iceoryx2::prelude::{
    Config, FileName, Node, NodeBuilder, NodeName, Path, SemanticString, ServiceName,
    SignalHandlingMode, ZeroCopySend, ipc_threadsafe,
};
use iceoryx2::service::port_factory::{event, publish_subscribe};
use std::time::Duration;

/// The variant of iceoryx2 in use: between processes, and its ports may move between threads. It
/// meets processes that use the single-threaded variant, and those in other languages.
pub(super) type Ipc = ipc_threadsafe::Service;

/// Why something could not be published or received.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum IpcError {
    /// The settings cannot be used.
    #[error("publish.{key}: {cause}")]
    Setting {
        /// The key.
        key: &'static str,
        /// What is wrong with its value.
        cause: String,
    },
    /// iceoryx2 does not let this process in.
    #[error("cannot use shared memory below {root}: {cause}")]
    Node {
        /// iceoryx2's root directory.
        root: String,
        /// Its reason.
        cause: String,
    },
    /// A service cannot be opened or created.
    #[error("cannot open the iceoryx2 service {service} below {root}: {cause}")]
    Service {
        /// The service.
        service: &'static str,
        /// iceoryx2's root directory.
        root: String,
        /// Its reason.
        cause: String,
    },
    /// Another process publishes already.
    #[error(
        "another process already publishes {service} below {root} with prefix {prefix}: end it, give this one another publish.prefix, or allow both by publish.exclusive = false"
    )]
    AnotherPublisher {
        /// The service.
        service: &'static str,
        /// iceoryx2's root directory.
        root: String,
        /// iceoryx2's prefix.
        prefix: String,
    },
    /// A message could not be sent or fetched.
    #[error("{service}: {cause}")]
    Transfer {
        /// The service.
        service: &'static str,
        /// iceoryx2's reason.
        cause: String,
    },
    /// A message came that cannot be used, or was about to be published.
    #[error(transparent)]
    Message(#[from] MessageError),
}

impl From<SettingError> for IpcError {
    fn from(error: SettingError) -> Self {
        Self::Setting {
            key: error.key,
            cause: error.cause,
        }
    }
}

/// A message that has a service.
pub trait Payload: ZeroCopySend + std::fmt::Debug + Copy + Send + 'static {
    /// The service's name.
    const SERVICE: &'static str;
    /// How many messages wait for a subscriber.
    const BUFFER: usize;

    /// The message's number among its publisher's.
    fn message_number(&self) -> u64;

    /// Fills in what only the publisher knows.
    fn stamp(&mut self, message_number: u64, monotonic_ns: i64);

    /// Whether the message can be used.
    ///
    /// # Errors
    /// [`MessageError`] says why not.
    fn check(&self) -> Result<(), MessageError>;
}

impl Payload for OdometryMessage {
    const SERVICE: &'static str = ODOMETRY_SERVICE;
    const BUFFER: usize = ODOMETRY_BUFFER;

    fn message_number(&self) -> u64 {
        self.message_number
    }

    fn stamp(&mut self, message_number: u64, monotonic_ns: i64) {
        self.message_number = message_number;
        self.published_monotonic_ns = monotonic_ns;
    }

    fn check(&self) -> Result<(), MessageError> {
        self.validate()
    }
}

impl Payload for FeaturesMessage {
    const SERVICE: &'static str = FEATURES_SERVICE;
    const BUFFER: usize = FEATURES_BUFFER;

    fn message_number(&self) -> u64 {
        self.message_number
    }

    fn stamp(&mut self, message_number: u64, monotonic_ns: i64) {
        self.message_number = message_number;
        self.published_monotonic_ns = monotonic_ns;
    }

    fn check(&self) -> Result<(), MessageError> {
        self.validate()
    }
}

impl Payload for HealthMessage {
    const SERVICE: &'static str = HEALTH_SERVICE;
    const BUFFER: usize = HEALTH_BUFFER;

    fn message_number(&self) -> u64 {
        self.message_number
    }

    fn stamp(&mut self, message_number: u64, monotonic_ns: i64) {
        self.message_number = message_number;
        self.monotonic_ns = monotonic_ns;
        self.realtime_ns = realtime_ns();
    }

    fn check(&self) -> Result<(), MessageError> {
        self.validate()
    }
}

/// CLOCK_MONOTONIC, ns.
#[must_use]
pub fn monotonic_ns() -> i64 {
    clock_ns(rustix::time::ClockId::Monotonic)
}

/// CLOCK_REALTIME, ns.
#[must_use]
pub fn realtime_ns() -> i64 {
    clock_ns(rustix::time::ClockId::Realtime)
}

fn clock_ns(clock: rustix::time::ClockId) -> i64 {
    let now = rustix::time::clock_gettime(clock);
    now.tv_sec * 1_000_000_000 + now.tv_nsec
}

/// Opens a node: this process's entry among those that use iceoryx2. What earlier processes left
/// behind when they were killed is removed on the way.
pub(super) fn open_node(
    name: &str,
    settings: &Settings,
    signals: SignalHandlingMode,
) -> Result<Node<Ipc>, IpcError> {
    settings.check()?;
    // iceoryx2 logs on stderr by itself; here its errors come back as values.
    iceoryx2::prelude::set_log_level_from_env_or(iceoryx2::prelude::LogLevel::Fatal);
    let config = configuration(settings)?;
    let failed = |cause: String| IpcError::Node {
        root: config.global.root_path().to_string(),
        cause,
    };
    room::check().map_err(failed)?;
    let name = NodeName::new(name).map_err(|e| failed(e.to_string()))?;
    NodeBuilder::new()
        .name(&name)
        .config(&config)
        .signal_handling_mode(signals)
        .create::<Ipc>()
        .map_err(|e| {
            // iceoryx2 calls this an internal error.
            if belongs_to_another(&config.global.root_path().to_string()) {
                failed("it belongs to another user, whom this process must run as".to_owned())
            } else {
                failed(explain(&format!("{e:?}")))
            }
        })
}

/// Whether a directory is another user's, or may not even be looked into.
fn belongs_to_another(directory: &str) -> bool {
    use std::os::unix::fs::MetadataExt;
    let owner = std::fs::metadata(directory).map(|m| m.uid());
    let is_closed = std::fs::read_dir(directory)
        .is_err_and(|e| e.kind() == std::io::ErrorKind::PermissionDenied);
    is_closed || owner.is_ok_and(|owner| owner != rustix::process::geteuid().as_raw())
}

/// iceoryx2's own configuration with what the settings say otherwise.
fn configuration(settings: &Settings) -> Result<Config, IpcError> {
    let mut config = Config::global_config().clone();
    // A killed process must not keep its place, whatever the configuration file says.
    config.global.node.cleanup_dead_nodes_on_creation = true;
    config.global.service.cleanup_dead_nodes_on_open = true;
    if let Some(root) = &settings.root {
        let root = Path::new(root.as_os_str().as_encoded_bytes())
            .map_err(|e| unusable("root", &format!("{e:?}")))?;
        config.global.set_root_path(&root);
    }
    if let Some(prefix) = &settings.prefix {
        config.global.prefix =
            FileName::new(prefix.as_bytes()).map_err(|e| unusable("prefix", &format!("{e:?}")))?;
    }
    Ok(config)
}

fn unusable(key: &'static str, cause: &str) -> IpcError {
    IpcError::Setting {
        key,
        cause: format!("iceoryx2 refuses it: {cause}"),
    }
}

/// The messages of a name, and the events beside them.
pub(super) struct Services<T: Payload> {
    pub(super) messages: publish_subscribe::PortFactory<Ipc, T, ()>,
    pub(super) events: event::PortFactory<Ipc>,
}

impl<T: Payload> Services<T> {
    /// Opens both, or creates them. Whoever comes first, publisher or subscriber, decides the
    /// sizes; hence all use these.
    pub(super) fn open(node: &Node<Ipc>) -> Result<Self, IpcError> {
        let failed = |cause: String| IpcError::Service {
            service: T::SERVICE,
            root: node.config().global.root_path().to_string(),
            cause,
        };
        let name = ServiceName::new(T::SERVICE).map_err(|e| failed(e.to_string()))?;
        let messages = retried(|| {
            node.service_builder(&name)
                .publish_subscribe::<T>()
                .enable_safe_overflow(true)
                .subscriber_max_buffer_size(T::BUFFER)
                .history_size(1)
                .max_subscribers(MAX_SUBSCRIBERS)
                .max_publishers(MAX_PUBLISHERS)
                .max_nodes(MAX_NODES)
                .open_or_create()
        })
        .map_err(|e| failed(explain(&e)))?;
        let events = retried(|| {
            node.service_builder(&name)
                .event()
                .event_id_max_value(events::MAX)
                .max_listeners(MAX_SUBSCRIBERS + MAX_PUBLISHERS)
                .max_notifiers(MAX_SUBSCRIBERS + MAX_PUBLISHERS)
                .max_nodes(MAX_NODES)
                .open_or_create()
        })
        .map_err(|e| failed(explain(&e)))?;
        Ok(Self { messages, events })
    }

    /// The error that something did not get through.
    pub(super) fn transfer_error(cause: impl std::fmt::Debug) -> IpcError {
        IpcError::Transfer {
            service: T::SERVICE,
            cause: explain(&format!("{cause:?}")),
        }
    }
}

/// Tries again for a second what fails because another process opens or closes the same service at
/// this very moment.
fn retried<S, E: std::fmt::Debug>(mut open: impl FnMut() -> Result<S, E>) -> Result<S, String> {
    const TRIES: u32 = 40;
    let mut tries = 0;
    loop {
        let cause = match open() {
            Ok(service) => return Ok(service),
            Err(e) => format!("{e:?}"),
        };
        tries += 1;
        let passing = [
            "InFlux",
            "BeingCreated",
            "MarkedForDestruction",
            "DoesNotExist",
            "AlreadyExists",
            "HangsInCreation",
        ];
        if tries == TRIES || !passing.iter().any(|word| cause.contains(word)) {
            return Err(cause);
        }
        std::thread::sleep(Duration::from_millis(25));
    }
}

/// iceoryx2's reasons in words, where a user can do something about them.
fn explain(cause: &str) -> String {
    let advice = if cause.contains("InsufficientPermissions") {
        "its files belong to another user"
    } else if cause.contains("IncompatibleTypes") || cause.contains("VersionMismatch") {
        "a process of another version uses it"
    } else if cause.contains("DoesNotSupportRequested") {
        "a process that has it open created it with other sizes: end that process and start again"
    } else if cause.contains("ResourceCreationFailed") {
        "its socket cannot be created, perhaps since the root's path is too long"
    } else if cause.contains("ExceedsMax") {
        "too many processes use it already"
    } else {
        return cause.to_owned();
    };
    format!("{advice} ({cause})")
}
