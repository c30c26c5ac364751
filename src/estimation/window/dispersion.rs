//! How much more a window's pose errs than independent pixels let expect: its sights' residuals in, a factor
//! of the pose's covariance out.
//!
//! The covariance of a least-squares estimate takes every sight's error for independent of all others'. But
//! what is wrong with a patch stays wrong from frame to frame, and neighbours on one surface are wrong
//! alike. Residuals tell: each sight pushes the pose by its residual (its *score*), and the pushes of all
//! sights in one region of the image add up to more than chance lets them. So the scores are summed by
//! region, and their squares compared with what independent errors would make of them,
//!
//! ```text
//! E[s sᵀ] = I − I C I,   I the region's information, C the covariance of the poses,
//! ```
//!
//! the second term being what the fit has taken out of the residuals. Their ratio, in the direction of the
//! newest pose, is the factor. Points are eliminated, and the warp is taken as given.
//!
//! Source: the cluster-robust ("sandwich") covariance, K.-Y. Liang, S. L. Zeger, *Longitudinal data analysis
//! using generalized linear models*, Biometrika 73, 1986; its correction for what the fit takes out:
//! R. M. Bell, D. F. McCaffrey, *Bias reduction in standard errors for linear regression with multi-stage
//! samples*, Survey Methodology 28, 2002.

use super::super::sight::Viewpoint;
use super::landmark::Landmark;
use super::memory::{ByUnknowns, carried};
use super::system::{self, At, POINT, weigh};
use super::warp::WARP;
use super::{Joint, MAX_FRAMES, line_count, line_index, row_of};
use crate::geometry::definite::inverse;
use crate::geometry::product::{
    product, product_transposed, transposed_product, transposed_scaled,
};
use crate::geometry::se3;
use crate::simd::widened;
use nalgebra::{Matrix6, SMatrix, SVector, Vector2, Vector6};

/// Regions of the image, across and down.
const REGIONS: [usize; 2] = [4, 3];
/// As many measurements count as if they had found nothing, at first.
const PRIOR: u32 = 2;
/// Share of a new measurement, once there are many.
const GAIN: f64 = 0.05;
/// What it may be above 1 by chance: what twelve regions' scores leave after smoothing.
const CHANCE: f64 = 0.03;

/// A pose's derivative by itself through one other.
type Block = Matrix6<f64>;

/// What one region's sights say.
#[derive(Clone, Debug)]
struct Region {
    /// Of the newest pose.
    score: Vector6<f64>,
    information: Matrix6<f64>,
    /// The information that joins the newest pose's direction to each unknown, transposed.
    by_unknowns: ByUnknowns,
}

impl Region {
    fn nothing() -> Self {
        Self {
            score: Vector6::zeros(),
            information: Matrix6::zeros(),
            by_unknowns: ByUnknowns::zeros(),
        }
    }
}

/// How one frame sees the landmarks of one anchor.
#[derive(Clone, Debug)]
struct Sightline {
    current: Viewpoint,
    adjoint: Matrix6<f64>,
    /// By how much the frame moves, relative to the anchor, with the newest pose.
    moved: Block,
}

/// What one landmark's sights say of one frame's own pose.
#[derive(Clone, Debug)]
struct OfFrame {
    frame: usize,
    /// The information that joins it to the newest pose's direction.
    by_direction: Block,
    by_point: SMatrix<f64, 6, POINT>,
}

/// Follows the factor, in memory that it keeps.
#[derive(Clone, Debug)]
pub(super) struct Dispersion {
    smoothed: f64,
    taken: u32,
    regions: Vec<Region>,
    /// By [`line_index`]; those that nothing was seen along are not made.
    sightlines: Vec<Option<Sightline>>,
    of_frames: Vec<OfFrame>,
}

impl Dispersion {
    /// None as yet; room for a window of so many frames.
    pub(super) fn with_room(frames: usize) -> Self {
        Self {
            smoothed: 1.0,
            taken: 0,
            regions: Vec::with_capacity(REGIONS[0] * REGIONS[1]),
            sightlines: Vec::with_capacity(line_count(frames)),
            of_frames: Vec::with_capacity(frames),
        }
    }

    /// The factor of a pose's covariance, its frame's relative to the datum: 1 or more.
    pub(super) fn factor(&self) -> f64 {
        (self.smoothed - CHANCE).max(1.0)
    }

    /// The ratio as it was measured, smoothed: around 1 where errors are independent.
    #[cfg(test)]
    pub(super) fn smoothed(&self) -> f64 {
        self.smoothed
    }

    /// Takes note of a window that has been adjusted, `joint` being its covariance.
    pub(super) fn take(&mut self, at: &At<'_>, landmarks: &[Landmark], joint: &Joint) {
        if let Some(measured) = self.measure(at, landmarks, joint) {
            self.taken = self.taken.saturating_add(1);
            let gain = GAIN.max(1.0 / f64::from(PRIOR.saturating_add(self.taken)));
            self.smoothed += gain * (measured - self.smoothed);
        }
    }

    /// The scores' squares over what they should be, in the direction of the newest pose.
    fn measure(&mut self, at: &At<'_>, landmarks: &[Landmark], joint: &Joint) -> Option<f64> {
        let n = at.frames.len();
        if n < 2 {
            return None;
        }
        let given_warp = GivenWarp::new(joint)?;
        let mut along = [Block::zeros(); MAX_FRAMES];
        for (f, block) in along.iter_mut().enumerate().take(n).skip(1) {
            *block = given_warp.covariance(joint, f, n - 1);
        }
        self.regions.clear();
        self.regions
            .resize_with(REGIONS[0] * REGIONS[1], Region::nothing);
        self.sightlines.clear();
        self.sightlines.resize(line_count(n), None);
        for landmark in landmarks {
            if let Some(last) = landmark.observations.last() {
                let region = region_of(at, &last.measurement.left_px());
                add(self, at, landmark, &along, region);
            }
        }
        let information: Matrix6<f64> = self.regions.iter().map(|r| r.information).sum();
        let scale = inverse(&information)?;
        let (mut squares, mut expected) = (0.0, 0.0);
        for region in &self.regions {
            squares += region.score.dot(&(scale * region.score));
            let taken_out = given_warp.carried(joint, &region.by_unknowns);
            expected += (scale * (region.information - taken_out)).trace();
        }
        (expected > 0.0).then(|| squares / expected)
    }
}

/// Which region of the left image a pixel lies in.
fn region_of(at: &At<'_>, px: &Vector2<f64>) -> usize {
    let left = &at.rig.left;
    let cell = |px: f64, size: u32, count: usize| {
        ((px / f64::from(size) * count as f64).max(0.0) as usize).min(count - 1)
    };
    let [columns, rows] = REGIONS;
    cell(px.x, left.width, columns) + columns * cell(px.y, left.height, rows)
}

widened! {
    /// Adds what a landmark's sights say of the newest pose to a region, `along` being by how much each pose
    /// moves with it.
    fn add = add_in,
        (dispersion: &mut Dispersion, at: &At<'_>, landmark: &Landmark, along: &[Block; MAX_FRAMES], region: usize)
}

#[inline(always)]
fn add_in(
    dispersion: &mut Dispersion,
    at: &At<'_>,
    landmark: &Landmark,
    along: &[Block; MAX_FRAMES],
    region: usize,
) {
    let position = |serial: u64| at.frames.iter().position(|f| f.serial == serial);
    let Some(anchor) = position(landmark.anchor) else {
        return;
    };
    let mut point_point = SMatrix::<f64, POINT, POINT>::zeros();
    let mut point_gradient = SVector::<f64, POINT>::zeros();
    let mut pose_point = SMatrix::<f64, 6, POINT>::zeros();
    let mut information = Matrix6::zeros();
    let mut score = Vector6::zeros();
    let mut of_anchor = OfFrame {
        frame: anchor,
        by_direction: Block::zeros(),
        by_point: SMatrix::zeros(),
    };
    let of_frames = &mut dispersion.of_frames;
    of_frames.clear();
    let mut sights = 0;
    for observation in &landmark.observations {
        let Some(frame) = position(observation.serial) else {
            continue;
        };
        let line = dispersion.sightlines[line_index(anchor, frame)]
            .get_or_insert_with(|| sightline(at, anchor, frame, along));
        let Some(seen) = line.current.linearise(at.rig, &landmark.inverse_depth) else {
            continue;
        };
        sights += 1;
        let (info, residual, _) = weigh(
            &(at.warp.corrected(&observation.measurement).px
                - seen.px
                - observation.by_relief(&landmark.relief)),
            &observation.measurement.sigma_px,
            at.variance_factor,
        );
        let seen_by_point = system::by_point(&seen, observation);
        let weighted = transposed_scaled(&seen_by_point, &info);
        point_point += product(&weighted, &seen_by_point);
        point_gradient += product(&weighted, &residual);
        if frame == anchor {
            continue;
        }
        let seen_by_direction = product(&seen.by_motion, &line.moved);
        let weighted = transposed_scaled(&seen_by_direction, &info);
        information += product(&weighted, &seen_by_direction);
        score += product(&weighted, &residual);
        pose_point += product(&weighted, &seen_by_point);
        let weighted = transposed_scaled(&seen.by_motion, &info);
        let own = OfFrame {
            frame,
            by_direction: product(&weighted, &seen_by_direction),
            by_point: product(&weighted, &seen_by_point),
        };
        of_anchor.by_direction -= transposed_product(&line.adjoint, &own.by_direction);
        of_anchor.by_point -= transposed_product(&line.adjoint, &own.by_point);
        of_frames.push(own);
    }
    if sights < 2 {
        return;
    }
    of_frames.push(of_anchor);
    for i in 0..2 {
        point_point[(3 + i, 3 + i)] += 1.0 / at.variance_factor;
        point_gradient[3 + i] -= landmark.relief[i] / at.variance_factor;
    }
    let Some(cov_point) = inverse(&point_point) else {
        return;
    };
    let region = &mut dispersion.regions[region];
    let through_point = product(&pose_point, &cov_point);
    region.score += score - product(&through_point, &point_gradient);
    region.information += information - product_transposed(&through_point, &pose_point);
    // The datum has no unknowns.
    for own in of_frames.iter().filter(|own| own.frame > 0) {
        let block =
            own.by_direction.transpose() - product_transposed(&through_point, &own.by_point);
        let mut columns = region.by_unknowns.fixed_columns_mut::<6>(row_of(own.frame));
        columns += block;
    }
}

fn sightline(at: &At<'_>, anchor: usize, frame: usize, along: &[Block; MAX_FRAMES]) -> Sightline {
    let frame_from_anchor =
        at.frames[frame].datum_from_frame.inverse() * at.frames[anchor].datum_from_frame;
    let adjoint = se3::adjoint(&frame_from_anchor);
    Sightline {
        moved: along[frame] - product(&adjoint, &along[anchor]),
        current: Viewpoint::new(at.rig, &frame_from_anchor),
        adjoint,
    }
}

/// The covariance of a window's poses, the warp being given.
struct GivenWarp {
    warp_information: SMatrix<f64, WARP, WARP>,
}

impl GivenWarp {
    fn new(joint: &Joint) -> Option<Self> {
        let cov = joint.fixed_view::<WARP, WARP>(0, 0).into_owned();
        Some(Self {
            warp_information: inverse(&cov)?,
        })
    }

    /// That of the poses of frames `a` and `b`.
    fn covariance(&self, joint: &Joint, a: usize, b: usize) -> Matrix6<f64> {
        let (a, b) = (row_of(a), row_of(b));
        let with_warp = |at: usize| joint.fixed_view::<6, WARP>(at, 0).into_owned();
        let through_warp = product(&with_warp(a), &self.warp_information);
        joint.fixed_view::<6, 6>(a, b) - product_transposed(&through_warp, &with_warp(b))
    }

    /// That of what depends on poses alone.
    fn carried(&self, joint: &Joint, by: &ByUnknowns) -> Matrix6<f64> {
        let mut with_warp = SMatrix::<f64, 6, WARP>::zeros();
        for k in WARP..joint.nrows() {
            with_warp += by.column(k) * joint.fixed_view::<1, WARP>(k, 0);
        }
        let through_warp = product(&with_warp, &self.warp_information);
        carried(by, joint) - product_transposed(&through_warp, &with_warp)
    }
}

/// The covariance of a frame's pose relative to the datum, the warp being given.
pub(super) fn of_pose_given_warp(joint: &Joint, frame: usize) -> Matrix6<f64> {
    GivenWarp::new(joint).map_or_else(Matrix6::zeros, |given| {
        se3::symmetric(&given.covariance(joint, frame, frame))
    })
}
