//! The window: a stereo bundle adjustment over the last keyframes, one frame's measurements in, the
//! motion and the pose with their joint covariance out.
//!
//! ```text
//! keyframe 0 (datum) ─ keyframe 1 ─ … ─ keyframe n ─ [last frame] ─ current frame
//!       │                 landmarks, each anchored in one keyframe, seen from several
//!  odom_from_datum
//! ```
//!
//! Poses are relative to the oldest keyframe, the *datum*, so that the equations never know how far
//! the robot has come: nothing loses precision over a long way. What lies before the window is kept
//! as a Gaussian prior on these relative poses (`prior`) and as the datum's own uncertainty, its
//! correlation with the window included (`datum`): marginalisation is exact to first order, so no
//! measurement counts twice and none is forgotten.
//!
//! Perturbations are right ones, `T ← T · Exp(x)`. Jacobians of poses that the prior knows are
//! taken where the prior was made (first-estimate Jacobians: Huang, Mourikis, Roumeliotis 2010), so
//! that marginalisation adds no knowledge that is not there.

mod datum;
mod dispersion;
mod keyframes;
mod landmark;
mod memory;
mod planar;
mod prior;
mod retirement;
mod sensitivity;
mod solve;
mod system;
#[cfg(test)]
mod tests;
mod viewpoints;
mod warp;

pub use landmark::{Landmark, LandmarkId, Observation};

use super::closed_form::MotionEstimate;
use super::sources::{BySources, Exposure, RigErrors, SOURCES};
use super::{Settings, StereoMeasurement};
use crate::geometry::{StereoRig, se3};
use crate::uncertainty::consistency;
use datum::Datum;
use dispersion::Dispersion;
use memory::Memory;
use nalgebra::{DMatrix, Isometry3, Matrix6, SMatrix, Vector2, Vector4, Vector6};
use planar::Ground;
use prior::Prior;
pub use retirement::UNSEEN_KEYFRAMES;
use sensitivity::Sensitivity;
use solve::{Sightings, State};
use system::System;
use viewpoints::Viewpoints;
pub(super) use warp::WARP;
use warp::Warp;

/// Where the unknowns of frame `i` begin, i > 0.
const fn row_of(i: usize) -> usize {
    WARP + 6 * (i - 1)
}

/// Frames in the window at most: keyframes, the last frame and the current one.
const MAX_FRAMES: usize = 24;
/// The same with these settings.
const fn frames_of(settings: &Settings) -> usize {
    settings.keyframes as usize + 2
}
/// Landmarks that there is room for from the start, over those that are tracked at once: those of the last keyframes
/// stay for a while after they were seen last.
const LANDMARKS_PER_TRACKED: usize = 2;
/// Unknowns of the warp and of poses at most.
const MAX_UNKNOWNS: usize = row_of(MAX_FRAMES);

/// One pair of images in the window.
#[derive(Clone, Copy, Debug)]
struct Frame {
    /// Counts all frames that ever were.
    serial: u64,
    datum_from_frame: Isometry3<f64>,
    /// Where the prior was linearised, for a frame that it knows.
    linearised: Option<Isometry3<f64>>,
    is_keyframe: bool,
    /// Landmarks seen when it became a keyframe.
    landmarks: usize,
    /// Sights of landmarks whose word the prior has by now.
    retired_sights: u32,
    /// How its two images were taken.
    exposure: Exposure,
}

impl Frame {
    /// Where Jacobians are taken.
    fn datum_from_linearised(&self) -> &Isometry3<f64> {
        self.linearised.as_ref().unwrap_or(&self.datum_from_frame)
    }
}

/// The state of the estimator.
#[derive(Clone, Debug)]
pub struct Window {
    rig: StereoRig,
    warp: Warp,
    cov_warp: SMatrix<f64, WARP, WARP>,
    warp_by_sources: SMatrix<f64, WARP, SOURCES>,
    errors: RigErrors,
    ground: Option<Ground>,
    sensitivity: Sensitivity,
    settings: Settings,
    datum: Datum,
    prior: Prior,
    frames: Vec<Frame>,
    landmarks: Vec<Landmark>,
    next_serial: u64,
    variance: VarianceFactor,
    dispersion: Dispersion,
    /// Covariance of the second frame's pose, the datum's and the warp being given.
    cov_second: Matrix6<f64>,
    system: System,
    memory: Memory,
    kept: State,
    sightings: Sightings,
    /// Indices of the landmarks whose sights in the newest frame have proved wrong.
    refuted: Vec<usize>,
    /// Lists of sights that belong to no landmark at present.
    spare_sights: Vec<Vec<Observation>>,
    squares: Vec<f64>,
    viewpoints: Viewpoints,
}

/// The a-posteriori variance factor, smoothed over frames.
#[derive(Clone, Copy, Debug)]
struct VarianceFactor {
    smoothed: f64,
    frames: u32,
}

/// Share of a new frame in the smoothed variance factor, once there are enough.
const VARIANCE_GAIN: f64 = 0.1;

impl VarianceFactor {
    fn take(&mut self, measured: f64) {
        self.frames = self.frames.saturating_add(1);
        let gain = VARIANCE_GAIN.max(1.0 / f64::from(self.frames));
        self.smoothed += gain * (measured.max(MIN_VARIANCE_FACTOR) - self.smoothed);
    }
}

/// However small residuals are, no more than this is believed of the stated σ: half of it.
const MIN_VARIANCE_FACTOR: f64 = 0.25;

impl Window {
    /// An empty window, to be [begun](Self::begin_at).
    #[must_use]
    pub fn new(rig: StereoRig, settings: Settings) -> Self {
        let warp = Warp::new(&rig);
        let cov_warp = warp::prior_covariance(&rig, &settings);
        let prior = Prior::new(&warp, &cov_warp);
        let landmarks = LANDMARKS_PER_TRACKED * settings.max_landmarks as usize;
        let frames = frames_of(&settings);
        let spare_sights = (0..landmarks)
            .map(|_| keyframes::room_for_sights(&settings))
            .collect();
        let warp_by_sources = cov_warp * prior.by_sources.fixed_rows::<WARP>(0);
        Self {
            prior,
            errors: RigErrors::of(&rig, &settings),
            ground: Ground::of(&rig, &settings),
            sensitivity: Sensitivity::with_room(frames),
            rig,
            warp,
            cov_warp,
            warp_by_sources,
            settings,
            datum: Datum::new(
                &Isometry3::identity(),
                &Matrix6::zeros(),
                &BySources::zeros(),
            ),
            frames: Vec::with_capacity(MAX_FRAMES),
            landmarks: Vec::with_capacity(landmarks),
            next_serial: 0,
            variance: VarianceFactor {
                smoothed: 1.0,
                frames: 0,
            },
            dispersion: Dispersion::with_room(frames),
            cov_second: Matrix6::zeros(),
            system: System::with_room(frames, landmarks),
            memory: Memory::stocked(),
            kept: State::with_room(frames, landmarks),
            sightings: Sightings::with_room(landmarks),
            refuted: Vec::with_capacity(landmarks),
            spare_sights,
            squares: Vec::with_capacity(frames * landmarks),
            viewpoints: Viewpoints::with_room(frames),
        }
    }

    /// A measurement as the rig would have made it if it were as calibrated.
    #[must_use]
    pub fn corrected(&self, measurement: &StereoMeasurement) -> StereoMeasurement {
        self.warp.corrected(measurement)
    }

    /// Where the rig as it is sees what it would see at `px` if it were as calibrated.
    #[must_use]
    pub fn expected_px(&self, px: &Vector4<f64>) -> Vector4<f64> {
        let at = StereoMeasurement {
            px: *px,
            sigma_px: Vector4::zeros(),
        };
        px * 2.0 - self.warp.corrected(&at).px
    }

    /// By how much the right image is displaced from what the calibration says, px: along the
    /// baseline, then the coefficients of 1, x, y, x², xy, y² across it, positions counted from the
    /// image's centre in halves of its width.
    #[must_use]
    pub fn warp_px(&self) -> [f64; 7] {
        self.warp.coefficients.into()
    }

    /// 1 σ of [`warp_px`](Self::warp_px).
    #[must_use]
    pub fn sigma_warp_px(&self) -> [f64; 7] {
        std::array::from_fn(|i| self.cov_warp[(i, i)].sqrt())
    }

    /// The landmarks, with rising ids.
    #[must_use]
    pub fn landmarks(&self) -> &[Landmark] {
        &self.landmarks
    }

    /// The landmark of this id.
    #[must_use]
    pub fn landmark(&self, id: LandmarkId) -> Option<&Landmark> {
        let at = self.landmarks.binary_search_by_key(&id, |l| l.id).ok()?;
        Some(&self.landmarks[at])
    }

    /// Where the newest frame sees a landmark in its left image, px; `None` if it does not.
    #[must_use]
    pub fn newest_px(&self, id: LandmarkId) -> Option<Vector2<f64>> {
        let newest = self.newest_serial()?;
        let last = self.landmark(id)?.observations.last()?;
        (last.serial == newest).then(|| last.measurement.left_px())
    }

    /// The variance factor to expect of measurements.
    #[must_use]
    pub fn variance_factor(&self) -> f64 {
        self.variance.smoothed
    }

    /// By how much more a pose's error scatters than independent errors of the pixels would make it: 1 or
    /// more. It is in every pose's covariance.
    #[must_use]
    pub fn dispersion(&self) -> f64 {
        self.dispersion.factor()
    }

    /// Pose of the newest frame in the odometry frame.
    #[must_use]
    pub fn odom_from_newest(&self) -> Isometry3<f64> {
        let x = self.prior.offsets(&self.warp, &self.frames);
        let newest = self
            .frames
            .last()
            .map_or_else(Isometry3::identity, |f| f.datum_from_frame);
        self.datum.pose(&x) * newest
    }

    /// Maps a point of the newest frame's left camera into that of the frame with this serial;
    /// `None` if the window does not hold it any more.
    #[must_use]
    pub fn frame_from_newest(&self, serial: u64) -> Option<Isometry3<f64>> {
        let newest = self.frames.last()?;
        let frame = self.frames.iter().find(|f| f.serial == serial)?;
        Some(frame.datum_from_frame.inverse() * newest.datum_from_frame)
    }

    /// Maps a point of a landmark's anchor into the newest frame.
    #[must_use]
    pub fn newest_from_anchor(&self, landmark: &Landmark) -> Option<Isometry3<f64>> {
        let newest = self.frames.last()?;
        let anchor = &self.frames[self.frame_index(landmark.anchor)?];
        Some(newest.datum_from_frame.inverse() * anchor.datum_from_frame)
    }

    /// The serial of the newest frame.
    #[must_use]
    pub fn newest_serial(&self) -> Option<u64> {
        self.frames.last().map(|f| f.serial)
    }

    /// The serials of the keyframes, oldest first.
    pub fn keyframe_serials(&self) -> impl Iterator<Item = u64> + '_ {
        self.frames
            .iter()
            .filter(|f| f.is_keyframe)
            .map(|f| f.serial)
    }

    fn frame_index(&self, serial: u64) -> Option<usize> {
        self.frames.iter().position(|f| f.serial == serial)
    }

    fn pose_covariance(&self, newest: &Isometry3<f64>, cov_window: &Joint) -> Matrix6<f64> {
        let mut cov = self.datum.covariance_of(newest, cov_window);
        if let Some(last) = self.frames.len().checked_sub(1).filter(|last| *last > 0) {
            cov += self.beyond_chance(&dispersion::of_pose_given_warp(cov_window, last));
        }
        se3::symmetric(&cov)
    }

    /// What a covariance that takes errors for independent lacks.
    fn beyond_chance(&self, cov: &Matrix6<f64>) -> Matrix6<f64> {
        cov * (self.dispersion.factor() - 1.0)
    }
}

/// Pairs of a frame and an anchor, which is not later than the frame, among so many frames.
fn line_count(frames: usize) -> usize {
    frames * (frames + 1) / 2
}

/// The place of one of them.
fn line_index(anchor: usize, frame: usize) -> usize {
    debug_assert!(
        anchor <= frame,
        "landmarks are seen from where they are anchored on"
    );
    frame * (frame + 1) / 2 + anchor
}

/// The joint covariance of the warp, and of the window's poses but the
/// datum, six rows each.
type Joint = DMatrix<f64>;

/// What one frame came to.
#[derive(Clone, Copy, Debug)]
pub struct Tracked {
    /// Pose of the frame in the odometry frame.
    pub odom_from_now: Isometry3<f64>,
    /// Its covariance, right perturbation: of the pixels' noise and of the warp's prior.
    pub cov_pose_right: Matrix6<f64>,
    /// What each source of error does to it.
    pub pose_by_sources: BySources,
    /// The motion since the frame before, its covariance as the pose's.
    pub motion: MotionEstimate,
    /// What each source of error does to it.
    pub motion_by_sources: BySources,
    /// A-posteriori variance factor of this frame's measurements.
    pub variance_factor: f64,
    /// Measurements of this frame that the estimate rests on.
    pub inliers: u32,
    /// How far the frame leaves flat ground, where that is the model: χ² with three degrees of
    /// freedom on ground that is flat.
    pub departure: Option<f64>,
}

impl Tracked {
    /// Whether rounding has left its covariances what they should be: where sights hardly determine a
    /// frame they are so large, and so much larger in one direction than in others, that nothing is
    /// left of what is small.
    fn is_determined(&self) -> bool {
        [&self.cov_pose_right, &self.motion.cov_right]
            .iter()
            .all(|cov| consistency::nees(&Vector6::zeros(), cov).is_some())
    }
}

/// A landmark seen in the newest frame.
#[derive(Clone, Copy, Debug)]
pub struct Seen {
    /// Which.
    pub id: LandmarkId,
    /// Where.
    pub measurement: StereoMeasurement,
    /// On the left and on the right, σ of an error that all sights of the landmark share, each in
    /// proportion to this, px.
    pub relief_px: Vector2<f64>,
}
