//! A camera in, the ray that each of its pixels sees along out, undistorted once and for all.

use crate::geometry::Camera;
use nalgebra::{Vector2, Vector3};
use rayon::prelude::*;

/// Side of the square tiles in which an image is rendered, px.
pub(super) const TILE_PX: usize = 32;
/// Pixels around a tile whose surfaces a pixel of the tile can be touched by.
pub(super) const APRON_PX: usize = 2;

/// The rays of a camera's pixels, as positions on the normalised plane z = 1.
pub(super) struct RayMap {
    pub(super) width: usize,
    pub(super) height: usize,
    rays: Vec<[f32; 2]>,
    cones: Vec<Option<Cone>>,
}

/// A cone from the camera's centre that holds all rays of a tile and its apron.
#[derive(Clone, Copy)]
pub(super) struct Cone {
    pub(super) axis: Vector3<f64>,
    pub(super) sin_half: f64,
    pub(super) cos_half: f64,
}

impl RayMap {
    pub(super) fn new(camera: &Camera) -> Self {
        let (width, height) = (camera.width as usize, camera.height as usize);
        let mut rays = vec![[f32::NAN; 2]; width * height];
        rays.par_chunks_exact_mut(width.max(1))
            .enumerate()
            .for_each(|(y, row)| {
                for (x, ray) in row.iter_mut().enumerate() {
                    if let Some(n) = camera.unproject(&Vector2::new(x as f64, y as f64)) {
                        *ray = [n.x as f32, n.y as f32];
                    }
                }
            });
        let mut map = Self {
            width,
            height,
            rays,
            cones: Vec::new(),
        };
        map.cones = (0..map.tiles_down() * map.tiles_across())
            .map(|tile| map.enclose(tile % map.tiles_across(), tile / map.tiles_across()))
            .collect();
        map
    }

    /// How many tiles lie side by side.
    pub(super) fn tiles_across(&self) -> usize {
        self.width.div_ceil(TILE_PX)
    }

    /// How many tiles lie below one another.
    pub(super) fn tiles_down(&self) -> usize {
        self.height.div_ceil(TILE_PX)
    }

    /// The columns, or rows, of a tile with its apron, within the image.
    pub(super) fn with_apron(tile: usize, limit: usize) -> std::ops::Range<usize> {
        (tile * TILE_PX).saturating_sub(APRON_PX)..((tile + 1) * TILE_PX + APRON_PX).min(limit)
    }

    /// The cone of a tile; `None` where a pixel of it sees nothing.
    pub(super) fn cone(&self, tile_x: usize, tile_y: usize) -> Option<&Cone> {
        self.cones[tile_y * self.tiles_across() + tile_x].as_ref()
    }

    /// The ray of a pixel; not finite where the lens' model has no inverse.
    #[inline]
    pub(super) fn at(&self, x: usize, y: usize) -> [f64; 2] {
        let [a, b] = self.rays[y * self.width + x];
        [f64::from(a), f64::from(b)]
    }

    /// The ray's derivative by the pixel's column and by its row, 1/px.
    #[inline]
    pub(super) fn derivative(&self, x: usize, y: usize) -> [[f64; 2]; 2] {
        let (left, right) = (x.saturating_sub(1), (x + 1).min(self.width - 1));
        let (up, down) = (y.saturating_sub(1), (y + 1).min(self.height - 1));
        [
            slope(self.at(left, y), self.at(right, y), right - left),
            slope(self.at(x, up), self.at(x, down), down - up),
        ]
    }

    fn enclose(&self, tile_x: usize, tile_y: usize) -> Option<Cone> {
        let columns = Self::with_apron(tile_x, self.width);
        let rows = Self::with_apron(tile_y, self.height);
        let direction = |x: usize, y: usize| {
            let [a, b] = self.at(x, y);
            Vector3::new(a, b, 1.0).normalize()
        };
        let middle = |range: &std::ops::Range<usize>| (range.start + range.end) / 2;
        let axis = direction(middle(&columns), middle(&rows));
        let mut cos_half = 1.0_f64;
        for y in rows {
            for x in columns.clone() {
                let cos = axis.dot(&direction(x, y));
                if !cos.is_finite() {
                    return None;
                }
                cos_half = cos_half.min(cos);
            }
        }
        // Rounding, and the samples between pixel centres.
        let half = cos_half.acos() * 1.05 + 1e-6;
        Some(Cone {
            axis,
            sin_half: half.sin(),
            cos_half: half.cos(),
        })
    }
}

#[inline]
fn slope(from: [f64; 2], to: [f64; 2], span: usize) -> [f64; 2] {
    let by = if span == 2 { 0.5 } else { 1.0 };
    [(to[0] - from[0]) * by, (to[1] - from[1]) * by]
}
