"""Native JSON format: one plan, or several with their levels. Plans with `units` other than metres are converted."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.floorplan.earth import Anchor
from lalaloc_core.floorplan.json_values import is_number
from lalaloc_core.importers.common import Budget, Level, ReportBuilder
from lalaloc_core.importers.common.assemble import ImportedPlan, assemble_levels, clean_name
from lalaloc_core.importers.common.import_options import METRES_PER_UNIT, ImportOptions, check_units, check_y_axis
from lalaloc_core.importers.common.plausibility import USUAL_CEILING_M, check_document, likely_unit

# JSON allows numbers of any size; larger ones are left for the validation to refuse.
_MAX_NUMBER = 1e12
# Levels of a venue in requests.
_MAX_LEVEL = 1000.0
# Lengths of the format. The same key without "_m" holds a length in `units`.
_LENGTHS = ("ceiling_height_m", "camera_height_m", "camera_height_std_m", "sill_m", "head_m")
# Shapes of the parts of a plan.
_SHAPES = {"rooms": ("polygon", "holes", "walls"), "openings": ("line",), "fixtures": ("outline",)}


def read(document: Any, options: ImportOptions, budget: Budget) -> tuple[ImportedPlan, ...]:
    """Read a plan in the native format, or a document with the member `plans`: plans with an additional `level`."""
    if isinstance(document, Mapping) and "plans" in document:
        return _read_plans(document, options, budget)
    plan = _read_plan(document, options, budget)
    if options.level is not None:
        ignored = "the option 'level' was ignored: it does not apply to native JSON"
        plan = replace(plan, report=replace(plan.report, warnings=(ignored, *plan.report.warnings)))
    return (plan,)


def _read_plans(document: Mapping[str, Any], options: ImportOptions, budget: Budget) -> tuple[ImportedPlan, ...]:
    """Read several plans, lowest level first; a plan without a level is on level 0."""
    plans = document["plans"]
    if more := [str(key)[:50] for key in document if key != "plans"]:
        raise InvalidFloorPlanError(f"'{more[0]}' stands beside 'plans'; move it into the plans, or remove it")
    if not isinstance(plans, list) or not plans or not all(isinstance(plan, Mapping) for plan in plans):
        raise InvalidFloorPlanError("'plans' must be a list of at least one plan, each an object with 'rooms'")
    if len(plans) > 1 and options.level is None:
        # The name of all plans together; each has its own.
        options = replace(options, name=None)
    levels = {str(number): (_level(plan, number), plan) for number, plan in enumerate(plans)}

    def make(level: Level, plan: Mapping[str, Any]) -> ImportedPlan:
        own = {key: value for key, value in plan.items() if key != "level"}
        return replace(_read_plan(own, options, budget), level=level)

    return assemble_levels(levels, options, budget, make)


def _level(plan: Mapping[str, Any], number: int) -> Level:
    """Return the level of one of several plans, named like the plan, which errors name."""
    level = plan.get("level", 0)
    if not is_number(level) or not abs(level) <= _MAX_LEVEL:
        raise InvalidFloorPlanError(
            f"plan {number} of 'plans' has level {str(level)[:50]!r}; it must be a number from {-_MAX_LEVEL:g} to "
            f"{_MAX_LEVEL:g}"
        )
    name = plan.get("name")
    return Level(clean_name(name if isinstance(name, str) else None) or f"plan {number}", float(level))


def _read_plan(document: Any, options: ImportOptions, budget: Budget) -> ImportedPlan:
    """Read a plan.

    The document can contain `units` and `y_axis` ("down"); the options take precedence. Keys that end in `_m` are
    always in metres. The same keys without it (`ceiling_height`) and all coordinates are in `units`.
    """
    if not isinstance(document, Mapping):
        raise InvalidFloorPlanError(f"the plan is of type {type(document).__name__}; it must be an object with 'rooms'")
    plan = dict(document)
    own_units, own_y_axis = plan.pop("units", None), plan.pop("y_axis", None)
    units = check_units(options.units or ("m" if own_units is None else own_units))
    y_axis = options.y_axis or ("up" if own_y_axis is None else own_y_axis)
    check_y_axis(y_axis)
    if options.name is not None:
        plan["name"] = options.name
    if options.ceiling_height_m is not None:
        plan.setdefault("ceiling_height_m", options.ceiling_height_m)
    factor = METRES_PER_UNIT[units]
    source = "units" if "units" in document or options.units else "the format: metres"
    builder = ReportBuilder("native", factor, source)
    y_factor = -factor if y_axis == "down" else factor
    if factor != 1.0 or y_factor != factor:
        plan = _convert(plan, factor, y_factor)
        builder.notes.append(f"coordinates were converted from {units}" if factor != 1.0 else "y was flipped")
    _check_ceiling_units(plan)
    limits = budget.limits.plan
    parsed = FloorPlan.from_dict(plan, limits)
    budget.spend(len(plan["rooms"]))
    builder.use("rooms", "rooms", len(plan["rooms"]))
    for key in ("openings", "fixtures"):
        for part in plan.get(key) or ():
            builder.use(key, str(part["kind"]))
    builder.warnings.extend(check_document(parsed.to_dict()))
    return ImportedPlan(plan, builder.build(), anchor=parsed.anchor, checked=(limits, parsed))


def write(document: Mapping[str, Any], anchor: Anchor | None) -> bytes:
    """Return a plan as native JSON; the document contains its own anchor."""
    return json.dumps(document, ensure_ascii=False, indent=1).encode()


def _convert(document: dict[str, Any], factor: float, y_factor: float) -> dict[str, Any]:
    """Convert a plan to metres; the validation refuses values of wrong types later."""
    plan = _lengths(document, factor)
    for key, shapes in _SHAPES.items():
        if isinstance(parts := plan.get(key), list):
            plan[key] = [_part(part, shapes, factor, y_factor) if isinstance(part, Mapping) else part for part in parts]
    holders = [plan]
    if isinstance(plan.get("anchor"), Mapping):
        anchor = plan["anchor"] = dict(plan["anchor"])
        holders.append(anchor)
        if isinstance(points := anchor.get("control_points"), list):
            # Their altitude is always in metres.
            scales = {"x": factor, "y": y_factor}
            anchor["control_points"] = [
                {key: _to_metres(value, scales.get(key, 1.0)) for key, value in point.items()}
                if isinstance(point, Mapping)
                else point
                for point in points
            ]
    for holder in holders if y_factor < 0.0 else ():
        north_deg = holder.get("north_deg")
        if is_number(north_deg) and abs(north_deg) < _MAX_NUMBER:
            # A flip of y mirrors angles and turns +y by half a turn.
            holder["north_deg"] = (180.0 - north_deg) % 360.0
    return plan


def _part(part: Mapping[str, Any], shapes: tuple[str, ...], factor: float, y_factor: float) -> dict[str, Any]:
    """Convert a room, opening or fixture with some members that are shapes; fixtures have no lengths."""
    lengths = dict(part) if "outline" in shapes else _lengths(part, factor)
    return lengths | {key: _scale(part[key], factor, y_factor) for key in shapes if key in part}


def _lengths(document: Mapping[str, Any], factor: float) -> dict[str, Any]:
    plan = dict(document)
    for key in _LENGTHS:
        short = key.removesuffix("_m")
        if short in plan and key in plan:
            raise InvalidFloorPlanError(f"'{short}' and '{key}' are both set; give only one of them")
        if short in plan:
            plan[key] = _to_metres(plan.pop(short), factor)
    return plan


def _scale(value: Any, factor: float, y_factor: float) -> Any:
    if not isinstance(value, list | tuple):
        return value
    if len(value) == 2 and all(is_number(number) for number in value):
        return [_to_metres(value[0], factor), _to_metres(value[1], y_factor)]
    return [_scale(item, factor, y_factor) for item in value]


def _to_metres(value: Any, factor: float) -> Any:
    """Return a length in metres; other values stay as they are for the validation to refuse."""
    return value * factor if is_number(value) and abs(value) < _MAX_NUMBER else value


def _check_ceiling_units(plan: Mapping[str, Any]) -> None:
    """Refuse a ceiling height of, say, 2500 m with the unit that was probably meant."""
    rooms = plan.get("rooms")
    holders = [plan, *(room for room in rooms if isinstance(room, Mapping))] if isinstance(rooms, list) else [plan]
    for holder in holders:
        height = holder.get("ceiling_height_m")
        if not is_number(height) or not 20.0 < height < _MAX_NUMBER:
            continue
        if (unit := likely_unit(float(height), USUAL_CEILING_M)) is not None:
            raise InvalidFloorPlanError(
                f"ceiling_height_m is {height:g} m; the limit is 20 m. It looks like {unit}: "
                f'rename it to \'ceiling_height\' and set "units": "{unit}"'
            )
