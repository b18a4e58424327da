"""Camera heading, height and place as a request states them, and warnings where the answer contradicts them."""

from __future__ import annotations

import numpy as np

from lalaloc_core.errors import InvalidHintError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise import query
from lalaloc_core.localise.query import CameraHeight, Hints, Near, rooms_named
from service.grids import check_height_m
from service.schemas import SessionDocument
from service.schemas.query_fields import EarthPoint, HeightFields, HintFields, PlanPoint
from service.storage.records import PlanRecord


def stated_height(form: HeightFields, record: PlanRecord) -> CameraHeight:
    """Return the camera height in the request, else the plan's, else an unknown one."""
    if form.camera_height_m is not None:
        check_height_m(record, form.camera_height_m)
    return query.stated_height(record.plan, form.camera_height_m, form.camera_height_std_m)


def stated_hints(form: HintFields | SessionDocument, plan: FloorPlan) -> Hints:
    """Return the hints of a request, before `Hints.check`."""
    near = None
    if form.near is not None and form.radius_m is not None:
        near = _near_in_plan(form.near, form.radius_m, plan)
    rooms = None if form.rooms is None else rooms_named(plan, form.rooms)
    return Hints(near=near, rooms=rooms, strict=isinstance(form, HintFields) and form.strict)


def _near_in_plan(point: PlanPoint | EarthPoint, radius_m: float, plan: FloorPlan) -> Near:
    if isinstance(point, PlanPoint):
        return Near(point.x_m, point.y_m, radius_m)
    if plan.anchor is None:
        raise InvalidHintError(
            "near", f"{point} cannot be placed, because the plan has no anchor: give x_m and y_m, or add an anchor"
        )
    ((x_m, y_m),) = plan.anchor.to_plan(np.array([[point.longitude, point.latitude]]))
    return Near(float(x_m), float(y_m), radius_m, str(point))
