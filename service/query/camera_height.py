"""What is known of the height of a query's camera before anything is compared."""

from __future__ import annotations

from lalaloc_core.localise import stated_camera
from lalaloc_core.localise.camera_height import CameraHeight
from service.grids import check_height_m
from service.schemas.camera_fields import CameraFields
from service.storage.records import PlanRecord


def stated_height(form: CameraFields, record: PlanRecord) -> CameraHeight:
    """What the request says, else what the plan says, else nothing: then any height is possible.

    Raises:
        InvalidPoseError: a height that no camera in the plan can have.
    """
    if form.camera_height_m is not None:
        check_height_m(record, form.camera_height_m)
    return stated_camera.stated_height(record.plan, form.camera_height_m, form.camera_height_std_m)
