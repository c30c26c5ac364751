//! The window of keyframes: landmarks are recognised by their descriptors, which settles the motion
//! roughly and robustly; then each is sought to a fraction of a pixel where that motion puts it, and
//! the window is adjusted to what was found.

use super::gallery::{Gallery, Portrait};
use super::method::Workbench;
use crate::estimation::window::{self, Window};
use crate::estimation::{self, Odometer, Odometry, PairStamp, Settings};
use crate::geometry::StereoRig;
use crate::matching::MatchError;
use crate::refinement::{self, Appearance, Pyramid};
use nalgebra::{Isometry3, Vector4};
use std::time::Instant;

/// How far a patch may be from where the motion puts it, px.
const REACH_PX: f64 = 4.0;
/// How far from the detector's position a new landmark's patch may be on the right, px.
const RIGHT_REACH_PX: f64 = 3.0;
/// Pairs in a row in which a landmark may be missed before it is given up.
const MAX_MISSED: u32 = 2;
/// Sights that may prove wrong before a landmark is given up.
const MAX_WRONG: u32 = 1;

/// The state between pairs.
pub(super) struct Windowed {
    window: Window,
    gallery: Gallery,
    /// The left images of keyframes, by serial.
    images: Vec<(u64, Pyramid)>,
    next_id: u64,
    seen: Vec<window::Seen>,
    /// Whether a stereo match of the present pair shows a landmark that is known.
    is_known: Vec<bool>,
}

impl Windowed {
    pub(super) fn new(rig: &StereoRig, settings: &Settings) -> Self {
        Self {
            window: Window::new(rig.clone(), settings.clone()),
            gallery: Gallery::default(),
            images: Vec::new(),
            next_id: 0,
            seen: Vec::new(),
            is_known: Vec::new(),
        }
    }

    pub(super) fn step(&mut self, bench: &mut Workbench) -> Result<Odometry, MatchError> {
        let stamp = bench.now.pair.stamp();
        let Some(mut odometer) = bench.odometer.take() else {
            let mut odometer = Odometer::new(bench.estimation.clone(), stamp);
            let row = odometer.begin(stamp, bench.counts(0));
            self.begin(bench, &odometer);
            bench.odometer = Some(odometer);
            return Ok(row);
        };
        let newest_from_now = odometer.predict(stamp.timestamp_ns);
        if let Err(e) = self.recognise(bench, &odometer, &newest_from_now) {
            bench.odometer = Some(odometer);
            return Err(e);
        }
        let row = self.track(bench, &mut odometer, &newest_from_now, stamp);
        bench.odometer = Some(odometer);
        Ok(row)
    }

    /// Adjusts the window to the present pair, or bridges it.
    fn track(
        &mut self,
        bench: &mut Workbench,
        odometer: &mut Odometer,
        predicted: &Isometry3<f64>,
        stamp: PairStamp,
    ) -> Odometry {
        let consent = self.consent(bench, predicted, stamp.sequence);
        let tracked = consent.and_then(|newest_from_now| {
            self.refine(bench, &newest_from_now);
            bench.matched = Some(Instant::now());
            self.window.add(&newest_from_now, &self.seen);
            self.window.adjust()
        });
        let Some(tracked) = tracked else {
            return self.bridge(bench, odometer, stamp);
        };
        self.window.settle();
        let counts = bench.counts(tracked.inliers);
        let row = odometer.arrive(stamp, &tracked, counts);
        if self.wants_keyframe(bench) {
            self.promote(bench);
        }
        row
    }

    /// Begins a window with the present pair where the odometer stands.
    fn begin(&mut self, bench: &mut Workbench, odometer: &Odometer) {
        let (odom_from_now, cov) = odometer.last_place();
        self.window.begin_at(&odom_from_now, &cov);
        self.gallery.clear();
        self.images.clear();
        self.is_known.clear();
        self.is_known.resize(bench.now.matches.len(), false);
        self.promote(bench);
    }

    /// The row of a pair whose motion could not be measured.
    fn bridge(
        &mut self,
        bench: &mut Workbench,
        odometer: &mut Odometer,
        stamp: PairStamp,
    ) -> Odometry {
        let counts = bench.counts(0);
        if !odometer.has_tracked() {
            let row = odometer.begin(stamp, counts);
            if bench.now.matches.len() >= bench.estimation.min_inliers as usize {
                self.begin(bench, odometer);
            }
            return row;
        }
        if odometer.should_begin_anew() {
            let row = odometer.begin_anew(stamp, counts);
            self.begin(bench, odometer);
            return row;
        }
        odometer.bridge(stamp, counts)
    }

    /// Finds landmarks again by their descriptors: first near the prediction, then, if that finds
    /// too few, far around.
    fn recognise(
        &mut self,
        bench: &mut Workbench,
        odometer: &Odometer,
        newest_from_now: &Isometry3<f64>,
    ) -> Result<(), MatchError> {
        self.predict(bench, newest_from_now);
        let wide_px = bench.matching.wide_search * f64::from(bench.rig.left.width);
        if odometer.has_velocity() {
            self.find_tracks(bench, bench.matching.search_radius_px)?;
            if bench.tracks.len() >= bench.estimation.good_inliers as usize {
                return Ok(());
            }
        }
        self.find_tracks(bench, wide_px)
    }

    fn find_tracks(&mut self, bench: &mut Workbench, radius_px: f64) -> Result<(), MatchError> {
        bench.temporal_matcher.find(
            self.gallery.matched(),
            bench.now.matched(),
            &bench.predicted,
            radius_px,
            &mut bench.tracks,
        )
    }

    /// Where each landmark of the gallery should be seen.
    fn predict(&self, bench: &mut Workbench, newest_from_now: &Isometry3<f64>) {
        let now_from_newest = newest_from_now.inverse();
        bench.predicted.clear();
        bench
            .predicted
            .extend(self.gallery.portraits.iter().map(|p| {
                let landmark = self.window.landmark(p.id)?;
                let now_from_anchor = now_from_newest * self.window.newest_from_anchor(landmark)?;
                let px =
                    estimation::seen_at(&bench.rig, &now_from_anchor, &landmark.inverse_depth)?;
                Some(self.window.expected_px(&px))
            }));
    }

    /// The motion that the recognised landmarks agree on.
    fn consent(
        &mut self,
        bench: &mut Workbench,
        predicted: &Isometry3<f64>,
        sequence: u64,
    ) -> Option<Isometry3<f64>> {
        self.seen.clear();
        self.seen.extend(bench.tracks.iter().map(|t| window::Seen {
            id: self.gallery.portraits[t.before as usize].id,
            measurement: bench.now.measurements[t.now as usize],
        }));
        let seed = bench.estimation.seed ^ sequence;
        let consent = self.window.consent(&self.seen, predicted, seed)?;
        self.is_known.clear();
        self.is_known.resize(bench.now.matches.len(), false);
        for &i in &consent.inliers {
            let track = bench.tracks[i as usize];
            self.is_known[track.now as usize] = true;
            let (pair, m) = (&bench.now.pair, bench.now.matches[track.now as usize]);
            self.gallery.recognised(track.before as usize, pair, m);
        }
        Some(consent.newest_from_now)
    }

    /// Seeks every landmark of the gallery where the motion puts it; what was found is in `seen`.
    fn refine(&mut self, bench: &mut Workbench, newest_from_now: &Isometry3<f64>) {
        self.predict(bench, newest_from_now);
        let now_from_newest = newest_from_now.inverse();
        let images = bench.now.pair.pyramids();
        self.seen.clear();
        for (portrait, predicted) in self.gallery.portraits.iter_mut().zip(&bench.predicted) {
            let found = predicted
                .filter(|px| is_inside(&bench.rig, px))
                .and_then(|start| {
                    let landmark = self.window.landmark(portrait.id)?;
                    let now_from_anchor =
                        now_from_newest * self.window.newest_from_anchor(landmark)?;
                    let (_, image) = self.images.iter().find(|(s, _)| *s == portrait.anchor)?;
                    let appearance = Appearance {
                        image,
                        px: portrait.px,
                        size_px: portrait.size_px,
                    };
                    refinement::refine(
                        &bench.rig,
                        &appearance,
                        &landmark.inverse_depth,
                        &now_from_anchor,
                        &images,
                        &start,
                        REACH_PX,
                    )
                });
            match found {
                Some(measurement) => {
                    portrait.missed = 0;
                    self.seen.push(window::Seen {
                        id: portrait.id,
                        measurement,
                    });
                }
                None => portrait.missed += 1,
            }
        }
    }

    /// Whether the window should keep the present pair.
    fn wants_keyframe(&self, bench: &Workbench) -> bool {
        let settings = &bench.estimation;
        self.window.survival() < settings.keyframe_survival
            || self.window.parallax_px()
                > settings.keyframe_parallax * f64::from(bench.rig.left.width)
    }

    /// Keeps the present pair as a keyframe, with what it shows for the first time.
    fn promote(&mut self, bench: &mut Workbench) {
        self.meet(bench);
        self.window.promote(&self.seen);
        let Some(newest) = self.window.newest_serial() else {
            return;
        };
        let window = &self.window;
        for portrait in &mut self.gallery.portraits {
            // A landmark whose anchor has left the window began anew in this keyframe.
            let Some(landmark) = window.landmark(portrait.id) else {
                continue;
            };
            if landmark.anchor == newest && portrait.anchor != newest {
                portrait.anchor = newest;
                portrait.px = landmark.observations[0].measurement.left_px();
            }
        }
        self.gallery.retain(|p| {
            p.missed <= MAX_MISSED && window.landmark(p.id).is_some_and(|l| l.wrong <= MAX_WRONG)
        });
        let mut image = self.release_image();
        std::mem::swap(&mut image, &mut bench.now.pair.left.pyramid);
        self.images.push((newest, image));
    }

    /// The stereo matches of the present pair that show no known landmark become new ones: they are
    /// left in `seen`.
    fn meet(&mut self, bench: &Workbench) {
        self.seen.clear();
        let pair = &bench.now.pair;
        let serial = self.window.newest_serial().unwrap_or(0);
        for (i, known) in self.is_known.iter().enumerate() {
            if *known {
                continue;
            }
            let coarse = &bench.now.measurements[i];
            let m = bench.now.matches[i];
            let size_px = f64::from(pair.left.features.keypoints[m.left as usize].size_px);
            let portrait = Portrait {
                id: self.next_id,
                anchor: serial,
                px: coarse.left_px(),
                size_px,
                missed: 0,
            };
            let appearance = Appearance {
                image: &pair.left.pyramid,
                px: portrait.px,
                size_px,
            };
            let Some(measurement) = refinement::refine_right(
                &bench.rig,
                &appearance,
                &pair.right.pyramid,
                coarse,
                RIGHT_REACH_PX,
            ) else {
                continue;
            };
            self.next_id += 1;
            self.seen.push(window::Seen {
                id: portrait.id,
                measurement,
            });
            self.gallery.add(portrait, pair, m);
        }
    }

    /// An image whose keyframe has left the window, to be used again.
    fn release_image(&mut self) -> Pyramid {
        let window = &self.window;
        let gone = self
            .images
            .iter()
            .position(|(serial, _)| window.keyframe_serials().all(|s| s != *serial));
        gone.map_or_else(Pyramid::default, |at| self.images.remove(at).1)
    }
}

/// Whether both cameras see something at these positions.
fn is_inside(rig: &StereoRig, px: &Vector4<f64>) -> bool {
    rig.left.contains(&px.xy(), 0.0) && rig.right.contains(&px.fixed_rows::<2>(2).into_owned(), 0.0)
}
