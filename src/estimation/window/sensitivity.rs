//! What the sources of error ([`super::super::sources`]) do to a window: the last equations in, the
//! derivative of their solution by each source out.
//!
//! To the window an error of the rig is a displacement `D` of every sight. It moves the right side
//! of the equations by `Jᵀ W D`, points eliminated like all else, and the solution by the joint
//! covariance times that. What left the window did the same to the prior.

use super::super::calibration::sight_by_skew;
use super::super::sight;
use super::super::sources::{MODE_COLUMNS, MODES, RigErrors, SKEW_COLUMN};
use super::landmark::Landmark;
use super::memory::UnknownsBySources;
use super::row_of;
use super::system::{self, At, POINT, System, weigh};
use super::warp::WARP;
use crate::geometry::product::{product, transposed_product};
use nalgebra::SMatrix;

/// Columns that displace sights: the modes and the skew.
const MOVING: usize = MODES + 1;
type Block6 = SMatrix<f64, 6, MOVING>;
type Block4 = SMatrix<f64, 4, MOVING>;

/// Working memory.
#[derive(Clone, Debug, Default)]
pub(super) struct Sensitivity {
    lines: Vec<Block6>,
    frames: Vec<Block6>,
}

impl Sensitivity {
    /// The derivative of the right side of `system`, which was built at `at`, by each source: rows
    /// as there.
    pub(super) fn right_side(
        &mut self,
        at: &At<'_>,
        errors: &RigErrors,
        system: &System,
        landmarks: &[Landmark],
    ) -> UnknownsBySources {
        let n = at.frames.len();
        let mut right = UnknownsBySources::zeros();
        let has_skew = at.frames.iter().any(|f| f.exposure.sigma_skew_s > 0.0);
        if !errors.has_modes() && !has_skew {
            return right;
        }
        self.lines.clear();
        self.lines.resize(n * n, Block6::zeros());
        self.frames.clear();
        self.frames.resize(n, Block6::zeros());
        let mut warp = SMatrix::<f64, WARP, MOVING>::zeros();
        for reduced in system.reduced() {
            let landmark = &landmarks[reduced.landmark];
            let Some(anchor) = at.frames.iter().position(|f| f.serial == landmark.anchor) else {
                continue;
            };
            let mut by_point = SMatrix::<f64, POINT, MOVING>::zeros();
            for observation in &landmark.observations {
                if Some(observation.serial) == at.without {
                    continue;
                }
                let Some(frame) = at
                    .frames
                    .iter()
                    .position(|f| f.serial == observation.serial)
                else {
                    continue;
                };
                let (current, linearised) = system.sightline(anchor, frame);
                let from = linearised.unwrap_or(current);
                let y = &landmark.inverse_depth;
                let (Some(seen), Some(px)) = (
                    sight::linearise(at.rig, from, y),
                    sight::seen_at(at.rig, current, y),
                ) else {
                    continue;
                };
                let Some(displaced) = displacement(at, errors, frame, from, y) else {
                    continue;
                };
                let residual = at.warp.corrected(&observation.measurement).px
                    - px
                    - observation.by_relief(&landmark.relief);
                let (info, _, _) = weigh(
                    &residual,
                    &observation.measurement.sigma_px,
                    at.variance_factor,
                );
                let mut weighted = displaced;
                for i in 0..4 {
                    weighted.row_mut(i).scale_mut(info[i]);
                }
                by_point += transposed_product(&system::by_point(&seen, observation), &weighted);
                let by_warp = at.warp.derivative(&observation.measurement);
                warp += by_warp.transpose() * weighted.fixed_rows::<2>(2);
                if frame != anchor {
                    self.lines[anchor * n + frame] +=
                        transposed_product(&seen.by_motion, &weighted);
                }
            }
            let gain = product(&reduced.cov, &by_point);
            for cross in system.crosses_of(reduced) {
                self.frames[cross.frame] -= product(&cross.by_point, &gain);
            }
            warp -= product(&reduced.by_warp, &gain);
        }
        self.expand(system, n);
        right
            .view_mut((0, MODE_COLUMNS), (WARP, MOVING))
            .copy_from(&warp);
        for i in 1..n {
            right
                .view_mut((row_of(i), MODE_COLUMNS), (6, MOVING))
                .copy_from(&self.frames[i]);
        }
        right
    }

    /// Hands on what the sightlines gathered to the poses at their two ends.
    fn expand(&mut self, system: &System, n: usize) {
        for anchor in 0..n {
            for frame in (0..n).filter(|frame| *frame != anchor) {
                let line = self.lines[anchor * n + frame];
                self.frames[frame] += line;
                self.frames[anchor] -= transposed_product(system.adjoint(anchor, frame), &line);
            }
        }
    }
}

/// By how much each source that moves sights displaces that of `y` from a frame.
fn displacement(
    at: &At<'_>,
    errors: &RigErrors,
    frame: usize,
    from: &nalgebra::Isometry3<f64>,
    y: &nalgebra::Vector3<f64>,
) -> Option<Block4> {
    let mut by = Block4::zeros();
    if errors.has_modes() {
        by.fixed_columns_mut::<MODES>(0)
            .copy_from(&errors.displacement(at.rig, from, y)?);
    }
    let exposure = &at.frames[frame].exposure;
    if exposure.sigma_skew_s > 0.0 {
        let skew = sight_by_skew(at.rig, from, y, &exposure.twist)? * exposure.sigma_skew_s;
        by.set_column(SKEW_COLUMN - MODE_COLUMNS, &skew);
    }
    Some(by)
}
