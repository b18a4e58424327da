"""The native format, with `units`: plans that were written in feet or millimetres are converted."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.floorplan.values import is_number
from lalaloc_core.importers.model.assemble import ImportedPlan
from lalaloc_core.importers.model.checks import USUAL_CEILING_M, check_document, likely_unit
from lalaloc_core.importers.model.limits import Budget
from lalaloc_core.importers.model.options import METRES_PER_UNIT, ImportOptions
from lalaloc_core.importers.model.report import ReportBuilder

FORMAT = "native"
# JSON has numbers of any size.
_BEYOND = 1e12
# Lengths of the format. With `units`, a key may stand without its ending and is in that unit.
_LENGTHS = ("ceiling_height_m", "camera_height_m", "camera_height_std_m", "sill_m", "head_m")


def import_native(document: Any, options: ImportOptions, budget: Budget) -> tuple[ImportedPlan, ...]:
    """A plan in the native format.

    `units` and `y_axis` ("down") may stand in the document, or come as options, which win. Keys that end in `_m` are
    always metres; the same keys without it (`ceiling_height`) and all coordinates are in `units`.

    Raises:
        InvalidFloorPlanError: names the room and what is wrong.
    """
    if not isinstance(document, Mapping):
        raise InvalidFloorPlanError("a plan must be an object")
    plan = dict(document)
    units_said, y_axis_said = plan.pop("units", None), plan.pop("y_axis", None)
    units = _choice(options.units or ("m" if units_said is None else units_said))
    y_axis = options.y_axis or ("up" if y_axis_said is None else y_axis_said)
    if y_axis not in ("up", "down"):
        raise InvalidFloorPlanError(f"y_axis is {str(y_axis)[:50]!r}, known are up, down")
    if options.name is not None:
        plan["name"] = options.name
    if options.ceiling_height_m is not None:
        plan.setdefault("ceiling_height_m", options.ceiling_height_m)
    builder = ReportBuilder()
    factor = METRES_PER_UNIT[units]
    y_factor = -factor if y_axis == "down" else factor
    if factor != 1.0 or y_factor != factor:
        plan = _converted(plan, factor, y_factor)
        builder.notes.append(f"coordinates were converted from {units}" if factor != 1.0 else "y was turned over")
    _refuse_other_units(plan)
    limits = budget.limits.plan
    parsed = FloorPlan.from_dict(plan, limits)
    rooms = plan["rooms"]
    budget.spend(len(rooms))
    builder.use("rooms", "rooms", len(rooms))
    for opening in plan.get("openings") or ():
        builder.use("openings", str(opening["kind"]))
    builder.warnings.extend(check_document(parsed.to_dict()))
    report = builder.build(FORMAT, factor, "units" if "units" in document or options.units else "the format: metres")
    return (ImportedPlan(plan, report, anchor=parsed.anchor, checked=(limits, parsed)),)


def _choice(units: Any) -> str:
    if not isinstance(units, str) or units not in METRES_PER_UNIT:
        raise InvalidFloorPlanError(f"units is {str(units)[:50]!r}, known are {', '.join(METRES_PER_UNIT)}")
    return units


def _converted(document: dict[str, Any], factor: float, y_factor: float) -> dict[str, Any]:
    """The plan in metres. What is no number stays as it is: the format's own checks say what is wrong with it."""
    plan = _lengths(document, factor)
    rooms = plan.get("rooms")
    if isinstance(rooms, list):
        plan["rooms"] = [_room(room, factor, y_factor) if isinstance(room, Mapping) else room for room in rooms]
    openings = plan.get("openings")
    if isinstance(openings, list):
        plan["openings"] = [
            _lengths(opening, factor) | _scaled_keys(opening, ("line",), factor, y_factor)
            if isinstance(opening, Mapping)
            else opening
            for opening in openings
        ]
    if y_factor < 0.0 and is_number(plan.get("north_deg")) and abs(plan["north_deg"]) < _BEYOND:
        # Turned over, what was clockwise from +y on the drawing is clockwise from its new +y after half a turn.
        plan["north_deg"] = (180.0 - plan["north_deg"]) % 360.0
    anchor = plan.get("anchor")
    if isinstance(anchor, Mapping):
        plan["anchor"] = _anchor(anchor, factor, y_factor)
    return plan


def _room(room: Mapping[str, Any], factor: float, y_factor: float) -> dict[str, Any]:
    return _lengths(room, factor) | _scaled_keys(room, ("polygon", "holes", "walls"), factor, y_factor)


def _anchor(anchor: Mapping[str, Any], factor: float, y_factor: float) -> dict[str, Any]:
    """Control points are places of the drawing; the altitude is metres in any case."""
    converted = dict(anchor)
    north_deg, points = converted.get("north_deg"), converted.get("control_points")
    if y_factor < 0.0 and is_number(north_deg) and abs(north_deg) < _BEYOND:
        converted["north_deg"] = (180.0 - north_deg) % 360.0
    if isinstance(points, list):
        scales = {"x": factor, "y": y_factor}
        converted["control_points"] = [
            {key: _times(value, scales.get(key, 1.0)) for key, value in point.items()}
            if isinstance(point, Mapping)
            else point
            for point in points
        ]
    return converted


def _lengths(document: Mapping[str, Any], factor: float) -> dict[str, Any]:
    plan = dict(document)
    for key in _LENGTHS:
        short = key.removesuffix("_m")
        if short not in plan:
            continue
        if key in plan:
            raise InvalidFloorPlanError(f"'{short}' and '{key}' say the same, give one of them")
        value = plan.pop(short)
        plan[key] = _times(value, factor)
    return plan


def _scaled_keys(document: Mapping[str, Any], keys: tuple[str, ...], factor: float, y_factor: float) -> dict[str, Any]:
    return {key: _scaled(document[key], factor, y_factor) for key in keys if key in document}


def _scaled(value: Any, factor: float, y_factor: float) -> Any:
    if not isinstance(value, list | tuple):
        return value
    if len(value) == 2 and all(is_number(number) for number in value):
        return [_times(value[0], factor), _times(value[1], y_factor)]
    return [_scaled(item, factor, y_factor) for item in value]


def _times(value: Any, factor: float) -> Any:
    """A length in metres. What is no number, or none that a float can be, is left for the format's checks to refuse."""
    return value * factor if is_number(value) and abs(value) < _BEYOND else value


def _refuse_other_units(plan: Mapping[str, Any]) -> None:
    """A ceiling of 2500 "metres" is refused by the format; here the refusal names the unit it was meant in."""
    rooms = plan.get("rooms")
    places = [plan, *(room for room in rooms if isinstance(room, Mapping))] if isinstance(rooms, list) else [plan]
    for place in places:
        height = place.get("ceiling_height_m")
        if not is_number(height) or not 20.0 < height < _BEYOND:
            continue
        unit = likely_unit(float(height), USUAL_CEILING_M)
        if unit is not None:
            raise InvalidFloorPlanError(
                f"ceiling_height_m is {height:g}, at most 20 m is allowed; it looks like {unit}: "
                f'write it as \'ceiling_height\' beside "units": "{unit}"'
            )
