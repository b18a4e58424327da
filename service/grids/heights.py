"""Which camera heights there are grids for."""

from __future__ import annotations

from lalaloc_core.conventions import MIN_CAMERA_HEIGHT_M
from lalaloc_core.errors import InvalidPoseError
from service.storage.records import PlanRecord

# Another camera height is rounded to this, so that a plan needs few grids.
HEIGHT_STEP_M = 0.02


def query_height_m(record: PlanRecord, asked_m: float | None) -> float:
    """The camera height that a query is compared at: the plan's, or the one asked for, rounded to 2 cm.

    Raises:
        InvalidPoseError: not below the lowest ceiling, or too low for any camera.
    """
    own = record.plan.camera_height_m
    if asked_m is None or abs(asked_m - own) < HEIGHT_STEP_M / 2.0:
        return own
    lowest = float(record.plan.ceiling_heights_m.min())
    if not MIN_CAMERA_HEIGHT_M <= asked_m < lowest:
        raise InvalidPoseError(
            f"camera_height_m is {asked_m:g}, it must be at least {MIN_CAMERA_HEIGHT_M:g} and below the plan's lowest "
            f"ceiling ({lowest:g} m)"
        )
    steps = round(asked_m / HEIGHT_STEP_M)
    if steps * HEIGHT_STEP_M >= lowest:
        steps -= 1
    return steps * HEIGHT_STEP_M
