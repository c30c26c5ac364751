//! Motion: the tracks between two pairs in, the motion by one of the two-frame estimators out, with
//! the covariance of the whole chain of motions; or why there is none.

use super::bundle::TrackedPoint;
use super::closed_form::MotionEstimate;
use super::consensus::{self, Search, Sighting};
use super::motion_chain::{ChainedTrack, MotionChain};
use super::sources::{BySources, Exposure, MODE_COLUMNS, MODES, RigErrors, SKEW_COLUMN};
use super::track_noise::TrackNoiseWatch;
use super::two_frame::{Estimator, TwoFrame, TwoFrameMotion};
use super::{Model, Settings, calibration};
use crate::geometry::{StereoRig, se3};
use nalgebra::{Isometry3, Matrix6};

/// A measured motion.
#[derive(Clone, Copy, Debug)]
pub struct MeasuredMotion {
    /// The motion, its covariance by the pixels' noise, scaled by the residuals.
    pub estimate: MotionEstimate,
    /// What each source of error does to it.
    pub by_sources: BySources,
    /// A-posteriori variance factor of this motion's residuals in the images.
    pub variance_factor: f64,
    /// Tracks that it rests on.
    pub inliers: u32,
    /// How far it leaves flat ground, where that is the model: χ² with three degrees of freedom on
    /// ground that is flat.
    pub departure: Option<f64>,
}

/// What there is to measure a motion from.
#[derive(Clone, Copy, Debug)]
pub struct Tracks<'a> {
    /// The tracks' numbers, rising; the same from pair to pair.
    pub ids: &'a [u64],
    /// Likewise.
    pub points: &'a [TrackedPoint],
    /// How the earlier images were taken, and the present ones.
    pub exposures: [Exposure; 2],
}

/// Measures one motion after the other, and what their noise makes of the pose.
#[derive(Debug)]
pub struct MotionMeter {
    settings: Settings,
    errors: RigErrors,
    model: Model,
    two_frame: TwoFrame,
    /// Any motion, where the model is planar: whether the ground is.
    unbound: Option<TwoFrame>,
    watch: TrackNoiseWatch,
    chain: MotionChain,
    cov_chained: Matrix6<f64>,
    inlier_ids: Vec<u64>,
    inliers: Vec<TrackedPoint>,
    chained: Vec<ChainedTrack>,
}

impl MotionMeter {
    /// A meter for the estimator of the settings: bundle adjustment where that is the window.
    #[must_use]
    pub fn new(rig: &StereoRig, settings: &Settings) -> Self {
        let model = settings.model.of(rig);
        let estimator = settings.method.of_two_frames().unwrap_or(Estimator::Bundle);
        let of = |estimator, model| TwoFrame::new(estimator, model, settings.gate_sigma2);
        Self {
            errors: RigErrors::of(rig, settings),
            model,
            two_frame: of(estimator, model),
            unbound: matches!(model, Model::Planar(_)).then(|| of(Estimator::Bundle, Model::Se3)),
            watch: TrackNoiseWatch::new(model.degrees_of_freedom()),
            chain: MotionChain::default(),
            cov_chained: Matrix6::zeros(),
            inlier_ids: Vec::new(),
            inliers: Vec::new(),
            chained: Vec::new(),
            settings: settings.clone(),
        }
    }

    /// Begins a chain of motions at a pose of this covariance (right perturbation).
    pub fn begin(&mut self, cov: &Matrix6<f64>) {
        self.chain = MotionChain::beginning_at(cov);
        self.cov_chained = *cov;
        self.watch.forget_tracks();
    }

    /// The covariance (right perturbation) that the noise of all motions since the beginning gives
    /// the pose.
    #[must_use]
    pub fn cov_chained(&self) -> &Matrix6<f64> {
        &self.cov_chained
    }

    /// The tracks that the last motion was measured from: their numbers, and what they showed.
    pub fn agreed(&self) -> impl Iterator<Item = (u64, &TrackedPoint)> {
        self.inlier_ids.iter().copied().zip(&self.inliers)
    }

    /// Measures the next motion and adds it to the chain. `guess` is where to look first,
    /// `variance_factor` what to expect of residuals.
    ///
    /// `None`, the chain as it was, if too few tracks agree, or do not determine the motion.
    pub fn measure(
        &mut self,
        rig: &StereoRig,
        tracks: &Tracks<'_>,
        guess: &Isometry3<f64>,
        variance_factor: f64,
        seed: u64,
    ) -> Option<MeasuredMotion> {
        let start = self.agree(rig, tracks, guess, variance_factor, seed)?;
        let motion = self.two_frame.estimate(rig, &start, &self.inliers)?;
        if motion.tracks.len() < self.settings.min_inliers as usize {
            return None;
        }
        let by_sources = self.by_sources(rig, &motion, &tracks.exposures)?;
        let departure = self.departure(rig, &motion);
        Some(MeasuredMotion {
            estimate: self.chain_on(rig, &motion),
            by_sources,
            variance_factor: motion.variance_factor,
            inliers: motion.tracks.len() as u32,
            departure,
        })
    }

    /// The motion that most tracks agree on; those that do are left in `inliers`.
    fn agree(
        &mut self,
        rig: &StereoRig,
        tracks: &Tracks<'_>,
        guess: &Isometry3<f64>,
        variance_factor: f64,
        seed: u64,
    ) -> Option<Isometry3<f64>> {
        let search = Search {
            max_samples: self.settings.max_samples,
            gate: self.settings.gate_sigma2,
            variance_factor,
            seed,
        };
        let (kept, sightings): (Vec<usize>, Vec<Sighting>) = tracks
            .points
            .iter()
            .enumerate()
            .filter_map(|(i, p)| Some((i, Sighting::of(rig, p)?)))
            .unzip();
        let consensus = consensus::find(rig, &sightings, Some(guess), &search)?;
        if consensus.inliers.len() < self.settings.min_inliers as usize {
            return None;
        }
        let agreed = || consensus.inliers.iter().map(|&i| kept[i as usize]);
        self.inlier_ids.clear();
        self.inlier_ids.extend(agreed().map(|i| tracks.ids[i]));
        self.inliers.clear();
        self.inliers.extend(agreed().map(|i| tracks.points[i]));
        Some(self.model.constrain(&consensus.prev_from_now))
    }

    /// Adds a motion to the chain; the motion with its own covariance.
    fn chain_on(&mut self, rig: &StereoRig, motion: &TwoFrameMotion) -> MotionEstimate {
        let noise = self
            .watch
            .observe(rig, motion, &self.inlier_ids, &self.inliers);
        self.chained.clear();
        let tracks = motion.tracks.iter().zip(&motion.influences);
        self.chained
            .extend(tracks.map(|(&i, influence)| ChainedTrack {
                id: self.inlier_ids[i as usize],
                influence: influence.whitened(&self.inliers[i as usize]),
            }));
        let prev_from_now = motion.estimate.prev_from_now;
        self.chain.advance(&prev_from_now, &self.chained, &noise);
        self.cov_chained = self.chain.covariance(&noise);
        let own = self.chained.iter().map(|t| noise.covariance(&t.influence));
        MotionEstimate {
            prev_from_now,
            cov_right: se3::symmetric(&own.sum()),
        }
    }

    fn by_sources(
        &self,
        rig: &StereoRig,
        motion: &TwoFrameMotion,
        [before, now]: &[Exposure; 2],
    ) -> Option<BySources> {
        let mut by_sources = BySources::zeros();
        if !self.errors.has_modes() && now.sigma_skew_s == 0.0 {
            return Some(by_sources);
        }
        let tracks = motion.tracks.iter().map(|&i| &self.inliers[i as usize]);
        let by = calibration::of_motion(
            rig,
            &motion.estimate.prev_from_now,
            tracks.zip(&motion.influences),
            &before.twist,
            &now.twist,
        )?;
        by_sources
            .fixed_columns_mut::<MODES>(MODE_COLUMNS)
            .copy_from(&self.errors.of_parameters(by.by_rig.by_parameters()));
        by_sources
            .column_mut(SKEW_COLUMN)
            .copy_from(&(by.by_skew.by_parameters() * now.sigma_skew_s));
        Some(by_sources)
    }

    /// How far a motion would leave the plane if it were free to.
    fn departure(&mut self, rig: &StereoRig, motion: &TwoFrameMotion) -> Option<f64> {
        let Model::Planar(plane) = self.model else {
            return None;
        };
        let free =
            self.unbound
                .as_mut()?
                .estimate(rig, &motion.estimate.prev_from_now, &self.inliers)?;
        let mut estimate = free.estimate;
        estimate.cov_right *= free.variance_factor;
        plane.departure(
            &estimate,
            self.settings.flat_sigma_m,
            self.settings.flat_sigma_rad,
        )
    }
}
