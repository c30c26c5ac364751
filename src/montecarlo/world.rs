//! Landmarks along a path, drawn once; their noisy sights, run by run.

use super::estimator::TrackedSight;
use super::{MonteCarloError, RigError, Settings};
use crate::estimation::{Plane, StereoMeasurement};
use crate::geometry::StereoRig;
use crate::geometry::rig_parameters::{RigCovariance, RigVector};
use nalgebra::{Isometry2, Isometry3, Point3, Vector2, Vector4};
use rand::RngExt;
use rand_distr::StandardNormal;
use rand_xoshiro::Xoshiro256PlusPlus;

/// A landmark as one pair truly sees it.
#[derive(Clone, Copy, Debug)]
pub(super) struct TrueSight {
    pub id: u64,
    /// In the left camera, m.
    pub point: Point3<f64>,
    /// (ul, vl, ur, vr), px.
    pub px: Vector4<f64>,
    /// Its deviations are this many times those of the smallest scale.
    pub scale: f64,
}

/// What one pair truly sees.
#[derive(Clone, Debug, Default)]
pub(super) struct TrueFrame {
    pub odom_from_camera: Isometry3<f64>,
    /// With rising ids.
    pub sights: Vec<TrueSight>,
}

/// The truth that every run measures anew.
pub(super) struct World<'a> {
    pub rig: &'a StereoRig,
    settings: &'a Settings,
    pub frames: Vec<TrueFrame>,
    landmarks: u64,
}

/// A landmark nearer than this to an image's border is not seen, px.
const MARGIN_PX: f64 = 16.0;
/// Draws until a landmark is given up.
const MAX_DRAWS: usize = 10_000;

impl<'a> World<'a> {
    /// A path of `steps` equal motions. Each motion has so many features as the settings say, seen
    /// before and after it; those of them that survive serve the next motion too.
    pub(super) fn new(
        rig: &'a StereoRig,
        settings: &'a Settings,
        steps: usize,
        rng: &mut Xoshiro256PlusPlus,
    ) -> Result<Self, MonteCarloError> {
        let motion = Plane::of(rig).lift(&Isometry2::new(
            Vector2::new(settings.step_m, 0.0),
            settings.turn_rad,
        ));
        let mut world = Self {
            rig,
            settings,
            frames: vec![TrueFrame::default(); steps + 1],
            landmarks: 0,
        };
        for k in 1..=steps {
            let mut pose = world.frames[k - 1].odom_from_camera * motion;
            pose.rotation.renormalize();
            world.frames[k].odom_from_camera = pose;
        }
        // Features in use, in the frame before the step.
        let mut used: Vec<TrueSight> = Vec::new();
        for k in 1..=steps {
            let now_from_prev = motion.inverse();
            let mut after = Vec::with_capacity(settings.features);
            while after.len() < settings.features {
                // First those that are followed, then new ones.
                let before = match used.get(after.len()) {
                    Some(followed) => *followed,
                    None => world.draw(&now_from_prev, rng)?,
                };
                let point = now_from_prev * before.point;
                let Some(px) = world.see(&point) else {
                    used.remove(after.len());
                    continue;
                };
                if after.len() >= used.len() {
                    used.push(before);
                    world.frames[k - 1].sights.push(before);
                }
                after.push(TrueSight {
                    point,
                    px,
                    ..before
                });
            }
            world.frames[k].sights.extend(&after);
            used = after;
            used.retain(|_| rng.random::<f64>() < settings.survival);
        }
        Ok(world)
    }

    /// The noise's standard deviation at the smallest scale, px.
    pub(super) fn sigma_px(&self) -> f64 {
        self.settings.noise.sigma_px()
    }

    /// Measures every sight anew, as `rig` sees it, into `frames`, whose memory is used again.
    pub(super) fn measure(
        &self,
        rig: Option<&StereoRig>,
        rng: &mut Xoshiro256PlusPlus,
        frames: &mut Vec<Vec<TrackedSight>>,
    ) {
        let settings = self.settings;
        let stays = settings.persistence.sqrt();
        let fresh = (1.0 - settings.persistence).sqrt();
        let lasting: Vec<Vector4<f64>> = if settings.persistence > 0.0 {
            (0..self.landmarks)
                .map(|_| settings.noise.sample(rng).0 * stays)
                .collect()
        } else {
            Vec::new()
        };
        let stated = settings.stated_sigma_px();
        frames.resize_with(self.frames.len(), Vec::new);
        for (truth, measured) in self.frames.iter().zip(frames) {
            measured.clear();
            measured.extend(truth.sights.iter().map(|sight| {
                let lasts = lasting.get(sight.id as usize).copied().unwrap_or_default();
                let deviation = (settings.noise.sample(rng).0 * fresh + lasts) * sight.scale;
                let seen = rig
                    .and_then(|rig| rig.project(&sight.point))
                    .unwrap_or(sight.px);
                TrackedSight {
                    id: sight.id,
                    measurement: StereoMeasurement {
                        px: seen + deviation,
                        sigma_px: Vector4::repeat(stated * sight.scale),
                    },
                }
            }));
        }
    }

    /// Where both cameras see a point, if they do.
    fn see(&self, point: &Point3<f64>) -> Option<Vector4<f64>> {
        let px = self.rig.project(point)?;
        let inside = self
            .rig
            .left
            .contains(&Vector2::new(px[0], px[1]), MARGIN_PX)
            && self
                .rig
                .right
                .contains(&Vector2::new(px[2], px[3]), MARGIN_PX);
        inside.then_some(px)
    }

    /// A new landmark that is seen before and after a motion: uniform over the left image and over
    /// depth, among those.
    fn draw(
        &mut self,
        now_from_prev: &Isometry3<f64>,
        rng: &mut Xoshiro256PlusPlus,
    ) -> Result<TrueSight, MonteCarloError> {
        let [near, far] = self.settings.depth_m;
        let camera = &self.rig.left;
        for _ in 0..MAX_DRAWS {
            let pixel = Vector2::new(
                rng.random::<f64>() * f64::from(camera.width - 1),
                rng.random::<f64>() * f64::from(camera.height - 1),
            );
            let depth = near + (far - near) * rng.random::<f64>();
            let scale = (rng.random::<f64>() * self.settings.scales.ln()).exp();
            let Some(ray) = camera.ray(&pixel) else {
                continue;
            };
            let point = Point3::from(ray * depth);
            let seen_after = self.see(&(now_from_prev * point)).is_some();
            if let Some(px) = self.see(&point).filter(|_| seen_after) {
                self.landmarks += 1;
                return Ok(TrueSight {
                    id: self.landmarks - 1,
                    point,
                    px,
                    scale,
                });
            }
        }
        Err(MonteCarloError::NothingToSee {
            near_m: near.to_string(),
            far_m: far.to_string(),
            when: "before and after a motion",
        })
    }
}

/// Draws what a rig truly is, from the uncertainty that it states.
pub(super) struct RigDraw {
    /// A square root of the parameters' covariance, which may be singular.
    root: RigCovariance,
}

impl RigDraw {
    /// `None` where the rig is to be what it is said to be.
    pub(super) fn new(
        rig: &StereoRig,
        settings: &Settings,
    ) -> Result<Option<Self>, MonteCarloError> {
        if settings.rig_error == RigError::None {
            return Ok(None);
        }
        let covariance = rig.covariance().ok_or(MonteCarloError::NoRigUncertainty)?;
        let eigen = covariance.symmetric_eigen();
        let sigmas = eigen.eigenvalues.map(|variance| variance.max(0.0).sqrt());
        let root = eigen.eigenvectors * RigCovariance::from_diagonal(&sigmas);
        Ok(Some(Self { root }))
    }

    /// The rig of one run.
    pub(super) fn draw(&self, rig: &StereoRig, rng: &mut Xoshiro256PlusPlus) -> StereoRig {
        let unit = RigVector::from_fn(|_, _| rng.sample::<f64, _>(StandardNormal));
        rig.with_error(&(self.root * unit))
    }
}
