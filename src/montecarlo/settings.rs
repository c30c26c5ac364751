//! What is simulated.

use crate::estimation::two_frame::Estimator;
use crate::estimation::{self, MotionModel};
use crate::settings::SettingError;
use crate::simulation::points::PixelNoise;

/// What becomes of the errors that a rig's calibration is stated to have.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum RigError {
    /// The rig is exactly what it is said to be.
    #[default]
    None,
    /// Every run draws a rig from the stated uncertainty; the covariance accounts for it.
    Considered,
    /// Every run draws a rig from the stated uncertainty; the covariance knows nothing of it.
    Ignored,
}

/// How the correlation of consecutive motions, which share pixels, is accounted for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Correlation {
    /// Not at all: motions are taken as independent, as the thesis does.
    Independent,
    /// Each pair's noise is taken as its own, and the same in both motions that use it.
    Shared,
    /// As the residuals of tracks over several pairs tell.
    #[default]
    Measured,
}

/// What is simulated, and how often.
#[derive(Clone, Debug, PartialEq)]
pub struct Settings {
    /// Runs. Number, 10 to 1000000, default 300: the ANEES is then known to 7 %.
    pub runs: u64,
    /// What landmarks and noise are drawn from. Any, default 1.
    pub seed: u64,
    /// Any motion or planar ones. Default SE(3).
    pub model: MotionModel,
    /// The estimator of motions. Default bundle adjustment.
    pub estimator: Estimator,
    /// Whether a path is estimated by the window of keyframes, as the pipeline does, instead of by
    /// chained motions. Default: it is not.
    pub windowed: bool,
    /// Keyframes in the window, where there is one. Number, 2 to 20, default that of the estimation.
    pub keyframes: u32,
    /// Features that a motion rests on. Number, 3 to 10000, default 100.
    pub features: usize,
    /// Depth at which landmarks appear, from the left camera, uniform in between. m, 0.1 to 10000,
    /// default 2 to 40: the range of the thesis.
    pub depth_m: [f64; 2],
    /// Chance that a feature which one motion used is used by the next one too. Share, 0 to 1,
    /// default 0.9. With 0, no two motions share a pixel.
    pub survival: f64,
    /// Motions of a path. Number, 1 to 10000, default 100.
    pub steps: usize,
    /// Length of a motion, ahead. m, −100 to 100, default 0.3.
    pub step_m: f64,
    /// Turn of a motion, to the left. rad, −1 to 1, default −0.9°: a path of a hundred motions is
    /// then a quarter of a circle.
    pub turn_rad: f64,
    /// How measured pixels deviate. Default Gaussian of 0.5 px.
    pub noise: PixelNoise,
    /// The largest feature's scale over the smallest one's; a feature's deviations grow with its
    /// scale, which is log-uniform. Ratio, 1 to 100, default 1: all alike.
    pub scales: f64,
    /// Share of a feature's noise variance that stays with it from pair to pair. Share, 0 to 1,
    /// default 0: each pair's noise is its own.
    pub persistence: f64,
    /// Standard deviation that the estimator is told (of the smallest scale). px, above 0, default
    /// that of the noise.
    pub stated_sigma_px: Option<f64>,
    /// Whether the rig is what it is said to be. Default: yes.
    pub rig_error: RigError,
    /// Largest squared residual of a track that counts. σ², 1 to 1e6, default 30: of Gaussian ones
    /// (five degrees of freedom) hardly any is larger; a narrower gate cuts off tails that are noise,
    /// and makes the covariance too small by what it cut.
    pub gate_sigma2: f64,
    /// How the correlation of consecutive motions, which share pixels, is accounted for. Default
    /// measured, as residuals tell.
    pub correlation: Correlation,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            runs: 300,
            seed: 1,
            model: MotionModel::Se3,
            estimator: Estimator::Bundle,
            windowed: false,
            keyframes: estimation::Settings::default().keyframes,
            features: 100,
            depth_m: [2.0, 40.0],
            survival: 0.9,
            steps: 100,
            step_m: 0.3,
            turn_rad: (-0.9_f64).to_radians(),
            noise: PixelNoise::Gaussian { sigma_px: 0.5 },
            scales: 1.0,
            persistence: 0.0,
            stated_sigma_px: None,
            rig_error: RigError::None,
            gate_sigma2: 30.0,
            correlation: Correlation::Measured,
        }
    }
}

impl Settings {
    /// Refuses values out of range.
    ///
    /// # Errors
    /// The first setting out of range.
    pub fn check(&self) -> Result<(), SettingError> {
        SettingError::unless_in("runs", self.runs, 10..=1_000_000)?;
        SettingError::unless_in("keyframes", self.keyframes, estimation::KEYFRAMES)?;
        SettingError::unless_in("features", self.features, 3..=10_000)?;
        let [near, far] = self.depth_m;
        SettingError::unless_in("depth", near, 0.1..=1e4)?;
        SettingError::unless_in("depth", far, near..=1e4)?;
        SettingError::unless_in("survival", self.survival, 0.0..=1.0)?;
        SettingError::unless_in("steps", self.steps, 1..=10_000)?;
        SettingError::unless_in("step", self.step_m, -100.0..=100.0)?;
        SettingError::unless_in("turn", self.turn_rad, -1.0..=1.0)?;
        SettingError::unless_in("scales", self.scales, 1.0..=100.0)?;
        SettingError::unless_in("persistence", self.persistence, 0.0..=1.0)?;
        SettingError::unless_in("gate", self.gate_sigma2, 1.0..=1e6)?;
        self.noise.check()?;
        SettingError::unless_in("stated sigma px", self.stated_sigma_px(), 1e-6..=1000.0)
    }

    /// What the estimator is told of the noise, px, at the smallest scale.
    #[must_use]
    pub fn stated_sigma_px(&self) -> f64 {
        self.stated_sigma_px
            .unwrap_or_else(|| self.noise.sigma_px())
    }
}
