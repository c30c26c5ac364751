//! The topics of a recording in; which two hold the images of the left and the right camera out.

use super::DatasetError;
use mcap::records::Channel;
use std::collections::BTreeMap;
use std::path::Path;

/// A topic with images.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ImageTopic {
    /// Its name.
    pub name: String,
    /// Whether each message holds an image file rather than raw pixels.
    pub is_compressed: bool,
    /// The recording's number of it.
    pub(super) channel: u16,
}

/// The last parts of an image topic's name, which the calibration's does not have.
const TRANSPORTS: [&str; 2] = ["/compressed", "/image_transport"];

impl ImageTopic {
    /// The topic of this camera's calibration: the same camera's `camera_info`.
    pub(super) fn camera_info_topic(&self) -> String {
        let mut name = self.name.as_str();
        for transport in TRANSPORTS {
            name = name.strip_suffix(transport).unwrap_or(name);
        }
        let camera = name.rfind('/').map_or("", |at| &name[..at]);
        format!("{camera}/camera_info")
    }

    /// Whether the images are rectified already, as their name says.
    pub(super) fn is_rectified(&self) -> bool {
        self.name
            .split(['/', '_'])
            .any(|word| word.starts_with("rect"))
    }

    /// Whether the name says which side it is, and which.
    fn side(&self) -> Option<usize> {
        let words = || self.name.split(['/', '_']);
        let is_any = |names: &[&str]| words().any(|word| names.contains(&word));
        if is_any(&["left", "cam0", "infra1"]) {
            Some(0)
        } else if is_any(&["right", "cam1", "infra2"]) {
            Some(1)
        } else {
            None
        }
    }
}

/// Most topics with images or calibrations that are looked at.
const MAX_TOPICS: usize = 256;
/// Most that are named in a message.
const MAX_NAMED: usize = 8;
/// Longest name, bytes: ROS takes none that is longer.
const MAX_NAME_BYTES: usize = 255;

/// Whether ROS could name anything so.
fn is_a_name(name: &str) -> bool {
    name.len() <= MAX_NAME_BYTES && !name.contains(char::is_control)
}

/// What is known of a recording's topics.
#[derive(Default)]
pub(super) struct Topics {
    schemas: BTreeMap<u16, String>,
    images: BTreeMap<u16, ImageTopic>,
    camera_infos: BTreeMap<u16, String>,
}

impl Topics {
    pub(super) fn is_empty(&self) -> bool {
        self.images.is_empty()
    }

    pub(super) fn add_schema(&mut self, id: u16, name: &str) {
        if is_a_name(name) {
            self.schemas.insert(id, name.to_owned());
        }
    }

    pub(super) fn add_channel(&mut self, channel: Channel) {
        if channel.message_encoding != "cdr"
            || !is_a_name(&channel.topic)
            || self.images.len() + self.camera_infos.len() >= MAX_TOPICS
        {
            return;
        }
        let Some(schema) = self.schemas.get(&channel.schema_id) else {
            return;
        };
        // ROS 2 spells package/msg/Type; older tools leave "msg" out.
        match schema.replace("/msg/", "/").as_str() {
            kind @ ("sensor_msgs/Image" | "sensor_msgs/CompressedImage") => {
                let topic = ImageTopic {
                    name: channel.topic,
                    is_compressed: kind == "sensor_msgs/CompressedImage",
                    channel: channel.id,
                };
                self.images.insert(channel.id, topic);
            }
            "sensor_msgs/CameraInfo" => {
                self.camera_infos.insert(channel.id, channel.topic);
            }
            _ => {}
        }
    }

    /// The name of the topic with this number, if calibrations come on it.
    pub(super) fn camera_info(&self, channel: u16) -> Option<&str> {
        self.camera_infos.get(&channel).map(String::as_str)
    }

    fn named(&self, name: &str) -> Option<&ImageTopic> {
        self.images.values().find(|topic| topic.name == name)
    }

    /// The sides as far as they are beyond doubt, whatever topics may come later.
    pub(super) fn clear_choice(&self, wanted: Option<[&str; 2]>) -> Option<[&ImageTopic; 2]> {
        match wanted {
            Some([left, right]) => Some([self.named(left)?, self.named(right)?]),
            None => Some([self.only_of_side(0)?, self.only_of_side(1)?]),
        }
    }

    /// The one topic whose name says that it is this side's; raw pixels go before image files.
    fn only_of_side(&self, side: usize) -> Option<&ImageTopic> {
        let of_side = || self.images.values().filter(|t| t.side() == Some(side));
        let mut raw = of_side().filter(|t| !t.is_compressed);
        let mut any = of_side();
        match (raw.next(), raw.next()) {
            (Some(topic), None) => Some(topic),
            (None, _) => any.next().filter(|_| any.next().is_none()),
            _ => None,
        }
    }

    /// The left and the right topic.
    pub(super) fn choose(
        &self,
        file: &Path,
        wanted: Option<[&str; 2]>,
    ) -> Result<[ImageTopic; 2], DatasetError> {
        if let Some(sides) = self.clear_choice(wanted) {
            return Ok(sides.map(ImageTopic::clone));
        }
        let names: Vec<&str> = self.images.values().map(|t| t.name.as_str()).collect();
        let there = match names.as_slice() {
            [] => "it has none".to_owned(),
            [names @ .., _] if names.len() >= MAX_NAMED => {
                format!("it has {} and others", names[..MAX_NAMED].join(", "))
            }
            names => format!("it has {}", names.join(", ")),
        };
        let cause = match wanted {
            Some(wanted) => {
                let missing = wanted.iter().find(|name| self.named(name).is_none());
                format!(
                    "has no images of ROS 2 on the topic {}: {there}",
                    missing.copied().unwrap_or_default()
                )
            }
            None if names.len() < 2 => {
                format!("two topics with images of ROS 2 are needed, but {there}")
            }
            None => format!(
                "which topics are the left and the right camera's is not clear: {there}; name them with --topics"
            ),
        };
        Err(DatasetError::file(file, cause))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn topics(names: &[(&str, bool)]) -> Topics {
        let mut topics = Topics::default();
        topics.add_schema(1, "sensor_msgs/msg/Image");
        topics.add_schema(2, "sensor_msgs/msg/CompressedImage");
        for (id, (name, is_compressed)) in (1..).zip(names) {
            topics.add_channel(Channel {
                id,
                schema_id: 1 + u16::from(*is_compressed),
                topic: (*name).to_owned(),
                message_encoding: "cdr".to_owned(),
                metadata: BTreeMap::new(),
            });
        }
        topics
    }

    fn chosen(names: &[(&str, bool)]) -> Result<[String; 2], String> {
        let choice = topics(names).choose(Path::new("r.mcap"), None);
        choice
            .map(|sides| sides.map(|t| t.name))
            .map_err(|e| e.to_string())
    }

    #[test]
    fn usual_names_tell_the_sides() {
        for [left, right] in [
            ["/left/image_raw", "/right/image_raw"],
            ["/cam0/image_raw", "/cam1/image_raw"],
            [
                "/camera/infra1/image_rect_raw",
                "/camera/infra2/image_rect_raw",
            ],
            ["/stereo/left_camera/image", "/stereo/right_camera/image"],
        ] {
            let expected = [left.to_owned(), right.to_owned()];
            assert_eq!(
                chosen(&[(right, false), (left, false)]),
                Ok(expected.clone())
            );
            assert_eq!(chosen(&[(left, true), (right, true)]), Ok(expected));
        }
    }

    #[test]
    fn names_that_ros_does_not_take_and_topics_without_end_are_passed_over() {
        let long = format!("/left/{}", "x".repeat(MAX_NAME_BYTES));
        let there = chosen(&[(&long, false), ("/left/\x1b[2J", false)]);
        assert!(there.expect_err("none").contains("it has none"));
        let names: Vec<String> = (0..2 * MAX_TOPICS).map(|n| format!("/{n}/image")).collect();
        let many: Vec<(&str, bool)> = names.iter().map(|name| (name.as_str(), false)).collect();
        assert_eq!(topics(&many).images.len(), MAX_TOPICS);
        let why = chosen(&many).expect_err("no side is named");
        assert!(why.len() < 400 && why.contains("and others"), "{why}");
    }

    #[test]
    fn raw_pixels_go_before_image_files() {
        let both = chosen(&[
            ("/left/image_raw/compressed", true),
            ("/left/image_raw", false),
            ("/right/image_raw", false),
            ("/right/image_raw/compressed", true),
        ]);
        let expected = ["/left/image_raw", "/right/image_raw"].map(str::to_owned);
        assert_eq!(both, Ok(expected));
    }

    #[test]
    fn what_is_not_clear_is_asked_for() {
        let unclear = chosen(&[("/a/image", false), ("/b/image", false)]);
        let why = unclear.expect_err("no side is named");
        assert!(
            why.contains("/a/image, /b/image") && why.contains("--topics"),
            "{why}"
        );
        let two = topics(&[("/a/image", false), ("/b/image", false)]);
        let named = two.choose(Path::new("r.mcap"), Some(["/b/image", "/a/image"]));
        let names = named.map(|sides| sides.map(|t| t.name));
        assert_eq!(
            names.map_err(|e| e.to_string()),
            Ok(["/b/image", "/a/image"].map(str::to_owned))
        );
        let wrong = two.choose(Path::new("r.mcap"), Some(["/b/image", "/c/image"]));
        let why = wrong.expect_err("there is no such topic").to_string();
        assert!(why.contains("on the topic /c/image"), "{why}");
        assert!(chosen(&[]).expect_err("nothing").contains("it has none"));
    }

    #[test]
    fn calibrations_stand_beside_their_images() {
        for (name, info) in [
            ("/left/image_raw", "/left/camera_info"),
            ("/left/image_raw/compressed", "/left/camera_info"),
            ("/image", "/camera_info"),
        ] {
            let topic = ImageTopic {
                name: name.to_owned(),
                is_compressed: false,
                channel: 0,
            };
            assert_eq!(topic.camera_info_topic(), info);
            assert!(!topic.is_rectified());
        }
    }
}
