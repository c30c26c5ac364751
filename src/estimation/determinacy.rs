//! Determinacy: a motion's covariance in, the axes that the images leave open out.
//!
//! A motion's information matrix is full of what its sights say of each direction; where the points are all
//! far, too few, or on one line, it says next to nothing of some. Its inverse, the covariance, has these
//! directions' variances, and an axis that has a part of one has its σ. So the axes are judged by their own σ
//! (the diagonal of the inverse), not by eigenvalues, which would have to weigh metres against radians.
//!
//! A published covariance says the same, and better; this is for those who want a word.

use nalgebra::Matrix6;

/// σ of a motion along an axis from which on the images are said not to determine it, m.
const OPEN_SIGMA_M: f64 = 0.1;
/// The same of a turn about it, rad.
const OPEN_SIGMA_RAD: f64 = 0.01;

/// Some of the six axes of a motion: along x, y, z, and about x, y, z.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Axes(u32);

impl Axes {
    /// All six.
    pub const ALL: Self = Self(0b11_1111);
    /// None.
    pub const NONE: Self = Self(0);
    /// Their names.
    pub const NAMES: [&str; 6] = ["x", "y", "z", "rx", "ry", "rz"];

    /// Those that a motion of this covariance (m², m·rad, rad²) leaves open. What is no number is open.
    #[must_use]
    pub fn left_open_by(cov_motion: &Matrix6<f64>) -> Self {
        let is_open = |axis: usize| {
            let limit = if axis < 3 {
                OPEN_SIGMA_M
            } else {
                OPEN_SIGMA_RAD
            };
            cov_motion[(axis, axis)].is_nan() || cov_motion[(axis, axis)] > limit * limit
        };
        let open = (0..6).filter(|axis| is_open(*axis));
        Self(open.fold(0, |bits, axis| bits | 1 << axis))
    }

    /// Bit 0 for x to bit 5 for rz; `None` where others are set.
    #[must_use]
    pub fn from_bits(bits: u32) -> Option<Self> {
        (bits & !Self::ALL.0 == 0).then_some(Self(bits))
    }

    /// Bit 0 for x to bit 5 for rz.
    #[must_use]
    pub fn bits(self) -> u32 {
        self.0
    }

    /// Whether there is none.
    #[must_use]
    pub fn is_empty(self) -> bool {
        self.0 == 0
    }

    /// The names of those that there are.
    pub fn names(self) -> impl Iterator<Item = &'static str> {
        let named = Self::NAMES.into_iter().enumerate();
        named.filter_map(move |(axis, name)| (self.0 >> axis & 1 == 1).then_some(name))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector6;

    fn names(sigmas: [f64; 6]) -> Vec<&'static str> {
        let variances = Vector6::from(sigmas).map(|s| s * s);
        Axes::left_open_by(&Matrix6::from_diagonal(&variances))
            .names()
            .collect()
    }

    #[test]
    fn each_axis_is_judged_by_its_own_sigma() {
        assert_eq!(names([0.09, 0.09, 0.09, 0.009, 0.009, 0.009]), [""; 0]);
        assert_eq!(names([0.11, 0.0, 0.0, 0.0, 0.0, 0.0]), ["x"]);
        assert_eq!(names([0.0, 0.0, 3.0, 0.0, 0.011, 0.0]), ["z", "ry"]);
        assert_eq!(
            names([f64::NAN, 0.0, 0.0, 0.0, 0.0, f64::INFINITY]),
            ["x", "rz"]
        );
    }

    #[test]
    fn a_direction_between_axes_leaves_both_open() {
        let across = Vector6::new(1.0, 0.0, 1.0, 0.0, 0.0, 0.0) * 0.2;
        let cov = across * across.transpose() + Matrix6::identity() * 1e-6;
        let open: Vec<_> = Axes::left_open_by(&cov).names().collect();
        assert_eq!(open, ["x", "z"]);
    }

    #[test]
    fn bits_stand_for_axes_and_nothing_else() {
        assert_eq!(Axes::ALL.names().collect::<Vec<_>>(), Axes::NAMES);
        for bits in 0..64 {
            assert_eq!(Axes::from_bits(bits).map(Axes::bits), Some(bits));
        }
        assert_eq!(Axes::from_bits(64), None);
        assert!(Axes::NONE.is_empty() && !Axes::ALL.is_empty());
    }
}
