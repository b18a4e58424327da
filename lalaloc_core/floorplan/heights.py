"""What a plan says of its cameras, and of north."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from lalaloc_core.conventions import heading_from_degrees
from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan.limits import PlanLimits
from lalaloc_core.floorplan.rooms import Room
from lalaloc_core.floorplan.values import read_number, read_number_between

DEFAULT_CAMERA_HEIGHT_M = 1.5
MAX_CAMERA_HEIGHT_STD_M = 2.0


def read_camera_height(value: Any, rooms: Sequence[Room], limits: PlanLimits) -> float:
    """The camera's height, below every ceiling (m)."""
    lowest_ceiling_m = min(room.ceiling_height_m for room in rooms)
    height_m = read_number(DEFAULT_CAMERA_HEIGHT_M if value is None else value, "camera_height_m", above=0.0)
    if height_m < limits.min_camera_height_m:
        raise InvalidFloorPlanError(
            f"camera_height_m is {height_m:g}, it must be at least {limits.min_camera_height_m:g} m"
        )
    if height_m >= lowest_ceiling_m:
        raise InvalidFloorPlanError(
            f"camera_height_m is {height_m:g}, it must lie below the lowest ceiling ({lowest_ceiling_m:g} m)"
        )
    return height_m


def read_camera_height_std(value: Any) -> float | None:
    """The standard deviation of the camera's height (m), None when it is not said."""
    if value is None:
        return None
    return read_number_between(value, "camera_height_std_m", 0.0, MAX_CAMERA_HEIGHT_STD_M, " m")


def read_north(degrees: Any) -> float | None:
    """The azimuth of true north (radians), None when it is not said."""
    if degrees is None:
        return None
    return heading_from_degrees(read_number_between(degrees, "north_deg", -360.0, 360.0, ""))
