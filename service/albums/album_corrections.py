"""Corrections of pins between the API and the store, which has them as the core reads them."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.album.entry import Correction
from service.errors import InvalidRequestError
from service.schemas.albums import CorrectionDocument, PinAnswer
from service.schemas.query_fields import PlanPoint


def stored_correction(
    document: CorrectionDocument, plan_id: str | None, plan: FloorPlan | None, pin: PinAnswer | None
) -> str:
    """Return a correction as JSON of the core.

    Args:
        document: the correction.
        plan_id: plan of the room or position; None where it is unknown.
        plan: that plan.
        pin: the pin of the photograph; None before the first solution.
    """
    if document.elsewhere:
        return _text(Correction(kind="elsewhere"))
    if document.confirmed:
        return _text(_confirmed(pin))
    if plan_id is None or plan is None:
        raise _fault("floorplan_id", "is missing: the photograph has no pin in a plan of the venue yet")
    if document.room_id is not None:
        if all(room.id != document.room_id for room in plan.rooms):
            raise _fault("room_id", f"is '{document.room_id}'; the floor plan has no room of this id")
        return _text(Correction(kind="room", plan_id=plan_id, room_id=document.room_id))
    assert document.position is not None
    x_m, y_m = document.position.x_m, document.position.y_m
    correction = Correction(kind="position", plan_id=plan_id, x_m=x_m, y_m=y_m, heading_deg=document.heading_deg)
    if int(plan.room_index_at(np.array([[x_m, y_m]]))[0]) < 0:
        raise _fault("position", f"is ({x_m:g}, {y_m:g}), which lies in no room of the floor plan")
    return _text(correction)


def correction_document(stored: str) -> CorrectionDocument:
    """Return a stored correction as the API states it."""
    values: dict[str, Any] = json.loads(stored)
    kind, plan_id = values["kind"], values.get("plan_id")
    if kind == "room":
        return CorrectionDocument(room_id=values["room_id"], floorplan_id=plan_id)
    if kind == "position":
        position = PlanPoint(x_m=values["x_m"], y_m=values["y_m"])
        return CorrectionDocument(position=position, heading_deg=values.get("heading_deg"), floorplan_id=plan_id)
    return CorrectionDocument(elsewhere=True) if kind == "elsewhere" else CorrectionDocument(confirmed=True)


def _confirmed(pin: PinAnswer | None) -> Correction:
    """Return the place of a pin as a correction; that of a pin set aside is elsewhere."""
    if pin is None:
        raise _fault("confirmed", "needs a pin; wait until the album is solved")
    if (place := pin.place) is None:
        return Correction(kind="elsewhere")
    return Correction(
        kind="confirmed",
        plan_id=place.floorplan_id,
        x_m=place.position.x_m,
        y_m=place.position.y_m,
        heading_deg=place.heading_deg,
    )


def _text(correction: Correction) -> str:
    return json.dumps(correction.to_document(), sort_keys=True)


def _fault(field: str, message: str) -> InvalidRequestError:
    return InvalidRequestError([(f"correction.{field}", message)])
