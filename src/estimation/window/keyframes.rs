//! Keyframes: which frames stay in the window, and how the oldest leaves it.

use super::super::sources::BySources;
use super::memory::{ByUnknowns, Unknowns, UnknownsBySources};
use super::system::At;
use super::warp::WARP;
use super::{
    Landmark, MAX_FRAMES, MAX_UNKNOWNS, Observation, Seen, Settings, Window, frames_of, row_of,
};
use crate::geometry::product::{product, product_transposed, transposed_product};
use crate::geometry::se3;
use nalgebra::{DMatrix, DVector, Isometry3, Matrix6, SMatrix, Vector2, Vector6};

impl Window {
    /// Makes the newest frame a keyframe, `new` what it sees for the first time. Where the window
    /// is full its oldest keyframe is marginalised.
    ///
    /// None of `new` may be a landmark that the window holds.
    pub fn promote(&mut self, new: &[Seen]) {
        let Some(newest) = self.frames.last().map(|f| f.serial) else {
            return;
        };
        if self.frames.len() > self.settings.keyframes as usize {
            self.marginalise_oldest(newest);
        }
        for s in new {
            let calibrated = self.warp.corrected(&s.measurement);
            let met = Landmark::new(&self.rig, s.id, newest, s.measurement, &calibrated);
            if let Some(landmark) = met {
                let sights = self
                    .spare_sights
                    .pop()
                    .unwrap_or_else(|| room_for_sights(&self.settings));
                let first = Observation::new(newest, s);
                self.landmarks
                    .push(landmark.with_first_sight(sights, first));
            }
        }
        // An id may come back after its landmark was given up.
        self.landmarks.sort_unstable_by_key(|l| l.id);
        self.retire_landmarks();
        let seen = self
            .landmarks
            .iter()
            .filter(|l| l.last_seen() == newest)
            .count();
        if let Some(frame) = self.frames.last_mut() {
            frame.is_keyframe = true;
            frame.landmarks = seen;
        }
    }

    /// The share of the landmarks of the newest keyframe that the newest frame still sees.
    #[must_use]
    pub fn survival(&self) -> f64 {
        let Some(newest) = self.newest_serial() else {
            return 0.0;
        };
        let Some(keyframe) = self.frames.iter().rev().find(|f| f.is_keyframe) else {
            return 0.0;
        };
        let seen = self
            .landmarks
            .iter()
            .filter(|l| l.last_seen() == newest && l.saw(keyframe.serial))
            .count();
        seen as f64 / keyframe.landmarks.max(1) as f64
    }

    /// How far the landmarks that the newest frame and the last keyframe both saw have moved in the
    /// left image: the median, px.
    #[must_use]
    pub fn parallax_px(&mut self) -> f64 {
        let (Some(newest), Some(keyframe)) = (
            self.newest_serial(),
            self.frames.iter().rev().find(|f| f.is_keyframe),
        ) else {
            return 0.0;
        };
        let left_px = |l: &Landmark, serial: u64| {
            let seen = l.observations.iter().find(|o| o.serial == serial)?;
            Some(seen.measurement.left_px())
        };
        let moved = &mut self.squares;
        moved.clear();
        moved.extend(
            self.landmarks
                .iter()
                .filter_map(|l| Some((left_px(l, newest)? - left_px(l, keyframe.serial)?).norm())),
        );
        if moved.is_empty() {
            return 0.0;
        }
        let middle = moved.len() / 2;
        *moved.select_nth_unstable_by(middle, f64::total_cmp).1
    }

    /// Takes the oldest keyframe out, with the landmarks anchored there: what they say of the other
    /// poses stays as the prior. Those that the newest frame sees begin anew there, with that sight
    /// alone, which the prior therefore does not get.
    fn marginalise_oldest(&mut self, newest: u64) {
        if self.frames.len() < 3 {
            return;
        }
        let oldest = self.frames[0].serial;
        let leaving = |l: &Landmark| l.anchor == oldest;
        let (mut hessian, mut gradient, mut by_sources) = self.said_by(leaving, Some(newest));
        if let Some(ground) = &self.ground {
            ground.add_to(&self.frames[..2], &mut hessian, &mut gradient);
        }
        self.count_from_linearised(&hessian, &mut gradient);
        let m = self.prior.vector.len();
        let mut top = hessian.view_mut((0, 0), (m, m));
        top += &self.prior.information;
        let mut head = gradient.rows_mut(0, m);
        head += &self.prior.vector;
        by_sources += self.prior.by_sources;
        self.move_datum(&hessian, &gradient, &by_sources);
        self.memory.recycle(hessian);
        self.memory.recycle_vector(gradient);
        self.restart_landmarks(oldest, newest);
    }

    /// What those of the landmarks that are `leaving` say of warp and poses, these standing where they do:
    /// information, right side, and by how much that moves with each source of error. `without` is a frame
    /// whose sights are left out.
    pub(super) fn said_by(
        &mut self,
        leaving: impl Fn(&Landmark) -> bool,
        without: Option<u64>,
    ) -> (DMatrix<f64>, DVector<f64>, UnknownsBySources) {
        let mut system = std::mem::take(&mut self.system);
        let at = At {
            without,
            ..At::new(&self.rig, &self.warp, &self.frames, self.variance.smoothed)
        };
        let leaving = self
            .landmarks
            .iter()
            .enumerate()
            .filter(|(_, l)| leaving(l));
        system.build(&at, leaving);
        let (hessian, gradient) = system.assemble(&mut self.memory);
        let by_sources = self
            .sensitivity
            .right_side(&at, &self.errors, &system, &self.landmarks);
        self.system = system;
        (hessian, gradient, by_sources)
    }

    /// Takes a right side from "at the current poses" to "counted from where they are linearised", as the
    /// prior's is.
    pub(super) fn count_from_linearised(
        &self,
        hessian: &DMatrix<f64>,
        gradient: &mut DVector<f64>,
    ) {
        let offsets = self.prior.offsets(&self.warp, &self.frames);
        for (column, offset) in hessian.column_iter().zip(&offsets) {
            gradient.axpy(*offset, &column, 1.0);
        }
    }

    /// Expresses everything relative to frame 1 and eliminates its pose.
    fn move_datum(
        &mut self,
        hessian: &DMatrix<f64>,
        gradient: &DVector<f64>,
        by_sources: &UnknownsBySources,
    ) {
        let first_linearised = *self.frames[1].datum_from_linearised();
        let all = row_of(self.frames.len());
        // xᵢ = x'ᵢ + Ad(frame i ← frame 1) x₁.
        let mut moved = [Matrix6::zeros(); MAX_FRAMES];
        let mut along = OfPose::zeros();
        along
            .fixed_rows_mut::<6>(row_of(1))
            .copy_from(&Matrix6::identity());
        for (i, f) in self.frames[2..].iter().enumerate() {
            moved[i] = se3::adjoint(&(f.datum_from_linearised().inverse() * first_linearised));
            along
                .fixed_rows_mut::<6>(row_of(i + 2))
                .copy_from(&moved[i]);
        }
        let moved = &moved[..self.frames.len() - 2];
        let by_first = hessian_times(hessian, &along);
        let first: Matrix6<f64> = transposed_product(&along, &by_first);
        let mut full_gradient = Unknowns::zeros();
        full_gradient.rows_mut(0, all).copy_from(gradient);
        let first_gradient: Vector6<f64> = transposed_product(&along, &full_gradient);
        // Without anything that holds frame 1 nothing can be handed on; the datum's own
        // uncertainty then has to grow beyond bounds, which the ridge expresses.
        let cov_first = invert_or_ridge(&se3::symmetric(&first));
        let mean = cov_first * first_gradient;
        let first_by_sources: BySources = transposed_product(&along, by_sources);
        let mean_by_sources: BySources = product(&cov_first, &first_by_sources);
        let cross = without_first(&by_first);
        let by_rest: ByUnknowns = -product_transposed(&cov_first, &cross);
        // The newest frame, last in the window, took no part.
        let known = all - 12;
        let mut information = self.memory.square(known);
        for j in 0..known {
            for i in 0..known {
                let through_first: f64 = (0..6).map(|k| cross[(i, k)] * by_rest[(k, j)]).sum();
                information[(i, j)] = hessian[(old_row(i), old_row(j))] + through_first;
            }
        }
        symmetrise(&mut information);
        self.memory
            .recycle(std::mem::replace(&mut self.prior.information, information));
        let mut vector = self.memory.vector(known);
        let mut kept_by_sources = UnknownsBySources::zeros();
        for i in 0..known {
            let cross = cross.row(i);
            vector[i] = gradient[old_row(i)] - (cross * mean)[0];
            let row = by_sources.row(old_row(i)) - cross * mean_by_sources;
            kept_by_sources.set_row(i, &row);
        }
        self.memory
            .recycle_vector(std::mem::replace(&mut self.prior.vector, vector));
        self.prior.by_sources = kept_by_sources;
        self.datum.advance(
            &self.frames,
            moved,
            &mean,
            &mean_by_sources,
            &by_rest,
            &cov_first,
        );
        self.datum.add(&self.beyond_chance(&self.cov_second));
        let first = self.frames[1].datum_from_frame;
        self.frames.remove(0);
        let last = self.frames.len() - 1;
        for (i, frame) in self.frames.iter_mut().enumerate() {
            // Renormalised, or what rounding does to the quaternions' length would double with every
            // keyframe that leaves.
            let linearised =
                se3::renormalised(first_linearised.inverse() * frame.datum_from_linearised());
            frame.linearised = (0 < i && i < last).then_some(linearised);
            frame.datum_from_frame = se3::renormalised(first.inverse() * frame.datum_from_frame);
        }
        self.frames[0].datum_from_frame = Isometry3::identity();
    }

    fn restart_landmarks(&mut self, oldest: u64, newest: u64) {
        let (rig, warp) = (&self.rig, &self.warp);
        let spare = &mut self.spare_sights;
        self.landmarks.retain_mut(|landmark| {
            if landmark.anchor != oldest {
                return true;
            }
            let sights = std::mem::take(&mut landmark.observations);
            let last = sights.last().filter(|o| o.serial == newest).copied();
            let anew = last.and_then(|last| {
                let calibrated = warp.corrected(&last.measurement);
                Landmark::new(rig, landmark.id, newest, last.measurement, &calibrated)
            });
            match (anew, last) {
                (Some(anew), Some(last)) => {
                    let first = Observation {
                        relief_px: Vector2::zeros(),
                        ..last
                    };
                    *landmark = anew.with_first_sight(sights, first);
                    true
                }
                _ => {
                    spare.push(sights);
                    false
                }
            }
        });
    }
}

/// A row for each unknown, a column for each of one pose.
type OfPose = SMatrix<f64, MAX_UNKNOWNS, 6>;

/// `hessian · along`.
fn hessian_times(hessian: &DMatrix<f64>, along: &OfPose) -> OfPose {
    let n = hessian.nrows();
    let mut out = OfPose::zeros();
    for (c, mut column) in out.column_iter_mut().enumerate() {
        for k in 0..n {
            column
                .rows_mut(0, n)
                .axpy(along[(k, c)], &hessian.column(k), 1.0);
        }
    }
    out
}

/// Where an unknown stood before frame 1 became the datum.
fn old_row(row: usize) -> usize {
    if row < WARP { row } else { row + 6 }
}

/// The same without the rows of frame 1.
fn without_first(of_pose: &OfPose) -> OfPose {
    let mut out = OfPose::zeros();
    for i in 0..MAX_UNKNOWNS - 6 {
        out.set_row(i, &of_pose.row(old_row(i)));
    }
    out
}

fn symmetrise(matrix: &mut DMatrix<f64>) {
    for j in 0..matrix.ncols() {
        for i in 0..j {
            let mean = 0.5 * (matrix[(i, j)] + matrix[(j, i)]);
            matrix[(i, j)] = mean;
            matrix[(j, i)] = mean;
        }
    }
}

/// A list of sights that never has to grow: every keyframe's, the last frame's and the current one's.
pub(super) fn room_for_sights(settings: &Settings) -> Vec<Observation> {
    Vec::with_capacity(frames_of(settings))
}

/// σ of a pose that nothing holds: m or rad.
const UNBOUND_SIGMA: f64 = 1e3;

fn invert_or_ridge(information: &Matrix6<f64>) -> Matrix6<f64> {
    if let Some(cholesky) = information.cholesky() {
        return cholesky.inverse();
    }
    let ridge = Matrix6::identity() / (UNBOUND_SIGMA * UNBOUND_SIGMA);
    (information + ridge)
        .try_inverse()
        .map_or(Matrix6::identity() * (UNBOUND_SIGMA * UNBOUND_SIGMA), |m| {
            se3::symmetric(&m)
        })
}
