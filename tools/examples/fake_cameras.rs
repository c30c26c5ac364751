//! Serves a recording as two GigE Vision cameras, until its standard input ends or says `quit`.
//!
//! Meant to be run by `tools/fake-cameras`, which gives it a network of its own. Standard input takes a
//! command a line: `unplug left`, `plug left`, `lose 0.01` (a share of the packets), `quit`.

use clap::Parser;
use std::io::BufRead;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use visod::capture::{Dataset, Side};
use visod::simulation::gige::{CameraClock, GigeCamera, RecordedImages, Together};

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

/// The two cameras, each plugged in or not.
struct Cameras {
    args: Args,
    images: Arc<RecordedImages>,
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
            _ => return Err(format!("{line}: is no command")),
        }
        Ok(true)
    }
}

fn serve(args: Args) -> Result<(), String> {
    let dataset = Dataset::open(&args.dataset, None).map_err(|e| e.to_string())?;
    let images = Arc::new(RecordedImages::decode(&dataset)?);
    let rate_hz = args.rate.unwrap_or(1.0 / images.period_s());
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
