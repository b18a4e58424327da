"""Camera heading, height and place as a request states them, and warnings where the answer contradicts them."""

from __future__ import annotations

import numpy as np

from lalaloc_core.conventions import heading_to_degrees
from lalaloc_core.errors import InvalidHintError, InvalidPoseError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.query import (
    DEFAULT_STD_M,
    CameraHeight,
    HintName,
    Hints,
    KnownHeading,
    Near,
    rooms_named,
    stated_pose,
)
from lalaloc_core.localise.search.pipeline import Localisation
from lalaloc_core.photograph import Photograph
from service.grids import check_height_m
from service.schemas import LocaliseForm, PhotographForm, SequenceForm, SessionDocument, StatedHeading
from service.schemas.query_fields import CameraFields, EarthPoint, HintFields, PlanPoint
from service.storage.records import PlanRecord


def known_heading(
    form: LocaliseForm | StatedHeading | PhotographForm,
    north: float | None,
    view: Photograph,
    compass_tolerance_deg: float,
) -> KnownHeading:
    """Return the heading in the request, else the photograph's compass heading if `north` is known, else none.

    Args:
        form: fields of the request.
        north: azimuth of true north (radians) in the plan; None where unknown.
        view: the decoded photograph with its metadata.
        compass_tolerance_deg: tolerance (degrees) of the compass heading.
    """
    return stated_pose.known_heading(
        north, form.heading_deg, form.heading_tolerance_deg, view.compass_heading, compass_tolerance_deg
    )


def stated_height(form: CameraFields, record: PlanRecord) -> CameraHeight:
    """Return the camera height in the request, else the plan's, else an unknown one.

    Raises:
        InvalidPoseError: the requested height is impossible in the plan.
    """
    if form.camera_height_m is not None:
        check_height_m(record, form.camera_height_m)
    return stated_pose.stated_height(record.plan, form.camera_height_m, form.camera_height_std_m)


def stated_heights(form: SequenceForm, record: PlanRecord, photographs: int) -> list[CameraHeight]:
    """Return the camera height of each photograph of a sequence, all with the same relative error.

    Raises:
        InvalidPoseError: a requested height is impossible in the plan, or the common height is needed and unknown.
    """
    for height_m in form.camera_heights_m or []:
        if height_m is not None:
            check_height_m(record, height_m)
    return heights_of(form, stated_height(form, record), photographs)


def heights_of(form: SequenceForm, common: CameraHeight, photographs: int) -> list[CameraHeight]:
    """Return the camera height of each photograph of a sequence, `common` where the request states none.

    Raises:
        InvalidPoseError: the common height is needed and unknown.
    """
    if form.camera_heights_m is None:
        return photographs * [common]
    if common.is_unknown:
        known_m = [height_m for height_m in form.camera_heights_m if height_m is not None]
        if len(known_m) < photographs:
            raise InvalidPoseError(
                "camera_heights_m has null, and no camera height of the plan is known: give all heights, or "
                "camera_height_m"
            )
        std_m = DEFAULT_STD_M if form.camera_height_std_m is None else form.camera_height_std_m
        common = CameraHeight(known_m[0], std_m)
    return [common if height_m is None else common.at(height_m) for height_m in form.camera_heights_m]


def stated_hints(form: HintFields | SessionDocument, plan: FloorPlan) -> Hints:
    """Return the hints of a request, before `Hints.check`.

    Raises:
        InvalidHintError: unknown rooms, or a place on Earth for a plan without an anchor.
    """
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


def heading_warnings(found: Localisation, known: KnownHeading) -> list[str]:
    """Return a warning if the known heading was not followed."""
    if not found.heading_contradicted:
        return []
    assert known.heading is not None
    origin = "heading_deg" if known.source == "given" else "the panorama's compass heading"
    degrees = heading_to_degrees(known.heading)
    return [f"{origin} is {degrees:.4g}, which the panorama contradicts: the heading was searched for instead"]


def hint_warnings(hints: Hints, found: Localisation, plan: FloorPlan) -> list[str]:
    """Return a warning for every hint that the panorama contradicts, followed or not."""
    return [_hint_warning(name, hints, found, plan) for name in found.hints_missed]


def _hint_warning(name: HintName, hints: Hints, found: Localisation, plan: FloorPlan) -> str:
    if name == "near":
        return contradiction(*near_missed(hints, found), hints.strict)
    assert hints.rooms is not None
    stated = f"rooms is {', '.join(repr(plan.rooms[index].id) for index in sorted(hints.rooms))}"
    room = plan.rooms[found.candidates[0].room_index]
    return contradiction(stated, f"the answer lies in room '{room.id}'", hints.strict)


def near_missed(hints: Hints, found: Localisation) -> tuple[str, str]:
    """Return the `near` hint and the answer's distance from it, as texts for `contradiction`."""
    assert hints.near is not None
    answer = found.candidates[0]
    (distance_m,) = hints.near.distance_m(answer.position_m[None], np.array([answer.room_index]))
    return f"near is within {hints.near.radius_m:g} m of {hints.near}", f"the answer is {distance_m:.1f} m from there"


def contradiction(stated: str, instead: str, strict: bool) -> str:
    """Return the warning that the panorama contradicts a statement, which only a strict hint overrides."""
    followed = "the answer follows it because strict is set" if strict else instead
    return f"{stated}, which the panorama contradicts: {followed}"
