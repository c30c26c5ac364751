//! Views of a scene in, one camera's image out.
//!
//! Inside a surface, a pixel is the texture's mean under the pixel's own point spread. Where
//! surfaces meet, rays scattered as the point spread decide how much of the pixel each of them
//! fills. Tiles that one surface fills, most of them, need no test of visibility at all.

use super::rays::{APRON_PX, RayMap, TILE_PX};
use super::scene::Scene;
use super::sensor::{self, RowKey};
use super::view::View;
use crate::capture::Side;
use crate::image::GrayImage;
use rayon::prelude::*;

/// Standard deviation of a pixel's point spread, px: a sharp lens before square pixels.
pub const SIGMA_PX: f64 = 0.6;
/// Rays that decide how a pixel is shared between surfaces.
const EDGE_RAYS: usize = 61;
/// What a pixel that meets no face sees.
const SKY: usize = usize::MAX;
/// What a pixel sees where the lens' model has no inverse.
const BLIND: usize = usize::MAX - 1;

/// Renders the images of one camera.
pub(super) struct Renderer {
    pub(super) rays: RayMap,
    edge_rays: [[f64; 2]; EDGE_RAYS],
}

/// Whose image it is: the key of its noise.
#[derive(Clone, Copy)]
pub(super) struct ImageKey {
    pub(super) seed: u64,
    pub(super) frame: u64,
    pub(super) side: Side,
}

/// Memory that a band of tiles works in.
#[derive(Default)]
struct Scratch {
    candidates: Vec<usize>,
    surfaces: Vec<usize>,
    shares: Vec<Share>,
}

/// How many of a pixel's rays met a surface, and the sum of these rays.
struct Share {
    surface: usize,
    count: u32,
    ray: [f64; 2],
}

impl Renderer {
    pub(super) fn new(rays: RayMap) -> Self {
        // A sunflower whose radii follow the Gaussian, cut off where the apron ends.
        let limit = APRON_PX as f64;
        let kept = 1.0 - (-0.5 * (limit / SIGMA_PX).powi(2)).exp();
        let golden_rad = std::f64::consts::PI * (3.0 - 5.0_f64.sqrt());
        let edge_rays = std::array::from_fn(|i| {
            let share = (i as f64 + 0.5) / EDGE_RAYS as f64 * kept;
            let radius = SIGMA_PX * (-2.0 * (1.0 - share).ln()).sqrt();
            let angle = golden_rad * i as f64;
            [radius * angle.cos(), radius * angle.sin()]
        });
        Self { rays, edge_rays }
    }

    /// The mean of the `views` (several for a long exposure) as the sensor gives it.
    pub(super) fn render(
        &self,
        scene: &Scene,
        views: &[View],
        settings: &sensor::Settings,
        key: ImageKey,
    ) -> GrayImage {
        let width = self.rays.width;
        let mut image = GrayImage::filled(width as u32, self.rays.height as u32, 0);
        image
            .pixels_mut()
            .par_chunks_mut(TILE_PX * width)
            .enumerate()
            .for_each(|(band, rows)| {
                let mut radiance = vec![0.0; rows.len()];
                let mut scratch = Scratch::default();
                for view in views {
                    for tile_x in 0..self.rays.tiles_across() {
                        self.add_tile(scene, view, [tile_x, band], &mut scratch, &mut radiance);
                    }
                }
                let by_count = 1.0 / views.len().max(1) as f32;
                for (i, (values, grey)) in radiance
                    .chunks_exact_mut(width)
                    .zip(rows.chunks_exact_mut(width))
                    .enumerate()
                {
                    let row = band * TILE_PX + i;
                    self.vignette(values, row, by_count, settings.vignetting);
                    let key = RowKey {
                        seed: key.seed,
                        frame: key.frame,
                        side: key.side,
                        row: row as u32,
                    };
                    sensor::expose(settings, &key, values, grey);
                }
            });
        image
    }

    /// Adds a tile's radiance to its band.
    fn add_tile(
        &self,
        scene: &Scene,
        view: &View,
        [tile_x, tile_y]: [usize; 2],
        scratch: &mut Scratch,
        band: &mut [f32],
    ) {
        let rays = &self.rays;
        let columns = tile_x * TILE_PX..((tile_x + 1) * TILE_PX).min(rays.width);
        let rows = tile_y * TILE_PX..((tile_y + 1) * TILE_PX).min(rays.height);
        let cone = rays.cone(tile_x, tile_y);
        let covered = view.cull(cone, &mut scratch.candidates);
        let around = Around::of(rays, tile_x, tile_y);
        let uniform = if covered {
            true
        } else {
            around.find(rays, view, scratch)
        };
        for y in rows.clone() {
            let out = &mut band[(y - rows.start) * rays.width..][..rays.width];
            for x in columns.clone() {
                out[x] += if covered {
                    self.surface(scene, view, scratch.candidates[0], [x, y], rays.at(x, y))
                } else if uniform || around.is_alone(&scratch.surfaces, x, y) {
                    let surface = scratch.surfaces[around.index(x, y)];
                    self.surface(scene, view, surface, [x, y], rays.at(x, y))
                } else {
                    self.shared(scene, view, scratch, [x, y])
                };
            }
        }
    }

    /// The radiance of a surface around a pixel along `ray`.
    fn surface(
        &self,
        scene: &Scene,
        view: &View,
        surface: usize,
        [x, y]: [usize; 2],
        ray: [f64; 2],
    ) -> f32 {
        let Some(seen) = view.faces.get(surface) else {
            return if surface == SKY { scene.sky } else { 0.0 };
        };
        let footing = seen.footing(ray, &self.rays.derivative(x, y), SIGMA_PX);
        let [xx, _, yy] = footing.cov_m2;
        if !(xx + yy).is_finite() {
            return 0.0;
        }
        let face = &scene.faces[seen.face];
        let material = &scene.materials[face.material];
        face.shade * material.albedo(footing.place, footing.cov_m2, face.seed)
    }

    /// The radiance of a pixel that several surfaces share.
    fn shared(&self, scene: &Scene, view: &View, scratch: &mut Scratch, [x, y]: [usize; 2]) -> f32 {
        let centre = self.rays.at(x, y);
        let [dx, dy] = self.rays.derivative(x, y);
        scratch.shares.clear();
        for [a, b] in self.edge_rays {
            let ray = [
                centre[0] + a * dx[0] + b * dy[0],
                centre[1] + a * dx[1] + b * dy[1],
            ];
            let surface = surface_along(view, &scratch.candidates, ray);
            match scratch.shares.iter_mut().find(|s| s.surface == surface) {
                Some(share) => {
                    share.count += 1;
                    share.ray[0] += ray[0];
                    share.ray[1] += ray[1];
                }
                None => scratch.shares.push(Share {
                    surface,
                    count: 1,
                    ray,
                }),
            }
        }
        // A surface is convex, so that the mean of the rays that meet it meets it.
        scratch
            .shares
            .iter()
            .map(|share| {
                let by_count = 1.0 / f64::from(share.count);
                let ray = [share.ray[0] * by_count, share.ray[1] * by_count];
                let part = share.count as f32 / EDGE_RAYS as f32;
                part * self.surface(scene, view, share.surface, [x, y], ray)
            })
            .sum()
    }

    /// Scales a row by `factor` and by what the lens lets through.
    fn vignette(&self, values: &mut [f32], row: usize, factor: f32, strength: f64) {
        let half = [0.5 * self.rays.width as f64, 0.5 * self.rays.height as f64];
        let y = row as f64 + 0.5 - half[1];
        let by_corner2 = 1.0 / (half[0] * half[0] + half[1] * half[1]);
        for (x, value) in values.iter_mut().enumerate() {
            let x = x as f64 + 0.5 - half[0];
            let loss = strength * (x * x + y * y) * by_corner2;
            *value *= factor * (1.0 - loss) as f32;
        }
    }
}

/// What a single ray meets.
fn surface_along(view: &View, candidates: &[usize], ray: [f64; 2]) -> usize {
    if !(ray[0].is_finite() && ray[1].is_finite()) {
        return BLIND;
    }
    view.nearest(candidates, ray).unwrap_or(SKY)
}

/// A tile with its apron.
struct Around {
    columns: std::ops::Range<usize>,
    rows: std::ops::Range<usize>,
}

impl Around {
    fn of(rays: &RayMap, tile_x: usize, tile_y: usize) -> Self {
        Self {
            columns: RayMap::with_apron(tile_x, rays.width),
            rows: RayMap::with_apron(tile_y, rays.height),
        }
    }

    fn index(&self, x: usize, y: usize) -> usize {
        (y - self.rows.start) * self.columns.len() + x - self.columns.start
    }

    /// Finds what every pixel's centre meets; returns whether all meet the same.
    fn find(&self, rays: &RayMap, view: &View, scratch: &mut Scratch) -> bool {
        scratch.surfaces.clear();
        for y in self.rows.clone() {
            for x in self.columns.clone() {
                let surface = surface_along(view, &scratch.candidates, rays.at(x, y));
                scratch.surfaces.push(surface);
            }
        }
        let first = scratch.surfaces[0];
        scratch.surfaces.iter().all(|&s| s == first)
    }

    /// Whether all pixels around (x, y) that could touch it meet what it meets.
    fn is_alone(&self, surfaces: &[usize], x: usize, y: usize) -> bool {
        let here = surfaces[self.index(x, y)];
        let near = |c: usize, range: &std::ops::Range<usize>| {
            c.saturating_sub(APRON_PX).max(range.start)..(c + APRON_PX + 1).min(range.end)
        };
        let columns = near(x, &self.columns);
        near(y, &self.rows).all(|row| {
            let from = self.index(columns.start, row);
            surfaces[from..from + columns.len()]
                .iter()
                .all(|&s| s == here)
        })
    }
}
