//! A place on a surface in, its albedo out: textures laid out so that no patch recurs.
//!
//! A periodic texture becomes an endless one by reading it, around each point of a triangular
//! lattice, at that point's own random offset, and blending the up to three readings so that mean
//! and variance are kept (Heitz and Neyret, *High-performance by-example noise using a
//! histogram-preserving blending operator*, 2018).

use super::pattern::{Leaves, bricks, leaves};
use super::texture::{Footprint, Texture};
use std::sync::OnceLock;

/// One texture of a material and how it is laid out.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Layer {
    pub(super) texture: TextureKind,
    /// Size of a texel, m.
    pub(super) texel_m: f64,
    /// Albedo per unit of the texture's deviation from its mean.
    pub(super) gain: f32,
    /// Whether the texture repeats as it is, as tiles and bricks do.
    pub(super) periodic: bool,
}

/// What a surface is made of.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Material {
    /// Mean albedo, 0 … 1.
    pub(super) albedo: f32,
    pub(super) layers: Vec<Layer>,
}

/// The textures that scenes are made of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum TextureKind {
    /// Leaves from a few texels to a few hundred.
    Mosaic,
    /// Fewer and larger leaves.
    Patches,
    /// One tile or two courses of bricks.
    Bricks,
}

impl TextureKind {
    /// The texture itself, painted when it is first asked for. It is the same in every scene:
    /// where its patches lie differs.
    fn texture(self) -> &'static Texture {
        static MOSAIC_TEXTURE: OnceLock<Texture> = OnceLock::new();
        static PATCHES_TEXTURE: OnceLock<Texture> = OnceLock::new();
        static BRICKS_TEXTURE: OnceLock<Texture> = OnceLock::new();
        match self {
            Self::Mosaic => {
                MOSAIC_TEXTURE.get_or_init(|| Texture::new(2048, &leaves(2048, &MOSAIC, 1)))
            }
            Self::Patches => {
                PATCHES_TEXTURE.get_or_init(|| Texture::new(1024, &leaves(1024, &PATCHES, 2)))
            }
            Self::Bricks => BRICKS_TEXTURE.get_or_init(|| Texture::new(512, &bricks(512, 3))),
        }
    }
}

const MOSAIC: Leaves = Leaves {
    radius_texel: [4.0, 250.0],
    coverage: 2.5,
    albedo: [0.06, 0.94],
};
const PATCHES: Leaves = Leaves {
    radius_texel: [10.0, 200.0],
    coverage: 2.0,
    albedo: [0.1, 0.9],
};

/// The lattice's spacing in sides of the texture.
const LATTICE: f64 = 0.3;
/// Weights start where a lattice point's share exceeds this; most places then read one texture.
const SHARPEN: f64 = 0.26;

impl Material {
    /// The albedo around `place` (m on the surface) under an ellipse of covariance `[xx, xy, yy]`
    /// (m²). `seed` tells surfaces of the same material apart.
    pub(super) fn albedo(&self, place: [f64; 2], cov_m2: [f64; 3], seed: u64) -> f32 {
        let mut albedo = self.albedo;
        for layer in &self.layers {
            let texture = layer.texture.texture();
            let by_texel = 1.0 / layer.texel_m;
            let place = [place[0] * by_texel, place[1] * by_texel];
            let by_texel2 = by_texel * by_texel;
            let [xx, xy, yy] = cov_m2;
            let footprint = Footprint::new([xx * by_texel2, xy * by_texel2, yy * by_texel2]);
            let deviation = if layer.periodic {
                texture.sample(&footprint, place) - texture.mean()
            } else {
                scattered(texture, &footprint, place, seed)
            };
            albedo += layer.gain * deviation;
        }
        albedo.clamp(0.0, 1.0)
    }
}

/// The deviation from the mean at `place` (texels) of the texture laid out without repetition.
fn scattered(texture: &Texture, footprint: &Footprint, place: [f64; 2], seed: u64) -> f32 {
    let side = texture.size() as f64;
    let by_spacing = 1.0 / (LATTICE * side);
    let (x, y) = (place[0] * by_spacing, place[1] * by_spacing);
    // Into the lattice's own skewed coordinates, where its triangles halve unit squares.
    let (a, b) = (x - y * INV_SQRT_3, 2.0 * INV_SQRT_3 * y);
    let (i, j) = (a.floor(), b.floor());
    let (fa, fb) = (a - i, b - j);
    let corners = if fa + fb < 1.0 {
        [(0.0, 0.0, 1.0 - fa - fb), (1.0, 0.0, fa), (0.0, 1.0, fb)]
    } else {
        [
            (1.0, 1.0, fa + fb - 1.0),
            (0.0, 1.0, 1.0 - fa),
            (1.0, 0.0, 1.0 - fb),
        ]
    };
    let (mut sum, mut squares) = (0.0_f64, 0.0_f64);
    for (di, dj, share) in corners {
        if share > SHARPEN {
            let weight = (share - SHARPEN).powi(2);
            let [ox, oy] = offset(i + di, j + dj, seed);
            let reading = texture.sample(footprint, [place[0] + ox * side, place[1] + oy * side]);
            sum += weight * f64::from(reading - texture.mean());
            squares += weight * weight;
        }
    }
    (sum / squares.sqrt()) as f32
}

const INV_SQRT_3: f64 = 0.577_350_269_189_625_8;

/// The random offset of a lattice point, in sides of the texture.
fn offset(i: f64, j: f64, seed: u64) -> [f64; 2] {
    let hash = mix(seed ^ mix((i as i64 as u64) ^ mix(j as i64 as u64)));
    let unit = |bits: u64| (bits & 0xffff_ffff) as f64 / 4_294_967_296.0;
    [unit(hash), unit(hash >> 32)]
}

/// A 64-bit number scrambled one to one (the finaliser of SplitMix64; Steele, Lea and Flood, 2014).
pub(super) fn mix(value: u64) -> u64 {
    let mut z = value.wrapping_add(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn patches(periodic: bool) -> Material {
        Material {
            albedo: 0.5,
            layers: vec![Layer {
                texture: TextureKind::Patches,
                texel_m: 0.001,
                gain: 1.0,
                periodic,
            }],
        }
    }

    /// Albedos along a line, 3 mm apart, from `x` on.
    fn line(material: &Material, x: f64) -> Vec<f32> {
        (0..400)
            .map(|k| {
                let place = [x + 0.003 * f64::from(k), 0.4 + 0.001 * f64::from(k)];
                material.albedo(place, [4e-6, 0.0, 4e-6], 7)
            })
            .collect()
    }

    fn correlation(a: &[f32], b: &[f32]) -> f32 {
        let mean = |v: &[f32]| v.iter().sum::<f32>() / v.len() as f32;
        let (ma, mb) = (mean(a), mean(b));
        let dot =
            |f: &dyn Fn(f32, f32) -> f32| a.iter().zip(b).map(|(&x, &y)| f(x, y)).sum::<f32>();
        dot(&|x, y| (x - ma) * (y - mb))
            / (dot(&|x, _| (x - ma).powi(2)) * dot(&|_, y| (y - mb).powi(2))).sqrt()
    }

    #[test]
    fn a_scattered_texture_does_not_recur_and_a_periodic_one_does() {
        for periodic in [false, true] {
            let material = patches(periodic);
            let here = line(&material, 0.3);
            let a_period_on = line(&material, 0.3 + 1.024);
            let alike = correlation(&here, &a_period_on);
            if periodic {
                assert!(alike > 0.999, "{alike}");
            } else {
                assert!(alike.abs() < 0.5, "{alike}");
            }
        }
    }

    #[test]
    fn a_scattered_texture_has_no_seams() {
        // Neighbours 0.1 mm apart under an ellipse of 2 mm: no step may exceed the steepest edge
        // that the ellipse allows, contrast · step / (σ √2π) with a contrast of at most 1.
        let material = patches(false);
        let mut last = None;
        for k in 0..40_000 {
            let place = [1e-4 * f64::from(k), 0.31 * 1e-4 * f64::from(k)];
            let albedo = material.albedo(place, [4e-6, 0.0, 4e-6], 7);
            if let Some(before) = last {
                let step: f32 = albedo - before;
                assert!(step.abs() < 0.04, "{k}: {step}");
            }
            last = Some(albedo);
        }
    }
}
