//! A rig and its motion in, noisy stereo sights of random landmarks out: no images, for experiments
//! that take thousands of runs.
//!
//! ```
//! use nalgebra::Isometry3;
//! use visod::simulation::points::{PointFrame, PointSimulation, Settings};
//!
//! let rig = visod::simulation::thesis_rig();
//! let mut simulation = PointSimulation::new(rig, Settings::default(), 7)?;
//! let (mut first, mut second) = (PointFrame::default(), PointFrame::default());
//! simulation.observe(&Isometry3::identity(), &mut first);
//! simulation.observe(&Isometry3::translation(0.0, 0.0, 0.2), &mut second);
//! let tracked = second.sights.iter().filter(|s| first.find(s.id).is_some()).count();
//! assert!(tracked > 100);
//! # Ok::<(), visod::settings::SettingError>(())
//! ```

use crate::geometry::StereoRig;
use crate::settings::SettingError;
use nalgebra::{Isometry3, Point3, Vector2, Vector4};
use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, StandardNormal, StudentT};
use rand_xoshiro::Xoshiro256PlusPlus;

/// How measured pixels deviate from the true ones; each coordinate on its own.
#[derive(Clone, Copy, Debug, PartialEq, serde::Deserialize, serde::Serialize)]
#[serde(tag = "model", rename_all = "kebab-case", deny_unknown_fields)]
pub enum PixelNoise {
    /// Normal.
    Gaussian {
        /// Standard deviation, px.
        sigma_px: f64,
    },
    /// Student's t: normal in the middle, with heavier tails.
    StudentT {
        /// Scale, px; the standard deviation is `scale · √(ν / (ν − 2))`.
        scale_px: f64,
        /// Degrees of freedom ν, above 2.
        degrees_of_freedom: f64,
    },
    /// Normal, but for a share of the sights that miss altogether.
    Outliers {
        /// Standard deviation of the others, px.
        sigma_px: f64,
        /// Share of the sights whose four coordinates all miss.
        share: f64,
        /// Standard deviation of those, px.
        outlier_sigma_px: f64,
    },
}

impl PixelNoise {
    /// Whether the values can be used.
    ///
    /// # Errors
    /// A value lies outside its range.
    pub fn check(&self) -> Result<(), SettingError> {
        match *self {
            Self::Gaussian { sigma_px } => {
                SettingError::unless_in("noise.sigma_px", sigma_px, 0.0..=1000.0)
            }
            Self::StudentT {
                scale_px,
                degrees_of_freedom,
            } => {
                SettingError::unless_in("noise.scale_px", scale_px, 0.0..=1000.0)?;
                SettingError::unless_in("noise.degrees_of_freedom", degrees_of_freedom, 2.01..=1e6)
            }
            Self::Outliers {
                sigma_px,
                share,
                outlier_sigma_px,
            } => {
                SettingError::unless_in("noise.sigma_px", sigma_px, 0.0..=1000.0)?;
                SettingError::unless_in("noise.share", share, 0.0..=1.0)?;
                SettingError::unless_in("noise.outlier_sigma_px", outlier_sigma_px, 0.0..=1e6)
            }
        }
    }

    /// The standard deviation of one coordinate of a sight that does not miss, px.
    #[must_use]
    pub fn sigma_px(&self) -> f64 {
        match *self {
            Self::Gaussian { sigma_px } | Self::Outliers { sigma_px, .. } => sigma_px,
            Self::StudentT {
                scale_px,
                degrees_of_freedom: nu,
            } => scale_px * (nu / (nu - 2.0)).sqrt(),
        }
    }

    /// The deviations of one sight's four coordinates, px, and whether it misses.
    pub fn sample(&self, rng: &mut Xoshiro256PlusPlus) -> (Vector4<f64>, bool) {
        let normal = |sigma: f64, rng: &mut Xoshiro256PlusPlus| {
            Vector4::from_fn(|_, _| sigma * rng.sample::<f64, _>(StandardNormal))
        };
        match *self {
            Self::Gaussian { sigma_px } => (normal(sigma_px, rng), false),
            Self::Outliers {
                sigma_px,
                share,
                outlier_sigma_px,
            } => {
                let misses = rng.random::<f64>() < share;
                let sigma = if misses { outlier_sigma_px } else { sigma_px };
                (normal(sigma, rng), misses)
            }
            Self::StudentT {
                scale_px,
                degrees_of_freedom,
            } => match StudentT::new(degrees_of_freedom) {
                Ok(t) => (Vector4::from_fn(|_, _| scale_px * t.sample(rng)), false),
                // Unreachable for checked settings: without freedom there is no deviation.
                Err(_) => (Vector4::zeros(), false),
            },
        }
    }
}

/// What is seen and how well.
#[derive(Clone, Debug, PartialEq, serde::Deserialize, serde::Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// Landmarks in view at any time. Number, 1 to 100000, default 300: what a good detector finds.
    pub landmarks: usize,
    /// Depth, from the left camera, at which landmarks appear; uniform in between. m, 0.1 to
    /// 10000, default 2 to 40: the range of the thesis.
    pub depth_m: [f64; 2],
    /// Chance that a landmark in view is seen again in the next frame. Share, 0 to 1, default 0.9:
    /// such detectors lose one in ten.
    pub survival: f64,
    /// Landmarks nearer than this to an image's border are not seen. px, 0 to 1000, default 16:
    /// detectors need their neighbourhood.
    pub margin_px: f64,
    /// How measured pixels deviate. Default Gaussian of 0.5 px.
    pub noise: PixelNoise,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            landmarks: 300,
            depth_m: [2.0, 40.0],
            survival: 0.9,
            margin_px: 16.0,
            noise: PixelNoise::Gaussian { sigma_px: 0.5 },
        }
    }
}

impl Settings {
    /// Whether the values can be used.
    ///
    /// # Errors
    /// A value lies outside its range.
    pub fn check(&self) -> Result<(), SettingError> {
        SettingError::unless_in("landmarks", self.landmarks, 1..=100_000)?;
        let [near, far] = self.depth_m;
        SettingError::unless_in("depth_m", near, 0.1..=1e4)?;
        SettingError::unless_in("depth_m", far, near..=1e4)?;
        SettingError::unless_in("survival", self.survival, 0.0..=1.0)?;
        SettingError::unless_in("margin_px", self.margin_px, 0.0..=1000.0)?;
        self.noise.check()
    }
}

/// One landmark seen by both cameras.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sight {
    /// The landmark: the same in every frame that sees it.
    pub id: u64,
    /// Measured position: ul, vl, ur, vr, px, raw.
    pub pixels: Vector4<f64>,
    /// True position, likewise.
    pub true_pixels: Vector4<f64>,
    /// True position in the left camera's frame, m.
    pub point: Point3<f64>,
    /// Whether the measurement misses.
    pub is_outlier: bool,
}

/// What both cameras see at one instant.
#[derive(Clone, Debug, PartialEq)]
pub struct PointFrame {
    /// True pose: maps a point of the left camera into the frame in which landmarks rest.
    pub odom_from_camera: Isometry3<f64>,
    /// The sights, with rising ids.
    pub sights: Vec<Sight>,
}

impl Default for PointFrame {
    fn default() -> Self {
        Self {
            odom_from_camera: Isometry3::identity(),
            sights: Vec::new(),
        }
    }
}

impl PointFrame {
    /// The sight of landmark `id`.
    #[must_use]
    pub fn find(&self, id: u64) -> Option<&Sight> {
        let index = self.sights.binary_search_by_key(&id, |s| s.id).ok()?;
        Some(&self.sights[index])
    }

    /// Measures the same landmarks anew: the same truth under other deviations.
    pub fn measure_again(&mut self, noise: &PixelNoise, rng: &mut Xoshiro256PlusPlus) {
        for sight in &mut self.sights {
            let (deviation, is_outlier) = noise.sample(rng);
            sight.pixels = sight.true_pixels + deviation;
            sight.is_outlier = is_outlier;
        }
    }
}

/// Landmarks that come and go while a rig moves.
pub struct PointSimulation {
    rig: StereoRig,
    settings: Settings,
    rng: Xoshiro256PlusPlus,
    landmarks: Vec<(u64, Point3<f64>)>,
    next_id: u64,
}

/// Draws until a landmark is given up that both cameras can see: fields of view that hardly meet
/// give fewer landmarks rather than none ever.
const MAX_DRAWS: usize = 1000;

impl PointSimulation {
    /// A simulation that has not seen anything yet; the same seed gives the same numbers.
    ///
    /// # Errors
    /// A setting lies outside its range.
    pub fn new(rig: StereoRig, settings: Settings, seed: u64) -> Result<Self, SettingError> {
        settings.check()?;
        Ok(Self {
            rig,
            rng: Xoshiro256PlusPlus::seed_from_u64(seed),
            landmarks: Vec::with_capacity(settings.landmarks),
            settings,
            next_id: 0,
        })
    }

    /// What the rig sees from `odom_from_camera`, into `frame`, whose memory is used again. Lost
    /// landmarks are replaced by new ones.
    pub fn observe(&mut self, odom_from_camera: &Isometry3<f64>, frame: &mut PointFrame) {
        frame.odom_from_camera = *odom_from_camera;
        frame.sights.clear();
        let camera_from_odom = odom_from_camera.inverse();
        let mut landmarks = std::mem::take(&mut self.landmarks);
        landmarks.retain(|(id, landmark)| {
            let survives = self.rng.random::<f64>() < self.settings.survival;
            let point = camera_from_odom * landmark;
            match self.see(&point).filter(|_| survives) {
                Some(true_pixels) => {
                    let sight = self.measure(*id, point, true_pixels);
                    frame.sights.push(sight);
                    true
                }
                None => false,
            }
        });
        while landmarks.len() < self.settings.landmarks {
            let Some((point, true_pixels)) = self.draw() else {
                break;
            };
            let id = self.next_id;
            self.next_id += 1;
            landmarks.push((id, odom_from_camera * point));
            let sight = self.measure(id, point, true_pixels);
            frame.sights.push(sight);
        }
        self.landmarks = landmarks;
    }

    fn measure(&mut self, id: u64, point: Point3<f64>, true_pixels: Vector4<f64>) -> Sight {
        let (deviation, is_outlier) = self.settings.noise.sample(&mut self.rng);
        Sight {
            id,
            pixels: true_pixels + deviation,
            true_pixels,
            point,
            is_outlier,
        }
    }

    /// Where a point (m, left camera frame) is seen, if it is by both cameras.
    fn see(&self, point: &Point3<f64>) -> Option<Vector4<f64>> {
        let pixels = self.rig.project(point)?;
        let margin = self.settings.margin_px;
        let both = self
            .rig
            .left
            .contains(&Vector2::new(pixels[0], pixels[1]), margin)
            && self
                .rig
                .right
                .contains(&Vector2::new(pixels[2], pixels[3]), margin);
        both.then_some(pixels)
    }

    /// A new landmark: uniform over the left image and over depth, among those both cameras see.
    fn draw(&mut self) -> Option<(Point3<f64>, Vector4<f64>)> {
        let [near, far] = self.settings.depth_m;
        let size = [
            f64::from(self.rig.left.width - 1),
            f64::from(self.rig.left.height - 1),
        ];
        for _ in 0..MAX_DRAWS {
            let pixel = Vector2::new(
                self.rng.random::<f64>() * size[0],
                self.rng.random::<f64>() * size[1],
            );
            let depth = near + (far - near) * self.rng.random::<f64>();
            if let Some(ray) = self.rig.left.ray(&pixel) {
                let point = Point3::from(ray * depth);
                if let Some(pixels) = self.see(&point) {
                    return Some((point, pixels));
                }
            }
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulation::{Trajectory, TrajectoryName, thesis_rig};

    fn deviations(noise: PixelNoise, frames: usize) -> Vec<(f64, bool)> {
        let settings = Settings {
            noise,
            ..Settings::default()
        };
        let mut simulation = PointSimulation::new(thesis_rig(), settings, 5).expect("valid");
        let mut frame = PointFrame::default();
        let mut all = Vec::new();
        for _ in 0..frames {
            simulation.observe(&Isometry3::identity(), &mut frame);
            for sight in &frame.sights {
                let deviation = sight.pixels - sight.true_pixels;
                all.extend(deviation.iter().map(|&d| (d, sight.is_outlier)));
            }
        }
        all
    }

    fn variance(values: &[f64]) -> f64 {
        values.iter().map(|v| v * v).sum::<f64>() / values.len() as f64
    }

    #[test]
    fn noise_has_the_variance_it_claims() {
        // n = 120 000 values; bounds at 4 σ of the sample variance, √((κ − 1)/n) with the kurtosis
        // κ: 3 for the normal, 3 + 6/(ν − 4) for Student's t.
        let n = 120_000.0_f64;
        for (noise, kurtosis) in [
            (PixelNoise::Gaussian { sigma_px: 0.5 }, 3.0),
            (
                PixelNoise::StudentT {
                    scale_px: 0.4,
                    degrees_of_freedom: 10.0,
                },
                4.0,
            ),
        ] {
            let values: Vec<f64> = deviations(noise, 100).iter().map(|d| d.0).collect();
            assert_eq!(values.len(), 120_000);
            let ratio = variance(&values) / noise.sigma_px().powi(2);
            assert!((ratio - 1.0).abs() < 4.0 * ((kurtosis - 1.0) / n).sqrt());
        }
    }

    #[test]
    fn outliers_come_in_their_share_and_miss() {
        let noise = PixelNoise::Outliers {
            sigma_px: 0.5,
            share: 0.2,
            outlier_sigma_px: 50.0,
        };
        let all = deviations(noise, 100);
        let part = |wanted: bool| -> Vec<f64> {
            all.iter()
                .filter(|(_, o)| *o == wanted)
                .map(|d| d.0)
                .collect()
        };
        let (missed, hit) = (part(true), part(false));
        // 30 000 sights: the share has σ = √(0.2 · 0.8 / 30 000) = 0.0023.
        let share = missed.len() as f64 / all.len() as f64;
        assert!((share - 0.2).abs() < 4.0 * 0.0023, "{share}");
        assert!((variance(&missed).sqrt() / 50.0 - 1.0).abs() < 0.03);
        assert!((variance(&hit).sqrt() / 0.5 - 1.0).abs() < 0.02);
    }

    #[test]
    fn landmarks_rest_while_the_rig_moves() {
        let rig = thesis_rig();
        let path = Trajectory::new(TrajectoryName::Slalom, 10.0, None, None, 1.0, 2);
        let settings = Settings {
            noise: PixelNoise::Gaussian { sigma_px: 0.0 },
            ..Settings::default()
        };
        let mut simulation = PointSimulation::new(rig.clone(), settings, 5).expect("valid");
        let (mut before, mut now) = (PointFrame::default(), PointFrame::default());
        let (mut seen, mut again) = (0.0, 0.0);
        for k in 0..50 {
            simulation.observe(&path.world_from_camera(0.1 * f64::from(k)), &mut now);
            assert_eq!(now.sights.len(), 300);
            assert!(now.sights.windows(2).all(|pair| pair[0].id < pair[1].id));
            for sight in &now.sights {
                let pixels = rig.project(&sight.point).expect("seen");
                assert!((pixels - sight.pixels).norm() < 1e-9);
                if let Some(old) = before.find(sight.id) {
                    let gap =
                        now.odom_from_camera * sight.point - before.odom_from_camera * old.point;
                    assert!(gap.norm() < 1e-12);
                    again += 1.0;
                }
            }
            seen += before.sights.len() as f64;
            std::mem::swap(&mut before, &mut now);
        }
        // Nine in ten survive by chance, and a few of those leave the view.
        let survival = again / seen;
        assert!((0.8..0.91).contains(&survival), "{survival}");
    }

    #[test]
    fn the_same_seed_gives_the_same_numbers() {
        let gaussian = PixelNoise::Gaussian { sigma_px: 0.5 };
        assert_eq!(deviations(gaussian, 3), deviations(gaussian, 3));
    }

    #[test]
    fn measuring_again_keeps_the_truth() {
        let mut simulation =
            PointSimulation::new(thesis_rig(), Settings::default(), 5).expect("valid");
        let mut frame = PointFrame::default();
        simulation.observe(&Isometry3::identity(), &mut frame);
        let first = frame.clone();
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(1);
        frame.measure_again(&PixelNoise::Gaussian { sigma_px: 0.5 }, &mut rng);
        for (a, b) in first.sights.iter().zip(&frame.sights) {
            assert_eq!(
                (a.id, a.true_pixels, a.point),
                (b.id, b.true_pixels, b.point)
            );
            assert_ne!(a.pixels, b.pixels);
        }
    }

    #[test]
    fn settings_out_of_range_are_named() {
        let settings = Settings {
            depth_m: [5.0, 2.0],
            ..Settings::default()
        };
        let error = PointSimulation::new(thesis_rig(), settings, 1)
            .err()
            .expect("far before near");
        assert_eq!(error.key, "depth_m");
    }
}
