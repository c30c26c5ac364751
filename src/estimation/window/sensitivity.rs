//! What the sources of error ([`super::super::sources`]) do to a window: the last equations in, the
//! derivative of their solution by each source out.
//!
//! To the window an error of the rig is a displacement `D` of every sight. It moves the right side
//! of the equations by `Jᵀ W D`, points eliminated like all else, and the solution by the joint
//! covariance times that. What left the window did the same to the prior.

use super::super::calibration::seen_by_skew;
use super::super::sight::{Sight, Viewpoint};
use super::super::sources::{MODE_COLUMNS, MODES, RigErrors, SKEW_COLUMN};
use super::landmark::Landmark;
use super::memory::UnknownsBySources;
use super::system::{self, At, POINT, Reduced, System, weigh};
use super::warp::WARP;
use super::{line_count, line_index, row_of};
use crate::geometry::product::{product, subtract_product_transposed};
use crate::simd::widened;
use nalgebra::{SMatrix, Vector3};

/// Rows for the sources that displace sights: the modes, then, last, the skew. Few do for a rig that states
/// nothing of its uncertainty.
const FEW: usize = 8;
const ALL: usize = MODES + 1;

/// Working memory.
#[derive(Clone, Debug)]
pub(super) struct Sensitivity {
    few: Gathered<FEW>,
    all: Gathered<ALL>,
}

/// What the sources, a row each, so that products run along them, do to the right side.
#[derive(Clone, Debug)]
struct Gathered<const ROWS: usize> {
    /// To the sights of a frame by their anchor, by [`line_index`]; then by the frame.
    lines: Vec<SMatrix<f64, ROWS, 6>>,
    frames: Vec<SMatrix<f64, ROWS, 6>>,
    warp: SMatrix<f64, ROWS, WARP>,
}

impl Sensitivity {
    /// Room for a window of so many frames.
    pub(super) fn with_room(frames: usize) -> Self {
        Self {
            few: Gathered::with_room(frames),
            all: Gathered::with_room(frames),
        }
    }

    /// The derivative of the right side of `system`, which was built at `at`, by each source: rows
    /// as there.
    pub(super) fn right_side(
        &mut self,
        at: &At<'_>,
        errors: &RigErrors,
        system: &System,
        landmarks: &[Landmark],
    ) -> UnknownsBySources {
        let has_skew = at.frames.iter().any(|f| f.exposure.sigma_skew_s > 0.0);
        if !errors.has_modes() && !has_skew {
            return UnknownsBySources::zeros();
        }
        let landmarks = system.reduced().iter().map(|r| (r, &landmarks[r.landmark]));
        let n = at.frames.len();
        if errors.modes() < FEW {
            self.few.begin(n);
            landmarks.for_each(|(r, l)| gather_few(&mut self.few, at, errors, system, r, l));
            self.few.right_side(system, n)
        } else {
            self.all.begin(n);
            landmarks.for_each(|(r, l)| gather_all(&mut self.all, at, errors, system, r, l));
            self.all.right_side(system, n)
        }
    }
}

impl<const ROWS: usize> Gathered<ROWS> {
    fn with_room(frames: usize) -> Self {
        Self {
            lines: Vec::with_capacity(line_count(frames)),
            frames: Vec::with_capacity(frames),
            warp: SMatrix::zeros(),
        }
    }

    fn begin(&mut self, n: usize) {
        self.lines.clear();
        self.lines.resize(line_count(n), SMatrix::zeros());
        self.frames.clear();
        self.frames.resize(n, SMatrix::zeros());
        self.warp = SMatrix::zeros();
    }

    /// Hands on what the sightlines gathered to the poses at their two ends.
    fn right_side(&mut self, system: &System, n: usize) -> UnknownsBySources {
        for frame in 0..n {
            for anchor in (0..frame).filter(|anchor| system.is_seen_along(*anchor, frame)) {
                let line = &self.lines[line_index(anchor, frame)];
                self.frames[frame] += line;
                self.frames[anchor] -= product(line, system.adjoint(anchor, frame));
            }
        }
        let mut right = UnknownsBySources::zeros();
        for row in 0..ROWS {
            let source = if row == ROWS - 1 {
                SKEW_COLUMN
            } else {
                MODE_COLUMNS + row
            };
            for i in 0..WARP {
                right[(i, source)] = self.warp[(row, i)];
            }
            for (frame, by_pose) in self.frames.iter().enumerate().skip(1) {
                for i in 0..6 {
                    right[(row_of(frame) + i, source)] = by_pose[(row, i)];
                }
            }
        }
        right
    }
}

widened! {
    fn gather_few = gather::<FEW>,
        (gathered: &mut Gathered<FEW>, at: &At<'_>, errors: &RigErrors, system: &System, reduced: &Reduced, landmark: &Landmark)
}

widened! {
    fn gather_all = gather::<ALL>,
        (gathered: &mut Gathered<ALL>, at: &At<'_>, errors: &RigErrors, system: &System, reduced: &Reduced, landmark: &Landmark)
}

/// Adds what the sources do to one landmark's sights, its point eliminated.
#[inline(always)]
fn gather<const ROWS: usize>(
    gathered: &mut Gathered<ROWS>,
    at: &At<'_>,
    errors: &RigErrors,
    system: &System,
    reduced: &Reduced,
    landmark: &Landmark,
) {
    let position = |serial: u64| at.frames.iter().position(|f| f.serial == serial);
    let Some(anchor) = position(landmark.anchor) else {
        return;
    };
    let y = &landmark.inverse_depth;
    let mut by_point = SMatrix::<f64, ROWS, POINT>::zeros();
    for observation in &landmark.observations {
        if Some(observation.serial) == at.without {
            continue;
        }
        let Some(frame) = position(observation.serial) else {
            continue;
        };
        let line = system.sightline(anchor, frame);
        let Some(seen) = line.linearise(at.rig, y) else {
            continue;
        };
        let displaced = displacement::<ROWS>(at, errors, frame, line.linearised(), y, &seen);
        let by_warp = at.warp.derivative(&observation.measurement);
        let residual = at.warp.corrected_px(&observation.measurement, &by_warp)
            - seen.px
            - observation.by_relief(&landmark.relief);
        let (info, _, _) = weigh(
            &residual,
            &observation.measurement.sigma_px,
            at.variance_factor,
        );
        let mut weighted = displaced;
        for (mut column, info) in weighted.column_iter_mut().zip(&info) {
            column *= *info;
        }
        by_point += product(&weighted, &system::by_point(&seen, observation));
        let of_right = weighted.fixed_columns::<2>(2).into_owned();
        gathered.warp += by_warp.after(&of_right);
        if frame != anchor {
            gathered.lines[line_index(anchor, frame)] += product(&weighted, &seen.by_motion);
        }
    }
    let gain = product(&by_point, &reduced.cov);
    for cross in system.crosses_of(reduced) {
        subtract_product_transposed(&mut gathered.frames[cross.frame], &gain, &cross.by_point);
    }
    subtract_product_transposed(&mut gathered.warp, &gain, &reduced.by_warp);
}

/// By how much each source that moves sights displaces that of `y` from a frame.
#[inline(always)]
fn displacement<const ROWS: usize>(
    at: &At<'_>,
    errors: &RigErrors,
    frame: usize,
    from: &Viewpoint,
    y: &Vector3<f64>,
    seen: &Sight,
) -> SMatrix<f64, ROWS, 4> {
    let mut by = if errors.has_modes() {
        errors.displacement::<ROWS>(at.rig, from, y, seen)
    } else {
        SMatrix::zeros()
    };
    let exposure = &at.frames[frame].exposure;
    if exposure.sigma_skew_s > 0.0 {
        let skew = seen_by_skew(seen, &exposure.twist) * exposure.sigma_skew_s;
        by.set_row(ROWS - 1, &skew.transpose());
    }
    by
}
