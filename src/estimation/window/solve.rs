//! One frame more: its measurements in, the adjusted window and what it says of the frame out.

use super::super::closed_form::MotionEstimate;
use super::super::consensus::{self, Room, Search, Sighting};
use super::super::sources::{BySources, Exposure, SOURCES};
use super::datum::Datum;
use super::dispersion;
use super::landmark::{Landmark, Observation};
use super::memory::{ByUnknowns, Memory, UnknownsBySources, carried};
use super::prior::Prior;
use super::system::{At, System};
use super::viewpoints::Viewpoints;
use super::warp::WARP;
use super::{Frame, Joint, MAX_FRAMES, Seen, Tracked, Window, row_of};
use crate::geometry::definite::inverse_from_factor;
use crate::geometry::product::product;
use crate::geometry::se3;
use nalgebra::{
    Cholesky, DMatrix, DVector, Dyn, Isometry3, Matrix6, SVector, Vector2, Vector3, Vector6,
};

/// Sights prepared for the consensus, and its own working memory.
#[derive(Clone, Debug, Default)]
pub(super) struct Sightings {
    /// Which of the sights given each is.
    indices: Vec<u32>,
    prepared: Vec<Sighting>,
    room: Room,
}

/// What a step that proves to be bad is taken back to.
#[derive(Clone, Debug, Default)]
pub(super) struct State {
    cost: f64,
    warp: SVector<f64, WARP>,
    frames: Vec<Frame>,
    points: Vec<(Vector3<f64>, Vector2<f64>)>,
}

impl Sightings {
    /// Room for sights of so many landmarks.
    pub(super) fn with_room(landmarks: usize) -> Self {
        Self {
            indices: Vec::with_capacity(landmarks),
            prepared: Vec::with_capacity(landmarks),
            ..Self::default()
        }
    }
}

impl State {
    /// Room for a window of so many frames and landmarks.
    pub(super) fn with_room(frames: usize, landmarks: usize) -> Self {
        Self {
            frames: Vec::with_capacity(frames),
            points: Vec::with_capacity(landmarks),
            ..Self::default()
        }
    }
}

/// Damping beyond which no step will help.
const MAX_DAMPING: f64 = 1e3;
/// Iterations of Levenberg and Marquardt at most.
const MAX_ITERATIONS: usize = 12;
/// The gain in cost, σ², of a step that may be the last: it moves no pose by more than √(2 · 0.1) = 0.45 σ. What
/// would follow is a tenth of that at most, for steps near the end converge quadratically.
const LAST_GAIN: f64 = 1e-1;
/// Steps before the newest frame's sights are judged for the first time: while wrong ones pull, steps are
/// many and small.
const ROUGH_STEPS: usize = 1;
/// The largest squared residual that counts, over the median one: beyond it lie 0.2 % of Gaussian
/// ones (χ² with four degrees of freedom: 16.9 over 3.36).
const LARGEST_OVER_MEDIAN: f64 = 5.0;
/// Rounds of adjusting and judging the newest frame's sights.
const ROUNDS: usize = 3;

impl Window {
    /// Begins, or begins anew, with a frame that stands at `odom_from_first`, known to `cov_right`,
    /// `by_sources` of which is due to the sources of error: a keyframe without landmarks as yet. What
    /// was learnt of the rig is kept.
    pub fn begin_at(
        &mut self,
        odom_from_first: &Isometry3<f64>,
        cov_right: &Matrix6<f64>,
        by_sources: &BySources,
    ) {
        let serial = self.take_serial();
        self.datum = Datum::new(odom_from_first, cov_right, by_sources);
        self.prior = Prior::learnt(&self.warp, &self.cov_warp, &self.warp_by_sources);
        self.frames.clear();
        let landmarks = self.landmarks.drain(..);
        self.spare_sights.extend(landmarks.map(|l| l.observations));
        self.frames.push(Frame {
            serial,
            datum_from_frame: Isometry3::identity(),
            linearised: None,
            is_keyframe: true,
            landmarks: 0,
            retired_sights: 0,
            exposure: Exposure::default(),
        });
    }

    /// The motion (maps a point of the left camera now into that of the newest frame) that most of
    /// `seen`, sights of known landmarks, agree on, each with its weight; `guess` is where to look
    /// first. The indices of those that agree are left in `agreed`, ascending. Leaves the window as it
    /// is. `None` if fewer agree than the settings ask for.
    #[must_use]
    pub fn consent(
        &mut self,
        seen: &[Seen],
        weights: &[f64],
        guess: &Isometry3<f64>,
        seed: u64,
        agreed: &mut Vec<u32>,
    ) -> Option<Isometry3<f64>> {
        let mut sightings = std::mem::take(&mut self.sightings);
        self.prepare(seen, weights, &mut sightings);
        let search = Search {
            max_samples: self.settings.max_samples,
            gate: self.settings.gate_sigma2,
            variance_factor: self.variance.smoothed,
            seed,
        };
        let Sightings {
            indices,
            prepared,
            room,
        } = &mut sightings;
        let found = consensus::find_in(room, &self.rig, prepared, Some(guess), &search);
        agreed.clear();
        agreed.extend(room.inliers().iter().map(|&i| indices[i as usize]));
        self.sightings = sightings;
        found.filter(|_| agreed.len() >= self.settings.min_inliers as usize)
    }

    /// The sights whose landmark lies in front of the newest frame, for the consensus.
    fn prepare(&self, seen: &[Seen], weights: &[f64], sightings: &mut Sightings) {
        sightings.indices.clear();
        sightings.prepared.clear();
        let scale = 1.0 / self.variance.smoothed;
        let cov_warp = self.cov_warp * scale;
        for ((i, s), &weight) in (0..).zip(seen).zip(weights) {
            let moved = self.landmark(s.id).and_then(|landmark| {
                let newest_from_anchor = self.newest_from_anchor(landmark)?;
                landmark.seen_from(&newest_from_anchor)
            });
            if let Some((inverse_depth, cov)) = moved {
                sightings.indices.push(i);
                sightings.prepared.push(Sighting {
                    inverse_depth,
                    cov: cov * scale,
                    now: self.warp.corrected(&s.measurement),
                    displacement_px2: self.warp.displacement_px2(&s.measurement, &cov_warp),
                    weight,
                });
            }
        }
    }

    /// Adds the current frame, which stands at `newest_from_now`, with its sights of landmarks.
    pub fn add(&mut self, newest_from_now: &Isometry3<f64>, seen: &[Seen]) {
        let newest = self
            .frames
            .last()
            .map_or_else(Isometry3::identity, |f| f.datum_from_frame);
        let serial = self.take_serial();
        self.frames.push(Frame {
            serial,
            datum_from_frame: se3::renormalised(newest * newest_from_now),
            linearised: None,
            is_keyframe: false,
            landmarks: 0,
            retired_sights: 0,
            exposure: Exposure::default(),
        });
        for s in seen {
            if let Ok(at) = self.landmarks.binary_search_by_key(&s.id, |l| l.id) {
                self.landmarks[at].observe(serial, s);
            }
        }
    }

    /// Says how the newest frame's images were taken; at the same instant otherwise.
    pub fn expose(&mut self, exposure: &Exposure) {
        if let Some(newest) = self.frames.last_mut() {
            newest.exposure = *exposure;
        }
    }

    /// Adjusts the whole window to all sights in it, sights of the newest frame that prove to be
    /// wrong left out. `None` if these are more than the share `most_wrong`, or if the frame is not determined by what
    /// is left of it: it is then taken out again.
    pub fn adjust(&mut self, most_wrong: f64) -> Option<Tracked> {
        self.refuted.clear();
        let tracked = self.adjust_and_judge(most_wrong);
        if tracked.is_none() {
            self.drop_newest();
            return None;
        }
        for &i in &self.refuted {
            self.landmarks[i].wrong += 1;
        }
        tracked
    }

    /// Lets go of the last frame but the newest, unless it is a keyframe: its sights are forgotten,
    /// so that a standing robot sees the same keyframes for ever.
    pub fn settle(&mut self) {
        let n = self.frames.len();
        if n >= 3 && !self.frames[n - 2].is_keyframe {
            let serial = self.frames[n - 2].serial;
            self.frames.remove(n - 2);
            for landmark in &mut self.landmarks {
                landmark.forget(serial);
            }
        }
    }

    fn take_serial(&mut self) -> u64 {
        let serial = self.next_serial;
        self.next_serial += 1;
        serial
    }

    fn drop_newest(&mut self) {
        if let Some(frame) = self.frames.pop() {
            for landmark in &mut self.landmarks {
                landmark.forget(frame.serial);
            }
        }
    }

    fn adjust_and_judge(&mut self, most_wrong: f64) -> Option<Tracked> {
        self.approach();
        self.judge_newest();
        let mut factor = self.solve()?;
        for _ in 1..ROUNDS {
            if !self.judge_newest() {
                break;
            }
            self.memory.recycle(factor.unpack_dirty());
            factor = self.solve()?;
        }
        let (inliers, wrong) = (self.count_newest(), self.refuted.len() as u32);
        if f64::from(wrong) > most_wrong * f64::from(wrong + inliers) {
            self.memory.recycle(factor.unpack_dirty());
            return None;
        }
        let joint = self.joint_covariance(factor);
        let tracked = self.conclude(&joint, inliers);
        self.memory.recycle(joint);
        tracked
    }

    /// What the adjusted window says of its newest frame; what it says of the rig is kept.
    fn conclude(&mut self, joint: &Joint, inliers: u32) -> Option<Tracked> {
        if inliers < self.settings.min_inliers {
            return None;
        }
        // With the weights that the joint covariance has.
        let by_sources = self.by_sources(joint);
        let variance_factor = self.measure_variance()?;
        self.watch_dispersion(joint);
        self.variance.take(variance_factor);
        self.cov_warp = joint.fixed_view::<WARP, WARP>(0, 0).into_owned();
        self.warp_by_sources = by_sources.fixed_view::<WARP, SOURCES>(0, 0).into_owned();
        let tracked = self.tracked(joint, &by_sources, variance_factor, inliers);
        tracked.is_determined().then_some(tracked)
    }

    /// Measures once a keyframe by how much more than chance poses scatter, while all but the newest frame
    /// are keyframes: a robot that stands learns nothing of it.
    fn watch_dispersion(&mut self, joint: &Joint) {
        if self.frames.len() >= 2 {
            self.cov_second = dispersion::of_pose_given_warp(joint, 1);
        }
        if self
            .frames
            .iter()
            .rev()
            .nth(1)
            .is_some_and(|f| f.is_keyframe)
        {
            let at = At::new(&self.rig, &self.warp, &self.frames, self.variance.smoothed);
            self.dispersion.take(&at, &self.landmarks, joint);
        }
    }

    /// Goes the first steps of an adjustment.
    fn approach(&mut self) {
        self.with_working_memory(|window, system, memory| {
            if let Some(factor) = window.iterate(system, memory, ROUGH_STEPS) {
                memory.recycle(factor.unpack_dirty());
            }
        });
    }

    /// Adjusts warp, poses and landmarks; the information of warp and poses at the optimum, factored.
    fn solve(&mut self) -> Option<Cholesky<f64, Dyn>> {
        self.with_working_memory(|window, system, memory| {
            window.iterate(system, memory, MAX_ITERATIONS)
        })
    }

    /// The covariance to an information, which was factored.
    fn joint_covariance(&mut self, factor: Cholesky<f64, Dyn>) -> Joint {
        let lower = factor.unpack_dirty();
        let mut room = self.memory.square(lower.nrows());
        let mut joint = self.memory.square(lower.nrows());
        inverse_from_factor(&lower, &mut room, &mut joint);
        self.memory.recycle(lower);
        self.memory.recycle(room);
        joint
    }

    /// Lends the working memory of an adjustment, which belongs to the window.
    fn with_working_memory<T>(
        &mut self,
        work: impl FnOnce(&mut Self, &mut System, &mut Memory) -> T,
    ) -> T {
        let mut system = std::mem::take(&mut self.system);
        let mut memory = std::mem::take(&mut self.memory);
        let outcome = work(self, &mut system, &mut memory);
        self.system = system;
        self.memory = memory;
        outcome
    }

    /// Levenberg–Marquardt, `most` iterations at most; the last equations' information, factored.
    fn iterate(
        &mut self,
        system: &mut System,
        memory: &mut Memory,
        most: usize,
    ) -> Option<Cholesky<f64, Dyn>> {
        let mut damping = 0.0;
        let mut has_kept = false;
        let mut factor: Option<Cholesky<f64, Dyn>> = None;
        for _ in 0..most {
            let (mut hessian, gradient, cost) = self.equations(system, memory, damping);
            if has_kept && cost > self.kept.cost + 1e-9 * self.kept.cost.abs() {
                has_kept = false;
                memory.recycle(hessian);
                memory.recycle_vector(gradient);
                self.restore();
                damping = if damping == 0.0 { 1e-4 } else { damping * 10.0 };
                if damping > MAX_DAMPING {
                    break;
                }
                continue;
            }
            for i in 0..hessian.nrows() {
                hessian[(i, i)] *= 1.0 + damping;
            }
            let Some(cholesky) = hessian.cholesky() else {
                memory.recycle_vector(gradient);
                break;
            };
            let mut step = memory.vector(gradient.len());
            step.copy_from(&gradient);
            cholesky.solve_mut(&mut step);
            let gain = 0.5 * step.dot(&gradient);
            memory.recycle_vector(gradient);
            if step.iter().any(|v| !v.is_finite()) {
                memory.recycle(cholesky.unpack_dirty());
                memory.recycle_vector(step);
                break;
            }
            if let Some(before) = factor.replace(cholesky) {
                memory.recycle(before.unpack_dirty());
            }
            let is_done = damping == 0.0 && gain < LAST_GAIN;
            self.keep(cost);
            has_kept = true;
            self.move_frames(&step);
            damping = if damping > 1e-5 { damping * 0.1 } else { 0.0 };
            system.move_landmarks(&step, &mut self.landmarks);
            memory.recycle_vector(step);
            if is_done {
                break;
            }
        }
        factor
    }

    /// The derivative of warp and poses by each source of error.
    fn by_sources(&mut self, joint: &Joint) -> UnknownsBySources {
        let at = At::new(&self.rig, &self.warp, &self.frames, self.variance.smoothed);
        let mut right =
            self.sensitivity
                .right_side(&at, &self.errors, &self.system, &self.landmarks);
        right += self.prior.by_sources;
        let n = joint.nrows();
        let mut by_sources = UnknownsBySources::zeros();
        for (c, mut column) in by_sources.column_iter_mut().enumerate() {
            for k in 0..n {
                if right[(k, c)] != 0.0 {
                    column
                        .rows_mut(0, n)
                        .axpy(right[(k, c)], &joint.column(k), 1.0);
                }
            }
        }
        by_sources
    }

    /// The equations at the present state, the prior included, and the cost.
    pub(super) fn equations(
        &self,
        system: &mut System,
        memory: &mut Memory,
        damping: f64,
    ) -> (DMatrix<f64>, DVector<f64>, f64) {
        let at = At {
            damping,
            ..At::new(&self.rig, &self.warp, &self.frames, self.variance.smoothed)
        };
        let cost = system.build(&at, self.landmarks.iter().enumerate());
        let (mut hessian, mut gradient) = system.assemble(memory);
        let of_prior = self
            .prior
            .add_to(&self.warp, &self.frames, &mut hessian, &mut gradient);
        let of_ground = self.ground.as_ref().map_or(0.0, |ground| {
            ground.add_to(&self.frames, &mut hessian, &mut gradient)
        });
        (hessian, gradient, cost + of_prior + of_ground)
    }

    /// Notes the present state, to come back to.
    fn keep(&mut self, cost: f64) {
        self.kept.cost = cost;
        self.kept.warp = self.warp.coefficients;
        self.kept.frames.clone_from(&self.frames);
        self.kept.points.clear();
        let points = self.landmarks.iter().map(|l| (l.inverse_depth, l.relief));
        self.kept.points.extend(points);
    }

    fn restore(&mut self) {
        self.warp.coefficients = self.kept.warp;
        self.frames.clone_from(&self.kept.frames);
        for (landmark, (point, relief)) in self.landmarks.iter_mut().zip(&self.kept.points) {
            (landmark.inverse_depth, landmark.relief) = (*point, *relief);
        }
    }

    fn move_frames(&mut self, step: &DVector<f64>) {
        self.warp.step(step);
        for (i, frame) in self.frames.iter_mut().enumerate().skip(1) {
            let x: Vector6<f64> = step.fixed_rows::<6>(row_of(i)).into_owned();
            // Counted from where Jacobians are taken, so that steps add up as the prior counts them.
            let moved = match &frame.linearised {
                Some(linearised) => {
                    let offset = se3::log(&(linearised.inverse() * frame.datum_from_frame));
                    linearised * se3::exp(&(offset + x))
                }
                None => frame.datum_from_frame * se3::exp(&x),
            };
            frame.datum_from_frame = se3::renormalised(moved);
        }
    }

    /// Takes out the newest frame's sights that lie beyond the gate; whether there are any.
    fn judge_newest(&mut self) -> bool {
        let limit = self.settings.gate_sigma2 * self.variance.smoothed;
        let Some(newest) = self.newest_serial() else {
            return false;
        };
        let mut viewpoints = std::mem::take(&mut self.viewpoints);
        viewpoints.begin(self.frames.len());
        let refuted = self.refuted.len();
        for i in 0..self.landmarks.len() {
            let landmark = &self.landmarks[i];
            let Some(last) = landmark.observations.last() else {
                continue;
            };
            if last.serial != newest || landmark.anchor == newest {
                continue;
            }
            let judged = self.squared_sigmas(&mut viewpoints, landmark, last);
            if judged.is_none_or(|e| e > limit) {
                self.landmarks[i].forget(newest);
                self.refuted.push(i);
            }
        }
        self.viewpoints = viewpoints;
        self.refuted.len() > refuted
    }

    /// Squared residual, σ², of one sight of a landmark.
    fn squared_sigmas(
        &self,
        viewpoints: &mut Viewpoints,
        landmark: &Landmark,
        sight: &Observation,
    ) -> Option<f64> {
        let anchor = self.frame_index(landmark.anchor)?;
        let frame = self.frame_index(sight.serial)?;
        let from = viewpoints.of(&self.rig, &self.frames, anchor, frame);
        let seen = from.seen_at(&self.rig, &landmark.inverse_depth)?;
        let m = self.warp.corrected(&sight.measurement);
        let residual = m.px - seen - sight.by_relief(&landmark.relief);
        Some(residual.component_div(&m.sigma_px).norm_squared())
    }

    fn count_newest(&self) -> u32 {
        let newest = self.newest_serial();
        let seen = |l: &&Landmark| Some(l.last_seen()) == newest;
        self.landmarks.iter().filter(seen).count() as u32
    }

    /// Squared residuals of all that the newest frame's landmarks were seen as, over their degrees
    /// of freedom: four coordinates a sight, less the unknowns of a landmark, less six for each
    /// frame's pose, in the share of its sights that count here. Large ones, compared with the
    /// median, count no more than a Gaussian's largest.
    fn measure_variance(&mut self) -> Option<f64> {
        let newest = self.newest_serial()?;
        let mut freedom = 0.0;
        let mut counted = [[0_u32; 2]; MAX_FRAMES];
        for ([_, all], frame) in counted.iter_mut().zip(&self.frames) {
            *all = frame.retired_sights;
        }
        let mut viewpoints = std::mem::take(&mut self.viewpoints);
        viewpoints.begin(self.frames.len());
        let mut squares = std::mem::take(&mut self.squares);
        squares.clear();
        for landmark in &self.landmarks {
            let counts = landmark.last_seen() == newest && landmark.observations.len() > 1;
            for o in &landmark.observations {
                if let Some(frame) = self.frame_index(o.serial) {
                    counted[frame][1] += 1;
                    counted[frame][0] += u32::from(counts);
                }
                if !counts {
                    continue;
                }
                if let Some(e) = self.squared_sigmas(&mut viewpoints, landmark, o) {
                    squares.push(e);
                    freedom += 4.0;
                }
            }
            if counts {
                freedom -= landmark.settled;
            }
        }
        self.viewpoints = viewpoints;
        for [here, all] in &counted[1..] {
            freedom -= 6.0 * f64::from(*here) / f64::from((*all).max(1));
        }
        let factor = (freedom > 0.0).then(|| {
            let middle = squares.len() / 2;
            let median = *squares.select_nth_unstable_by(middle, f64::total_cmp).1;
            let limit = LARGEST_OVER_MEDIAN * median;
            squares.iter().map(|e| e.min(limit)).sum::<f64>() / freedom
        });
        self.squares = squares;
        factor
    }

    fn tracked(
        &self,
        joint: &Joint,
        by_sources: &UnknownsBySources,
        variance_factor: f64,
        inliers: u32,
    ) -> Tracked {
        let n = self.frames.len();
        let newest = self.frames[n - 1].datum_from_frame;
        let before = self.frames[n - 2].datum_from_frame;
        let prev_from_now = before.inverse() * newest;
        // x_now − Ad(now_from_prev) x_prev; the datum has no error of its own here.
        let mut by_window = ByUnknowns::zeros();
        by_window
            .fixed_columns_mut::<6>(row_of(n - 1))
            .copy_from(&Matrix6::identity());
        if n >= 3 {
            by_window
                .fixed_columns_mut::<6>(row_of(n - 2))
                .copy_from(&-se3::adjoint(&prev_from_now.inverse()));
        }
        let cov = carried(&by_window, joint);
        Tracked {
            odom_from_now: self.odom_from_newest(),
            cov_pose_right: self.pose_covariance(&newest, joint),
            pose_by_sources: self
                .datum
                .sensitivity_of(&newest, joint.nrows(), by_sources),
            motion_by_sources: product(&by_window, by_sources),
            motion: MotionEstimate {
                prev_from_now,
                cov_right: se3::symmetric(&cov),
            },
            variance_factor,
            inliers,
            departure: self
                .ground
                .as_ref()
                .and_then(|ground| ground.departure_of_last(&self.frames, joint)),
        }
    }
}
