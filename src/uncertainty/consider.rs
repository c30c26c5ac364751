//! Consider-parameters: numbers that an estimator takes for granted though they are uncertain, and
//! what their errors do to a pose (Schmidt 1966; theory §5).
//!
//! Such an error is the same at every pair. It does not average out: its effects on consecutive
//! motions add up coherently, along a straight way in proportion to the distance.

use crate::geometry::se3;
use nalgebra::{Isometry3, Matrix6, SMatrix, Vector6};

/// The derivative of a pose (right perturbation) by `C` parameters that stay the same along the
/// path.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sensitivity<const C: usize> {
    by_parameters: SMatrix<f64, 6, C>,
}

impl<const C: usize> Default for Sensitivity<C> {
    /// The origin is exact whatever the parameters are.
    fn default() -> Self {
        Self {
            by_parameters: SMatrix::zeros(),
        }
    }
}

impl<const C: usize> Sensitivity<C> {
    /// That of a motion or pose whose derivative is known.
    #[must_use]
    pub fn new(by_parameters: SMatrix<f64, 6, C>) -> Self {
        Self { by_parameters }
    }

    /// The derivative itself.
    #[must_use]
    pub fn by_parameters(&self) -> &SMatrix<f64, 6, C> {
        &self.by_parameters
    }

    /// That of the pose after one more motion: `S ← Ad(M⁻¹) S + G` with `motion` = G.
    #[must_use]
    pub fn chain(&self, prev_from_now: &Isometry3<f64>, motion: &Self) -> Self {
        let carried = se3::adjoint(&prev_from_now.inverse()) * self.by_parameters;
        Self {
            by_parameters: carried + motion.by_parameters,
        }
    }

    /// That of the motion between two poses, from theirs: the inverse of [`chain`](Self::chain).
    /// For estimators that give poses rather than motions.
    #[must_use]
    pub fn between(&self, prev_from_now: &Isometry3<f64>, now: &Self) -> Self {
        let carried = se3::adjoint(&prev_from_now.inverse()) * self.by_parameters;
        Self {
            by_parameters: now.by_parameters - carried,
        }
    }

    /// What the parameters' covariance adds to that of the pose: `S Σ_c Sᵀ`.
    #[must_use]
    pub fn covariance(&self, cov_parameters: &SMatrix<f64, C, C>) -> Matrix6<f64> {
        let s = &self.by_parameters;
        se3::symmetric(&(s * cov_parameters * s.transpose()))
    }
}

/// What an uncertain time stamp adds to the covariance of the pose at that time (right
/// perturbation): the robot moved on by twist × σ.
#[must_use]
pub fn of_timestamp(twist: &Vector6<f64>, sigma_s: f64) -> Matrix6<f64> {
    twist * twist.transpose() * (sigma_s * sigma_s)
}

/// The same for a velocity that was measured over `dt_s` between two stamps, each uncertain on its
/// own: σ² of the interval is 2 σ_stamp².
#[must_use]
pub fn of_interval(twist: &Vector6<f64>, dt_s: f64, sigma_s: f64) -> Matrix6<f64> {
    twist * twist.transpose() * (2.0 * sigma_s * sigma_s / (dt_s * dt_s))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn chained_sensitivities_are_the_derivative_of_the_path(
            steps in prop::collection::vec((prop::array::uniform6(-0.5..0.5_f64), prop::array::uniform6(-1.0..1.0_f64)), 1..12)
        ) {
            // Each motion is off by its own derivative times one common parameter.
            let path = |parameter: f64| {
                steps.iter().fold(Isometry3::identity(), |pose, (xi, by)| {
                    let motion = se3::exp(&Vector6::from(*xi));
                    pose * motion * se3::exp(&(Vector6::from(*by) * parameter))
                })
            };
            let mut sensitivity = Sensitivity::<1>::default();
            let mut before = sensitivity;
            let mut last = Isometry3::identity();
            for (xi, by) in &steps {
                last = se3::exp(&Vector6::from(*xi));
                before = sensitivity;
                let motion = Sensitivity::new(SMatrix::from(Vector6::from(*by)));
                sensitivity = sensitivity.chain(&last, &motion);
            }
            let h = 1e-6;
            let numeric = (se3::log(&(path(0.0).inverse() * path(h)))
                - se3::log(&(path(0.0).inverse() * path(-h)))) / (2.0 * h);
            prop_assert!((numeric - sensitivity.by_parameters()).norm() < 1e-6 * (1.0 + numeric.norm()));
            let back = before.between(&last, &sensitivity);
            let by = Vector6::from(steps.last().expect("not empty").1);
            prop_assert!((back.by_parameters() - by).norm() < 1e-9 * (1.0 + numeric.norm()));
        }
    }

    #[test]
    fn on_a_straight_way_the_effect_grows_with_the_distance() {
        let step = Isometry3::translation(0.0, 0.0, 0.5);
        // A scale error: each motion comes out a hundredth too long per unit.
        let motion = Sensitivity::new(SMatrix::from(Vector6::new(0.0, 0.0, 0.005, 0.0, 0.0, 0.0)));
        let mut pose = Sensitivity::<1>::default();
        for _ in 0..100 {
            pose = pose.chain(&step, &motion);
        }
        let cov = pose.covariance(&SMatrix::<f64, 1, 1>::new(4.0));
        assert!((cov[(2, 2)].sqrt() - 1.0).abs() < 1e-12);
    }

    #[test]
    fn late_stamps_move_the_pose_along_its_velocity() {
        let twist = Vector6::new(0.0, 0.0, 2.0, 0.0, 0.5, 0.0);
        let cov = of_timestamp(&twist, 0.001);
        assert!((cov[(2, 2)].sqrt() - 0.002).abs() < 1e-15);
        assert!((cov[(4, 4)].sqrt() - 0.0005).abs() < 1e-15);
        let cov = of_interval(&twist, 0.1, 0.001);
        assert!((cov[(2, 2)].sqrt() - 2.0 * 0.01 * 2_f64.sqrt()).abs() < 1e-12);
    }
}
