//! The file: channels, what goes on them, and when it is on the disk.

use crate::estimation::{Odometry, TrackedFeature};
use crate::geometry::{COVARIANCE_FILE, StereoRig, rig_to_toml, with_covariance_beside};
use crate::image::GrayImage;
use crate::output::topics::{Audience, Purpose, Topic, Topics};
use crate::ros::RIG_ATTACHMENT;
use mcap::records::MessageHeader;
use mcap::{Attachment, WriteOptions};
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::io::{self, Seek, Write};

/// Writes a recording; [`finish`](Self::finish) says whether all of it arrived. Without, and wherever the file is
/// cut, every pair that was added before can be read.
pub struct McapWriter<W: Write + Seek> {
    topics: Topics,
    channels: Channels<W>,
}

/// The file.
struct Channels<W: Write + Seek> {
    out: mcap::Writer<W>,
    /// In the order of [`Topic::ALL`].
    ids: [u16; Topic::ALL.len()],
    /// The number of the pair.
    number: u32,
}

impl<W: Write + Seek> McapWriter<W> {
    /// Begins a recording of one rig.
    ///
    /// # Errors
    /// The output cannot be written to.
    pub fn new(out: W, rig: &StereoRig) -> io::Result<Self> {
        let mut out = WriteOptions::new()
            // Images are compressed already.
            .compression(None)
            .profile("ros2")
            .library(concat!("visod ", env!("CARGO_PKG_VERSION")))
            .create(out)
            .map_err(io_error)?;
        // The covariance first: a reader that has found the rig looks no further.
        let (rig_beside, covariance) = with_covariance_beside(rig);
        if let Some(csv) = covariance {
            attach(&mut out, COVARIANCE_FILE, "text/csv", &csv)?;
        }
        let toml = rig_to_toml(&rig_beside);
        attach(&mut out, RIG_ATTACHMENT, "application/toml", &toml)?;
        let mut ids = [0; Topic::ALL.len()];
        for (id, topic) in ids.iter_mut().zip(Topic::ALL) {
            *id = add_channel(&mut out, topic).map_err(io_error)?;
        }
        Ok(Self {
            topics: Topics::new(rig, Purpose::Recording),
            channels: Channels {
                out,
                ids,
                number: 0,
            },
        })
    }

    /// Writes one pair's estimate, the features that it rests on, and its images where there are any.
    ///
    /// # Errors
    /// The output cannot be written to.
    pub fn add(
        &mut self,
        estimate: &Odometry,
        features: &[TrackedFeature],
        images: Option<[&GrayImage; 2]>,
    ) -> io::Result<()> {
        let channels = &mut self.channels;
        self.topics.tell(estimate, features, images, channels)?;
        channels.number = channels.number.wrapping_add(1);
        // Ends the chunk: one that is still open has no length yet, so that nothing in it could be read.
        channels.out.flush().map_err(io_error)
    }

    /// Ends the file with its index.
    ///
    /// # Errors
    /// What was still buffered cannot be written.
    pub fn finish(mut self) -> io::Result<()> {
        self.channels.out.finish().map_err(io_error)?;
        self.channels.out.into_inner().flush()
    }
}

impl<W: Write + Seek> Audience for Channels<W> {
    fn wants(&self, _: Topic) -> bool {
        true
    }

    fn tell(&mut self, topic: Topic, at_ns: i64, message: &[u8]) -> io::Result<()> {
        // Recordings begin at 0 at the earliest.
        let time_ns = u64::try_from(at_ns).unwrap_or(0);
        let header = MessageHeader {
            channel_id: self.ids[topic as usize],
            sequence: self.number,
            log_time: time_ns,
            publish_time: time_ns,
        };
        self.out
            .write_to_known_channel(&header, message)
            .map_err(io_error)
    }
}

fn attach<W: Write + Seek>(
    out: &mut mcap::Writer<W>,
    name: &str,
    media_type: &str,
    text: &str,
) -> io::Result<()> {
    out.attach(&Attachment {
        log_time: 0,
        create_time: 0,
        name: name.to_owned(),
        media_type: media_type.to_owned(),
        data: Cow::Borrowed(text.as_bytes()),
    })
    .map_err(io_error)
}

fn add_channel<W: Write + Seek>(out: &mut mcap::Writer<W>, topic: Topic) -> mcap::McapResult<u16> {
    let (name, definition) = topic.definition();
    let text = definition.text();
    let schema = out.add_schema(definition.name, "ros2msg", text.as_bytes())?;
    out.add_channel(schema, name, "cdr", &BTreeMap::new())
}

fn io_error(error: mcap::McapError) -> io::Error {
    match error {
        mcap::McapError::Io(error) => error,
        other => io::Error::other(other.to_string()),
    }
}
