//! Serves a recording as two GigE Vision cameras, until its standard input ends or says `quit`.
//!
//! Meant to be run by `tools/fake-cameras`, which gives it a network of its own. Standard input takes a
//! command a line: `unplug left`, `plug left`, `lose 0.01` (a share of the packets), `spoil black` (what the images
//! show, by the words of `visod::simulation::corruption`, `spoil none` for what they should), `step 500` (sets the
//! clocks of both cameras forth, or back, by so many ms), `quit`.

use clap::Parser;
use rand::SeedableRng;
use rand_xoshiro::Xoshiro256PlusPlus;
use std::io::BufRead;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::atomic::{AtomicI64, Ordering};
use std::sync::{Arc, PoisonError, RwLock};
use visod::capture::{Dataset, Side, Skew, StereoPair};
use visod::image::GrayImage;
use visod::simulation::corruption::{Corruption, MAX_LAG, Material, Spoiler};
use visod::simulation::gige::{CameraClock, GigeCamera, Images, RecordedImages, Together};

/// Serve a recording as two GigE Vision cameras.
#[derive(Parser)]
struct Args {
    /// The recording.
    dataset: PathBuf,
    /// Frames a second [default: the recording's].
    #[arg(long, value_name = "HZ")]
    rate: Option<f64>,
    /// Network addresses of the left and the right camera.
    #[arg(long, value_name = "LEFT,RIGHT", value_delimiter = ',', default_values = ["127.0.0.1", "127.0.0.2"])]
    addresses: Vec<String>,
    /// How far the right camera's clock is ahead, ms.
    #[arg(long, value_name = "MS", default_value_t = 0.0)]
    offset_ms: f64,
    /// How much faster the right camera's clock runs, parts per million.
    #[arg(long, value_name = "PPM", default_value_t = 0.0)]
    drift_ppm: f64,
    /// Share of the packets that get lost.
    #[arg(long, value_name = "SHARE", default_value_t = 0.0)]
    lose: f64,
    /// Leave no pair out where this machine is too busy for the rate: fall behind instead.
    #[arg(long)]
    leave_none_out: bool,
}

/// A recording that may be spoilt while it is shown.
struct Shown {
    recorded: RecordedImages,
    spoilt: RwLock<Option<Vec<[Arc<GrayImage>; 2]>>>,
    ahead_ns: AtomicI64,
}

impl Shown {
    fn spoil(&self, kind: Corruption) {
        let spoilt = (kind != Corruption::None).then(|| self.spoilt_as(kind));
        *self.spoilt.write().unwrap_or_else(PoisonError::into_inner) = spoilt;
    }

    /// All pairs as one run of spoilt ones; those that have no others before or behind them take after them.
    fn spoilt_as(&self, kind: Corruption) -> Vec<[Arc<GrayImage>; 2]> {
        let count = self.len();
        let image = |at: usize, side| (*self.recorded.image(at, side)).clone();
        let pair = |at: usize| StereoPair {
            sequence: at as u64,
            timestamp_ns: self.recorded.timestamp_ns(at),
            skew: Skew::default(),
            left: image(at, Side::Left),
            right: image(at, Side::Right),
        };
        let around = (0..count + 2 * (MAX_LAG + 1))
            .map(|i| pair((i + count * (MAX_LAG + 1) - (MAX_LAG + 1)) % count));
        let pairs: Vec<StereoPair> = around.collect();
        let other_place = pair(count / 2);
        let material = Material {
            pairs: &pairs,
            other_place: &other_place,
        };
        let rng = Xoshiro256PlusPlus::seed_from_u64(1);
        let mut spoiler = Spoiler::new(kind, material, [MAX_LAG + 1, count], rng);
        let spoilt = (0..count).map(|i| spoiler.pair(MAX_LAG + 1 + i).pair);
        spoilt
            .map(|pair| [Arc::new(pair.left), Arc::new(pair.right)])
            .collect()
    }
}

impl Images for Shown {
    fn len(&self) -> usize {
        self.recorded.len()
    }

    fn timestamp_ns(&self, at: usize) -> i64 {
        self.recorded.timestamp_ns(at) + self.ahead_ns.load(Ordering::Relaxed)
    }

    fn image(&self, at: usize, side: Side) -> Arc<GrayImage> {
        let spoilt = self.spoilt.read().unwrap_or_else(PoisonError::into_inner);
        match &*spoilt {
            Some(images) => Arc::clone(&images[at][side as usize]),
            None => self.recorded.image(at, side),
        }
    }
}

/// The two cameras, each plugged in or not.
struct Cameras {
    args: Args,
    images: Arc<Shown>,
    rate_hz: f64,
    together: Arc<Together>,
    plugged: [Option<GigeCamera>; 2],
    lose: f64,
}

impl Cameras {
    fn plug(&mut self, side: Side) -> Result<(), String> {
        let at = side as usize;
        let serial = ["LEFT", "RIGHT"][at];
        let clock = match side {
            Side::Left => CameraClock::default(),
            Side::Right => CameraClock {
                offset_ns: (self.args.offset_ms * 1e6) as i64,
                drift: self.args.drift_ppm * 1e-6,
                ..CameraClock::default()
            },
        };
        let address = self
            .args
            .addresses
            .get(at)
            .ok_or("two addresses are needed")?;
        let camera = GigeCamera::serve(
            self.images.clone(),
            side,
            (address, serial),
            self.rate_hz,
            clock,
            Arc::clone(&self.together),
        )?;
        camera.lose_packets(self.lose);
        self.plugged[at] = Some(camera);
        Ok(())
    }

    fn obey(&mut self, line: &str) -> Result<bool, String> {
        let side = |word| match word {
            "left" => Ok(Side::Left),
            "right" => Ok(Side::Right),
            _ => Err(format!("{word}: is neither left nor right")),
        };
        match line.split_whitespace().collect::<Vec<_>>()[..] {
            [] => {}
            ["quit"] => return Ok(false),
            ["unplug", word] => self.plugged[side(word)? as usize] = None,
            ["plug", word] => self.plug(side(word)?)?,
            ["lose", share] => {
                self.lose = share.parse().map_err(|_| format!("{share}: is no share"))?;
                for camera in self.plugged.iter().flatten() {
                    camera.lose_packets(self.lose);
                }
            }
            ["spoil", word] => {
                let kind = serde_json::from_value(word.into());
                self.images.spoil(kind.map_err(|e| format!("{word}: {e}"))?);
            }
            ["step", ms] => {
                let ms: i64 = ms
                    .parse()
                    .map_err(|_| format!("{ms}: is no number of ms"))?;
                self.images
                    .ahead_ns
                    .fetch_add(ms * 1_000_000, Ordering::Relaxed);
            }
            _ => return Err(format!("{line}: is no command")),
        }
        Ok(true)
    }
}

fn serve(args: Args) -> Result<(), String> {
    let dataset = Dataset::open(&args.dataset, None).map_err(|e| e.to_string())?;
    let recorded = RecordedImages::decode(&dataset)?;
    let rate_hz = args.rate.unwrap_or(1.0 / recorded.period_s());
    let images = Arc::new(Shown {
        recorded,
        spoilt: RwLock::default(),
        ahead_ns: AtomicI64::new(0),
    });
    let lose = args.lose;
    let together = if args.leave_none_out {
        Together::leaving_none_out()
    } else {
        Together::default()
    };
    let mut cameras = Cameras {
        args,
        images,
        rate_hz,
        together: Arc::new(together),
        plugged: [None, None],
        lose,
    };
    cameras.plug(Side::Left)?;
    cameras.plug(Side::Right)?;
    println!(
        "serving Aravis-Fake-LEFT on {} and Aravis-Fake-RIGHT on {} at {rate_hz:.3} Hz",
        cameras.args.addresses[0], cameras.args.addresses[1]
    );
    for line in std::io::stdin().lock().lines() {
        match cameras.obey(&line.map_err(|e| e.to_string())?) {
            Ok(true) => println!("ok"),
            Ok(false) => return Ok(()),
            Err(e) => eprintln!("fake-cameras: {e}"),
        }
    }
    Ok(())
}

fn main() -> ExitCode {
    match serve(Args::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => {
            eprintln!("fake-cameras: {e}");
            ExitCode::FAILURE
        }
    }
}
