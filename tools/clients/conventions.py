"""visod's odometry in the conventions of ROS 2 and of MAVLink: plain functions of numpy arrays.

visod's message is either of the robot's base (x forward, y left, z up, as REP-103 wants it), in the odometry
frame that was the base's at the start, or, for a rig without a mounting, of the left camera (x right, y down,
z forward), in the frame that was the camera's at the start. Its covariances are ordered x, y, z, rx, ry, rz
with rotations about the fixed axes of the odometry frame, which is the order and the meaning of
nav_msgs/Odometry; its twist is in the moving frame itself.

| | frame | child frame | axes |
|---|---|---|---|
| ROS, base | odom | base_link | REP-103, REP-105 |
| ROS, camera | odom_optical | left_optical | REP-103's optical frames |
| MAVLink | MAV_FRAME_LOCAL_FRD | MAV_FRAME_BODY_FRD | x forward, y right, z down |
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Optional

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Common constants of MAVLink, by their names there.
MAV_FRAME_BODY_FRD = 12
MAV_FRAME_LOCAL_FRD = 20
MAV_ESTIMATOR_TYPE_VISION = 2

# Each maps a vector in a frame of visod's into forward, right, down.
_FRD_FROM = {
    "base": np.diag([1.0, -1.0, -1.0]),
    "left_camera": np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
}
# Maps a vector in a camera's axes into forward, left, up: where odom_optical stands in odom.
LEVEL_FROM_OPTICAL_XYZW = np.array([-0.5, 0.5, -0.5, 0.5])

# Closer to straight up or down than this, roll and yaw are one: no covariance of them is stated, rad.
_GIMBAL_MARGIN_RAD = math.radians(5.0)
_UPPER = np.triu_indices(6)


@dataclass(frozen=True, eq=False)
class RosOdometry:
    """The fields of nav_msgs/Odometry."""

    stamp_sec: int
    stamp_nanosec: int
    frame_id: str
    child_frame_id: str
    position: Array  # (3,)
    orientation_xyzw: Array  # (4,)
    pose_covariance: Array  # (36,), row by row
    linear: Array  # (3,), in the child frame
    angular: Array  # (3,)
    twist_covariance: Array  # (36,)


@dataclass(frozen=True, eq=False)
class MavlinkOdometry:
    """The fields of MAVLink's ODOMETRY (331), by their names there."""

    time_usec: int
    frame_id: int
    child_frame_id: int
    x: float
    y: float
    z: float
    q: list[float]  # w, x, y, z
    vx: float
    vy: float
    vz: float
    rollspeed: float
    pitchspeed: float
    yawspeed: float
    pose_covariance: list[float]  # 21: upper triangle of x, y, z, roll, pitch, yaw
    velocity_covariance: list[float]  # 21
    reset_counter: int
    estimator_type: int
    quality: int  # -1 failed, 0 unknown, 1 to 100 %


def ros_odometry(estimate) -> RosOdometry:
    """An estimate as nav_msgs/Odometry has it: the numbers are visod's own, under ROS's names."""
    frames = {"base": ("odom", "base_link"), "left_camera": ("odom_optical", "left_optical")}
    frame_id, child_frame_id = frames[estimate.frame]
    sec, nanosec = divmod(estimate.realtime_ns, 10**9)
    return RosOdometry(
        stamp_sec=sec,
        stamp_nanosec=nanosec,
        frame_id=frame_id,
        child_frame_id=child_frame_id,
        position=estimate.position_m,
        orientation_xyzw=estimate.orientation_xyzw,
        pose_covariance=estimate.cov_pose.reshape(36),
        linear=estimate.twist[:3],
        angular=estimate.twist[3:],
        twist_covariance=estimate.cov_twist.reshape(36),
    )


def mavlink_odometry(estimate) -> MavlinkOdometry:
    """An estimate as MAVLink's ODOMETRY has it: local and body frame both forward, right, down."""
    frd_from = _FRD_FROM[estimate.frame]
    both = np.kron(np.eye(2), frd_from)
    rotation = frd_from @ matrix_from_xyzw(estimate.orientation_xyzw) @ frd_from.T
    position = frd_from @ estimate.position_m
    twist = both @ estimate.twist
    cov_pose = cov_by_angles(both @ estimate.cov_pose @ both.T, rotation)
    return MavlinkOdometry(
        time_usec=estimate.realtime_ns // 1000,
        frame_id=MAV_FRAME_LOCAL_FRD,
        child_frame_id=MAV_FRAME_BODY_FRD,
        **dict(zip("xyz", position.tolist())),
        q=wxyz_from_matrix(rotation).tolist(),
        **dict(zip(("vx", "vy", "vz"), twist[:3].tolist())),
        **dict(zip(("rollspeed", "pitchspeed", "yawspeed"), twist[3:].tolist())),
        pose_covariance=_triangle(cov_pose),
        velocity_covariance=_triangle(both @ estimate.cov_twist @ both.T),
        reset_counter=estimate.epoch % 256,
        estimator_type=MAV_ESTIMATOR_TYPE_VISION,
        quality=quality(estimate),
    )


def quality(estimate) -> int:
    """The share of the tracks that the estimate rests on, per cent; -1 for a pose that is only bridged, 0 for
    the first of an epoch, which nothing was measured for."""
    if estimate.status == "lost":
        return -1
    if estimate.status == "initializing" or estimate.tracks == 0:
        return 0
    return min(max(round(100.0 * estimate.inliers / estimate.tracks), 1), 100)


def cov_by_angles(cov: Array, rotation: Array) -> Optional[Array]:
    """A covariance whose rotation is about fixed axes as one of roll, pitch and yaw (R = Rz Ry Rx); None near
    the pole, where roll and yaw cannot be told apart.

    A turn about fixed axes is E (droll, dpitch, dyaw), the columns of E being the axes that each angle turns
    about: Rz Ry x, Rz y and z.
    """
    pitch = math.asin(min(max(-rotation[2, 0], -1.0), 1.0))
    if abs(pitch) > math.pi / 2 - _GIMBAL_MARGIN_RAD:
        return None
    yaw = math.atan2(rotation[1, 0], rotation[0, 0])
    turned_y = [-math.sin(yaw), math.cos(yaw), 0.0]
    axes = np.column_stack([rotation[:, 0], turned_y, [0.0, 0.0, 1.0]])
    jacobian = np.eye(6)
    jacobian[3:, 3:] = np.linalg.inv(axes)
    return jacobian @ cov @ jacobian.T


def matrix_from_xyzw(xyzw: Array) -> Array:
    """The rotation matrix of a unit quaternion."""
    x, y, z, w = xyzw
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def wxyz_from_matrix(rotation: Array) -> Array:
    """The unit quaternion of a rotation matrix, w >= 0."""
    # The largest of the four squares of 2 w, 2 x, 2 y, 2 z, to divide by (Shepperd 1978).
    trace = np.trace(rotation)
    squares = np.array([1 + trace, *(1 - trace + 2 * np.diag(rotation))])
    largest = int(np.argmax(squares))
    antisymmetric = np.array(
        [
            rotation[2, 1] - rotation[1, 2],
            rotation[0, 2] - rotation[2, 0],
            rotation[1, 0] - rotation[0, 1],
        ]
    )
    if largest == 0:
        q = np.array([squares[0], *antisymmetric])
    else:
        i = largest - 1
        q = np.array([antisymmetric[i], *(rotation[i] + rotation[:, i])])
        q[largest] = squares[largest]
    q /= np.linalg.norm(q)
    return -q if q[0] < 0 else q


def _triangle(cov: Optional[Array]) -> list[float]:
    """Upper triangle, row by row; what is not known is told by a first entry that is no number."""
    return [math.nan] * 21 if cov is None else cov[_UPPER].tolist()
