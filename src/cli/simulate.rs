//! `visod simulate`: renders a dataset with ground truth.

use super::{Failure, progress};
use crate::geometry::{load_rig, so3};
use crate::simulation::{
    DatasetError, DatasetWriter, SceneName, Settings, Simulation, TrajectoryName, sensor,
    thesis_rig,
};
use std::path::PathBuf;

/// Render a stereo recording whose true poses are known.
///
/// OUT becomes a dataset that `visod replay` reads: left/ and right/ with PNG images, rig.toml,
/// times.txt and poses.txt (the true poses of the left camera, 3×4 row by row, the first one being
/// the identity).
#[derive(clap::Args)]
#[command(after_help = "\
Scenes and trajectories go together freely, as long as there is room: `room` and `lowtexture` are \
made for `loop-room`, `fast-turn` and `standstill`; `corridor` and `street` for long straight ways; \
`hall`, `repetitive` and `mover` for all.

Example: visod simulate --scene room --trajectory loop-room --frames 60 --rate 10 --seed 1 demo")]
pub(crate) struct Args {
    /// What there is to see.
    #[arg(long, value_enum, value_name = "NAME")]
    scene: SceneName,
    /// How the rig moves.
    #[arg(long, value_enum, value_name = "NAME")]
    trajectory: TrajectoryName,
    /// How many pairs to render.
    #[arg(long, value_name = "N", default_value_t = Settings::default().frames)]
    frames: u64,
    /// Pairs a second, Hz.
    #[arg(long, value_name = "HZ", default_value_t = Settings::default().rate_hz)]
    rate: f64,
    /// What textures, boxes, shaking and noise are drawn from: the same seed renders the same bits.
    #[arg(long, value_name = "S", default_value_t = Settings::default().seed)]
    seed: u64,
    /// The rig that looks, from a rig.toml [default: two cameras of 1280×960 pixels, 0.386 m apart].
    #[arg(long, value_name = "FILE")]
    rig: Option<PathBuf>,
    /// Speed along the path, m/s [default: what suits the trajectory].
    #[arg(long, value_name = "V")]
    speed_m_s: Option<f64>,
    /// Size of the path, m: a bend's radius, a figure's reach, a slalom's swing [default: what
    /// suits the trajectory].
    #[arg(long, value_name = "R")]
    radius_m: Option<f64>,
    /// How much the camera shakes: 1 for a calm robot, 0 for none.
    #[arg(long, value_name = "FACTOR", default_value_t = Settings::default().shake)]
    shake: f64,
    /// How long the shutter is open, ms: motion blurs the images.
    #[arg(long, value_name = "MS", default_value_t = Settings::default().exposure_ms)]
    exposure_ms: f64,
    /// Electrons of a white pixel: fewer make more photon noise.
    #[arg(long, value_name = "E", default_value_t = sensor::Settings::default().full_well_e)]
    full_well: f64,
    /// Standard deviation of reading a pixel, electrons.
    #[arg(long, value_name = "E", default_value_t = sensor::Settings::default().read_noise_e)]
    read_noise: f64,
    /// Render without any noise.
    #[arg(long, conflicts_with_all = ["full_well", "read_noise"])]
    no_noise: bool,
    /// Loss of light in the corners, a share.
    #[arg(long, value_name = "SHARE", default_value_t = sensor::Settings::default().vignetting)]
    vignetting: f64,
    /// Make frames FROM up to, but not including, TO black in both cameras.
    #[arg(long, value_name = "FROM..TO", value_parser = parse_range)]
    blackout: Option<[u64; 2]>,
    /// Print what was rendered as JSON.
    #[arg(long)]
    json: bool,
    /// The folder to write to; it must be new or empty.
    out: PathBuf,
}

/// What a simulation comes to, as `--json` prints it.
#[derive(serde::Serialize)]
struct Summary {
    out: String,
    scene: String,
    trajectory: String,
    frames: u64,
    rate_hz: f64,
    seed: u64,
    duration_s: f64,
    length_m: f64,
    turned_rad: f64,
    width_px: u32,
    height_px: u32,
}

pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let rig = match &args.rig {
        Some(file) => load_rig(file).map_err(Failure::usage)?,
        None => thesis_rig(),
    };
    let simulation = Simulation::new(args.scene, args.trajectory, rig, args.settings())
        .map_err(Failure::usage)?;
    let mut writer = DatasetWriter::create(&args.out, simulation.rig()).map_err(failure)?;
    let bar = progress::pairs(Some(args.frames));
    for frame in 0..args.frames {
        let (pair, odom_from_camera) = simulation.pair(frame);
        writer.add(&pair, &odom_from_camera).map_err(failure)?;
        bar.inc(1);
    }
    writer.finish().map_err(failure)?;
    bar.finish_and_clear();
    args.print(&args.summary(&simulation))
}

impl Args {
    fn settings(&self) -> Settings {
        Settings {
            frames: self.frames,
            rate_hz: self.rate,
            seed: self.seed,
            speed_m_s: self.speed_m_s,
            radius_m: self.radius_m,
            shake: self.shake,
            exposure_ms: self.exposure_ms,
            blackout: self.blackout,
            sensor: sensor::Settings {
                full_well_e: self.full_well,
                read_noise_e: self.read_noise,
                noisy: !self.no_noise,
                vignetting: self.vignetting,
            },
        }
    }

    fn summary(&self, simulation: &Simulation) -> Summary {
        let (mut length_m, mut turned_rad) = (0.0, 0.0);
        for frame in 1..self.frames {
            let motion = simulation.odom_from_camera(frame - 1).inverse()
                * simulation.odom_from_camera(frame);
            length_m += motion.translation.vector.norm();
            turned_rad += so3::log(&motion.rotation).norm();
        }
        Summary {
            out: self.out.display().to_string(),
            scene: self.scene.to_string(),
            trajectory: self.trajectory.to_string(),
            frames: self.frames,
            rate_hz: self.rate,
            seed: self.seed,
            duration_s: (self.frames - 1) as f64 / self.rate,
            length_m,
            turned_rad,
            width_px: simulation.rig().left.width,
            height_px: simulation.rig().left.height,
        }
    }

    fn print(&self, summary: &Summary) -> Result<(), Failure> {
        if self.json {
            let text = serde_json::to_string_pretty(summary).map_err(Failure::other)?;
            println!("{text}");
        } else {
            println!(
                "{}: {} pairs of {}×{} px: {:.1} s, {:.2} m and {:.0}° of {} through {}",
                summary.out,
                summary.frames,
                summary.width_px,
                summary.height_px,
                summary.duration_s,
                summary.length_m,
                summary.turned_rad.to_degrees(),
                summary.trajectory,
                summary.scene,
            );
        }
        Ok(())
    }
}

/// A folder that cannot be used is bad usage; a disk that cannot be written to is not.
fn failure(error: DatasetError) -> Failure {
    match error {
        DatasetError::NotEmpty(_) | DatasetError::NotAFolder(_) => Failure::usage(error),
        DatasetError::Write { .. } | DatasetError::Encode { .. } => Failure::other(error),
    }
}

fn parse_range(text: &str) -> Result<[u64; 2], String> {
    let numbers = text
        .split_once("..")
        .and_then(|(from, to)| Some([from.parse().ok()?, to.parse().ok()?]));
    numbers.ok_or_else(|| "must be two frame numbers such as 10..20".to_owned())
}
