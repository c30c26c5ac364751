//! The file: what goes on which topic.

use super::convert::{Frames, OPTICAL, diagnostics, header};
use crate::estimation::{Odometry, Status};
use crate::geometry::{StereoRig, rig_to_toml};
use crate::image::GrayImage;
use crate::ros::definitions::{
    CAMERA_INFO, COMPRESSED_IMAGE, DIAGNOSTIC_ARRAY, Definition, ODOMETRY, TF_MESSAGE,
};
use crate::ros::messages::{CameraInfo, CompressedImage};
use crate::ros::{self, Bytes, RIG_ATTACHMENT, camera_info};
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};
use mcap::records::MessageHeader;
use mcap::{Attachment, WriteOptions};
use serde::Serialize;
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::io::{self, Seek, Write};

/// Diagnostics come at least so often, ns; so long is also the most that a cut can cost.
const PERIOD_NS: i64 = 1_000_000_000;

/// Writes a recording; [`finish`](Self::finish) says whether all of it arrived. Without, what was
/// written can be read up to the last second.
pub struct McapWriter<W: Write + Seek> {
    out: mcap::Writer<W>,
    frames: Frames,
    infos: Option<[CameraInfo; 2]>,
    odometry: u16,
    tf: u16,
    tf_static: u16,
    diagnostics: u16,
    images: [u16; 2],
    camera_infos: [u16; 2],
    number: u32,
    /// When diagnostics were written last, and what they said.
    told: Option<(i64, Status)>,
    bytes: Vec<u8>,
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
        let toml = rig_to_toml(rig);
        out.attach(&Attachment {
            log_time: 0,
            create_time: 0,
            name: RIG_ATTACHMENT.to_owned(),
            media_type: "application/toml".to_owned(),
            data: Cow::Borrowed(toml.as_bytes()),
        })
        .map_err(io_error)?;
        let mut channel = |topic: &str, definition: &Definition| {
            add_channel(&mut out, topic, definition).map_err(io_error)
        };
        let [odometry, tf, tf_static, diagnostics] = [
            channel("/visod/odometry", &ODOMETRY)?,
            channel("/tf", &TF_MESSAGE)?,
            channel("/tf_static", &TF_MESSAGE)?,
            channel("/diagnostics", &DIAGNOSTIC_ARRAY)?,
        ];
        let images = [
            channel("/left/image_raw/compressed", &COMPRESSED_IMAGE)?,
            channel("/right/image_raw/compressed", &COMPRESSED_IMAGE)?,
        ];
        let camera_infos = [
            channel("/left/camera_info", &CAMERA_INFO)?,
            channel("/right/camera_info", &CAMERA_INFO)?,
        ];
        Ok(Self {
            out,
            frames: Frames::new(rig.base_from_camera, rig.right_from_left),
            infos: camera_info::of_rig(rig),
            odometry,
            tf,
            tf_static,
            diagnostics,
            images,
            camera_infos,
            number: 0,
            told: None,
            bytes: Vec::new(),
        })
    }

    /// Writes one pair's estimate, and its images where there are any.
    ///
    /// # Errors
    /// The output cannot be written to.
    pub fn add(&mut self, estimate: &Odometry, images: Option<[&GrayImage; 2]>) -> io::Result<()> {
        let at_ns = estimate.timestamp_ns;
        if let Some(images) = images {
            self.add_images(at_ns, images)?;
        }
        if self.number == 0 {
            self.write(self.tf_static, at_ns, &self.frames.fixed(at_ns))?;
        }
        let odometry = self.frames.odometry(estimate);
        self.write(self.odometry, at_ns, &odometry)?;
        self.write(self.tf, at_ns, &self.frames.moving(&odometry))?;
        let is_news = self.told.is_none_or(|(told_ns, status)| {
            status != estimate.status || at_ns.saturating_sub(told_ns) >= PERIOD_NS
        });
        if is_news {
            self.told = Some((at_ns, estimate.status));
            self.write(self.diagnostics, at_ns, &diagnostics(estimate))?;
            self.out.flush().map_err(io_error)?;
        }
        self.number = self.number.wrapping_add(1);
        Ok(())
    }

    fn add_images(&mut self, at_ns: i64, images: [&GrayImage; 2]) -> io::Result<()> {
        let (left, right) = rayon::join(|| png(images[0]), || png(images[1]));
        for (side, file) in [left?, right?].into_iter().enumerate() {
            let message = CompressedImage {
                header: header(OPTICAL[side], at_ns),
                format: "mono8; png compressed mono8".to_owned(),
                data: Bytes(file),
            };
            self.write(self.images[side], at_ns, &message)?;
            if let Some(infos) = &mut self.infos {
                infos[side].header = message.header;
                let info = infos[side].clone();
                self.write(self.camera_infos[side], at_ns, &info)?;
            }
        }
        Ok(())
    }

    fn write(&mut self, channel_id: u16, at_ns: i64, message: &impl Serialize) -> io::Result<()> {
        self.bytes.clear();
        ros::encode(message, &mut self.bytes).map_err(io::Error::other)?;
        // Recordings begin at 0 at the earliest.
        let time_ns = u64::try_from(at_ns).unwrap_or(0);
        let header = MessageHeader {
            channel_id,
            sequence: self.number,
            log_time: time_ns,
            publish_time: time_ns,
        };
        self.out
            .write_to_known_channel(&header, &self.bytes)
            .map_err(io_error)
    }

    /// Ends the file with its index.
    ///
    /// # Errors
    /// What was still buffered cannot be written.
    pub fn finish(mut self) -> io::Result<()> {
        self.out.finish().map_err(io_error)?;
        self.out.into_inner().flush()
    }
}

fn add_channel<W: Write + Seek>(
    out: &mut mcap::Writer<W>,
    topic: &str,
    definition: &Definition,
) -> mcap::McapResult<u16> {
    let text = definition.text();
    let schema = out.add_schema(definition.name, "ros2msg", text.as_bytes())?;
    out.add_channel(schema, topic, "cdr", &BTreeMap::new())
}

fn png(image: &GrayImage) -> io::Result<Vec<u8>> {
    let mut file = Vec::with_capacity(image.pixels().len());
    PngEncoder::new_with_quality(&mut file, CompressionType::Fast, FilterType::Sub)
        .write_image(
            image.pixels(),
            image.width(),
            image.height(),
            ExtendedColorType::L8,
        )
        .map_err(io::Error::other)?;
    Ok(file)
}

fn io_error(error: mcap::McapError) -> io::Error {
    match error {
        mcap::McapError::Io(error) => error,
        other => io::Error::other(other.to_string()),
    }
}
