//! One pair's estimate, features and images in, messages of ROS 2 on their topics out: what a recording holds
//! and what Foxglove is shown.
//!
//! | topic | message | holds |
//! |---|---|---|
//! | `/visod/odometry` | `nav_msgs/Odometry` | pose and velocity with their covariances |
//! | `/visod/features` | `sensor_msgs/PointCloud2` | the features that each estimate rests on: point, `age`, `id`, pixels, covariance |
//! | `/tf`, `/tf_static` | `tf2_msgs/TFMessage` | the same pose; where the cameras are |
//! | `/diagnostics` | `diagnostic_msgs/DiagnosticArray` | state and counts, every second and on change |
//! | `/left/image_raw/compressed`, `/right/…` | `sensor_msgs/CompressedImage` | images |
//! | `/left/camera_info`, `/right/…` | `sensor_msgs/CameraInfo` | calibrations |

mod convert;
mod points;

use crate::estimation::{Odometry, Status, TrackedFeature};
use crate::geometry::StereoRig;
use crate::image::GrayImage;
use crate::ros::definitions::{
    CAMERA_INFO, COMPRESSED_IMAGE, DIAGNOSTIC_ARRAY, Definition, ODOMETRY, POINT_CLOUD2, TF_MESSAGE,
};
use crate::ros::messages::{CameraInfo, CompressedImage};
use crate::ros::{self, Bytes, camera_info};
pub(super) use convert::Frames;
use convert::{OPTICAL, diagnostics, header};
use image::codecs::jpeg::JpegEncoder;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};
use serde::Serialize;
use std::io;

/// Diagnostics come at least so often, ns.
const PERIOD_NS: i64 = 1_000_000_000;
/// Of images that somebody only looks at, per cent.
const JPEG_QUALITY: u8 = 80;

/// A topic.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Topic {
    Odometry,
    Features,
    Tf,
    TfStatic,
    Diagnostics,
    LeftImage,
    RightImage,
    LeftInfo,
    RightInfo,
}

impl Topic {
    pub(super) const ALL: [Self; 9] = [
        Self::Odometry,
        Self::Features,
        Self::Tf,
        Self::TfStatic,
        Self::Diagnostics,
        Self::LeftImage,
        Self::RightImage,
        Self::LeftInfo,
        Self::RightInfo,
    ];

    /// Its name, and what is told on it.
    pub(super) fn definition(self) -> (&'static str, &'static Definition) {
        match self {
            Self::Odometry => ("/visod/odometry", &ODOMETRY),
            Self::Features => ("/visod/features", &POINT_CLOUD2),
            Self::Tf => ("/tf", &TF_MESSAGE),
            Self::TfStatic => ("/tf_static", &TF_MESSAGE),
            Self::Diagnostics => ("/diagnostics", &DIAGNOSTIC_ARRAY),
            Self::LeftImage => ("/left/image_raw/compressed", &COMPRESSED_IMAGE),
            Self::RightImage => ("/right/image_raw/compressed", &COMPRESSED_IMAGE),
            Self::LeftInfo => ("/left/camera_info", &CAMERA_INFO),
            Self::RightInfo => ("/right/camera_info", &CAMERA_INFO),
        }
    }
}

/// Who messages are for.
pub(super) trait Audience {
    /// Whether somebody listens to a topic: else nothing is made for it.
    fn wants(&self, topic: Topic) -> bool;

    /// Takes a message in CDR, of a pair that was taken at `at_ns`.
    ///
    /// # Errors
    /// It cannot be handed on.
    fn tell(&mut self, topic: Topic, at_ns: i64, message: &[u8]) -> io::Result<()>;
}

/// What messages are for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Purpose {
    /// To be kept: images lose nothing, and what stays is told once.
    #[cfg_attr(
        not(feature = "mcap"),
        expect(dead_code, reason = "nothing is recorded")
    )]
    Recording,
    /// To be looked at: images are small, and who comes late is told all within a second.
    Looking,
}

/// Puts the pairs of one run into messages.
pub(super) struct Topics {
    frames: Frames,
    infos: Option<[CameraInfo; 2]>,
    purpose: Purpose,
    has_begun: bool,
    /// When diagnostics were told last, and what they said.
    told: Option<(i64, Status)>,
    bytes: Vec<u8>,
}

impl Topics {
    pub(super) fn new(rig: &StereoRig, purpose: Purpose) -> Self {
        Self {
            frames: Frames::new(rig.base_from_camera, rig.right_from_left),
            infos: camera_info::of_rig(rig),
            purpose,
            has_begun: false,
            told: None,
            bytes: Vec::new(),
        }
    }

    /// Tells of one pair: its images where there are any, its estimate, the features that this rests on.
    ///
    /// # Errors
    /// The audience's.
    pub(super) fn tell(
        &mut self,
        estimate: &Odometry,
        features: &[TrackedFeature],
        images: Option<[&GrayImage; 2]>,
        audience: &mut impl Audience,
    ) -> io::Result<()> {
        let at_ns = estimate.timestamp_ns;
        if let Some(images) = images {
            self.tell_images(at_ns, images, audience)?;
        }
        let is_news = self.told.is_none_or(|(told_ns, status)| {
            status != estimate.status || at_ns.saturating_sub(told_ns) >= PERIOD_NS
        });
        if !self.has_begun || (is_news && self.purpose == Purpose::Looking) {
            self.has_begun = true;
            let fixed = self.frames.fixed(at_ns);
            self.say(Topic::TfStatic, at_ns, &fixed, audience)?;
        }
        let odometry = self.frames.odometry(estimate);
        self.say(Topic::Odometry, at_ns, &odometry, audience)?;
        let moving = self.frames.moving(&odometry);
        self.say(Topic::Tf, at_ns, &moving, audience)?;
        if audience.wants(Topic::Features) {
            let cloud = points::cloud(at_ns, features);
            self.say(Topic::Features, at_ns, &cloud, audience)?;
        }
        if is_news {
            self.told = Some((at_ns, estimate.status));
            self.say(Topic::Diagnostics, at_ns, &diagnostics(estimate), audience)?;
        }
        Ok(())
    }

    fn tell_images(
        &mut self,
        at_ns: i64,
        images: [&GrayImage; 2],
        audience: &mut impl Audience,
    ) -> io::Result<()> {
        let topics = [
            (Topic::LeftImage, Topic::LeftInfo),
            (Topic::RightImage, Topic::RightInfo),
        ];
        let is_wanted = topics.map(|(image, _)| audience.wants(image));
        let encoded = |side: usize| {
            let image = images[side];
            is_wanted[side].then(|| self.encode(image)).transpose()
        };
        let (left, right) = rayon::join(|| encoded(0), || encoded(1));
        for (side, file) in [left?, right?].into_iter().enumerate() {
            let (image, info) = topics[side];
            if let Some(file) = file {
                let message = CompressedImage {
                    header: header(OPTICAL[side], at_ns),
                    format: format!("mono8; {} compressed mono8", self.suffix()),
                    data: Bytes(file),
                };
                self.say(image, at_ns, &message, audience)?;
            }
            if let Some(infos) = &mut self.infos {
                infos[side].header = header(OPTICAL[side], at_ns);
                let message = infos[side].clone();
                self.say(info, at_ns, &message, audience)?;
            }
        }
        Ok(())
    }

    fn say(
        &mut self,
        topic: Topic,
        at_ns: i64,
        message: &impl Serialize,
        audience: &mut impl Audience,
    ) -> io::Result<()> {
        if !audience.wants(topic) {
            return Ok(());
        }
        self.bytes.clear();
        ros::encode(message, &mut self.bytes).map_err(io::Error::other)?;
        audience.tell(topic, at_ns, &self.bytes)
    }

    fn suffix(&self) -> &'static str {
        match self.purpose {
            Purpose::Recording => "png",
            Purpose::Looking => "jpeg",
        }
    }

    fn encode(&self, image: &GrayImage) -> io::Result<Vec<u8>> {
        let (width, height) = (image.width(), image.height());
        let (pixels, grey) = (image.pixels(), ExtendedColorType::L8);
        let mut file = Vec::with_capacity(pixels.len());
        match self.purpose {
            Purpose::Recording => {
                PngEncoder::new_with_quality(&mut file, CompressionType::Fast, FilterType::Sub)
                    .write_image(pixels, width, height, grey)
            }
            Purpose::Looking => JpegEncoder::new_with_quality(&mut file, JPEG_QUALITY)
                .write_image(pixels, width, height, grey),
        }
        .map_err(io::Error::other)?;
        Ok(file)
    }
}
