"""Rooms from the plan's document."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import shapely
from jaxtyping import Float

from lalaloc_core.conventions import ROOM_TYPES
from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan.arrays import frozen
from lalaloc_core.floorplan.limits import PlanLimits
from lalaloc_core.floorplan.rooms import Room
from lalaloc_core.floorplan.values import (
    check_keys,
    json_kind,
    read_choice,
    read_list,
    read_name,
    read_number_between,
    read_points,
    read_segment,
)

_ROOM_KEYS = {"id", "name", "type", "polygon", "holes", "walls", "ceiling_height_m"}
# A free-standing wall may end this far inside another: drawings let a stub begin on the wall's axis.
_WALL_OVERSHOOT_M = 0.01


def read_rooms(raw_rooms: Any, default_ceiling_m: float | None, limits: PlanLimits) -> tuple[Room, ...]:
    """All rooms of a plan, with ids.

    Raises:
        InvalidFloorPlanError: names the room and what is wrong.
    """
    if not isinstance(raw_rooms, list) or not raw_rooms:
        raise InvalidFloorPlanError("'rooms' must be a list of at least one room")
    if len(raw_rooms) > limits.max_rooms:
        raise InvalidFloorPlanError(f"{len(raw_rooms)} rooms, at most {limits.max_rooms} are allowed (max_rooms)")
    vertices = sum(_count_vertices(raw) for raw in raw_rooms if isinstance(raw, Mapping))
    if vertices > limits.max_plan_vertices:
        raise InvalidFloorPlanError(
            f"{vertices} vertices, at most {limits.max_plan_vertices} are allowed (max_plan_vertices)"
        )
    rooms = [_read_room(raw, f"room {i + 1}", default_ceiling_m, limits) for i, raw in enumerate(raw_rooms)]
    return tuple(replace(room, id=key) for room, key in zip(rooms, _unique_ids(rooms), strict=True))


def read_ceiling(value: Any, room: str | None, limits: PlanLimits) -> float:
    """A ceiling height (m)."""
    low, high = limits.min_ceiling_height_m, limits.max_ceiling_height_m
    return read_number_between(value, "ceiling_height_m", low, high, " m", room)


def _count_vertices(raw: Mapping[str, Any]) -> int:
    """Vertices of outline and holes, and one for each free-standing wall, before any is looked at."""
    holes = raw.get("holes")
    rings = [raw.get("polygon"), raw.get("walls"), *(holes if isinstance(holes, list | tuple) else ())]
    return sum(len(ring) for ring in rings if isinstance(ring, list | tuple))


def _read_room(raw: Any, fallback_name: str, default_ceiling_m: float | None, limits: PlanLimits) -> Room:
    if not isinstance(raw, Mapping):
        raise InvalidFloorPlanError(f"a room must be an object, not {json_kind(raw)}", room=fallback_name)
    name = read_name(raw.get("name", fallback_name), limits, what=f"the name of {fallback_name}")
    check_keys(raw, _ROOM_KEYS, room=name)
    key = read_name(raw["id"], limits, "the id", room=name) if raw.get("id") is not None else ""
    kind = read_choice(raw.get("type", ROOM_TYPES[0]), ROOM_TYPES, "the type", room=name)
    ceiling = raw.get("ceiling_height_m", default_ceiling_m)
    if ceiling is None:
        raise InvalidFloorPlanError("no ceiling_height_m, neither here nor for the plan", room=name)
    height_m = read_ceiling(ceiling, name, limits)
    if (vertices := _count_vertices(raw)) > limits.max_vertices_per_room:
        raise InvalidFloorPlanError(
            f"{vertices} vertices, at most {limits.max_vertices_per_room} are allowed (max_vertices)", room=name
        )
    outline_m = _read_ring(raw.get("polygon"), "polygon", name, limits)
    holes_m = _read_holes(raw.get("holes"), outline_m, name, limits)
    shape = shapely.Polygon(outline_m, holes_m)
    if shape.area < limits.min_room_area_m2:
        raise InvalidFloorPlanError(
            f"the area is {shape.area:.3g} m², at least {limits.min_room_area_m2:g} m² is needed", room=name
        )
    return Room(
        name=name,
        polygon_m=outline_m,
        ceiling_height_m=height_m,
        id=key,
        type=kind,
        holes_m=holes_m,
        inner_walls_m=_read_walls(raw.get("walls"), shape, name, limits),
    )


def _read_ring(raw: Any, what: str, room: str, limits: PlanLimits, *, is_hole: bool = False) -> np.ndarray:
    """A simple polygon, counter-clockwise, or clockwise if it is a hole; read-only."""
    if not isinstance(raw, list | tuple) or len(raw) < 3:
        raise InvalidFloorPlanError(f"'{what}' must be a list of at least three [x, y] vertices", room=room)
    ring = read_points(raw, limits, room, "vertex" if what == "polygon" else f"{what}: vertex")
    # Drop repeated vertices, the closing one of a closed ring among them: they would be walls of no length.
    ring = ring[np.any(ring != np.roll(ring, -1, axis=0), axis=1)]
    subject = "the polygon" if what == "polygon" else what
    if len(ring) < 3:
        raise InvalidFloorPlanError(f"{subject} has fewer than three distinct vertices", room=room)
    if _is_collinear(ring):
        raise InvalidFloorPlanError(f"all vertices of {subject} lie on one line", room=room)
    shape = shapely.Polygon(ring)
    if not shape.is_valid:
        raise InvalidFloorPlanError(f"{subject} crosses itself ({shapely.is_valid_reason(shape)})", room=room)
    return frozen(ring if shape.exterior.is_ccw != is_hole else ring[::-1].copy())


def _is_collinear(ring: Float[np.ndarray, "n 2"]) -> bool:
    away = ring - ring[0]
    length = np.hypot(*away.T)
    direction = away[np.argmax(length)] / length.max()
    aside = away[:, 0] * direction[1] - away[:, 1] * direction[0]
    return bool(np.abs(aside).max() <= 1e-9 * length.max())


def _read_holes(
    raw: Any, outline_m: Float[np.ndarray, "n 2"], room: str, limits: PlanLimits
) -> tuple[Float[np.ndarray, "_ 2"], ...]:
    holes = read_list([] if raw is None else raw, "holes", limits.max_vertices_per_room, "max_vertices", room)
    rings = tuple(_read_ring(hole, f"hole {i}", room, limits, is_hole=True) for i, hole in enumerate(holes))
    outline = shapely.Polygon(outline_m)
    for index, ring in enumerate(rings):
        if not outline.covers(shapely.Polygon(ring)):
            raise InvalidFloorPlanError(f"hole {index} does not lie inside the polygon", room=room)
    if rings and not (whole := shapely.Polygon(outline_m, rings)).is_valid:
        reason = shapely.is_valid_reason(whole)
        raise InvalidFloorPlanError(f"the holes cross or cut off parts of the floor ({reason})", room=room)
    return rings


def _read_walls(raw: Any, shape: shapely.Polygon, room: str, limits: PlanLimits) -> Float[np.ndarray, "k 4"]:
    walls = read_list([] if raw is None else raw, "walls", limits.max_vertices_per_room, "max_vertices", room)
    if not walls:
        return frozen(np.empty((0, 4)))
    points = np.stack([read_segment(wall, f"wall {index}", limits, room) for index, wall in enumerate(walls)])
    floor = shape.buffer(_WALL_OVERSHOOT_M, join_style="mitre")
    for index, wall in enumerate(points):
        if not floor.covers(shapely.LineString(wall)):
            raise InvalidFloorPlanError(f"wall {index} leaves the room's floor", room=room)
    return frozen(points.reshape(-1, 4))


def _unique_ids(rooms: Sequence[Room]) -> list[str]:
    """The ids that the document gives, and for other rooms some made from their names: `bedroom`, `bedroom-2`."""
    given = Counter(room.id for room in rooms if room.id)
    for key, count in given.items():
        if count > 1:
            raise InvalidFloorPlanError(f"the id '{key}' is that of {count} rooms, ids are unique")
    taken, tried, ids = set(given), Counter[str](), []
    for room in rooms:
        key = room.id
        if not key:
            stem = re.sub(r"[\W_]+", "-", room.name.casefold()).strip("-") or "room"
            # Counted per name, so that a name that repeats hundreds of times is no search from the beginning each time.
            while not key or key in taken:
                tried[stem] += 1
                key = stem if tried[stem] == 1 else f"{stem}-{tried[stem]}"
            taken.add(key)
        ids.append(key)
    return ids
