//! Tracks and the motion estimated from them in; how much each pixel moved that estimate out.
//!
//! To first order the error of an estimated motion (right perturbation) is
//! `δm = Σ Pᵢ δzᵢ(before) + Qᵢ δzᵢ(now)` over its tracks (theory §4). From `P` and `Q` follow the
//! motion's covariance, its correlation with the motions before and after, which share pixels with
//! it, and what an error of the rig's calibration or of its synchronisation does to it, for that is
//! a common displacement of pixels.

use super::bundle::TrackedPoint;
use super::model::Model;
use super::{Landmark, closed_form, sight, weighted};
use crate::geometry::{StereoRig, se3};
use crate::uncertainty::propagate;
use nalgebra::{
    Isometry3, Matrix3, Matrix3x4, Matrix4, Matrix6, Matrix6x4, Point3, SMatrix, Vector4,
};

/// By how much a motion moves with the pixels of one of its tracks: m/px, rad/px.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Influence {
    /// With (ul, vl, ur, vr) of the earlier pair: `P`.
    pub by_prev: Matrix6x4<f64>,
    /// With those of this pair: `Q`.
    pub by_now: Matrix6x4<f64>,
}

impl Influence {
    /// What the noise of one track contributes to the motion's covariance, the two pairs' being
    /// independent.
    #[must_use]
    pub fn covariance(&self, point: &TrackedPoint) -> Matrix6<f64> {
        propagate(&self.by_prev, &point.prev.cov_px2())
            + propagate(&self.by_now, &point.now.cov_px2())
    }

    /// What one track contributes to `Cov(δm, δm')` of this motion and the one after it: the pixels
    /// that are now this motion's present view are then the next one's previous view.
    #[must_use]
    pub fn covariance_with_next(&self, now: &Vector4<f64>, next: &Self) -> Matrix6<f64> {
        let var = Matrix4::from_diagonal(&now.component_mul(now));
        self.by_now * var * next.by_prev.transpose()
    }
}

/// The influences on the reprojection bundle adjustment: points marginalised, weights robust as
/// its own are. One a track, in order, into `out`; the covariance for a variance factor of 1.
///
/// `None` where a camera cannot see a point, or the motion is not determined.
pub fn of_bundle(
    rig: &StereoRig,
    model: &Model,
    prev_from_now: &Isometry3<f64>,
    points: &[TrackedPoint],
    out: &mut Vec<Influence>,
) -> Option<Matrix6<f64>> {
    let now_from_prev = prev_from_now.inverse();
    let mut info = Matrix6::zeros();
    out.clear();
    for p in points {
        let track = LinearTrack::new(rig, &now_from_prev, p)?;
        let (motion_motion, by_pixels) = track.marginalised()?;
        info += motion_motion;
        out.push(by_pixels);
    }
    let cov = model.inverse(&info)?;
    for influence in out {
        influence.by_prev = cov * influence.by_prev;
        influence.by_now = cov * influence.by_now;
    }
    Some(cov)
}

/// One track linearised: eight residuals by its point and by the motion.
pub(super) struct LinearTrack {
    prev_by_point: nalgebra::Matrix4x3<f64>,
    now_by_point: nalgebra::Matrix4x3<f64>,
    now_by_motion: SMatrix<f64, 4, 6>,
    prev_residual: Vector4<f64>,
    now_residual: Vector4<f64>,
    prev_info: Matrix4<f64>,
    now_info: Matrix4<f64>,
}

impl LinearTrack {
    pub(super) fn new(
        rig: &StereoRig,
        now_from_prev: &Isometry3<f64>,
        p: &TrackedPoint,
    ) -> Option<Self> {
        let prev = sight::linearise(rig, &Isometry3::identity(), &p.inverse_depth)?;
        let now = sight::linearise(rig, now_from_prev, &p.inverse_depth)?;
        let prev_residual = p.prev.px - prev.px;
        let now_residual = p.now.px - now.px;
        Some(Self {
            prev_by_point: prev.by_point,
            now_by_point: now.by_point,
            now_by_motion: now.by_motion,
            prev_info: robust_info(&prev_residual, &p.prev.sigma_px),
            now_info: robust_info(&now_residual, &p.now.sigma_px),
            prev_residual,
            now_residual,
        })
    }

    /// Squared residuals, in σ², by their robust weights.
    pub(super) fn weighted_squares(&self) -> f64 {
        let square = |r: &Vector4<f64>, info: &Matrix4<f64>| r.dot(&(info * r));
        square(&self.prev_residual, &self.prev_info) + square(&self.now_residual, &self.now_info)
    }

    /// The track's part of the motion's information, its point marginalised, and the derivative of
    /// the motion's gradient by the pixels.
    fn marginalised(&self) -> Option<(Matrix6<f64>, Influence)> {
        let point_prev: Matrix3x4<f64> = self.prev_by_point.transpose() * self.prev_info;
        let point_now: Matrix3x4<f64> = self.now_by_point.transpose() * self.now_info;
        let motion_now: Matrix6x4<f64> = self.now_by_motion.transpose() * self.now_info;
        let point_point: Matrix3<f64> =
            point_prev * self.prev_by_point + point_now * self.now_by_point;
        let motion_point = motion_now * self.now_by_point;
        let gain = motion_point * point_point.cholesky()?.inverse();
        let info = motion_now * self.now_by_motion - gain * motion_point.transpose();
        Some((
            info,
            Influence {
                by_prev: -(gain * point_prev),
                by_now: motion_now - gain * point_now,
            },
        ))
    }

    /// Information and gradient of the motion, and what gives the point's step for a motion's step.
    pub(super) fn reduced(&self) -> Option<(Matrix6<f64>, nalgebra::Vector6<f64>, PointStep)> {
        let (info, by_pixels) = self.marginalised()?;
        let gradient =
            by_pixels.by_prev * self.prev_residual + by_pixels.by_now * self.now_residual;
        let point_prev = self.prev_by_point.transpose() * self.prev_info;
        let point_now = self.now_by_point.transpose() * self.now_info;
        let inverse = (point_prev * self.prev_by_point + point_now * self.now_by_point)
            .cholesky()?
            .inverse();
        let step = PointStep {
            alone: inverse * (point_prev * self.prev_residual + point_now * self.now_residual),
            by_motion: -inverse * (point_now * self.now_by_motion),
        };
        Some((info, gradient, step))
    }
}

/// A point's Gauss–Newton step: its own, and what a step of the motion adds.
pub(super) struct PointStep {
    pub(super) alone: nalgebra::Vector3<f64>,
    pub(super) by_motion: SMatrix<f64, 3, 6>,
}

/// Where Huber's loss turns from square to linear, in σ of one camera's residual: as in the bundle
/// adjustment, whose estimate these are the derivatives of.
const HUBER_SIGMAS: f64 = 3.0;

fn robust_info(residual: &Vector4<f64>, sigma_px: &Vector4<f64>) -> Matrix4<f64> {
    let normalised = residual.component_div(sigma_px);
    let weight = |sigmas: f64| (HUBER_SIGMAS / sigmas).min(1.0);
    let left = weight(normalised.xy().norm());
    let right = weight(normalised.fixed_rows::<2>(2).norm());
    let info =
        Vector4::new(left, left, right, right).component_div(&sigma_px.component_mul(sigma_px));
    Matrix4::from_diagonal(&info)
}

/// Both triangulated points of a track with their derivatives by their pixels, where depth is
/// certain enough for first order.
#[derive(Clone, Copy, Debug)]
pub struct Triangulated {
    /// The point in the earlier left camera.
    pub prev: Landmark,
    /// The point in the left camera now.
    pub now: Landmark,
    prev_by_px: Matrix3x4<f64>,
    now_by_px: Matrix3x4<f64>,
}

impl Triangulated {
    /// Triangulates both views of a track. `None` where sights do not meet, or depth is so
    /// uncertain that its error is not Gaussian.
    #[must_use]
    pub fn new(rig: &StereoRig, p: &TrackedPoint) -> Option<Self> {
        let (prev, now) = (
            super::triangulate(rig, &p.prev)?,
            super::triangulate(rig, &p.now)?,
        );
        if !(prev.is_first_order() && now.is_first_order()) {
            return None;
        }
        let by_px = |landmark: &Landmark, sigma_px: &Vector4<f64>| {
            let (_, jacobian) = rig.project_with_jacobian(&landmark.point)?;
            let info = Matrix4::from_diagonal(&sigma_px.map(|s| 1.0 / (s * s)));
            Some(landmark.cov_m2 * jacobian.transpose() * info)
        };
        Some(Self {
            prev_by_px: by_px(&prev, &p.prev.sigma_px)?,
            now_by_px: by_px(&now, &p.now.sigma_px)?,
            prev,
            now,
        })
    }
}

/// The influences on the closed form (thesis 3.29, carried on to the pixels), as [`of_bundle`].
pub fn of_closed_form(
    model: &Model,
    prev_from_now: &Isometry3<f64>,
    tracks: &[Triangulated],
    out: &mut Vec<Influence>,
) -> Option<()> {
    let now_from_prev = prev_from_now.inverse();
    let carried = |t: &Triangulated| (now_from_prev * t.prev.point).coords;
    let hessian: Matrix6<f64> = tracks
        .iter()
        .map(|t| closed_form::hessian_of_point(&t.now.point.coords, &carried(t)))
        .sum();
    let inverse = model.inverse(&hessian)?;
    let rotation = now_from_prev.rotation.to_rotation_matrix();
    out.clear();
    out.extend(tracks.iter().map(|t| {
        let by_now = closed_form::mixed_by_now(&carried(t));
        let by_prev = closed_form::mixed_by_prev(&t.now.point.coords, rotation.matrix());
        Influence {
            by_prev: -inverse * by_prev * t.prev_by_px,
            by_now: -inverse * by_now * t.now_by_px,
        }
    }));
    Some(())
}

/// The influences on the weighted alignment, as [`of_bundle`].
pub fn of_weighted(
    model: &Model,
    prev_from_now: &Isometry3<f64>,
    tracks: &[Triangulated],
    out: &mut Vec<Influence>,
) -> Option<()> {
    let pairs: Vec<(Landmark, Landmark)> = tracks.iter().map(|t| (t.prev, t.now)).collect();
    let derivative = weighted::derivative(model, prev_from_now, &pairs)?;
    out.clear();
    out.extend(
        tracks
            .iter()
            .zip(&derivative)
            .map(|(t, (by_prev, by_now))| Influence {
                by_prev: by_prev * t.prev_by_px,
                by_now: by_now * t.now_by_px,
            }),
    );
    Some(())
}

/// The motion's covariance, summed over its tracks.
#[must_use]
pub fn covariance(influences: &[Influence], points: &[TrackedPoint]) -> Matrix6<f64> {
    let sum = influences
        .iter()
        .zip(points)
        .map(|(influence, p)| influence.covariance(p))
        .sum();
    se3::symmetric(&sum)
}

/// The earlier point of a track as a Euclidean one. `None` at infinity.
#[must_use]
pub fn euclidean(p: &TrackedPoint) -> Option<Point3<f64>> {
    let y = p.inverse_depth;
    (y.z > 1e-6).then(|| Point3::new(y.x / y.z, y.y / y.z, 1.0 / y.z))
}
