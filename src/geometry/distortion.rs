//! Lens distortion on the normalised image plane (z = 1), with its Jacobian, and its inverse.

use nalgebra::{Matrix2, SMatrix, Vector2};

/// How a lens moves a point of the normalised image plane.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Distortion {
    /// A perfect pinhole.
    None,
    /// Radial and tangential (Brown–Conrady) with the rational extension, as OpenCV orders it:
    /// k1, k2, p1, p2, k3, k4, k5, k6.
    Radtan([f64; 8]),
    /// Equidistant fisheye (Kannala–Brandt): k1 … k4 in the angle from the optical axis.
    Equidistant([f64; 4]),
}

/// Newton steps that undistortion may take.
const MAX_STEPS: usize = 50;

impl Distortion {
    /// The distorted position of `p`, without units (pixels over focal length).
    #[must_use]
    #[inline]
    pub fn distort(&self, p: &Vector2<f64>) -> Vector2<f64> {
        self.distort_with_jacobian(p).0
    }

    /// The distorted position of `p` and its derivative by `p`.
    #[must_use]
    #[inline]
    pub fn distort_with_jacobian(&self, p: &Vector2<f64>) -> (Vector2<f64>, Matrix2<f64>) {
        match self {
            Self::None => (*p, Matrix2::identity()),
            Self::Radtan(k) => radtan(k, p),
            Self::Equidistant(k) => equidistant(k, p),
        }
    }

    /// By how much the distorted position of `p` moves with each coefficient, in their order;
    /// columns beyond the last coefficient are zero.
    #[must_use]
    pub fn by_coefficients(&self, p: &Vector2<f64>) -> SMatrix<f64, 2, 8> {
        let mut by = SMatrix::<f64, 2, 8>::zeros();
        match self {
            Self::None => {}
            Self::Radtan([k1, k2, _, _, k3, k4, k5, k6]) => {
                let r2 = p.norm_squared();
                let powers = [r2, r2 * r2, r2 * r2 * r2];
                let numerator = 1.0 + k1 * powers[0] + k2 * powers[1] + k3 * powers[2];
                let denominator = 1.0 + k4 * powers[0] + k5 * powers[1] + k6 * powers[2];
                let radial = numerator / denominator;
                for (power, (above, below)) in powers.into_iter().zip([(0, 5), (1, 6), (4, 7)]) {
                    by.set_column(above, &(p * (power / denominator)));
                    by.set_column(below, &(p * (-radial * power / denominator)));
                }
                let mixed = 2.0 * p.x * p.y;
                by.set_column(2, &Vector2::new(mixed, r2 + 2.0 * p.y * p.y));
                by.set_column(3, &Vector2::new(r2 + 2.0 * p.x * p.x, mixed));
            }
            Self::Equidistant(_) => {
                let r = p.norm();
                let theta = r.atan();
                // θ/r tends to 1.
                let ratio = if r > 1e-9 { theta / r } else { 1.0 };
                for i in 0..4 {
                    by.set_column(i, &(p * (ratio * theta.powi(2 * i as i32 + 2))));
                }
            }
        }
        by
    }

    /// The position whose distorted image is `distorted`, within `max_radius` (see
    /// [`max_radius`](Self::max_radius)); `None` where the model has no inverse.
    ///
    /// Newton's method with step halving, down to rounding.
    #[must_use]
    pub fn undistort(&self, distorted: &Vector2<f64>, max_radius: f64) -> Option<Vector2<f64>> {
        if matches!(self, Self::None) {
            return Some(*distorted);
        }
        let mut p = self.undistort_guess(distorted)?;
        let (image, mut jacobian) = self.distort_with_jacobian(&p);
        let mut gap = distorted - image;
        for _ in 0..MAX_STEPS {
            if gap.norm() <= 1e-15 * (1.0 + distorted.norm()) {
                break;
            }
            let mut step = jacobian.try_inverse()? * gap;
            loop {
                let next = p + step;
                let (next_image, next_jacobian) = self.distort_with_jacobian(&next);
                let next_gap = distorted - next_image;
                if next_gap.norm() < gap.norm() {
                    (p, jacobian, gap) = (next, next_jacobian, next_gap);
                    break;
                }
                step *= 0.5;
                if step.norm() <= 1e-16 * (1.0 + p.norm()) {
                    // No step comes nearer: this is the answer, if it is one.
                    return accept(p, gap.norm(), max_radius);
                }
            }
        }
        accept(p, gap.norm(), max_radius)
    }

    fn undistort_guess(&self, distorted: &Vector2<f64>) -> Option<Vector2<f64>> {
        match self {
            // The fisheye's inverse runs to infinity: start from the pure equidistant answer.
            Self::Equidistant(_) => {
                let theta = distorted.norm();
                (theta < 1.55).then(|| {
                    distorted
                        * if theta > 1e-8 {
                            theta.tan() / theta
                        } else {
                            1.0
                        }
                })
            }
            _ => Some(*distorted),
        }
    }

    /// The radius on the normalised plane up to which the model is one to one.
    ///
    /// Beyond it a radial polynomial folds back, and a point far outside the view would be imaged
    /// inside it.
    #[must_use]
    pub fn max_radius(&self) -> f64 {
        const STEP: f64 = 0.005;
        const LIMIT: f64 = 20.0;
        let slope = |r: f64| {
            let (_, j) = self.distort_with_jacobian(&Vector2::new(r, 0.0));
            j[(0, 0)]
        };
        match self {
            Self::None => f64::INFINITY,
            Self::Radtan(k) => {
                // The radial part alone decides; tangential terms are small by nature.
                let radial = Self::Radtan([k[0], k[1], 0.0, 0.0, k[4], k[5], k[6], k[7]]);
                if k.iter()
                    .enumerate()
                    .all(|(i, &c)| c == 0.0 || i == 2 || i == 3)
                {
                    return f64::INFINITY;
                }
                let mut r = 0.0;
                while r < LIMIT {
                    r += STEP;
                    let (_, j) = radial.distort_with_jacobian(&Vector2::new(r, 0.0));
                    if j[(0, 0)].is_nan() || j[(0, 0)] <= 0.0 {
                        return r - STEP;
                    }
                }
                LIMIT
            }
            Self::Equidistant(_) => {
                let mut r = 0.0;
                while r < LIMIT {
                    r += STEP;
                    if slope(r) <= 0.0 {
                        return r - STEP;
                    }
                }
                LIMIT
            }
        }
    }
}

/// A solution is one only if it reproduces the input on the branch that contains the axis.
fn accept(p: Vector2<f64>, gap: f64, max_radius: f64) -> Option<Vector2<f64>> {
    (gap < 1e-10 && p.norm() <= max_radius).then_some(p)
}

fn radtan(k: &[f64; 8], p: &Vector2<f64>) -> (Vector2<f64>, Matrix2<f64>) {
    let [k1, k2, p1, p2, k3, k4, k5, k6] = *k;
    let (x, y) = (p.x, p.y);
    let r2 = x * x + y * y;
    let numerator = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
    let denominator = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6));
    let radial = numerator / denominator;
    let d_numerator = k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3);
    let d_denominator = k4 + r2 * (2.0 * k5 + 3.0 * r2 * k6);
    let d_radial = (d_numerator - radial * d_denominator) / denominator;

    let distorted = Vector2::new(
        x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
        y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
    );
    let mixed = 2.0 * x * y * d_radial + 2.0 * p1 * x + 2.0 * p2 * y;
    let jacobian = Matrix2::new(
        radial + 2.0 * x * x * d_radial + 2.0 * p1 * y + 6.0 * p2 * x,
        mixed,
        mixed,
        radial + 2.0 * y * y * d_radial + 6.0 * p1 * y + 2.0 * p2 * x,
    );
    (distorted, jacobian)
}

fn equidistant(k: &[f64; 4], p: &Vector2<f64>) -> (Vector2<f64>, Matrix2<f64>) {
    let r2 = p.norm_squared();
    let r = r2.sqrt();
    let theta = r.atan();
    let t2 = theta * theta;
    let theta_d = theta * (1.0 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))));
    if r < 1e-4 {
        // θ_d/r = 1 + (k1 − 1/3) r² + O(r⁴): exact to rounding below this radius.
        let c = k[0] - 1.0 / 3.0;
        let scale = 1.0 + c * r2;
        return (
            p * scale,
            Matrix2::identity() * scale + p * p.transpose() * (2.0 * c),
        );
    }
    let d_theta_d =
        1.0 + t2 * (3.0 * k[0] + t2 * (5.0 * k[1] + t2 * (7.0 * k[2] + t2 * 9.0 * k[3])));
    let slope = d_theta_d / (1.0 + r2);
    let scale = theta_d / r;
    let jacobian = Matrix2::identity() * scale + p * p.transpose() * ((slope - scale) / r2);
    (p * scale, jacobian)
}
