"""Camera heights: the possible ones of a plan, and those with a pose grid."""

from __future__ import annotations

from lalaloc_core.conventions import MIN_CAMERA_HEIGHT_M
from lalaloc_core.errors import InvalidPoseError
from service.storage.records import PlanRecord

# Other camera heights are rounded to multiples of this, so that a plan needs few grids.
HEIGHT_STEP_M = 0.02


def check_height_m(record: PlanRecord, height_m: float) -> None:
    """Check that a camera can have a height (m) in a plan.

    Raises:
        InvalidPoseError: the height is not below the lowest ceiling, or too low for any camera.
    """
    lowest = float(record.plan.ceiling_heights_m.min())
    if height_m != record.plan.camera_height_m and not MIN_CAMERA_HEIGHT_M <= height_m < lowest:
        raise InvalidPoseError(
            f"camera_height_m is {height_m:g}; it must be at least {MIN_CAMERA_HEIGHT_M:g} and below the plan's lowest "
            f"ceiling ({lowest:g} m)"
        )


def grid_height_m(record: PlanRecord, height_m: float, *, latents_alone: bool) -> float:
    """Return the camera height (m) of the grid that a query is compared with.

    Wall profiles do not depend on the height, so the plan's own grid serves all queries. Only models that compare
    latents alone have a grid per height, rounded to 2 cm.
    """
    own = record.plan.camera_height_m
    if not latents_alone or abs(height_m - own) < HEIGHT_STEP_M / 2.0:
        return own
    steps = round(height_m / HEIGHT_STEP_M)
    if steps * HEIGHT_STEP_M >= float(record.plan.ceiling_heights_m.min()):
        steps -= 1
    return steps * HEIGHT_STEP_M
