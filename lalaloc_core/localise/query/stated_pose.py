"""Heading and height of a photograph's camera as the caller, the metadata or the plan state them.

A picture shows the layout in units of the camera's height. An error of the stated height scales all distances in the
picture: it is one offset δ of log distances, with true height = stated height · exp δ. The search solves for δ and the
pose.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Float

from lalaloc_core.conventions import MIN_CAMERA_HEIGHT_M, TWO_PI, heading_from_degrees
from lalaloc_core.errors import InvalidPoseError
from lalaloc_core.floorplan import FloorPlan

HeadingSource = Literal["given", "photograph", "searched"]
# Largest error (degrees) of the compass heading in a photograph's metadata.
COMPASS_TOLERANCE_DEG = 20.0
# Range of unknown camera heights (m) over the floor, all equally likely.
UNKNOWN_RANGE_M = (0.8, 2.2)
DEFAULT_STD_M = 0.1
# Largest distance between the offsets that retrieval tries; half of it is small beside the error of a grid pose.
_SPACING = 0.1
# Range of these offsets, in standard deviations; refinement can exceed it.
_REACH_STDS = 1.5


@dataclass(frozen=True)
class CameraHeight:
    """A stated camera height (m), and the standard deviation (m) of its error.

    A deviation of 0 means that the height is exact, infinity that it is unknown: the height is then anywhere in
    `UNKNOWN_RANGE_M`, and predictions are made for `height_m`.
    """

    height_m: float
    std_m: float = DEFAULT_STD_M

    def __post_init__(self) -> None:
        if not self.height_m > 0.0 or not math.isfinite(self.height_m):
            raise InvalidPoseError(f"the camera height is {self.height_m:g} m; it must be positive and finite")
        if not self.std_m >= 0.0:
            raise InvalidPoseError(f"the camera height's deviation is {self.std_m:g} m; it must not be negative")

    def at(self, height_m: float) -> CameraHeight:
        """Return another stated height (m) with the same relative error; not for an unknown height."""
        return CameraHeight(height_m, self.std_m * height_m / self.height_m)

    @property
    def is_exact(self) -> bool:
        """True if the height is exact."""
        return self.std_m == 0.0

    @property
    def is_unknown(self) -> bool:
        """True if the height is unknown."""
        return math.isinf(self.std_m)

    @property
    def log_std(self) -> float:
        """Standard deviation of δ; infinite if the height is unknown."""
        # Rounded, so that heights with the same relative error have the same offsets.
        return round(self.std_m / self.height_m, 12)

    @cached_property
    def bounds(self) -> tuple[float, float]:
        """Smallest and largest possible δ."""
        if self.is_unknown:
            low, high = UNKNOWN_RANGE_M
            return math.log(low / self.height_m), math.log(high / self.height_m)
        return -4.0 * self.log_std, 4.0 * self.log_std

    @cached_property
    def offsets(self) -> Float[np.ndarray, "j"]:
        """The δ that retrieval tries."""
        if self.is_unknown:
            low, high = self.bounds
            return np.linspace(low, high, math.ceil((high - low) / _SPACING) + 1)
        reach = _REACH_STDS * self.log_std
        each_side = math.ceil(reach / _SPACING)
        return np.linspace(-reach, reach, 2 * each_side + 1) if each_side else np.zeros(1)

    def penalty(self, offset: Float[np.ndarray, "*j"]) -> Float[np.ndarray, "*j"]:
        """Return the negative log prior of δ, 0 at best."""
        if self.is_unknown or self.is_exact:
            return np.zeros_like(offset)
        return 0.5 * np.square(offset / self.log_std)


@dataclass(frozen=True)
class KnownHeading:
    """Known heading: radians, or None if all are searched; its largest error (radians); and its source."""

    heading: float | None
    tolerance: float
    source: HeadingSource


UNKNOWN_HEADING = KnownHeading(None, 0.0, "searched")


def known_heading(
    north: float | None,
    heading_deg: float | None,
    tolerance_deg: float,
    compass_heading: float | None,
    compass_tolerance_deg: float = COMPASS_TOLERANCE_DEG,
) -> KnownHeading:
    """Return the given heading, else the photograph's if north is known, else none.

    `heading_deg` is given with the largest error `tolerance_deg`. `compass_heading` is in the photograph's metadata,
    clockwise from true north (radians); `north` is the azimuth of true north in the plan (radians).
    """
    if heading_deg is not None:
        return KnownHeading(heading_from_degrees(heading_deg), math.radians(tolerance_deg), "given")
    if north is not None and compass_heading is not None:
        heading = (compass_heading + north) % TWO_PI
        return KnownHeading(heading, math.radians(compass_tolerance_deg), "photograph")
    return UNKNOWN_HEADING


def check_height_m(plan: FloorPlan, height_m: float) -> None:
    """Check that a camera can have a height (m) in a plan.

    Raises:
        InvalidPoseError: the height is not below the lowest ceiling, or too low for any camera.
    """
    lowest_m = float(plan.ceiling_heights_m.min())
    if height_m != plan.camera_height_m and not MIN_CAMERA_HEIGHT_M <= height_m < lowest_m:
        raise InvalidPoseError(
            f"camera_height_m is {height_m:g}; it must be at least {MIN_CAMERA_HEIGHT_M:g} and below the plan's lowest "
            f"ceiling ({lowest_m:g} m)"
        )


def stated_height(plan: FloorPlan, height_m: float | None, std_m: float | None = None) -> CameraHeight:
    """Return the given camera height, else the plan's, else an unknown one."""
    if height_m is not None:
        return CameraHeight(height_m, DEFAULT_STD_M if std_m is None else std_m)
    usual = DEFAULT_STD_M if plan.states_camera_height else math.inf
    stated = (value for value in (std_m, plan.camera_height_std_m, usual) if value is not None)
    return CameraHeight(plan.camera_height_m, next(stated))
