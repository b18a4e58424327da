"""Checks of a valid plan for likely mistakes: wrong units, rooms without a door, duplicate names, missing openings.

The trust in openings is the probability, by kind, that an opening that exists is drawn. Every room has an entry, and
most rooms on an outer wall have a window. So rooms that no drawn opening reaches show how many are missing. The trust
is the posterior mean of the share t of openings that are drawn:

    P(a room is reached | t) = q (1 - (1 - t)^n)

with the probability q that a room has an opening, and the usual number n of these. A priori, a plan shows a kind as far
as the reader finds it, t ~ Beta(c r, c (1 - r)) with the reader's recall r; or a part of it, t ~ U(0, 1); or none.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np
import shapely

from lalaloc_core.conventions import OPENING_CLASSES
from lalaloc_core.importers.common.import_options import METRES_PER_UNIT

# Usual ranges; a value outside gives a warning with the unit that would make it usual.
USUAL_CEILING_M = (1.9, 6.0)
_USUAL_DOOR_M = (0.5, 3.0)
_USUAL_SIDE_M = (0.8, 40.0)
# Largest distance of two rooms that share a wall, reach of an opening to either side, and shortest outer wall (m).
_WALL_M, _REACH_M, _OUTER_M = 0.6, 0.65, 1.5
# Doors of one drawing are alike within this share, and so few other arcs are as wide as their leaves (m) by chance.
_ALIKE, _SOME, _WIDTHS_M, _LEAF_M = 0.3, 0.1, (0.55, 1.2), 0.84
_MAX_NAMED, _MAX_ROOMS_COMPARED = 5, 2000
UNIT_NAMES = {"m": "metres", "cm": "centimetres", "mm": "millimetres", "in": "inches", "ft": "feet"}
# q and n of entries and windows, as in generated homes; prior probabilities of a part and of none; c.
_HAS_ENTRY, _ENTRIES, _HAS_WINDOW, _WINDOWS = 0.99, 1.8, 0.9, 1.6
_IN_PART, _NOT_DRAWN, _STRENGTH = 0.2, 0.25, 20.0
# Probability that passages are drawn where they occur, in a plan with doors and without passages.
_ABSENT_PASSAGES = 0.7
# Trust in passages of a plan without doors, relative to others: they can be doors whose leaves are not drawn.
_LEAFLESS = 0.6
# Smaller rooms (m²) can be ducts without an entry, or lack a window.
_MIN_ENTERED_M2, _MIN_LIT_M2 = 1.5, 6.0
_UNLIT_TYPES = {
    "bathroom", "corridor", "entrance", "closet", "storage", "laundry", "garage", "stairs", "balcony",
}  # fmt: skip
# Rooms that are examined, evenly chosen among more.
_MAX_ROOMS = 400
_SHARES = (np.arange(200) + 0.5) / 200


def check_document(
    document: Mapping[str, Any], *, is_scale_certain: bool = False, metres_per_unit: float = 1.0
) -> list[str]:
    """Return warnings about a plan as `FloorPlan.from_dict` expects it, except overlaps, of which `FloorPlan` warns.

    Values of the document may be out of range; those of the file were multiplied by `metres_per_unit`. With
    `is_scale_certain`, rooms and doors of unusual size give no warning.
    """
    rooms = [shapely.Polygon(room["polygon"]) for room in document["rooms"]]
    names = [room.get("name", f"room {index + 1}") for index, room in enumerate(document["rooms"])]
    warnings = _ceiling_warnings(document, names)
    if not is_scale_certain:
        warnings += _size_warnings(document, rooms, metres_per_unit)
    duplicates = [name for name, count in Counter(names).items() if count > 1]
    if duplicates:
        warnings.append(f"rooms share a name: {_list_names(duplicates)}; answers distinguish them by id only")
    if len(rooms) <= _MAX_ROOMS_COMPARED:
        warnings += _isolated_rooms(rooms, names) + _unreachable_rooms(document, rooms, names)
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


def check_leaves(leaves_m: Sequence[float], metres_per_unit: float) -> list[str]:
    """Return a warning if the leaves of doors in a drawing are alike, but not as wide as usual."""
    median = float(np.median(leaves_m or [0.0]))
    alike = sum(abs(leaf / median - 1.0) <= _ALIKE for leaf in leaves_m)
    usual = sum(_WIDTHS_M[0] <= leaf <= _WIDTHS_M[1] for leaf in leaves_m)
    if alike < max(2, 0.5 * len(leaves_m)) or usual > _SOME * len(leaves_m):
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
    widths = [line.length for line in _lines(document, "door")]
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


def _unreachable_rooms(
    document: Mapping[str, Any], rooms: Sequence[shapely.Polygon], names: Sequence[str]
) -> list[str]:
    """Find rooms without a door or passage, in a plan that has any."""
    entries = _lines(document, "door") + _lines(document, "passage")
    reached = set(_reached(rooms, entries))
    unreachable = [name for index, name in enumerate(names) if index not in reached]
    return [f"no door or passage reaches {_list_names(unreachable)}"] if entries and unreachable else []


def _list_names(names: Sequence[str]) -> str:
    shown = ", ".join(f"'{name}'" for name in names[:_MAX_NAMED])
    return shown if len(names) <= _MAX_NAMED else f"{shown} and {len(names) - _MAX_NAMED} more"


@dataclass(frozen=True)
class OpeningTrust:
    """Trust in the openings of one kind, with its reason."""

    kind: str
    trust: float
    reason: str


def estimate_trust(
    document: Mapping[str, Any], recall: float, kinds: Sequence[str] = OPENING_CLASSES[1:]
) -> tuple[OpeningTrust, ...]:
    """Return the trust in the kinds of openings of a plan in the native format.

    `recall` is the share of drawn openings that the reader finds, and `kinds` are those that its format can hold.
    """
    shapes = [shapely.Polygon(room["polygon"]) for room in document["rooms"]]
    lines = {kind: _lines(document, kind) for kind in OPENING_CLASSES[1:]}
    chosen = np.unique(np.linspace(0, len(shapes) - 1, min(len(shapes), _MAX_ROOMS)).round().astype(int)).tolist()
    entered = [shapes[index] for index in chosen if shapes[index].area >= _MIN_ENTERED_M2]
    reached = len(_reached(entered, lines["door"] + lines["passage"]))
    entries = _share_drawn(reached, len(entered), (_HAS_ENTRY, _ENTRIES), recall)
    by_entries = f"{reached} of {len(entered)} rooms are reached by a door or passage"
    lit = _lit_rooms(document, shapes, chosen)
    with_window = len(_reached(lit, lines["window"]))
    windows = _share_drawn(with_window, len(lit), (_HAS_WINDOW, _WINDOWS), recall)
    has_doors, has_passages = bool(lines["door"]), bool(lines["passage"])
    passages, by_passages = entries, by_entries
    if has_doors and not has_passages:
        passages, by_passages = _ABSENT_PASSAGES * entries, f"{by_entries}; no passage is drawn"
    elif has_passages and not has_doors:
        passages, by_passages = _LEAFLESS * entries, f"{by_entries}; without doors, passages can be doors"
    found = (
        ("door", entries if has_doors else 0.0, by_entries if has_doors else "no door is drawn"),
        ("window", windows, f"{with_window} of {len(lit)} rooms on outer walls have a window"),
        ("passage", passages if has_doors or has_passages else 0.0, by_passages),
    )
    # A certain kind would count as proven.
    return tuple(OpeningTrust(kind, round(min(trust, 0.99), 2), why) for kind, trust, why in found if kind in kinds)


def _share_drawn(reached: int, rooms: int, having: tuple[float, float], recall: float) -> float:
    """Return the posterior mean of the share of openings that are drawn."""
    has, count = having
    if rooms == 0:
        return 0.0
    whole = _SHARES ** (_STRENGTH * recall - 1.0) * (1.0 - _SHARES) ** (_STRENGTH * (1.0 - recall) - 1.0)
    prior = (1.0 - _IN_PART - _NOT_DRAWN) * whole / whole.sum() + _IN_PART / len(_SHARES)
    reach = has * (1.0 - (1.0 - _SHARES) ** count)
    # In logs, as plans can have hundreds of rooms.
    log_weight = np.log(prior) + reached * np.log(reach) + (rooms - reached) * np.log1p(-reach)
    log_none = np.log(_NOT_DRAWN) if reached == 0 else -np.inf
    highest = max(float(log_weight.max()), log_none)
    weight = np.exp(log_weight - highest)
    return float(weight @ _SHARES / (weight.sum() + np.exp(log_none - highest)))


def _lines(document: Mapping[str, Any], kind: str) -> list[shapely.LineString]:
    return [shapely.LineString(opening["line"]) for opening in document.get("openings", ()) if opening["kind"] == kind]


def _reached(rooms: Sequence[shapely.Polygon], lines: Sequence[shapely.LineString]) -> list[int]:
    """Return the numbers of the rooms that openings lead to, straight across their middle; not those beside them."""
    if not rooms or not lines:
        return []
    start, end = (np.array([line.coords[side] for line in lines]) for side in (0, -1))
    along = (end - start) / np.maximum(np.linalg.norm(end - start, axis=1, keepdims=True), 1e-9)
    middle, across = 0.5 * (start + end), _REACH_M * along[:, ::-1] * (-1.0, 1.0)
    ways = [shapely.LineString(ends) for ends in np.stack([middle - across, middle + across], axis=1)]
    room, _ = shapely.STRtree(ways).query(rooms, predicate="intersects")
    return np.unique(room).tolist()


def _lit_rooms(
    document: Mapping[str, Any], shapes: Sequence[shapely.Polygon], chosen: Sequence[int]
) -> list[shapely.Polygon]:
    """Return the rooms that usually have a window: large ones with an outer wall."""
    tree = shapely.STRtree(shapes)
    found = []
    for index in chosen:
        shape, kind = shapes[index], document["rooms"][index].get("type")
        if shape.area < _MIN_LIT_M2 or kind in _UNLIT_TYPES:
            continue
        near = tree.query(shape, predicate="dwithin", distance=_WALL_M)
        around = shapely.union_all(tree.geometries[near[near != index]]).buffer(_WALL_M)
        if shape.exterior.difference(around).length >= _OUTER_M:
            found.append(shape)
    return found
