"""Tests of the mappings in conventions.py: `python3 -m unittest test_conventions`. They need no ROS."""

import unittest
from types import SimpleNamespace

import conventions as c
import numpy as np


def rotation_about(axis, angle):
    x, y, z = np.asarray(axis) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def xyzw(rotation):
    w, x, y, z = c.wxyz_from_matrix(rotation)
    return np.array([x, y, z, w])


def estimate(**changes):
    spread = np.random.default_rng(1).normal(size=(2, 6, 6))
    fields = dict(
        frame="base",
        status="tracking",
        realtime_ns=1_700_000_000_123_456_789,
        epoch=257,
        tracks=200,
        inliers=150,
        position_m=np.array([1.0, 2.0, 3.0]),
        orientation_xyzw=xyzw(rotation_about([0.1, 0.2, 1.0], 0.7)),
        twist=np.array([1.5, 0.1, 0.2, 0.01, 0.02, 0.3]),
        cov_pose=spread[0] @ spread[0].T,
        cov_twist=spread[1] @ spread[1].T,
    )
    return SimpleNamespace(**{**fields, **changes})


def full(triangle):
    m = np.zeros((6, 6))
    m[np.triu_indices(6)] = triangle
    return m + np.triu(m, 1).T


class Ros(unittest.TestCase):
    def test_numbers_are_visods_own(self):
        e = estimate()
        m = c.ros_odometry(e)
        self.assertEqual((m.frame_id, m.child_frame_id), ("odom", "base_link"))
        self.assertEqual((m.stamp_sec, m.stamp_nanosec), (1_700_000_000, 123_456_789))
        np.testing.assert_array_equal(m.position, e.position_m)
        # Row by row: entry 4 is x against ry.
        self.assertEqual(m.pose_covariance[4], e.cov_pose[0, 4])
        self.assertEqual(m.twist_covariance[35], e.cov_twist[5, 5])
        np.testing.assert_array_equal(m.linear, e.twist[:3])
        np.testing.assert_array_equal(m.angular, e.twist[3:])

    def test_a_camera_is_not_called_a_base(self):
        m = c.ros_odometry(estimate(frame="left_camera"))
        self.assertEqual((m.frame_id, m.child_frame_id), ("odom_optical", "left_optical"))

    def test_stamps_before_1970_have_positive_nanoseconds(self):
        m = c.ros_odometry(estimate(realtime_ns=-1))
        self.assertEqual((m.stamp_sec, m.stamp_nanosec), (-1, 999_999_999))

    def test_the_optical_frame_stands_upright(self):
        level = c.matrix_from_xyzw(c.LEVEL_FROM_OPTICAL_XYZW)
        np.testing.assert_array_equal(level @ [0, 0, 1], [1, 0, 0])
        np.testing.assert_array_equal(level @ [1, 0, 0], [0, -1, 0])
        np.testing.assert_array_equal(level @ [0, 1, 0], [0, 0, -1])


class Mavlink(unittest.TestCase):
    def test_left_and_up_become_right_and_down(self):
        m = c.mavlink_odometry(estimate())
        self.assertEqual((m.frame_id, m.child_frame_id), (20, 12))
        self.assertEqual((m.x, m.y, m.z), (1.0, -2.0, -3.0))
        self.assertEqual((m.vx, m.vy, m.vz), (1.5, -0.1, -0.2))
        self.assertEqual((m.rollspeed, m.pitchspeed, m.yawspeed), (0.01, -0.02, -0.3))
        self.assertEqual(m.time_usec, 1_700_000_000_123_456)
        self.assertEqual(m.reset_counter, 1)

    def test_a_turn_to_the_left_is_a_negative_yaw(self):
        e = estimate(orientation_xyzw=xyzw(rotation_about([0, 0, 1], np.pi / 2)))
        np.testing.assert_allclose(
            c.mavlink_odometry(e).q, [np.sqrt(0.5), 0, 0, -np.sqrt(0.5)], atol=1e-15
        )

    def test_a_camera_that_looks_ahead_is_level(self):
        # The camera went 5 m forward, 1 m to the right, 0.5 m down, and turned to the right.
        e = estimate(
            frame="left_camera",
            position_m=np.array([1.0, 0.5, 5.0]),
            orientation_xyzw=xyzw(rotation_about([0, 1, 0], 0.4)),
            twist=np.array([0.1, 0.2, 3.0, 0.0, 0.5, 0.0]),
        )
        m = c.mavlink_odometry(e)
        self.assertEqual((m.x, m.y, m.z), (5.0, 1.0, 0.5))
        self.assertEqual((m.vx, m.vy, m.vz), (3.0, 0.1, 0.2))
        self.assertEqual((m.rollspeed, m.pitchspeed, m.yawspeed), (0.0, 0.0, 0.5))
        np.testing.assert_allclose(m.q, [np.cos(0.2), 0, 0, np.sin(0.2)], atol=1e-15)

    def test_quaternion_and_axes_turn_alike(self):
        rng = np.random.default_rng(2)
        for _ in range(200):
            rotation = rotation_about(rng.normal(size=3), rng.uniform(-np.pi, np.pi))
            for frame, frd_from in c._FRD_FROM.items():
                self.assertAlmostEqual(np.linalg.det(frd_from), 1.0)
                w, x, y, z = c.mavlink_odometry(
                    estimate(frame=frame, orientation_xyzw=xyzw(rotation))
                ).q
                v = rng.normal(size=3)
                there = frd_from @ (rotation @ v)
                here = c.matrix_from_xyzw(np.array([x, y, z, w])) @ (frd_from @ v)
                np.testing.assert_allclose(here, there, atol=1e-12)
                self.assertGreaterEqual(w, 0.0)

    def test_covariance_is_that_of_samples(self):
        # Poses scattered as the covariance says, roll, pitch and yaw read off each: the same spread.
        rng = np.random.default_rng(3)
        for frame in ("base", "left_camera"):
            e = estimate(frame=frame)
            e.cov_pose = 1e-6 * e.cov_pose
            stated = full(c.mavlink_odometry(e).pose_covariance)
            mean = angles_and_place(e, np.zeros(6))
            drawn = rng.multivariate_normal(np.zeros(6), e.cov_pose, size=10_000)
            errors = np.array([angles_and_place(e, d) for d in drawn]) - mean
            sampled = errors.T @ errors / len(errors)
            sigma = np.sqrt(np.diag(stated))
            np.testing.assert_allclose(
                sampled / np.outer(sigma, sigma), stated / np.outer(sigma, sigma), atol=0.06
            )

    def test_near_the_pole_the_covariance_is_unknown(self):
        e = estimate(orientation_xyzw=xyzw(rotation_about([0, 1, 0], np.pi / 2)))
        m = c.mavlink_odometry(e)
        self.assertTrue(np.isnan(m.pose_covariance[0]))
        self.assertFalse(np.isnan(m.velocity_covariance[0]))

    def test_quality_says_how_much_to_believe(self):
        self.assertEqual(c.quality(estimate()), 75)
        self.assertEqual(c.quality(estimate(status="lost")), -1)
        self.assertEqual(c.quality(estimate(status="initializing")), 0)
        self.assertEqual(c.quality(estimate(inliers=0)), 1)
        self.assertEqual(c.quality(estimate(inliers=300)), 100)


def angles_and_place(e, error):
    """x, y, z, roll, pitch, yaw, forward right down, of an estimate that is off by `error` about fixed axes."""
    angle = np.linalg.norm(error[3:])
    turn = rotation_about(error[3:], angle) if angle > 0 else np.eye(3)
    frd_from = c._FRD_FROM[e.frame]
    rotation = frd_from @ turn @ c.matrix_from_xyzw(e.orientation_xyzw) @ frd_from.T
    roll = np.arctan2(rotation[2, 1], rotation[2, 2])
    pitch = -np.arcsin(rotation[2, 0])
    yaw = np.arctan2(rotation[1, 0], rotation[0, 0])
    return np.array([*(frd_from @ (e.position_m + error[:3])), roll, pitch, yaw])


if __name__ == "__main__":
    unittest.main()
