//! An MCAP recording of ROS 2 messages in; its rig, and its stereo pairs out.
//!
//! Images are `sensor_msgs/Image` or `sensor_msgs/CompressedImage` on two topics, calibrations the
//! `sensor_msgs/CameraInfo` beside them, or the rig file that visod attaches to its own recordings.
//! The file is read from front to back, once for the rig, once for the pairs, so that one that was
//! cut off gives what came before the cut.

mod images;
mod records;
mod source;
mod topics;

pub use source::McapSource;
pub use topics::ImageTopic;

use super::dataset::{DatasetError, Settings};
use crate::geometry::{COVARIANCE_FILE, StereoRig, parse_rig, parse_rig_with_covariance};
use crate::ros::camera_info::{self, Calibration};
use crate::ros::messages::CameraInfo;
use crate::ros::{self, RIG_ATTACHMENT};
use crate::toml_file::MAX_BYTES as MAX_ATTACHMENT_BYTES;
use mcap::records::Record;
use records::Records;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use topics::Topics;

/// Longest calibration message that is looked at, bytes; the usual ones have a few hundred.
const MAX_CALIBRATION_BYTES: usize = 1 << 16;

/// A recording in an MCAP file.
#[derive(Clone, Debug)]
pub struct McapRecording {
    file: PathBuf,
    /// The cameras.
    pub rig: StereoRig,
    /// The left and the right images' topic.
    pub topics: [ImageTopic; 2],
    settings: Settings,
}

impl McapRecording {
    /// Opens a recording. `rig_override` takes the place of its own calibration; `topics` names the
    /// left and the right image topic where their names do not tell.
    ///
    /// # Errors
    /// The file cannot be read or is no MCAP file; it has no two image topics that can be told
    /// apart, or not those named; a calibration is missing or impossible.
    pub fn open(
        file: &Path,
        rig_override: Option<StereoRig>,
        topics: Option<[&str; 2]>,
        settings: Settings,
    ) -> Result<Self, DatasetError> {
        let found = Found::scan(file, topics, rig_override.is_some())?;
        let topics = found.topics.choose(file, topics)?;
        let rig = match rig_override {
            Some(rig) => rig,
            None => found.rig(file, &topics)?,
        };
        Ok(Self {
            file: file.to_owned(),
            rig,
            topics,
            settings,
        })
    }

    /// Starts to read the pairs.
    ///
    /// # Errors
    /// The file cannot be opened any more.
    pub fn source(&self) -> std::io::Result<McapSource> {
        McapSource::open(self)
    }
}

/// What a first look at the file finds.
#[derive(Default)]
struct Found {
    topics: Topics,
    /// Calibrations by topic.
    infos: BTreeMap<String, CameraInfo>,
    attached_rig: Option<String>,
    attached_covariance: Option<String>,
}

impl Found {
    /// Reads until the topics and the rig are known.
    fn scan(file: &Path, wanted: Option<[&str; 2]>, has_rig: bool) -> Result<Self, DatasetError> {
        let mut found = Self::default();
        let mut records = Records::open(file).map_err(|e| DatasetError::file(file, e))?;
        while !found.is_enough(wanted, has_rig) {
            let more = records.next(|record| found.take(record));
            match more {
                Ok(Some(())) => {}
                Ok(None) => break,
                // A recording that was cut off may have shown all that is needed.
                Err(why) if found.topics.is_empty() => return Err(DatasetError::file(file, why)),
                Err(_) => break,
            }
        }
        Ok(found)
    }

    fn take(&mut self, record: Record<'_>) {
        match record {
            Record::Schema { header, .. } => self.topics.add_schema(header.id, &header.name),
            Record::Channel(channel) => self.topics.add_channel(channel),
            Record::Attachment { header, data, .. }
                if data.len() as u64 <= MAX_ATTACHMENT_BYTES =>
            {
                let text = || String::from_utf8(data.into_owned()).ok();
                match header.name.as_str() {
                    RIG_ATTACHMENT => self.attached_rig = text(),
                    COVARIANCE_FILE => self.attached_covariance = text(),
                    _ => {}
                }
            }
            Record::Message { header, data } => {
                let Some(topic) = self.topics.camera_info(header.channel_id) else {
                    return;
                };
                if data.len() <= MAX_CALIBRATION_BYTES
                    && !self.infos.contains_key(topic)
                    && let Ok(info) = ros::decode(&data)
                {
                    self.infos.insert(topic.to_owned(), info);
                }
            }
            _ => {}
        }
    }

    fn is_enough(&self, wanted: Option<[&str; 2]>, has_rig: bool) -> bool {
        let Some(sides) = self.topics.clear_choice(wanted) else {
            return false;
        };
        has_rig
            || self.attached_rig.is_some()
            || sides.iter().all(|side| self.info_of(side).is_some())
    }

    fn info_of(&self, topic: &ImageTopic) -> Option<(&str, &CameraInfo)> {
        let name = topic.camera_info_topic();
        let (name, info) = self.infos.get_key_value(&name)?;
        Some((name, info))
    }

    fn rig(&self, file: &Path, topics: &[ImageTopic; 2]) -> Result<StereoRig, DatasetError> {
        if let Some(text) = &self.attached_rig {
            let rig = match &self.attached_covariance {
                Some(covariance) => parse_rig_with_covariance(text, covariance),
                None => parse_rig(text),
            };
            return rig.map_err(|e| {
                DatasetError::file(file, format!("its attachment {RIG_ATTACHMENT}: {e}"))
            });
        }
        let calibration = |topic: &ImageTopic| {
            let Some((name, info)) = self.info_of(topic) else {
                let name = topic.camera_info_topic();
                return Err(format!(
                    "has no calibration: there is no message on {name}; name a rig file with --rig"
                ));
            };
            Ok((name.to_owned(), info, topic.is_rectified()))
        };
        let rig = || {
            let [left, right] = [calibration(&topics[0])?, calibration(&topics[1])?];
            let [left, right] = [&left, &right].map(|(topic, info, is_rectified)| Calibration {
                topic,
                info,
                is_rectified: *is_rectified,
            });
            camera_info::rig(left, right)
        };
        rig().map_err(|why| DatasetError::file(file, why))
    }
}
