//! Estimates, features and images in, what Foxglove is shown over a WebSocket out.
//!
//! The topics of a recording (see the module `topics`), images as JPEG, and besides them:
//!
//! | topic | message | holds |
//! |---|---|---|
//! | `/visod/annotations` | `foxglove.ImageAnnotations` | the features in the left image, coloured by age |
//! | `/visod/scene` | `foxglove.SceneUpdate` | the way so far, and the ellipsoid of the position |
//! | `/visod/state` | JSON | σ, error budget, latencies and counts, as plots want them |
//!
//! All of it is made on a thread of its own, and only what somebody has subscribed to; pairs for which that
//! thread has no time are left out and counted, and a client that does not read loses its oldest messages. The
//! pipeline waits for nobody.

mod scene;
mod state;

use super::background::{Background, Entry, WhenBehind, Worker};
use super::message::Latencies;
use super::topics::{Audience, Purpose, Topic, Topics};
use crate::capture::StereoPair;
use crate::estimation::{Odometry, TrackedFeature};
use crate::geometry::StereoRig;
use foxglove::messages::{ImageAnnotations, SceneUpdate};
use foxglove::{
    Channel, Context, FoxgloveError, PartialMetadata, RawChannel, Schema, WebSocketServerHandle,
};
use scene::Scene;
use std::io;
use std::net::SocketAddr;
use std::sync::Arc;

/// Messages that wait for a client before the oldest is dropped: a second or two of them.
const BACKLOG: usize = 256;

/// Shows a run to whoever connects.
pub struct FoxgloveServer {
    background: Background,
    server: Option<WebSocketServerHandle>,
    address: SocketAddr,
    // Channels live only as long as it does.
    _context: Arc<Context>,
}

impl FoxgloveServer {
    /// Listens at an address; port 0 takes one that is free.
    ///
    /// # Errors
    /// The address cannot be listened at, or the system refuses a thread.
    pub fn start(address: SocketAddr, rig: &StereoRig) -> io::Result<Self> {
        let context = Context::new();
        let presenter = Presenter::new(&context, rig).map_err(io_error)?;
        let server = context
            .websocket_server()
            .name(concat!("visod ", env!("CARGO_PKG_VERSION")))
            .bind(address.ip().to_string(), address.port())
            .message_backlog_size(BACKLOG)
            .start_blocking()
            .map_err(io_error)?;
        let port = server.port();
        Ok(Self {
            background: Background::start("foxglove", presenter, WhenBehind::LeaveOut)?,
            server: Some(server),
            address: SocketAddr::new(address.ip(), port),
            _context: context,
        })
    }

    /// Where Foxglove finds it.
    #[must_use]
    pub fn url(&self) -> String {
        format!("ws://{}", self.address)
    }

    /// Shows one pair's estimate, how long it took, the features that it rests on, and the images where there
    /// are any. Never waits.
    ///
    /// # Errors
    /// The thread that shows it has ended.
    pub fn add(
        &mut self,
        estimate: &Odometry,
        latencies: Latencies,
        tracked: impl Iterator<Item = TrackedFeature>,
        pair: Option<&StereoPair>,
    ) -> io::Result<()> {
        self.background.add(estimate, latencies, tracked, pair)
    }

    /// Pairs that were not shown because there was no time to.
    #[must_use]
    pub fn left_out(&self) -> u64 {
        self.background.left_out()
    }
}

impl Drop for FoxgloveServer {
    /// Shows what is under way and bids clients farewell.
    fn drop(&mut self) {
        let _ = self.background.end();
        if let Some(server) = self.server.take() {
            server.stop().wait_blocking();
        }
    }
}

/// Makes the messages.
struct Presenter {
    topics: Topics,
    channels: Channels,
    scene: Scene,
    annotations: Channel<ImageAnnotations>,
    scenes: Channel<SceneUpdate>,
    states: Arc<RawChannel>,
}

/// In the order of [`Topic::ALL`].
struct Channels([Arc<RawChannel>; Topic::ALL.len()]);

impl Presenter {
    fn new(context: &Arc<Context>, rig: &StereoRig) -> Result<Self, FoxgloveError> {
        let mut channels = Vec::with_capacity(Topic::ALL.len());
        for topic in Topic::ALL {
            let (name, definition) = topic.definition();
            let text = definition.text().into_bytes();
            let schema = Schema::new(definition.name, "ros2msg", text);
            let channel = context.channel_builder(name).schema(schema);
            channels.push(channel.message_encoding("cdr").build_raw()?);
        }
        let channels = channels
            .try_into()
            .map_err(|_| FoxgloveError::Unspecified("a topic has no channel".into()))?;
        let schema = Schema::new("visod.State", "jsonschema", state::SCHEMA.as_bytes());
        Ok(Self {
            topics: Topics::new(rig, Purpose::Looking),
            channels: Channels(channels),
            scene: Scene::new(rig),
            annotations: context.channel_builder("/visod/annotations").build(),
            scenes: context.channel_builder("/visod/scene").build(),
            states: context
                .channel_builder("/visod/state")
                .schema(schema)
                .message_encoding("json")
                .build_raw()?,
        })
    }
}

impl Worker for Presenter {
    fn work(&mut self, entry: &Entry) -> io::Result<()> {
        let Some(estimate) = &entry.estimate else {
            return Ok(());
        };
        let (features, images) = (&entry.features, entry.images());
        self.topics
            .tell(estimate, features, images, &mut self.channels)?;
        let at = metadata(estimate.timestamp_ns);
        if self.annotations.has_sinks() {
            let annotations = scene::annotations(estimate.timestamp_ns, features);
            self.annotations.log_with_meta(&annotations, at);
        }
        self.scene.go(estimate);
        if self.scenes.has_sinks() {
            self.scenes.log_with_meta(&self.scene.update(estimate), at);
        }
        if self.states.has_sinks() {
            let state = state::of(estimate, &entry.latencies).to_string();
            self.states.log_with_meta(state.as_bytes(), at);
        }
        Ok(())
    }

    fn finish(self) -> io::Result<()> {
        Ok(())
    }
}

impl Audience for Channels {
    fn wants(&self, topic: Topic) -> bool {
        self.0[topic as usize].has_sinks()
    }

    fn tell(&mut self, topic: Topic, at_ns: i64, message: &[u8]) -> io::Result<()> {
        self.0[topic as usize].log_with_meta(message, metadata(at_ns));
        Ok(())
    }
}

fn metadata(at_ns: i64) -> PartialMetadata {
    PartialMetadata::with_log_time(u64::try_from(at_ns).unwrap_or(0))
}

fn io_error(error: FoxgloveError) -> io::Error {
    io::Error::other(error.to_string())
}
