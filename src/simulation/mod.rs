//! Simulation: a scene, a trajectory and a rig in, images with known truth out.
//!
//! ```
//! use visod::simulation::{SceneName, Settings, Simulation, TrajectoryName, small_rig};
//!
//! let settings = Settings { frames: 10, ..Settings::default() };
//! let simulation =
//!     Simulation::new(SceneName::Room, TrajectoryName::LoopRoom, small_rig(), settings)?;
//! let (pair, odom_from_camera) = simulation.pair(3);
//! assert_eq!(pair.sequence, 3);
//! assert!(odom_from_camera.translation.vector.norm() > 0.05);
//! # Ok::<(), visod::simulation::SimulationError>(())
//! ```
//!
//! [`points`] simulates on the level of feature points instead: no images, thousands of times
//! faster.

mod camera;
pub mod corruption;
mod dataset_writer;
#[cfg(feature = "aravis")]
pub mod gige;
mod kernel;
mod material;
mod pattern;
pub mod points;
mod rays;
mod render;
mod scene;
mod scenes;
pub mod sensor;
mod source;
mod texture;
mod trajectory;
mod view;

pub use camera::SimulatedCamera;
pub use dataset_writer::{DatasetError, DatasetWriter};
pub use render::SIGMA_PX;
pub use scene::Scene;
pub use scenes::SceneName;
pub use source::SimulatedSource;
pub use trajectory::{FAST_TURN_RAD, Trajectory, TrajectoryName};

use crate::capture::{Side, StereoPair};
use crate::geometry::{Camera, Distortion, StereoRig, so3};
use crate::image::GrayImage;
use crate::settings::SettingError;
use nalgebra::{Isometry3, Point3, Translation3, Vector2, Vector3};
use rays::RayMap;
use render::{ImageKey, Renderer};
use view::{SeenFace, View};

/// How a simulation runs.
#[derive(Clone, Debug, PartialEq, serde::Deserialize, serde::Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// How many pairs there are. Pairs, 1 to 1000000, default 100.
    pub frames: u64,
    /// Pairs a second. Hz, 0.1 to 1000, default 10: the usual rate of such robots.
    pub rate_hz: f64,
    /// What textures, boxes, shaking and noise are drawn from. Any number, default 1.
    pub seed: u64,
    /// Speed along the path. m/s, 0 to 100, default: what suits the trajectory.
    pub speed_m_s: Option<f64>,
    /// Size of the path: a bend's radius, a figure's reach, a slalom's swing. m, 0.1 to 1000,
    /// default: what suits the trajectory.
    pub radius_m: Option<f64>,
    /// How much the camera shakes, 1 being millimetres and tenths of a degree. A factor, 0 to 20,
    /// default 1: a calm robot.
    pub shake: f64,
    /// How long the shutter is open, centred on the time stamp; motion blurs the image. ms, 0 to
    /// 1000, default 0: an instant.
    pub exposure_ms: f64,
    /// Pairs from … up to, but not including, … whose images are black. Default none.
    pub blackout: Option<[u64; 2]>,
    /// The cameras' sensors.
    pub sensor: sensor::Settings,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            frames: 100,
            rate_hz: 10.0,
            seed: 1,
            speed_m_s: None,
            radius_m: None,
            shake: 1.0,
            exposure_ms: 0.0,
            blackout: None,
            sensor: sensor::Settings::default(),
        }
    }
}

impl Settings {
    /// Whether the values can be used.
    ///
    /// # Errors
    /// A value lies outside its range.
    pub fn check(&self) -> Result<(), SettingError> {
        SettingError::unless_in("frames", self.frames, 1..=1_000_000)?;
        SettingError::unless_in("rate_hz", self.rate_hz, 0.1..=1000.0)?;
        if let Some(speed) = self.speed_m_s {
            SettingError::unless_in("speed_m_s", speed, 0.0..=100.0)?;
        }
        if let Some(radius) = self.radius_m {
            SettingError::unless_in("radius_m", radius, 0.1..=1000.0)?;
        }
        SettingError::unless_in("shake", self.shake, 0.0..=20.0)?;
        SettingError::unless_in("exposure_ms", self.exposure_ms, 0.0..=1000.0)?;
        if let Some([from, to]) = self.blackout
            && from >= to
        {
            return Err(SettingError {
                key: "blackout",
                cause: format!("must begin before it ends, but is {from}..{to}"),
            });
        }
        self.sensor.check()
    }
}

/// Why a simulation cannot be.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SimulationError {
    /// A setting is out of range.
    #[error("{}: {}", .0.key, .0.cause)]
    Setting(SettingError),
    /// The cameras would leave the scene or run into something.
    #[error(
        "trajectory {trajectory} runs into something in scene {scene} at frame {frame}, {way_m} m from its start: \
         ask for fewer frames, a lower speed, a smaller radius or a larger scene"
    )]
    Collision {
        /// The scene.
        scene: SceneName,
        /// The trajectory.
        trajectory: TrajectoryName,
        /// The first frame at which a camera would not be free.
        frame: u64,
        /// How far that is from the first frame, m, as text.
        way_m: String,
    },
}

/// A stereo rig on its way through a scene. Every frame can be asked for, in any order and from any
/// thread, and is always the same.
pub struct Simulation {
    scene: Scene,
    trajectory: Trajectory,
    rig: StereoRig,
    settings: Settings,
    left: Renderer,
    right: Renderer,
}

/// More views than this are not averaged for one exposure.
const MAX_VIEWS: usize = 64;

impl Simulation {
    /// Builds the scene and checks that the cameras have a free way.
    ///
    /// # Errors
    /// A setting is out of range, or a camera would run into something.
    pub fn new(
        scene: SceneName,
        trajectory: TrajectoryName,
        rig: StereoRig,
        settings: Settings,
    ) -> Result<Self, SimulationError> {
        settings.check().map_err(SimulationError::Setting)?;
        let path = Trajectory::new(
            trajectory,
            settings.rate_hz,
            settings.speed_m_s,
            settings.radius_m,
            settings.shake,
            settings.seed,
        );
        let built = scene.build(settings.seed);
        let simulation = Self {
            scene: built,
            trajectory: path,
            left: Renderer::new(RayMap::new(&rig.left)),
            right: Renderer::new(RayMap::new(&rig.right)),
            rig,
            settings,
        };
        match simulation.first_collision() {
            None => Ok(simulation),
            Some(frame) => Err(SimulationError::Collision {
                scene,
                trajectory,
                frame,
                way_m: format!(
                    "{:.1}",
                    simulation.odom_from_camera(frame).translation.vector.norm()
                ),
            }),
        }
    }

    /// The settings it runs with.
    #[must_use]
    pub fn settings(&self) -> &Settings {
        &self.settings
    }

    /// The rig that looks.
    #[must_use]
    pub fn rig(&self) -> &StereoRig {
        &self.rig
    }

    /// When pair `frame` is taken, ns since the first.
    #[must_use]
    #[expect(
        clippy::cast_possible_truncation,
        reason = "a million frames at a tenth of a hertz are far from the limit"
    )]
    pub fn timestamp_ns(&self, frame: u64) -> i64 {
        (frame as f64 * 1e9 / self.settings.rate_hz).round() as i64
    }

    /// The true pose of pair `frame`: maps a point of the left camera then into the left camera of
    /// pair 0.
    #[must_use]
    pub fn odom_from_camera(&self, frame: u64) -> Isometry3<f64> {
        if frame == 0 {
            return Isometry3::identity();
        }
        let world_from_odom = self.trajectory.world_from_camera(0.0);
        world_from_odom.inverse() * self.trajectory.world_from_camera(self.time_s(frame))
    }

    /// Pair `frame`, with its true pose as [`odom_from_camera`](Self::odom_from_camera) gives it.
    #[must_use]
    pub fn pair(&self, frame: u64) -> (StereoPair, Isometry3<f64>) {
        let pair = StereoPair {
            sequence: frame,
            timestamp_ns: self.timestamp_ns(frame),
            skew: crate::capture::Skew::default(),
            left: self.image(frame, Side::Left),
            right: self.image(frame, Side::Right),
        };
        (pair, self.odom_from_camera(frame))
    }

    /// One image of pair `frame`.
    #[must_use]
    pub fn image(&self, frame: u64, side: Side) -> GrayImage {
        let key = ImageKey {
            seed: self.settings.seed,
            frame,
            side,
        };
        let dark = self
            .settings
            .blackout
            .is_some_and(|[from, to]| (from..to).contains(&frame));
        let views = if dark {
            Vec::new()
        } else {
            self.views(frame, side)
        };
        self.renderer(side)
            .render(&self.scene, &views, &self.settings.sensor, key)
    }

    fn camera(&self, side: Side) -> &Camera {
        match side {
            Side::Left => &self.rig.left,
            Side::Right => &self.rig.right,
        }
    }

    fn renderer(&self, side: Side) -> &Renderer {
        match side {
            Side::Left => &self.left,
            Side::Right => &self.right,
        }
    }

    fn time_s(&self, frame: u64) -> f64 {
        frame as f64 / self.settings.rate_hz
    }

    fn world_from_side(&self, time_s: f64, side: Side) -> Isometry3<f64> {
        let world_from_left = self.trajectory.world_from_camera(time_s);
        match side {
            Side::Left => world_from_left,
            Side::Right => world_from_left * self.rig.right_from_left.inverse(),
        }
    }

    fn view(&self, time_s: f64, side: Side) -> View {
        let world_from_path = self.trajectory.world_from_path(time_s);
        let world_from_camera = self.world_from_side(time_s, side);
        View::new(&self.scene, &world_from_camera, &world_from_path, time_s)
    }

    /// The views that an exposure averages: enough that none is two thirds of a pixel from the next.
    fn views(&self, frame: u64, side: Side) -> Vec<View> {
        let time_s = self.time_s(frame);
        let exposure_s = self.settings.exposure_ms * 1e-3;
        let count = self.blur_px(time_s, exposure_s, side) * 1.5;
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "cut to 1 … MAX_VIEWS"
        )]
        let count = (count.ceil() as usize).clamp(1, MAX_VIEWS);
        (0..count)
            .map(|i| {
                let share = (i as f64 + 0.5) / count as f64 - 0.5;
                self.view(time_s + share * exposure_s, side)
            })
            .collect()
    }

    /// How far, at most and about, the image moves during an exposure, px.
    fn blur_px(&self, time_s: f64, exposure_s: f64, side: Side) -> f64 {
        const NEAR_M: f64 = 2.0;
        let camera = self.camera(side);
        let at = |t: f64| self.world_from_side(t, side);
        let (from, to) = (at(time_s - 0.5 * exposure_s), at(time_s + 0.5 * exposure_s));
        let motion = from.inverse() * to;
        let turn_px = motion.rotation.angle() * camera.focal_px.max();
        let shift_px = motion.translation.vector.norm() * camera.focal_px.max() / NEAR_M;
        turn_px + shift_px
    }

    fn first_collision(&self) -> Option<u64> {
        (0..self.settings.frames).find(|&frame| {
            [Side::Left, Side::Right].into_iter().any(|side| {
                let world_from_camera = self.world_from_side(self.time_s(frame), side);
                !self
                    .scene
                    .is_free(&Point3::from(world_from_camera.translation.vector))
            })
        })
    }
}

/// Looks through one camera at one instant: what is true at a pixel.
pub struct Looker<'a> {
    scene: &'a Scene,
    camera: &'a Camera,
    view: View,
    all: Vec<usize>,
}

impl<'a> Looker<'a> {
    /// Through the camera on `side` of `simulation` when pair `frame` is taken.
    #[must_use]
    pub fn new(simulation: &'a Simulation, frame: u64, side: Side) -> Self {
        let view = simulation.view(simulation.time_s(frame), side);
        Self {
            scene: &simulation.scene,
            camera: simulation.camera(side),
            all: (0..view.faces.len()).collect(),
            view,
        }
    }

    /// The depth, m along the optical axis, of what is seen at `pixel`; `None` for the sky and where
    /// the lens' model has no inverse.
    #[must_use]
    pub fn depth_m(&self, pixel: &Vector2<f64>) -> Option<f64> {
        let (seen, ray) = self.seen_at(pixel)?;
        Some(seen.depth_m(ray))
    }

    /// Whether what is seen at `pixel` moves on its own.
    #[must_use]
    pub fn is_moving(&self, pixel: &Vector2<f64>) -> bool {
        self.seen_at(pixel)
            .is_some_and(|(seen, _)| self.scene.faces[seen.face].body.is_some())
    }

    fn seen_at(&self, pixel: &Vector2<f64>) -> Option<(&SeenFace, [f64; 2])> {
        let ray: [f64; 2] = self.camera.unproject(pixel)?.into();
        let index = self.view.nearest(&self.all, ray)?;
        Some((&self.view.faces[index], ray))
    }
}

/// The thesis' rig at its images' size of 1280×960 pixels, without lens distortion.
#[must_use]
pub fn thesis_rig() -> StereoRig {
    let camera = |fx: f64, fy: f64, cx: f64, cy: f64| {
        Camera::new(
            1280,
            960,
            Vector2::new(fx, fy),
            Vector2::new(cx, cy),
            Distortion::None,
        )
    };
    StereoRig {
        left: camera(1771.63666, 1768.21228, 626.3761, 486.9874),
        right: camera(1765.87472, 1762.3608, 600.39562, 492.79666),
        right_from_left: Isometry3::from_parts(
            Translation3::new(-0.3857, -0.0072, 0.0001),
            so3::exp(&Vector3::new(0.04046, 0.01616, 0.01419)),
        ),
        base_from_camera: None,
        uncertainty: None,
    }
}

/// A rig of 320×240 pixels with a short baseline: quick to render.
#[must_use]
pub fn small_rig() -> StereoRig {
    let camera = Camera::new(
        320,
        240,
        Vector2::new(300.0, 300.0),
        Vector2::new(159.5, 119.5),
        Distortion::None,
    );
    StereoRig {
        left: camera.clone(),
        right: camera,
        right_from_left: Isometry3::translation(-0.15, 0.0, 0.0),
        base_from_camera: None,
        uncertainty: None,
    }
}

#[cfg(test)]
mod tests;
