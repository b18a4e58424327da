"""Poses and transforms on the floor, and what a robot makes of an answer: its base in the map, and `map -> odom`.

Everything is in the frames of REP 105 and REP 103: metres, x forward, y to the left, angles in radians
counter-clockwise. The map is the plan frame. No ROS is needed; `examples/robot/localise_node.py` passes the values on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

from lalaloc_client.frames import yaw_of
from lalaloc_client.model import Position
from lalaloc_client.tracking import Covariance3, Motion

Quaternion = tuple[float, float, float, float]
# A base that is tilted further than this does not stand on the floor (radians).
_MAX_TILT = math.radians(30.0)


class Placed(Protocol):
    """Pose of an answer: of a photograph, of a sequence or of a session."""

    @property
    def position(self) -> Position:
        """Place of the camera."""
        ...

    @property
    def heading_deg(self) -> float:
        """Azimuth of the photograph's centre."""
        ...


@dataclass(frozen=True)
class FloorTransform:
    """Pose on the floor, which is also the transform from its own frame to the one it is stated in.

    Attributes:
        yaw: direction of its x axis (radians, counter-clockwise from x).
    """

    x_m: float
    y_m: float
    yaw: float

    def __matmul__(self, other: FloorTransform) -> FloorTransform:
        """Return the composition: `a_from_b @ b_from_c` is `a_from_c`."""
        x, y = self.point(other.x_m, other.y_m)
        return FloorTransform(x, y, math.remainder(self.yaw + other.yaw, 2.0 * math.pi))

    def point(self, x_m: float, y_m: float) -> tuple[float, float]:
        """Return a point of this pose's frame in the frame that the pose is stated in."""
        sine, cosine = math.sin(self.yaw), math.cos(self.yaw)
        return self.x_m + cosine * x_m - sine * y_m, self.y_m + sine * x_m + cosine * y_m

    def inverse(self) -> FloorTransform:
        """Return the transform the other way: that of `a_from_b` is `b_from_a`."""
        sine, cosine = math.sin(self.yaw), math.cos(self.yaw)
        x, y = -cosine * self.x_m - sine * self.y_m, sine * self.x_m - cosine * self.y_m
        return FloorTransform(x, y, -self.yaw)

    @property
    def orientation(self) -> Quaternion:
        """Quaternion x, y, z, w, as in `geometry_msgs/Quaternion`."""
        return 0.0, 0.0, math.sin(0.5 * self.yaw), math.cos(0.5 * self.yaw)


def of_answer(pose: Placed) -> FloorTransform:
    """Return the pose of an answer: `map_from_camera`, with x along the centre of the photograph."""
    return FloorTransform(pose.position.x_m, pose.position.y_m, yaw_of(pose.heading_deg))


def of_ros(x_m: float, y_m: float, orientation: Quaternion) -> FloorTransform:
    """Return the pose of a robot on the floor from its position and quaternion (x, y, z, w)."""
    x, y, z, w = orientation
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    if not 0.9 < norm < 1.1:
        raise ValueError(f"the quaternion has the length {norm:.3g}; that of a rotation is 1")
    up = 1.0 - 2.0 * (x * x + y * y) / norm**2
    if up < math.cos(_MAX_TILT):
        raise ValueError(f"the pose is tilted by {math.degrees(math.acos(max(up, -1.0))):.0f}°; the limit is 30°")
    yaw = math.atan2(2.0 * (w * z + x * y), norm**2 - 2.0 * (y * y + z * z))
    return FloorTransform(x_m, y_m, yaw)


def map_from_base(pose: Placed, base_from_camera: FloorTransform) -> FloorTransform:
    """Return the pose of a robot's base in the map from the answer to a photograph of its camera.

    `base_from_camera` is where the camera is mounted on the base, and where it looks.
    """
    return of_answer(pose) @ base_from_camera.inverse()


def map_from_odom(pose: Placed, base_from_camera: FloorTransform, odom_from_base: FloorTransform) -> FloorTransform:
    """Return the transform `map -> odom` of REP 105, which corrects the drift of odometry.

    `odom_from_base` is the pose of the base by odometry at the time of the photograph, not at that of the answer.
    """
    return map_from_base(pose, base_from_camera) @ odom_from_base.inverse()


def base_covariance(covariance: Covariance3, pose: Placed, base_from_camera: FloorTransform) -> Covariance3:
    """Return the covariance of the base (x_m, y_m in m, heading in degrees) from that of the camera in an answer.

    An error of the heading moves a base that is away from the camera to the side.
    """
    base, camera = map_from_base(pose, base_from_camera), of_answer(pose)
    # A heading that grows by a degree turns the base clockwise about the camera.
    degree = math.radians(1.0)
    dx, dy = degree * (base.y_m - camera.y_m), -degree * (base.x_m - camera.x_m)
    jacobian = ((1.0, 0.0, dx), (0.0, 1.0, dy), (0.0, 0.0, 1.0))
    half = [[sum(a * covariance[k][j] for k, a in enumerate(row)) for j in range(3)] for row in jacobian]
    rows = [tuple(sum(value * jacobian[j][k] for k, value in enumerate(row)) for j in range(3)) for row in half]
    return (rows[0], rows[1], rows[2])  # pyright: ignore[reportReturnType]


def motion_between(before: FloorTransform, now: FloorTransform, base_from_camera: FloorTransform) -> Motion:
    """Return the motion of the camera from one photograph to the next, from the poses of the base by odometry."""
    moved = (before @ base_from_camera).inverse() @ (now @ base_from_camera)
    return Motion(forward_m=moved.x_m, right_m=-moved.y_m, turn_deg=-math.degrees(moved.yaw))
