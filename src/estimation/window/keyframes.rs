//! Keyframes: which frames stay in the window, and how the oldest leaves it.

use super::super::sources::{BySources, SOURCES};
use super::system::At;
use super::{Landmark, Seen, Window, row_of};
use crate::geometry::se3;
use nalgebra::{DMatrix, DVector, Isometry3, Matrix6, Matrix6xX, MatrixXx6, Vector6};

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
            self.landmarks.extend(Landmark::new(
                &self.rig,
                s.id,
                newest,
                s.measurement,
                &calibrated,
            ));
        }
        // An id may come back after its landmark was given up.
        self.landmarks.sort_by_key(|l| l.id);
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
    pub fn parallax_px(&self) -> f64 {
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
        let mut moved: Vec<f64> = self
            .landmarks
            .iter()
            .filter_map(|l| Some((left_px(l, newest)? - left_px(l, keyframe.serial)?).norm()))
            .collect();
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
        let mut system = std::mem::take(&mut self.system);
        let leaving = self
            .landmarks
            .iter()
            .enumerate()
            .filter(|(_, l)| l.anchor == oldest);
        let at = At {
            rig: &self.rig,
            warp: &self.warp,
            frames: &self.frames,
            without: Some(newest),
            variance_factor: self.variance.smoothed,
            damping: 0.0,
        };
        system.build(&at, leaving);
        let (mut hessian, mut gradient) = system.assemble();
        let mut by_sources =
            self.sensitivity
                .right_side(&at, &self.errors, &system, &self.landmarks);
        self.system = system;
        if let Some(ground) = &self.ground {
            ground.add_to(&self.frames[..2], &mut hessian, &mut gradient);
        }
        // From "at the current poses" to "counted from where they are linearised".
        let offsets = self.prior.offsets(&self.warp, &self.frames);
        gradient += &hessian * offsets;
        let m = self.prior.vector.len();
        let mut top = hessian.view_mut((0, 0), (m, m));
        top += &self.prior.information;
        let mut head = gradient.rows_mut(0, m);
        head += &self.prior.vector;
        let mut head = by_sources.rows_mut(0, m);
        head += &self.prior.by_sources;
        self.move_datum(&hessian, &gradient, &by_sources);
        self.restart_landmarks(oldest, newest);
    }

    /// Expresses everything relative to frame 1 and eliminates its pose.
    fn move_datum(
        &mut self,
        hessian: &DMatrix<f64>,
        gradient: &DVector<f64>,
        by_sources: &DMatrix<f64>,
    ) {
        let first_linearised = *self.frames[1].datum_from_linearised();
        let all = row_of(self.frames.len());
        let rest = all - 6;
        // xᵢ = x'ᵢ + Ad(frame i ← frame 1) x₁.
        let moved: Vec<Matrix6<f64>> = self.frames[2..]
            .iter()
            .map(|f| se3::adjoint(&(f.datum_from_linearised().inverse() * first_linearised)))
            .collect();
        let mut along = MatrixXx6::zeros(all);
        along
            .fixed_rows_mut::<6>(row_of(1))
            .copy_from(&Matrix6::identity());
        for (i, block) in moved.iter().enumerate() {
            along.fixed_rows_mut::<6>(row_of(i + 2)).copy_from(block);
        }
        let by_first = hessian * &along;
        let first: Matrix6<f64> = along.transpose() * &by_first;
        let first_gradient: Vector6<f64> = along.transpose() * gradient;
        // Without anything that holds frame 1 nothing can be handed on; the datum's own
        // uncertainty then has to grow beyond bounds, which the ridge expresses.
        let cov_first = invert_or_ridge(&se3::symmetric(&first));
        let mean = cov_first * first_gradient;
        let first_by_sources: BySources = along
            .tr_mul(by_sources)
            .fixed_view::<6, SOURCES>(0, 0)
            .into_owned();
        let mean_by_sources: BySources = cov_first * first_by_sources;
        let cross = by_first.remove_fixed_rows::<6>(row_of(1));
        let by_rest: Matrix6xX<f64> = -(cov_first * cross.transpose());
        let hessian = hessian
            .clone()
            .remove_fixed_rows::<6>(row_of(1))
            .remove_fixed_columns::<6>(row_of(1));
        let information = hessian + &cross * &by_rest;
        // The newest frame, last in the window, took no part.
        let known = rest - 6;
        let symmetric = (&information + information.transpose()) * 0.5;
        self.prior.information = symmetric.view((0, 0), (known, known)).into_owned();
        let gradient = gradient.clone().remove_fixed_rows::<6>(row_of(1)) - &cross * mean;
        self.prior.vector = gradient.rows(0, known).into_owned();
        let of_rest = by_sources.clone().remove_fixed_rows::<6>(row_of(1));
        let of_first: DMatrix<f64> =
            &cross * DMatrix::from_column_slice(6, SOURCES, mean_by_sources.as_slice());
        self.prior.by_sources = (of_rest - of_first).rows(0, known).into_owned();
        self.datum.advance(
            &self.frames,
            &moved,
            &mean,
            &mean_by_sources,
            &by_rest,
            &cov_first,
        );
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
        self.landmarks.retain_mut(|landmark| {
            if landmark.anchor != oldest {
                return true;
            }
            let Some(last) = landmark.observations.last().filter(|o| o.serial == newest) else {
                return false;
            };
            let calibrated = warp.corrected(&last.measurement);
            match Landmark::new(rig, landmark.id, newest, last.measurement, &calibrated) {
                Some(anew) => {
                    *landmark = anew;
                    true
                }
                None => false,
            }
        });
    }
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
