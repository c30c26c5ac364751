//! A recording in; two cameras that serve it over GigE Vision out, for programs that know nothing of
//! simulations.
//!
//! The cameras expose together, at whole multiples of their period: number n of the recording is what
//! both send at tick n after the first at which both are running. The stamps are the recording's, on
//! clocks that may differ.
#![expect(
    unsafe_code,
    reason = "calls of Aravis for which its crate has no form"
)]

use crate::capture::camera::monotonic_ns;
use crate::capture::{Dataset, PairEvent, PairSource, ReadAhead, Side};
use crate::image::GrayImage;
use aravis::{FakeCamera, GvFakeCamera};
use aravis_sys::{ArvBuffer, ArvPixelFormat};
use glib::translate::ToGlibPtr;
use std::ffi::c_void;
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

/// How long the first camera waits for the second before it begins alone. Aravis' camera serves its
/// control channel on the same thread: it must not sleep for long.
const PATIENCE: Duration = Duration::from_millis(1500);

/// How many numbers a camera that leaves none out may be ahead of the other before it waits.
const MOST_AHEAD: i64 = 2;
/// How long it waits at most.
const PATIENCE_AHEAD: Duration = Duration::from_millis(100);

/// The images of a recording, whole.
pub trait Images: Send + Sync {
    /// How many pairs there are.
    fn len(&self) -> usize;
    /// When pair `at` was taken, ns.
    fn timestamp_ns(&self, at: usize) -> i64;
    /// One image of pair `at`.
    fn image(&self, at: usize, side: Side) -> Arc<GrayImage>;
    /// Whether there are none.
    fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// A recording's images, decoded when the cameras are set up.
#[derive(Debug)]
pub struct RecordedImages {
    stamps_ns: Vec<i64>,
    images: Vec<[Arc<GrayImage>; 2]>,
}

impl RecordedImages {
    /// Decodes every pair of a recording; pairs that cannot be decoded are left out.
    ///
    /// # Errors
    /// One sentence: not one pair can be decoded, or a thread cannot be started.
    pub fn decode(dataset: &Dataset) -> Result<Self, String> {
        let mut source = ReadAhead::start(dataset).map_err(|e| e.to_string())?;
        let mut all = Self {
            stamps_ns: Vec::new(),
            images: Vec::new(),
        };
        let mut first_why = None;
        while let Some(event) = source.next_event() {
            match event {
                PairEvent::Pair(pair) => {
                    all.stamps_ns.push(pair.timestamp_ns);
                    all.images.push([pair.left, pair.right].map(Arc::new));
                }
                PairEvent::Unusable(unusable) => {
                    first_why.get_or_insert(unusable.why);
                }
            }
        }
        match first_why {
            Some(why) if all.images.is_empty() => Err(why),
            _ => Ok(all),
        }
    }

    /// The mean time between two pairs, s.
    #[must_use]
    pub fn period_s(&self) -> f64 {
        match (self.stamps_ns.first(), self.stamps_ns.last()) {
            (Some(first), Some(last)) if last > first => {
                (last - first) as f64 * 1e-9 / (self.stamps_ns.len() - 1) as f64
            }
            _ => 0.1,
        }
    }
}

impl Images for RecordedImages {
    fn len(&self) -> usize {
        self.images.len()
    }

    fn timestamp_ns(&self, at: usize) -> i64 {
        self.stamps_ns[at]
    }

    fn image(&self, at: usize, side: Side) -> Arc<GrayImage> {
        Arc::clone(&self.images[at][side as usize])
    }
}

/// What the clock of a camera is like.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct CameraClock {
    /// Ahead of the recording's, ns.
    pub offset_ns: i64,
    /// Faster than the recording's, as a ratio less one.
    pub drift: f64,
    /// What time it shows.
    pub shows: Shows,
}

/// What time a simulated camera's clock shows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Shows {
    /// The recording's: stamps are those of its pairs, however late a busy machine sends them.
    #[default]
    Recording,
    /// When each frame is really taken, by this host's CLOCK_MONOTONIC: what is estimated from stamps can
    /// be held against the truth.
    Host {
        /// When the clock was right, but for its offset, ns.
        since_ns: i64,
    },
}

/// One simulated camera; it serves until it is dropped.
pub struct GigeCamera {
    camera: GvFakeCamera,
    // What the callback reads; freed only after the camera.
    filler: *mut Filler,
}

// SAFETY: the pointer is owned, and what it points at is Sync.
unsafe impl Send for GigeCamera {}

/// What both cameras have in common: when the recording began.
#[derive(Debug, Default)]
pub struct Together {
    state: Mutex<Start>,
    changed: Condvar,
    leaves_none_out: bool,
}

impl Together {
    /// Cameras that a busy machine makes late leave no number out, but fall behind, together.
    #[must_use]
    pub fn leaving_none_out() -> Self {
        Self {
            leaves_none_out: true,
            ..Self::default()
        }
    }
}

#[derive(Debug, Default)]
struct Start {
    is_running: [bool; 2],
    /// The tick of number 0.
    first_tick: Option<i64>,
    /// The last numbers that were due.
    last: [i64; 2],
}

struct Filler {
    images: Arc<dyn Images>,
    side: Side,
    period_us: i64,
    clock: CameraClock,
    together: Arc<Together>,
    last: Mutex<Option<i64>>,
}

impl GigeCamera {
    /// Serves one side of a recording at `rate_hz` on the network address `address`.
    ///
    /// # Errors
    /// One sentence: the address cannot be served.
    pub fn serve(
        images: Arc<dyn Images>,
        side: Side,
        (address, serial): (&str, &str),
        rate_hz: f64,
        clock: CameraClock,
        together: Arc<Together>,
    ) -> Result<Self, String> {
        let camera = GvFakeCamera::new(Some(address), Some(serial));
        if !camera.is_running() {
            return Err(format!(
                "{address}: cannot be served: is the address there, and its port 3956 free?"
            ));
        }
        let fake = camera
            .fake_camera()
            .ok_or("the simulated camera has no inside")?;
        let period_us = (1e6 / rate_hz).round() as i64;
        let first = images.image(0, side);
        preset(&fake, (first.width(), first.height()), period_us);
        let filler = Box::into_raw(Box::new(Filler {
            images,
            side,
            period_us,
            clock,
            together,
            last: Mutex::new(None),
        }));
        // SAFETY: the camera calls `fill` with `filler` until it is dropped; `filler` lives longer
        // (see `Drop`).
        unsafe {
            aravis_sys::arv_fake_camera_set_fill_pattern(
                fake.to_glib_none().0,
                Some(fill),
                filler.cast(),
            );
        }
        Ok(Self { camera, filler })
    }

    /// Loses a share of the packets, 0 to 1.
    pub fn lose_packets(&self, share: f64) {
        self.camera.set_gvsp_lost_ratio(share);
    }
}

impl Drop for GigeCamera {
    fn drop(&mut self) {
        let Some(fake) = self.camera.fake_camera() else {
            return;
        };
        // SAFETY: setting the pattern takes the lock that is held during each call of the old one, so
        // that nobody reads `filler` afterwards.
        unsafe {
            aravis_sys::arv_fake_camera_set_fill_pattern(
                fake.to_glib_none().0,
                None,
                std::ptr::null_mut(),
            );
            drop(Box::from_raw(self.filler));
        }
    }
}

/// Registers of Aravis' simulated camera.
const REGISTER_WIDTH: u32 = 0x100;
const REGISTER_HEIGHT: u32 = 0x104;
const REGISTER_FRAME_PERIOD_US: u32 = 0x138;

fn preset(fake: &FakeCamera, (width, height): (u32, u32), period_us: i64) {
    for (register, value) in [
        (REGISTER_WIDTH, width),
        (REGISTER_HEIGHT, height),
        (REGISTER_FRAME_PERIOD_US, period_us as u32),
    ] {
        fake.write_register(register, value);
    }
}

impl Filler {
    /// Which number of the recording is due now. Blocks once, until the other camera runs too.
    fn due(&self) -> i64 {
        let tick = now_us() / self.period_us;
        let first = self.first_tick(tick);
        let mut last = self.last.lock().unwrap_or_else(PoisonError::into_inner);
        let due = match *last {
            // Aravis sends all but the first frame at a tick.
            None => {
                let wait_us = first * self.period_us - now_us();
                std::thread::sleep(Duration::from_micros(u64::try_from(wait_us).unwrap_or(0)));
                (now_us() / self.period_us - first).max(0)
            }
            Some(last) if self.together.leaves_none_out => last + 1,
            Some(last) => (tick - first).max(last + 1),
        };
        *last = Some(due);
        if self.together.leaves_none_out {
            self.wait_for_other(due);
        }
        due
    }

    /// Waits a little where the other camera is far behind: apart, they would send what no longer belongs
    /// together.
    fn wait_for_other(&self, due: i64) {
        let together = &self.together;
        let mut start = together
            .state
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        start.last[self.side as usize] = due;
        together.changed.notify_all();
        let other = 1 - self.side as usize;
        let is_behind =
            |start: &mut Start| start.is_running[other] && start.last[other] + MOST_AHEAD < due;
        let _ = together
            .changed
            .wait_timeout_while(start, PATIENCE_AHEAD, is_behind);
    }

    /// The tick at which the recording began, or begins now that both cameras run.
    fn first_tick(&self, tick: i64) -> i64 {
        let together = &self.together;
        let mut start = together
            .state
            .lock()
            .unwrap_or_else(PoisonError::into_inner);
        start.is_running[self.side as usize] = true;
        if start.first_tick.is_none() && start.is_running == [true; 2] {
            start.first_tick = Some(tick + 1);
            together.changed.notify_all();
        }
        let (mut start, _) = together
            .changed
            .wait_timeout_while(start, PATIENCE, |start| start.first_tick.is_none())
            .unwrap_or_else(PoisonError::into_inner);
        *start.first_tick.get_or_insert(tick + 1)
    }

    /// The stamp of number `due` of a recording that is repeated, by the camera's clock, ns.
    fn stamp_ns(&self, due: i64) -> i64 {
        let count = self.images.len() as i64;
        let (round, at) = (due / count, (due % count) as usize);
        let first_ns = self.images.timestamp_ns(0);
        let length_ns =
            self.images.timestamp_ns(count as usize - 1) - first_ns + self.period_us * 1000;
        let since_ns = round * length_ns + self.images.timestamp_ns(at) - first_ns;
        let (first_ns, since_ns) = match self.clock.shows {
            Shows::Recording => (first_ns, since_ns),
            Shows::Host { since_ns } => (since_ns, monotonic_ns() - since_ns),
        };
        let drifted_ns = (self.clock.drift * since_ns as f64).round() as i64;
        first_ns + since_ns + drifted_ns + self.clock.offset_ns
    }
}

fn now_us() -> i64 {
    let now = SystemTime::now().duration_since(UNIX_EPOCH);
    now.map_or(0, |since| since.as_micros() as i64)
}

/// Fills a frame; Aravis calls it on the camera's thread.
unsafe extern "C" fn fill(
    buffer: *mut ArvBuffer,
    filler: *mut c_void,
    _exposure_us: u32,
    _gain: u32,
    _format: ArvPixelFormat,
) {
    // SAFETY: `filler` is what `serve` gave, and lives until the camera is told to forget it.
    let filler = unsafe { &*filler.cast::<Filler>() };
    let due = filler.due();
    let at = (due % filler.images.len() as i64) as usize;
    let image = filler.images.image(at, filler.side);
    let stamp_ns = filler.stamp_ns(due);
    // SAFETY: the buffer is the camera's own, filled by nobody else during the call. Its data have
    // width × height bytes, which Aravis has checked; the size it states is not set yet.
    unsafe {
        let mut size = 0;
        let data = aravis_sys::arv_buffer_get_data(buffer, &mut size).cast::<u8>();
        let width = aravis_sys::arv_buffer_get_image_width(buffer) as usize;
        let height = aravis_sys::arv_buffer_get_image_height(buffer) as usize;
        let out = std::slice::from_raw_parts_mut(data, width * height);
        crop(&image, width, out);
        aravis_sys::arv_buffer_set_timestamp(buffer, stamp_ns.max(0) as u64);
    }
}

/// The upper left part of an image, black where there is none.
fn crop(image: &GrayImage, width: usize, out: &mut [u8]) {
    for (y, row) in (0..).zip(out.chunks_exact_mut(width)) {
        row.fill(0);
        if y < image.height() {
            let own = image.row(y);
            let common = own.len().min(width);
            row[..common].copy_from_slice(&own[..common]);
        }
    }
}
