"""What is known of a panorama's heading before anything is compared, and from where."""

from __future__ import annotations

from lalaloc_core.localise import stated_camera
from lalaloc_core.localise.stated_camera import KnownHeading
from lalaloc_core.panorama.images import Panorama
from service.schemas import LocaliseForm, StatedHeading


def known_heading(
    form: LocaliseForm | StatedHeading, north: float | None, panorama: Panorama, compass_tolerance_deg: float
) -> KnownHeading:
    """What the request says, else what the panorama says where north is known, else nothing.

    Args:
        north: azimuth of true north (radians) in the plan.
    """
    return stated_camera.known_heading(
        north, form.heading_deg, form.heading_tolerance_deg, panorama.compass_heading, compass_tolerance_deg
    )
