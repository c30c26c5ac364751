//! What is wrong with a rig in; independent sources of error, each of standard deviation 1, out.
//!
//! A rig's errors displace pixels alike in every pair: they do not average out. They enter the
//! estimates as consider-parameters (theory §5): an estimator carries the derivative of its pose by
//! each source along, [`BySources`], and `S Sᵀ` is what they add to the covariance. Sources are
//!
//! | columns | source |
//! |---|---|
//! | [`WARP_COLUMNS`] | the warp that the window estimates along: what its prior may be wrong by |
//! | [`MODE_COLUMNS`] | errors of the rig's parameters, by combinations that are independent |
//! | [`SKEW_COLUMN`] | the time between the exposures of the two images |
//!
//! **What counts twice, and what does not.** The window's warp has a prior that supposes it to be
//! zero within some tenths of a pixel. Where the rig states its uncertainty, that supposition is
//! but another form of the stated errors: they act through the modes, the part that the warp
//! absorbs and the part that it cannot alike, and the prior's own share is taken out of the
//! covariance. Where nothing is stated, the warp's prior *is* what is supposed of the difference
//! between the cameras, and the modes are only what it cannot describe: errors of both cameras
//! together.

use super::Settings;
use super::calibration::{seen_by_rig, sight_by_rig};
use super::sight::{Sight, Viewpoint};
use super::window::WARP;
use crate::geometry::product::product_transposed;
use crate::geometry::rig_parameters::{
    CAMERA_PARAMETERS, EXTRINSICS, RIG_PARAMETERS, RigCovariance, RigVector,
};
use crate::geometry::{Distortion, StereoRig, se3};
use nalgebra::{Isometry3, Matrix6, SMatrix, SymmetricEigen, Vector3, Vector4};

/// Independent errors of a rig's parameters that are told apart.
pub const MODES: usize = 16;
/// All sources.
pub const SOURCES: usize = WARP + MODES + 1;
/// The first column of the warp's prior.
pub const WARP_COLUMNS: usize = 0;
/// The first column of the rig's parameters.
pub const MODE_COLUMNS: usize = WARP;
/// The column of the exposures' skew.
pub const SKEW_COLUMN: usize = WARP + MODES;

/// The derivative of a pose or motion (right perturbation) by each source, per σ of it.
pub type BySources = SMatrix<f64, 6, SOURCES>;

/// How a rig may be wrong.
#[derive(Clone, Debug, PartialEq)]
pub struct RigErrors {
    /// The modes, a row each, by the parameters.
    modes_by_parameters: SMatrix<f64, MODES, RIG_PARAMETERS>,
    /// Whether the warp's prior is an error of its own rather than another form of the modes.
    warp_counts: bool,
    /// How many of the modes there are: the others are zero.
    modes: usize,
    skew_counts: bool,
}

impl RigErrors {
    /// Those that the rig states, else what the settings suppose.
    #[must_use]
    pub fn of(rig: &StereoRig, settings: &Settings) -> Self {
        let stated = rig.covariance();
        let root = match &stated {
            _ if !settings.consider_calibration => SMatrix::zeros(),
            Some(covariance) => modes_of(rig, covariance),
            None => supposed(rig, settings.calibration_sigma_px),
        };
        Self {
            modes: (0..MODES)
                .rev()
                .find(|mode| root.column(*mode).iter().any(|v| *v != 0.0))
                .map_or(0, |last| last + 1),
            warp_counts: stated.is_none() || !settings.consider_calibration,
            skew_counts: settings.consider_synchronisation,
            modes_by_parameters: root.transpose(),
        }
    }

    /// Whether errors of parameters act at all.
    #[must_use]
    pub fn has_modes(&self) -> bool {
        self.modes > 0
    }

    /// How many modes there are at most: those from there on are zero.
    #[must_use]
    pub fn modes(&self) -> usize {
        self.modes
    }

    /// By how much `seen`, the sight (ul, vl, ur, vr), px, of the point `y` = (x, y, ρ) from where a rig
    /// has gone, is displaced by 1 σ of each mode, a row each, as many as there are `ROWS`.
    #[must_use]
    #[inline(always)]
    pub fn displacement<const ROWS: usize>(
        &self,
        rig: &StereoRig,
        from: &Viewpoint,
        y: &Vector3<f64>,
        seen: &Sight,
    ) -> SMatrix<f64, ROWS, 4> {
        let by_rig = seen_by_rig(rig, from, y, seen);
        // Neither camera's pixels depend on the other's lens, nor the left one's on where the right one is.
        let parameters = [
            0..CAMERA_PARAMETERS,
            0..CAMERA_PARAMETERS,
            CAMERA_PARAMETERS..RIG_PARAMETERS,
            CAMERA_PARAMETERS..RIG_PARAMETERS,
        ];
        let mut by_modes = SMatrix::<f64, ROWS, 4>::zeros();
        for (px, parameters) in parameters.into_iter().enumerate() {
            let column = &mut by_modes.data.0[px];
            for k in parameters {
                let factor = by_rig.data.0[k][px];
                // Most parameters move one coordinate at most.
                if factor == 0.0 {
                    continue;
                }
                let modes = &self.modes_by_parameters.data.0[k];
                for (out, mode) in column.iter_mut().zip(modes) {
                    *out += mode * factor;
                }
            }
        }
        by_modes
    }

    /// The derivative by the modes, of what has this derivative by the rig's parameters.
    #[must_use]
    pub fn of_parameters(
        &self,
        by_rig: &SMatrix<f64, 6, RIG_PARAMETERS>,
    ) -> SMatrix<f64, 6, MODES> {
        product_transposed(by_rig, &self.modes_by_parameters)
    }

    /// A covariance by source. `cov` is that of the estimate, the warp's prior included; `by` what
    /// the sources do to it; both of right perturbations.
    #[must_use]
    pub fn apart(&self, cov: &Matrix6<f64>, by: &BySources) -> Parts {
        let warp = squared::<WARP>(by, WARP_COLUMNS);
        let (detection, of_warp) = without(cov, &warp);
        let modes = if self.has_modes() {
            squared::<MODES>(by, MODE_COLUMNS)
        } else {
            Matrix6::zeros()
        };
        let calibration = if self.warp_counts {
            modes + of_warp
        } else {
            modes
        };
        let synchronisation = if self.skew_counts {
            squared::<1>(by, SKEW_COLUMN)
        } else {
            Matrix6::zeros()
        };
        Parts {
            detection: se3::symmetric(&detection),
            calibration: se3::symmetric(&calibration),
            synchronisation: se3::symmetric(&synchronisation),
        }
    }
}

/// The covariance that `COUNT` sources from `first` on give.
fn squared<const COUNT: usize>(by: &BySources, first: usize) -> Matrix6<f64> {
    let columns = by.fixed_columns::<COUNT>(first).into_owned();
    product_transposed(&columns, &columns)
}

/// A covariance by source.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Parts {
    /// From the noise of pixels.
    pub detection: Matrix6<f64>,
    /// From the rig's calibration.
    pub calibration: Matrix6<f64>,
    /// From the exposures' skew.
    pub synchronisation: Matrix6<f64>,
}

impl Parts {
    /// The whole.
    #[must_use]
    pub fn total(&self) -> Matrix6<f64> {
        self.detection + self.calibration + self.synchronisation
    }
}

/// The largest share of a covariance that its part may take in any direction: linearised at
/// different points, a part may seem to be larger than the whole.
const LARGEST_SHARE: f64 = 0.99;

/// The whole without a part of it, and the part: both positive definite or zero, and their sum the whole.
fn without(whole: &Matrix6<f64>, part: &Matrix6<f64>) -> (Matrix6<f64>, Matrix6<f64>) {
    let Some(factor) = whole.cholesky() else {
        return (*whole, Matrix6::zeros());
    };
    let lower = factor.l();
    let Some(inverse) = lower.try_inverse() else {
        return (*whole, Matrix6::zeros());
    };
    let shares = SymmetricEigen::new(se3::symmetric(&(inverse * part * inverse.transpose())));
    let limited = shares.eigenvalues.map(|v| v.clamp(0.0, LARGEST_SHARE));
    let by = lower * shares.eigenvectors;
    let part = by * Matrix6::from_diagonal(&limited) * by.transpose();
    let rest = by * Matrix6::from_diagonal(&limited.map(|v| 1.0 - v)) * by.transpose();
    (rest, part)
}

/// Disparities at which it is weighed, px.
const DISPARITIES_PX: [f64; 3] = [0.0, 10.0, 60.0];

/// The combinations of parameters that displace pixels most, each of 1 σ. With up to [`MODES`]
/// uncertain parameters it is all of them.
fn modes_of(rig: &StereoRig, covariance: &RigCovariance) -> SMatrix<f64, RIG_PARAMETERS, MODES> {
    let eigen = SymmetricEigen::new(*covariance);
    let sigmas: RigVector = eigen.eigenvalues.map(|v| v.max(0.0).sqrt());
    let root = eigen.eigenvectors * RigCovariance::from_diagonal(&sigmas);
    let mut weight = RigCovariance::zeros();
    let unmoved = Viewpoint::unmoved(rig);
    let inverse_depth = |disparity_px: f64| disparity_px / (rig.left.focal_px.x * rig.baseline_m());
    for ray in rig.left.spread_rays() {
        for disparity_px in DISPARITIES_PX {
            let y = ray.push(inverse_depth(disparity_px));
            if let Some(by) = sight_by_rig(rig, &unmoved, &y) {
                let by = by * root;
                weight += by.transpose() * by;
            }
        }
    }
    let effect = SymmetricEigen::new(weight);
    let mut order: Vec<usize> = (0..RIG_PARAMETERS).collect();
    order.sort_by(|&a, &b| effect.eigenvalues[b].total_cmp(&effect.eigenvalues[a]));
    let mut modes = SMatrix::<f64, RIG_PARAMETERS, MODES>::zeros();
    for (column, &i) in order.iter().take(MODES).enumerate() {
        modes.set_column(column, &(root * effect.eigenvectors.column(i)));
    }
    modes
}

/// What is supposed of a rig that states nothing, beyond the warp: each of the parameters that both
/// cameras share, and the difference of focal lengths, is off by so much that a pixel half an
/// image's width from the centre is displaced by `sigma_px`; so is the baseline, in proportion.
fn supposed(rig: &StereoRig, sigma_px: f64) -> SMatrix<f64, RIG_PARAMETERS, MODES> {
    let mut modes = SMatrix::<f64, RIG_PARAMETERS, MODES>::zeros();
    let share = |camera: &crate::geometry::Camera| 2.0 * sigma_px / f64::from(camera.width);
    for (camera, first) in [(&rig.left, 0), (&rig.right, CAMERA_PARAMETERS)] {
        modes[(first, 0)] = camera.focal_px.x * share(camera);
        modes[(first + 1, 0)] = camera.focal_px.y * share(camera);
        modes[(first + 2, 1)] = sigma_px;
        modes[(first + 3, 2)] = sigma_px;
        if !matches!(camera.distortion(), Distortion::None) {
            let edge = 0.5 * f64::from(camera.width) / camera.focal_px.x;
            modes[(first + 4, 3)] = sigma_px / (camera.focal_px.x * edge.powi(3));
        }
    }
    let baseline = rig.right_from_left.translation.vector * share(&rig.left);
    modes
        .fixed_view_mut::<3, 1>(EXTRINSICS, 4)
        .copy_from(&baseline);
    modes[(CAMERA_PARAMETERS, 5)] = rig.right.focal_px.x * share(&rig.right);
    modes
}

/// When and how fast the images of a pair were taken.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Exposure {
    /// The camera's velocity in its own frame: m/s, rad/s.
    pub twist: nalgebra::Vector6<f64>,
    /// The time of the right exposure less that of the left one, s.
    pub skew_s: f64,
    /// 1 σ of that, s.
    pub sigma_skew_s: f64,
}

impl Exposure {
    /// By how much the sight of a point is displaced by the known skew, px; zero without one, or
    /// where a camera cannot see the point.
    #[must_use]
    pub fn displacement(
        &self,
        rig: &StereoRig,
        now_from_prev: &Isometry3<f64>,
        y: &Vector3<f64>,
    ) -> Vector4<f64> {
        if self.skew_s == 0.0 {
            return Vector4::zeros();
        }
        let from = Viewpoint::new(rig, now_from_prev);
        super::calibration::sight_by_skew(rig, &from, y, &self.twist)
            .map_or_else(Vector4::zeros, |by| by * self.skew_s)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::RigUncertainty;
    use crate::simulation::thesis_rig;
    use nalgebra::{Vector2, Vector6};
    use proptest::prelude::*;

    fn stated() -> StereoRig {
        StereoRig {
            uncertainty: Some(RigUncertainty::Sigmas {
                focal_px: 0.5,
                principal_point_px: 0.4,
                rotation_rad: 1e-4,
                translation_m: 2e-4,
            }),
            ..thesis_rig()
        }
    }

    #[test]
    fn modes_have_the_covariance_that_the_rig_states() {
        let rig = stated();
        let errors = RigErrors::of(&rig, &Settings::default());
        let covariance = rig.covariance().expect("stated");
        let modes = &errors.modes_by_parameters;
        let gap = modes.transpose() * modes - covariance;
        for i in 0..RIG_PARAMETERS {
            let scale = covariance[(i, i)].max(1e-30);
            assert!(gap[(i, i)].abs() < 1e-9 * scale.max(1e-12), "{i}");
        }
        assert!(!errors.warp_counts);
    }

    #[test]
    fn what_is_not_to_be_considered_is_not() {
        let settings = Settings {
            consider_calibration: false,
            consider_synchronisation: false,
            ..Settings::default()
        };
        let errors = RigErrors::of(&stated(), &settings);
        assert!(!errors.has_modes());
        let by = BySources::repeat(1e-3);
        let cov = Matrix6::identity();
        let parts = errors.apart(&cov, &by);
        assert!((parts.total() - cov).norm() < 1e-12);
        assert_eq!(parts.synchronisation, Matrix6::zeros());
    }

    #[test]
    fn a_rig_that_states_nothing_is_supposed_to_be_off_by_the_setting_at_the_border() {
        let rig = thesis_rig();
        let sigma_px = 0.3;
        let errors = RigErrors::of(
            &rig,
            &Settings {
                calibration_sigma_px: sigma_px,
                ..Settings::default()
            },
        );
        assert!(errors.warp_counts && errors.has_modes());
        let camera = &rig.left;
        let border = Vector2::new(
            camera.principal_point_px.x + 0.5 * f64::from(camera.width),
            camera.principal_point_px.y,
        );
        let ray = camera.unproject(&border).expect("has a ray");
        let (from, far) = (Viewpoint::unmoved(&rig), ray.push(0.0));
        let seen = from.linearise(&rig, &far).expect("in front");
        let by = errors.displacement::<MODES>(&rig, &from, &far, &seen);
        for mode in 0..3 {
            let moved = by.fixed_view::<1, 2>(mode, 0).norm();
            assert!((moved - sigma_px).abs() < 1e-9, "{mode} {moved}");
        }
        // The baseline only shows in what is near.
        assert!(by.row(4).norm() < 1e-12);
    }

    proptest! {
        #[test]
        fn parts_are_definite_and_sum_to_the_whole(
            root in prop::array::uniform32(-1.0..1.0_f64),
            by in prop::array::uniform32(-1.0..1.0_f64),
            scale in -6.0..2.0_f64,
        ) {
            let root = Matrix6::from_fn(|i, j| root[(6 * i + j) % 32]);
            let cov = root * root.transpose() + Matrix6::identity() * 1e-4;
            let by = BySources::from_fn(|i, j| by[(7 * i + j) % 32] * 10_f64.powf(scale));
            for rig in [stated(), thesis_rig()] {
                let parts = RigErrors::of(&rig, &Settings::default()).apart(&cov, &by);
                prop_assert!(parts.detection.cholesky().is_some());
                prop_assert!(parts.total().cholesky().is_some());
                if rig.uncertainty.is_none() {
                    let added = by.fixed_columns::<{ MODES + 1 }>(WARP);
                    let expected = cov + added * added.transpose();
                    prop_assert!((parts.total() - expected).norm() < 1e-9 * expected.norm());
                }
            }
        }

        #[test]
        fn a_late_right_image_is_displaced_by_its_skew(twist in prop::array::uniform6(-1.0..1.0_f64)) {
            let rig = thesis_rig();
            let exposure = Exposure { twist: Vector6::from(twist), skew_s: 1e-3, sigma_skew_s: 0.0 };
            let y = Vector3::new(0.1, -0.1, 0.2);
            let identity = Isometry3::identity();
            let shift = exposure.displacement(&rig, &identity, &y);
            let late = se3::exp(&(exposure.twist * exposure.skew_s));
            let there = crate::estimation::seen_at(&rig, &late.inverse(), &y).expect("in front");
            let here = crate::estimation::seen_at(&rig, &identity, &y).expect("in front");
            prop_assert!((shift.xy()).norm() == 0.0);
            prop_assert!((there - here - shift).fixed_rows::<2>(2).norm() < 1e-2 * (shift.norm() + 1e-3));
        }
    }
}
