"""Rooms: outline, holes, walls and free floor; checks of the size and overlaps of all rooms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property

import numpy as np
import shapely
from jaxtyping import Float
from shapely.geometry.base import BaseGeometry

from lalaloc_core.conventions import ROOM_TYPES
from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan.json_values import PlanLimits

# Margin around free-standing walls in rooms too narrow for any other, so that no camera stands on a wall.
_WALL_CORE_M = 1e-3
# `interior_point` tests a lattice over the floor, then finer ones around the best point. The exact answer, the centre
# of the largest inscribed circle, takes seconds for a spiral of two hundred vertices.
_LATTICE, _FINER_LATTICE, _ROUNDS = 20, 7, 5

# The search for overlaps ends after this many found or pairs tested; the number of pairs is quadratic in the rooms.
_MAX_OVERLAPS, _MAX_PAIRS = 20, 5000
# Two combs of two hundred vertices can cross ten thousand times, so the number of wall pairs that can cross is limited
# over all pairs of rooms. Pairs of rooms with fewer wall pairs than `_FEW` are not counted.
_MAX_WORK, _FEW = 100_000, 400


def frozen(array: np.ndarray) -> np.ndarray:
    """Make an array read-only and return it."""
    array.flags.writeable = False
    return array


@dataclass(frozen=True, eq=False)
class Room:
    """One room.

    Attributes:
        name: name for users; names may repeat.
        polygon_m: (n, 2) outline, counter-clockwise, not closed (the last vertex joins the first).
        id: unique within its plan.
        types: uses of the room, of `conventions.ROOM_TYPES` without "unknown"; empty if unknown.
        holes_m: areas inside the outline that are no floor, such as columns and shafts: each (k, 2), clockwise, not
            closed.
        inner_walls_m: (k, 4) free-standing walls up to the ceiling, segments (x0, y0, x1, y1).
        states_ceiling: the height is the room's own, not that of the plan or an assumed one.
    """

    name: str
    polygon_m: Float[np.ndarray, "n 2"]
    ceiling_height_m: float
    id: str = ""
    types: tuple[str, ...] = ()
    holes_m: tuple[Float[np.ndarray, "_ 2"], ...] = ()
    inner_walls_m: Float[np.ndarray, "k 4"] = field(default_factory=lambda: frozen(np.empty((0, 4))))
    states_ceiling: bool = True

    @property
    def type(self) -> str:
        """The first type, "unknown" without any."""
        return self.types[0] if self.types else ROOM_TYPES[0]

    @cached_property
    def shape(self) -> shapely.Polygon:
        """The floor as a shapely polygon: the outline without the holes."""
        return shapely.Polygon(self.polygon_m, self.holes_m)

    @property
    def area_m2(self) -> float:
        """Floor area, without holes."""
        return float(self.shape.area)

    @cached_property
    def walls_m(self) -> Float[np.ndarray, "n 4"]:
        """Wall segments (x0, y0, x1, y1): edges of the outline, edges of the holes, free-standing walls.

        The room lies to the left of the edges, and on both sides of the free-standing walls.
        """
        rings = (self.polygon_m, *self.holes_m)
        # Merged plans of a venue have hundreds of rooms, and `np.roll` takes longer than all else here.
        edges = [np.concatenate([ring, np.concatenate([ring[1:], ring[:1]])], axis=1) for ring in rings]
        return frozen(np.concatenate([*edges, self.inner_walls_m]))

    def wall_part(self, wall: int, start: float, end: float) -> Float[np.ndarray, "2 2"]:
        """Return the ends of the part of a wall between two shares of its length."""
        first, last = self.walls_m[wall].reshape(2, 2)
        return first + np.array([[start], [end]]) * (last - first)

    def free_floor(self, margin_m: float) -> BaseGeometry:
        """Return the floor at least `margin_m` from all walls, free-standing ones included; it can be empty."""
        floor = self.shape.buffer(-margin_m)
        if not len(self.inner_walls_m):
            return floor
        segments = shapely.MultiLineString(self.inner_walls_m.reshape(-1, 2, 2).tolist())
        return floor.difference(segments.buffer(margin_m))

    def interior_point(self) -> Float[np.ndarray, "2"]:
        """Return a point about as far from all walls as possible."""
        floor: BaseGeometry = self.shape
        if len(self.inner_walls_m):
            parts = shapely.get_parts(self.free_floor(_WALL_CORE_M))
            floor = shapely.MultiPolygon([part for part in parts if isinstance(part, shapely.Polygon)])
        return interior_point(floor)[0]


def interior_point(floor: BaseGeometry) -> tuple[Float[np.ndarray, "2"], float]:
    """Return a point about as far from the edges of a floor as possible, and its distance (m) from them.

    In ordinary rooms this is the centre of the largest inscribed circle, to a centimetre. In a floor narrower than a
    twentieth of its extent it is any point inside. The time is bounded for any shape.
    """
    shapely.prepare(floor)
    x_min, y_min, x_max, y_max = floor.bounds
    middle, half = np.array([x_min + x_max, y_min + y_max]) / 2.0, np.array([x_max - x_min, y_max - y_min]) / 2.0
    # A start for floors narrower than the lattice spacing.
    start = floor.representative_point()
    best, distance_m = _farthest(floor, np.array([[start.x, start.y]]), middle + half * _cell_centres(_LATTICE))
    half = half / _LATTICE
    for _ in range(_ROUNDS):
        # Twice as wide as the cell of the best point: a better one can lie beyond its edge.
        half = 2.0 * half
        best, distance_m = _farthest(floor, best[None], best + half * _cell_centres(_FINER_LATTICE))
        half = half / _FINER_LATTICE
    return best, distance_m


def _cell_centres(count: int) -> Float[np.ndarray, "n 2"]:
    """Return the cell centres of the square from -1 to 1, cut into `count` x `count` cells."""
    steps = (2.0 * np.arange(count) + 1.0) / count - 1.0
    return np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)


def _farthest(
    floor: BaseGeometry, inside: Float[np.ndarray, "1 2"], points: Float[np.ndarray, "n 2"]
) -> tuple[Float[np.ndarray, "2"], float]:
    """Return the point on the floor that is farthest from its edges, and that distance; `inside` is on the floor."""
    points = np.concatenate([inside, points[shapely.contains_xy(floor, points[:, 0], points[:, 1])]])
    distance_m = np.asarray(shapely.distance(shapely.points(points), floor.boundary))
    chosen = int(distance_m.argmax())
    return points[chosen], float(distance_m[chosen])


def check_size(rooms: Sequence[Room], limits: PlanLimits) -> None:
    """Refuse a plan that is too large, such as one drawn in millimetres."""
    corners = np.concatenate([room.polygon_m for room in rooms])
    extent = float(np.ptp(corners, axis=0).max())
    if extent > limits.max_extent_m:
        raise InvalidFloorPlanError(
            f"the plan is {extent:.6g} m across; the limit is {limits.max_extent_m:g} m (max_extent_m); "
            "check that the coordinates are in metres"
        )
    area_m2 = sum(room.area_m2 for room in rooms)
    if area_m2 > limits.max_area_m2:
        raise InvalidFloorPlanError(
            f"the floor area is {area_m2:.6g} m²; the limit is {limits.max_area_m2:g} m² (max_area_m2); "
            "check that the coordinates are in metres"
        )
    boxes_m2 = sum(float(np.prod(np.ptp(room.polygon_m, axis=0))) for room in rooms)
    if boxes_m2 > limits.max_bounds_area_m2:
        raise InvalidFloorPlanError(
            f"the bounding boxes of all rooms cover {boxes_m2:.6g} m²; the limit is {limits.max_bounds_area_m2:g} m² "
            "(max_bounds_area_m2)"
        )


def overlap_warnings(rooms: Sequence[Room], limits: PlanLimits) -> tuple[str, ...]:
    """Return a warning for each of the first twenty pairs of rooms that overlap, within a bounded amount of work."""
    shapes = [room.shape for room in rooms]
    pairs = _near_pairs(shapes)
    warnings: list[str] = []

    @cache
    def wall_tree(room: int) -> shapely.STRtree:
        return shapely.STRtree([shapely.LineString(wall) for wall in rooms[room].walls_m.reshape(-1, 2, 2)])

    def crossings(first: int, second: int) -> int:
        """Estimate the cost of intersecting two rooms: their walls, and wall pairs whose bounding boxes meet."""
        met = wall_tree(first).query(wall_tree(second).geometries).shape[1]
        return len(rooms[first].walls_m) + len(rooms[second].walls_m) + met

    work, is_complete = 0, len(pairs) <= _MAX_PAIRS
    for i, j in pairs[:_MAX_PAIRS]:
        if len(warnings) == _MAX_OVERLAPS:
            is_complete = False
            break
        # Pairs of simple rooms are always tested.
        if len(rooms[i].walls_m) * len(rooms[j].walls_m) > _FEW:
            # Counting is work too, so it stops above the limit.
            work += crossings(i, j) if work <= _MAX_WORK else 0
            if work > _MAX_WORK:
                is_complete = False
                continue
        shared = float(shapely.intersection(shapes[i], shapes[j]).area)
        if shared > limits.overlap_tolerance_m2:
            warnings.append(f"rooms '{rooms[i].name}' and '{rooms[j].name}' overlap by {shared:.2f} m²")
    if not is_complete:
        warnings.append("more rooms may overlap; the remaining pairs were not checked")
    return tuple(warnings)


def _near_pairs(shapes: Sequence[shapely.Polygon]) -> list[tuple[int, int]]:
    """Return the pairs of rooms whose bounding boxes meet, in order, and none after the first `_MAX_PAIRS + 1`."""
    tree = shapely.STRtree(shapes)
    pairs: list[tuple[int, int]] = []
    for number, shape in enumerate(shapes):
        pairs += [(number, other) for other in np.sort(tree.query(shape)).tolist() if other > number]
        if len(pairs) > _MAX_PAIRS:
            break
    return pairs[: _MAX_PAIRS + 1]
