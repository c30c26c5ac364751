//! Paired poses in, absolute trajectory error (ATE) and relative pose error (RPE) out.
//!
//! Sturm et al., *A benchmark for the evaluation of RGB-D SLAM systems*, IROS 2012.

use super::alignment::{Alignment, align, angle_between};
use super::statistics::Statistics;
use nalgebra::Isometry3;

/// How far poses lie from the truth after an alignment.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct AbsoluteErrors {
    /// How the estimate was brought onto the truth.
    pub alignment: Alignment,
    /// The scale of that, 1 unless `sim3`.
    pub scale: f64,
    /// Distances between positions, m.
    pub translation_m: Statistics,
    /// Angles between orientations, deg.
    pub rotation_deg: Statistics,
}

/// The absolute errors after `alignment`; `None` where the poses do not determine it.
#[must_use]
pub fn absolute_errors(
    estimate: &[Isometry3<f64>],
    truth: &[Isometry3<f64>],
    alignment: Alignment,
) -> Option<AbsoluteErrors> {
    let similarity = align(alignment, estimate, truth)?;
    let mut distances_m = Vec::with_capacity(truth.len());
    let mut angles_deg = Vec::with_capacity(truth.len());
    for (estimate, truth) in estimate.iter().zip(truth) {
        let aligned = similarity.apply(estimate);
        distances_m.push((aligned.translation.vector - truth.translation.vector).norm());
        angles_deg.push(angle_between(&aligned, truth).to_degrees());
    }
    Some(AbsoluteErrors {
        alignment,
        scale: similarity.scale,
        translation_m: Statistics::of(&distances_m)?,
        rotation_deg: Statistics::of(&angles_deg)?,
    })
}

/// How far motions from one pose to the next lie from the true ones.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct RelativeErrors {
    /// Length of the translation of `(true motion)⁻¹ · motion`, m.
    pub translation_m: Statistics,
    /// Angle of its rotation, deg.
    pub rotation_deg: Statistics,
}

/// The errors from each pose to the next within each run of poses; `None` where there is no pair.
#[must_use]
pub fn relative_errors<'a>(
    runs: impl Iterator<Item = (&'a [Isometry3<f64>], &'a [Isometry3<f64>])>,
) -> Option<RelativeErrors> {
    let mut distances_m = Vec::new();
    let mut angles_deg = Vec::new();
    for (estimate, truth) in runs {
        for (e, t) in estimate.windows(2).zip(truth.windows(2)) {
            let error = t[0].inv_mul(&t[1]).inv_mul(&e[0].inv_mul(&e[1]));
            distances_m.push(error.translation.vector.norm());
            angles_deg.push(angle_between(&Isometry3::identity(), &error).to_degrees());
        }
    }
    Some(RelativeErrors {
        translation_m: Statistics::of(&distances_m)?,
        rotation_deg: Statistics::of(&angles_deg)?,
    })
}
