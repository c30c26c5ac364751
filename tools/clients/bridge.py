#!/usr/bin/env python3
"""Passes visod's odometry on to ROS 2 or to an autopilot.

    python3 bridge.py --ros                                  # nav_msgs/Odometry and /tf
    python3 bridge.py --mavlink udpout:192.168.1.7:14550     # MAVLink's ODOMETRY, as PX4 and ArduPilot take it

--ros takes rclpy and the messages from the ROS 2 that is sourced; --mavlink needs pymavlink and takes any
address of its own (udpout:HOST:PORT, serial devices, …). conventions.py says what becomes of each number.
Where visod falls silent, so does this: who steers by it must act on silence.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import sys
from typing import Optional, Protocol

from conventions import LEVEL_FROM_OPTICAL_XYZW, mavlink_odometry, ros_odometry
from visod_client import MessageError, Odometry, OdometrySubscriber


class Sink(Protocol):
    """Where estimates go."""

    def send(self, estimate: Odometry) -> None: ...


class Mavlink:
    """MAVLink's ODOMETRY and, once a second, the heartbeat of a companion."""

    def __init__(self, address: str, system: int, baud: int) -> None:
        # ODOMETRY is not in MAVLink 1, which pymavlink begins with otherwise.
        os.environ["MAVLINK20"] = "1"
        from pymavlink import mavutil

        self._link = mavutil.mavlink_connection(
            address,
            baud=baud,
            source_system=system,
            source_component=mavutil.mavlink.MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY,
            dialect="common",
        )
        self._mavlink = mavutil.mavlink
        self._last_heartbeat_ns: Optional[int] = None

    def send(self, estimate: Odometry) -> None:
        now_ns = estimate.published_monotonic_ns
        if self._last_heartbeat_ns is None or now_ns - self._last_heartbeat_ns >= 10**9:
            self._last_heartbeat_ns = now_ns
            self._link.mav.heartbeat_send(
                self._mavlink.MAV_TYPE_ONBOARD_CONTROLLER,
                self._mavlink.MAV_AUTOPILOT_INVALID,
                0,
                0,
                self._mavlink.MAV_STATE_ACTIVE,
            )
        self._link.mav.odometry_send(**dataclasses.asdict(mavlink_odometry(estimate)))


class Ros:
    """nav_msgs/Odometry on a topic, and the same pose on /tf."""

    def __init__(self, topic: str) -> None:
        import rclpy
        from geometry_msgs.msg import TransformStamped
        from nav_msgs.msg import Odometry as OdometryMessage
        from rclpy.qos import DurabilityPolicy, QoSProfile
        from tf2_msgs.msg import TFMessage

        rclpy.init()
        self._node = rclpy.create_node("visod_bridge")
        self._odometry = self._node.create_publisher(OdometryMessage, topic, 10)
        self._tf = self._node.create_publisher(TFMessage, "/tf", 10)
        lasting = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._tf_static = self._node.create_publisher(TFMessage, "/tf_static", lasting)
        self._types = (OdometryMessage, TransformStamped, TFMessage)
        self._told_level = False

    def send(self, estimate: Odometry) -> None:
        odometry_type, transform_type, tf_type = self._types
        o = ros_odometry(estimate)
        m = odometry_type()
        m.header.stamp.sec, m.header.stamp.nanosec = o.stamp_sec, o.stamp_nanosec
        m.header.frame_id, m.child_frame_id = o.frame_id, o.child_frame_id
        _set(m.pose.pose.position, "xyz", o.position)
        _set(m.pose.pose.orientation, "xyzw", o.orientation_xyzw)
        m.pose.covariance = o.pose_covariance.tolist()
        _set(m.twist.twist.linear, "xyz", o.linear)
        _set(m.twist.twist.angular, "xyz", o.angular)
        m.twist.covariance = o.twist_covariance.tolist()
        if o.frame_id == "odom_optical" and not self._told_level:
            # A camera without a mounting: at least the way lies level.
            self._told_level = True
            level = transform_type()
            level.header.stamp = m.header.stamp
            level.header.frame_id, level.child_frame_id = "odom", "odom_optical"
            _set(level.transform.rotation, "xyzw", LEVEL_FROM_OPTICAL_XYZW)
            self._tf_static.publish(tf_type(transforms=[level]))
        self._odometry.publish(m)
        moving = transform_type(header=m.header, child_frame_id=o.child_frame_id)
        _set(moving.transform.translation, "xyz", o.position)
        _set(moving.transform.rotation, "xyzw", o.orientation_xyzw)
        self._tf.publish(tf_type(transforms=[moving]))


def _set(target: object, names: str, values) -> None:
    for name, value in zip(names, values):
        setattr(target, name, float(value))


def forward(odometry: OdometrySubscriber, sink: Sink, count: Optional[int]) -> None:
    """Hands every estimate on, until there were `count`, if that is given."""
    forwarded = 0
    while count is None or forwarded < count:
        try:
            estimate = odometry.wait()
        except MessageError as error:
            print(f"bridge.py: {error}", file=sys.stderr)
            continue
        if estimate is not None:
            sink.send(estimate)
            forwarded += 1


def main() -> int:
    parser = argparse.ArgumentParser(
        description="Pass visod's odometry on to ROS 2 or to an autopilot.",
        epilog="Examples: bridge.py --ros    bridge.py --mavlink udpout:127.0.0.1:14550",
    )
    where = parser.add_mutually_exclusive_group(required=True)
    where.add_argument("--ros", action="store_true", help="publish nav_msgs/Odometry and /tf")
    where.add_argument("--mavlink", metavar="ADDRESS", help="send ODOMETRY, to udpout:HOST:PORT or a serial device")
    parser.add_argument("--topic", default="/visod/odometry", help="topic of --ros (default: %(default)s)")
    parser.add_argument("--system", type=int, default=1, help="MAVLink's system, that of the autopilot (default: 1)")
    parser.add_argument("--baud", type=int, default=921600, help="of a serial device (default: %(default)s)")
    parser.add_argument("--count", type=int, help="end after this many estimates")
    parser.add_argument("--service-root", help="the publisher's publish.root")
    parser.add_argument("--service-prefix", help="the publisher's publish.prefix")
    args = parser.parse_args()

    try:
        sink: Sink = Ros(args.topic) if args.ros else Mavlink(args.mavlink, args.system, args.baud)
    except ImportError as error:
        advice = "source a ROS 2" if args.ros else "pip install -r requirements.txt"
        print(f"bridge.py: {error.name} is not here: {advice}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"bridge.py: {args.mavlink} cannot be opened: {error}", file=sys.stderr)
        return 1
    with OdometrySubscriber(args.service_root, args.service_prefix, "visod_bridge") as odometry:
        forward(odometry, sink, args.count)
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit(0)
