"""What is known of a panorama's heading before anything is compared, and from where."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from lalaloc_core.conventions import TWO_PI, heading_from_degrees
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.panorama.images import Panorama
from service.schemas import LocaliseForm

HeadingSource = Literal["given", "panorama", "searched"]


@dataclass(frozen=True)
class KnownHeading:
    """A heading in radians, None when all have to be searched, and how far off it may be."""

    heading: float | None
    tolerance: float
    source: HeadingSource


def known_heading(
    form: LocaliseForm, plan: FloorPlan, panorama: Panorama, compass_tolerance_deg: float
) -> KnownHeading:
    """What the request says, else what the panorama says where the plan knows north, else nothing."""
    if form.heading_deg is not None:
        return KnownHeading(heading_from_degrees(form.heading_deg), math.radians(form.heading_tolerance_deg), "given")
    if plan.north is not None and panorama.compass_heading is not None:
        heading = (panorama.compass_heading + plan.north) % TWO_PI
        return KnownHeading(heading, math.radians(compass_tolerance_deg), "panorama")
    return KnownHeading(None, 0.0, "searched")
