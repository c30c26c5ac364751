//! Triangulation: one stereo measurement in, a point with its covariance out (thesis §2.3, §3.2).
//!
//! Frame: left camera, m. A measurement is (ul, vl, ur, vr), raw px.

use crate::geometry::{StereoRig, definite};
use crate::uncertainty::{derivative_of_minimiser, propagate};
use nalgebra::{
    Matrix3, Matrix3x4, Matrix4, Matrix4x3, Point3, SMatrix, Vector2, Vector3, Vector4,
};

/// Where a stereo rig saw a point, and how sure it is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StereoMeasurement {
    /// (ul, vl, ur, vr), raw px.
    pub px: Vector4<f64>,
    /// Standard deviation of each coordinate, px; the coordinates are independent.
    pub sigma_px: Vector4<f64>,
}

impl StereoMeasurement {
    /// The covariance `Σ_z`, px².
    #[must_use]
    pub fn cov_px2(&self) -> Matrix4<f64> {
        Matrix4::from_diagonal(&self.sigma_px.component_mul(&self.sigma_px))
    }

    /// The left pixel.
    #[must_use]
    pub fn left_px(&self) -> Vector2<f64> {
        self.px.fixed_rows::<2>(0).into_owned()
    }

    /// The right pixel.
    #[must_use]
    pub fn right_px(&self) -> Vector2<f64> {
        self.px.fixed_rows::<2>(2).into_owned()
    }
}

/// A point in the left camera's frame with its covariance.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Landmark {
    /// The point, m.
    pub point: Point3<f64>,
    /// Its covariance `Σ_p`, m².
    pub cov_m2: Matrix3<f64>,
}

impl Landmark {
    /// The point (x, y, 1) / ρ, of (x, y, ρ) and its covariance. `None` where it lies behind the camera,
    /// or farther away than numbers tell.
    #[must_use]
    pub fn from_inverse_depth(inverse_depth: &Vector3<f64>, cov: &Matrix3<f64>) -> Option<Self> {
        let [x, y, rho] = (*inverse_depth).into();
        if rho <= 0.0 {
            return None;
        }
        let z = 1.0 / rho;
        #[rustfmt::skip]
        let by_inverse_depth = Matrix3::new(
            z, 0.0, -x * z * z,
            0.0, z, -y * z * z,
            0.0, 0.0, -z * z,
        );
        let cov_m2 = by_inverse_depth * cov * by_inverse_depth.transpose();
        let landmark = Self {
            point: Point3::new(x * z, y * z, z),
            cov_m2: (cov_m2 + cov_m2.transpose()) * 0.5,
        };
        let numbers = landmark.cov_m2.iter().chain(landmark.point.iter());
        numbers.copied().all(f64::is_finite).then_some(landmark)
    }

    /// Whether first-order propagation holds: σ of the depth is at most 8 % of it, where Monte
    /// Carlo agrees to a per cent. Beyond, depth is not Gaussian (its inverse is).
    #[must_use]
    pub fn is_first_order(&self) -> bool {
        self.cov_m2[(2, 2)].sqrt() <= 0.08 * self.point.z
    }
}

/// Gauss–Newton steps of the refinement; it converges in two or three.
const MAX_STEPS: usize = 10;

/// The point that is seen at `measurement`: the linear solution, then the least reprojection error
/// in both images, weighted by Σ_z. Covariance by the implicit function theorem.
///
/// `None` where the sights meet behind the cameras or at infinity.
#[must_use]
pub fn triangulate(rig: &StereoRig, measurement: &StereoMeasurement) -> Option<Landmark> {
    let start = triangulate_linear(rig, measurement)?.point;
    let info = measurement.sigma_px.map(|s| 1.0 / (s * s));
    let mut point = start;
    for _ in 0..MAX_STEPS {
        let (seen, jacobian) = rig.project_with_jacobian(&point)?;
        let (hessian, gradient) = normal_equations(&jacobian, &info, &(measurement.px - seen));
        let step = hessian.cholesky()?.solve(&gradient);
        point += step;
        if point.z <= 0.0 {
            return None;
        }
        if step.norm() <= 1e-12 * point.coords.norm() {
            break;
        }
    }
    let (_, jacobian) = rig.project_with_jacobian(&point)?;
    let (hessian, _) = normal_equations(&jacobian, &info, &Vector4::zeros());
    // With weights Σ_z⁻¹, −H⁻¹ ∂²C/∂y∂z Σ_z (…)ᵀ collapses to H⁻¹ (residuals being small).
    Some(Landmark {
        point,
        cov_m2: definite::inverse(&hessian)?,
    })
}

fn normal_equations(
    jacobian: &Matrix4x3<f64>,
    info: &Vector4<f64>,
    residual: &Vector4<f64>,
) -> (Matrix3<f64>, Vector3<f64>) {
    let weighted = jacobian.transpose() * Matrix4::from_diagonal(info);
    (weighted * jacobian, weighted * residual)
}

/// The linear solution (thesis 2.3–2.5) and its covariance (thesis 3.9–3.14, corrected).
///
/// On the undistorted planes (z = 1), with `n_l`, `n_r` the positions and `R`, `t` the right camera
/// from the left: rows `(n_r r₃ᵀ − r₁,₂ᵀ) y = t₁,₂ − n_r t₃` and `(n_l e₃ᵀ − e₁,₂ᵀ) y = 0`, each
/// times its focal length. That is `A(z) y = b(z)`, four equations in three unknowns.
///
/// `None` as for [`triangulate`].
#[must_use]
pub fn triangulate_linear(rig: &StereoRig, measurement: &StereoMeasurement) -> Option<Landmark> {
    let (n_left, left_by_px) = rig.left.unproject_with_jacobian(&measurement.left_px())?;
    let (n_right, right_by_px) = rig.right.unproject_with_jacobian(&measurement.right_px())?;
    let system = LinearSystem::new(rig, &n_left, &n_right);
    let (y, normal) = system.solve()?;
    if y.z <= 0.0 {
        return None;
    }
    let mut by_px = Matrix4::zeros();
    by_px.fixed_view_mut::<2, 2>(0, 0).copy_from(&left_by_px);
    by_px.fixed_view_mut::<2, 2>(2, 2).copy_from(&right_by_px);
    let cov_normalised = propagate(&by_px, &measurement.cov_px2());
    let gradient = derivative_of_minimiser(&normal, &system.mixed_derivative(&y))?;
    Some(Landmark {
        point: Point3::from(y),
        cov_m2: propagate(&gradient, &cov_normalised),
    })
}

/// `A(z) y = b(z)` with its derivatives by the normalised measurement (xl, yl, xr, yr).
struct LinearSystem {
    a: Matrix4x3<f64>,
    b: Vector4<f64>,
    /// `∂A/∂z_j` has one row that is not zero: row j, and this is it.
    a_by_z: Matrix4x3<f64>,
    /// `∂b/∂z_j`, likewise in row j alone.
    b_by_z: Vector4<f64>,
}

impl LinearSystem {
    fn new(rig: &StereoRig, n_left: &Vector2<f64>, n_right: &Vector2<f64>) -> Self {
        let rotation = rig.right_from_left.rotation.to_rotation_matrix();
        let r = rotation.matrix();
        let t = rig.right_from_left.translation.vector;
        let focal: [f64; 4] = [
            rig.left.focal_px.x,
            rig.left.focal_px.y,
            rig.right.focal_px.x,
            rig.right.focal_px.y,
        ];
        let mut system = Self {
            a: Matrix4x3::zeros(),
            b: Vector4::zeros(),
            a_by_z: Matrix4x3::zeros(),
            b_by_z: Vector4::zeros(),
        };
        for axis in 0..2 {
            let mut left = Vector3::zeros();
            left[axis] = -1.0;
            left.z = n_left[axis];
            let right = r.row(2).transpose() * n_right[axis] - r.row(axis).transpose();
            let (i, j) = (axis, axis + 2);
            system.a.set_row(i, &(left * focal[i]).transpose());
            system.a.set_row(j, &(right * focal[j]).transpose());
            system.b[j] = (t[axis] - n_right[axis] * t.z) * focal[j];
            system
                .a_by_z
                .set_row(i, &(Vector3::z() * focal[i]).transpose());
            system.a_by_z.set_row(j, &(r.row(2) * focal[j]));
            system.b_by_z[j] = -t.z * focal[j];
        }
        system
    }

    /// The least-squares solution and `∂²C/∂y² / 2 = AᵀA`.
    fn solve(&self) -> Option<(Vector3<f64>, Matrix3<f64>)> {
        let normal = self.a.transpose() * self.a;
        let y = normal.cholesky()?.solve(&(self.a.transpose() * self.b));
        Some((y, normal))
    }

    /// `∂²C/∂y∂z / 2`: column j is `A_jᵀ r + Aᵀ r_j`, with `r = A y − b`, `r_j = A_j y − ∂b/∂z_j`.
    fn mixed_derivative(&self, y: &Vector3<f64>) -> Matrix3x4<f64> {
        let residual = self.a * y - self.b;
        let mut mixed = SMatrix::<f64, 3, 4>::zeros();
        for j in 0..4 {
            let row = self.a_by_z.row(j).transpose();
            let residual_by_z = row.dot(y) - self.b_by_z[j];
            let column = row * residual[j] + self.a.row(j).transpose() * residual_by_z;
            mixed.set_column(j, &column);
        }
        mixed
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::parse_rig;
    use rand::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};
    use rand_xoshiro::Xoshiro256PlusPlus;

    /// The thesis' rig at the resolution its calibration belongs to, with a mild lens.
    fn rig(distortion: &str) -> StereoRig {
        parse_rig(&format!(
            "left = {{ width = 640, height = 480, focal = [885.81833, 884.10614], principal_point = [313.18805, 243.49370]{distortion} }}
             right = {{ width = 640, height = 480, focal = [882.93736, 881.18040], principal_point = [300.19781, 246.39833]{distortion} }}
             right_from_left = {{ translation_m = [-0.3857, -0.0072, 0.0001], rotation_vector_rad = [0.04046, 0.01616, 0.01419] }}"
        ))
        .expect("valid")
    }

    const LENS: &str =
        ", distortion = { model = \"radtan\", coefficients = [-0.25, 0.1, 0.0005, -0.0003, 0.0] }";

    fn measure(rig: &StereoRig, point: &Point3<f64>) -> StereoMeasurement {
        StereoMeasurement {
            px: rig.project(point).expect("in view"),
            sigma_px: Vector4::new(0.5, 0.5, 0.5, 0.5),
        }
    }

    /// The covariance in inverse depth, carried over, is that of triangulation.
    #[test]
    fn inverse_depth_and_triangulation_agree() {
        let rig = rig(LENS);
        for z in [1.0, 5.0, 40.0] {
            let m = measure(&rig, &Point3::new(0.1 * z, -0.08 * z, z));
            let expected = triangulate(&rig, &m).expect("in front");
            let y = crate::estimation::inverse_depth(&rig, &m).expect("in front");
            let by_point =
                crate::estimation::linearise_sight(&rig, &nalgebra::Isometry3::identity(), &y)
                    .expect("in view")
                    .by_point;
            let info = m.sigma_px.map(|s| 1.0 / (s * s));
            let cov = (by_point.transpose() * Matrix4::from_diagonal(&info) * by_point)
                .try_inverse()
                .expect("determined");
            let found = Landmark::from_inverse_depth(&y, &cov).expect("in front");
            assert!((found.point - expected.point).norm() < 1e-7 * z);
            let gap = (found.cov_m2 - expected.cov_m2).norm();
            assert!(gap < 1e-5 * expected.cov_m2.norm(), "{gap}");
            assert_eq!(Landmark::from_inverse_depth(&-y, &cov), None);
            let far = Vector3::new(y.x, y.y, 1e-200);
            assert_eq!(Landmark::from_inverse_depth(&far, &cov), None);
        }
    }

    #[test]
    fn a_perfect_measurement_gives_the_point_back() {
        for rig in [rig(""), rig(LENS)] {
            for z in [1.0, 2.0, 5.0, 40.0] {
                let point = Point3::new(0.1 * z, -0.08 * z, z);
                let m = measure(&rig, &point);
                for landmark in [triangulate(&rig, &m), triangulate_linear(&rig, &m)] {
                    let found = landmark.expect("in front").point;
                    assert!((found - point).norm() < 1e-7 * z, "{found} {point}");
                }
            }
        }
    }

    #[test]
    fn linear_gradient_matches_central_differences() {
        let rig = rig(LENS);
        for z in [2.0, 10.0, 40.0] {
            let mut m = measure(&rig, &Point3::new(0.1 * z, -0.08 * z, z));
            // Off the epipolar line, so that the residual's own terms count.
            m.px += Vector4::new(0.8, -1.5, 0.4, 1.1);
            let unit = |j: usize| {
                let mut sigma = Vector4::repeat(1e-9);
                sigma[j] = 1.0;
                sigma
            };
            for j in 0..4 {
                let mut numeric = Vector3::zeros();
                let step = 1e-4;
                for sign in [1.0, -1.0] {
                    let mut moved = m;
                    moved.px[j] += sign * step;
                    let p = triangulate_linear(&rig, &moved).expect("in front").point;
                    numeric += p.coords * (sign / (2.0 * step));
                }
                // With noise in one coordinate only, Σ_p is the outer product of its derivative.
                m.sigma_px = unit(j);
                let cov = triangulate_linear(&rig, &m).expect("in front").cov_m2;
                let expected = numeric * numeric.transpose();
                assert!(
                    (cov - expected).norm() < 1e-6 * expected.norm(),
                    "{j} {cov} {expected}"
                );
            }
        }
    }

    #[test]
    fn covariance_holds_against_monte_carlo() {
        let rig = rig(LENS);
        let mut rng = Xoshiro256PlusPlus::seed_from_u64(1);
        const RUNS: usize = 20_000;
        for (z, refined) in [
            (2.0, true),
            (5.0, true),
            (10.0, true),
            (20.0, true),
            (2.0, false),
            (10.0, false),
        ] {
            let truth = Point3::new(0.1 * z, -0.08 * z, z);
            let exact = measure(&rig, &truth);
            let estimate = |m: &StereoMeasurement| {
                if refined {
                    triangulate(&rig, m)
                } else {
                    triangulate_linear(&rig, m)
                }
            };
            let predicted = estimate(&exact).expect("in front").cov_m2;
            let mut nees = 0.0;
            let mut sampled = Matrix3::zeros();
            for _ in 0..RUNS {
                let mut noisy = exact;
                for j in 0..4 {
                    let n: f64 = StandardNormal.sample(&mut rng);
                    noisy.px[j] += n * exact.sigma_px[j];
                }
                let landmark = estimate(&noisy).expect("in front");
                let error = landmark.point - truth;
                sampled += error * error.transpose() / RUNS as f64;
                let solved = landmark
                    .cov_m2
                    .cholesky()
                    .expect("positive definite")
                    .solve(&error);
                nees += error.dot(&solved) / (3 * RUNS) as f64;
            }
            // 3 σ: χ²(60000)/60000 within 1.8 %; the trace, led by one axis, χ²(20000)/20000 within 3 %,
            // and what the second order adds at 20 m.
            let ratio = predicted.trace() / sampled.trace();
            assert!((0.96..1.04).contains(&ratio), "z {z}: trace ratio {ratio}");
            assert!((0.98..1.02).contains(&nees), "z {z}: ANEES/3 {nees}");
        }
    }

    #[test]
    fn sights_that_meet_behind_are_refused() {
        let rig = rig("");
        let mut m = measure(&rig, &Point3::new(0.0, 0.0, 30.0));
        m.px[2] += 60.0;
        assert_eq!(triangulate(&rig, &m), None);
    }
}
