//! An estimate in, the ROS messages that say the same out.
//!
//! Where the rig has a mounting, the robot's base moves in `odom` as REP-103 and REP-105 have it: x
//! forward, y left, z up. Where it has none, the left camera moves in `odom_optical`, which stands in
//! `odom` with its z axis forward, so that viewers show the way level.

use crate::estimation::{Odometry, Status};
use crate::output::mounting::in_base_frame;
use crate::output::row::canonical_xyzw;
use crate::ros::messages as ros;
use crate::ros::{Fixed, time};
use nalgebra::{Isometry3, Matrix6, Translation3, UnitQuaternion, Vector3};

const ODOM: &str = "odom";
const ODOM_OPTICAL: &str = "odom_optical";
const BASE: &str = "base_link";
/// The optical frames, by side.
pub(super) const OPTICAL: [&str; 2] = ["left_optical", "right_optical"];

/// Names the frames of one rig.
#[derive(Clone, Debug)]
pub(in crate::output) struct Frames {
    base_from_camera: Option<Isometry3<f64>>,
    right_from_left: Isometry3<f64>,
}

impl Frames {
    pub(in crate::output) fn new(
        base_from_camera: Option<Isometry3<f64>>,
        right_from_left: Isometry3<f64>,
    ) -> Self {
        Self {
            base_from_camera,
            right_from_left,
        }
    }

    /// The frame that poses are in, and the one that moves.
    fn names(&self) -> [&'static str; 2] {
        match self.base_from_camera {
            Some(_) => [ODOM, BASE],
            None => [ODOM_OPTICAL, OPTICAL[0]],
        }
    }

    /// Pose and velocity, of the base where there is one.
    pub(in crate::output) fn odometry(&self, camera: &Odometry) -> ros::Odometry {
        let moved = self.base_from_camera.map(|x| in_base_frame(camera, &x));
        let estimate = moved.as_ref().unwrap_or(camera);
        let [frame, child] = self.names();
        let twist = &estimate.twist;
        ros::Odometry {
            header: header(frame, estimate.timestamp_ns),
            child_frame_id: child.to_owned(),
            pose: ros::PoseWithCovariance {
                pose: ros::Pose {
                    position: vector3(&estimate.odom_from_camera.translation.vector),
                    orientation: quaternion(&estimate.odom_from_camera.rotation),
                },
                covariance: row_major(&estimate.cov_pose),
            },
            twist: ros::TwistWithCovariance {
                twist: ros::Twist {
                    linear: vector3(&twist.fixed_rows::<3>(0).into_owned()),
                    angular: vector3(&twist.fixed_rows::<3>(3).into_owned()),
                },
                covariance: row_major(&estimate.cov_twist),
            },
        }
    }

    /// The transform that changes with every pair.
    pub(super) fn moving(&self, odometry: &ros::Odometry) -> ros::TfMessage {
        let pose = &odometry.pose.pose;
        ros::TfMessage {
            transforms: vec![ros::TransformStamped {
                header: odometry.header.clone(),
                child_frame_id: odometry.child_frame_id.clone(),
                transform: ros::Transform {
                    translation: pose.position,
                    rotation: pose.orientation,
                },
            }],
        }
    }

    /// The transforms that stay.
    pub(super) fn fixed(&self, timestamp_ns: i64) -> ros::TfMessage {
        let transform =
            |frame: &str, child: &str, frame_from_child: &Isometry3<f64>| ros::TransformStamped {
                header: header(frame, timestamp_ns),
                child_frame_id: child.to_owned(),
                transform: ros::Transform {
                    translation: vector3(&frame_from_child.translation.vector),
                    rotation: quaternion(&frame_from_child.rotation),
                },
            };
        let left_from_right = self.right_from_left.inverse();
        let first = match &self.base_from_camera {
            Some(base_from_camera) => transform(BASE, OPTICAL[0], base_from_camera),
            None => transform(ODOM, ODOM_OPTICAL, &level_from_optical()),
        };
        ros::TfMessage {
            transforms: vec![first, transform(OPTICAL[0], OPTICAL[1], &left_from_right)],
        }
    }
}

/// Turns camera axes (x right, y down, z forward) into x forward, y left, z up.
fn level_from_optical() -> Isometry3<f64> {
    // The half of (−1, 1, −1; 1): exact in binary.
    let turn = nalgebra::Quaternion::new(0.5, -0.5, 0.5, -0.5);
    Isometry3::from_parts(
        Translation3::identity(),
        UnitQuaternion::new_unchecked(turn),
    )
}

/// How the estimate is, in the words of `diagnostics`.
pub(super) fn diagnostics(odometry: &Odometry) -> ros::DiagnosticArray {
    let level = match odometry.status {
        Status::Tracking => 0,
        Status::Initializing | Status::Degraded => 1,
        Status::Lost => 2,
    };
    let counts = &odometry.counts;
    let values = [
        ("sequence", odometry.sequence.to_string()),
        ("epoch", odometry.epoch.to_string()),
        ("keypoints_left", counts.keypoints_left.to_string()),
        ("keypoints_right", counts.keypoints_right.to_string()),
        ("stereo_matches", counts.stereo_matches.to_string()),
        ("tracks", counts.tracks.to_string()),
        ("inliers", counts.inliers.to_string()),
        ("variance_factor", odometry.variance_factor.to_string()),
    ];
    ros::DiagnosticArray {
        header: header("", odometry.timestamp_ns),
        status: vec![ros::DiagnosticStatus {
            level,
            name: "visod: odometry".to_owned(),
            message: odometry.status.as_str().to_owned(),
            hardware_id: String::new(),
            values: values
                .map(|(key, value)| ros::KeyValue {
                    key: key.to_owned(),
                    value,
                })
                .into(),
        }],
    }
}

pub(super) fn header(frame_id: &str, timestamp_ns: i64) -> ros::Header {
    ros::Header {
        stamp: time(timestamp_ns),
        frame_id: frame_id.to_owned(),
    }
}

fn vector3(v: &Vector3<f64>) -> ros::Vector3 {
    ros::Vector3 {
        x: v.x,
        y: v.y,
        z: v.z,
    }
}

fn quaternion(q: &UnitQuaternion<f64>) -> ros::Quaternion {
    let [x, y, z, w] = canonical_xyzw(q);
    ros::Quaternion { x, y, z, w }
}

fn row_major(m: &Matrix6<f64>) -> Fixed<36> {
    Fixed(std::array::from_fn(|i| m[(i / 6, i % 6)]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::output::row::tests::sample_odometry;

    #[test]
    fn camera_axes_stand_upright_in_the_odometry_frame() {
        let level = level_from_optical();
        let close = |a: Vector3<f64>, b: Vector3<f64>| (a - b).norm() < 1e-15;
        assert!(close(level * Vector3::z(), Vector3::x()), "forward");
        assert!(close(level * Vector3::x(), -Vector3::y()), "right");
        assert!(close(level * Vector3::y(), -Vector3::z()), "down");
    }

    #[test]
    fn without_a_mounting_the_numbers_are_the_estimate_itself() {
        let estimate = sample_odometry(3);
        let frames = Frames::new(None, Isometry3::translation(-0.3, 0.0, 0.0));
        let message = frames.odometry(&estimate);
        assert_eq!(message.header.frame_id, "odom_optical");
        assert_eq!(message.child_frame_id, "left_optical");
        assert_eq!(message.pose.covariance.0[1], estimate.cov_pose[(0, 1)]);
        assert_eq!(message.pose.covariance.0[35], estimate.cov_pose[(5, 5)]);
        assert_eq!(message.twist.twist.linear.x, estimate.twist[0]);
        assert_eq!(message.twist.twist.angular.z, estimate.twist[5]);
        let right = &frames.fixed(0).transforms[1];
        assert_eq!(right.transform.translation.x, 0.3);
    }

    #[test]
    fn with_a_mounting_the_base_moves_forward_along_x() {
        let mut estimate = sample_odometry(3);
        estimate.odom_from_camera = Isometry3::translation(0.0, 0.0, 2.0);
        estimate.twist = nalgebra::Vector6::new(0.0, 0.0, 1.5, 0.0, 0.0, 0.0);
        let mut mounting = level_from_optical();
        mounting.translation.vector.z = 0.8;
        let message = Frames::new(Some(mounting), Isometry3::identity()).odometry(&estimate);
        assert_eq!(message.child_frame_id, "base_link");
        assert!((message.pose.pose.position.x - 2.0).abs() < 1e-12);
        assert!((message.twist.twist.linear.x - 1.5).abs() < 1e-12);
    }
}
