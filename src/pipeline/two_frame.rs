//! From pair to pair: the motion since the last pair whose motion was measured, by the estimators
//! that look at two pairs only.

use super::method::{Seen, Workbench};
use crate::estimation::bundle::TrackedPoint;
use crate::estimation::sources::Exposure;
use crate::estimation::{
    self, MeasuredMotion, MotionMeter, MotionTracks, Odometer, Odometry, Settings, Status,
    TrackedFeature, Viewpoint,
};
use crate::geometry::StereoRig;
use crate::matching::MatchError;
use nalgebra::Isometry3;
use std::time::Instant;

/// The state between pairs.
pub(super) struct TwoFrame {
    reference: Seen,
    /// The track of each of the reference's stereo matches.
    reference_tracks: Vec<Thread>,
    reference_exposure: Exposure,
    next_id: u64,
    now_tracks: Vec<Thread>,
    tracked: Vec<(Thread, TrackedPoint)>,
    ids: Vec<u64>,
    points: Vec<TrackedPoint>,
    meter: MotionMeter,
    /// Whether the meter has measured the present motion.
    has_measured: bool,
}

/// A track through the pairs.
#[derive(Clone, Copy, Debug, Default)]
struct Thread {
    id: u64,
    /// Pairs that have shown it since the first that did.
    age: u32,
}

impl TwoFrame {
    pub(super) fn new(rig: &StereoRig, settings: &Settings) -> Self {
        Self {
            reference: Seen::default(),
            reference_tracks: Vec::new(),
            reference_exposure: Exposure::default(),
            next_id: 0,
            now_tracks: Vec::new(),
            tracked: Vec::new(),
            ids: Vec::new(),
            points: Vec::new(),
            meter: MotionMeter::new(rig, settings),
            has_measured: false,
        }
    }

    pub(super) fn step(&mut self, bench: &mut Workbench) -> Result<Odometry, MatchError> {
        self.has_measured = false;
        let stamp = bench.now.pair.stamp();
        let Some(mut odometer) = bench.odometer.take() else {
            let mut odometer = bench.new_odometer(stamp);
            let row = odometer.begin(stamp, bench.counts(0));
            self.become_reference(bench);
            self.meter.begin(&odometer.last_place().cov);
            bench.odometer = Some(odometer);
            return Ok(row);
        };
        let predicted = odometer.predict(stamp.timestamp_ns);
        let matched = self.match_over_time(bench, &odometer, &predicted);
        bench.matched = Some(Instant::now());
        if let Err(e) = matched {
            bench.odometer = Some(odometer);
            return Err(e);
        }
        let measured = self.measure_motion(bench, &odometer, &predicted);
        self.has_measured = measured.is_some();
        if let Some(watch) = &mut bench.watch {
            watch.begin_sights();
            for point in &self.points {
                watch.see(&point.now);
            }
            // Corrections hold from the next pair on.
            let _ = watch.conclude_sights(stamp.timestamp_ns);
        }
        let counts = bench.counts(measured.as_ref().map_or(0, |m| m.inliers));
        let row = match &measured {
            Some(motion) => odometer.advance(stamp, motion, self.meter.cov_chained(), counts),
            None if !odometer.has_tracked() && self.is_better_start(bench) => {
                odometer.begin(stamp, counts)
            }
            None if odometer.should_begin_anew() => odometer.begin_anew(stamp, counts),
            None => odometer.bridge(stamp, counts),
        };
        if row.status != Status::Lost {
            self.become_reference(bench);
        }
        if row.status == Status::Initializing {
            self.meter.begin(&odometer.last_place().cov);
        }
        bench.odometer = Some(odometer);
        Ok(row)
    }

    /// The features that the present motion was measured from.
    pub(super) fn tracked<'a>(
        &'a self,
        rig: &'a StereoRig,
    ) -> impl Iterator<Item = TrackedFeature> + 'a {
        let agreed = self.meter.agreed().filter(|_| self.has_measured);
        agreed.filter_map(|(id, point)| {
            let at = self.tracked.binary_search_by_key(&id, |(t, _)| t.id).ok()?;
            Some(TrackedFeature {
                id,
                age: self.tracked[at].0.age + 1,
                measurement: point.now,
                landmark: estimation::triangulate(rig, &point.now)?,
            })
        })
    }

    /// Makes the present pair the reference; tracks keep their numbers.
    fn become_reference(&mut self, bench: &mut Workbench) {
        self.now_tracks.clear();
        let first = self.next_id;
        let new = (first..).take(bench.now.matches.len());
        self.now_tracks.extend(new.map(|id| Thread { id, age: 0 }));
        self.next_id = first + bench.now.matches.len() as u64;
        for track in &bench.tracks {
            let (before, now) = (track.before as usize, track.now as usize);
            if let (Some(thread), Some(slot)) = (
                self.reference_tracks.get(before),
                self.now_tracks.get_mut(now),
            ) {
                *slot = Thread {
                    age: thread.age + 1,
                    ..*thread
                };
            }
        }
        std::mem::swap(&mut self.reference_tracks, &mut self.now_tracks);
        self.reference_exposure = bench.exposure;
        std::mem::swap(&mut self.reference, &mut bench.now);
    }

    /// Tracks from the reference to now: first near the prediction, then, if that finds too few,
    /// far around where things were.
    fn match_over_time(
        &mut self,
        bench: &mut Workbench,
        odometer: &Odometer,
        predicted: &Isometry3<f64>,
    ) -> Result<(), MatchError> {
        let wide_px = bench.matching.wide_search * f64::from(bench.rig.left.width);
        if odometer.has_velocity() {
            self.find_tracks(bench, predicted, bench.matching.search_radius_px)?;
            if bench.tracks.len() >= bench.estimation.good_inliers as usize {
                return Ok(());
            }
        }
        self.find_tracks(bench, predicted, wide_px)
    }

    fn find_tracks(
        &mut self,
        bench: &mut Workbench,
        reference_from_now: &Isometry3<f64>,
        radius_px: f64,
    ) -> Result<(), MatchError> {
        let now = Viewpoint::new(&bench.rig, &reference_from_now.inverse());
        bench.predicted.clear();
        bench.predicted.extend(
            self.reference
                .inverse_depths
                .iter()
                .map(|y| now.seen_at(&bench.rig, &(*y)?)),
        );
        bench.temporal_matcher.find(
            self.reference.matched(),
            bench.now.matched(),
            &bench.predicted,
            radius_px,
            &mut bench.tracks,
        )
    }

    fn measure_motion(
        &mut self,
        bench: &Workbench,
        odometer: &Odometer,
        predicted: &Isometry3<f64>,
    ) -> Option<MeasuredMotion> {
        self.tracked.clear();
        for track in &bench.tracks {
            let before = track.before as usize;
            let Some(inverse_depth) = self.reference.inverse_depths[before] else {
                continue;
            };
            let point = TrackedPoint {
                prev: self.reference.measurements[before],
                now: bench.now.measurements[track.now as usize],
                inverse_depth,
            };
            self.tracked.push((self.reference_tracks[before], point));
        }
        self.tracked.sort_unstable_by_key(|(thread, _)| thread.id);
        self.ids.clear();
        self.ids
            .extend(self.tracked.iter().map(|(thread, _)| thread.id));
        self.points.clear();
        self.points
            .extend(self.tracked.iter().map(|(_, point)| *point));
        self.meter.measure(
            &bench.rig,
            &MotionTracks {
                ids: &self.ids,
                points: &self.points,
                exposures: [self.reference_exposure, bench.exposure],
            },
            predicted,
            odometer.expected_variance_factor(),
            bench.estimation.seed ^ bench.now.pair.sequence,
        )
    }

    /// Whether the present pair would make a better reference than one that nothing was ever
    /// tracked from.
    fn is_better_start(&self, bench: &Workbench) -> bool {
        let enough = bench.estimation.min_inliers as usize;
        self.reference.matches.len() < enough || bench.now.matches.len() >= enough
    }
}
