//! View: where a camera stands in, how a plane of any slope is seen from there, out.
//!
//! Around its centre a patch of a plane goes from one image to the other by a homography
//! (Hartley and Zisserman, *Multiple View Geometry*, §13.1). With the centre kept, δ px in the anchor
//! are seen at `A δ / (1 + d · δ)`: `A` is linear in the slope, and `d` is the share by which depth
//! grows with each px. A lens' distortion is taken for constant over a patch.

use nalgebra::{Isometry3, Matrix2, Matrix4x3, Vector2, Vector3};

/// How an image shows a patch: the plane that it lies in, through a homography.
#[derive(Clone, Copy, Debug)]
pub struct View {
    /// The derivative of a pixel of the image by the one of the anchor that shows the same, on a
    /// surface of slope 0.
    pub now_by_anchor: Matrix2<f64>,
    /// The displacement against what lies at infinity, px.
    pub lever_px: Vector2<f64>,
    /// Share by which depth grows with each px of the anchor, on a surface of slope 0 …
    pub depth_by_px: Vector2<f64>,
    /// … and with the slope.
    pub depth_by_slope: f64,
}

impl View {
    /// The camera stands at `now_from_anchor`; from the derivatives of all pixels by (x, y, ρ), those of
    /// the image from `row` on, and of (x, y) by the anchor's pixel.
    pub(super) fn new(
        by_point: &Matrix4x3<f64>,
        row: usize,
        by_px: &Matrix2<f64>,
        now_from_anchor: &Isometry3<f64>,
        y: &Vector3<f64>,
    ) -> Self {
        let ahead = now_from_anchor.inverse() * Vector3::z();
        let forward = now_from_anchor.translation.z * y.z;
        let depth = ahead.dot(&Vector3::new(y.x, y.y, 1.0)) + forward;
        Self {
            now_by_anchor: by_point.fixed_view::<2, 2>(row, 0) * by_px,
            lever_px: by_point.fixed_view::<2, 1>(row, 2) * y.z,
            depth_by_px: by_px.transpose() * ahead.xy() / depth,
            depth_by_slope: forward / depth,
        }
    }

    /// The derivative of a pixel by the anchor's, and of depth, in shares of it, on a surface of any
    /// slope.
    pub(super) fn on(&self, slope: &Vector2<f64>) -> (Matrix2<f64>, Vector2<f64>) {
        (
            self.now_by_anchor + self.lever_px * slope.transpose(),
            self.depth_by_px + slope * self.depth_by_slope,
        )
    }

    /// How far the patch is deformed: the root of the sum of its principal strains' squares.
    pub(super) fn deformation(&self, slope: &Vector2<f64>) -> f64 {
        let (now_by_anchor, _) = self.on(slope);
        0.5 * (now_by_anchor.transpose() * now_by_anchor - Matrix2::identity()).norm()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimation::{linearise_sight, seen_at};
    use crate::geometry::se3;
    use crate::simulation::thesis_rig;
    use nalgebra::Vector6;

    #[test]
    fn a_sloping_plane_is_seen_where_its_points_are() {
        let rig = thesis_rig();
        let now_from_anchor = se3::exp(&Vector6::new(0.1, -0.05, -0.8, 0.03, -0.05, 0.08));
        let centre_px = Vector2::new(700.0, 620.0);
        let slope = Vector2::new(-0.0007, 0.004);
        // (x, y, ρ) of the plane's point at some px from the centre.
        let point = |offset_px: &Vector2<f64>| {
            let ray = rig.left.unproject(&(centre_px + offset_px)).expect("a ray");
            let inverse_depth = 0.2 * (1.0 + slope.dot(offset_px));
            Vector3::new(ray.x, ray.y, inverse_depth)
        };
        let centre = point(&Vector2::zeros());
        let by_point = |camera: &Isometry3<f64>| {
            let sight = linearise_sight(&rig, camera, &centre).expect("in sight");
            sight.by_point
        };
        let by_px = by_point(&Isometry3::identity())
            .fixed_view::<2, 2>(0, 0)
            .try_inverse()
            .expect("regular");
        let cameras = [now_from_anchor, rig.right_from_left * now_from_anchor];
        let seen = |offset_px: &Vector2<f64>| {
            seen_at(&rig, &now_from_anchor, &point(offset_px)).expect("in sight")
        };
        for (side, camera) in [0, 2].into_iter().zip(&cameras) {
            let view = View::new(&by_point(&now_from_anchor), side, &by_px, camera, &centre);
            let (now_by_anchor, depth_by_px) = view.on(&slope);
            for offset_px in [(8.0, 0.0), (0.0, 8.0), (-6.0, 5.0), (4.0, -9.0)] {
                let offset_px = Vector2::new(offset_px.0, offset_px.1);
                let expected = seen(&offset_px) - seen(&Vector2::zeros());
                let found = now_by_anchor * offset_px / (1.0 + depth_by_px.dot(&offset_px));
                let error = (found - expected.fixed_rows::<2>(side)).norm();
                assert!(error < 1e-9, "{side} {offset_px}: {error} px");
            }
        }
    }
}
