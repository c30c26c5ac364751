//! A time in, the camera's exact pose out.
//!
//! Every trajectory starts at the world's origin heading along +z, lies in the level plane but for
//! the shaking of a robot's mast, and is smooth.

use super::material::mix;
use crate::geometry::se3;
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3, Vector6};
use std::f64::consts::{PI, TAU};

/// The trajectories to choose from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, clap::ValueEnum, serde::Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum TrajectoryName {
    /// Straight ahead.
    Straight,
    /// A wide bend to the right.
    Arc,
    /// Round and round a circle to the right.
    Circle,
    /// Swinging left and right of a straight line.
    Slalom,
    /// A figure of eight.
    Figure8,
    /// Around a room, looking about.
    LoopRoom,
    /// Straight ahead, stopping for two seconds out of every eight.
    StopAndGo,
    /// Turning on the spot by 7° from frame to frame.
    FastTurn,
    /// Not moving at all.
    Standstill,
}

/// The turn of `fast-turn` from frame to frame, rad.
pub const FAST_TURN_RAD: f64 = 7.0 * PI / 180.0;

/// A path through a scene and how fast it is travelled.
#[derive(Clone, Debug, PartialEq)]
pub struct Trajectory {
    name: TrajectoryName,
    speed_m_s: f64,
    radius_m: f64,
    turn_rad_s: f64,
    shake: f64,
    phases_rad: [f64; 12],
}

impl TrajectoryName {
    /// Every trajectory.
    pub const ALL: [Self; 9] = [
        Self::Straight,
        Self::Arc,
        Self::Circle,
        Self::Slalom,
        Self::Figure8,
        Self::LoopRoom,
        Self::StopAndGo,
        Self::FastTurn,
        Self::Standstill,
    ];

    /// The speed, m/s, that suits it.
    #[must_use]
    pub fn default_speed_m_s(self) -> f64 {
        match self {
            Self::LoopRoom => 0.5,
            Self::FastTurn | Self::Standstill => 0.0,
            _ => 1.0,
        }
    }

    /// Its size, m: the radius of a bend, the reach of a figure, the swing of a slalom.
    #[must_use]
    pub fn default_radius_m(self) -> f64 {
        match self {
            Self::Arc => 15.0,
            Self::Circle => 3.0,
            Self::Slalom => 0.5,
            Self::Figure8 => 4.5,
            Self::LoopRoom => 1.4,
            Self::Straight | Self::StopAndGo | Self::FastTurn | Self::Standstill => 0.0,
        }
    }
}

impl std::fmt::Display for TrajectoryName {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Straight => "straight",
            Self::Arc => "arc",
            Self::Circle => "circle",
            Self::Slalom => "slalom",
            Self::Figure8 => "figure8",
            Self::LoopRoom => "loop-room",
            Self::StopAndGo => "stop-and-go",
            Self::FastTurn => "fast-turn",
            Self::Standstill => "standstill",
        })
    }
}

/// A place of the level plane, m, and a heading, rad, 0 along z and positive to the right.
struct Place {
    x: f64,
    z: f64,
    heading_rad: f64,
    /// Height above the start, m.
    rise: f64,
}

impl Trajectory {
    /// A trajectory at its own speed and size, unless others are given. `rate_hz` is the frame rate
    /// that `fast-turn` counts by; `shake` scales the shaking, 1 being that of a calm robot; `seed`
    /// decides the shaking's phases.
    #[must_use]
    pub fn new(
        name: TrajectoryName,
        rate_hz: f64,
        speed_m_s: Option<f64>,
        radius_m: Option<f64>,
        shake: f64,
        seed: u64,
    ) -> Self {
        let phase = |i: u64| (mix(seed ^ mix(i ^ 0x7a_ec70)) >> 11) as f64 / (1_u64 << 53) as f64;
        Self {
            name,
            speed_m_s: speed_m_s.unwrap_or(name.default_speed_m_s()),
            radius_m: radius_m.unwrap_or(name.default_radius_m()),
            turn_rad_s: FAST_TURN_RAD * rate_hz,
            shake,
            phases_rad: std::array::from_fn(|i| TAU * phase(i as u64)),
        }
    }

    /// The name it was made by.
    #[must_use]
    pub fn name(&self) -> TrajectoryName {
        self.name
    }

    /// The camera at `time_s`, shaking included.
    #[must_use]
    pub fn world_from_camera(&self, time_s: f64) -> Isometry3<f64> {
        self.world_from_path(time_s) * se3::exp(&self.shaking(self.travelled_m(time_s)))
    }

    /// The path alone, without the shaking.
    #[must_use]
    pub fn world_from_path(&self, time_s: f64) -> Isometry3<f64> {
        let place = self.place(time_s);
        Isometry3::from_parts(
            Translation3::new(place.x, -place.rise, place.z),
            UnitQuaternion::from_axis_angle(&Vector3::y_axis(), place.heading_rad),
        )
    }

    /// The nominal way since the start, m.
    fn travelled_m(&self, time_s: f64) -> f64 {
        match self.name {
            TrajectoryName::StopAndGo => self.speed_m_s * stop_and_go_s(time_s),
            _ => self.speed_m_s * time_s,
        }
    }

    fn place(&self, time_s: f64) -> Place {
        let way = self.travelled_m(time_s);
        let radius = self.radius_m;
        let level = |x: f64, z: f64, heading_rad: f64| Place {
            x,
            z,
            heading_rad,
            rise: 0.0,
        };
        match self.name {
            TrajectoryName::Straight | TrajectoryName::StopAndGo => level(0.0, way, 0.0),
            TrajectoryName::Arc | TrajectoryName::Circle => {
                let angle = way / radius;
                level(radius * (1.0 - angle.cos()), radius * angle.sin(), angle)
            }
            TrajectoryName::Slalom => slalom(radius, way),
            TrajectoryName::Figure8 => figure8(radius, way),
            TrajectoryName::LoopRoom => loop_room(radius, way),
            TrajectoryName::FastTurn => level(0.0, way, self.turn_rad_s * time_s),
            TrajectoryName::Standstill => level(0.0, 0.0, 0.0),
        }
    }

    /// The shaking after a way of `way_m`: a twist of a few millimetres and tenths of a degree. It
    /// follows the way, not the time, so that a robot that stands does not shake.
    fn shaking(&self, way_m: f64) -> Vector6<f64> {
        const AMPLITUDE: [f64; 6] = [0.003, 0.005, 0.002, 0.004, 0.003, 0.005];
        const WAVES_PER_M: [[f64; 2]; 6] = [
            [0.61, 1.37],
            [0.83, 1.73],
            [0.47, 1.19],
            [0.71, 1.61],
            [0.53, 1.13],
            [0.67, 1.43],
        ];
        let still = matches!(
            self.name,
            TrajectoryName::FastTurn | TrajectoryName::Standstill
        );
        if still || self.shake == 0.0 {
            return Vector6::zeros();
        }
        Vector6::from_fn(|i, _| {
            let wave =
                |k: usize| (TAU * WAVES_PER_M[i][k] * way_m + self.phases_rad[2 * i + k]).sin();
            self.shake * AMPLITUDE[i] * (0.7 * wave(0) + 0.3 * wave(1))
        })
    }
}

/// The time, s, for which a robot would have driven at full speed that starts and stops: in every
/// eight seconds it speeds up for one, drives for four, slows down for one and stands for two.
fn stop_and_go_s(time_s: f64) -> f64 {
    const PERIOD_S: f64 = 8.0;
    const DRIVEN_S: f64 = 5.0;
    // The integral of the speed (1 − cos πt)/2, which joins standing and driving smoothly.
    let ramp = |t: f64| 0.5 * (t - (PI * t).sin() / PI);
    let periods = (time_s / PERIOD_S).floor();
    let t = time_s - periods * PERIOD_S;
    let within = if t < 1.0 {
        ramp(t)
    } else if t < 5.0 {
        0.5 + (t - 1.0)
    } else if t < 6.0 {
        DRIVEN_S - ramp(6.0 - t)
    } else {
        DRIVEN_S
    };
    periods * DRIVEN_S + within
}

/// A cubed sine of eight metres about the z axis: unlike a plain one, it begins along the axis.
fn slalom(swing_m: f64, way: f64) -> Place {
    const WAVE: f64 = TAU / 8.0;
    let (sin, cos) = (WAVE * way).sin_cos();
    Place {
        x: swing_m * sin.powi(3),
        z: way,
        heading_rad: (3.0 * swing_m * WAVE * sin * sin * cos).atan(),
        rise: 0.0,
    }
}

/// Gerono's lemniscate, turned so that it begins along z; its length is 6.0972 times its reach.
fn figure8(reach_m: f64, way: f64) -> Place {
    let phase = TAU * way / (6.0972 * reach_m);
    let (p, q) = (reach_m * phase.sin(), 0.5 * reach_m * (2.0 * phase).sin());
    let (dp, dq) = (phase.cos(), (2.0 * phase).cos());
    let turned = |a: f64, b: f64| ((b - a) * 0.5_f64.sqrt(), (a + b) * 0.5_f64.sqrt());
    let (x, z) = turned(p, q);
    let (dx, dz) = turned(dp, dq);
    Place {
        x,
        z,
        heading_rad: dx.atan2(dz),
        rise: 0.0,
    }
}

/// An ellipse around a point to the right, looking to and fro and rising a little.
fn loop_room(radius_m: f64, way: f64) -> Place {
    const STRETCH: f64 = 1.2;
    let phase = way / (radius_m * 0.5 * (1.0 + STRETCH));
    let (dx, dz) = (phase.sin(), STRETCH * phase.cos());
    Place {
        x: radius_m * (1.0 - phase.cos()),
        z: radius_m * STRETCH * phase.sin(),
        heading_rad: dx.atan2(dz) + 0.3 * (3.0 * phase).sin(),
        rise: 0.05 * (2.0 * phase).sin(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn every() -> impl Iterator<Item = Trajectory> {
        TrajectoryName::ALL
            .into_iter()
            .map(|name| Trajectory::new(name, 20.0, None, None, 1.0, 11))
    }

    #[test]
    fn every_path_begins_at_the_origin_along_z() {
        for trajectory in every() {
            let start = trajectory.world_from_path(0.0);
            assert!(se3::log(&start).norm() < 1e-3, "{:?}", trajectory.name());
        }
    }

    #[test]
    fn poses_are_smooth() {
        // Halving the step must quarter the second difference: a jump of pose or velocity would not.
        for trajectory in every() {
            let bend = |t: f64, h: f64| {
                let motion = |a: f64, b: f64| {
                    se3::log(
                        &(trajectory.world_from_camera(a).inverse()
                            * trajectory.world_from_camera(b)),
                    )
                };
                (motion(t, t + h) - motion(t - h, t)).norm()
            };
            for k in 0..2000 {
                let t = 0.0137 * f64::from(k);
                let (coarse, fine) = (bend(t, 2e-3), bend(t, 1e-3));
                assert!(
                    fine < 0.5 * coarse + 1e-9,
                    "{:?} at {t} s: {coarse} then {fine}",
                    trajectory.name()
                );
            }
        }
    }

    #[test]
    fn a_heading_follows_the_path_where_it_should() {
        for name in [
            TrajectoryName::Arc,
            TrajectoryName::Circle,
            TrajectoryName::Slalom,
            TrajectoryName::Figure8,
        ] {
            let trajectory = Trajectory::new(name, 20.0, None, None, 0.0, 0);
            for k in 1..200 {
                let t = 0.1 * f64::from(k);
                let here = trajectory.world_from_path(t);
                let ahead = trajectory.world_from_path(t + 1e-4);
                let direction = here.inverse_transform_vector(
                    &(ahead.translation.vector - here.translation.vector),
                );
                let angle = direction.x.atan2(direction.z);
                assert!(angle.abs() < 1e-3, "{name} at {t} s: {angle} rad");
            }
        }
    }

    #[test]
    fn a_fast_turn_is_seven_degrees_a_frame_at_any_rate() {
        for rate in [5.0, 15.0, 30.0] {
            let trajectory = Trajectory::new(TrajectoryName::FastTurn, rate, None, None, 1.0, 4);
            for k in 0..60 {
                let at = |k: u32| trajectory.world_from_camera(f64::from(k) / rate);
                let motion = at(k).inverse() * at(k + 1);
                assert!((motion.rotation.angle().to_degrees() - 7.0).abs() < 1e-9);
                assert!(motion.translation.vector.norm() < 1e-12);
            }
        }
    }

    #[test]
    fn a_stopped_robot_stands_perfectly_still() {
        let trajectory = Trajectory::new(TrajectoryName::StopAndGo, 20.0, Some(1.5), None, 1.0, 4);
        for period in 0..3 {
            let start = 8.0 * f64::from(period) + 6.0;
            let (a, b) = (
                trajectory.world_from_camera(start),
                trajectory.world_from_camera(start + 1.99),
            );
            assert_eq!(a, b);
            let moving = trajectory.world_from_camera(start - 2.0);
            let later = trajectory.world_from_camera(start - 1.0);
            let way = (later.translation.vector - moving.translation.vector).norm();
            assert!(way > 1.0, "{way}");
        }
    }

    #[test]
    fn a_circle_closes() {
        let trajectory =
            Trajectory::new(TrajectoryName::Circle, 20.0, Some(1.0), Some(2.0), 0.0, 4);
        let turn = trajectory.world_from_path(TAU * 2.0);
        assert!(se3::log(&turn).norm() < 1e-12);
    }
}
