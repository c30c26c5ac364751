//! Two pairs' tracks in, the motion within a [`Model`] that reprojects them best out.
//!
//! What is minimised is the same as in [`bundle`](super::bundle): all eight coordinates of a track
//! over their σ, robust by camera (Huber), points in inverse depth and marginalised. Here the motion
//! may be bound to a plane, and what every pixel did to it comes out too.

use super::bundle::TrackedPoint;
use super::influence::Influence;
use super::model::Model;
use super::sight::{Sight, Viewpoint};
use crate::geometry::product::{product, product_transposed, transposed_scaled};
use crate::geometry::{StereoRig, se3};
use nalgebra::{
    Isometry3, Matrix3, Matrix3x4, Matrix6, Matrix6x4, SMatrix, Vector3, Vector4, Vector6,
};

/// What the adjustment found.
#[derive(Clone, Copy, Debug)]
pub struct Adjusted {
    /// Maps a point of the left camera now into the left camera before.
    pub prev_from_now: Isometry3<f64>,
    /// Covariance of the right perturbation for a variance factor of 1.
    pub cov_right: Matrix6<f64>,
    /// A-posteriori variance factor: squared residuals over degrees of freedom. It is that of all
    /// the tracks together, outliers included: judge those by `robust_factor` first.
    pub variance_factor: f64,
    /// The same with outliers bounded by their robust weights. What scales a covariance must not
    /// be: heavy tails are noise too, and robust weights then hide a tenth of it.
    pub robust_factor: f64,
    /// Times that the tracks were linearised.
    pub iterations: usize,
}

/// Where Huber's loss turns from square to linear, in σ of one camera's residual: beyond it lie
/// 1.1 % of Gaussian ones (χ² with two degrees of freedom).
const HUBER_SIGMAS: f64 = 3.0;
/// Linearisations at most.
const MAX_ITERATIONS: usize = 30;
/// The search ends where a step would lower the weighted squares by less: a thousandth of a σ.
const SMALL_GAIN: f64 = 1e-6;
/// A step is shortened down to this share of itself before the search is given up.
const SHORTEST: f64 = 1e-4;

/// Adjusts motions; keeps its working memory from pair to pair.
#[derive(Debug, Default)]
pub struct Reprojection {
    tracks: Vec<TrackEquations>,
    start: Vec<Vector3<f64>>,
}

impl Reprojection {
    /// Adjusts motion and points, starting from `prev_from_now` and the points' own values, which
    /// are left at their optimum.
    ///
    /// `None` with fewer than three tracks, or if the motion is not determined by them.
    pub fn adjust(
        &mut self,
        rig: &StereoRig,
        model: &Model,
        prev_from_now: &Isometry3<f64>,
        points: &mut [TrackedPoint],
    ) -> Option<Adjusted> {
        if points.len() < 3 {
            return None;
        }
        let mut motion = model.constrain(prev_from_now);
        let mut cost = self.linearise(rig, &motion, points)?;
        let mut iterations = 1;
        loop {
            let (inverse, gradient) = self.solve(model)?;
            let step = inverse * gradient;
            let gain = step.dot(&gradient) + self.tracks.iter().map(|t| t.own_gain).sum::<f64>();
            if gain <= SMALL_GAIN {
                // So short that the equations need not be set up anew.
                for (p, track) in points.iter_mut().zip(&self.tracks) {
                    p.inverse_depth += track.step_with(&step);
                }
                motion *= se3::exp(&step);
                break;
            }
            if iterations >= MAX_ITERATIONS {
                break;
            }
            match self.walk(rig, &motion, &step, cost, points, &mut iterations) {
                Some((next, lower)) => (motion, cost) = (next, lower),
                // The optimum up to rounding; the equations of where we stand are needed again.
                None => {
                    self.linearise(rig, &motion, points)?;
                    break;
                }
            }
        }
        let (cov_right, _) = self.solve(model)?;
        let freedom = (5 * points.len() - model.degrees_of_freedom()) as f64;
        let sum = |of: fn(&TrackEquations) -> f64| self.tracks.iter().map(of).sum::<f64>();
        Some(Adjusted {
            prev_from_now: motion,
            cov_right,
            variance_factor: sum(|t| t.squares) / freedom,
            robust_factor: sum(|t| t.weighted_squares) / freedom,
            iterations,
        })
    }

    /// What each pixel did to the motion last [adjusted](Self::adjust), a track each, in order.
    pub fn influences(&self, cov_right: &Matrix6<f64>) -> impl Iterator<Item = Influence> {
        self.tracks.iter().map(move |track| Influence {
            by_prev: product(cov_right, &track.by_pixels.by_prev),
            by_now: product(cov_right, &track.by_pixels.by_now),
            ..track.by_pixels
        })
    }

    /// Squared residual of each track of the last adjustment, σ², in order.
    pub fn squared_residuals(&self) -> impl Iterator<Item = f64> {
        self.tracks.iter().map(|track| track.squares)
    }

    /// Takes as much of a step as lowers the cost, and leaves points and equations there.
    fn walk(
        &mut self,
        rig: &StereoRig,
        motion: &Isometry3<f64>,
        step: &Vector6<f64>,
        cost: f64,
        points: &mut [TrackedPoint],
        iterations: &mut usize,
    ) -> Option<(Isometry3<f64>, f64)> {
        let steps: Vec<Vector3<f64>> = self
            .tracks
            .iter()
            .map(|track| track.step_with(step))
            .collect();
        self.start.clear();
        self.start.extend(points.iter().map(|p| p.inverse_depth));
        let mut share = 1.0;
        while share >= SHORTEST && *iterations < MAX_ITERATIONS {
            for ((p, from), by) in points.iter_mut().zip(&self.start).zip(&steps) {
                p.inverse_depth = from + by * share;
            }
            let candidate = motion * se3::exp(&(step * share));
            *iterations += 1;
            if let Some(next) = self
                .linearise(rig, &candidate, points)
                .filter(|c| *c <= cost)
            {
                return Some((candidate, next));
            }
            share *= 0.3;
        }
        for (p, from) in points.iter_mut().zip(&self.start) {
            p.inverse_depth = *from;
        }
        None
    }

    /// Each track's equations at a motion; the cost there, σ².
    fn linearise(
        &mut self,
        rig: &StereoRig,
        prev_from_now: &Isometry3<f64>,
        points: &[TrackedPoint],
    ) -> Option<f64> {
        let before = Viewpoint::unmoved(rig);
        let now = Viewpoint::new(rig, &prev_from_now.inverse());
        self.tracks.clear();
        let mut cost = 0.0;
        for p in points {
            let track = TrackEquations::new(rig, [&before, &now], p)?;
            cost += track.cost;
            self.tracks.push(track);
        }
        Some(cost)
    }

    /// The inverse information of the motion, points marginalised, and its gradient.
    fn solve(&self, model: &Model) -> Option<(Matrix6<f64>, Vector6<f64>)> {
        let mut info = Matrix6::zeros();
        let mut gradient = Vector6::zeros();
        for track in &self.tracks {
            info += track.info;
            gradient += track.gradient;
        }
        Some((model.inverse(&info)?, gradient))
    }
}

/// One track's robust normal equations, its point marginalised.
#[derive(Debug)]
struct TrackEquations {
    info: Matrix6<f64>,
    gradient: Vector6<f64>,
    /// The derivative of the gradient by the pixels.
    by_pixels: Influence,
    /// The point's step for a motion that stays, and what a step of the motion adds.
    point_alone: Vector3<f64>,
    point_by_motion: SMatrix<f64, 3, 6>,
    /// What the point's own step takes off the cost.
    own_gain: f64,
    /// Robust loss, twice: squared residuals, in σ², where they are small.
    cost: f64,
    /// Squared residuals, σ², and the same by their robust weights.
    squares: f64,
    weighted_squares: f64,
}

impl TrackEquations {
    /// `None` where a camera cannot see the point from one of the viewpoints, before and now.
    fn new(rig: &StereoRig, viewpoints: [&Viewpoint; 2], p: &TrackedPoint) -> Option<Self> {
        let [before, now] = viewpoints.map(|from| from.linearise(rig, &p.inverse_depth));
        let (prev, now) = (before?, now?);
        let before = Weighed::new(&p.prev.px, &p.prev.sigma_px, &prev);
        let after = Weighed::new(&p.now.px, &p.now.sigma_px, &now);
        let point_prev: Matrix3x4<f64> = transposed_scaled(&prev.by_point, &before.info);
        let point_now: Matrix3x4<f64> = transposed_scaled(&now.by_point, &after.info);
        let motion_now: Matrix6x4<f64> = transposed_scaled(&now.by_motion, &after.info);
        let point_point: Matrix3<f64> =
            product(&point_prev, &prev.by_point) + product(&point_now, &now.by_point);
        let inverse = point_point.cholesky()?.inverse();
        let point_gradient =
            product(&point_prev, &before.residual) + product(&point_now, &after.residual);
        let motion_point = product(&motion_now, &now.by_point);
        let gain = product(&motion_point, &inverse);
        let point_alone = product(&inverse, &point_gradient);
        Some(Self {
            info: product(&motion_now, &now.by_motion) - product_transposed(&gain, &motion_point),
            gradient: product(&motion_now, &after.residual) - product(&gain, &point_gradient),
            by_pixels: Influence {
                by_prev: -product(&gain, &point_prev),
                by_now: motion_now - product(&gain, &point_now),
                weight_prev: before.weight,
                weight_now: after.weight,
            },
            own_gain: point_gradient.dot(&point_alone),
            point_alone,
            point_by_motion: -gain.transpose(),
            cost: before.cost + after.cost,
            squares: before.squares + after.squares,
            weighted_squares: before.weighted_squares + after.weighted_squares,
        })
    }

    /// The point's step that goes with a step of the motion.
    fn step_with(&self, motion: &Vector6<f64>) -> Vector3<f64> {
        self.point_alone + product(&self.point_by_motion, motion)
    }
}

/// One pair's measurement of a track, weighed.
struct Weighed {
    residual: Vector4<f64>,
    weight: Vector4<f64>,
    /// Robust information of each coordinate, px⁻².
    info: Vector4<f64>,
    cost: f64,
    squares: f64,
    weighted_squares: f64,
}

impl Weighed {
    fn new(px: &Vector4<f64>, sigma_px: &Vector4<f64>, seen: &Sight) -> Self {
        let residual = px - seen.px;
        let n = residual.component_div(sigma_px);
        let (left2, right2) = (n[0] * n[0] + n[1] * n[1], n[2] * n[2] + n[3] * n[3]);
        let ((wl, cl), (wr, cr)) = (huber(left2), huber(right2));
        let weight = Vector4::new(wl, wl, wr, wr);
        Self {
            residual,
            weight,
            info: weight.component_div(&sigma_px.component_mul(sigma_px)),
            cost: cl + cr,
            squares: left2 + right2,
            weighted_squares: wl * left2 + wr * right2,
        }
    }
}

/// Huber's weight and twice his loss, of a squared residual in σ².
fn huber(squares: f64) -> (f64, f64) {
    if squares <= HUBER_SIGMAS * HUBER_SIGMAS {
        (1.0, squares)
    } else {
        let sigmas = squares.sqrt();
        (
            HUBER_SIGMAS / sigmas,
            HUBER_SIGMAS * (2.0 * sigmas - HUBER_SIGMAS),
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimation::bundle::Adjuster;
    use crate::estimation::synthetic::{random, rig, step, tracks};
    use crate::estimation::{MotionModel, Plane};
    use nalgebra::{Isometry2, Vector2};

    #[test]
    fn it_agrees_with_the_bundle_adjustment() {
        let rig = rig();
        let mut rng = random(11);
        for _ in 0..20 {
            let points = tracks(&rig, &step(), 60, [2.0, 40.0], 0.5, &mut rng);
            let (mut ours, mut theirs) = (points.clone(), points);
            let found = Reprojection::default()
                .adjust(&rig, &Model::Se3, &step(), &mut ours)
                .expect("determined");
            let other = Adjuster::default()
                .adjust(&rig, &step(), &mut theirs)
                .expect("determined");
            let apart = se3::log(&(other.motion.prev_from_now.inverse() * found.prev_from_now));
            // Both stop within a thousandth of a σ or so.
            let nees = apart.dot(&found.cov_right.cholesky().expect("definite").solve(&apart));
            assert!(nees < 1e-4, "{nees}");
            let ratio = (found.cov_right - other.motion.cov_right).norm() / found.cov_right.norm();
            assert!(ratio < 1e-3, "{ratio}");
            assert!((found.robust_factor / other.variance_factor - 1.0).abs() < 1e-3);
        }
    }

    #[test]
    fn exact_measurements_give_the_exact_motion_in_the_plane_too() {
        let rig = rig();
        let planar = MotionModel::Planar.of(&rig);
        let truth = Plane::of(&rig).lift(&Isometry2::new(Vector2::new(0.4, 0.05), 0.06));
        let mut points = tracks(&rig, &truth, 30, [2.0, 40.0], 0.0, &mut random(12));
        let found = Reprojection::default()
            .adjust(&rig, &planar, &Isometry3::identity(), &mut points)
            .expect("determined");
        let error = se3::log(&(truth.inverse() * found.prev_from_now));
        assert!(error.norm() < 1e-8, "{error}");
        // Nothing leaves the plane: heave, roll and pitch are certain.
        assert_eq!(found.cov_right.column(1).norm(), 0.0);
        assert!(found.cov_right[(4, 4)] > 0.0);
    }

    #[test]
    fn what_does_not_determine_a_motion_is_refused() {
        let rig = rig();
        let mut adjuster = Reprojection::default();
        let mut few = tracks(&rig, &step(), 2, [2.0, 40.0], 0.5, &mut random(13));
        assert!(
            adjuster
                .adjust(&rig, &Model::Se3, &step(), &mut few)
                .is_none()
        );
        let one = tracks(&rig, &step(), 1, [2.0, 40.0], 0.0, &mut random(14))[0];
        let mut same = vec![one; 5];
        // One point, however often, determines nothing.
        let found = adjuster.adjust(&rig, &Model::Se3, &step(), &mut same);
        assert!(found.is_none());
    }
}
