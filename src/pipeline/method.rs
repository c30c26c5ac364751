//! The method: one stereo pair after the other in, one odometry row each out.
//!
//! [`Method::step`] is the whole of it. Features are extracted before, for that may be done for
//! several images at once; everything else depends on the pair before and is done in order.

use crate::capture::{Skew, StereoPair};
use crate::estimation::{
    self, Counts, MeasuredMotion, Odometer, Odometry, PairStamp, Status, StereoMeasurement,
    bundle::{Adjuster, TrackedPoint},
};
use crate::features::Features;
use crate::geometry::{Rectification, StereoRig};
use crate::matching::{
    self, MatchError, MatchedPair, StereoMatch, StereoMatcher, TemporalMatcher, Track,
};
use nalgebra::{Isometry3, Vector3, Vector4};
use std::time::{Duration, Instant};

/// A pair with the features of both its images.
#[derive(Clone, Debug, Default)]
pub struct DescribedPair {
    /// The number of the pair in its recording.
    pub sequence: u64,
    /// When the left image was taken, ns.
    pub timestamp_ns: i64,
    /// How far apart in time the two images were taken.
    pub skew: Skew,
    /// The left image's features.
    pub left: Features,
    /// The right image's features.
    pub right: Features,
}

impl DescribedPair {
    fn stamp(&self) -> PairStamp {
        PairStamp {
            sequence: self.sequence,
            timestamp_ns: self.timestamp_ns,
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
struct Seen {
    pair: DescribedPair,
    matches: Vec<StereoMatch>,
    measurements: Vec<StereoMeasurement>,
    /// (x, y, ρ) in the left camera; `None` where the sights do not meet.
    inverse_depths: Vec<Option<Vector3<f64>>>,
}

/// The state between pairs.
pub struct Method {
    rig: StereoRig,
    matching: matching::Settings,
    estimation: estimation::Settings,
    stereo_matcher: StereoMatcher,
    temporal_matcher: TemporalMatcher,
    odometer: Option<Odometer>,
    reference: Seen,
    now: Seen,
    predicted: Vec<Option<Vector4<f64>>>,
    tracks: Vec<Track>,
    points: Vec<TrackedPoint>,
    adjuster: Adjuster,
    times: StageTimes,
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
        Some(Self {
            rig,
            stereo_matcher: StereoMatcher::new(matching.clone(), rectification),
            temporal_matcher: TemporalMatcher::new(matching.clone()),
            matching,
            estimation,
            odometer: None,
            reference: Seen::default(),
            now: Seen::default(),
            predicted: Vec::new(),
            tracks: Vec::new(),
            points: Vec::new(),
            adjuster: Adjuster::default(),
            times: StageTimes::default(),
        })
    }

    /// Takes the next pair and says where the camera is.
    ///
    /// # Errors
    /// Its features could not be matched. The method stands as before the pair, which is then to be
    /// [skipped](Self::skip).
    pub fn step(&mut self, pair: &mut DescribedPair) -> Result<Odometry, MatchError> {
        std::mem::swap(&mut self.now.pair, pair);
        let stamp = self.now.pair.stamp();
        let started = Instant::now();
        self.match_left_and_right()?;
        self.triangulate();
        let Some(mut odometer) = self.odometer.take() else {
            let matched = Instant::now();
            let mut odometer = Odometer::new(self.estimation.clone(), stamp);
            let row = odometer.begin(stamp, self.counts(None));
            self.finish(odometer, true, started, matched);
            return Ok(row);
        };
        let predicted = odometer.predict(stamp.timestamp_ns);
        if let Err(e) = self.match_over_time(&odometer, &predicted) {
            self.odometer = Some(odometer);
            return Err(e);
        }
        let matched = Instant::now();
        let measured = self.measure_motion(&odometer, &predicted);
        let counts = self.counts(measured.as_ref());
        let row = match &measured {
            Some(motion) => odometer.advance(stamp, motion, counts),
            None if !odometer.has_tracked() && self.is_better_start() => {
                odometer.begin(stamp, counts)
            }
            None if odometer.should_begin_anew() => odometer.begin_anew(stamp, counts),
            None => odometer.bridge(stamp, counts),
        };
        self.finish(odometer, row.status != Status::Lost, started, matched);
        Ok(row)
    }

    /// Takes note of a pair that could not be used at all.
    pub fn skip(&mut self, stamp: PairStamp) -> Odometry {
        self.times = StageTimes::default();
        match &mut self.odometer {
            Some(odometer) if odometer.has_tracked() => odometer.bridge(stamp, Counts::default()),
            Some(odometer) => odometer.begin(stamp, Counts::default()),
            None => Odometer::new(self.estimation.clone(), stamp).begin(stamp, Counts::default()),
        }
    }

    /// How long the stages of the last [`step`](Self::step) took; zero after a
    /// [`skip`](Self::skip).
    #[must_use]
    pub fn times(&self) -> StageTimes {
        self.times
    }

    fn match_left_and_right(&mut self) -> Result<(), MatchError> {
        let seen = &mut self.now;
        self.stereo_matcher
            .find(&seen.pair.left, &seen.pair.right, &mut seen.matches)
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
        inverse_depths.clear();
        inverse_depths.extend(
            measurements
                .iter()
                .map(|m| estimation::inverse_depth(&self.rig, m)),
        );
    }

    /// Tracks from the reference to now: first near the prediction, then, if that finds too few,
    /// far around where things were.
    fn match_over_time(
        &mut self,
        odometer: &Odometer,
        predicted: &Isometry3<f64>,
    ) -> Result<(), MatchError> {
        let wide_px = self.matching.wide_search * f64::from(self.rig.left.width);
        if odometer.has_velocity() {
            self.find_tracks(predicted, self.matching.search_radius_px)?;
            if self.tracks.len() >= self.estimation.good_inliers as usize {
                return Ok(());
            }
        }
        self.find_tracks(predicted, wide_px)
    }

    fn find_tracks(
        &mut self,
        reference_from_now: &Isometry3<f64>,
        radius_px: f64,
    ) -> Result<(), MatchError> {
        let now_from_reference = reference_from_now.inverse();
        self.predicted.clear();
        self.predicted.extend(
            self.reference
                .inverse_depths
                .iter()
                .map(|y| estimation::seen_at(&self.rig, &now_from_reference, &(*y)?)),
        );
        self.temporal_matcher.find(
            self.reference.matched(),
            self.now.matched(),
            &self.predicted,
            radius_px,
            &mut self.tracks,
        )
    }

    fn measure_motion(
        &mut self,
        odometer: &Odometer,
        predicted: &Isometry3<f64>,
    ) -> Option<MeasuredMotion> {
        self.points.clear();
        for track in &self.tracks {
            let Some(inverse_depth) = self.reference.inverse_depths[track.before as usize] else {
                continue;
            };
            self.points.push(TrackedPoint {
                prev: self.reference.measurements[track.before as usize],
                now: self.now.measurements[track.now as usize],
                inverse_depth,
            });
        }
        estimation::measure(
            &self.rig,
            &self.points,
            Some(predicted),
            odometer.expected_variance_factor(),
            self.estimation.seed ^ self.now.pair.sequence,
            &self.estimation,
            &mut self.adjuster,
        )
    }

    /// Whether the present pair would make a better reference than one that nothing was ever
    /// tracked from.
    fn is_better_start(&self) -> bool {
        let enough = self.estimation.min_inliers as usize;
        self.reference.matches.len() < enough || self.now.matches.len() >= enough
    }

    fn counts(&self, measured: Option<&MeasuredMotion>) -> Counts {
        Counts {
            keypoints_left: self.now.pair.left.len() as u32,
            keypoints_right: self.now.pair.right.len() as u32,
            stereo_matches: self.now.matches.len() as u32,
            tracks: self.tracks.len() as u32,
            inliers: measured.map_or(0, |m| m.inliers),
        }
    }

    fn finish(
        &mut self,
        odometer: Odometer,
        new_reference: bool,
        started: Instant,
        matched: Instant,
    ) {
        if new_reference {
            std::mem::swap(&mut self.reference, &mut self.now);
        }
        self.odometer = Some(odometer);
        self.times = StageTimes {
            matching: matched - started,
            estimation: matched.elapsed(),
        };
    }
}

impl Seen {
    fn matched(&self) -> MatchedPair<'_> {
        MatchedPair {
            left: &self.pair.left,
            right: &self.pair.right,
            matches: &self.matches,
        }
    }
}

/// What a stereo match measured.
fn measurement(pair: &DescribedPair, m: StereoMatch) -> StereoMeasurement {
    let l = &pair.left.keypoints[m.left as usize];
    let r = &pair.right.keypoints[m.right as usize];
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
    use crate::matching::MatcherName;
    use crate::matching::synthetic::{Scene, View, rig};

    fn described(sequence: u64, [left, right]: &[View; 2]) -> DescribedPair {
        DescribedPair {
            sequence,
            timestamp_ns: 100_000_000 * sequence as i64,
            skew: Skew::default(),
            left: left.features.clone(),
            right: right.features.clone(),
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
        let mut unlike = described(1, &scene.before);
        unlike.right.descriptor_len = 32;
        let run = |spoilt: bool| {
            let mut method = Method::new(rig(), flann.clone(), estimation::Settings::default())
                .expect("has a baseline");
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
