//! The scenes that visod knows by name.

use super::material::{Layer, Material, TextureKind, mix};
use super::scene::{Builder, Escort, Inside, Scene};
use nalgebra::Vector3;
use rand::{RngExt, SeedableRng};
use rand_xoshiro::Xoshiro256PlusPlus;
use std::f64::consts::PI;

/// The scenes to choose from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, clap::ValueEnum, serde::Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum SceneName {
    /// A furnished room, 10 m × 10 m: depths of 1 to 9 m.
    Room,
    /// A corridor of 160 m with boxes along its walls.
    Corridor,
    /// A hall of 44 m × 50 m with boxes and pillars: depths of 2 to 40 m.
    Hall,
    /// A street of 250 m between house fronts, under an open sky.
    Street,
    /// A room with nearly blank walls and a few pictures: hardly any features.
    Lowtexture,
    /// A hall of tiles and bricks that all look alike.
    Repetitive,
    /// The hall, with bodies that accompany the camera and fill a third of its image.
    Mover,
}

impl SceneName {
    /// Every scene.
    pub const ALL: [Self; 7] = [
        Self::Room,
        Self::Corridor,
        Self::Hall,
        Self::Street,
        Self::Lowtexture,
        Self::Repetitive,
        Self::Mover,
    ];

    /// The scene itself; `seed` decides its textures and where its boxes stand.
    #[must_use]
    pub fn build(self, seed: u64) -> Scene {
        let rng = &mut Xoshiro256PlusPlus::seed_from_u64(mix(seed ^ 0x5cee5));
        match self {
            Self::Room => furnished_room(
                seed,
                rng,
                &mosaic(0.5, 0.0012, 0.9),
                &mosaic(0.55, 0.0015, 0.8),
            ),
            Self::Corridor => corridor(seed, rng),
            Self::Hall => hall(seed, rng, &HallStyle::varied()).build(),
            Self::Street => street(seed, rng),
            Self::Lowtexture => low_texture(seed, rng),
            Self::Repetitive => hall(seed, rng, &HallStyle::repetitive()).build(),
            Self::Mover => mover(seed, rng),
        }
    }
}

impl std::fmt::Display for SceneName {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Room => "room",
            Self::Corridor => "corridor",
            Self::Hall => "hall",
            Self::Street => "street",
            Self::Lowtexture => "lowtexture",
            Self::Repetitive => "repetitive",
            Self::Mover => "mover",
        })
    }
}

fn mosaic(albedo: f32, texel_m: f64, gain: f32) -> Material {
    Material {
        albedo,
        layers: vec![Layer {
            texture: TextureKind::Mosaic,
            texel_m,
            gain,
            periodic: false,
        }],
    }
}

fn patches(albedo: f32, texel_m: f64, gain: f32) -> Material {
    Material {
        albedo,
        layers: vec![Layer {
            texture: TextureKind::Patches,
            texel_m,
            gain,
            periodic: false,
        }],
    }
}

/// Tiles or bricks of 512 texels, with a trace of wear that tells them apart.
fn tiles(albedo: f32, texel_m: f64) -> Material {
    Material {
        albedo,
        layers: vec![
            Layer {
                texture: TextureKind::Bricks,
                texel_m,
                gain: 0.9,
                periodic: true,
            },
            Layer {
                texture: TextureKind::Patches,
                texel_m: 0.002,
                gain: 0.06,
                periodic: false,
            },
        ],
    }
}

/// What tests of textures look at.
#[cfg(test)]
pub(super) fn plain_mosaic() -> Material {
    mosaic(0.5, 0.0015, 0.9)
}

/// The brightness of a box: bright, middle or dark.
fn any_albedo(rng: &mut Xoshiro256PlusPlus) -> f32 {
    rng.random_range(0.35..0.65)
}

fn furnished_room(
    seed: u64,
    rng: &mut Xoshiro256PlusPlus,
    floor: &Material,
    walls: &Material,
) -> Scene {
    let inside = Inside {
        floor: floor.clone(),
        walls: walls.clone(),
        ceiling: Some(mosaic(0.7, 0.002, 0.5)),
        sky: 0.0,
    };
    let mut room = Builder::new(seed, [-3.6, -1.8, -5.0], [6.4, 1.0, 5.0], &inside);
    furnish(&mut room, rng, |rng| mosaic(any_albedo(rng), 0.001, 0.9));
    room.build()
}

/// Shelves, tables and crates around the ellipse that trajectory `loop-room` needs.
fn furnish(
    room: &mut Builder,
    rng: &mut Xoshiro256PlusPlus,
    mut material: impl FnMut(&mut Xoshiro256PlusPlus) -> Material,
) {
    let places = 16;
    for k in 0..places {
        let angle = 2.0 * PI * (f64::from(k) + 0.3 * rng.random::<f64>()) / f64::from(places);
        let reach = rng.random_range(3.4..4.3);
        let (x, z) = (1.4 + reach * angle.cos(), reach * angle.sin());
        let size = [
            rng.random_range(0.4..1.1),
            rng.random_range(0.4..1.9),
            rng.random_range(0.4..0.9),
        ];
        let of = material(rng);
        room.block(x, z, size, rng.random_range(0.0..PI), &of);
    }
    // Something hangs between the camera's height and the ceiling, so that parallax fills the view.
    for k in 0..5 {
        let angle = 2.0 * PI * (f64::from(k) + 0.5) / 5.0;
        let of = material(rng);
        let centre = [1.4 + 3.1 * angle.cos(), -1.3, 3.1 * angle.sin()];
        room.floating_block(centre, [0.5, 0.4, 0.5], rng.random_range(0.0..PI), &of);
    }
}

fn low_texture(seed: u64, rng: &mut Xoshiro256PlusPlus) -> Scene {
    let inside = Inside {
        floor: mosaic(0.45, 0.002, 0.02),
        walls: mosaic(0.7, 0.002, 0.012),
        ceiling: Some(mosaic(0.8, 0.002, 0.01)),
        sky: 0.0,
    };
    let mut room = Builder::new(seed, [-3.6, -1.8, -5.0], [6.4, 1.0, 5.0], &inside);
    for k in 0..10 {
        let angle = 2.0 * PI * (f64::from(k) + 0.2) / 10.0;
        let (x, z) = (1.4 + 3.7 * angle.cos(), 3.9 * angle.sin());
        let size = [0.9, rng.random_range(0.3..0.8), 0.6];
        let of = mosaic(any_albedo(rng), 0.002, 0.02);
        room.block(x, z, size, rng.random_range(0.0..PI), &of);
    }
    // Pictures: thin boards before the walls.
    for k in 0..4 {
        let along = f64::from(k) * 2.2 - 3.4;
        let of = mosaic(any_albedo(rng), 0.001, 0.9);
        let y = rng.random_range(-0.9..0.0);
        room.floating_block([1.6 + along, y, 4.96], [0.5, 0.4, 0.04], 0.0, &of);
        room.floating_block([1.6 + along, y, -4.96], [0.5, 0.4, 0.04], 0.0, &of);
        room.floating_block([-3.56, y, along], [0.04, 0.4, 0.5], 0.0, &of);
        room.floating_block([6.36, y, along], [0.04, 0.4, 0.5], 0.0, &of);
    }
    room.build()
}

fn corridor(seed: u64, rng: &mut Xoshiro256PlusPlus) -> Scene {
    let inside = Inside {
        floor: mosaic(0.45, 0.0015, 0.8),
        walls: mosaic(0.55, 0.0015, 0.8),
        ceiling: Some(mosaic(0.65, 0.002, 0.5)),
        sky: 0.0,
    };
    let mut corridor = Builder::new(seed, [-2.2, -1.8, -4.0], [2.2, 1.0, 156.0], &inside);
    let mut z = 3.0;
    let mut side = 1.0;
    while z < 155.0 {
        let size = [
            rng.random_range(0.35..0.75),
            rng.random_range(0.4..2.2),
            rng.random_range(0.4..1.0),
        ];
        let x = side * (2.2 - 0.5 * size[0]);
        let of = mosaic(any_albedo(rng), 0.001, 0.9);
        corridor.block(x, z, size, rng.random_range(-0.1..0.1), &of);
        if rng.random::<f64>() < 0.25 {
            let lamp = [-side * 1.2, -1.5, z + 0.8];
            corridor.floating_block(lamp, [0.9, 0.25, 0.3], 0.0, &of);
        }
        side = -side;
        z += rng.random_range(1.2..2.6);
    }
    corridor.build()
}

/// What the hall and what stands in it is made of.
struct HallStyle {
    inside: Inside,
    boxes: fn(&mut Xoshiro256PlusPlus) -> Material,
}

impl HallStyle {
    fn varied() -> Self {
        Self {
            inside: Inside {
                floor: mosaic(0.45, 0.002, 0.85),
                walls: mosaic(0.55, 0.004, 0.85),
                ceiling: Some(patches(0.6, 0.006, 0.6)),
                sky: 0.0,
            },
            boxes: |rng| mosaic(any_albedo(rng), rng.random_range(0.001..0.002), 0.9),
        }
    }

    fn repetitive() -> Self {
        Self {
            inside: Inside {
                floor: tiles(0.5, 0.001),
                walls: tiles(0.5, 0.002),
                ceiling: Some(tiles(0.65, 0.003)),
                sky: 0.0,
            },
            boxes: |rng| tiles(any_albedo(rng), 0.001),
        }
    }
}

/// Where nothing stands in the hall, so that every trajectory fits: x and z from … to, m.
const HALL_CLEAR_M: [[f64; 2]; 2] = [[-6.5, 9.0], [-7.0, 18.0]];

fn hall(seed: u64, rng: &mut Xoshiro256PlusPlus, style: &HallStyle) -> Builder {
    let mut hall = Builder::new(seed, [-20.0, -5.0, -16.0], [24.0, 1.2, 34.0], &style.inside);
    let mut placed: Vec<[f64; 2]> = Vec::new();
    for _ in 0..400 {
        let at = [rng.random_range(-18.5..22.5), rng.random_range(-14.5..32.5)];
        let clear = |margin: f64| {
            (0..2)
                .any(|i| at[i] < HALL_CLEAR_M[i][0] - margin || at[i] > HALL_CLEAR_M[i][1] + margin)
        };
        let apart = |p: &[f64; 2]| (p[0] - at[0]).hypot(p[1] - at[1]) > 3.6;
        if placed.len() < 44 && clear(0.9) && placed.iter().all(apart) {
            placed.push(at);
            let pillar = rng.random::<f64>() < 0.25;
            let size = if pillar {
                [0.8, 6.2, 0.8]
            } else {
                [
                    rng.random_range(0.7..2.0),
                    rng.random_range(0.6..2.8),
                    rng.random_range(0.7..2.0),
                ]
            };
            let of = (style.boxes)(rng);
            hall.block(at[0], at[1], size, rng.random_range(0.0..PI), &of);
        }
    }
    // A lane of crates along the clear ground, for depths of a few metres.
    for k in 0..7 {
        let z = 3.0 + 2.4 * f64::from(k);
        for (x, turn) in [(-4.2, 0.3), (4.8, -0.4)] {
            // Trajectory `figure8` and `circle` pass through the first few places.
            if z > 6.5 {
                let of = (style.boxes)(rng);
                let size = [0.8, rng.random_range(0.5..1.6), 0.8];
                hall.block(x, z, size, turn + rng.random_range(0.0..0.5), &of);
            }
        }
    }
    hall
}

fn mover(seed: u64, rng: &mut Xoshiro256PlusPlus) -> Scene {
    let mut hall = hall(seed, rng, &HallStyle::varied());
    let floor = hall.floor_m();
    let mut escort = |size: [f64; 3], x: f64, z: f64, sway: [f64; 3], period_s: f64| {
        let escort = Escort {
            offset_m: Vector3::new(x, floor - 0.5 * size[1], z),
            sway_m: Vector3::from(sway),
            sway_rad: 0.12,
            period_s,
        };
        hall.moving_block(size, escort, &mosaic(0.5, 0.001, 0.9));
    };
    escort([1.0, 1.6, 0.8], -0.75, 5.2, [0.35, 0.0, 0.3], 5.3);
    escort([0.75, 1.5, 0.9], 0.95, 4.6, [0.25, 0.0, -0.4], 3.7);
    hall.build()
}

fn street(seed: u64, rng: &mut Xoshiro256PlusPlus) -> Scene {
    let inside = Inside {
        floor: mosaic(0.4, 0.002, 0.8),
        walls: mosaic(0.5, 0.004, 0.85),
        ceiling: None,
        sky: 0.85,
    };
    let mut street = Builder::new(seed, [-11.0, -9.0, -6.0], [11.0, 1.5, 244.0], &inside);
    for side in [-1.0, 1.0] {
        // House fronts that stand forward, and what is parked before them.
        let mut z = 0.0;
        while z < 240.0 {
            let length = rng.random_range(4.0..9.0);
            let depth = rng.random_range(0.5..3.0);
            let size = [depth, rng.random_range(3.5..10.0), length];
            let of = mosaic(any_albedo(rng), 0.003, 0.9);
            street.block(
                side * (11.0 - 0.5 * depth),
                z + 0.5 * length,
                size,
                0.0,
                &of,
            );
            z += length + rng.random_range(1.0..4.0);
        }
        let mut z = 5.0;
        while z < 240.0 {
            let size = [
                rng.random_range(0.6..1.8),
                rng.random_range(0.7..1.9),
                rng.random_range(0.6..3.6),
            ];
            let x = side * rng.random_range(3.2..5.8);
            let of = mosaic(any_albedo(rng), 0.0015, 0.9);
            street.block(x, z, size, rng.random_range(-0.15..0.15), &of);
            z += size[2] + rng.random_range(1.5..7.0);
        }
    }
    street.build()
}
