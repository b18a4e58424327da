"""Documents about the pins of an album: corrections as the store has them; pins as GeoJSON, CSV, SVG and plain data."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from lalaloc_core.draw.pins import ReportRow, draw_pins
from lalaloc_core.draw.plan import Bounds, svg_around
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.album.entry import Correction
from lalaloc_core.shown_text import no_formula
from service.errors import InvalidRequestError
from service.schemas.albums import AlbumPhotographAnswer, CorrectionDocument, PinAnswer
from service.schemas.query_fields import PlanPoint


def stored_correction(
    document: CorrectionDocument, plan_id: str | None, plan: FloorPlan | None, pin: PinAnswer | None
) -> str:
    """Return a correction as JSON of the core; the plan is that of its room or position, None where it is unknown."""
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


_COLUMNS: tuple[str, ...] = (
    "number", "name", "taken_at", "state", "confidence", "floorplan_id", "level", "room_id", "room", "x_m", "y_m",
    "heading_deg", "latitude", "longitude", "reason", "room_confidence", "within_1m",
)  # fmt: skip


def pins_csv(photographs: Sequence[AlbumPhotographAnswer]) -> bytes:
    """Return photographs as CSV in UTF-8 (RFC 4180), a line each; texts that look like formulas begin with `'`."""
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, _COLUMNS)
    writer.writeheader()
    for photograph in photographs:
        row = _row(photograph).items()
        writer.writerow({name: no_formula(value) if isinstance(value, str) else value for name, value in row})
    return buffer.getvalue().encode(errors="replace")


def pins_geojson(photographs: Sequence[AlbumPhotographAnswer]) -> dict[str, Any] | None:
    """Return pins as a FeatureCollection (RFC 7946); None if no photograph with a pin has a place on Earth.

    Photographs without a place have a null geometry.
    """
    features, placed, located = [], 0, 0
    for photograph in photographs:
        pin = photograph.pin
        geometry = None
        if pin is not None and pin.place is not None:
            placed += 1
            if pin.geopose is not None:
                located += 1
                place = pin.geopose.position
                geometry = {"type": "Point", "coordinates": [place.lon, place.lat, place.h]}
        properties = photograph.model_dump(mode="json")
        features.append({"type": "Feature", "id": photograph.id, "geometry": geometry, "properties": properties})
    if placed and not located:
        return None
    return {"type": "FeatureCollection", "features": features}


def pins_svg(name: str, bounds_m: Bounds, photographs: Sequence[AlbumPhotographAnswer]) -> tuple[str, str]:
    """Return the parts of a drawing before and after its rooms: a pin with its number and arrow for each photograph."""
    head, tail = svg_around(name, bounds_m)
    size_m = max(bounds_m[2] - bounds_m[0], bounds_m[3] - bounds_m[1], 1.0)
    rows = [ReportRow(report_entry(row, row.name or ""), bytes) for row in photographs if row.pin is not None]
    marks = draw_pins(size_m, [pin for row in rows if (pin := row.pin) is not None])
    end = tail.rindex("</svg>")
    return head, tail[:end] + marks + tail[end:]


def report_entry(photograph: AlbumPhotographAnswer, name: str) -> dict[str, Any]:
    """Return a photograph that is solved as in the `pins.json` of `lalaloc pin`, for its copy and the report."""
    row = dict.fromkeys(_COLUMNS) | _row(photograph)
    position = None if row["x_m"] is None else {"x_m": row["x_m"], "y_m": row["y_m"]}
    taken = (row["taken_at"] or "").replace("T", " ").partition(".")[0]
    return row | {"photograph": name, "taken": taken, "plan": row["floorplan_id"], "position": position}


def _row(photograph: AlbumPhotographAnswer) -> dict[str, Any]:
    pin = photograph.pin
    row = {"number": photograph.number, "name": photograph.name, "taken_at": photograph.view.taken_at}
    if pin is None:
        return row
    row |= {key: getattr(pin, key) for key in ("state", "room_confidence", "confidence", "within_1m", "reason")}
    if (place := pin.place) is not None:
        row |= {key: getattr(place, key) for key in ("floorplan_id", "level", "room_id", "room", "heading_deg")}
        row |= {"x_m": place.position.x_m, "y_m": place.position.y_m}
    if pin.geopose is not None:
        row |= {"latitude": pin.geopose.position.lat, "longitude": pin.geopose.position.lon}
    return row
