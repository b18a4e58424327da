"""Fixtures in plan files: their rooms, and the types that these get."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import shapely

from lalaloc_core.floorplan.room_types import types_by_fixtures
from lalaloc_core.importers.common.geometry import side_lengths
from lalaloc_core.importers.common.import_report import ReportBuilder
from lalaloc_core.importers.common.sketch import SketchedFixture, SketchedRoom

# Longer side of a fixture (m); others are symbols of another kind, or whole rooms.
_SIDES_M: Mapping[str, tuple[float, float]] = {
    "toilet": (0.3, 1.2), "shower": (0.5, 2.2), "bath": (0.8, 2.6), "basin": (0.2, 2.0), "stove": (0.3, 1.6),
    "sink": (0.25, 2.2), "fridge": (0.4, 1.6), "washer": (0.4, 1.5), "bed": (1.1, 2.8), "sofa": (0.8, 5.0),
    "stairs": (0.6, 20.0),
}  # fmt: skip
_MAX_NAMED = 5


def place_fixtures(
    fixtures: Sequence[SketchedFixture], rooms: Sequence[SketchedRoom], builder: ReportBuilder
) -> list[tuple[int, SketchedFixture]]:
    """Return the fixtures of usual size whose middle lies in a room, each with the number of its room."""
    if not fixtures:
        return []
    tree = shapely.STRtree([room.shape for room in rooms])
    points = [fixture.shape.representative_point() for fixture in fixtures]
    room_of = dict(tree.query(points, predicate="within").T[::-1].tolist())
    placed, unusual = [], []
    for number, fixture in enumerate(fixtures):
        low, high = _SIDES_M[fixture.kind]
        _, longer = side_lengths(fixture.shape)
        if not low <= longer <= high:
            unusual.append(f"a {fixture.kind} of {longer:.2f} m (usual: {low:g} to {high:g} m)")
        elif number in room_of:
            placed.append((room_of[number], fixture))
    outside = len(fixtures) - len(placed) - len(unusual)
    if outside:
        builder.notes.append(f"{outside} fixtures that lie in no room were left out")
    if unusual:
        builder.notes.append(
            f"{len(unusual)} fixtures of unusual size were left out: {', '.join(unusual[:_MAX_NAMED])}; check the scale"
        )
    return placed


def type_rooms(
    rooms: Sequence[SketchedRoom], placed: Sequence[tuple[int, SketchedFixture]], builder: ReportBuilder
) -> list[SketchedRoom]:
    """Return the rooms with the types that their fixtures add."""
    sizes_of: dict[int, list[tuple[str, float]]] = {}
    for index, fixture in placed:
        sizes_of.setdefault(index, []).append((fixture.kind, fixture.shape.area))
    typed, lines = list(rooms), []
    for index, sizes in sizes_of.items():
        room = rooms[index]
        types = types_by_fixtures(room.types, sizes, room.shape.area)
        if types != room.types:
            typed[index] = replace(room, types=types)
            added, kinds = (", ".join(sorted(names)) for names in (set(types) - set(room.types), {k for k, _ in sizes}))
            lines.append(f"'{room.name or f'room {index + 1}'}' {added} ({kinds})")
    if lines:
        more = f" and {len(lines) - _MAX_NAMED} more" if len(lines) > _MAX_NAMED else ""
        builder.unsure.append(f"types of rooms by their fixtures: {', '.join(lines[:_MAX_NAMED])}{more}")
    return typed
