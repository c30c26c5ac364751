//! The least variance that an unbiased estimator can have (Cramér–Rao), from the Fisher information
//! at the truth.
//!
//! It is that of Gaussian noise of the same variance, independent from pair to pair; with heavier
//! tails an estimator that knows them may do a little better.

use super::world::World;
use crate::estimation::Model;
use crate::geometry::{se3, so3};
use nalgebra::{DMatrix, Matrix3, Matrix3xX, Matrix4x3, Matrix6, SMatrix};

/// Most unknowns of poses that a full batch is solved for: beyond, it would take minutes.
const MOST_UNKNOWNS: usize = 1500;

/// The covariance of each pose (right perturbation) if all measurements of the whole path are used
/// at once, the first pose being exact. Index 0 is the second pair.
///
/// `None` for paths that are too long, or if the measurements do not determine them.
pub(super) fn of_batch(world: &World<'_>, model: &Model) -> Option<Vec<Matrix6<f64>>> {
    let freedom = model.degrees_of_freedom();
    let unknowns = freedom * (world.frames.len() - 1);
    if unknowns > MOST_UNKNOWNS {
        return None;
    }
    let mut info = DMatrix::<f64>::zeros(unknowns, unknowns);
    for landmark in landmarks(world, model) {
        landmark.add_to(&mut info, freedom)?;
    }
    let cov = info.cholesky()?.inverse();
    let poses = (0..world.frames.len() - 1).map(|k| {
        let block = cov.view((k * freedom, k * freedom), (freedom, freedom));
        let lifted = match model {
            Model::Se3 => Matrix6::from_fn(|i, j| block[(i, j)]),
            Model::Planar(plane) => {
                let basis = plane.basis();
                basis * Matrix3::from_fn(|i, j| block[(i, j)]) * basis.transpose()
            }
        };
        se3::symmetric(&lifted)
    });
    Some(poses.collect())
}

/// A landmark's sights, linearised, points in the first pair's frame.
#[derive(Default)]
struct Landmark {
    point_point: Matrix3<f64>,
    /// Pose (0 is the second pair), its own information, and that shared with the point.
    poses: Vec<(usize, DMatrix<f64>, Matrix3xX<f64>)>,
}

impl Landmark {
    /// Adds what the landmark says of the poses once its point is marginalised.
    fn add_to(&self, info: &mut DMatrix<f64>, freedom: usize) -> Option<()> {
        let inverse = self.point_point.cholesky()?.inverse();
        for (i, own, with_point) in &self.poses {
            let mut block = info.view_mut((i * freedom, i * freedom), (freedom, freedom));
            block += own;
            let gain = with_point.transpose() * inverse;
            for (j, _, other) in &self.poses {
                let mut block = info.view_mut((i * freedom, j * freedom), (freedom, freedom));
                block -= &gain * other;
            }
        }
        Some(())
    }
}

fn landmarks(world: &World<'_>, model: &Model) -> Vec<Landmark> {
    let mut all: Vec<Landmark> = Vec::new();
    for (k, frame) in world.frames.iter().enumerate() {
        let rotation = frame.odom_from_camera.rotation.to_rotation_matrix();
        for sight in &frame.sights {
            let Some((_, by_camera_point)) = world.rig.project_with_jacobian(&sight.point) else {
                continue;
            };
            let sigma = world.sigma_px() * sight.scale;
            let whitened: Matrix4x3<f64> = by_camera_point / sigma;
            let by_point = whitened * rotation.matrix().transpose();
            let index = sight.id as usize;
            if all.len() <= index {
                all.resize_with(index + 1, Landmark::default);
            }
            let landmark = &mut all[index];
            landmark.point_point += by_point.transpose() * by_point;
            if k > 0 {
                let mut by_pose = SMatrix::<f64, 4, 6>::zeros();
                by_pose.fixed_view_mut::<4, 3>(0, 0).copy_from(&-whitened);
                by_pose
                    .fixed_view_mut::<4, 3>(0, 3)
                    .copy_from(&(whitened * so3::hat(&sight.point.coords)));
                let by_pose = match model {
                    Model::Se3 => DMatrix::from_column_slice(4, 6, by_pose.as_slice()),
                    Model::Planar(plane) => {
                        let reduced = by_pose * plane.basis();
                        DMatrix::from_column_slice(4, 3, reduced.as_slice())
                    }
                };
                landmark.poses.push((
                    k - 1,
                    by_pose.transpose() * &by_pose,
                    by_point.transpose() * &by_pose,
                ));
            }
        }
    }
    all
}
