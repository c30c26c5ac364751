//! A recording's files in; decoded pairs out, in order, made ready ahead of the consumer.
//!
//! One thread a side decodes into its own bounded queue; the consumer takes one image from each.
//! As many buffers as can be under way are there from the beginning; those given back by
//! [`recycle`](PairSource::recycle) are filled again.

use super::dataset::{Dataset, ImageFiles, PairFiles};
use super::decode::Decoder;
use super::{PairEvent, PairSource, StereoPair, Unusable};
use crate::image::GrayImage;
use crate::queue::{bounded_both_ways, prepare_thread};
use crossbeam_channel::{Receiver, Sender, bounded};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread::JoinHandle;

/// One side's answer to one pair: the image, or a sentence why there is none.
type Decoded = Result<GrayImage, String>;

/// Plays a [`Dataset`], decoding ahead.
///
/// Dropping it early stops its threads after the image that each is at.
#[derive(Debug)]
pub struct ReadAhead {
    pairs: Arc<[PairFiles]>,
    next: usize,
    left: SideReader,
    right: SideReader,
}

impl ReadAhead {
    /// Starts to read `dataset` from its first pair.
    ///
    /// # Errors
    /// The system refuses a thread.
    pub fn start(dataset: &Dataset) -> std::io::Result<Self> {
        let pairs: Arc<[PairFiles]> = dataset.pairs.clone().into();
        let side =
            |name: &str, width: u32, height: u32, pick: fn(&ImageFiles) -> Option<&PathBuf>| {
                let mut decoder = Decoder::new(dataset.settings.white_level);
                SideReader::start(
                    name,
                    dataset.settings.read_ahead,
                    (width, height),
                    Arc::clone(&pairs),
                    pick,
                    move |file, image| {
                        decoder
                            .decode(file, Some((width, height)), image)
                            .map_err(|e| e.to_string())
                    },
                )
            };
        let cameras = (&dataset.rig.left, &dataset.rig.right);
        Ok(Self {
            left: side("read-left", cameras.0.width, cameras.0.height, left_of)?,
            right: side("read-right", cameras.1.width, cameras.1.height, right_of)?,
            pairs,
            next: 0,
        })
    }
}

fn left_of(images: &ImageFiles) -> Option<&PathBuf> {
    match images {
        ImageFiles::Both { left, .. } => Some(left),
        ImageFiles::Unpaired { .. } => None,
    }
}

fn right_of(images: &ImageFiles) -> Option<&PathBuf> {
    match images {
        ImageFiles::Both { right, .. } => Some(right),
        ImageFiles::Unpaired { .. } => None,
    }
}

impl PairSource for ReadAhead {
    fn next_event(&mut self) -> Option<PairEvent> {
        let files = self.pairs.get(self.next)?;
        let sequence = self.next as u64;
        self.next += 1;
        let timestamp_ns = files.timestamp_ns;
        let unusable = |why| {
            Some(PairEvent::Unusable(Unusable {
                sequence,
                timestamp_ns: Some(timestamp_ns),
                why,
            }))
        };
        if let ImageFiles::Unpaired { why } = &files.images {
            return unusable(why.clone());
        }
        match (self.left.take(), self.right.take()) {
            (Ok(left), Ok(right)) => Some(PairEvent::Pair(StereoPair {
                sequence,
                timestamp_ns,
                skew: crate::capture::Skew::default(),
                left,
                right,
            })),
            (Err(left), Err(right)) => unusable(format!("{left}; {right}")),
            (Ok(image), Err(why)) => {
                self.left.give_back(image);
                unusable(why)
            }
            (Err(why), Ok(image)) => {
                self.right.give_back(image);
                unusable(why)
            }
        }
    }

    fn len_hint(&self) -> Option<u64> {
        Some(self.pairs.len() as u64)
    }

    fn make_room(&mut self, pairs_held: usize) {
        self.left.make_room(pairs_held);
        self.right.make_room(pairs_held);
    }

    fn recycle(&mut self, pair: StereoPair) {
        self.left.give_back(pair.left);
        self.right.give_back(pair.right);
    }
}

/// The thread that decodes one camera's images, seen from the consumer.
#[derive(Debug)]
struct SideReader {
    /// `None` once the side is being dropped, which is what stops the thread.
    decoded: Option<Receiver<Decoded>>,
    depth: usize,
    pool: Arc<Pool>,
    thread: Option<JoinHandle<()>>,
}

impl SideReader {
    /// `pick` chooses this side's file of a pair; `decode` fills an image of `size_px` from it.
    fn start(
        name: &str,
        depth: usize,
        size_px: (u32, u32),
        pairs: Arc<[PairFiles]>,
        pick: fn(&ImageFiles) -> Option<&PathBuf>,
        mut decode: impl FnMut(&Path, &mut GrayImage) -> Result<(), String> + Send + 'static,
    ) -> std::io::Result<Self> {
        let (to_consumer, decoded) = bounded_both_ways(depth, || Err(String::new()));
        let pool = Arc::new(Pool::new(size_px));
        let spares = Arc::clone(&pool);
        let mut side = Self {
            decoded: Some(decoded),
            depth,
            pool,
            thread: None,
        };
        side.make_room(1);
        let thread = std::thread::Builder::new()
            .name(name.to_owned())
            .spawn(move || {
                prepare_thread();
                for file in pairs.iter().filter_map(|pair| pick(&pair.images)) {
                    let mut image = spares.take();
                    let answer = match decode_safely(&mut decode, file, &mut image) {
                        Ok(()) => Ok(image),
                        Err(why) => {
                            spares.give_back(image);
                            Err(why)
                        }
                    };
                    if to_consumer.send(answer).is_err() {
                        return;
                    }
                }
            })?;
        side.thread = Some(thread);
        Ok(side)
    }

    /// Has as many images as can be under way: in the queue, in the decoder and with the consumer.
    fn make_room(&self, held: usize) {
        self.pool.grow(self.depth + 1 + held);
    }

    /// The next image. A thread that has died is an answer, too: nobody waits for it.
    fn take(&self) -> Decoded {
        let gone = || "the thread that decodes images has ended".to_owned();
        let decoded = self.decoded.as_ref().ok_or_else(gone)?;
        decoded.recv().map_err(|_| gone())?
    }

    fn give_back(&self, image: GrayImage) {
        self.pool.give_back(image);
    }
}

/// Images that wait to be filled.
#[derive(Debug)]
struct Pool {
    size_px: (u32, u32),
    give: Sender<GrayImage>,
    spare: Receiver<GrayImage>,
    /// Images that there are, here or under way.
    all: AtomicUsize,
}

/// More images than any consumer holds.
const MOST_SPARE: usize = 1024;

impl Pool {
    fn new(size_px: (u32, u32)) -> Self {
        let (give, spare) = bounded(MOST_SPARE);
        Self {
            size_px,
            give,
            spare,
            all: AtomicUsize::new(0),
        }
    }

    /// Adds images until there are `count` in all.
    fn grow(&self, count: usize) {
        let (width, height) = self.size_px;
        let has = self.all.fetch_max(count, Ordering::Relaxed);
        for _ in has..count {
            let _ = self.give.try_send(GrayImage::filled(width, height, 0));
        }
    }

    /// A spare image, or a new one for a consumer that holds more than it said.
    fn take(&self) -> GrayImage {
        self.spare.try_recv().unwrap_or_default()
    }

    /// Keeps an image unless there are enough without it.
    fn give_back(&self, image: GrayImage) {
        if self.spare.len() < self.all.load(Ordering::Relaxed) {
            let _ = self.give.try_send(image);
        }
    }
}

/// A decoder that panics over a strange file costs that file, not the run.
fn decode_safely(
    decode: &mut impl FnMut(&Path, &mut GrayImage) -> Result<(), String>,
    file: &Path,
    image: &mut GrayImage,
) -> Result<(), String> {
    // Unwind safe: all that a panic leaves half done are buffers, which each call fills anew.
    match catch_unwind(AssertUnwindSafe(|| decode(file, image))) {
        Ok(answer) => answer,
        Err(_) => Err(format!("{}: the decoder failed on it", file.display())),
    }
}

impl Drop for SideReader {
    fn drop(&mut self) {
        self.decoded = None;
        if let Some(thread) = self.thread.take() {
            // It ends within the image it is at; a panic in it has been reported already.
            let _ = thread.join();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pairs(count: usize) -> Arc<[PairFiles]> {
        (0..count)
            .map(|index| PairFiles {
                timestamp_ns: index as i64,
                images: ImageFiles::Both {
                    left: format!("{index}").into(),
                    right: format!("{index}").into(),
                },
            })
            .collect()
    }

    fn side(
        decode: impl FnMut(&Path, &mut GrayImage) -> Result<(), String> + Send + 'static,
    ) -> SideReader {
        SideReader::start("test", 2, (64, 64), pairs(6), left_of, decode).expect("a thread")
    }

    #[test]
    fn a_panic_costs_one_image_and_the_order_stays() {
        let side = side(|file, image| {
            assert_ne!(file, Path::new("2"), "a decoder that fails");
            let number = file.to_string_lossy().parse().expect("a number");
            image.reshape(1, 1);
            image.pixels_mut()[0] = number;
            Ok(())
        });
        let seen: Vec<_> = (0..6).map(|_| side.take().map(|i| i.pixels()[0])).collect();
        assert_eq!(seen[2], Err("2: the decoder failed on it".to_owned()));
        for (index, answer) in seen.iter().enumerate().filter(|(index, _)| *index != 2) {
            assert_eq!(*answer, Ok(index as u8));
        }
        assert!(side.take().is_err(), "after the end nobody waits");
    }

    #[test]
    fn buffers_that_are_given_back_are_filled_again() {
        let side = side(|_, image| {
            image.reshape(64, 64);
            Ok(())
        });
        let mut addresses = std::collections::BTreeSet::new();
        for _ in 0..6 {
            let image = side.take().expect("an image");
            addresses.insert(image.pixels().as_ptr() as usize);
            side.give_back(image);
        }
        // Two in the queue, one at each end; without the pool there could be six at once.
        assert!(addresses.len() <= 5, "{}", addresses.len());
    }

    #[test]
    fn as_many_images_as_can_be_under_way_are_there_at_the_start() {
        let side = side(|_, _| Ok(()));
        side.make_room(3);
        // Two in the queue, one in the decoder, three that are held: a new one would be empty.
        let held: Vec<_> = (0..6).map(|_| side.take()).collect();
        let is_of_the_pool = |answer: &Decoded| answer.as_ref().is_ok_and(|i| i.width() == 64);
        assert!(held.iter().all(is_of_the_pool));
        assert_eq!(side.pool.spare.len(), 0);
    }

    #[test]
    fn a_file_that_cannot_be_read_costs_no_image() {
        let side = side(|_, _| Err("unreadable".to_owned()));
        for _ in 0..6 {
            assert_eq!(side.take(), Err("unreadable".to_owned()));
        }
        assert!(side.take().is_err(), "after the end");
        assert_eq!(side.pool.spare.len(), 4);
    }

    #[test]
    fn one_that_is_dropped_early_ends_its_thread() {
        let witness = Arc::new(());
        let held = Arc::clone(&witness);
        let side = side(move |_, _| {
            // Dropped with the closure, that is when the thread is over.
            let _ = &held;
            Ok(())
        });
        drop(side.take());
        drop(side);
        assert_eq!(Arc::strong_count(&witness), 1);
    }
}
