"""Checks of a valid plan for likely mistakes: wrong units, rooms without a door, duplicate names."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import chain
from typing import Any

import numpy as np
import shapely

from lalaloc_core.importers.common.import_options import METRES_PER_UNIT

# Usual ranges; a value outside gives a warning with the unit that would make it usual.
USUAL_CEILING_M = (1.9, 6.0)
USUAL_DOOR_M = (0.5, 3.0)
_USUAL_ROOM_M2 = (0.64, 1600.0)
# Largest distance of two rooms that share a wall, and reach of an opening to either side (m).
_USUAL_WALL_M, _REACH_M = 0.6, 0.45
# Usual door leaves, sides of rooms and buildings in drawings without a unit (m).
_USUAL_LEAF_M, _USUAL_SIDE_M, _USUAL_EXTENT_M = (0.55, 1.3), (1.0, 40.0), (4.0, 120.0)
_IMPERIAL = 0.7
_MAX_NAMED, _MAX_ROOMS_COMPARED = 5, 2000
UNIT_NAMES = {"m": "metres", "cm": "centimetres", "mm": "millimetres", "in": "inches", "ft": "feet"}


def check_document(document: Mapping[str, Any], *, is_scale_certain: bool = False) -> list[str]:
    """Return warnings about a plan as `FloorPlan.from_dict` expects it, except overlaps, of which `FloorPlan` warns.

    Values of the document may be out of range. With `is_scale_certain`, rooms and doors of unusual size give no
    warning.
    """
    rooms = [shapely.Polygon(room["polygon"]) for room in document["rooms"]]
    names = [room.get("name", f"room {index + 1}") for index, room in enumerate(document["rooms"])]
    warnings = _ceiling_warnings(document, names)
    if not is_scale_certain:
        warnings += _door_warnings(document) + _size_warnings(rooms)
    duplicates = [name for name, count in Counter(names).items() if count > 1]
    if duplicates:
        warnings.append(f"rooms share a name: {_list_names(duplicates)}; answers distinguish them by id only")
    if len(rooms) <= _MAX_ROOMS_COMPARED:
        warnings += _isolated_rooms(rooms, names)
        warnings += _unreachable_rooms(rooms, names, document.get("openings", []))
    return warnings


def likely_unit(value: float, usual_m: tuple[float, float]) -> str | None:
    """Return the unit that makes a length usual that is not usual in metres, None if no unit does or none is needed."""
    low, high = usual_m
    if low <= value <= high:
        return None
    fitting = [unit for unit, metres in METRES_PER_UNIT.items() if unit != "m" and low <= value * metres <= high]
    usual = math.sqrt(low * high)
    return min(fitting, key=lambda unit: abs(math.log(value * METRES_PER_UNIT[unit] / usual)), default=None)


def unit_by_parts(doors: Sequence[float], extent: float, sides: Sequence[float] = ()) -> str | None:
    """Return the unit of a drawing in which door leaves, rooms and the whole have usual sizes, None if none does.

    `doors` are the widths of leaves, `sides` those of typical rooms, and `extent` the size of the drawing, all in its
    units. Of the units in which all are usual, the one in which they are nearest to the middle is chosen; imperial
    ones are less frequent.
    """
    measures = [(doors, _USUAL_LEAF_M), (sides, _USUAL_SIDE_M), ([extent], _USUAL_EXTENT_M)]

    def score(unit: str) -> tuple[int, float]:
        fitting, off = 0, _IMPERIAL if unit in ("in", "ft") else 0.0
        for values, (low, high) in measures:
            if values:
                value = float(np.median(values)) * METRES_PER_UNIT[unit]
                fitting += low <= value <= high
                off += abs(math.log(max(value, 1e-9) / math.sqrt(low * high)))
        return fitting, -off

    best = max(METRES_PER_UNIT, key=score)
    return best if score(best)[0] == sum(bool(values) for values, _ in measures) else None


def _unit_hints(subject: str, value: float, usual_m: tuple[float, float]) -> list[str]:
    """Return a warning about a length if it is unusual in metres."""
    low, high = usual_m
    if low <= value <= high:
        return []
    unit = likely_unit(value, usual_m)
    advice = (
        f"it looks like {UNIT_NAMES[unit]} (with units={unit} it is {value * METRES_PER_UNIT[unit]:.2f} m)"
        if unit is not None
        else "check the scale"
    )
    return [f"{subject} is {value:g} m; the usual range is {low:.2g} to {high:.2g} m; {advice}"]


def _ceiling_warnings(document: Mapping[str, Any], names: Sequence[str]) -> list[str]:
    default = document.get("ceiling_height_m")
    heights = [room.get("ceiling_height_m", default) for room in document["rooms"]]
    first_room: dict[float, str] = {}
    for name, height in zip(names, heights, strict=True):
        if height is not None:
            first_room.setdefault(float(height), name)
    hints = [_unit_hints(f"the ceiling of '{name}'", height, USUAL_CEILING_M) for height, name in first_room.items()]
    return list(chain.from_iterable(hints))[:_MAX_NAMED]


def _door_warnings(document: Mapping[str, Any]) -> list[str]:
    widths = [_length(opening["line"]) for opening in document.get("openings", []) if opening["kind"] == "door"]
    if not widths:
        return []
    return _unit_hints("the median width of doors", round(float(np.median(widths)), 4), USUAL_DOOR_M)


def _size_warnings(rooms: Sequence[shapely.Polygon]) -> list[str]:
    """Detect a wrong unit by the size of rooms, which works without doors."""
    areas = np.sort([room.area for room in rooms])
    # Median weighted by area, so that closets and ducts hardly count.
    side = float(np.sqrt(areas[np.searchsorted(np.cumsum(areas), 0.5 * areas.sum())]))
    low, high = (float(np.sqrt(area)) for area in _USUAL_ROOM_M2)
    return _unit_hints("the side of a typical room", round(side, 3), (low, high))


def _isolated_rooms(rooms: Sequence[shapely.Polygon], names: Sequence[str]) -> list[str]:
    """Find rooms farther from all others than a wall is thick."""
    if len(rooms) < 2:
        return []
    tree = shapely.STRtree(rooms)
    isolated = []
    for index, room in enumerate(rooms):
        near = tree.query(room, predicate="dwithin", distance=_USUAL_WALL_M)
        if len(near) < 2:
            isolated.append(names[index])
    if not isolated:
        return []
    return [
        f"rooms farther than a wall's thickness ({_USUAL_WALL_M:g} m) from every other room: {_list_names(isolated)}; "
        "check the scale and look for missing rooms"
    ]


def _unreachable_rooms(
    rooms: Sequence[shapely.Polygon], names: Sequence[str], openings: Sequence[Mapping[str, Any]]
) -> list[str]:
    """Find rooms without a door or passage, in a plan that has any."""
    entries = [shapely.LineString(opening["line"]) for opening in openings if opening["kind"] in ("door", "passage")]
    if not entries:
        return []
    tree = shapely.STRtree(entries)
    unreachable = [
        name
        for name, room in zip(names, rooms, strict=True)
        if len(tree.query(room.exterior, predicate="dwithin", distance=_REACH_M)) == 0
    ]
    return [f"no door or passage reaches {_list_names(unreachable)}"] if unreachable else []


def _length(line: Sequence[Sequence[float]]) -> float:
    (x0, y0), (x1, y1) = line
    return float(np.hypot(x1 - x0, y1 - y0))


def _list_names(names: Sequence[str]) -> str:
    shown = ", ".join(f"'{name}'" for name in names[:_MAX_NAMED])
    return shown if len(names) <= _MAX_NAMED else f"{shown} and {len(names) - _MAX_NAMED} more"
