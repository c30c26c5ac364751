//! From pair to pair: the motion since the last pair whose motion was measured, by the estimators
//! that look at two pairs only.

use super::method::{Seen, Workbench};
use crate::estimation::bundle::{Adjuster, TrackedPoint};
use crate::estimation::{self, MeasuredMotion, Odometer, Odometry, Status};
use crate::matching::MatchError;
use nalgebra::Isometry3;
use std::time::Instant;

/// The state between pairs.
#[derive(Default)]
pub(super) struct TwoFrame {
    reference: Seen,
    points: Vec<TrackedPoint>,
    adjuster: Adjuster,
}

impl TwoFrame {
    pub(super) fn step(&mut self, bench: &mut Workbench) -> Result<Odometry, MatchError> {
        let stamp = bench.now.pair.stamp();
        let Some(mut odometer) = bench.odometer.take() else {
            let mut odometer = Odometer::new(bench.estimation.clone(), stamp);
            let row = odometer.begin(stamp, bench.counts(0));
            bench.odometer = Some(odometer);
            std::mem::swap(&mut self.reference, &mut bench.now);
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
        let counts = bench.counts(measured.as_ref().map_or(0, |m| m.inliers));
        let row = match &measured {
            Some(motion) => odometer.advance(stamp, motion, counts),
            None if !odometer.has_tracked() && self.is_better_start(bench) => {
                odometer.begin(stamp, counts)
            }
            None if odometer.should_begin_anew() => odometer.begin_anew(stamp, counts),
            None => odometer.bridge(stamp, counts),
        };
        if row.status != Status::Lost {
            std::mem::swap(&mut self.reference, &mut bench.now);
        }
        bench.odometer = Some(odometer);
        Ok(row)
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
        let now_from_reference = reference_from_now.inverse();
        bench.predicted.clear();
        bench.predicted.extend(
            self.reference
                .inverse_depths
                .iter()
                .map(|y| estimation::seen_at(&bench.rig, &now_from_reference, &(*y)?)),
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
        self.points.clear();
        for track in &bench.tracks {
            let Some(inverse_depth) = self.reference.inverse_depths[track.before as usize] else {
                continue;
            };
            self.points.push(TrackedPoint {
                prev: self.reference.measurements[track.before as usize],
                now: bench.now.measurements[track.now as usize],
                inverse_depth,
            });
        }
        estimation::measure(
            &bench.rig,
            &self.points,
            Some(predicted),
            odometer.expected_variance_factor(),
            bench.estimation.seed ^ bench.now.pair.sequence,
            &bench.estimation,
            &mut self.adjuster,
        )
    }

    /// Whether the present pair would make a better reference than one that nothing was ever
    /// tracked from.
    fn is_better_start(&self, bench: &Workbench) -> bool {
        let enough = bench.estimation.min_inliers as usize;
        self.reference.matches.len() < enough || bench.now.matches.len() >= enough
    }
}
