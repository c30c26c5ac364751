//! Flat ground: that a robot's keyframes stand on one plane, as a measurement.
//!
//! Each frame's heave, roll and pitch relative to the datum are measured to be zero, with the σ by
//! which the ground may fail to be flat. When the datum moves on to the next keyframe, what flat
//! ground says of that one alone is kept: each link of the path uses it once. Whether the ground *is*
//! flat shows in what is left: `rᵀ (Σ − P)⁻¹ r`, with `P` the residual's covariance afterwards, is the
//! normalised square of what the sights alone make of it.

use super::super::{Model, Plane, Settings};
use super::{Frame, Joint, row_of};
use crate::geometry::{StereoRig, se3};
use crate::uncertainty::consistency;
use nalgebra::{DMatrix, DVector, Matrix3, SMatrix, Vector3, Vector6};

/// What is known of the ground.
#[derive(Clone, Debug)]
pub(super) struct Ground {
    plane: Plane,
    /// Of heave, roll and pitch, m and rad.
    sigmas: Vector3<f64>,
}

impl Ground {
    /// Flat ground, where the settings say so.
    pub(super) fn of(rig: &StereoRig, settings: &Settings) -> Option<Self> {
        let Model::Planar(plane) = settings.model.of(rig) else {
            return None;
        };
        let tilt = settings.flat_sigma_rad;
        Some(Self {
            plane,
            sigmas: Vector3::new(settings.flat_sigma_m, tilt, tilt),
        })
    }

    /// Heave, roll and pitch of a frame, and their derivative by its pose.
    fn departure(&self, frame: &Frame) -> (Vector3<f64>, SMatrix<f64, 3, 6>) {
        let across = self.plane.across().transpose();
        let xi = se3::log(&frame.datum_from_frame);
        (across * xi, across * se3::right_jacobian_inverse(&xi))
    }

    /// Adds what flat ground says of `frames` (the datum is the first) to equations linearised at
    /// their poses; `frames` may be fewer than the equations know. Returns its cost.
    pub(super) fn add_to(
        &self,
        frames: &[Frame],
        hessian: &mut DMatrix<f64>,
        gradient: &mut DVector<f64>,
    ) -> f64 {
        let info = Matrix3::from_diagonal(&self.sigmas.map(|s| 1.0 / (s * s)));
        let mut cost = 0.0;
        for (i, frame) in frames.iter().enumerate().skip(1) {
            let (r, by) = self.departure(frame);
            let weighted = by.transpose() * info;
            let mut block = hessian.fixed_view_mut::<6, 6>(row_of(i), row_of(i));
            block += weighted * by;
            let step: Vector6<f64> = weighted * -r;
            let mut rows = gradient.fixed_rows_mut::<6>(row_of(i));
            rows += step;
            cost += 0.5 * r.dot(&(info * r));
        }
        cost
    }

    /// How far the last frame leaves the plane: χ² with three degrees of freedom on flat ground.
    pub(super) fn departure_of_last(&self, frames: &[Frame], joint: &Joint) -> Option<f64> {
        let last = frames.len().checked_sub(1).filter(|&last| last > 0)?;
        let (r, by) = self.departure(&frames[last]);
        let pose = joint.fixed_view::<6, 6>(row_of(last), row_of(last));
        let allowed = Matrix3::from_diagonal(&self.sigmas.component_mul(&self.sigmas));
        let left: Matrix3<f64> = allowed - by * pose * by.transpose();
        consistency::nees(&r, &((left + left.transpose()) * 0.5))
    }
}
