"""What is known of a photograph's camera before anything is compared: its heading and its height, and from where."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from lalaloc_core.conventions import TWO_PI, heading_from_degrees
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.camera_height import DEFAULT_STD_M, CameraHeight

HeadingSource = Literal["given", "panorama", "searched"]
# How far off (degrees) the compass heading in a panorama's metadata may be.
COMPASS_TOLERANCE_DEG = 20.0


@dataclass(frozen=True)
class KnownHeading:
    """A heading in radians, None when all have to be searched, and how far off it may be."""

    heading: float | None
    tolerance: float
    source: HeadingSource


def known_heading(
    north: float | None,
    heading_deg: float | None,
    tolerance_deg: float,
    compass_heading: float | None,
    compass_tolerance_deg: float = COMPASS_TOLERANCE_DEG,
) -> KnownHeading:
    """What is said, else what the panorama says where north is known, else nothing.

    Args:
        north: azimuth of true north (radians) in the plan.
        compass_heading: clockwise from true north (radians), as the panorama's metadata have it.
    """
    if heading_deg is not None:
        return KnownHeading(heading_from_degrees(heading_deg), math.radians(tolerance_deg), "given")
    if north is not None and compass_heading is not None:
        heading = (compass_heading + north) % TWO_PI
        return KnownHeading(heading, math.radians(compass_tolerance_deg), "panorama")
    return KnownHeading(None, 0.0, "searched")


def stated_height(plan: FloorPlan, height_m: float | None, std_m: float | None = None) -> CameraHeight:
    """What is said, else what the plan says, else nothing: then any height is possible.

    Raises:
        InvalidPoseError: not a height.
    """
    if height_m is not None:
        return CameraHeight(height_m, DEFAULT_STD_M if std_m is None else std_m)
    usual = DEFAULT_STD_M if plan.states_camera_height else math.inf
    said = (value for value in (std_m, plan.camera_height_std_m, usual) if value is not None)
    return CameraHeight(plan.camera_height_m, next(said))
