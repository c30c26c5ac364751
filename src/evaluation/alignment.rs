//! Two paths in, the similarity that brings one onto the other out.

use crate::geometry::so3;
use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};

/// How an estimate is brought into the frame of the truth before positions are compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Alignment {
    /// As it is.
    None,
    /// So that the first poses agree.
    First,
    /// By the rigid motion with the least squares of distances (Umeyama).
    Se3,
    /// As `Se3`, with a scale.
    Sim3,
}

impl std::fmt::Display for Alignment {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::None => "none",
            Self::First => "first",
            Self::Se3 => "se3",
            Self::Sim3 => "sim3",
        })
    }
}

/// `p ↦ scale · R p + t`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Similarity {
    /// Rotation and translation, m.
    pub rigid: Isometry3<f64>,
    /// Scale.
    pub scale: f64,
}

impl Similarity {
    /// Where a pose comes to lie: its position is scaled, its rotation is not.
    #[must_use]
    pub fn apply(&self, pose: &Isometry3<f64>) -> Isometry3<f64> {
        let scaled = Translation3::from(pose.translation.vector * self.scale);
        self.rigid * Isometry3::from_parts(scaled, pose.rotation)
    }
}

/// The similarity that `alignment` asks for; `None` where the poses do not determine it, as on
/// a straight line.
#[must_use]
pub fn align(
    alignment: Alignment,
    estimate: &[Isometry3<f64>],
    truth: &[Isometry3<f64>],
) -> Option<Similarity> {
    let rigid = |rigid| Similarity { rigid, scale: 1.0 };
    let positions = |poses: &[Isometry3<f64>]| -> Vec<Vector3<f64>> {
        poses.iter().map(|pose| pose.translation.vector).collect()
    };
    match alignment {
        Alignment::None => Some(rigid(Isometry3::identity())),
        Alignment::First => {
            let (estimate, truth) = (estimate.first()?, truth.first()?);
            Some(rigid(truth * estimate.inverse()))
        }
        Alignment::Se3 => umeyama(&positions(estimate), &positions(truth), false),
        Alignment::Sim3 => umeyama(&positions(estimate), &positions(truth), true),
    }
}

/// The similarity (scale 1 unless `with_scale`) that minimises `Σ |to − (s R from + t)|²`.
///
/// Umeyama, *Least-squares estimation of transformation parameters between two point patterns*,
/// PAMI 1991, equations 34–43. `None` where the points lie on a line, or there are fewer than
/// three.
#[must_use]
pub fn umeyama(from: &[Vector3<f64>], to: &[Vector3<f64>], with_scale: bool) -> Option<Similarity> {
    let n = from.len().min(to.len());
    if n < 3 {
        return None;
    }
    let mean = |points: &[Vector3<f64>]| points[..n].iter().sum::<Vector3<f64>>() / n as f64;
    let (mean_from, mean_to) = (mean(from), mean(to));
    let mut cross = Matrix3::zeros();
    let mut var_from_m2 = 0.0;
    for (a, b) in from.iter().zip(to) {
        cross += (b - mean_to) * (a - mean_from).transpose() / n as f64;
        var_from_m2 += (a - mean_from).norm_squared() / n as f64;
    }
    let svd = cross.svd(true, true);
    let (u, v_t) = (svd.u?, svd.v_t?);
    let singular = svd.singular_values;
    if singular[1] <= 1e-12 * singular[0] {
        return None;
    }
    let mut signs = Vector3::repeat(1.0);
    if u.determinant() * v_t.determinant() < 0.0 {
        signs[singular.imin()] = -1.0;
    }
    let rotation = Rotation3::from_matrix_unchecked(u * Matrix3::from_diagonal(&signs) * v_t);
    let scale = match with_scale {
        true => singular.dot(&signs) / var_from_m2,
        false => 1.0,
    };
    let rotation = UnitQuaternion::from_rotation_matrix(&rotation);
    let translation = mean_to - scale * (rotation * mean_from);
    Some(Similarity {
        rigid: Isometry3::from_parts(translation.into(), rotation),
        scale,
    })
}

/// The angle between two orientations, rad.
pub(super) fn angle_between(a: &Isometry3<f64>, b: &Isometry3<f64>) -> f64 {
    so3::log(&(a.rotation.inverse() * b.rotation)).norm()
}
