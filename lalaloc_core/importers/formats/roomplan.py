"""Apple RoomPlan: the JSON of a `CapturedRoom` or `CapturedStructure`, as apps on phones with a depth sensor save it.

Walls, doors, windows and openings are upright rectangles with their width and height (`dimensions`) and their place
(`transform`, 4 x 4, column by column) in metres, y up. Floors have outlines in their own frame (`polygonCorners`).
https://developer.apple.com/documentation/roomplan/capturedroom
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import shapely
from jaxtyping import Float

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan.json_values import is_number
from lalaloc_core.floorplan.plan_words import fixture_from_name
from lalaloc_core.importers.common import Budget, ImportOptions, Level, ReportBuilder, Sketch, SketchedRoom
from lalaloc_core.importers.common.assemble import ImportedPlan, assemble, assemble_levels
from lalaloc_core.importers.common.geometry import MAX_COORDINATE, check_coordinates, point_xy, polygons_of
from lalaloc_core.importers.common.sketch import OpeningKind, SketchedFixture, SketchedOpening
from lalaloc_core.importers.drawing.enclosed_rooms import enclose

_OPENINGS: Mapping[str, OpeningKind] = {"doors": "door", "windows": "window", "openings": "passage"}
# Walls that enclose less than this share of the floors have gaps; the floors' outlines are used then.
_ENCLOSED_SHARE = 0.8
# Corners of a flat rectangle of unit size.
_CORNERS = np.array([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]])
# A sill nearer to the floor is rounding of the scan (m).
_MIN_SILL_M = 0.1
# Walls beside a room have their middle within this distance of it (m).
_BESIDE_M = 0.3


class _Surface(NamedTuple):
    """Upright rectangle: its line seen from above, and the heights of its edges (m)."""

    line: shapely.LineString
    low_m: float
    high_m: float


def read(document: Mapping[str, Any], options: ImportOptions, budget: Budget) -> tuple[ImportedPlan, ...]:
    """Read one plan per story of a scan."""
    keys = ("walls", "floors", "sections", "objects", *_OPENINGS)
    surfaces = {key: list(_objects(document, key, budget)) for key in keys}
    stories = sorted({_story(raw) for key in ("walls", "floors") for raw in surfaces[key]})
    levels = {str(story): (Level(f"story {story}", float(story)), story) for story in stories}
    if not levels:
        raise InvalidFloorPlanError("the RoomPlan scan has no walls and no floors; scan the room again")

    def make(level: Level, story: int) -> ImportedPlan:
        builder = ReportBuilder("roomplan", 1.0, "the scan: metres")
        on_story = {key: [raw for raw in found if _story(raw) == story] for key, found in surfaces.items()}
        sketch = _sketch(on_story, builder, budget)
        if len(levels) > 1:
            sketch.level, sketch.name = level, level.name
        return assemble(sketch, builder, options, budget.limits.plan)

    return assemble_levels(levels, options, budget, make)


def _sketch(surfaces: Mapping[str, Sequence[Mapping[str, Any]]], builder: ReportBuilder, budget: Budget) -> Sketch:
    walls = [_surface(raw, f"wall {index}") for index, raw in enumerate(surfaces["walls"])]
    builder.use("walls", "walls", len(walls))
    floors = [floor for index, raw in enumerate(surfaces["floors"]) for floor in _floor(raw, f"floor {index}")]
    rooms = enclose([], [wall.line for wall in walls], check_time=budget.check_time).rooms
    if sum(room.area for room in rooms) < _ENCLOSED_SHARE * sum(floor.area for floor in floors):
        rooms = floors
        builder.use("floors", "rooms", len(floors))
    floor_m = float(np.median([wall.low_m for wall in walls])) if walls else 0.0
    sketch = Sketch(opening_kinds=tuple(_OPENINGS.values()))
    middles = shapely.STRtree([wall.line.interpolate(0.5, normalized=True) for wall in walls])
    labels = _labels(rooms, surfaces["sections"])
    for index, room in enumerate(rooms):
        budget.check_time()
        around = [walls[k] for k in middles.query(room, predicate="dwithin", distance=_BESIDE_M)]
        height_m = float(np.median([wall.high_m - floor_m for wall in around])) if around else None
        sketch.rooms.append(SketchedRoom(room, labels.get(index), (), height_m))
    for index, raw in enumerate(surfaces["objects"]):
        _add_object(raw, f"object {index}", sketch, builder)
    for key, kind in _OPENINGS.items():
        for index, raw in enumerate(surfaces[key]):
            line, low_m, high_m = _surface(raw, f"{key} {index}")
            builder.use(key, kind)
            sill_m = low_m - floor_m if low_m - floor_m >= _MIN_SILL_M else None
            start, end = map(point_xy, line.coords)
            sketch.openings.append(SketchedOpening(kind, start, end, None, sill_m, high_m - floor_m))
    return sketch


def _add_object(raw: Mapping[str, Any], where: str, sketch: Sketch, builder: ReportBuilder) -> None:
    """Add a piece of furniture, a box with its category: `{"toilet": {}}` or "toilet"."""
    category = raw.get("category")
    name = next(iter(category), "") if isinstance(category, Mapping) else category
    kind = fixture_from_name(name if isinstance(name, str) else None)
    builder.use(f"objects: {str(name)[:50]}", "fixtures" if kind else "ignored")
    if kind is not None:
        corners = _CORNERS[:, [0, 2, 1]] * _numbers(raw.get("dimensions"), 3, f"dimensions of {where}")
        sketch.fixtures += [SketchedFixture(kind, part) for part in _outlines(corners, raw, where)]


def _objects(document: Mapping[str, Any], key: str, budget: Budget) -> Iterator[Mapping[str, Any]]:
    found = document.get(key) or []
    if not isinstance(found, list) or not all(isinstance(raw, Mapping) for raw in found):
        raise InvalidFloorPlanError(f"'{key}' of the RoomPlan scan must be a list of objects; export the scan again")
    for raw in found:
        corners = raw.get("polygonCorners")
        budget.spend(1 + (len(corners) if isinstance(corners, list) else 0))
        yield raw


def _story(raw: Mapping[str, Any]) -> int:
    story = raw.get("story")
    return int(story) if is_number(story) and abs(story) < 1000 else 0


def _surface(raw: Mapping[str, Any], where: str) -> _Surface:
    width_m, height_m, _ = _numbers(raw.get("dimensions"), 3, f"dimensions of {where}").tolist()
    ends = _place(np.array([[-0.5 * width_m, 0.0, 0.0], [0.5 * width_m, 0.0, 0.0]]), raw, where)
    middle_m = float(ends[:, 1].mean())
    return _Surface(shapely.LineString(_from_above(ends)), middle_m - 0.5 * height_m, middle_m + 0.5 * height_m)


def _floor(raw: Mapping[str, Any], where: str) -> list[shapely.Polygon]:
    corners = raw.get("polygonCorners")
    if isinstance(corners, list) and len(corners) >= 3:
        local = np.stack([_numbers(corner, 3, f"corners of {where}") for corner in corners])
    else:
        local = _CORNERS * _numbers(raw.get("dimensions"), 3, f"dimensions of {where}")
    return _outlines(local, raw, where)


def _outlines(local: Float[np.ndarray, "n 3"], raw: Mapping[str, Any], where: str) -> list[shapely.Polygon]:
    """Return a surface with these corners, seen from above."""
    return polygons_of(shapely.Polygon(_from_above(_place(local, raw, where))))


def _place(local: Float[np.ndarray, "n 3"], raw: Mapping[str, Any], where: str) -> Float[np.ndarray, "n 3"]:
    """Return points of a surface in the frame of the scan."""
    transform = _numbers(raw.get("transform"), 16, f"transform of {where}").reshape(4, 4).T
    placed = local @ transform[:3, :3].T + transform[:3, 3]
    check_coordinates(placed, where)
    return placed


def _from_above(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
    """Return points seen from above: the scan's z points down on the plan."""
    return np.column_stack([points[:, 0], -points[:, 2]])


def _numbers(raw: Any, count: int, where: str) -> Float[np.ndarray, "n"]:
    # Some encoders write matrices as four columns.
    parts = raw if isinstance(raw, list) else []
    flat = [value for part in parts for value in (part if isinstance(part, list) else [part])]
    if len(flat) != count or not all(is_number(value) and abs(value) <= MAX_COORDINATE for value in flat):
        raise InvalidFloorPlanError(
            f"the {where} must be {count} numbers up to {MAX_COORDINATE:g}; export the RoomPlan scan again"
        )
    return np.array(flat, dtype=float)


def _labels(rooms: Sequence[shapely.Polygon], sections: Sequence[Mapping[str, Any]]) -> dict[int, str]:
    """Return names by the index of a room, of the first section whose centre lies in it, "livingRoom" as two words."""
    tree = shapely.STRtree(list(rooms))
    found: dict[int, str] = {}
    for section in sections:
        label, centre = section.get("label"), section.get("center")
        if not isinstance(label, str) or not isinstance(centre, list) or label == "unidentified":
            continue
        ((x, y),) = _from_above(_numbers(centre, 3, f"centre of section '{label[:50]}'")[None])
        words = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", label).lower()[:100]
        for index in tree.query(shapely.Point(x, y), predicate="within"):
            found.setdefault(int(index), words)
    return found
