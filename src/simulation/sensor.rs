//! Radiance in, grey values out: the noise and the steps of a real sensor.
//!
//! Electrons are counted: their number varies with its own square root (photon noise), reading
//! adds a constant noise, and the result is cut into 256 steps (EMVA 1288, linear camera model).

use super::material::mix;
use crate::capture::Side;
use crate::settings::SettingError;
use rand::{RngExt, SeedableRng};
use rand_distr::StandardNormal;
use rand_xoshiro::Xoshiro256PlusPlus;

/// What the sensor is like.
#[derive(Clone, Debug, PartialEq, serde::Deserialize, serde::Serialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// Electrons of a white pixel (grey value 255); fewer are noisier. Electrons, 100 to 1e9,
    /// default 10000: an industrial camera of about 3.5 µm pixels.
    pub full_well_e: f64,
    /// Standard deviation of reading a pixel. Electrons, 0 to 10000, default 12: as above.
    pub read_noise_e: f64,
    /// Whether the sensor is noisy at all; without noise values are still cut to whole steps.
    /// Default true.
    pub noisy: bool,
    /// Loss of light from the centre to the farthest corner, growing with the square of the
    /// distance. A share, 0 to 0.9, default 0: none.
    pub vignetting: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            full_well_e: 10_000.0,
            read_noise_e: 12.0,
            noisy: true,
            vignetting: 0.0,
        }
    }
}

impl Settings {
    /// Whether the values can be used.
    ///
    /// # Errors
    /// A value lies outside its range.
    pub fn check(&self) -> Result<(), SettingError> {
        SettingError::unless_in("full_well_e", self.full_well_e, 100.0..=1e9)?;
        SettingError::unless_in("read_noise_e", self.read_noise_e, 0.0..=10_000.0)?;
        SettingError::unless_in("vignetting", self.vignetting, 0.0..=0.9)
    }

    /// The standard deviation, in grey values, of a pixel of this radiance (0 … 1) before it is
    /// cut to a whole step.
    #[must_use]
    pub fn sigma_grey(&self, radiance: f64) -> f64 {
        if !self.noisy {
            return 0.0;
        }
        let electrons = radiance.clamp(0.0, 1.0) * self.full_well_e;
        (electrons + self.read_noise_e * self.read_noise_e).sqrt() * 255.0 / self.full_well_e
    }
}

/// Which row of which image: the key of its random numbers.
#[derive(Clone, Copy, Debug)]
pub(super) struct RowKey {
    pub(super) seed: u64,
    pub(super) frame: u64,
    pub(super) side: Side,
    pub(super) row: u32,
}

impl RowKey {
    fn rng(&self) -> Xoshiro256PlusPlus {
        let side = match self.side {
            Side::Left => 0,
            Side::Right => 1,
        };
        let place = mix(self.frame ^ mix((u64::from(self.row) << 1) | side));
        Xoshiro256PlusPlus::seed_from_u64(mix(self.seed ^ place))
    }
}

/// Turns a row of radiances (0 … 1) into grey values. Each row has its own random numbers, so that
/// any number of threads gives the same image.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "values are clamped to 0 … 255 and rounded"
)]
pub(super) fn expose(settings: &Settings, key: &RowKey, radiance: &[f32], grey: &mut [u8]) {
    let mut rng = key.rng();
    let electrons_per_unit = settings.full_well_e as f32;
    let read_variance = (settings.read_noise_e * settings.read_noise_e) as f32;
    let grey_per_electron = 255.0 / electrons_per_unit;
    for (value, out) in radiance.iter().zip(grey) {
        let mut electrons = value.clamp(0.0, 1.0) * electrons_per_unit;
        if settings.noisy {
            let normal: f32 = rng.sample(StandardNormal);
            electrons += normal * (electrons + read_variance).sqrt();
        }
        *out = (electrons * grey_per_electron).round().clamp(0.0, 255.0) as u8;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn exposed(settings: &Settings, radiance: f32, seed: u64) -> Vec<u8> {
        let mut all = Vec::new();
        for row in 0..200 {
            let key = RowKey {
                seed,
                frame: 3,
                side: Side::Left,
                row,
            };
            let mut grey = vec![0; 500];
            expose(settings, &key, &vec![radiance; 500], &mut grey);
            all.extend(grey);
        }
        all
    }

    fn moments(values: &[u8]) -> (f64, f64) {
        let n = values.len() as f64;
        let mean = values.iter().map(|&v| f64::from(v)).sum::<f64>() / n;
        let variance = values
            .iter()
            .map(|&v| (f64::from(v) - mean).powi(2))
            .sum::<f64>()
            / (n - 1.0);
        (mean, variance)
    }

    #[test]
    fn mean_and_variance_follow_the_camera_model() {
        // n = 100 000 values: the mean has σ/√n and the variance √(2/n), bounds at 4 of each.
        // Rounding to whole steps adds 1/12.
        let settings = Settings::default();
        for radiance in [0.1, 0.3, 0.5, 0.8] {
            let (mean, variance) = moments(&exposed(&settings, radiance, 9));
            let expected = settings.sigma_grey(f64::from(radiance)).powi(2) + 1.0 / 12.0;
            let n = 100_000.0_f64;
            let mean_gap = (mean - 255.0 * f64::from(radiance)).abs();
            assert!(mean_gap < 4.0 * (expected / n).sqrt(), "{radiance}: {mean}");
            let ratio = variance / expected;
            assert!(
                (ratio - 1.0).abs() < 4.0 * (2.0 / n).sqrt(),
                "{radiance}: {ratio}"
            );
        }
    }

    #[test]
    fn rows_frames_and_sides_have_independent_noise() {
        let settings = Settings::default();
        let row = |frame, side, row| {
            let key = RowKey {
                seed: 1,
                frame,
                side,
                row,
            };
            let mut grey = vec![0; 20_000];
            expose(&settings, &key, &vec![0.5; 20_000], &mut grey);
            grey
        };
        let base = row(0, Side::Left, 0);
        let (mean, variance) = moments(&base);
        for other in [
            row(0, Side::Right, 0),
            row(1, Side::Left, 0),
            row(0, Side::Left, 1),
            row(0, Side::Left, 2),
        ] {
            let covariance = base
                .iter()
                .zip(&other)
                .map(|(&a, &b)| (f64::from(a) - mean) * (f64::from(b) - mean))
                .sum::<f64>()
                / 20_000.0;
            // A correlation of nothing has σ = 1/√n.
            assert!((covariance / variance).abs() < 4.0 / 20_000.0_f64.sqrt());
        }
        assert_eq!(base, row(0, Side::Left, 0));
    }

    #[test]
    fn without_noise_values_are_only_rounded() {
        let settings = Settings {
            noisy: false,
            ..Settings::default()
        };
        assert!(exposed(&settings, 0.5, 1).iter().all(|&v| v == 128));
        assert!(exposed(&settings, 7.0, 1).iter().all(|&v| v == 255));
    }

    #[test]
    fn values_out_of_range_are_named() {
        let settings = Settings {
            full_well_e: 1.0,
            ..Settings::default()
        };
        let error = settings.check().expect_err("too small");
        assert_eq!(error.key, "full_well_e");
    }
}
