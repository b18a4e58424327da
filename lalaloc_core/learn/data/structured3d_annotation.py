"""Structured3D's `annotation_3d.json`: rooms as planes, lines and junctions in millimetres.

    semantics    rooms, doors, windows and outer walls with their planes
    planes       floor, ceiling or wall
    planeLineMatrix     planes x lines, 1 where a line lies on a plane
    lineJunctionMatrix  lines x junctions, 1 where a junction ends a line
    junctions    coordinates

Planes, lines and junctions are referenced by their index in the lists, as in the data set's own tools.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from jaxtyping import Float

from lalaloc_core.errors import DatasetError
from lalaloc_core.floorplan import FloorPlan, room_type_from_label
from lalaloc_core.learn.data import assembly
from lalaloc_core.learn.data.drawn_rooms import DrawnOpening

_MM_PER_M = 1000.0
# All other types are rooms.
_OPENINGS = ("door", "window")
_NOT_ROOMS = (*_OPENINGS, "outwall")
# Maximum height difference of a level floor or ceiling.
_LEVEL_TOLERANCE_M = 0.05
# Maximum distance between a door's box and the walls of its rooms, because of rounding.
_BESIDE_M = 0.03
_LISTS = ("semantics", "planes", "junctions", "planeLineMatrix", "lineJunctionMatrix")


@dataclass(frozen=True)
class Floor:
    """Floor of a room: index of the room in the plan, and height (m) of the floor in the world frame."""

    room_index: int
    z_m: float


@dataclass(frozen=True, eq=False)
class Annotation:
    """Content of a scene's annotation.

    `floors` are by the ID of the room's semantic; a room can have several.
    """

    plan: FloorPlan
    floors: dict[str, tuple[Floor, ...]]


def read_annotation(path: Path, scene: str) -> Annotation:
    """Read the rooms of a scene."""
    return _Reader(assembly.read_json(path, scene=scene), scene, path).annotation()


class _Reader:
    """Reader of one annotation; errors name its scene and file."""

    def __init__(self, document: dict[str, Any], scene: str, path: Path) -> None:
        self._document, self._scene, self._path = document, scene, path
        for key in _LISTS:
            if not isinstance(document.get(key), list):
                raise self._error(f"'{key}' must be a list" if key in document else f"'{key}' is missing")

    def annotation(self) -> Annotation:
        outlines: list[assembly.RoomOutline] = []
        heights: list[tuple[str, float]] = []
        seen: Counter[str] = Counter()
        for number, semantic in enumerate(self._document["semantics"]):
            kind, planes = self._semantic(semantic, number)
            if kind in _NOT_ROOMS:
                continue
            identity = str(semantic.get("ID"))
            for outline, floor_z_m in self._outlines(f"{kind} {identity}", planes):
                seen[outline.name] += 1
                if seen[outline.name] > 1:
                    outline = dataclasses.replace(outline, name=f"{outline.name} ({seen[outline.name]})")
                outlines.append(outline)
                heights.append((identity, floor_z_m))
        openings, faults = self._openings(outlines, [z_m for _, z_m in heights])
        plan = assembly.assemble_plan(
            self._scene,
            outlines,
            path=self._path,
            units="coordinates are read as millimetres",
            openings=openings,
            opening_kinds=_OPENINGS,
        )
        plan = dataclasses.replace(plan, warnings=(*plan.warnings, *faults))
        # The plan leaves out rooms that are too small.
        places = {room.name: index for index, room in enumerate(plan.rooms)}
        floors: dict[str, tuple[Floor, ...]] = {}
        for outline, (identity, floor_z_m) in zip(outlines, heights, strict=True):
            kept = (Floor(places[outline.name], floor_z_m),) if outline.name in places else ()
            floors[identity] = (*floors.get(identity, ()), *kept)
        return Annotation(plan, floors)

    def _outlines(self, room: str, planes: list[Any]) -> list[tuple[assembly.RoomOutline, float]]:
        """Return the outline and floor height of each of a room's floors."""
        by_kind: dict[str, list[int]] = {"floor": [], "ceiling": []}
        for plane in planes:
            entry = self._entry("planes", plane, room)
            kind = entry.get("type") if isinstance(entry, dict) else None
            if not isinstance(kind, str):
                raise self._error(f"plane {plane} has no 'type'", room)
            by_kind.setdefault(kind, []).append(plane)
        for kind in ("floor", "ceiling"):
            if not by_kind[kind]:
                raise self._error(f"the room has no {kind} among its planes {planes}", room)
        ceiling_mm = [point for plane in by_kind["ceiling"] for point in self._points_mm(plane, "ceiling", room)]
        ceiling_z_m, ceiling_warnings = _level(np.array(ceiling_mm)[:, 2] / _MM_PER_M, "ceiling", room)
        found = []
        for plane in by_kind["floor"]:
            corners_m, holes_m = self._floor_m(plane, room)
            floor_z_m, floor_warnings = _level(corners_m[:, 2], "floor", room)
            outline = assembly.RoomOutline(
                name=room,
                polygon_m=corners_m[:, :2],
                ceiling_height_m=ceiling_z_m - floor_z_m,
                holes_m=holes_m,
                warnings=(*floor_warnings, *ceiling_warnings),
                type=room_type_from_label(room),
            )
            found.append((outline, floor_z_m))
        return found

    def _openings(
        self, outlines: list[assembly.RoomOutline], floors_z_m: list[float]
    ) -> tuple[list[DrawnOpening], tuple[str, ...]]:
        """Return doors and windows (boxes between two walls, or single faces), and warnings about unreadable ones."""
        shapes = [shapely.Polygon(outline.polygon_m) for outline in outlines]
        found, faults = [], []
        for number, semantic in enumerate(self._document["semantics"]):
            kind, planes = self._semantic(semantic, number)
            if kind not in _OPENINGS:
                continue
            name = f"{kind} {semantic['ID']}"
            try:
                corners_mm = [point for plane in planes for point in self._points_mm(plane, kind, name)]
            except DatasetError as error:
                faults.append(f"{name} is left out: {error.reason}")
                continue
            if len(corners_mm) < 3:
                faults.append(f"{name} is left out: it has {len(corners_mm)} corners")
                continue
            corners_m = np.array(corners_mm) / _MM_PER_M
            footprint = shapely.MultiPoint(corners_m[:, :2]).convex_hull
            beside = [k for k, shape in enumerate(shapes) if shapely.distance(shape, footprint) <= _BESIDE_M]
            floor_z_m = min((floors_z_m[k] for k in beside), default=min(floors_z_m, default=0.0))
            found.append(
                DrawnOpening(
                    kind=kind,
                    line_m=_middle_line(footprint),
                    sill_m=max(0.0, float(corners_m[:, 2].min()) - floor_z_m),
                    head_m=float(corners_m[:, 2].max()) - floor_z_m,
                    rooms=tuple(outlines[k].name for k in beside),
                )
            )
        return found, tuple(faults)

    def _floor_m(self, plane: int, room: str) -> tuple[Float[np.ndarray, "n 3"], tuple[Float[np.ndarray, "_ 2"], ...]]:
        """Return the corners of a floor in order, and its other rings, which are holes."""
        lines = self._lines(plane, "floor", room)
        rings, fault = self._chained(lines, room)
        if len(rings) != 1:
            # Doors and windows may also be drawn on the floor; the data set's own tools ignore their lines.
            rings = self._chained([line for line in lines if line not in self._lines_of_openings], room)[0] or rings
        if not rings:
            raise self._error(f"floor plane {plane}: {fault}", room) from fault
        corners_m = [np.array([self._junction_mm(junction, room) for junction in ring]) / _MM_PER_M for ring in rings]
        outer = int(np.argmax([shapely.Polygon(corners).area for corners in corners_m]))
        return corners_m[outer], tuple(corners[:, :2] for k, corners in enumerate(corners_m) if k != outer)

    def _chained(self, lines: list[int], room: str) -> tuple[list[list[int]], assembly.OpenRingError | None]:
        try:
            return assembly.chain_rings([self._ends(line, room) for line in lines]), None
        except assembly.OpenRingError as error:
            return [], error

    @cached_property
    def _lines_of_openings(self) -> frozenset[int]:
        found: set[int] = set()
        for number, semantic in enumerate(self._document["semantics"]):
            kind, planes = self._semantic(semantic, number)
            if kind in _OPENINGS:
                found.update(line for plane in planes for line in _ones(self._entry("planeLineMatrix", plane, kind)))
        return frozenset(found)

    def _points_mm(self, plane: int, kind: str, room: str) -> list[list[float]]:
        ends = {junction for line in self._lines(plane, kind, room) for junction in self._ends(line, room)}
        return [self._junction_mm(junction, room) for junction in sorted(ends)]

    def _semantic(self, semantic: Any, number: int) -> tuple[str, list[Any]]:
        if not isinstance(semantic, dict) or not isinstance(semantic.get("type"), str):
            raise self._error(f"semantic {number} has no 'type'")
        planes = semantic.get("planeID")
        name = f"{semantic['type']} {semantic.get('ID')}"
        if not isinstance(semantic.get("ID"), int | str):
            raise self._error(f"semantic {number} has no 'ID'", name)
        if not isinstance(planes, list):
            raise self._error(f"semantic {number} has no list 'planeID'", name)
        return semantic["type"], planes

    def _lines(self, plane: int, kind: str, room: str) -> list[int]:
        lines = _ones(self._entry("planeLineMatrix", plane, room))
        if not lines:
            raise self._error(f"{kind} plane {plane} has no lines", room)
        return lines

    def _ends(self, line: int, room: str) -> tuple[int, int]:
        junctions = _ones(self._entry("lineJunctionMatrix", line, room))
        if len(junctions) != 2:
            raise self._error(f"line {line} has {len(junctions)} junctions; two are required", room)
        return junctions[0], junctions[1]

    def _junction_mm(self, junction: int, room: str) -> list[float]:
        entry = self._entry("junctions", junction, room)
        point = entry.get("coordinate") if isinstance(entry, dict) else None
        if not isinstance(point, list) or len(point) != 3 or not all(assembly.is_number(value) for value in point):
            raise self._error(f"junction {junction} has coordinate {str(point)[:80]}; three numbers are required", room)
        return [float(value) for value in point]

    def _entry(self, key: str, index: Any, room: str) -> Any:
        entries = self._document[key]
        if isinstance(index, bool) or not isinstance(index, int) or not 0 <= index < len(entries):
            raise self._error(f"'{key}' has no entry {index!r}; it has {len(entries)} entries", room)
        return entries[index]

    def _error(self, reason: str, room: str | None = None) -> DatasetError:
        return DatasetError(reason, scene=self._scene, room=room, path=self._path)


def _middle_line(footprint: shapely.Geometry) -> Float[np.ndarray, "2 2"]:
    corners = shapely.get_coordinates(shapely.oriented_envelope(footprint))
    if len(corners) < 5:
        # A single face is a line in plan view.
        return np.stack([corners[0], corners[-1]])
    sides = np.linalg.norm(np.diff(corners[:3], axis=0), axis=1)
    a, b, c, d = corners[:4]
    return np.stack([(a + d) / 2.0, (b + c) / 2.0] if sides[0] >= sides[1] else [(a + b) / 2.0, (c + d) / 2.0])


def _level(z_m: Float[np.ndarray, "n"], kind: str, room: str) -> tuple[float, tuple[str, ...]]:
    """Return the mean height of a floor or ceiling, and a warning if it is not level."""
    spread_m = float(np.ptp(z_m))
    if spread_m <= _LEVEL_TOLERANCE_M:
        return float(z_m.mean()), ()
    return float(z_m.mean()), (f"room '{room}': the {kind} is not level; its height varies by {spread_m:.2f} m",)


def _ones(row: Any) -> list[int]:
    """Return the indices of the ones in a row of a matrix; rows are long and sparse."""
    if not isinstance(row, list):
        return []
    places, place = [], -1
    for _ in range(row.count(1)):
        place = row.index(1, place + 1)
        places.append(place)
    return places
