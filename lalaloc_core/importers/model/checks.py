"""What is likely wrong with a plan that breaks no rule: wrong units, rooms that no door reaches, doubled names."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import shapely

from lalaloc_core.importers.model.options import METRES_PER_UNIT

# What is usual; beyond it a warning asks for a look, and names the unit that would make it usual.
USUAL_CEILING_M = (1.9, 6.0)
USUAL_DOOR_M = (0.5, 3.0)
_USUAL_ROOM_M2 = (0.64, 1600.0)
# How far apart two rooms lie at most that share a wall, and how far an opening reaches to either side.
_USUAL_WALL_M, _REACH_M = 0.6, 0.45
_MIN_OVERLAP_M2 = 0.01
_MAX_NAMED, _MAX_ROOMS_COMPARED = 5, 2000
_UNIT_NAMES = {"m": "metres", "cm": "centimetres", "mm": "millimetres", "in": "inches", "ft": "feet"}


def check_document(document: Mapping[str, Any]) -> list[str]:
    """Warnings about a plan in the native format; of overlaps the format itself warns.

    Args:
        document: a plan that `FloorPlan.from_dict` takes, or would take but for its values.
    """
    rooms = [shapely.Polygon(room["polygon"]) for room in document["rooms"]]
    names = [room.get("name", f"room {index + 1}") for index, room in enumerate(document["rooms"])]
    warnings = _ceilings(document, names)
    warnings += _unit_of_doors(document)
    warnings += _sizes(rooms, names)
    doubled = [name for name, count in Counter(names).items() if count > 1]
    if doubled:
        warnings.append(f"rooms share a name: {_listed(doubled)}; answers tell them apart by id only")
    if len(rooms) <= _MAX_ROOMS_COMPARED:
        warnings += _gaps(rooms, names)
        warnings += _unreached(rooms, names, document.get("openings", []))
    return warnings


def likely_unit(value: float, usual_m: tuple[float, float]) -> str | None:
    """The unit in which a length that was taken for metres would be usual; None where it is, or none makes it so."""
    low, high = usual_m
    if low <= value <= high:
        return None
    fitting = [unit for unit, metres in METRES_PER_UNIT.items() if unit != "m" and low <= value * metres <= high]
    # Where several fit, the one that makes it most usual.
    usual = math.sqrt(low * high)
    return min(fitting, key=lambda unit: abs(math.log(value * METRES_PER_UNIT[unit] / usual)), default=None)


def unit_hint(what: str, value: float, usual_m: tuple[float, float]) -> str | None:
    """A sentence on a length that is improbable in metres, None where it is usual."""
    low, high = usual_m
    if low <= value <= high:
        return None
    unit = likely_unit(value, usual_m)
    advice = (
        f"it looks like {_UNIT_NAMES[unit]} (units={unit} would make it {value * METRES_PER_UNIT[unit]:.2f} m)"
        if unit is not None
        else "is the scale right?"
    )
    return f"{what} is {value:g} m, usual are {low:.2g} to {high:.2g} m; {advice}"


def _ceilings(document: Mapping[str, Any], names: Sequence[str]) -> list[str]:
    default = document.get("ceiling_height_m")
    heights = [room.get("ceiling_height_m", default) for room in document["rooms"]]
    seen: dict[float, str] = {}
    for name, height in zip(names, heights, strict=True):
        if height is not None:
            seen.setdefault(float(height), name)
    hints = [unit_hint(f"the ceiling of '{name}'", height, USUAL_CEILING_M) for height, name in seen.items()]
    return [hint for hint in hints if hint is not None][:_MAX_NAMED]


def _unit_of_doors(document: Mapping[str, Any]) -> list[str]:
    widths = [_length(opening["line"]) for opening in document.get("openings", []) if opening["kind"] == "door"]
    if not widths:
        return []
    hint = unit_hint("the usual door's width", round(float(np.median(widths)), 4), USUAL_DOOR_M)
    return [] if hint is None else [hint]


def _sizes(rooms: Sequence[shapely.Polygon], names: Sequence[str]) -> list[str]:
    """Without doors, the size of rooms is what tells a wrong unit."""
    areas = np.sort([room.area for room in rooms])
    # The room that a random place of the floor lies in: closets and ducts do not count for much.
    side = float(np.sqrt(areas[np.searchsorted(np.cumsum(areas), 0.5 * areas.sum())]))
    low, high = (float(np.sqrt(area)) for area in _USUAL_ROOM_M2)
    hint = unit_hint("the usual room's side", round(side, 3), (low, high))
    return [] if hint is None else [hint]


def _gaps(rooms: Sequence[shapely.Polygon], names: Sequence[str]) -> list[str]:
    """Rooms farther from all others than any wall is thick."""
    if len(rooms) < 2:
        return []
    tree = shapely.STRtree(rooms)
    lonely = []
    for index, room in enumerate(rooms):
        near = tree.query(room, predicate="dwithin", distance=_USUAL_WALL_M)
        if len(near) < 2:
            lonely.append(names[index])
    if not lonely:
        return []
    return [
        f"farther than a wall's thickness ({_USUAL_WALL_M:g} m) from every other room: {_listed(lonely)}; "
        "is something missing between them, or the scale wrong?"
    ]


def _unreached(
    rooms: Sequence[shapely.Polygon], names: Sequence[str], openings: Sequence[Mapping[str, Any]]
) -> list[str]:
    """Rooms without a door or passage, where the plan has any at all."""
    ways = [shapely.LineString(opening["line"]) for opening in openings if opening["kind"] in ("door", "passage")]
    if not ways:
        return []
    tree = shapely.STRtree(ways)
    shut = [
        name
        for name, room in zip(names, rooms, strict=True)
        if len(tree.query(room.exterior, predicate="dwithin", distance=_REACH_M)) == 0
    ]
    return [f"no door or passage reaches {_listed(shut)}"] if shut else []


def _length(line: Sequence[Sequence[float]]) -> float:
    (x0, y0), (x1, y1) = line
    return float(np.hypot(x1 - x0, y1 - y0))


def _listed(names: Sequence[str]) -> str:
    shown = ", ".join(f"'{name}'" for name in names[:_MAX_NAMED])
    return shown if len(names) <= _MAX_NAMED else f"{shown} and {len(names) - _MAX_NAMED} more"
