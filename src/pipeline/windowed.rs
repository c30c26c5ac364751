//! The window of keyframes: landmarks are recognised by their descriptors, which settles the motion
//! roughly and robustly; then each is sought to a fraction of a pixel where that motion puts it, and
//! the window is adjusted to what was found.

use super::gallery::{Gallery, Portrait};
use super::method::Workbench;
use super::occupancy::Occupancy;
use super::unlikeness::Unlikeness;
use crate::estimation::window::{self, Window};
use crate::estimation::{
    self, Landmark, Odometer, Odometry, PairStamp, Settings, StereoMeasurement, TrackedFeature,
};
use crate::geometry::StereoRig;
use crate::image::GrayImage;
use crate::matching::MatchError;
use crate::refinement::{self, Appearance, Pyramid, Refined, Slant};
use nalgebra::{Isometry3, Vector4};
use std::time::Instant;

/// How far a patch may be from where the motion puts it, px.
const REACH_PX: f64 = 4.0;
/// How far from the detector's position the patch of a landmark may be, px.
const TRACK_REACH_PX: f64 = 4.0;
/// How far from the detector's position a new landmark's patch may be on the right, px.
const RIGHT_REACH_PX: f64 = 3.0;
/// Pairs in a row in which a landmark may be missed before it is given up.
const MAX_MISSED: u32 = 2;
const _: () = assert!(
    (MAX_MISSED as usize) < window::UNSEEN_KEYFRAMES,
    "a landmark is looked for that the window may have retired"
);
/// New landmarks in a cell of the image at most, old ones included.
const MOST_IN_A_CELL: u32 = 8;
/// Pairs after which a landmark's vote counts in full: what has stood still for long has more of a say than what has
/// just come into view.
const SENIORITY: u32 = 4;
/// The share of the votes of recognised landmarks that a motion has to have. Below, the images show two motions, such
/// as those of a body that fills the view or of images in two parts, and which is the robot's is a guess.
const LEAST_AGREEMENT: f64 = 0.5;
/// The share above which the others' votes do not matter.
const CLEAR_AGREEMENT: f64 = 0.8;
/// The share of the others' votes that makes a second motion of them.
const COHERENT: f64 = 0.6;
/// The share below which a pair becomes no keyframe, where that can wait.
const SETTLED_AGREEMENT: f64 = 0.65;
/// Pairs for which a keyframe that is wanted waits for images that show one motion.
const MOST_POSTPONED: u32 = 2;
/// The share of the old landmarks that should be in view that has to be found.
const QUORUM: f64 = 0.2;
/// The share of the landmarks in view that are not found where the motion puts them, above which they are sought elsewhere.
const MANY_MISSING: f64 = 0.2;
/// The share of those that are found where another instant has them, above which it is one that the images show.
const MANY_THERE: f64 = 0.3;
/// The share of the sights in a pair that may prove wrong when the window is adjusted to them. Where more do, the images
/// show two motions, and what is left may be a mixture of both; else a few in a hundred do.
const MOST_WRONG: f64 = 0.2;
/// Sights that may prove wrong before a landmark is given up.
const MAX_WRONG: u32 = 1;

/// The state between pairs.
pub(super) struct Windowed {
    window: Window,
    gallery: Gallery,
    /// The left images of keyframes, by serial.
    images: Vec<(u64, Pyramid)>,
    /// Images that no keyframe needs any more.
    spare_images: Vec<Pyramid>,
    next_id: u64,
    seen: Vec<window::Seen>,
    /// The same, what the right camera saw being unsure.
    unsure: Vec<window::Seen>,
    weights: Vec<f64>,
    /// How well each of `seen` fits its landmark's patch.
    correlations: Vec<f32>,
    unlikeness: Unlikeness,
    /// Those of `seen` that do not agree with the motion, what their votes count, and those of them that agree with
    /// each other.
    others: Vec<window::Seen>,
    others_weights: Vec<f64>,
    others_agreed: Vec<u32>,
    /// Indices of those of `seen` that agree with the motion.
    agreed: Vec<u32>,
    /// The tracks that `seen` comes from.
    matches: Vec<usize>,
    /// Whether landmarks were found where the pairs before led to expect them. Far around, much is found that does not
    /// belong together.
    are_where_expected: bool,
    /// Whether most landmarks agree on the present motion.
    is_settled: bool,
    /// Pairs in a row that were no keyframe although one was wanted.
    postponed: u32,
    /// Pairs that were tracked since the window began.
    tracked_pairs: u32,
    /// Whether a stereo match of the present pair shows a landmark that is known.
    is_known: Vec<bool>,
    occupancy: Occupancy,
    candidates: Vec<usize>,
    /// Whether the newest frame of the window is the present pair.
    holds_present: bool,
    /// When the present pair was taken.
    present_ns: i64,
}

impl Windowed {
    pub(super) fn new(rig: &StereoRig, settings: &Settings) -> Self {
        // As many as the window will ever hold, so that none has to be allocated on the way.
        let mut blank = Pyramid::default();
        blank.fill(&GrayImage::filled(rig.left.width, rig.left.height, 0));
        let images = settings.keyframes as usize + 1;
        Self {
            window: Window::new(rig.clone(), settings.clone()),
            gallery: Gallery::default(),
            images: Vec::with_capacity(images),
            spare_images: vec![blank; images],
            next_id: 0,
            seen: Vec::new(),
            unsure: Vec::new(),
            weights: Vec::new(),
            correlations: Vec::new(),
            unlikeness: Unlikeness::default(),
            others: Vec::new(),
            others_weights: Vec::new(),
            others_agreed: Vec::new(),
            agreed: Vec::new(),
            matches: Vec::new(),
            are_where_expected: false,
            is_settled: false,
            postponed: 0,
            tracked_pairs: 0,
            is_known: Vec::new(),
            occupancy: Occupancy::default(),
            candidates: Vec::new(),
            holds_present: false,
            present_ns: 0,
        }
    }

    pub(super) fn step(&mut self, bench: &mut Workbench) -> Result<Odometry, MatchError> {
        self.holds_present = false;
        let stamp = bench.now.pair.stamp();
        let before_ns = std::mem::replace(&mut self.present_ns, stamp.timestamp_ns);
        let Some(mut odometer) = bench.odometer.take() else {
            let mut odometer = bench.new_odometer(stamp);
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
        let newest_from_before = odometer.predict(before_ns);
        let expected = [newest_from_before, newest_from_now];
        let row = self.track(bench, &mut odometer, &expected, stamp);
        bench.odometer = Some(odometer);
        Ok(row)
    }

    /// The landmarks that the present pair shows.
    pub(super) fn tracked(&self) -> impl Iterator<Item = TrackedFeature> + '_ {
        let newest = self.window.newest_serial().filter(|_| self.holds_present);
        self.gallery.portraits.iter().filter_map(move |portrait| {
            let landmark = self.window.landmark(portrait.id)?;
            let last = landmark.observations.last();
            let sight = last.filter(|sight| Some(sight.serial) == newest)?;
            let newest_from_anchor = self.window.newest_from_anchor(landmark)?;
            let (inverse_depth, cov) = landmark.seen_from(&newest_from_anchor)?;
            Some(TrackedFeature {
                id: portrait.id,
                age: portrait.age,
                measurement: sight.measurement,
                landmark: Landmark::from_inverse_depth(&inverse_depth, &cov)?,
            })
        })
    }

    /// Adjusts the window to the present pair, or bridges it. `expected` is where the robot should have been at the pair
    /// before, and where it should be now, seen from the newest frame.
    fn track(
        &mut self,
        bench: &mut Workbench,
        odometer: &mut Odometer,
        expected: &[Isometry3<f64>; 2],
        stamp: PairStamp,
    ) -> Odometry {
        let consent = self
            .consent(bench, &expected[1], stamp.sequence)
            .filter(|motion| odometer.is_possible(motion, stamp.timestamp_ns));
        let tracked = consent.and_then(|newest_from_now| {
            self.find_missed(bench, &newest_from_now);
            bench.matched = Some(Instant::now());
            if !self.are_seniors_there(bench) || self.shows_another_instant(bench, expected) {
                self.gallery.forget_doubts();
                return None;
            }
            self.gallery.grow_older();
            let widened = self.unlikeness.widening();
            for s in &mut self.seen {
                s.measurement.sigma_px *= widened;
            }
            self.window.add(&newest_from_now, &self.seen);
            self.window.expose(&bench.exposure);
            let most_wrong = if self.is_young() { 1.0 } else { MOST_WRONG };
            self.window.adjust(most_wrong)
        });
        let Some(tracked) = tracked else {
            return self.bridge(bench, odometer, stamp);
        };
        self.holds_present = true;
        self.tracked_pairs += 1;
        self.take_looks(bench);
        self.window.settle();
        let mut counts = bench.counts(tracked.inliers);
        counts.tracks = self.seen.len() as u32;
        let row = odometer.arrive(stamp, &tracked, counts);
        if self.wants_keyframe(bench) && self.may_promote() {
            self.promote(bench);
        }
        row
    }

    /// Begins a window with the present pair where the odometer stands.
    fn begin(&mut self, bench: &mut Workbench, odometer: &Odometer) {
        let place = odometer.last_place();
        self.window
            .begin_at(&place.odom_from_camera, &place.cov, &place.by_sources);
        self.window.expose(&bench.exposure);
        self.gallery.clear();
        self.tracked_pairs = 0;
        let images = self.images.drain(..).map(|(_, image)| image);
        self.spare_images.extend(images);
        self.is_known.clear();
        self.is_known.resize(bench.now.matches.len(), false);
        self.holds_present = true;
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
            // Where there is nothing to begin with, the window keeps the pair that it has, and so must the odometer:
            // else the next motion would be called one since this pair.
            if bench.now.matches.len() < bench.estimation.min_inliers as usize {
                return odometer.bridge(stamp, counts);
            }
            let row = odometer.begin(stamp, counts);
            self.begin(bench, odometer);
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
        self.are_where_expected = false;
        if odometer.has_velocity() {
            self.find_tracks(bench, bench.matching.search_radius_px)?;
            if bench.tracks.len() >= bench.estimation.good_inliers as usize {
                self.are_where_expected = true;
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
        let portraits = self.gallery.portraits.iter();
        let expected = portraits.map(|p| self.expected_px(&bench.rig, p, &now_from_newest));
        bench.predicted.extend(expected);
    }

    /// Where a landmark should be seen, raw px.
    fn expected_px(
        &self,
        rig: &StereoRig,
        portrait: &Portrait,
        now_from_newest: &Isometry3<f64>,
    ) -> Option<Vector4<f64>> {
        let landmark = self.window.landmark(portrait.id)?;
        let now_from_anchor = now_from_newest * self.window.newest_from_anchor(landmark)?;
        let px = estimation::seen_at(rig, &now_from_anchor, &landmark.inverse_depth)?;
        Some(self.window.expected_px(&px))
    }

    /// Seeks the patch of every recognised landmark near where the detector saw it, and finds the
    /// motion that they agree on: a patch's place is so sure that what moves by itself stands out.
    /// Each part of the image has one vote, or a body of rich texture would outvote the world. None is found where it
    /// is doubtful whose it is.
    fn consent(
        &mut self,
        bench: &mut Workbench,
        predicted: &Isometry3<f64>,
        sequence: u64,
    ) -> Option<Isometry3<f64>> {
        self.seen.clear();
        self.matches.clear();
        self.correlations.clear();
        self.occupancy.begin(&bench.rig.left);
        let now_from_newest = predicted.inverse();
        for i in 0..bench.tracks.len() {
            let track = bench.tracks[i];
            let start = bench.now.measurements[track.now as usize].px;
            let gallery_index = track.before as usize;
            let Some(found) = self.seek(
                bench,
                gallery_index,
                &now_from_newest,
                &start,
                TRACK_REACH_PX,
            ) else {
                continue;
            };
            self.gallery.portraits[gallery_index].slant = found.slant;
            self.occupancy.enter(&found.measurement.left_px());
            self.matches.push(i);
            self.correlations.push(found.correlation);
            self.seen.push(window::Seen {
                id: self.gallery.portraits[gallery_index].id,
                measurement: found.measurement,
                relief_px: found.relief_px,
            });
        }
        self.weigh(bench);
        let seed = bench.estimation.seed ^ sequence;
        let mut newest_from_now =
            self.window
                .consent(&self.seen, &self.weights, predicted, seed, &mut self.agreed);
        if self.watch(bench, newest_from_now.as_ref(), predicted, seed) {
            newest_from_now =
                self.window
                    .consent(&self.seen, &self.weights, predicted, seed, &mut self.agreed);
        }
        let newest_from_now = newest_from_now?;
        if !self.is_convincing(predicted, seed) {
            return None;
        }
        let of_agreed = self.agreed.iter().map(|&i| self.correlations[i as usize]);
        self.unlikeness.take(of_agreed);
        self.take_note(bench);
        Some(newest_from_now)
    }

    /// Whether the motion that `agreed` is for is the robot's, as far as the landmarks tell.
    fn is_convincing(&mut self, predicted: &Isometry3<f64>, seed: u64) -> bool {
        self.is_settled = self.is_young();
        if self.is_settled {
            return true;
        }
        let share = share_of(&self.agreed, &self.weights);
        self.is_settled = share >= SETTLED_AGREEMENT;
        let least = if self.are_where_expected {
            LEAST_AGREEMENT
        } else {
            0.0
        };
        share >= least && (share >= CLEAR_AGREEMENT || !self.do_others_agree(predicted, seed))
    }

    /// Whether nothing has stood still in the window for long enough to say which of two motions is the robot's.
    fn is_young(&self) -> bool {
        self.tracked_pairs < SENIORITY
    }

    /// Whether those that do not agree agree with each other: the images then show two motions.
    fn do_others_agree(&mut self, predicted: &Isometry3<f64>, seed: u64) -> bool {
        self.others.clear();
        self.others_weights.clear();
        let mut agreed = self.agreed.iter().peekable();
        for (i, (seen, weight)) in (0..).zip(self.seen.iter().zip(&self.weights)) {
            if agreed.next_if(|&&next| next == i).is_none() {
                self.others.push(*seen);
                self.others_weights.push(*weight);
            }
        }
        let motion = self.window.consent(
            &self.others,
            &self.others_weights,
            predicted,
            seed,
            &mut self.others_agreed,
        );
        motion.is_some() && share_of(&self.others_agreed, &self.others_weights) >= COHERENT
    }

    /// How much of a say each of `seen` has.
    fn weigh(&mut self, bench: &Workbench) {
        self.weights.clear();
        let seen = self.seen.iter().zip(&self.matches);
        self.weights.extend(seen.map(|(seen, &track)| {
            let portrait = &self.gallery.portraits[bench.tracks[track].before as usize];
            let in_its_part = self.occupancy.count(&seen.measurement.left_px()).max(1);
            f64::from((1 + portrait.age).min(SENIORITY)) / f64::from(in_its_part)
        }));
    }

    /// Has the watch on the rig look at the landmarks that agree with a motion. Where none was found, the right
    /// camera may have turned at once: what it sees is then taken for less sure than it is. Whether `seen` has been
    /// corrected for a turn that was found.
    fn watch(
        &mut self,
        bench: &mut Workbench,
        newest_from_now: Option<&Isometry3<f64>>,
        predicted: &Isometry3<f64>,
        seed: u64,
    ) -> bool {
        let Some(watch) = &mut bench.watch else {
            return false;
        };
        watch.begin_sights();
        let newest_from_now = newest_from_now.copied().or_else(|| {
            self.unsure.clear();
            self.unsure.extend(self.seen.iter().map(|s| {
                let mut unsure = *s;
                for sigma_px in unsure.measurement.sigma_px.iter_mut().skip(2) {
                    *sigma_px = sigma_px.hypot(watch.blow_px());
                }
                unsure
            }));
            self.window.consent(
                &self.unsure,
                &self.weights,
                predicted,
                seed,
                &mut self.agreed,
            )
        });
        let Some(newest_from_now) = newest_from_now else {
            return false;
        };
        let now_from_newest = newest_from_now.inverse();
        for &i in &self.agreed {
            let s = &self.seen[i as usize];
            watch.see(&s.measurement);
            let expected = self.window.landmark(s.id).and_then(|landmark| {
                landmark.seen_from(&self.window.newest_from_anchor(landmark)?)
            });
            if let Some(expected) = expected {
                let seen = self.window.corrected(&s.measurement);
                watch.see_landmark(&now_from_newest, &expected, &seen);
            }
        }
        let Some(more_rad) = watch.conclude_sights(bench.now.pair.timestamp_ns) else {
            return false;
        };
        for s in &mut self.seen {
            s.measurement.px -= watch.displacement_by(&more_rad, &s.measurement.px);
        }
        true
    }

    /// Takes note of who agrees with the motion and who does not; only the former stay in `seen`.
    fn take_note(&mut self, bench: &Workbench) {
        self.is_known.clear();
        self.is_known.resize(bench.now.matches.len(), false);
        for portrait in &mut self.gallery.portraits {
            portrait.found = false;
        }
        for &i in &self.matches {
            self.gallery.portraits[bench.tracks[i].before as usize].disagreed = true;
        }
        for (kept, &i) in self.agreed.iter().enumerate() {
            let track = bench.tracks[self.matches[i as usize]];
            let portrait = &mut self.gallery.portraits[track.before as usize];
            portrait.disagreed = false;
            portrait.found = true;
            self.is_known[track.now as usize] = true;
            self.seen[kept] = self.seen[i as usize];
        }
        self.seen.truncate(self.agreed.len());
    }

    /// Takes note of how the recognised landmarks look in the present pair.
    fn take_looks(&mut self, bench: &Workbench) {
        for &i in &self.agreed {
            let track = bench.tracks[self.matches[i as usize]];
            let m = bench.now.matches[track.now as usize];
            self.gallery
                .recognised(track.before as usize, &bench.now.pair, m);
        }
    }

    /// Seeks the landmarks that the detector has missed where the motion puts them, and adds what
    /// it finds to `seen`.
    fn find_missed(&mut self, bench: &mut Workbench, newest_from_now: &Isometry3<f64>) {
        self.predict(bench, newest_from_now);
        let now_from_newest = newest_from_now.inverse();
        for i in 0..self.gallery.portraits.len() {
            let portrait = &self.gallery.portraits[i];
            if portrait.found || portrait.disagreed {
                continue;
            }
            let id = portrait.id;
            let found = bench.predicted[i]
                .filter(|px| is_inside(&bench.rig, px))
                .and_then(|start| self.seek(bench, i, &now_from_newest, &start, REACH_PX));
            let portrait = &mut self.gallery.portraits[i];
            portrait.found = found.is_some();
            if let Some(found) = found {
                portrait.slant = found.slant;
                self.seen.push(window::Seen {
                    id,
                    measurement: found.measurement,
                    relief_px: found.relief_px,
                });
            }
        }
    }

    /// Whether old landmarks were found where the motion puts them, if there should be some: where something new hides
    /// the world or outshines it, they are not.
    fn are_seniors_there(&self, bench: &Workbench) -> bool {
        let (found, all) = self.found_in_view(bench, SENIORITY);
        f64::from(found) >= QUORUM * f64::from(all)
    }

    /// How many of the landmarks that were found so often before are found, and how many should be in view.
    fn found_in_view(&self, bench: &Workbench, least_age: u32) -> (u32, u32) {
        let (mut found, mut all) = (0, 0);
        for (portrait, px) in self.gallery.portraits.iter().zip(&bench.predicted) {
            if portrait.age >= least_age && px.is_some_and(|px| is_inside(&bench.rig, &px)) {
                all += 1;
                found += u32::from(portrait.found);
            }
        }
        (found, all)
    }

    /// Whether landmarks that are not where the motion puts them are where they were in the pair before, or where this
    /// one was expected to show them: a part of the images is of another instant, and which part is not is a guess.
    /// Those that no motion has found again as yet have no say: they may belong to a body that goes along with the camera.
    fn shows_another_instant(&self, bench: &Workbench, expected: &[Isometry3<f64>; 2]) -> bool {
        if self.is_young() {
            return false;
        }
        let (found, all) = self.found_in_view(bench, 1);
        if f64::from(all - found) < MANY_MISSING * f64::from(all) {
            return false;
        }
        let known = self.gallery.portraits.iter().zip(&bench.predicted);
        let missing = known
            .enumerate()
            .filter(|(_, (p, _))| p.age >= 1 && !p.found);
        expected.iter().any(|newest_from_then| {
            let then_from_newest = newest_from_then.inverse();
            let (mut there, mut all) = (0, 0);
            for (i, (portrait, now)) in missing.clone() {
                // Too near to where it was sought already, it would be of this motion as well.
                let is_apart =
                    |px: &Vector4<f64>| now.is_none_or(|now| (now - px).amax() >= REACH_PX);
                let then = self.expected_px(&bench.rig, portrait, &then_from_newest);
                let Some(then) = then.filter(|px| is_inside(&bench.rig, px) && is_apart(px)) else {
                    continue;
                };
                let found = self.seek(bench, i, &then_from_newest, &then, REACH_PX);
                all += 1;
                there += u32::from(found.is_some());
            }
            there >= bench.estimation.min_inliers && f64::from(there) >= MANY_THERE * f64::from(all)
        })
    }

    /// Where a landmark's patch is in the present pair, near `start`.
    fn seek(
        &self,
        bench: &Workbench,
        index: usize,
        now_from_newest: &Isometry3<f64>,
        start: &Vector4<f64>,
        reach_px: f64,
    ) -> Option<Refined> {
        let portrait = &self.gallery.portraits[index];
        let landmark = self.window.landmark(portrait.id)?;
        let now_from_anchor = now_from_newest * self.window.newest_from_anchor(landmark)?;
        let (_, image) = self.images.iter().find(|(s, _)| *s == portrait.anchor)?;
        let appearance = Appearance {
            image,
            px: portrait.px,
            size_px: portrait.size_px,
            slant: portrait.slant,
        };
        let y = &landmark.inverse_depth;
        let late = bench.displacement(start, &now_from_anchor, Some(y));
        let found = refinement::refine(
            &bench.rig,
            &appearance,
            y,
            &now_from_anchor,
            &bench.now.pair.pyramids(),
            &(start + late),
            reach_px,
        );
        found.map(|found| Refined {
            measurement: earlier(&found.measurement, &late),
            ..found
        })
    }

    /// Whether the window should keep the present pair.
    fn wants_keyframe(&mut self, bench: &Workbench) -> bool {
        let settings = &bench.estimation;
        self.window.survival() < settings.keyframe_survival
            || self.window.parallax_px()
                > settings.keyframe_parallax * f64::from(bench.rig.left.width)
    }

    /// Whether the present pair may be kept where a keyframe is wanted: what is new in images that show something else as
    /// well may belong to that, and would stay. Not for ever, or there would soon be nothing left to hold pairs against.
    fn may_promote(&mut self) -> bool {
        let may = self.is_settled || self.postponed >= MOST_POSTPONED;
        self.postponed = if may { 0 } else { self.postponed + 1 };
        may
    }

    /// Keeps the present pair as a keyframe, with what it shows for the first time.
    fn promote(&mut self, bench: &mut Workbench) {
        self.meet(bench);
        self.window.promote(&self.seen);
        let Some(newest) = self.window.newest_serial() else {
            return;
        };
        let window = &self.window;
        let focal_px = bench.rig.left.focal_px.x;
        for portrait in &mut self.gallery.portraits {
            // A landmark whose anchor has left the window began anew in this keyframe.
            let Some(landmark) = window.landmark(portrait.id) else {
                continue;
            };
            if landmark.anchor == newest && portrait.anchor != newest {
                portrait.anchor = newest;
                portrait.px = landmark.observations[0].measurement.left_px();
                portrait.slant = Slant::unknown(focal_px);
            }
        }
        self.gallery.retain(|p| {
            p.missed <= MAX_MISSED
                && !p.disagreed
                && window.landmark(p.id).is_some_and(|l| l.wrong <= MAX_WRONG)
        });
        let mut image = self.release_image();
        std::mem::swap(&mut image, &mut bench.now.pair.left.pyramid);
        self.images.push((newest, image));
    }

    /// Stereo matches of the present pair that show no known landmark become new ones, strong ones
    /// first and where there are few as yet, until there are enough: they are left in `seen`.
    fn meet(&mut self, bench: &Workbench) {
        self.seen.clear();
        self.occupancy.begin(&bench.rig.left);
        let tracked = self.gallery.portraits.iter().filter(|p| p.missed == 0);
        let mut room = bench.estimation.max_landmarks as usize;
        for portrait in tracked {
            if let Some(px) = self.window.newest_px(portrait.id) {
                self.occupancy.enter(&px);
                room = room.saturating_sub(1);
            }
        }
        self.order_candidates(bench);
        let candidates = std::mem::take(&mut self.candidates);
        for most in 1..=MOST_IN_A_CELL {
            for &i in &candidates {
                if self.seen.len() >= room {
                    break;
                }
                let px = bench.now.measurements[i].left_px();
                if !self.is_known[i] && self.occupancy.count(&px) < most {
                    self.is_known[i] = true;
                    if self.meet_one(bench, i) {
                        self.occupancy.enter(&px);
                    }
                }
            }
        }
        self.candidates = candidates;
    }

    /// Stereo matches by the strength of their left keypoint.
    fn order_candidates(&mut self, bench: &Workbench) {
        let keypoints = &bench.now.pair.left.features.keypoints;
        let response = |i: usize| keypoints[bench.now.matches[i].left as usize].response;
        self.candidates.clear();
        self.candidates.extend(0..bench.now.matches.len());
        self.candidates
            .sort_unstable_by(|&a, &b| response(b).total_cmp(&response(a)).then(a.cmp(&b)));
    }

    /// Makes one stereo match a new landmark, if its patch is found on the right.
    fn meet_one(&mut self, bench: &Workbench, i: usize) -> bool {
        let pair = &bench.now.pair;
        let m = bench.now.matches[i];
        let late = bench.displacement(
            &bench.now.measurements[i].px,
            &Isometry3::identity(),
            bench.now.inverse_depths[i].as_ref(),
        );
        let coarse = &earlier(&bench.now.measurements[i], &-late);
        let size_px = f64::from(pair.left.features.keypoints[m.left as usize].size_px);
        let slant = Slant::unknown(bench.rig.left.focal_px.x);
        let mut portrait = Portrait {
            id: self.next_id,
            anchor: self.window.newest_serial().unwrap_or(0),
            px: coarse.left_px(),
            size_px,
            slant,
            age: 0,
            missed: 0,
            found: true,
            disagreed: false,
        };
        let appearance = Appearance {
            image: &pair.left.pyramid,
            px: portrait.px,
            size_px,
            slant,
        };
        let right = &pair.right.pyramid;
        let found =
            refinement::refine_right(&bench.rig, &appearance, right, coarse, RIGHT_REACH_PX);
        let Some(found) = found else {
            return false;
        };
        portrait.slant = found.slant;
        self.next_id += 1;
        self.seen.push(window::Seen {
            id: portrait.id,
            measurement: earlier(&found.measurement, &late),
            relief_px: found.relief_px,
        });
        self.gallery.add(portrait, pair, m);
        true
    }

    /// An image whose keyframe has left the window, to be used again.
    fn release_image(&mut self) -> Pyramid {
        let window = &self.window;
        let gone = self
            .images
            .iter()
            .position(|(serial, _)| window.keyframe_serials().all(|s| s != *serial));
        match gone {
            Some(at) => self.images.remove(at).1,
            None => self.spare_images.pop().unwrap_or_default(),
        }
    }
}

/// The share of all votes that those of `agreed` have.
fn share_of(agreed: &[u32], weights: &[f64]) -> f64 {
    let votes: f64 = agreed.iter().map(|&i| weights[i as usize]).sum();
    votes / weights.iter().sum::<f64>().max(f64::MIN_POSITIVE)
}

/// A measurement as it would have been without the displacement `late`, px, that the skew of the
/// exposures gives it.
fn earlier(measurement: &StereoMeasurement, late: &Vector4<f64>) -> StereoMeasurement {
    StereoMeasurement {
        px: measurement.px - late,
        ..*measurement
    }
}

/// Whether both cameras see something at these positions.
fn is_inside(rig: &StereoRig, px: &Vector4<f64>) -> bool {
    rig.left.contains(&px.xy(), 0.0) && rig.right.contains(&px.fixed_rows::<2>(2).into_owned(), 0.0)
}
