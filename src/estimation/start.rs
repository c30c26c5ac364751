//! Where an earlier run ended, as the beginning of this one.
//!
//! Nothing was seen in between. The pose that the robot most probably has is still the last one; how far it
//! may be from it grows with the time T that has passed: by σ_v T along each axis and σ_ω T about each, for a
//! robot whose velocity meanwhile is unknown but for its size, and may have been the same all the time. That
//! is the most careful model with these σ: were the velocity new every second, it would grow with √T.

use crate::geometry::se3;
use nalgebra::{Isometry3, Matrix6, Vector6};
use std::time::{Duration, Instant};

/// Where an odometry frame of before is taken up again.
#[derive(Clone, Debug)]
pub struct Start {
    /// The last pose that was known.
    pub odom_from_camera: Isometry3<f64>,
    /// Its covariance then, of the error `[t_est − t ; Log(R_est Rᵀ)]`.
    pub cov_pose: Matrix6<f64>,
    /// Since then, up to when this was made.
    pub gap: Duration,
    /// When this was made.
    pub made: Instant,
    /// 1 σ of the robot's speed along an axis meanwhile, m/s.
    pub sigma_speed_m_s: f64,
    /// 1 σ of its turn about an axis meanwhile, rad/s.
    pub sigma_turn_rad_s: f64,
}

impl Start {
    /// The covariance of a right perturbation of the pose, once the time of `now` is reached.
    #[must_use]
    pub fn cov_right(&self, now: Instant) -> Matrix6<f64> {
        let t_s = (self.gap + now.saturating_duration_since(self.made)).as_secs_f64();
        let (moved_m, turned_rad) = (self.sigma_speed_m_s * t_s, self.sigma_turn_rad_s * t_s);
        let sigma = Vector6::new(
            moved_m, moved_m, moved_m, turned_rad, turned_rad, turned_rad,
        );
        let then = se3::cov_right_from_fixed_axes(&self.odom_from_camera, &self.cov_pose);
        then + Matrix6::from_diagonal(&sigma.component_mul(&sigma))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::uncertainty::consistency::{anees_interval, nees};
    use rand::{RngExt, SeedableRng};
    use rand_distr::StandardNormal;
    use rand_xoshiro::Xoshiro256PlusPlus;

    #[test]
    fn the_covariance_is_that_of_robots_that_went_on_at_whatever_velocity() {
        let stands = se3::exp(&Vector6::new(3.0, -1.0, 20.0, 0.4, -1.2, 0.3));
        let sigma_then = Vector6::new(0.1, 0.05, 0.2, 0.01, 0.02, 0.005);
        let start = Start {
            odom_from_camera: stands,
            cov_pose: Matrix6::from_diagonal(&sigma_then.component_mul(&sigma_then)),
            gap: Duration::from_secs(2),
            made: Instant::now(),
            sigma_speed_m_s: 0.3,
            sigma_turn_rad_s: 0.02,
        };
        let gap_s = 5.0;
        let first_pair = start.made + Duration::from_secs(3);
        let cov = se3::cov_fixed_axes_from_right(&stands, &start.cov_right(first_pair));
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(3);
        let runs = 4000;
        let total: f64 = (0..runs)
            .map(|_| {
                let mut normal = || Vector6::from_fn(|_, _| rng.sample::<f64, _>(StandardNormal));
                let error = sigma_then.component_mul(&normal());
                let mut was = stands;
                was.translation.vector -= se3::translation_of(&error);
                was.rotation =
                    nalgebra::UnitQuaternion::new(-se3::rotation_of(&error)) * was.rotation;
                let speed = Vector6::new(0.3, 0.3, 0.3, 0.02, 0.02, 0.02);
                let is = was * se3::exp(&(gap_s * speed.component_mul(&normal())));
                nees(&se3::error_fixed_axes(&stands, &is), &cov).expect("positive definite")
            })
            .sum();
        let anees = total / (6.0 * f64::from(runs));
        let (low, high) = anees_interval(6, runs as usize, 0.999);
        // To first order: turns of up to 0.3 rad bend what was moved by a hundredth.
        assert!(
            (low - 0.01..high + 0.01).contains(&anees),
            "{low} {anees} {high}"
        );
    }

    #[test]
    fn without_a_gap_it_is_what_it_was() {
        let made = Instant::now();
        let start = Start {
            odom_from_camera: se3::exp(&Vector6::new(1.0, 2.0, 3.0, 0.1, 0.2, 0.3)),
            cov_pose: Matrix6::identity() * 1e-4,
            gap: Duration::ZERO,
            made,
            sigma_speed_m_s: 1.0,
            sigma_turn_rad_s: 1.0,
        };
        let right = start.cov_right(made);
        let back = se3::cov_fixed_axes_from_right(&start.odom_from_camera, &right);
        assert!((back - start.cov_pose).norm() < 1e-15);
    }
}
