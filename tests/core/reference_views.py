"""Slow reference of layout views, independent of the closed forms: shapely intersects one ray with the lines."""

from __future__ import annotations

import numpy as np
import shapely
from jaxtyping import Float
from shapely.affinity import rotate

from lalaloc_core.conventions import OPENING_CLASSES
from lalaloc_core.floorplan import FloorPlan, Room

_FAR_M = 1e4


def reference_view(
    plan: FloorPlan, room_index: int, position_m: Float[np.ndarray, "2"], azimuth: float, camera_height_m: float
) -> tuple[float, int, float]:
    """Return distance to the wall (m), opening code, and distance behind the opening (m) along one ray."""
    direction = np.array([np.sin(azimuth), np.cos(azimuth)])
    room = plan.rooms[room_index]
    distance_m = _crossings(room, position_m, direction)[0]
    met = position_m + distance_m * direction
    for opening in plan.openings:
        is_of_room = opening.rooms is None or room.id in opening.rooms
        sill_m, head_m = (opening.sill_m or 0.0), (_FAR_M if opening.head_m is None else opening.head_m)
        at_eye = sill_m < camera_height_m < head_m
        if is_of_room and at_eye and _is_at(opening.line_m, room, met, plan.opening_tolerance_m):
            code = OPENING_CLASSES.index(opening.kind)
            if opening.kind == "window":
                return distance_m, code, distance_m
            return distance_m, code, _behind(plan, room_index, opening.line_m, position_m, direction, distance_m)
    return distance_m, 0, distance_m


def _behind(
    plan: FloorPlan,
    room_index: int,
    line_m: Float[np.ndarray, "2 2"],
    position_m: Float[np.ndarray, "2"],
    direction: Float[np.ndarray, "2"],
    distance_m: float,
) -> float:
    """Return the length of a ray through an opening; `distance_m` if it enters no room."""
    for index, room in enumerate(plan.rooms):
        crossings = [t for t in _crossings(room, position_m, direction) if t > distance_m - 1e-6]
        if index == room_index:
            # The opening is in a free-standing wall: the ray stays on the same floor.
            probe = shapely.Point(position_m + (distance_m + 1e-4) * direction)
            if room.shape.contains(probe):
                return next(t for t in crossings if t > distance_m + 1e-6)
        elif crossings and _is_at(line_m, room, position_m + crossings[0] * direction, plan.opening_tolerance_m):
            return crossings[1]
    return distance_m


def _is_at(line_m: Float[np.ndarray, "2 2"], room: Room, point_m: Float[np.ndarray, "2"], tolerance_m: float) -> bool:
    """Return True if a point on a room's wall lies within the opening's projection onto that wall."""
    x0, y0, x1, y1 = min(
        room.walls_m, key=lambda wall: shapely.LineString(wall.reshape(2, 2)).distance(shapely.Point(point_m))
    )
    turn = np.arctan2(y1 - y0, x1 - x0)
    wall, line, point = (
        rotate(shape, -turn, origin=(x0, y0), use_radians=True)
        for shape in (shapely.LineString([(x0, y0), (x1, y1)]), shapely.LineString(line_m), shapely.Point(point_m))
    )
    left, low, right, high = line.bounds
    is_parallel = high - low < 0.27 * (right - left)
    return is_parallel and left < point.centroid.x < right and line.distance(wall) <= tolerance_m


def _crossings(room: Room, position_m: Float[np.ndarray, "2"], direction: Float[np.ndarray, "2"]) -> list[float]:
    """Return the ascending distances (m) along a ray at which it meets walls of a room."""
    ray = shapely.LineString([position_m, position_m + _FAR_M * direction])
    walls = shapely.union_all([shapely.LineString(wall.reshape(2, 2)) for wall in room.walls_m])
    points = shapely.get_coordinates(shapely.intersection(ray, walls))
    return sorted(np.unique(np.linalg.norm(points - position_m, axis=1)).tolist())
