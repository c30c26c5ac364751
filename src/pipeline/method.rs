//! The method: one stereo pair after the other in, one odometry row each out.
//!
//! [`Method::step`] is the whole of it. Features are extracted before, for that may be done for
//! several images at once; everything else depends on the pair before and is done in order: by the
//! window of keyframes ([`super::windowed`]), or from pair to pair ([`super::two_frame`]).

use super::repeats::{Repeated, Repeats};
use super::two_frame::TwoFrame;
use super::windowed::Windowed;
use crate::capture::{Skew, StereoPair};
use crate::estimation::sources::{Exposure, RigErrors};
use crate::estimation::{
    self, Counts, Odometer, Odometry, PairStamp, Start, StereoMeasurement, TrackedFeature,
};
use crate::features::{ExtractError, Extractor, Features};
use crate::geometry::{Rectification, StereoRig};
use crate::image::{BANDS, GrayImage};
use crate::matching::{
    self, MatchError, MatchedPair, Partners, StereoMatch, StereoMatcher, SurroundingsMatcher,
    TemporalMatcher, Track,
};
use crate::refinement::{Pyramid, PyramidPair};
use crate::rig_watch::{self, RigState, RigWatch};
use nalgebra::{Isometry3, Vector3, Vector4};
use std::time::{Duration, Instant};

const NS_PER_S: f64 = 1e9;

/// What is known of one image.
#[derive(Clone, Debug, Default)]
pub struct Described {
    /// Its features.
    pub features: Features,
    /// Its reductions.
    pub pyramid: Pyramid,
    /// What tells its bands of rows from those of other images; `None` for one that says nothing.
    pub fingerprints: [Option<u64>; BANDS],
}

impl Described {
    /// Takes on what needs no extractor.
    pub fn take(&mut self, image: &GrayImage) {
        self.pyramid.fill(image);
        self.fingerprints = image.fingerprints();
    }
}

/// A pair with the features of both its images.
#[derive(Clone, Debug, Default)]
pub struct DescribedPair {
    /// The number of the pair in its recording.
    pub sequence: u64,
    /// When the left image was taken, ns.
    pub timestamp_ns: i64,
    /// How far apart in time the two images were taken.
    pub skew: Skew,
    /// The left image's.
    pub left: Described,
    /// The right image's.
    pub right: Described,
}

impl DescribedPair {
    pub(super) fn stamp(&self) -> PairStamp {
        PairStamp {
            sequence: self.sequence,
            timestamp_ns: self.timestamp_ns,
        }
    }

    pub(super) fn pyramids(&self) -> PyramidPair<'_> {
        PyramidPair {
            left: &self.left.pyramid,
            right: &self.right.pyramid,
        }
    }
}

/// How long the stages took for one pair.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct StageTimes {
    /// Left–right and over time.
    pub matching: Duration,
    /// Triangulation, motion and odometry.
    pub estimation: Duration,
}

/// A pair's features with its stereo matches and where their points are.
#[derive(Debug, Default)]
pub(super) struct Seen {
    pub(super) pair: DescribedPair,
    pub(super) matches: Vec<StereoMatch>,
    pub(super) measurements: Vec<StereoMeasurement>,
    /// (x, y, ρ) in the left camera; `None` where the sights do not meet.
    pub(super) inverse_depths: Vec<Option<Vector3<f64>>>,
}

/// What both estimators work with: the present pair, the matchers, the settings.
pub(super) struct Workbench {
    pub(super) rig: StereoRig,
    pub(super) matching: matching::Settings,
    pub(super) estimation: estimation::Settings,
    left_right: LeftRight,
    pub(super) temporal_matcher: TemporalMatcher,
    pub(super) now: Seen,
    pub(super) predicted: Vec<Option<Vector4<f64>>>,
    pub(super) tracks: Vec<Track>,
    pub(super) odometer: Option<Odometer>,
    pub(super) errors: RigErrors,
    /// How the present images were taken.
    pub(super) exposure: Exposure,
    /// When matching was done and estimation began.
    pub(super) matched: Option<Instant>,
    /// Whether the rig is still as calibrated.
    pub(super) watch: Option<RigWatch>,
    /// The epoch that the first pair begins, and where, if not at the origin.
    beginning: (u32, Option<Start>),
}

/// Finds the stereo matches.
enum LeftRight {
    Features(StereoMatcher),
    Surroundings(SurroundingsMatcher),
}

impl LeftRight {
    fn new(settings: &matching::Settings, rectification: Rectification) -> Self {
        let settings = settings.clone();
        match settings.partners {
            Partners::Features => Self::Features(StereoMatcher::new(settings, rectification)),
            Partners::Surroundings => {
                Self::Surroundings(SurroundingsMatcher::new(settings, rectification))
            }
        }
    }
}

enum Estimator {
    TwoFrame(Box<TwoFrame>),
    Window(Box<Windowed>),
}

/// The state between pairs.
pub struct Method {
    bench: Workbench,
    estimator: Estimator,
    repeats: Repeats,
    times: StageTimes,
    has_stepped: bool,
}

/// Why a pair gives no estimate of its own.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum StepError {
    /// A camera hands on what it has handed on before.
    #[error(transparent)]
    Repeated(#[from] Repeated),
    /// Its features could not be matched.
    #[error(transparent)]
    Match(#[from] MatchError),
}

impl Method {
    /// The method for one rig. `None` if the rig's cameras stand in line with their view, so that
    /// no epipolar band exists.
    #[must_use]
    pub fn new(
        rig: StereoRig,
        matching: matching::Settings,
        estimation: estimation::Settings,
    ) -> Option<Self> {
        let rectification = Rectification::new(&rig)?;
        let estimator = match estimation.method {
            estimation::Method::Window => {
                Estimator::Window(Box::new(Windowed::new(&rig, &estimation)))
            }
            _ => Estimator::TwoFrame(Box::new(TwoFrame::new(&rig, &estimation))),
        };
        let bench = Workbench {
            errors: RigErrors::of(&rig, &estimation),
            exposure: Exposure::default(),
            rig,
            left_right: LeftRight::new(&matching, rectification),
            temporal_matcher: TemporalMatcher::new(matching.clone()),
            matching,
            estimation,
            now: Seen::default(),
            predicted: Vec::new(),
            tracks: Vec::new(),
            odometer: None,
            matched: None,
            watch: None,
            beginning: (0, None),
        };
        Some(Self {
            repeats: Repeats::new(bench.estimation.repeats),
            bench,
            estimator,
            times: StageTimes::default(),
            has_stepped: false,
        })
    }

    /// Watches the rig from now on, if the settings want it.
    #[must_use]
    pub fn watching_rig(mut self, settings: &rig_watch::Settings) -> Self {
        self.bench.watch = RigWatch::new(&self.bench.rig, settings, &self.bench.estimation);
        self
    }

    /// Begins with the given epoch, and where an earlier run ended, if that is known. Before the first pair.
    #[must_use]
    pub fn continuing(mut self, epoch: u32, start: Option<Start>) -> Self {
        self.bench.beginning = (epoch, start);
        self
    }

    /// Whether features of the right image are wanted.
    #[must_use]
    pub fn wants_right_features(&self) -> bool {
        matches!(self.bench.left_right, LeftRight::Features(_))
    }

    /// How the rig is, where it is watched.
    #[must_use]
    pub fn rig_state(&self) -> Option<RigState> {
        self.bench.watch.as_ref().map(RigWatch::state)
    }

    /// Takes the next pair and says where the camera is.
    ///
    /// # Errors
    /// An image, or a good part of it, is one that the camera has shown before, or its features could not be
    /// matched. The method stands as before the pair, which is then to be [skipped](Self::skip).
    pub fn step(&mut self, pair: &mut DescribedPair) -> Result<Odometry, StepError> {
        self.has_stepped = false;
        self.repeats.check(pair)?;
        std::mem::swap(&mut self.bench.now.pair, pair);
        let started = Instant::now();
        self.bench.matched = None;
        self.bench.match_left_and_right()?;
        self.bench.exposure = self.bench.exposure();
        self.bench.triangulate();
        let row = match &mut self.estimator {
            Estimator::TwoFrame(estimator) => estimator.step(&mut self.bench)?,
            Estimator::Window(estimator) => estimator.step(&mut self.bench)?,
        };
        let matched = self.bench.matched.unwrap_or_else(Instant::now);
        self.times = StageTimes {
            matching: matched - started,
            estimation: matched.elapsed(),
        };
        self.has_stepped = true;
        Ok(row)
    }

    /// Takes note of a pair that could not be used at all.
    pub fn skip(&mut self, stamp: PairStamp) -> Odometry {
        self.times = StageTimes::default();
        self.has_stepped = false;
        match &mut self.bench.odometer {
            // Also before anything was tracked: the next motion is one since an earlier pair.
            Some(odometer) => odometer.bridge(stamp, Counts::default()),
            None => self
                .bench
                .new_odometer(stamp)
                .begin(stamp, Counts::default()),
        }
    }

    /// The features of the last [`step`](Self::step)'s pair that its estimate rests on, and those that are
    /// followed from it on; none where its motion could not be measured, and after a [`skip`](Self::skip).
    pub fn tracked(&self) -> impl Iterator<Item = TrackedFeature> + '_ {
        let (window, two_frame) = match &self.estimator {
            Estimator::Window(estimator) => (Some(estimator.tracked()), None),
            Estimator::TwoFrame(estimator) => (None, Some(estimator.tracked(&self.bench.rig))),
        };
        let window = window.into_iter().flatten();
        let features = window.chain(two_frame.into_iter().flatten());
        features.filter(|_| self.has_stepped)
    }

    /// How long the stages of the last [`step`](Self::step) took; zero after a
    /// [`skip`](Self::skip).
    #[must_use]
    pub fn times(&self) -> StageTimes {
        self.times
    }
}

impl Workbench {
    fn match_left_and_right(&mut self) -> Result<(), MatchError> {
        let Seen { pair, matches, .. } = &mut self.now;
        let (left, right) = (&pair.left, &mut pair.right);
        match &mut self.left_right {
            LeftRight::Features(matcher) => matcher.find(&left.features, &right.features, matches),
            LeftRight::Surroundings(matcher) => {
                let images = PyramidPair {
                    left: &left.pyramid,
                    right: &right.pyramid,
                };
                matcher.find(&left.features, &images, &mut right.features, matches);
                Ok(())
            }
        }
    }

    fn triangulate(&mut self) {
        let Seen {
            pair,
            matches,
            measurements,
            inverse_depths,
        } = &mut self.now;
        measurements.clear();
        measurements.extend(matches.iter().map(|m| measurement(pair, *m)));
        if self.exposure.skew_s != 0.0 {
            // As they would have been seen at the left image's time.
            let identity = Isometry3::identity();
            for m in measurements.iter_mut() {
                if let Some(y) = estimation::inverse_depth(&self.rig, m) {
                    m.px -= self.exposure.displacement(&self.rig, &identity, &y);
                }
            }
        }
        if let Some(watch) = &self.watch {
            for m in measurements.iter_mut() {
                m.px -= watch.displacement(&m.px);
            }
        }
        inverse_depths.clear();
        inverse_depths.extend(
            measurements
                .iter()
                .map(|m| estimation::inverse_depth(&self.rig, m)),
        );
    }

    /// How the present images were taken, as far as the last velocity tells.
    fn exposure(&self) -> Exposure {
        let skew = &self.now.pair.skew;
        let (skew_s, sigma_s) = (skew.ns as f64 / NS_PER_S, skew.sigma_ns / NS_PER_S);
        self.odometer
            .as_ref()
            .map_or_else(Exposure::default, |o| o.exposure(skew_s, sigma_s))
    }

    /// By how much the sight of a point, at about `px`, is displaced by what is known of the exposures' skew and
    /// of the rig's turn, px.
    pub(super) fn displacement(
        &self,
        px: &Vector4<f64>,
        now_from_anchor: &Isometry3<f64>,
        y: Option<&Vector3<f64>>,
    ) -> Vector4<f64> {
        let late = y.map_or_else(Vector4::zeros, |y| {
            self.exposure.displacement(&self.rig, now_from_anchor, y)
        });
        let turned = self.watch.as_ref().map(|w| w.displacement(px));
        late + turned.unwrap_or_else(Vector4::zeros)
    }

    /// An odometer that begins with a pair.
    pub(super) fn new_odometer(&self, stamp: PairStamp) -> Odometer {
        let (epoch, start) = self.beginning.clone();
        Odometer::new(self.estimation.clone(), self.errors.clone(), stamp).continuing(epoch, start)
    }

    pub(super) fn counts(&self, inliers: u32) -> Counts {
        Counts {
            keypoints_left: self.now.pair.left.features.len() as u32,
            keypoints_right: self.now.pair.right.features.len() as u32,
            stereo_matches: self.now.matches.len() as u32,
            tracks: self.tracks.len() as u32,
            inliers,
        }
    }
}

impl Seen {
    pub(super) fn matched(&self) -> MatchedPair<'_> {
        MatchedPair {
            left: &self.pair.left.features,
            right: &self.pair.right.features,
            matches: &self.matches,
        }
    }
}

/// What a stereo match measured.
fn measurement(pair: &DescribedPair, m: StereoMatch) -> StereoMeasurement {
    let l = &pair.left.features.keypoints[m.left as usize];
    let r = &pair.right.features.keypoints[m.right as usize];
    let (sl, sr) = (f64::from(l.sigma_px), f64::from(r.sigma_px));
    StereoMeasurement {
        px: Vector4::new(
            f64::from(l.x_px),
            f64::from(l.y_px),
            f64::from(r.x_px),
            f64::from(r.y_px),
        ),
        sigma_px: Vector4::new(sl, sl, sr, sr),
    }
}

impl DescribedPair {
    /// Takes on what `extractor` finds in a pair's images.
    ///
    /// # Errors
    /// The extractor's.
    pub fn describe(
        &mut self,
        extractor: &mut dyn Extractor,
        pair: &StereoPair,
    ) -> Result<(), ExtractError> {
        self.sequence = pair.sequence;
        self.timestamp_ns = pair.timestamp_ns;
        self.skew = pair.skew;
        for (side, image) in [(&mut self.left, &pair.left), (&mut self.right, &pair.right)] {
            extractor.extract(image, &mut side.features)?;
            side.take(image);
        }
        Ok(())
    }
}

/// A pair without features, to be filled.
impl From<&StereoPair> for DescribedPair {
    fn from(pair: &StereoPair) -> Self {
        Self {
            sequence: pair.sequence,
            timestamp_ns: pair.timestamp_ns,
            skew: pair.skew,
            ..Self::default()
        }
    }
}

#[cfg(all(test, feature = "opencv"))]
mod tests {
    use super::*;
    use crate::estimation::Status;
    use crate::matching::MatcherName;
    use crate::matching::synthetic::{Scene, View, rig};

    fn described(sequence: u64, [left, right]: &[View; 2]) -> DescribedPair {
        DescribedPair {
            sequence,
            timestamp_ns: 100_000_000 * sequence as i64,
            skew: Skew::default(),
            left: Described {
                features: left.features.clone(),
                ..Described::default()
            },
            right: Described {
                features: right.features.clone(),
                ..Described::default()
            },
        }
    }

    /// A pair that cannot be matched leaves no trace but that it was skipped.
    #[test]
    fn a_pair_that_flann_refuses_is_as_good_as_skipped() {
        let scene = Scene::new(1, 200, 100);
        let flann = matching::Settings {
            matcher: MatcherName::Flann,
            ..matching::Settings::default()
        };
        let two_frame = estimation::Settings {
            method: estimation::Method::Bundle,
            ..estimation::Settings::default()
        };
        let mut unlike = described(1, &scene.before);
        unlike.right.features.descriptor_len = 32;
        let run = |spoilt: bool| {
            let mut method =
                Method::new(rig(), flann.clone(), two_frame.clone()).expect("has a baseline");
            let first = method.step(&mut described(0, &scene.before));
            if spoilt {
                assert!(method.step(&mut unlike.clone()).is_err());
            }
            let skipped = method.skip(unlike.stamp());
            let last = method.step(&mut described(2, &scene.now));
            [first, Ok(skipped), last].map(|row| row.expect("matched"))
        };
        let rows = run(true);
        assert_eq!(rows[2].status, Status::Tracking);
        assert_eq!(rows[2].counts.tracks, 200);
        assert_eq!(format!("{rows:?}"), format!("{:?}", run(false)));
    }
}
