"""Frames of robots and AR devices.

The plan frame is right-handed with z up, as the map frame of REP 105, so positions are the same in both. Headings are
azimuths, clockwise from +y; a yaw (REP 103) is counter-clockwise from +x: `yaw = 90° - heading`.

Matrices are 4 x 4, by rows, and map points of the camera to the world:

* plan: the camera looks along its +y, x is to its right, z up; the world is the plan frame.
* `opengl` (ARKit, ARCore, OpenXR): the camera looks along its -z, x is to its right, y up; the world is the plan with
  y up: (x, y, z) of the plan is (x, z, -y).
* `unity`: left-handed, the camera looks along its +z, x to its right, y up; (x, y, z) of the plan is (x, z, y).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from lalaloc_client.tracking import Covariance3, TrackedPose

Matrix = tuple[tuple[float, ...], ...]
Convention = Literal["opengl", "unity"]
# Variance of what a level camera on a flat floor does not measure: z, roll and pitch.
_UNKNOWN = 1e-6
_MIN_APART_M = 0.5
# Places of photographs are right within decimetres: largest ratio of distances, and root mean square error (m, and as a
# share of the places' extent).
_MAX_SCALE, _MAX_MISFIT_M, _MAX_MISFIT = 1.3, 0.5, 0.25


def yaw_of(heading_deg: float) -> float:
    """Return the yaw (radians, counter-clockwise from +x, in (-π, π]) of a heading."""
    yaw = math.remainder(math.radians(90.0 - heading_deg), 2.0 * math.pi)
    return math.pi if yaw == -math.pi else yaw


def heading_of(yaw: float) -> float:
    """Return the heading (degrees in [0, 360)) of a yaw (radians)."""
    return (90.0 - math.degrees(yaw)) % 360.0


@dataclass(frozen=True)
class RosPose:
    """Pose as `geometry_msgs/PoseWithCovariance` has it, in the map frame.

    Attributes:
        position: x, y and z (m).
        orientation: quaternion x, y, z, w.
        covariance: 36 values, row by row, of x, y, z and rotations about X, Y and Z (radians).
    """

    position: tuple[float, float, float]
    orientation: tuple[float, float, float, float]
    covariance: tuple[float, ...]


def ros_pose(pose: TrackedPose, *, z_m: float | None = None) -> RosPose:
    """Return a pose in the map frame of REP 105, with the frame's x forward (REP 103).

    `z_m` is the height of the frame over the floor. Default: that of the camera.
    """
    yaw = yaw_of(pose.heading_deg)
    z_m = pose.camera_height_m if z_m is None else z_m
    orientation = (0.0, 0.0, math.sin(0.5 * yaw), math.cos(0.5 * yaw))
    return RosPose((pose.position.x_m, pose.position.y_m, z_m), orientation, ros_covariance(pose.covariance))


def ros_covariance(covariance: Covariance3) -> tuple[float, ...]:
    """Return the 6 x 6 covariance, row by row, of a covariance of x_m, y_m and heading_deg."""
    # The yaw turns the other way.
    scale = (1.0, 1.0, -math.radians(1.0))
    place = (0, 1, 5)
    values = [[0.0] * 6 for _ in range(6)]
    for index in range(2, 5):
        values[index][index] = _UNKNOWN
    for i, row in enumerate(covariance):
        for j, value in enumerate(row):
            values[place[i]][place[j]] = scale[i] * scale[j] * value
    return tuple(value for row in values for value in row)


def camera_matrix(pose: TrackedPose, convention: Convention) -> Matrix:
    """Return the matrix that maps points of a level camera to the plan, both in a convention of AR devices."""
    heading = math.radians(pose.heading_deg)
    rotation, place = complex(math.cos(heading), -math.sin(heading)), complex(pose.position.x_m, pose.position.y_m)
    return floor_matrix(rotation, place, pose.camera_height_m, convention)


def floor_matrix(rotation: complex, shift: complex, up: float, convention: Convention) -> Matrix:
    """Return a turn and shift on the floor (x + iy), and a shift upwards, as a 4 x 4 matrix in a convention."""
    side, cosine, sine = depth_sign(convention), rotation.real, rotation.imag
    return (
        (cosine, 0.0, -side * sine, shift.real),
        (0.0, 1.0, 0.0, up),
        (side * sine, 0.0, cosine, side * shift.imag),
        (0.0, 0.0, 0.0, 1.0),
    )


def depth_sign(convention: Convention) -> float:
    """Return the sign of the plan's y on the device's z axis."""
    if convention not in ("opengl", "unity"):
        raise ValueError(f"convention is {convention!r}; it must be 'opengl' or 'unity'")
    return 1.0 if convention == "unity" else -1.0


def world_from_plan(
    plan_m: Sequence[tuple[float, float]], world_m: Sequence[tuple[float, float]], *, mirrored: bool = False
) -> Matrix:
    """Return the 3 x 3 matrix that maps points (x, y, 1) of the plan to the floor of a device's own world frame.

    Turn and translation are those that fit best; scale is not changed, because both frames are in metres. With it, an
    app that tracks itself stays localised between photographs.

    Args:
        plan_m: at least two places of the camera in the plan, such as those of two photographs.
        world_m: the same places in the device's frame: two axes of its floor, such as (x, -z) of ARKit and ARCore.
        mirrored: whether the axes of the device's floor are left-handed seen from above, as (x, z) of ARKit are.
    """
    if len(plan_m) != len(world_m) or len(plan_m) < 2:
        raise ValueError(f"{len(plan_m)} places in the plan and {len(world_m)} in the world; give at least two of both")
    sign, count = (-1.0 if mirrored else 1.0), len(plan_m)
    own = [complex(x, y) for x, y in plan_m]
    other = [complex(x, sign * y) for x, y in world_m]
    centre, target = sum(own) / count, sum(other) / count
    spread = max(abs(point - centre) for point in own)
    if not spread >= 0.5 * _MIN_APART_M:
        raise ValueError(f"the places are {2.0 * spread:.2f} m apart; the minimum is {_MIN_APART_M:g} m")
    turn = sum((b - target) * (a - centre).conjugate() for a, b in zip(own, other, strict=True))
    if not abs(turn) > 0.0:
        raise ValueError("the places in the world are all the same; give places that are apart")
    _check_fit([a - centre for a in own], [b - target for b in other])
    turn /= abs(turn)
    shift = target - turn * centre
    return (
        (turn.real, -turn.imag, shift.real),
        (sign * turn.imag, sign * turn.real, sign * shift.imag),
        (0.0, 0.0, 1.0),
    )


def misfit_m(
    matrix: Matrix, plan_m: Sequence[tuple[float, float]], world_m: Sequence[tuple[float, float]]
) -> list[float]:
    """Return the distance of each place of `world_m` from that of `plan_m` by the matrix of `world_from_plan`."""
    return [
        math.hypot(*(row[0] * x + row[1] * y + row[2] - value for row, value in zip(matrix, place, strict=False)))
        for (x, y), place in zip(plan_m, world_m, strict=True)
    ]


def _check_fit(own: Sequence[complex], other: Sequence[complex]) -> None:
    """Refuse places, relative to their means, that no turn makes fit."""
    size_m, other_m = (math.sqrt(sum(abs(point) ** 2 for point in points)) for points in (own, other))
    scale = other_m / size_m
    if not 1.0 / _MAX_SCALE <= scale <= _MAX_SCALE:
        raise ValueError(
            f"distances in the world are {scale:.3g} times those in the plan; at most {_MAX_SCALE:g} times fit: give "
            "both in metres, and the same places in the same order"
        )

    def rest_m(points: Sequence[complex]) -> float:
        turned = abs(sum(b * a.conjugate() for a, b in zip(own, points, strict=True)))
        return math.sqrt(max(size_m**2 + other_m**2 - 2.0 * turned, 0.0) / len(own))

    as_given, as_mirrored = rest_m(other), rest_m([point.conjugate() for point in other])
    if as_given > max(_MAX_MISFIT_M, 3.0 * as_mirrored):
        raise ValueError(
            f"the places fit with {as_given:.2f} m, and with {as_mirrored:.2f} m if one axis of the world is turned "
            "over: give (x, -z) of ARKit and ARCore, or mirrored=True"
        )
    if as_given > max(_MAX_MISFIT_M, _MAX_MISFIT * size_m):
        raise ValueError(
            f"the places fit with {as_given:.2f} m; the limit is {max(_MAX_MISFIT_M, _MAX_MISFIT * size_m):.2f} m: "
            "check that both lists have the same places in the same order"
        )
