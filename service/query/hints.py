"""What a request says of where the camera stood, and what an answer says of it."""

from __future__ import annotations

import numpy as np

from lalaloc_core.errors import InvalidHintError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.hints import HintName, Hints, Near, rooms_named
from lalaloc_core.localise.pipeline import Localisation
from service.schemas.hint_fields import EarthPoint, HintFields, PlanPoint


def stated_hints(form: HintFields, plan: FloorPlan) -> Hints:
    """The hints of a request; `Hints.check` is not yet done.

    Raises:
        InvalidHintError: rooms that the plan has not, or a place on Earth where the plan has no anchor.
    """
    near = None
    if form.near is not None and form.radius_m is not None:
        near = _in_plan(form.near, form.radius_m, plan)
    rooms = None if form.rooms is None else rooms_named(plan, form.rooms)
    return Hints(near=near, rooms=rooms, strict=form.strict)


def _in_plan(point: PlanPoint | EarthPoint, radius_m: float, plan: FloorPlan) -> Near:
    if isinstance(point, PlanPoint):
        return Near(point.x_m, point.y_m, radius_m)
    if plan.anchor is None:
        raise InvalidHintError(
            "near", f"the plan has no anchor, so it is not known where {point} is in it: give x_m and y_m"
        )
    ((x_m, y_m),) = plan.anchor.to_plan(np.array([[point.longitude, point.latitude]]))
    return Near(float(x_m), float(y_m), radius_m, str(point))


def hint_warnings(hints: Hints, found: Localisation, plan: FloorPlan) -> list[str]:
    """Says which hints were not followed, or were although the panorama contradicts them."""
    return [_contradiction(name, hints, found, plan) for name in found.hints_missed]


def _contradiction(name: HintName, hints: Hints, found: Localisation, plan: FloorPlan) -> str:
    answer = found.candidates[0]
    if name == "near":
        return contradiction(*near_missed(hints, found), hints.strict)
    assert hints.rooms is not None
    said = f"rooms is {', '.join(repr(plan.rooms[index].id) for index in sorted(hints.rooms))}"
    return contradiction(said, f"the answer lies in room '{plan.rooms[answer.room_index].id}'", hints.strict)


def near_missed(hints: Hints, found: Localisation) -> tuple[str, str]:
    """What was said of the point that the camera is near, and where the answer is instead."""
    assert hints.near is not None
    answer = found.candidates[0]
    (away_m,) = hints.near.distance_m(answer.position_m[None], np.array([answer.room_index]))
    return f"near is within {hints.near.radius_m:g} m of {hints.near}", f"the answer is {away_m:.1f} m from there"


def contradiction(said: str, instead: str, strict: bool) -> str:
    """Says that the panorama contradicts a hint, and which of the two was followed."""
    followed = "it was followed, being strict" if strict else instead
    return f"{said}, which the panorama contradicts: {followed}"
