//! The messages of a recording in; stereo pairs out, in order of their stamps.

use super::images::Images;
use super::records::Records;
use super::{ImageTopic, McapRecording};
use crate::capture::{MAX_STAMP_NS, PairEvent, PairSource, Side, Skew, StereoPair, Unusable};
use crate::image::GrayImage;
use crate::ros::messages::{CompressedImage, Header, Image};
use crate::ros::{self, CdrError};
use mcap::records::Record;
use std::collections::VecDeque;

/// Images of one side that may wait for the other side's before the oldest is given up.
const MOST_WAITING: usize = 64;

/// Plays an MCAP recording.
pub struct McapSource {
    file: String,
    records: Option<Records>,
    topics: [ImageTopic; 2],
    images: [Images; 2],
    waiting: [VecDeque<Waiting>; 2],
    tolerance_ns: i64,
    sequence: u64,
    sizes_px: [(u32, u32); 2],
    spare: [Vec<GrayImage>; 2],
    /// Why the file ends early, to be said once.
    cut: Option<String>,
    last_ns: Option<i64>,
}

/// An image that waits for its partner.
struct Waiting {
    timestamp_ns: i64,
    content: Result<Content, String>,
}

enum Content {
    Raw(Image),
    Compressed(CompressedImage),
}

impl McapSource {
    pub(super) fn open(recording: &McapRecording) -> std::io::Result<Self> {
        let records = Records::open(&recording.file).map_err(std::io::Error::other)?;
        let (rig, white_level) = (&recording.rig, recording.settings.white_level);
        let sizes_px = [&rig.left, &rig.right].map(|camera| (camera.width, camera.height));
        Ok(Self {
            file: recording.file.display().to_string(),
            records: Some(records),
            topics: recording.topics.clone(),
            images: sizes_px.map(|size_px| Images::new(size_px, white_level)),
            waiting: [VecDeque::new(), VecDeque::new()],
            tolerance_ns: recording.settings.pairing_tolerance_ns(),
            sequence: 0,
            sizes_px,
            spare: Default::default(),
            cut: None,
            last_ns: None,
        })
    }

    /// Reads one record; false after the last.
    fn read(&mut self) -> bool {
        let Some(records) = &mut self.records else {
            return false;
        };
        let topics = &self.topics;
        let waiting = &mut self.waiting;
        let most_bytes = self.sizes_px.map(most_bytes_of);
        let more = records.next(|record| {
            if let Record::Message { header, data } = record
                && let Some(side) = topics.iter().position(|t| t.channel == header.channel_id)
            {
                let is_compressed = topics[side].is_compressed;
                let most_bytes = most_bytes[side];
                waiting[side].push_back(if data.len() > most_bytes {
                    too_long(&data, most_bytes, header.log_time)
                } else {
                    waiting_of(&data, is_compressed, header.log_time)
                });
            }
        });
        match more {
            Ok(Some(())) => true,
            Ok(None) => {
                self.records = None;
                false
            }
            Err(why) => {
                self.cut = Some(format!("{}: {why}", self.file));
                self.records = None;
                false
            }
        }
    }

    /// The next event from what waits, if that is settled. `is_over`: nothing more will come.
    fn settle(&mut self, is_over: bool) -> Option<PairEvent> {
        let [left, right] = &self.waiting;
        match (left.front(), right.front()) {
            (Some(l), Some(r)) => {
                let apart_ns = l.timestamp_ns.saturating_sub(r.timestamp_ns);
                if apart_ns.abs() <= self.tolerance_ns {
                    Some(self.pair())
                } else {
                    let older = if apart_ns < 0 {
                        Side::Left
                    } else {
                        Side::Right
                    };
                    self.unpaired(older)
                }
            }
            (Some(_), None) if is_over || left.len() > MOST_WAITING => self.unpaired(Side::Left),
            (None, Some(_)) if is_over || right.len() > MOST_WAITING => self.unpaired(Side::Right),
            _ => None,
        }
    }

    /// Both that wait longest make a pair.
    fn pair(&mut self) -> PairEvent {
        let sequence = self.take_sequence();
        let [left, right] = &mut self.waiting;
        let (Some(left), Some(right)) = (left.pop_front(), right.pop_front()) else {
            return unusable(sequence, None, "there are no images".to_owned());
        };
        let timestamp_ns = left.timestamp_ns;
        if self.last_ns.is_some_and(|last| timestamp_ns <= last) {
            let why = format!(
                "{}: its stamp {timestamp_ns} ns is not after the one before",
                self.file
            );
            return unusable(sequence, None, why);
        }
        self.last_ns = Some(timestamp_ns);
        match (
            self.decode(Side::Left, left),
            self.decode(Side::Right, right),
        ) {
            (Ok(left), Ok(right)) => PairEvent::Pair(StereoPair {
                sequence,
                timestamp_ns,
                skew: Skew::default(),
                left,
                right,
            }),
            (Err(left), Err(right)) => {
                unusable(sequence, Some(timestamp_ns), format!("{left}; {right}"))
            }
            (Ok(image), Err(why)) => {
                self.spare[Side::Left as usize].push(image);
                unusable(sequence, Some(timestamp_ns), why)
            }
            (Err(why), Ok(image)) => {
                self.spare[Side::Right as usize].push(image);
                unusable(sequence, Some(timestamp_ns), why)
            }
        }
    }

    fn decode(&mut self, side: Side, waiting: Waiting) -> Result<GrayImage, String> {
        let topic = &self.topics[side as usize].name;
        let named = |why| format!("{}: {topic}: {why}", self.file);
        let mut image = self.spare[side as usize].pop().unwrap_or_default();
        let images = &mut self.images[side as usize];
        let done = match &waiting.content {
            Ok(Content::Raw(message)) => images.raw(message, &mut image).map_err(named),
            Ok(Content::Compressed(message)) => images
                .compressed(topic, message, &mut image)
                .map_err(|why| format!("{}: {why}", self.file)),
            Err(why) => Err(named(why.clone())),
        };
        match done {
            Ok(()) => Ok(image),
            Err(why) => {
                self.spare[side as usize].push(image);
                Err(why)
            }
        }
    }

    /// The oldest image of a side has no partner.
    fn unpaired(&mut self, side: Side) -> Option<PairEvent> {
        let alone = self.waiting[side as usize].pop_front()?;
        let sequence = self.take_sequence();
        let topic = &self.topics[1 - side as usize].name;
        let why = format!(
            "{}: {topic} has no image of {} ns",
            self.file, alone.timestamp_ns
        );
        Some(unusable(sequence, Some(alone.timestamp_ns), why))
    }

    fn take_sequence(&mut self) -> u64 {
        let sequence = self.sequence;
        self.sequence += 1;
        sequence
    }
}

fn waiting_of(data: &[u8], is_compressed: bool, log_time_ns: u64) -> Waiting {
    let decoded = if is_compressed {
        ros::decode::<CompressedImage>(data).map(|m| (stamp(&m.header), Content::Compressed(m)))
    } else {
        ros::decode::<Image>(data).map(|m| (stamp(&m.header), Content::Raw(m)))
    };
    match decoded {
        Ok((timestamp_ns, content)) => Waiting {
            timestamp_ns,
            content: Ok(content),
        },
        Err(why) => Waiting {
            timestamp_ns: stamp_of_damaged(data, log_time_ns),
            content: Err(why.to_string()),
        },
    }
}

/// Longest message with an image of this size, bytes. Of pixels in any encoding, or of a file that makes them no
/// shorter, and what stands around them; so many may wait.
fn most_bytes_of((width, height): (u32, u32)) -> usize {
    8 * width as usize * height as usize + (1 << 16)
}

fn too_long(data: &[u8], most_bytes: usize, log_time_ns: u64) -> Waiting {
    Waiting {
        timestamp_ns: stamp_of_damaged(data, log_time_ns),
        content: Err(format!(
            "the message has {} bytes, more than the {most_bytes} that an image of the rig's size may have",
            data.len()
        )),
    }
}

fn stamp(header: &Header) -> i64 {
    ros::timestamp_ns(header.stamp)
}

/// A message that cannot be read as a whole may still say when its image was taken.
fn stamp_of_damaged(data: &[u8], log_time_ns: u64) -> i64 {
    let header: Result<Header, CdrError> = ros::decode(data);
    header.map_or_else(
        |_| i64::try_from(log_time_ns).map_or(MAX_STAMP_NS, |ns| ns.min(MAX_STAMP_NS)),
        |h| stamp(&h),
    )
}

fn unusable(sequence: u64, timestamp_ns: Option<i64>, why: String) -> PairEvent {
    PairEvent::Unusable(Unusable {
        sequence,
        timestamp_ns,
        why,
    })
}

impl PairSource for McapSource {
    fn next_event(&mut self) -> Option<PairEvent> {
        loop {
            if let Some(event) = self.settle(false) {
                return Some(event);
            }
            if self.read() {
                continue;
            }
            if let Some(event) = self.settle(true) {
                return Some(event);
            }
            let why = self.cut.take()?;
            let sequence = self.take_sequence();
            return Some(unusable(sequence, None, why));
        }
    }

    /// One image a side more than are held: that which is being decoded.
    fn make_room(&mut self, pairs_held: usize) {
        for (spare, (width, height)) in self.spare.iter_mut().zip(self.sizes_px) {
            let more = (pairs_held + 1).saturating_sub(spare.len());
            spare.extend((0..more).map(|_| GrayImage::filled(width, height, 0)));
        }
    }

    fn recycle(&mut self, pair: StereoPair) {
        let [left, right] = &mut self.spare;
        left.push(pair.left);
        right.push(pair.right);
    }
}
