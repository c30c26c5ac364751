//! No stage allocates for a pair once its buffers have grown: each allocation of this process is
//! counted, and told apart by the thread that asks for it and by what runs at that time.
//!
//! A binary of its own, and one test: another test's allocations would be counted, too.
#![expect(unsafe_code, reason = "an allocator")]

#[path = "../tools/bench/common/memory.rs"]
#[cfg(test)]
#[expect(dead_code, reason = "the benches read recordings, too")]
mod memory;

#[cfg(test)]
mod tests {
    use super::memory::{self, Recording};
    use std::alloc::{GlobalAlloc, Layout, System};
    use std::cell::Cell;
    use std::collections::VecDeque;
    use std::convert::Infallible;
    use std::ops::ControlFlow;
    use std::sync::atomic::{AtomicU64, Ordering};
    use std::time::Duration;
    use visod::capture::{Dataset, PairEvent, PairSource, ReadAhead};
    use visod::features::{self, Extractor, Features};
    use visod::geometry::Rectification;
    use visod::image::GrayImage;
    use visod::matching::{self, MatchedPair, Partners, StereoMatcher, TemporalMatcher};
    use visod::output::features::FeaturesMessage;
    use visod::output::message::CaptureTime;
    use visod::pipeline::{self, DescribedPair, Method};
    use visod::simulation::small_rig;

    /// The system's allocator, counting.
    struct Counting;

    static OF_ALL_THREADS: AtomicU64 = AtomicU64::new(0);

    thread_local! {
        static OF_THIS_THREAD: Cell<u64> = const { Cell::new(0) };
    }

    fn count() {
        OF_ALL_THREADS.fetch_add(1, Ordering::SeqCst);
        // A thread that is ending has no counter any more.
        let _ = OF_THIS_THREAD.try_with(|counter| counter.set(counter.get() + 1));
    }

    // SAFETY: every call goes on to the system's allocator unchanged.
    unsafe impl GlobalAlloc for Counting {
        unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
            count();
            // SAFETY: as the caller promised.
            unsafe { System.alloc(layout) }
        }

        unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
            count();
            // SAFETY: as the caller promised.
            unsafe { System.alloc_zeroed(layout) }
        }

        unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
            count();
            // SAFETY: as the caller promised.
            unsafe { System.realloc(pointer, layout, size) }
        }

        unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
            // SAFETY: as the caller promised.
            unsafe { System.dealloc(pointer, layout) }
        }
    }

    #[global_allocator]
    static ALLOCATOR: Counting = Counting;

    fn of_this_thread() -> u64 {
        OF_THIS_THREAD.with(Cell::get)
    }

    /// How often `work` allocates on this thread.
    fn allocations(work: impl FnOnce()) -> u64 {
        let before = of_this_thread();
        work();
        of_this_thread() - before
    }

    const FRAMES: u64 = 8;
    /// Keypoints that an image has at most.
    const BUDGET: usize = 1000;
    /// To and fro four times: every buffer has been as large as any pair makes it.
    const WARM_UP: u64 = 8 * FRAMES;
    const COUNTED: u64 = 4 * FRAMES;
    /// Files after which the readers have had one each; their images are there from the start.
    const FIRST_READ: u64 = 2;

    #[test]
    fn no_stage_allocates_after_warm_up() {
        let recording = Recording::simulated(small_rig(), FRAMES);
        let mut lean = features::Settings::default();
        (lean.surf.sampling_px, lean.surf.upright) = (2, true);
        features_do_not_allocate(&recording, &lean);
        let described = features_do_not_allocate(&recording, &features::Settings::default());
        matching_does_not_allocate(&recording, &described);
        for partners in [Partners::Features, Partners::Surroundings] {
            the_method_does_not_allocate(&recording, &described, partners);
            the_pipeline_does_not_allocate(&recording, partners);
        }
        recordings_are_read_without_allocating(&recording);
    }

    fn extractor() -> Box<dyn Extractor> {
        features::extractor(&features::Settings::default()).expect("the defaults are in range")
    }

    fn features_do_not_allocate(
        recording: &Recording,
        settings: &features::Settings,
    ) -> Vec<[Features; 2]> {
        let mut extractor = features::extractor(settings).expect("in range");
        let mut described = vec![<[Features; 2]>::default(); recording.pairs.len()];
        let mut features = Features::default();
        for place in 0..WARM_UP + COUNTED {
            let index = recording.index(place);
            let pair = &recording.pairs[index];
            for (image, kept) in [&pair.left, &pair.right].into_iter().zip(0..) {
                let count = allocations(|| {
                    assert_eq!(extractor.extract(image, &mut features), Ok(()));
                });
                assert!(place < WARM_UP || count == 0, "features: {count}");
                assert!(features.len() > 100, "{}", features.len());
                described[index][kept] = features.clone();
            }
        }
        described
    }

    fn matching_does_not_allocate(recording: &Recording, described: &[[Features; 2]]) {
        let settings = matching::Settings::default();
        let rectification = Rectification::new(&recording.rig).expect("side by side");
        let mut stereo = StereoMatcher::new(settings.clone(), rectification);
        let mut temporal = TemporalMatcher::new(settings);
        let (mut before, mut now) = (Vec::new(), Vec::new());
        let (mut predicted, mut tracks) = (Vec::new(), Vec::new());
        let mut last: &[Features; 2] = &described[0];
        for place in 0..WARM_UP + COUNTED {
            let [left, right] = &described[recording.index(place)];
            let count = allocations(|| {
                assert_eq!(stereo.find(left, right, &mut now), Ok(()));
                predicted.clear();
                predicted.extend(before.iter().map(|m: &matching::StereoMatch| {
                    let (l, r) = (m.left as usize, m.right as usize);
                    let (l, r) = (&last[0].keypoints[l], &last[1].keypoints[r]);
                    Some([l.x_px, l.y_px, r.x_px, r.y_px].map(f64::from).into())
                }));
                let found = temporal.find(
                    MatchedPair {
                        left: &last[0],
                        right: &last[1],
                        matches: &before,
                    },
                    MatchedPair {
                        left,
                        right,
                        matches: &now,
                    },
                    &predicted,
                    40.0,
                    &mut tracks,
                );
                assert_eq!(found, Ok(()));
            });
            assert!(place < WARM_UP || count == 0, "matching: {count}");
            assert!(place == 0 || tracks.len() > 30, "{}", tracks.len());
            std::mem::swap(&mut before, &mut now);
            last = &described[recording.index(place)];
        }
    }

    fn method(recording: &Recording, partners: Partners) -> Method {
        let rig = recording.rig.clone();
        let matching = matching::Settings {
            partners,
            ..matching::Settings::default()
        };
        Method::new(rig, matching, memory::estimation())
            .expect("side by side")
            .watching_rig(&visod::rig_watch::Settings::default())
    }

    /// Matching and estimation as they run.
    fn the_method_does_not_allocate(
        recording: &Recording,
        described: &[[Features; 2]],
        partners: Partners,
    ) {
        let mut method = method(recording, partners);
        let mut pair = DescribedPair::default();
        let mut tracked = Box::<FeaturesMessage>::default();
        for place in 0..WARM_UP + COUNTED {
            let [left, right] = &described[recording.index(place)];
            let images = &recording.pairs[recording.index(place)];
            for (side, features, image) in [
                (&mut pair.left, left, &images.left),
                (&mut pair.right, right, &images.right),
            ] {
                // Room for a budget, as an extractor makes it.
                side.features.clone_from(features);
                let count = side.features.len();
                side.features.keypoints.reserve_exact(BUDGET - count);
                side.features
                    .descriptors
                    .reserve_exact(64 * (BUDGET - count));
                side.take(image);
            }
            pair.sequence = place;
            pair.timestamp_ns = 100_000_000 * place as i64;
            let mut row = None;
            let count = allocations(|| row = method.step(&mut pair).ok());
            let row = row.expect("matched");
            let gathered = allocations(|| {
                tracked.fill(&row, CaptureTime::Recorded(0), method.tracked());
            });
            assert_eq!(gathered, 0, "tracked features");
            assert!(place == 0 || tracked.count > 20, "{}", tracked.count);
            assert!(place < WARM_UP || count == 0, "method: {count}");
        }
    }

    /// All stages side by side, and the queues between them.
    fn the_pipeline_does_not_allocate(recording: &Recording, partners: Partners) {
        let mut method = method(recording, partners);
        let mut counted = 0;
        let mut rows = 0;
        // Each has had an image: a machine with other work may let one worker do it all for long.
        let extractors = [(); 2].map(|()| {
            let mut extractor = extractor();
            let warmed = extractor.extract(&recording.pairs[0].left, &mut Features::default());
            assert_eq!(warmed, Ok(()));
            extractor
        });
        let result = pipeline::run(
            recording.source(WARM_UP + COUNTED),
            extractors.into(),
            &mut method,
            |_| {
                rows += 1;
                let all = OF_ALL_THREADS.load(Ordering::SeqCst);
                // The last pairs are not counted: the first threads end while they come.
                if rows <= WARM_UP {
                    counted = all;
                } else if rows == WARM_UP + COUNTED - FRAMES {
                    counted = all - counted;
                }
                Ok::<_, Infallible>(ControlFlow::Continue(()))
            },
        );
        assert!(result.is_ok());
        assert_eq!(rows, WARM_UP + COUNTED);
        assert_eq!(counted, 0, "capture, features, method and queues");
    }

    /// From files: raw images without any allocation, compressed ones with those of their library.
    fn recordings_are_read_without_allocating(recording: &Recording) {
        let folder = tempfile::tempdir().expect("a folder");
        for (side, image) in [
            (
                "left",
                (|p| &p.left) as fn(&visod::capture::StereoPair) -> &GrayImage,
            ),
            ("right", |p| &p.right),
        ] {
            let side = folder.path().join(side);
            std::fs::create_dir(&side).expect("an empty folder");
            for place in 0..WARM_UP + COUNTED {
                let image = image(&recording.pairs[recording.index(place)]);
                let mut file =
                    format!("P5\n{} {}\n255\n", image.width(), image.height()).into_bytes();
                file.extend_from_slice(image.pixels());
                std::fs::write(side.join(format!("{place:06}.pgm")), file).expect("written");
            }
        }
        let rig = Some(recording.rig.clone());
        std::fs::write(folder.path().join("rig.toml"), "").expect("written");
        let dataset = Dataset::open(folder.path(), rig).expect("a dataset");
        let mut source = ReadAhead::start(&dataset).expect("threads");
        const HELD: usize = 3;
        source.make_room(HELD);
        let mut held = VecDeque::with_capacity(HELD);
        let mut before = 0;
        for place in 0..WARM_UP + COUNTED {
            if place == FIRST_READ {
                before = OF_ALL_THREADS.load(Ordering::SeqCst);
            }
            // The consumer now waits for the readers and now has them wait, as late as can be.
            if place % 16 == 15 {
                std::thread::sleep(Duration::from_millis(5));
            }
            let Some(PairEvent::Pair(pair)) = source.next_event() else {
                unreachable!("every image is whole");
            };
            held.push_back(pair);
            if place % 16 < 8 || held.len() == HELD {
                held.drain(..).for_each(|pair| source.recycle(pair));
            }
        }
        let counted = OF_ALL_THREADS.load(Ordering::SeqCst) - before;
        assert_eq!(counted, 0, "reading");
    }
}
