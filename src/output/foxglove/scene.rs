//! Estimates and features in, drawings for Foxglove out.

use crate::estimation::{Odometry, TrackedFeature};
use crate::geometry::StereoRig;
use crate::output::topics::Frames;
use crate::ros::messages as ros;
use foxglove::messages::{
    Color, ImageAnnotations, LinePrimitive, Point2, Point3, PointsAnnotation, Pose, Quaternion,
    SceneEntity, SceneUpdate, SpherePrimitive, TextPrimitive, Timestamp, Vector3, line_primitive,
    points_annotation,
};
use nalgebra::{Matrix3, Rotation3, SymmetricEigen, UnitQuaternion};

/// Diameter of a feature's dot, px.
const DOT_PX: f64 = 4.0;
/// Pairs after which a feature counts as old.
const OLD: f64 = 20.0;
/// The way grows by a point where the robot has gone so far, m.
const STEP_M: f64 = 0.05;
/// Points of the way at most: then every other one is forgotten.
const MAX_POINTS: usize = 4000;
/// The ellipsoid is enlarged by a power of ten until its longest half axis has so many m.
const LEAST_RADIUS_M: f64 = 0.03;

/// The features in the left image: new ones yellow, old ones blue, which every eye tells apart.
pub(super) fn annotations(timestamp_ns: i64, features: &[TrackedFeature]) -> ImageAnnotations {
    let point = |f: &TrackedFeature| Point2 {
        x: f.measurement.px.x,
        y: f.measurement.px.y,
    };
    ImageAnnotations {
        timestamp: timestamp(timestamp_ns),
        points: vec![PointsAnnotation {
            timestamp: timestamp(timestamp_ns),
            r#type: points_annotation::Type::Points as i32,
            points: features.iter().map(point).collect(),
            outline_colors: features.iter().map(|f| by_age(f.age)).collect(),
            thickness: DOT_PX,
            ..PointsAnnotation::default()
        }],
        ..ImageAnnotations::default()
    }
}

fn by_age(age: u32) -> Color {
    let old = (f64::from(age) / OLD).min(1.0);
    let between = |new: f64, last: f64| new + old * (last - new);
    Color {
        r: between(1.0, 0.0),
        g: between(0.85, 0.35),
        b: between(0.0, 1.0),
        a: 1.0,
    }
}

/// The way so far, and how sure the robot is of where it stands.
pub(super) struct Scene {
    frames: Frames,
    epoch: u32,
    way: Vec<Point3>,
}

impl Scene {
    pub(super) fn new(rig: &StereoRig) -> Self {
        Self {
            frames: Frames::new(rig.base_from_camera, rig.right_from_left),
            epoch: 0,
            way: Vec::new(),
        }
    }

    /// Takes note of where an estimate is.
    pub(super) fn go(&mut self, estimate: &Odometry) {
        if self.epoch != estimate.epoch {
            self.epoch = estimate.epoch;
            self.way.clear();
        }
        let ros::Vector3 { x, y, z } = self.frames.odometry(estimate).pose.pose.position;
        let is_far = |last: &Point3| {
            let (dx, dy, dz) = (x - last.x, y - last.y, z - last.z);
            dx * dx + dy * dy + dz * dz >= STEP_M * STEP_M
        };
        if self.way.last().is_none_or(is_far) {
            if self.way.len() >= MAX_POINTS {
                let mut is_kept = false;
                self.way.retain(|_| {
                    is_kept = !is_kept;
                    is_kept
                });
            }
            self.way.push(Point3 { x, y, z });
        }
    }

    /// The drawing with an estimate at its end.
    pub(super) fn update(&self, estimate: &Odometry) -> SceneUpdate {
        let odometry = self.frames.odometry(estimate);
        let position = odometry.pose.pose.position;
        let mut points = self.way.clone();
        points.push(Point3 {
            x: position.x,
            y: position.y,
            z: position.z,
        });
        let entity = |id: &str| SceneEntity {
            timestamp: timestamp(estimate.timestamp_ns),
            frame_id: odometry.header.frame_id.clone(),
            id: id.to_owned(),
            ..SceneEntity::default()
        };
        let way = LinePrimitive {
            r#type: line_primitive::Type::LineStrip as i32,
            pose: Some(Pose::default()),
            thickness: 2.0,
            scale_invariant: true,
            points,
            color: colour(0.0, 0.45, 0.7, 1.0),
            ..LinePrimitive::default()
        };
        let (ellipsoid, label) = ellipsoid(&odometry);
        SceneUpdate {
            entities: vec![
                SceneEntity {
                    lines: vec![way],
                    ..entity("way")
                },
                SceneEntity {
                    spheres: vec![ellipsoid],
                    texts: vec![label],
                    ..entity("uncertainty")
                },
            ],
            ..SceneUpdate::default()
        }
    }
}

/// The 3 σ ellipsoid of the position, enlarged until it can be seen, and what it is.
fn ellipsoid(odometry: &ros::Odometry) -> (SpherePrimitive, TextPrimitive) {
    let cov = &odometry.pose.covariance.0;
    let cov = Matrix3::from_fn(|i, j| cov[6 * i + j]);
    let axes = SymmetricEigen::new(cov);
    let radii_m = axes
        .eigenvalues
        .map(|variance| 3.0 * variance.max(0.0).sqrt());
    let enlarged = [1.0, 10.0, 100.0, 1000.0]
        .into_iter()
        .find(|factor| factor * radii_m.max() >= LEAST_RADIUS_M)
        .unwrap_or(1000.0);
    let mut turn = axes.eigenvectors;
    if turn.determinant() < 0.0 {
        turn.column_mut(2).neg_mut();
    }
    let turn = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(turn));
    let place = odometry.pose.pose.position;
    let position = Some(Vector3 {
        x: place.x,
        y: place.y,
        z: place.z,
    });
    let size = radii_m * (2.0 * enlarged);
    let sphere = SpherePrimitive {
        pose: Some(Pose {
            position,
            orientation: Some(Quaternion {
                x: turn.i,
                y: turn.j,
                z: turn.k,
                w: turn.w,
            }),
        }),
        size: Some(Vector3 {
            x: size.x,
            y: size.y,
            z: size.z,
        }),
        color: colour(0.84, 0.37, 0.0, 0.4),
    };
    let label = TextPrimitive {
        pose: Some(Pose {
            position,
            orientation: Some(Quaternion {
                w: 1.0,
                ..Quaternion::default()
            }),
        }),
        billboard: true,
        font_size: 14.0,
        scale_invariant: true,
        color: colour(0.84, 0.37, 0.0, 1.0),
        text: format!("3 σ × {enlarged}"),
    };
    (sphere, label)
}

fn colour(r: f64, g: f64, b: f64, a: f64) -> Option<Color> {
    Some(Color { r, g, b, a })
}

/// What no `u32` of seconds holds is left out.
fn timestamp(timestamp_ns: i64) -> Option<Timestamp> {
    let sec = u32::try_from(timestamp_ns.div_euclid(1_000_000_000)).ok()?;
    Some(Timestamp::new(
        sec,
        timestamp_ns.rem_euclid(1_000_000_000) as u32,
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::output::row::tests::sample_odometry;
    use nalgebra::{Isometry3, Matrix6, Vector6};

    fn rig() -> StereoRig {
        crate::simulation::small_rig()
    }

    #[test]
    fn the_way_grows_with_the_distance_and_begins_anew_with_an_epoch() {
        let mut scene = Scene::new(&rig());
        let mut estimate = sample_odometry(3);
        for i in 0..100 {
            estimate.odom_from_camera = Isometry3::translation(0.0, 0.0, 0.02 * f64::from(i));
            scene.go(&estimate);
        }
        assert!((30..=40).contains(&scene.way.len()), "{}", scene.way.len());
        estimate.epoch += 1;
        scene.go(&estimate);
        assert_eq!(scene.way.len(), 1);
    }

    #[test]
    fn a_long_way_keeps_its_ends() {
        let mut scene = Scene::new(&rig());
        let mut estimate = sample_odometry(3);
        for i in 0..3 * MAX_POINTS as u32 {
            estimate.odom_from_camera = Isometry3::translation(f64::from(i), 0.0, 0.0);
            scene.go(&estimate);
        }
        assert!(scene.way.len() <= MAX_POINTS);
        assert_eq!(scene.way.first().map(|p| p.x), Some(0.0));
        let end = f64::from(3 * MAX_POINTS as u32 - 1);
        assert_eq!(scene.way.last().map(|p| p.x), Some(end));
    }

    #[test]
    fn the_ellipsoid_has_the_axes_of_the_covariance() {
        let mut estimate = sample_odometry(3);
        let variances = Vector6::new(1e-4, 4e-4, 9e-4, 1.0, 1.0, 1.0);
        estimate.cov_pose = Matrix6::from_diagonal(&variances);
        let frames = Frames::new(None, Isometry3::identity());
        let (sphere, label) = ellipsoid(&frames.odometry(&estimate));
        let size = sphere.size.unwrap();
        let mut sizes = [size.x, size.y, size.z];
        sizes.sort_by(f64::total_cmp);
        for (size, expected) in sizes.into_iter().zip([0.06, 0.12, 0.18]) {
            assert!((size - expected).abs() < 1e-12);
        }
        assert_eq!(label.text, "3 σ × 1");
    }
}
