"""Heading and height of a photograph's camera as the caller, the metadata or the plan state them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from lalaloc_core.conventions import TWO_PI, heading_from_degrees
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.query.camera_height import DEFAULT_STD_M, CameraHeight

HeadingSource = Literal["given", "panorama", "searched"]
# Largest error (degrees) of the compass heading in a photograph's metadata.
COMPASS_TOLERANCE_DEG = 20.0


@dataclass(frozen=True)
class KnownHeading:
    """Known heading: radians, or None if all are searched; its largest error (radians); and its source."""

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
    """Return the given heading, else the photograph's if north is known, else none.

    `heading_deg` is given with the largest error `tolerance_deg`. `compass_heading` is in the photograph's metadata,
    clockwise from true north (radians); `north` is the azimuth of true north in the plan (radians).
    """
    if heading_deg is not None:
        return KnownHeading(heading_from_degrees(heading_deg), math.radians(tolerance_deg), "given")
    if north is not None and compass_heading is not None:
        heading = (compass_heading + north) % TWO_PI
        return KnownHeading(heading, math.radians(compass_tolerance_deg), "panorama")
    return KnownHeading(None, 0.0, "searched")


def stated_height(plan: FloorPlan, height_m: float | None, std_m: float | None = None) -> CameraHeight:
    """Return the given camera height, else the plan's, else an unknown one.

    Raises:
        InvalidPoseError: the height is not positive and finite, or its deviation negative.
    """
    if height_m is not None:
        return CameraHeight(height_m, DEFAULT_STD_M if std_m is None else std_m)
    usual = DEFAULT_STD_M if plan.states_camera_height else math.inf
    stated = (value for value in (std_m, plan.camera_height_std_m, usual) if value is not None)
    return CameraHeight(plan.camera_height_m, next(stated))
