//! A plane and its image in, the homography between them and the plane's placement out.

use crate::geometry::so3;
use nalgebra::{
    DMatrix, Isometry3, Matrix3, Point3, Rotation3, Translation3, UnitQuaternion, Vector2, Vector3,
};

/// Fewest points that a homography is estimated from.
const LEAST_POINTS: usize = 6;
/// Turns of the iteration for the nearest rotation.
const ROTATION_STEPS: usize = 100;

/// The homography that maps the board's x and y to image positions: direct linear transform on normalised
/// coordinates (Hartley and Zisserman, *Multiple View Geometry*, algorithm 4.2).
///
/// `None` for fewer than six points, or where they do not determine it.
pub(super) fn homography(pairs: &[(Point3<f64>, Vector2<f64>)]) -> Option<Matrix3<f64>> {
    if pairs.len() < LEAST_POINTS {
        return None;
    }
    let on_board: Vec<_> = pairs.iter().map(|(p, _)| p.xy().coords).collect();
    let in_image: Vec<_> = pairs.iter().map(|(_, q)| *q).collect();
    let (board_scale, image_scale) = (normalisation(&on_board)?, normalisation(&in_image)?);
    let mut equations = DMatrix::zeros(2 * pairs.len(), 9);
    for (i, (p, q)) in on_board.iter().zip(&in_image).enumerate() {
        let p = board_scale * p.push(1.0);
        let q = image_scale * q.push(1.0);
        for k in 0..3 {
            equations[(2 * i, k)] = p[k];
            equations[(2 * i, 6 + k)] = -q.x * p[k];
            equations[(2 * i + 1, 3 + k)] = p[k];
            equations[(2 * i + 1, 6 + k)] = -q.y * p[k];
        }
    }
    let eigen = (equations.transpose() * &equations).symmetric_eigen();
    let least = eigen.eigenvalues.imin();
    let h = eigen.eigenvectors.column(least);
    let normalised = Matrix3::new(h[0], h[1], h[2], h[3], h[4], h[5], h[6], h[7], h[8]);
    let homography = image_scale.try_inverse()? * normalised * board_scale;
    let is_good = homography.iter().all(|h| h.is_finite()) && homography.determinant() != 0.0;
    is_good.then_some(homography)
}

/// Moves points to their centre and scales them to a mean distance of √2.
fn normalisation(points: &[Vector2<f64>]) -> Option<Matrix3<f64>> {
    let count = points.len() as f64;
    let sum: Vector2<f64> = points.iter().sum();
    let centre = sum / count;
    let distance = points.iter().map(|p| (p - centre).norm()).sum::<f64>() / count;
    if !(distance.is_finite() && distance > 0.0) {
        return None;
    }
    let scale = std::f64::consts::SQRT_2 / distance;
    Some(Matrix3::new(
        scale,
        0.0,
        -scale * centre.x,
        0.0,
        scale,
        -scale * centre.y,
        0.0,
        0.0,
        1.0,
    ))
}

/// Where the board stands, camera_from_board, from the homography of board to *normalised* image positions
/// (Zhang 2000, §3.1).
pub(super) fn placement(homography: &Matrix3<f64>) -> Option<Isometry3<f64>> {
    let scale = 0.5 * (homography.column(0).norm() + homography.column(1).norm());
    let mut h = homography / scale;
    // The board stands before the camera.
    if h[(2, 2)] < 0.0 {
        h = -h;
    }
    let (x, y) = (h.column(0).into_owned(), h.column(1).into_owned());
    let axes = Matrix3::from_columns(&[x, y, x.cross(&y)]);
    if !axes.iter().all(|a| a.is_finite()) {
        return None;
    }
    let rotation = Rotation3::from_matrix_eps(&axes, 1e-12, ROTATION_STEPS, start(&x, &y)?);
    Some(Isometry3::from_parts(
        Translation3::from(h.column(2).into_owned()),
        UnitQuaternion::from_rotation_matrix(&rotation),
    ))
}

/// A rotation near that of the axes x and y, to start from.
fn start(x: &Vector3<f64>, y: &Vector3<f64>) -> Option<Rotation3<f64>> {
    let x = x.try_normalize(1e-12)?;
    let z = x.cross(y).try_normalize(1e-12)?;
    Some(Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[
        x,
        z.cross(&x),
        z,
    ])))
}

/// How far two placements lie apart: metres and radians together, as a board's length turns one into the other.
pub(super) fn apart(a: &Isometry3<f64>, b: &Isometry3<f64>, length_m: f64) -> f64 {
    let turn = so3::log(&(a.rotation.inverse() * b.rotation)).norm();
    (a.translation.vector - b.translation.vector).norm() + length_m * turn
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_boards_placement_is_found_from_where_its_points_are_seen() {
        let camera_from_board =
            Isometry3::new(Vector3::new(-0.1, -0.05, 0.8), Vector3::new(0.3, -0.4, 1.9));
        let pairs: Vec<_> = (0..20)
            .map(|i| Point3::new(f64::from(i % 5) * 0.04, f64::from(i / 5) * 0.04, 0.0))
            .map(|p| {
                let seen = camera_from_board * p;
                (p, Vector2::new(seen.x / seen.z, seen.y / seen.z))
            })
            .collect();
        let found = placement(&homography(&pairs).expect("determined")).expect("a placement");
        assert!(apart(&found, &camera_from_board, 1.0) < 1e-8);
        assert!(homography(&pairs[..5]).is_none());
        let same = vec![pairs[0]; 10];
        assert!(homography(&same).is_none());
    }
}
