"""What is known of the height of a query's camera before anything is compared."""

from __future__ import annotations

import math

from lalaloc_core.localise.camera_height import DEFAULT_STD_M, CameraHeight
from service.grids import check_height_m
from service.schemas import LocaliseForm
from service.storage.records import PlanRecord


def stated_height(form: LocaliseForm, record: PlanRecord) -> CameraHeight:
    """What the request says, else what the plan says, else nothing: then any height is possible.

    Raises:
        InvalidPoseError: a height that no camera in the plan can have.
    """
    plan = record.plan
    if form.camera_height_m is not None:
        check_height_m(record, form.camera_height_m)
        return CameraHeight(form.camera_height_m, _first(form.camera_height_std_m, DEFAULT_STD_M))
    usual = DEFAULT_STD_M if plan.states_camera_height else math.inf
    return CameraHeight(plan.camera_height_m, _first(form.camera_height_std_m, plan.camera_height_std_m, usual))


def _first(*values: float | None) -> float:
    """The first of some values that is one."""
    return next(value for value in values if value is not None)
