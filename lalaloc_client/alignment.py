"""The world of an AR device aligned with the plan, from the photographs of one spot.

A device that tracks itself knows where its camera was, in a world of its own: metres, y up, turned and shifted at will.
The answer to one photograph fixes turn and shift; those to the photographs of a turn fix them better, and tell how well
they fit. Afterwards the app draws what stands in the plan without asking again. `frames` has the conventions.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence
from dataclasses import dataclass

from lalaloc_client.frames import Convention, Matrix, depth_sign, floor_matrix
from lalaloc_client.planar import Placed, of_answer

# A camera that looks further up or down than this has no heading (share of its axis along the floor).
_LEAST_LEVEL = 0.5
# Headings and places of one spot that agree worse than this are of other photographs, or of a wrong answer.
_MAX_MISFIT_DEG, _MAX_MISFIT_M = 20.0, 1.0


@dataclass(frozen=True)
class Alignment:
    """Alignment of a device's world with the plan.

    Attributes:
        world_from_plan: 4 x 4 matrix, by rows, from the plan in the device's convention to the device's world.
        misfit_deg: largest difference between the device's and the plan's heading of a photograph; 0 for one.
        misfit_m: largest distance between the device's and the plan's place of a photograph; 0 for one.
    """

    world_from_plan: Matrix
    misfit_deg: float
    misfit_m: float


def align(
    poses: Sequence[Placed], cameras: Sequence[Matrix], convention: Convention, *, camera_height_m: float
) -> Alignment:
    """Return the alignment that photographs of one spot give.

    Args:
        poses: answers: that to one photograph, or the `poses` of a turn.
        cameras: 4 x 4 matrices, by rows, of the camera to the device's world when each photograph was taken, in the
            convention of the device (`frames`).
        convention: `opengl` for ARKit, ARCore and WebXR, `unity` for Unity.
        camera_height_m: height of the camera over the floor, of the answer.
    """
    if not poses or len(poses) != len(cameras):
        raise ValueError(f"{len(poses)} poses and {len(cameras)} cameras; give one camera for each pose")
    placed = [of_answer(pose) for pose in poses]
    seen = [_on_floor(camera, convention) for camera in cameras]
    turns = [yaw - pose.yaw for pose, (_, yaw) in zip(placed, seen, strict=True)]
    turn = cmath.phase(sum(cmath.exp(1j * angle) for angle in turns))
    rotation = cmath.exp(1j * turn)
    shifts = [place - rotation * complex(pose.x_m, pose.y_m) for pose, (place, _) in zip(placed, seen, strict=True)]
    shift = sum(shifts) / len(shifts)
    misfit_deg = max(abs(math.degrees(math.remainder(angle - turn, 2.0 * math.pi))) for angle in turns)
    misfit_m = max(abs(one - shift) for one in shifts)
    if misfit_deg > _MAX_MISFIT_DEG or misfit_m > _MAX_MISFIT_M:
        raise ValueError(
            f"the photographs fit with {misfit_deg:.0f}° and {misfit_m:.2f} m; the limits are {_MAX_MISFIT_DEG:g}° and "
            f"{_MAX_MISFIT_M:g} m: give poses and cameras of the same photographs, in the same order, or turn again"
        )
    up = sum(camera[1][3] for camera in cameras) / len(cameras) - camera_height_m
    return Alignment(floor_matrix(rotation, shift, up, convention), misfit_deg, misfit_m)


def plan_point(x_m: float, y_m: float, z_m: float, convention: Convention) -> tuple[float, float, float]:
    """Return a point of the plan (z over the floor) in a convention of AR devices, for `world_from_plan`."""
    return (x_m, z_m, y_m) if convention == "unity" else (x_m, z_m, -y_m)


def _on_floor(camera: Matrix, convention: Convention) -> tuple[complex, float]:
    """Return place (x + iy) and yaw of a camera on the floor of the device's world, seen from above."""
    if len(camera) != 4 or any(len(row) != 4 for row in camera):
        raise ValueError("a camera's matrix must have 4 rows of 4 numbers")
    side = depth_sign(convention)
    # The camera looks along its own z axis, in `opengl` along -z.
    forward = [side * row[2] for row in camera[:3]]
    length = math.hypot(*forward)
    if not 0.9 < length < 1.1:
        raise ValueError(f"the matrix stretches by {length:.3g}; that of a camera is 1: check its rows")
    ahead = complex(forward[0], side * forward[2])
    if abs(ahead) < _LEAST_LEVEL:
        raise ValueError("the camera looks up or down, so that it has no heading; hold it upright")
    return complex(camera[0][3], side * camera[2][3]), cmath.phase(ahead)
