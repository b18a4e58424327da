"""Checks of a valid plan for likely mistakes: wrong units, rooms without a door, duplicate names."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import chain
from typing import Any

import numpy as np
import shapely

from lalaloc_core.floorplan.opening_trust import opening_lines, reached_rooms
from lalaloc_core.importers.common.import_options import METRES_PER_UNIT

# Usual ranges; a value outside gives a warning with the unit that would make it usual.
USUAL_CEILING_M = (1.9, 6.0)
_USUAL_DOOR_M = (0.5, 3.0)
_USUAL_SIDE_M = (0.8, 40.0)
# Largest distance of two rooms that share a wall (m).
_WALL_M = 0.6
# Doors of one drawing are alike within this share, and so few other arcs are as wide as their leaves (m) by chance.
_ALIKE, _SOME, _WIDTHS_M, _LEAF_M = 0.3, 0.1, (0.55, 1.2), 0.84
_MAX_NAMED, _MAX_ROOMS_COMPARED = 5, 2000
UNIT_NAMES = {"m": "metres", "cm": "centimetres", "mm": "millimetres", "in": "inches", "ft": "feet"}


def check_document(document: Mapping[str, Any], *, is_certain: bool = False, metres_per_unit: float = 1.0) -> list[str]:
    """Return warnings about a plan as `FloorPlan.from_dict` expects it, except overlaps, of which `FloorPlan` warns.

    Values of the document may be out of range; those of the file were multiplied by `metres_per_unit`. With
    `is_certain`, rooms and doors of unusual size give no warning.
    """
    rooms = [shapely.Polygon(room["polygon"]) for room in document["rooms"]]
    names = [room.get("name", f"room {index + 1}") for index, room in enumerate(document["rooms"])]
    warnings = _ceiling_warnings(document, names)
    if not is_certain:
        warnings += _size_warnings(document, rooms, metres_per_unit)
    duplicates = [name for name, count in Counter(names).items() if count > 1]
    if duplicates:
        warnings.append(f"rooms share a name: {_list_names(duplicates)}; answers distinguish them by id only")
    if len(rooms) <= _MAX_ROOMS_COMPARED:
        warnings += _isolated_rooms(rooms, names) + _unreached_rooms(document, rooms, names)
    return warnings


def likely_unit(value: float, usual_m: tuple[float, float]) -> str | None:
    """Return the unit that makes a length usual that is not usual in metres, None if no unit does or none is needed."""
    low, high = usual_m
    if low <= value <= high:
        return None
    fitting = [unit for unit, metres in METRES_PER_UNIT.items() if unit != "m" and low <= value * metres <= high]
    usual = math.sqrt(low * high)
    return min(fitting, key=lambda unit: abs(math.log(value * METRES_PER_UNIT[unit] / usual)), default=None)


def unit_hints(subject: str, value: float, usual_m: tuple[float, float], metres_per_unit: float = 1.0) -> list[str]:
    """Return a warning about a length if it is unusual in metres, with the unit in which that of the file is not."""
    low, high = usual_m
    if low <= value <= high:
        return []
    stated = value / metres_per_unit
    unit = "m" if low <= stated <= high else likely_unit(stated, usual_m)
    advice = (
        f"it looks like {UNIT_NAMES[unit]} (with units={unit} it is {stated * METRES_PER_UNIT[unit]:.2f} m)"
        if unit is not None and metres_per_unit in METRES_PER_UNIT.values()
        else "check the scale"
    )
    return [f"{subject} is {value:g} m; the usual range is {low:.2g} to {high:.2g} m; {advice}"]


def check_leaves(leaves_m: Sequence[float], metres_per_unit: float, least: int = 2) -> list[str]:
    """Return a warning if at least so many leaves of doors in a drawing are alike, but not as wide as usual."""
    median = float(np.median(leaves_m or [0.0]))
    alike = sum(abs(leaf / median - 1.0) <= _ALIKE for leaf in leaves_m)
    usual = sum(_WIDTHS_M[0] <= leaf <= _WIDTHS_M[1] for leaf in leaves_m)
    if alike < max(least, 0.5 * len(leaves_m)) or usual > _SOME * len(leaves_m):
        return []
    subject = f"the median width of the leaves of {len(leaves_m)} doors"
    found = unit_hints(subject, round(median, 4), _WIDTHS_M, metres_per_unit)
    return [f"{line}, or set multiply to about {_LEAF_M / median:.2g}" for line in found]


def _ceiling_warnings(document: Mapping[str, Any], names: Sequence[str]) -> list[str]:
    default = document.get("ceiling_height_m")
    heights = [room.get("ceiling_height_m", default) for room in document["rooms"]]
    first_room: dict[float, str] = {}
    for name, height in zip(names, heights, strict=True):
        if height is not None:
            first_room.setdefault(float(height), name)
    hints = [unit_hints(f"the ceiling of '{name}'", height, USUAL_CEILING_M) for height, name in first_room.items()]
    return list(chain.from_iterable(hints))[:_MAX_NAMED]


def _size_warnings(document: Mapping[str, Any], rooms: Sequence[shapely.Polygon], metres_per_unit: float) -> list[str]:
    """Detect a wrong unit by the width of doors, and by the size of rooms, which works without doors."""
    widths = [line.length for line in opening_lines(document, "door")]
    door_m = round(float(np.median(widths)), 4) if widths else _USUAL_DOOR_M[0]
    areas = np.sort([room.area for room in rooms])
    # Median weighted by area, so that closets and ducts hardly count.
    side_m = round(math.sqrt(areas[np.searchsorted(np.cumsum(areas), 0.5 * areas.sum())]), 3)
    return [
        *unit_hints("the median width of doors", door_m, _USUAL_DOOR_M, metres_per_unit),
        *unit_hints("the side of a typical room", side_m, _USUAL_SIDE_M, metres_per_unit),
    ]


def _isolated_rooms(rooms: Sequence[shapely.Polygon], names: Sequence[str]) -> list[str]:
    """Find rooms farther from all others than a wall is thick."""
    near, _ = shapely.STRtree(rooms).query(rooms, predicate="dwithin", distance=_WALL_M)
    isolated = [name for name, count in zip(names, np.bincount(near, minlength=len(rooms)), strict=True) if count < 2]
    warning = (
        f"rooms farther than a wall's thickness ({_WALL_M:g} m) from every other room: {_list_names(isolated)}; "
        "check the scale and look for missing rooms"
    )
    return [warning] if len(rooms) > 1 and isolated else []


def _unreached_rooms(document: Mapping[str, Any], rooms: Sequence[shapely.Polygon], names: Sequence[str]) -> list[str]:
    """Find rooms without a door or passage, in a plan that has any."""
    entries = opening_lines(document, "door") + opening_lines(document, "passage")
    reached = set(reached_rooms(rooms, entries))
    unreachable = [name for index, name in enumerate(names) if index not in reached]
    return [f"no door or passage reaches {_list_names(unreachable)}"] if entries and unreachable else []


def _list_names(names: Sequence[str]) -> str:
    shown = ", ".join(f"'{name}'" for name in names[:_MAX_NAMED])
    return shown if len(names) <= _MAX_NAMED else f"{shown} and {len(names) - _MAX_NAMED} more"
