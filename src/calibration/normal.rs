//! One view in, its part of the normal equations out: the placement of its board eliminated, what remains speaks of
//! the rig alone.
//!
//! With p = camera_from_board · X and errors as in [`rig_parameters`](crate::geometry::rig_parameters) (t adds, r turns
//! from the left), a placement moves its points by `dp = dt − [R X]× dr`, and the rig's extrinsics theirs likewise.

use super::{Board, View};
use crate::geometry::rig_parameters::{
    CAMERA_PARAMETERS, EXTRINSICS, RIG_PARAMETERS, RigVector, pixel_by_parameters,
};
use crate::geometry::{StereoRig, so3};
use nalgebra::{
    Isometry3, Matrix2x3, Matrix6, Point3, SMatrix, Translation3, Vector2, Vector3, Vector6,
};

/// A matrix over the rig's slots.
pub(super) type RigMatrix = SMatrix<f64, RIG_PARAMETERS, RIG_PARAMETERS>;

/// What a point that cannot be projected counts as having missed by, px.
const BEYOND_VIEW_PX: f64 = 1000.0;

/// How misses count: quadratically up to a threshold, linearly beyond (Huber 1964), by the length of a point's miss.
#[derive(Clone, Copy, Debug)]
pub(super) struct Loss {
    /// The threshold, px; infinite for least squares.
    pub threshold_px: f64,
}

impl Loss {
    pub(super) const SQUARED: Self = Self {
        threshold_px: f64::INFINITY,
    };

    /// Half the square of a miss of `length_px`, or less beyond the threshold.
    fn cost(self, length_px: f64) -> f64 {
        if length_px <= self.threshold_px {
            0.5 * length_px * length_px
        } else {
            self.threshold_px * (length_px - 0.5 * self.threshold_px)
        }
    }

    fn weight(self, length_px: f64) -> f64 {
        if length_px <= self.threshold_px {
            1.0
        } else {
            self.threshold_px / length_px
        }
    }
}

/// A point's image with its derivatives by the rig and by the board's placement.
struct Prediction {
    px: Vector2<f64>,
    by_rig: SMatrix<f64, 2, RIG_PARAMETERS>,
    by_placement: SMatrix<f64, 2, 6>,
}

/// A damped step of a placement before a rig that stays as it is. `None` where there is none.
pub(super) fn placement_step(
    rig: &StereoRig,
    left_from_board: &Isometry3<f64>,
    board: &Board,
    view: &View,
    loss: Loss,
    damping: f64,
) -> Option<Vector6<f64>> {
    let (mut information, mut score) = (Matrix6::zeros(), Vector6::zeros());
    let right = rig.right_from_left.rotation.to_rotation_matrix();
    for side in 0..2 {
        for (point, seen_px) in view.points(side) {
            let turned = left_from_board.rotation * board.point(point).coords;
            let in_left = Point3::from(turned + left_from_board.translation.vector);
            let seen = match side {
                0 => rig.left.project_with_jacobian(&in_left),
                _ => rig
                    .right
                    .project_with_jacobian(&(rig.right_from_left * in_left)),
            };
            let Some((px, mut by_point)) = seen else {
                continue;
            };
            if side == 1 {
                by_point *= right.matrix();
            }
            let by = by_motion(&by_point, &turned);
            let miss = seen_px - px;
            let weight = loss.weight(miss.norm());
            information += by.transpose() * by * weight;
            score += by.transpose() * miss * weight;
        }
    }
    for i in 0..6 {
        information[(i, i)] *= 1.0 + damping;
    }
    Some(information.cholesky()?.solve(&score))
}

/// dp by (dt, dr) of a motion whose rotated point is `turned`, through a pixel's derivative by the point.
fn by_motion(by_point: &Matrix2x3<f64>, turned: &Vector3<f64>) -> SMatrix<f64, 2, 6> {
    let mut by = SMatrix::<f64, 2, 6>::zeros();
    by.fixed_view_mut::<2, 3>(0, 0).copy_from(by_point);
    by.fixed_view_mut::<2, 3>(0, 3)
        .copy_from(&(-by_point * so3::hat(turned)));
    by
}

fn predict(
    rig: &StereoRig,
    left_from_board: &Isometry3<f64>,
    side: usize,
    on_board: &Point3<f64>,
) -> Option<Prediction> {
    let turned = left_from_board.rotation * on_board.coords;
    let in_left = Point3::from(turned + left_from_board.translation.vector);
    let mut by_rig = SMatrix::<f64, 2, RIG_PARAMETERS>::zeros();
    let (camera, in_camera) = match side {
        0 => (&rig.left, in_left),
        _ => (&rig.right, rig.right_from_left * in_left),
    };
    let (px, by_point) = camera.project_with_jacobian(&in_camera)?;
    let normalised = Vector2::new(in_camera.x / in_camera.z, in_camera.y / in_camera.z);
    by_rig
        .fixed_view_mut::<2, CAMERA_PARAMETERS>(0, side * CAMERA_PARAMETERS)
        .copy_from(&pixel_by_parameters(camera, &normalised));
    let by_left_point = if side == 0 {
        by_point
    } else {
        let rotation = rig.right_from_left.rotation;
        by_rig
            .fixed_view_mut::<2, 6>(0, EXTRINSICS)
            .copy_from(&by_motion(&by_point, &(rotation * in_left.coords)));
        by_point * rotation.to_rotation_matrix().matrix()
    };
    Some(Prediction {
        px,
        by_rig,
        by_placement: by_motion(&by_left_point, &turned),
    })
}

/// By how much each point of a view was missed, measured − predicted, px: side, point, miss. `None` where the
/// point cannot be projected.
pub(super) fn misses(
    rig: &StereoRig,
    left_from_board: &Isometry3<f64>,
    board: &Board,
    view: &View,
) -> Vec<(usize, usize, Option<Vector2<f64>>)> {
    let mut misses = Vec::with_capacity(view.count(0) + view.count(1));
    for side in 0..2 {
        for (point, seen_px) in view.points(side) {
            let in_left = left_from_board * board.point(point);
            let px = match side {
                0 => rig.left.project(&in_left),
                _ => rig.right.project(&(rig.right_from_left * in_left)),
            };
            misses.push((side, point, px.map(|px| seen_px - px)));
        }
    }
    misses
}

/// The cost of a view, px².
pub(super) fn cost(
    rig: &StereoRig,
    left_from_board: &Isometry3<f64>,
    board: &Board,
    view: &View,
    loss: Loss,
) -> f64 {
    misses(rig, left_from_board, board, view)
        .iter()
        .map(|(_, _, miss)| loss.cost(miss.map_or(BEYOND_VIEW_PX, |miss| miss.norm())))
        .sum()
}

/// A view's normal equations: `s` the rig's slots, `v` the placement's six.
#[derive(Clone, Debug)]
pub(super) struct ViewEquations {
    ss: RigMatrix,
    sv: SMatrix<f64, RIG_PARAMETERS, 6>,
    vv: Matrix6<f64>,
    s: RigVector,
    v: Vector6<f64>,
}

/// What a view says of the rig once its placement is eliminated.
#[derive(Clone, Debug)]
pub(super) struct Reduced {
    /// Information, 1/px² of the misses.
    pub information: RigMatrix,
    /// Gradient towards smaller misses.
    pub score: RigVector,
}

/// Whether misses count in the information by their weight under the loss (as a step wants) or fully (as the
/// covariance does).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Weighting {
    ByLoss,
    Full,
}

impl ViewEquations {
    pub(super) fn new(
        rig: &StereoRig,
        left_from_board: &Isometry3<f64>,
        board: &Board,
        view: &View,
        loss: Loss,
        weighting: Weighting,
    ) -> Self {
        let mut all = Self {
            ss: RigMatrix::zeros(),
            sv: SMatrix::zeros(),
            vv: Matrix6::zeros(),
            s: RigVector::zeros(),
            v: Vector6::zeros(),
        };
        for side in 0..2 {
            for (point, seen_px) in view.points(side) {
                if let Some(prediction) = predict(rig, left_from_board, side, &board.point(point)) {
                    all.add(
                        side,
                        &prediction,
                        &(seen_px - prediction.px),
                        loss,
                        weighting,
                    );
                }
            }
        }
        all.mirror();
        all
    }

    fn add(
        &mut self,
        side: usize,
        at: &Prediction,
        miss: &Vector2<f64>,
        loss: Loss,
        weighting: Weighting,
    ) {
        let weight = loss.weight(miss.norm());
        let information = match weighting {
            Weighting::ByLoss => weight,
            Weighting::Full => 1.0,
        };
        // A pixel of one camera moves with that camera's slots and, on the right, with the extrinsics alone.
        let first = side * CAMERA_PARAMETERS;
        let last = if side == 0 {
            CAMERA_PARAMETERS
        } else {
            RIG_PARAMETERS
        };
        for i in first..last {
            let (xi, yi) = (
                at.by_rig[(0, i)] * information,
                at.by_rig[(1, i)] * information,
            );
            for j in first..=i {
                self.ss[(i, j)] += xi * at.by_rig[(0, j)] + yi * at.by_rig[(1, j)];
            }
            for j in 0..6 {
                self.sv[(i, j)] += xi * at.by_placement[(0, j)] + yi * at.by_placement[(1, j)];
            }
            self.s[i] += weight * (at.by_rig[(0, i)] * miss.x + at.by_rig[(1, i)] * miss.y);
        }
        self.vv += at.by_placement.transpose() * at.by_placement * information;
        self.v += at.by_placement.transpose() * miss * weight;
    }

    fn mirror(&mut self) {
        for i in 0..RIG_PARAMETERS {
            for j in 0..i {
                self.ss[(j, i)] = self.ss[(i, j)];
            }
        }
    }

    /// The inverse of the placement's block with its diagonal raised by the share `damping`.
    fn placement_inverse(&self, damping: f64) -> Option<Matrix6<f64>> {
        let mut block = self.vv;
        for i in 0..6 {
            block[(i, i)] *= 1.0 + damping;
        }
        block.cholesky().map(|factor| factor.inverse())
    }

    /// The rig's diagonal before elimination, by which a step is damped.
    pub(super) fn diagonal(&self) -> RigVector {
        self.ss.diagonal()
    }

    /// Eliminates the placement. `None` where the view's points do not determine it.
    pub(super) fn reduced(&self, damping: f64) -> Option<Reduced> {
        let towards = self.sv * self.placement_inverse(damping)?;
        Some(Reduced {
            information: self.ss - towards * self.sv.transpose(),
            score: self.s - towards * self.v,
        })
    }

    /// The step of the placement that goes with one of the rig.
    pub(super) fn placement_step(
        &self,
        rig_step: &RigVector,
        damping: f64,
    ) -> Option<Vector6<f64>> {
        Some(self.placement_inverse(damping)? * (self.v - self.sv.transpose() * rig_step))
    }
}

/// A placement moved by (dt, dr): the translation adds up, the rotation turns from the left.
pub(super) fn moved(placement: &Isometry3<f64>, step: &Vector6<f64>) -> Isometry3<f64> {
    let (shift, turn) = (
        step.fixed_rows::<3>(0).into_owned(),
        step.fixed_rows::<3>(3).into_owned(),
    );
    Isometry3::from_parts(
        Translation3::from(placement.translation.vector + shift),
        so3::exp(&turn) * placement.rotation,
    )
}

#[cfg(test)]
mod tests {
    use super::super::Pattern;
    use super::*;
    use crate::geometry::parse_rig;

    #[test]
    fn predictions_move_with_rig_and_placement_as_central_differences_say() {
        let rig = parse_rig(
            "left = { width = 640, height = 480, focal = [505.8, 504.1], principal_point = [313.2, 243.5], distortion = { model = \"radtan\", coefficients = [-0.25, 0.1, 0.0005, -0.0003, 0.01, 0.02, 0.03, 0.01] } }
             right = { width = 640, height = 480, focal = [502.9, 501.2], principal_point = [300.2, 246.4], distortion = { model = \"equidistant\", coefficients = [-0.01, 0.02, -0.01, 0.002] } }
             right_from_left = { translation_m = [-0.1857, -0.0072, 0.0101], rotation_vector_rad = [0.04046, 0.01616, 0.01419] }",
        )
        .expect("valid");
        let placement =
            Isometry3::new(Vector3::new(-0.05, -0.1, 0.9), Vector3::new(0.4, -0.3, 0.2));
        let point = Point3::new(0.12, 0.07, 0.0);
        for side in 0..2 {
            let at = predict(&rig, &placement, side, &point).expect("in view");
            let px = |rig: &StereoRig, placement: &Isometry3<f64>| {
                predict(rig, placement, side, &point).expect("near").px
            };
            for i in 0..RIG_PARAMETERS {
                let mut step = RigVector::zeros();
                step[i] = 1e-5;
                let numeric = (px(&rig.with_error(&step), &placement)
                    - px(&rig.with_error(&-step), &placement))
                    / 2e-5;
                // A slot that the lens does not use has no effect; its column is zero as well.
                assert!(
                    (numeric - at.by_rig.column(i)).norm() < 1e-6 * (1.0 + numeric.norm()),
                    "{side} {i}"
                );
            }
            for i in 0..6 {
                let mut step = Vector6::zeros();
                step[i] = 1e-6;
                let numeric = (px(&rig, &moved(&placement, &step))
                    - px(&rig, &moved(&placement, &-step)))
                    / 2e-6;
                assert!(
                    (numeric - at.by_placement.column(i)).norm() < 1e-5 * numeric.norm(),
                    "{side} {i}"
                );
            }
        }
    }

    #[test]
    fn the_square_size_and_all_distances_may_grow_together() {
        // What images cannot tell: hence the square's own uncertainty goes to the translation as it is.
        let rig = crate::simulation::thesis_rig();
        let mut wide = rig.clone();
        wide.right_from_left.translation.vector *= 1.01;
        let placement =
            Isometry3::new(Vector3::new(-0.05, -0.1, 1.9), Vector3::new(0.4, -0.3, 0.2));
        let mut far = placement;
        far.translation.vector *= 1.01;
        let board = |square_m| Board {
            pattern: Pattern::Chessboard,
            columns: 4,
            rows: 3,
            square_m,
            sigma_square_m: 0.0,
        };
        for side in 0..2 {
            let small = predict(&rig, &placement, side, &board(0.05).point(7)).expect("in view");
            let large = predict(&wide, &far, side, &board(0.0505).point(7)).expect("in view");
            assert!((small.px - large.px).norm() < 1e-9);
        }
    }
}
