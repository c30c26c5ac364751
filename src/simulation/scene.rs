//! A scene's name and seed in, its textured faces out.
//!
//! The world frame has the axes of a camera that stands level at the trajectory's start: x right,
//! y down, z forward, metres.

use super::material::{Material, mix};
use nalgebra::{Isometry3, Point3, Vector3};

/// A rectangle that is seen from one side, fixed to a body.
#[derive(Clone, Debug)]
pub(super) struct Face {
    /// The corner where both edges begin.
    pub(super) corner: Point3<f64>,
    /// Directions of the edges, of length 1; `across × along` points to where it is seen from.
    pub(super) across: Vector3<f64>,
    pub(super) along: Vector3<f64>,
    /// Lengths of the edges, m.
    pub(super) size_m: [f64; 2],
    /// Index of its material.
    pub(super) material: usize,
    /// Tells it apart from other faces of the same material.
    pub(super) seed: u64,
    /// Brightness under the scene's light: 1 faces it.
    pub(super) shade: f32,
    /// Index of the body that it moves with; `None` where nothing moves.
    pub(super) body: Option<usize>,
}

/// An upright block that cameras must not run into.
#[derive(Clone, Debug)]
pub(super) struct Block {
    world_from_block: Isometry3<f64>,
    half_m: Vector3<f64>,
}

/// How a moving body moves.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Escort {
    /// Where it stays relative to the camera's path, m.
    pub(super) offset_m: Vector3<f64>,
    /// How far it sways about that place, m.
    pub(super) sway_m: Vector3<f64>,
    /// How far it turns to and fro about the vertical, rad.
    pub(super) sway_rad: f64,
    /// Period of its swaying, s.
    pub(super) period_s: f64,
}

impl Escort {
    /// Where the body is at `time_s`, beside a camera that is at `world_from_path`.
    pub(super) fn world_from_body(
        &self,
        world_from_path: &Isometry3<f64>,
        time_s: f64,
    ) -> Isometry3<f64> {
        let phase = std::f64::consts::TAU * time_s / self.period_s;
        let place = self.offset_m + self.sway_m * phase.sin();
        let turn = Vector3::y() * (self.sway_rad * (0.7 * phase).sin());
        world_from_path * Isometry3::new(place, turn)
    }
}

/// A world: faces, what they are made of, and where a camera may be.
pub struct Scene {
    pub(super) faces: Vec<Face>,
    pub(super) materials: Vec<Material>,
    pub(super) bodies: Vec<Escort>,
    /// Radiance of what no face covers.
    pub(super) sky: f32,
    blocks: Vec<Block>,
    room_m: [Point3<f64>; 2],
}

/// Cameras keep at least this far, m, from walls and blocks.
const CLEARANCE_M: f64 = 0.3;

impl Scene {
    /// Whether a camera may be at `point`: inside the scene and clear of everything that stands.
    #[must_use]
    pub fn is_free(&self, point: &Point3<f64>) -> bool {
        let [low, high] = &self.room_m;
        let inside =
            (0..3).all(|i| point[i] >= low[i] + CLEARANCE_M && point[i] <= high[i] - CLEARANCE_M);
        inside && self.blocks.iter().all(|block| block.is_clear_of(point))
    }
}

impl Block {
    fn is_clear_of(&self, point: &Point3<f64>) -> bool {
        let local = self.world_from_block.inverse_transform_point(point);
        (0..3).any(|i| local[i].abs() > self.half_m[i] + CLEARANCE_M)
    }
}

/// Puts a scene together, piece by piece.
pub(super) struct Builder {
    faces: Vec<Face>,
    materials: Vec<Material>,
    bodies: Vec<Escort>,
    blocks: Vec<Block>,
    room_m: [Point3<f64>; 2],
    sky: f32,
    seed: u64,
}

/// Share of the light that comes from everywhere.
const AMBIENT: f64 = 0.6;

impl Builder {
    /// A hollow room from `low` to `high` (m) whose walls, floor and ceiling are of the given
    /// materials; without a ceiling the sky of the given radiance is seen.
    pub(super) fn new(seed: u64, low: [f64; 3], high: [f64; 3], inside: &Inside) -> Self {
        let mut builder = Self {
            faces: Vec::new(),
            materials: Vec::new(),
            bodies: Vec::new(),
            blocks: Vec::new(),
            room_m: [Point3::from(low), Point3::from(high)],
            sky: inside.sky,
            seed,
        };
        let [low, high] = builder.room_m;
        let half = (high - low) * 0.5;
        let centre = Isometry3::translation(low.x + half.x, low.y + half.y, low.z + half.z);
        for axis in 0..3 {
            for sign in [-1.0, 1.0] {
                let material = match (axis, sign > 0.0) {
                    (1, true) => Some(&inside.floor),
                    (1, false) => inside.ceiling.as_ref(),
                    _ => Some(&inside.walls),
                };
                if let Some(material) = material {
                    builder.side(&centre, &half, axis, sign, false, material, None);
                }
            }
        }
        builder
    }

    /// The level of the floor, m (y points down).
    pub(super) fn floor_m(&self) -> f64 {
        self.room_m[1].y
    }

    /// Adds a block that stands on the floor.
    pub(super) fn block(&mut self, x: f64, z: f64, size_m: [f64; 3], yaw_rad: f64, of: &Material) {
        let y = self.floor_m() - 0.5 * size_m[1];
        self.floating_block([x, y, z], size_m, yaw_rad, of);
    }

    /// Adds a block whose centre is at `centre`.
    pub(super) fn floating_block(
        &mut self,
        centre: [f64; 3],
        size_m: [f64; 3],
        yaw_rad: f64,
        of: &Material,
    ) {
        let world_from_block = Isometry3::new(Vector3::from(centre), Vector3::y() * yaw_rad);
        let half_m = Vector3::from(size_m) * 0.5;
        self.sides(&world_from_block, &half_m, of, None);
        self.blocks.push(Block {
            world_from_block,
            half_m,
        });
    }

    /// Adds a block that moves; the camera may run into it.
    pub(super) fn moving_block(&mut self, size_m: [f64; 3], escort: Escort, of: &Material) {
        let body = self.bodies.len();
        self.bodies.push(escort);
        let half_m = Vector3::from(size_m) * 0.5;
        self.sides(&Isometry3::identity(), &half_m, of, Some(body));
    }

    /// The finished scene.
    pub(super) fn build(self) -> Scene {
        Scene {
            faces: self.faces,
            materials: self.materials,
            bodies: self.bodies,
            sky: self.sky,
            blocks: self.blocks,
            room_m: self.room_m,
        }
    }

    fn sides(
        &mut self,
        body_from_block: &Isometry3<f64>,
        half_m: &Vector3<f64>,
        of: &Material,
        body: Option<usize>,
    ) {
        for axis in 0..3 {
            for sign in [-1.0, 1.0] {
                self.side(body_from_block, half_m, axis, sign, true, of, body);
            }
        }
    }

    #[expect(
        clippy::too_many_arguments,
        reason = "one private place that makes faces"
    )]
    fn side(
        &mut self,
        body_from_block: &Isometry3<f64>,
        half_m: &Vector3<f64>,
        axis: usize,
        sign: f64,
        outside: bool,
        of: &Material,
        body: Option<usize>,
    ) {
        let unit = |i: usize| Vector3::ith(i, 1.0);
        let towards_viewer = if outside { sign } else { -sign };
        // unit(a + 1) × unit(a + 2) = unit(a). Textures are read fastest along `across`: it is the
        // direction in which a face is usually foreshortened, level, and forwards where there is a
        // choice. `along` completes it to a face that is seen from the right side.
        let across = if axis == 2 { unit(0) } else { unit(2) };
        let along = unit(axis).cross(&across) * towards_viewer;
        let half_of = |v: &Vector3<f64>| v.abs().dot(half_m);
        let corner = Point3::from(
            unit(axis) * (sign * half_m[axis])
                - across * half_of(&across)
                - along * half_of(&along),
        );
        let normal = body_from_block * unit(axis) * towards_viewer;
        let light = Vector3::new(0.45, -0.75, -0.5).normalize();
        let shade = AMBIENT + (1.0 - AMBIENT) * normal.dot(&light).max(0.0);
        let material = self.index_of(of);
        self.faces.push(Face {
            corner: body_from_block * corner,
            across: body_from_block * across,
            along: body_from_block * along,
            size_m: [2.0 * half_of(&across), 2.0 * half_of(&along)],
            material,
            seed: mix(self.seed ^ mix(self.faces.len() as u64)),
            shade: shade as f32,
            body,
        });
    }

    fn index_of(&mut self, material: &Material) -> usize {
        match self.materials.iter().position(|m| m == material) {
            Some(index) => index,
            None => {
                self.materials.push(material.clone());
                self.materials.len() - 1
            }
        }
    }
}

/// What the inside of a scene is made of.
pub(super) struct Inside {
    pub(super) floor: Material,
    pub(super) walls: Material,
    /// `None`: open to the sky.
    pub(super) ceiling: Option<Material>,
    /// Radiance of the sky.
    pub(super) sky: f32,
}
