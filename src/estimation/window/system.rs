//! The normal equations of a window: frames and landmarks in, the equations of the poses alone out.
//!
//! Each landmark's own three unknowns are eliminated as soon as its observations are linearised
//! (Schur complement), so that cost grows linearly with the observations.

use super::super::bundle::{huber_loss, huber_weight};
use super::super::sight::{Sight, Viewpoint};
use super::landmark::{Landmark, Observation};
use super::memory::Memory;
use super::warp::{WARP, Warp};
use super::{Frame, line_count, line_index, row_of};
use crate::geometry::definite::inverse;
use crate::geometry::product::{
    product, subtract_product_transposed, transposed_product, transposed_scaled,
};
use crate::geometry::{StereoRig, se3};
use crate::simd::widened;
use nalgebra::{
    DMatrix, DVector, Matrix2, Matrix6, SMatrix, SVector, Vector2, Vector3, Vector4, Vector6,
};

/// Where and how observations are linearised.
#[derive(Clone, Copy, Debug)]
pub(super) struct At<'a> {
    pub(super) rig: &'a StereoRig,
    pub(super) warp: &'a Warp,
    pub(super) frames: &'a [Frame],
    /// A frame whose observations are left out.
    pub(super) without: Option<u64>,
    /// Information is divided by it.
    pub(super) variance_factor: f64,
    /// Levenberg's and Marquardt's.
    pub(super) damping: f64,
}

impl<'a> At<'a> {
    /// All observations of a window, undamped.
    pub(super) fn new(
        rig: &'a StereoRig,
        warp: &'a Warp,
        frames: &'a [Frame],
        variance_factor: f64,
    ) -> Self {
        Self {
            rig,
            warp,
            frames,
            without: None,
            variance_factor,
            damping: 0.0,
        }
    }
}

/// Normal equations, with the working memory for making them.
#[derive(Clone, Debug, Default)]
pub(super) struct System {
    /// By [`line_index`].
    sightlines: Vec<Sightline>,
    frame_count: usize,
    /// Upper triangle of blocks, the datum's included.
    blocks: Vec<Matrix6<f64>>,
    gradients: Vec<Vector6<f64>>,
    by_warp: Vec<SMatrix<f64, 6, WARP>>,
    warp_warp: SMatrix<f64, WARP, WARP>,
    warp_gradient: SVector<f64, WARP>,
    reduced: Vec<Reduced>,
    crosses: Vec<Cross>,
}

/// How one frame sees the landmarks of one anchor, and what they all say of it.
#[derive(Clone, Debug)]
pub(super) struct Sightline {
    current: Viewpoint,
    /// The same where the Jacobians are taken, if elsewhere.
    linearised: Option<Viewpoint>,
    adjoint: Matrix6<f64>,
    adjoint_transposed: Matrix6<f64>,
    information: Matrix6<f64>,
    by_warp: SMatrix<f64, 6, WARP>,
    gradient: Vector6<f64>,
    is_used: bool,
}

impl Sightline {
    /// Where Jacobians are taken.
    #[inline(always)]
    pub(super) fn linearised(&self) -> &Viewpoint {
        self.linearised.as_ref().unwrap_or(&self.current)
    }

    /// How the frame sees a point as things stand, with Jacobians as they are taken. `None` where a camera
    /// cannot.
    #[inline(always)]
    pub(super) fn linearise(&self, rig: &StereoRig, y: &Vector3<f64>) -> Option<Sight> {
        let mut seen = self.linearised().linearise(rig, y)?;
        if self.linearised.is_some() {
            seen.px = self.current.seen_at(rig, y)?;
        }
        Some(seen)
    }
}

/// Unknowns of a landmark: x, y, ρ and its relief.
pub(super) const POINT: usize = 5;
/// A sight's derivative by them.
type ByPoint = SMatrix<f64, 4, POINT>;

/// A landmark, eliminated.
#[derive(Clone, Debug)]
pub(super) struct Reduced {
    pub(super) landmark: usize,
    crosses: std::ops::Range<usize>,
    pub(super) cov: SMatrix<f64, POINT, POINT>,
    gradient: SVector<f64, POINT>,
    settled: f64,
    pub(super) by_warp: SMatrix<f64, WARP, POINT>,
}

/// What joins a landmark to a frame's pose.
#[derive(Clone, Debug)]
pub(super) struct Cross {
    pub(super) frame: usize,
    pub(super) by_point: SMatrix<f64, 6, POINT>,
}

impl System {
    /// Room for a window of so many frames and landmarks.
    pub(super) fn with_room(frames: usize, landmarks: usize) -> Self {
        Self {
            sightlines: Vec::with_capacity(line_count(frames)),
            blocks: Vec::with_capacity(frames * frames),
            gradients: Vec::with_capacity(frames),
            by_warp: Vec::with_capacity(frames),
            reduced: Vec::with_capacity(landmarks),
            crosses: Vec::with_capacity(frames * landmarks),
            ..Self::default()
        }
    }

    /// Linearises the observations of `landmarks`. Returns the robust cost, in σ².
    pub(super) fn build<'a>(
        &mut self,
        at: &At<'_>,
        landmarks: impl Iterator<Item = (usize, &'a Landmark)>,
    ) -> f64 {
        self.begin(at.rig, at.frames);
        let mut cost = 0.0;
        for (index, landmark) in landmarks {
            cost += eliminate(self, at, index, landmark).unwrap_or(0.0);
        }
        self.expand_sightlines();
        cost / at.variance_factor
    }

    /// The landmarks that were eliminated.
    pub(super) fn reduced(&self) -> &[Reduced] {
        &self.reduced
    }

    /// What joins an eliminated landmark to poses.
    pub(super) fn crosses_of(&self, reduced: &Reduced) -> &[Cross] {
        &self.crosses[reduced.crosses.clone()]
    }

    /// How a frame sees the landmarks of an anchor, which is not later.
    pub(super) fn sightline(&self, anchor: usize, frame: usize) -> &Sightline {
        &self.sightlines[line_index(anchor, frame)]
    }

    /// The adjoint of that.
    pub(super) fn adjoint(&self, anchor: usize, frame: usize) -> &Matrix6<f64> {
        &self.sightlines[line_index(anchor, frame)].adjoint
    }

    /// Whether a frame saw landmarks of an anchor other than itself.
    pub(super) fn is_seen_along(&self, anchor: usize, frame: usize) -> bool {
        self.sightlines[line_index(anchor, frame)].is_used
    }

    fn begin(&mut self, rig: &StereoRig, frames: &[Frame]) {
        let n = frames.len();
        self.frame_count = n;
        self.sightlines.clear();
        for (i, frame) in frames.iter().enumerate() {
            for anchor in &frames[..=i] {
                let current = frame.datum_from_frame.inverse() * anchor.datum_from_frame;
                let linearised =
                    (anchor.linearised.is_some() || frame.linearised.is_some()).then(|| {
                        frame.datum_from_linearised().inverse() * anchor.datum_from_linearised()
                    });
                let adjoint = se3::adjoint(linearised.as_ref().unwrap_or(&current));
                self.sightlines.push(Sightline {
                    adjoint,
                    adjoint_transposed: adjoint.transpose(),
                    current: Viewpoint::new(rig, &current),
                    linearised: linearised.map(|l| Viewpoint::new(rig, &l)),
                    information: Matrix6::zeros(),
                    by_warp: SMatrix::zeros(),
                    gradient: Vector6::zeros(),
                    is_used: false,
                });
            }
        }
        self.blocks.clear();
        self.blocks.resize(n * n, Matrix6::zeros());
        self.gradients.clear();
        self.gradients.resize(n, Vector6::zeros());
        self.by_warp.clear();
        self.by_warp.resize(n, SMatrix::zeros());
        self.warp_warp = SMatrix::zeros();
        self.warp_gradient = SVector::zeros();
        self.reduced.clear();
        self.crosses.clear();
    }

    /// Hands on what the sightlines gathered to the poses at their two ends.
    fn expand_sightlines(&mut self) {
        let n = self.frame_count;
        for frame in 0..n {
            for anchor in 0..frame {
                let line = &self.sightlines[line_index(anchor, frame)];
                if !line.is_used {
                    continue;
                }
                let by_anchor = line.information * line.adjoint;
                self.blocks[frame * n + frame] += line.information;
                self.blocks[anchor * n + anchor] += line.adjoint.transpose() * by_anchor;
                self.blocks[anchor * n + frame] -= by_anchor.transpose();
                self.by_warp[frame] += line.by_warp;
                self.by_warp[anchor] -= line.adjoint.transpose() * line.by_warp;
                self.gradients[frame] += line.gradient;
                self.gradients[anchor] -= line.adjoint.transpose() * line.gradient;
            }
        }
    }

    /// The equations of the warp and of all poses but the datum: full symmetric
    /// matrix and right side.
    pub(super) fn assemble(&self, memory: &mut Memory) -> (DMatrix<f64>, DVector<f64>) {
        let n = self.frame_count;
        let dim = row_of(n);
        let mut hessian = memory.square(dim);
        let mut gradient = memory.vector(dim);
        hessian
            .fixed_view_mut::<WARP, WARP>(0, 0)
            .copy_from(&self.warp_warp);
        gradient
            .fixed_rows_mut::<WARP>(0)
            .copy_from(&self.warp_gradient);
        for i in 1..n {
            let r = row_of(i);
            gradient
                .fixed_rows_mut::<6>(r)
                .copy_from(&self.gradients[i]);
            let by_warp = &self.by_warp[i];
            hessian.fixed_view_mut::<6, WARP>(r, 0).copy_from(by_warp);
            hessian
                .fixed_view_mut::<WARP, 6>(0, r)
                .copy_from(&by_warp.transpose());
            for j in i..n {
                let c = row_of(j);
                let block = &self.blocks[i * n + j];
                hessian.fixed_view_mut::<6, 6>(r, c).copy_from(block);
                if i != j {
                    hessian
                        .fixed_view_mut::<6, 6>(c, r)
                        .copy_from(&block.transpose());
                }
            }
        }
        (hessian, gradient)
    }

    /// Moves the landmarks along with a step of warp and poses, and notes their covariance.
    pub(super) fn move_landmarks(&self, step: &DVector<f64>, landmarks: &mut [Landmark]) {
        for r in &self.reduced {
            let warp = step.fixed_rows::<WARP>(0).into_owned();
            let mut gradient = r.gradient - transposed_product(&r.by_warp, &warp);
            for cross in &self.crosses[r.crosses.clone()] {
                if cross.frame > 0 {
                    let x = step.fixed_rows::<6>(row_of(cross.frame)).into_owned();
                    gradient -= transposed_product(&cross.by_point, &x);
                }
            }
            let landmark = &mut landmarks[r.landmark];
            let step = r.cov * gradient;
            landmark.inverse_depth += step.fixed_rows::<3>(0);
            landmark.relief += step.fixed_rows::<2>(3);
            landmark.settled = r.settled;
            landmark.cov = r.cov.fixed_view::<3, 3>(0, 0).into_owned();
        }
    }
}

widened! {
    fn eliminate = eliminate_in, (system: &mut System, at: &At<'_>, index: usize, landmark: &Landmark) -> Option<f64>
}

/// Adds a landmark's observations and eliminates its point. `None` if it has fewer than two or
/// cannot be seen from where it was observed.
#[inline(always)]
fn eliminate_in(
    system: &mut System,
    at: &At<'_>,
    index: usize,
    landmark: &Landmark,
) -> Option<f64> {
    if landmark.observations.len() < 2 {
        return None;
    }
    let (rig, warp, frames) = (at.rig, at.warp, at.frames);
    let anchor = frames.iter().position(|f| f.serial == landmark.anchor)?;
    let mut point_point = SMatrix::<f64, POINT, POINT>::zeros();
    let mut point_gradient = SVector::<f64, POINT>::zeros();
    let mut warp_point = SMatrix::<f64, WARP, POINT>::zeros();
    let mut warp_warp = SMatrix::<f64, WARP, WARP>::zeros();
    let mut warp_gradient = SVector::<f64, WARP>::zeros();
    let mut cost = 0.0;
    let first_cross = system.crosses.len();
    let mut anchor_by_point = SMatrix::<f64, 6, POINT>::zeros();
    let mut sights = 0;
    for observation in &landmark.observations {
        if Some(observation.serial) == at.without {
            continue;
        }
        let Some(frame) = frames.iter().position(|f| f.serial == observation.serial) else {
            continue;
        };
        let line = &mut system.sightlines[line_index(anchor, frame)];
        let Some(seen) = line.linearise(rig, &landmark.inverse_depth) else {
            continue;
        };
        sights += 1;
        let by_warp = warp.derivative(&observation.measurement);
        let (info, residual, loss) = weigh(
            &(warp.corrected_px(&observation.measurement, &by_warp)
                - seen.px
                - observation.by_relief(&landmark.relief)),
            &observation.measurement.sigma_px,
            at.variance_factor,
        );
        cost += loss;
        let seen_by_point = by_point(&seen, observation);
        let weighted = transposed_scaled(&seen_by_point, &info);
        point_point += product(&weighted, &seen_by_point);
        point_gradient += product(&weighted, &residual);
        let of_right = Matrix2::new(info[2], 0.0, 0.0, info[3]);
        warp_warp += by_warp.transposed_before(&by_warp.after(&of_right));
        let of_right = weighted.fixed_columns::<2>(2).transpose();
        warp_point += by_warp.transposed_before(&of_right);
        let of_right = Vector2::new(info[2] * residual[2], info[3] * residual[3]);
        warp_gradient += by_warp.transposed_before(&of_right);
        if frame == anchor {
            continue;
        }
        let weighted = transposed_scaled(&seen.by_motion, &info);
        line.information += product(&weighted, &seen.by_motion);
        let of_right = weighted.fixed_columns::<2>(2).into_owned();
        line.by_warp += by_warp.after(&of_right);
        line.gradient += product(&weighted, &residual);
        line.is_used = true;
        let by_point = product(&weighted, &seen_by_point);
        anchor_by_point -= product(&line.adjoint_transposed, &by_point);
        system.crosses.push(Cross { frame, by_point });
    }
    if sights < 2 {
        system.crosses.truncate(first_cross);
        return None;
    }
    system.crosses.push(Cross {
        frame: anchor,
        by_point: anchor_by_point,
    });
    // The relief has σ 1, which like all σ is to be scaled.
    for i in 0..2 {
        point_point[(3 + i, 3 + i)] += 1.0 / at.variance_factor;
        point_gradient[3 + i] -= landmark.relief[i] / at.variance_factor;
    }
    cost += 0.5 * landmark.relief.norm_squared();
    for i in 0..POINT {
        point_point[(i, i)] *= 1.0 + at.damping;
    }
    let cov = inverse(&point_point)?;
    let crosses = first_cross..system.crosses.len();
    for i in crosses.clone() {
        let a = &system.crosses[i];
        // The datum has no unknowns.
        if a.frame == 0 {
            continue;
        }
        let gain = product(&a.by_point, &cov);
        system.gradients[a.frame] -= product(&gain, &point_gradient);
        subtract_product_transposed(&mut system.by_warp[a.frame], &gain, &warp_point);
        let row = &mut system.blocks[a.frame * system.frame_count..][..system.frame_count];
        for b in &system.crosses[crosses.clone()] {
            if a.frame <= b.frame {
                subtract_product_transposed(&mut row[b.frame], &gain, &b.by_point);
            }
        }
    }
    let gain = product(&warp_point, &cov);
    subtract_product_transposed(&mut warp_warp, &gain, &warp_point);
    system.warp_warp += warp_warp;
    system.warp_gradient += warp_gradient - product(&gain, &point_gradient);
    system.reduced.push(Reduced {
        landmark: index,
        crosses,
        cov,
        gradient: point_gradient,
        settled: 5.0 - (cov[(3, 3)] + cov[(4, 4)]) / at.variance_factor,
        by_warp: warp_point,
    });
    Some(cost)
}

/// The derivative of a sight by the unknowns of its landmark.
pub(super) fn by_point(seen: &Sight, observation: &Observation) -> ByPoint {
    let mut by_point = ByPoint::zeros();
    by_point.fixed_columns_mut::<3>(0).copy_from(&seen.by_point);
    for (side, relief_px) in observation.relief_px.iter().enumerate() {
        by_point[(2 * side, 3)] = *relief_px;
        by_point[(2 * side + 1, 4)] = *relief_px;
    }
    by_point
}

/// Robust information (a diagonal), the residual, and the loss (σ²) of one frame's measurement. Huber's bend
/// stands at so many σ as residuals really have.
pub(super) fn weigh(
    residual: &Vector4<f64>,
    sigma_px: &Vector4<f64>,
    variance_factor: f64,
) -> (Vector4<f64>, Vector4<f64>, f64) {
    let scale = variance_factor.sqrt();
    let normalised = residual.component_div(&(sigma_px * scale));
    let (left, right) = (normalised.xy().norm(), normalised.fixed_rows::<2>(2).norm());
    let (wl, wr) = (huber_weight(left), huber_weight(right));
    let info = Vector4::new(wl, wl, wr, wr)
        .component_div(&(sigma_px.component_mul(sigma_px) * variance_factor));
    (
        info,
        *residual,
        variance_factor * (huber_loss(left) + huber_loss(right)),
    )
}
