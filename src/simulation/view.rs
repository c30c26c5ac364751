//! A scene from one place at one instant in, what each ray meets out.
//!
//! On a plane, the inverse depth and the position over depth are linear in the ray `(x, y, 1)`:
//! with them, whether and where a ray meets a face takes three dot products.

use super::rays::Cone;
use super::scene::{Face, Scene};
use nalgebra::{Isometry3, Vector3};

/// Nearest distance, m, at which surfaces are seen.
const NEAREST_M: f64 = 0.02;

/// A face as a camera sees it.
pub(super) struct SeenFace {
    /// Index of the face in the scene.
    pub(super) face: usize,
    inverse_depth: Vector3<f64>,
    across: Vector3<f64>,
    along: Vector3<f64>,
    size_m: [f64; 2],
    /// What is positive on all rays that meet the face, with its norm: in front, and inside of
    /// each of the four edges.
    bounds: [(Vector3<f64>, f64); 5],
}

/// Where on a face a ray meets it, m, and the covariance of a pixel's ellipse there, m².
pub(super) struct Footing {
    pub(super) place: [f64; 2],
    pub(super) cov_m2: [f64; 3],
}

/// All faces that a camera could see.
pub(super) struct View {
    pub(super) faces: Vec<SeenFace>,
}

impl View {
    /// The scene from a camera at `world_from_camera`, whose path is at `world_from_path`.
    pub(super) fn new(
        scene: &Scene,
        world_from_camera: &Isometry3<f64>,
        world_from_path: &Isometry3<f64>,
        time_s: f64,
    ) -> Self {
        let camera_from_world = world_from_camera.inverse();
        let camera_from_body: Vec<_> = scene
            .bodies
            .iter()
            .map(|body| camera_from_world * body.world_from_body(world_from_path, time_s))
            .collect();
        let faces = scene
            .faces
            .iter()
            .enumerate()
            .filter_map(|(index, face)| {
                let camera_from_face = match face.body {
                    Some(body) => &camera_from_body[body],
                    None => &camera_from_world,
                };
                SeenFace::new(index, face, camera_from_face)
            })
            .collect();
        Self { faces }
    }

    /// The faces that rays within `cone` may meet, into `candidates`, as indices. Returns whether
    /// one face alone, the only candidate, is met by all of them.
    pub(super) fn cull(&self, cone: Option<&Cone>, candidates: &mut Vec<usize>) -> bool {
        candidates.clear();
        let Some(cone) = cone else {
            candidates.extend(0..self.faces.len());
            return false;
        };
        let mut covered_from = 0.0_f64;
        let mut cover = None;
        for (index, face) in self.faces.iter().enumerate() {
            if face.may_meet(cone) {
                candidates.push(index);
                let (least, _) = face.inverse_range(cone);
                if least > covered_from && face.covers(cone) {
                    covered_from = least;
                    cover = Some(index);
                }
            }
        }
        candidates.retain(|&index| {
            Some(index) == cover || self.faces[index].inverse_range(cone).1 > covered_from
        });
        // Near ones first: behind what a ray has met already, one dot product refuses a face.
        candidates.sort_by_cached_key(|&index| {
            let middle = self.faces[index].inverse_depth.dot(&cone.axis);
            std::cmp::Reverse(middle.max(0.0).to_bits())
        });
        cover.is_some() && candidates.len() == 1
    }

    /// The nearest of the candidates that `ray` meets.
    pub(super) fn nearest(&self, candidates: &[usize], ray: [f64; 2]) -> Option<usize> {
        let mut nearest = None;
        let mut inverse_depth = 0.0;
        for &index in candidates {
            if let Some(hit) = self.faces[index].hit_before(ray, inverse_depth) {
                inverse_depth = hit;
                nearest = Some(index);
            }
        }
        nearest
    }
}

impl SeenFace {
    fn new(index: usize, face: &Face, camera_from_face: &Isometry3<f64>) -> Option<Self> {
        let corner = (camera_from_face * face.corner).coords;
        let across = camera_from_face * face.across;
        let along = camera_from_face * face.along;
        let normal = across.cross(&along);
        let distance = normal.dot(&corner);
        // The normal points to where the face is seen from: away from the plane as seen from here.
        if distance > -1e-6 {
            return None;
        }
        let inverse_depth = normal / distance;
        let across = across - inverse_depth * across.dot(&corner);
        let along = along - inverse_depth * along.dot(&corner);
        let bounded = |v: Vector3<f64>| (v, v.norm());
        let [width, height] = face.size_m;
        Some(Self {
            face: index,
            bounds: [
                bounded(inverse_depth),
                bounded(across),
                bounded(inverse_depth * width - across),
                bounded(along),
                bounded(inverse_depth * height - along),
            ],
            inverse_depth,
            across,
            along,
            size_m: face.size_m,
        })
    }

    fn may_meet(&self, cone: &Cone) -> bool {
        self.bounds
            .iter()
            .all(|(v, norm)| v.dot(&cone.axis) + norm * cone.sin_half > 0.0)
    }

    fn covers(&self, cone: &Cone) -> bool {
        self.bounds
            .iter()
            .all(|(v, norm)| v.dot(&cone.axis) - norm * cone.sin_half > 0.0)
    }

    /// Bounds of the inverse distance, 1/m, along rays within `cone`.
    fn inverse_range(&self, cone: &Cone) -> (f64, f64) {
        let (v, norm) = &self.bounds[0];
        let cos = (v.dot(&cone.axis) / norm).clamp(-1.0, 1.0);
        let sin = (1.0 - cos * cos).sqrt();
        let least = norm * (cos * cone.cos_half - sin * cone.sin_half);
        let most = if cos >= cone.cos_half {
            *norm
        } else {
            norm * (cos * cone.cos_half + sin * cone.sin_half)
        };
        (least, most)
    }

    /// The inverse depth, 1/m, at which `ray` meets the face, if it is above `least`.
    #[inline]
    fn hit_before(&self, ray: [f64; 2], least: f64) -> Option<f64> {
        let inverse_depth = linear(&self.inverse_depth, ray);
        if inverse_depth <= least || inverse_depth >= 1.0 / NEAREST_M {
            return None;
        }
        let across = linear(&self.across, ray);
        let along = linear(&self.along, ray);
        let inside = across >= 0.0
            && along >= 0.0
            && across <= self.size_m[0] * inverse_depth
            && along <= self.size_m[1] * inverse_depth;
        inside.then_some(inverse_depth)
    }

    /// The depth, m, of the face's plane along `ray`.
    pub(super) fn depth_m(&self, ray: [f64; 2]) -> f64 {
        1.0 / linear(&self.inverse_depth, ray)
    }

    /// Where `ray` meets the face's plane, and what a pixel sees of it there whose ray has the
    /// `derivative` and whose point spread has the standard deviation `sigma_px`.
    pub(super) fn footing(
        &self,
        ray: [f64; 2],
        derivative: &[[f64; 2]; 2],
        sigma_px: f64,
    ) -> Footing {
        let depth = self.depth_m(ray);
        let place = [
            linear(&self.across, ray) * depth,
            linear(&self.along, ray) * depth,
        ];
        // Derivative of (across / inverse depth), times the point spread.
        let by = sigma_px * depth;
        let w = &self.inverse_depth;
        let step = |d: &[f64; 2], form: &Vector3<f64>, at: f64| {
            by * ((form.x - at * w.x) * d[0] + (form.y - at * w.y) * d[1])
        };
        let [dx, dy] = derivative;
        let (ax, ay) = (
            step(dx, &self.across, place[0]),
            step(dy, &self.across, place[0]),
        );
        let (bx, by) = (
            step(dx, &self.along, place[1]),
            step(dy, &self.along, place[1]),
        );
        Footing {
            place,
            cov_m2: [ax * ax + ay * ay, ax * bx + ay * by, bx * bx + by * by],
        }
    }
}

#[inline]
fn linear(form: &Vector3<f64>, ray: [f64; 2]) -> f64 {
    form.x * ray[0] + form.y * ray[1] + form.z
}
