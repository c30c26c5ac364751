//! Two-frame stereo bundle adjustment: tracked stereo measurements in, the most likely motion out,
//! with the covariance that the pixels' own covariances and the residuals give it.
//!
//! Unknowns are the motion and every point, each in inverse depth in the earlier left camera, so
//! that points at infinity are ordinary. What is minimised is the reprojection error of all eight
//! coordinates of a track, robust by camera (Huber). Points are marginalised by the Schur
//! complement: cost grows linearly with the tracks. (Theory: Triggs et al. 2000, *Bundle
//! Adjustment – A Modern Synthesis*.)

use super::closed_form::MotionEstimate;
use super::sight::{self, Sight};
use super::triangulation::StereoMeasurement;
use crate::geometry::{StereoRig, se3};
use nalgebra::{Isometry3, Matrix3, Matrix6, SMatrix, Vector2, Vector3, Vector4, Vector6};

/// One point seen by both cameras before and now.
#[derive(Clone, Copy, Debug)]
pub struct TrackedPoint {
    /// The stereo measurement of the earlier pair.
    pub prev: StereoMeasurement,
    /// The stereo measurement of this pair.
    pub now: StereoMeasurement,
    /// Position on the earlier left camera's normalised plane and inverse depth (1/m): the point
    /// is (x, y, 1) / ρ.
    pub inverse_depth: Vector3<f64>,
}

/// What the adjustment found.
#[derive(Clone, Copy, Debug)]
pub struct Adjustment {
    /// The motion, with covariance for a variance factor of 1.
    pub motion: MotionEstimate,
    /// A-posteriori variance factor: weighted squared residuals over degrees of freedom.
    pub variance_factor: f64,
    /// Iterations taken.
    pub iterations: usize,
}

/// Where Huber's loss turns from square to linear, in σ of a two-dimensional residual: beyond it
/// lie 1.1 % of Gaussian ones (χ² with two degrees of freedom).
const HUBER_SIGMAS: f64 = 3.0;
/// Levenberg–Marquardt iterations at most.
const MAX_ITERATIONS: usize = 25;
/// The relative gain in cost below which the optimum is reached.
const MIN_GAIN: f64 = 1e-9;

/// Adjusts motions; keeps its working memory from pair to pair.
#[derive(Debug, Default)]
pub struct Adjuster {
    systems: Vec<PointSystem>,
    moved: Vec<Vector3<f64>>,
}

impl Adjuster {
    /// Adjusts motion and points, starting from `prev_from_now` and the points' own values, which
    /// are left at their optimum.
    ///
    /// `None` with fewer than three tracks, or if the motion is not determined by them.
    #[must_use]
    pub fn adjust(
        &mut self,
        rig: &StereoRig,
        prev_from_now: &Isometry3<f64>,
        points: &mut [TrackedPoint],
    ) -> Option<Adjustment> {
        if points.len() < 3 {
            return None;
        }
        let mut motion = *prev_from_now;
        let mut damping = 1e-6;
        let mut cost = self.linearise(rig, &motion, points)?;
        let mut iterations = 0;
        while iterations < MAX_ITERATIONS && damping < 1e6 {
            iterations += 1;
            let (reduced, gradient) = self.reduce(damping)?;
            let step = damped(&reduced, damping).cholesky()?.solve(&gradient);
            let candidate = motion * se3::exp(&step);
            match self.cost_after(rig, &candidate, &step, points, damping) {
                Some(next) if next <= cost => {
                    motion = candidate;
                    for (p, moved) in points.iter_mut().zip(&self.moved) {
                        p.inverse_depth = *moved;
                    }
                    let gain = cost - next;
                    cost = self.linearise(rig, &motion, points)?;
                    damping = (damping * 0.1).max(1e-12);
                    if gain <= MIN_GAIN * cost {
                        break;
                    }
                }
                _ => damping *= 10.0,
            }
        }
        let (reduced, _) = self.reduce(0.0)?;
        Some(Adjustment {
            motion: MotionEstimate {
                prev_from_now: motion,
                cov_right: se3::symmetric(&reduced.cholesky()?.inverse()),
            },
            variance_factor: variance_factor(rig, &motion, points)?,
            iterations,
        })
    }

    /// Each track's system at a motion; the cost there.
    fn linearise(
        &mut self,
        rig: &StereoRig,
        prev_from_now: &Isometry3<f64>,
        points: &[TrackedPoint],
    ) -> Option<f64> {
        let now_from_prev = prev_from_now.inverse();
        self.systems.clear();
        let mut cost = 0.0;
        for p in points {
            let (system, loss) = PointSystem::new(rig, &now_from_prev, p)?;
            self.systems.push(system);
            cost += loss;
        }
        Some(cost)
    }

    /// The normal equations of the motion alone, points marginalised (Schur complement).
    fn reduce(&self, damping: f64) -> Option<(Matrix6<f64>, Vector6<f64>)> {
        let mut reduced = Matrix6::zeros();
        let mut gradient = Vector6::zeros();
        for system in &self.systems {
            let inverse = damped(&system.point_point, damping).cholesky()?.inverse();
            let gain = system.motion_point * inverse;
            reduced += system.motion_motion - gain * system.motion_point.transpose();
            gradient += system.motion_gradient - gain * system.point_gradient;
        }
        Some((se3::symmetric(&reduced), gradient))
    }

    /// The cost after a step of the motion and the steps of the points that go with it.
    fn cost_after(
        &mut self,
        rig: &StereoRig,
        candidate: &Isometry3<f64>,
        step: &Vector6<f64>,
        points: &[TrackedPoint],
        damping: f64,
    ) -> Option<f64> {
        let now_from_prev = candidate.inverse();
        self.moved.clear();
        let mut cost = 0.0;
        for (p, system) in points.iter().zip(&self.systems) {
            let right = system.point_gradient - system.motion_point.transpose() * step;
            let by = damped(&system.point_point, damping)
                .cholesky()?
                .solve(&right);
            let moved = p.inverse_depth + by;
            let residuals = residual_sigmas(rig, &now_from_prev, p, &moved)?;
            cost += residuals.iter().map(|r| huber_loss(r.norm())).sum::<f64>();
            self.moved.push(moved);
        }
        Some(cost)
    }
}

/// One track's weighted normal equations.
#[derive(Debug)]
struct PointSystem {
    motion_motion: Matrix6<f64>,
    motion_point: SMatrix<f64, 6, 3>,
    point_point: Matrix3<f64>,
    motion_gradient: Vector6<f64>,
    point_gradient: Vector3<f64>,
}

impl PointSystem {
    /// The equations and the robust cost. `None` where a camera cannot see the point.
    fn new(
        rig: &StereoRig,
        now_from_prev: &Isometry3<f64>,
        p: &TrackedPoint,
    ) -> Option<(Self, f64)> {
        let mut system = Self {
            motion_motion: Matrix6::zeros(),
            motion_point: SMatrix::zeros(),
            point_point: Matrix3::zeros(),
            motion_gradient: Vector6::zeros(),
            point_gradient: Vector3::zeros(),
        };
        let prev = sight::linearise(rig, &Isometry3::identity(), &p.inverse_depth)?;
        let now = sight::linearise(rig, now_from_prev, &p.inverse_depth)?;
        let (info, residual, loss_prev) = weigh(&p.prev, &prev);
        let weighted = prev.by_point.transpose() * info;
        system.point_point += weighted * prev.by_point;
        system.point_gradient += weighted * residual;
        let (info, residual, loss_now) = weigh(&p.now, &now);
        let weighted = now.by_point.transpose() * info;
        system.point_point += weighted * now.by_point;
        system.point_gradient += weighted * residual;
        let weighted = now.by_motion.transpose() * info;
        system.motion_motion = weighted * now.by_motion;
        system.motion_point = weighted * now.by_point;
        system.motion_gradient = weighted * residual;
        Some((system, loss_prev + loss_now))
    }
}

/// Robust information, residual (px) and loss of one pair's measurement.
fn weigh(m: &StereoMeasurement, seen: &Sight) -> (nalgebra::Matrix4<f64>, Vector4<f64>, f64) {
    let residual = m.px - seen.px;
    let normalised = residual.component_div(&m.sigma_px);
    let (left, right) = (normalised.xy().norm(), normalised.fixed_rows::<2>(2).norm());
    let (wl, wr) = (huber_weight(left), huber_weight(right));
    let info = Vector4::new(wl, wl, wr, wr).component_div(&m.sigma_px.component_mul(&m.sigma_px));
    (
        nalgebra::Matrix4::from_diagonal(&info),
        residual,
        huber_loss(left) + huber_loss(right),
    )
}

/// The four two-dimensional residuals of a track, each over its σ, with its point at
/// `inverse_depth`. `None` where a camera cannot see it.
fn residual_sigmas(
    rig: &StereoRig,
    now_from_prev: &Isometry3<f64>,
    p: &TrackedPoint,
    inverse_depth: &Vector3<f64>,
) -> Option<[Vector2<f64>; 4]> {
    let prev = sight::seen_at(rig, &Isometry3::identity(), inverse_depth)?;
    let now = sight::seen_at(rig, now_from_prev, inverse_depth)?;
    let prev = (p.prev.px - prev).component_div(&p.prev.sigma_px);
    let now = (p.now.px - now).component_div(&p.now.sigma_px);
    let right = |r: &Vector4<f64>| r.fixed_rows::<2>(2).into_owned();
    Some([prev.xy(), right(&prev), now.xy(), right(&now)])
}

/// Weighted squared residuals over degrees of freedom: eight measurements a track, less three
/// unknowns of its point, less six of the motion.
fn variance_factor(
    rig: &StereoRig,
    prev_from_now: &Isometry3<f64>,
    points: &[TrackedPoint],
) -> Option<f64> {
    let now_from_prev = prev_from_now.inverse();
    let mut sum = 0.0;
    for p in points {
        for r in residual_sigmas(rig, &now_from_prev, p, &p.inverse_depth)? {
            let norm = r.norm();
            sum += huber_weight(norm) * norm * norm;
        }
    }
    let freedom = 5 * points.len() - 6;
    Some(sum / freedom as f64)
}

/// Squared residual of a track at a motion and at its own point, in σ². `None` where a camera
/// cannot see it.
#[must_use]
pub fn squared_residual_sigmas(
    rig: &StereoRig,
    prev_from_now: &Isometry3<f64>,
    point: &TrackedPoint,
) -> Option<f64> {
    let residuals = residual_sigmas(rig, &prev_from_now.inverse(), point, &point.inverse_depth)?;
    Some(residuals.iter().map(Vector2::norm_squared).sum())
}

pub(super) fn huber_weight(sigmas: f64) -> f64 {
    if sigmas <= HUBER_SIGMAS {
        1.0
    } else {
        HUBER_SIGMAS / sigmas
    }
}

pub(super) fn huber_loss(sigmas: f64) -> f64 {
    if sigmas <= HUBER_SIGMAS {
        0.5 * sigmas * sigmas
    } else {
        HUBER_SIGMAS * (sigmas - 0.5 * HUBER_SIGMAS)
    }
}

/// Marquardt's damping: the diagonal grows by a share of itself.
fn damped<const N: usize>(m: &SMatrix<f64, N, N>, damping: f64) -> SMatrix<f64, N, N> {
    m + SMatrix::from_diagonal(&(m.diagonal() * damping))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimation::triangulate;
    use crate::geometry::parse_rig;
    use nalgebra::Point3;
    use rand::{RngExt, SeedableRng};
    use rand_distr::{Distribution, StandardNormal};
    use rand_xoshiro::Xoshiro256PlusPlus;

    fn rig() -> StereoRig {
        parse_rig(
            "left = { width = 640, height = 480, focal = [885.81833, 884.10614], principal_point = [313.18805, 243.49370] }
             right = { width = 640, height = 480, focal = [882.93736, 881.18040], principal_point = [300.19781, 246.39833], distortion = { model = \"radtan\", coefficients = [-0.2, 0.1, 0.0005, -0.0003] } }
             right_from_left = { translation_m = [-0.3857, -0.0072, 0.0001], rotation_vector_rad = [0.04046, 0.01616, 0.01419] }",
        )
        .expect("valid")
    }

    /// Points 2–40 m ahead, seen before and after `prev_from_now`, with noise of `sigma_px`.
    fn tracks(
        rig: &StereoRig,
        prev_from_now: &Isometry3<f64>,
        count: usize,
        sigma_px: f64,
        rng: &mut Xoshiro256PlusPlus,
    ) -> Vec<TrackedPoint> {
        let mut tracks = Vec::new();
        while tracks.len() < count {
            let z: f64 = rng.random_range(2.0..40.0);
            let px = Vector2::new(rng.random_range(0.0..640.0), rng.random_range(0.0..480.0));
            let prev = Point3::from(rig.left.ray(&px).expect("inside") * z);
            let now = prev_from_now.inverse() * prev;
            let measure = |p: &Point3<f64>, rng: &mut Xoshiro256PlusPlus| {
                let seen = rig.project(p)?;
                let inside = rig.left.contains(&Vector2::new(seen[0], seen[1]), 0.0)
                    && rig.right.contains(&Vector2::new(seen[2], seen[3]), 0.0);
                inside.then(|| StereoMeasurement {
                    px: seen
                        + Vector4::from_fn(|_, _| {
                            let n: f64 = StandardNormal.sample(rng);
                            n * sigma_px
                        }),
                    sigma_px: Vector4::repeat(0.5),
                })
            };
            let (Some(m_prev), Some(m_now)) = (measure(&prev, rng), measure(&now, rng)) else {
                continue;
            };
            let Some(landmark) = triangulate(rig, &m_prev) else {
                continue;
            };
            let p = landmark.point;
            tracks.push(TrackedPoint {
                prev: m_prev,
                now: m_now,
                inverse_depth: Vector3::new(p.x / p.z, p.y / p.z, 1.0 / p.z),
            });
        }
        tracks
    }

    fn step() -> Isometry3<f64> {
        se3::exp(&Vector6::new(0.02, -0.01, 0.3, 0.01, 0.04, -0.005))
    }

    #[test]
    fn exact_measurements_give_the_exact_motion() {
        let rig = rig();
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(2);
        let mut points = tracks(&rig, &step(), 40, 0.0, &mut rng);
        let found = Adjuster::default()
            .adjust(&rig, &Isometry3::identity(), &mut points)
            .expect("determined");
        let error = se3::log(&(step().inverse() * found.motion.prev_from_now));
        assert!(error.norm() < 1e-8, "{error}");
        assert!(found.variance_factor < 1e-9);
    }

    #[test]
    fn covariance_holds_against_monte_carlo_and_is_scaled_by_residuals() {
        const RUNS: usize = 300;
        let rig = rig();
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(3);
        // Noise as stated, and 40 % above: the residuals must tell.
        for sigma_px in [0.5, 0.7] {
            let mut nees = 0.0;
            for _ in 0..RUNS {
                let mut points = tracks(&rig, &step(), 100, sigma_px, &mut rng);
                let found = Adjuster::default()
                    .adjust(&rig, &step(), &mut points)
                    .expect("determined");
                let cov = found.motion.cov_right * found.variance_factor;
                let error = se3::log(&(step().inverse() * found.motion.prev_from_now));
                nees += error.dot(&cov.cholesky().expect("positive definite").solve(&error))
                    / (6 * RUNS) as f64;
            }
            // The two-sided 95 % interval of χ²(1800)/1800 is [0.936, 1.066]; 3 σ is 10 %.
            assert!((0.9..1.1).contains(&nees), "σ {sigma_px}: ANEES/6 {nees}");
        }
    }

    #[test]
    fn too_few_tracks_are_refused() {
        let rig = rig();
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(4);
        let mut points = tracks(&rig, &step(), 2, 0.5, &mut rng);
        assert!(
            Adjuster::default()
                .adjust(&rig, &step(), &mut points)
                .is_none()
        );
    }
}
