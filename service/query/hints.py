"""What a request says of where the camera stood, and what an answer says of it."""

from __future__ import annotations

from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.hints import HintName, Hints, Near, rooms_named
from lalaloc_core.localise.pipeline import Localisation
from service.schemas.hint_fields import HintFields


def stated_hints(form: HintFields, plan: FloorPlan) -> Hints:
    """The hints of a request; `Hints.check` is not yet done.

    Raises:
        InvalidHintError: rooms that the plan has not.
    """
    near = None
    if form.near is not None and form.radius_m is not None:
        near = Near(form.near.x_m, form.near.y_m, form.radius_m)
    rooms = None if form.rooms is None else rooms_named(plan, form.rooms)
    return Hints(near=near, rooms=rooms, strict=form.strict)


def hint_warnings(hints: Hints, found: Localisation, plan: FloorPlan) -> list[str]:
    """Says which hints were not followed, or were although the panorama contradicts them."""
    return [_contradiction(name, hints, found, plan) for name in found.hints_missed]


def _contradiction(name: HintName, hints: Hints, found: Localisation, plan: FloorPlan) -> str:
    answer = found.candidates[0]
    if name == "near":
        assert hints.near is not None
        said = f"near is within {hints.near.radius_m:g} m of ({hints.near.x_m:g}, {hints.near.y_m:g})"
        away_m = float(hints.near.distance_m(answer.position_m[None])[0])
        not_followed = f"the answer is {away_m:.1f} m from there"
    else:
        assert hints.rooms is not None
        said = f"rooms is {', '.join(repr(plan.rooms[index].id) for index in sorted(hints.rooms))}"
        not_followed = f"the answer lies in room '{plan.rooms[answer.room_index].id}'"
    if hints.strict:
        return f"{said}, which the panorama contradicts: it was followed, being strict"
    return f"{said}, which the panorama contradicts: {not_followed}"
