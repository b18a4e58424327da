"""Checks of all rooms of a plan together: total size and overlaps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan.limits import PlanLimits
from lalaloc_core.floorplan.rooms import Room

# The search for overlaps ends after this many found or pairs tested; the number of pairs is quadratic in the rooms.
_MAX_OVERLAPS, _MAX_PAIRS = 20, 5000
# Two combs of two hundred vertices can cross ten thousand times, so the number of wall pairs that can cross is limited
# over all pairs of rooms. Pairs of rooms with fewer wall pairs than `_FEW` are not counted.
_MAX_WORK, _FEW = 100_000, 400


def check_size(rooms: Sequence[Room], limits: PlanLimits) -> None:
    """Refuse a plan that is too large, such as one drawn in millimetres."""
    corners = np.concatenate([room.polygon_m for room in rooms])
    extent = float(np.ptp(corners, axis=0).max())
    if extent > limits.max_extent_m:
        raise InvalidFloorPlanError(
            f"the plan is {extent:.6g} m across; the limit is {limits.max_extent_m:g} m (LALALOC_MAX_EXTENT_M); "
            "check that the coordinates are in metres"
        )
    area_m2 = sum(room.area_m2 for room in rooms)
    if area_m2 > limits.max_area_m2:
        raise InvalidFloorPlanError(
            f"the floor area is {area_m2:.6g} m²; the limit is {limits.max_area_m2:g} m² (LALALOC_MAX_AREA_M2); "
            "check that the coordinates are in metres"
        )
    boxes_m2 = sum(float(np.prod(np.ptp(room.polygon_m, axis=0))) for room in rooms)
    if boxes_m2 > limits.max_bounds_area_m2:
        raise InvalidFloorPlanError(
            f"the bounding boxes of all rooms cover {boxes_m2:.6g} m²; the limit is {limits.max_bounds_area_m2:g} m² "
            "(LALALOC_MAX_BOUNDS_AREA_M2)"
        )


def overlap_warnings(rooms: Sequence[Room], limits: PlanLimits) -> tuple[str, ...]:
    """Return a warning for each of the first twenty pairs of rooms that overlap, within a bounded amount of work."""
    shapes = [room.shape for room in rooms]
    pairs = _near_pairs(shapes)
    crossings = _Crossings(rooms)
    warnings: list[str] = []
    work, is_complete = 0, len(pairs) <= _MAX_PAIRS
    for i, j in pairs[:_MAX_PAIRS]:
        if len(warnings) == _MAX_OVERLAPS:
            is_complete = False
            break
        # Pairs of simple rooms are always tested.
        if len(rooms[i].walls_m) * len(rooms[j].walls_m) > _FEW:
            # Counting is work too, so it stops above the limit.
            work += crossings.between(i, j) if work <= _MAX_WORK else 0
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


class _Crossings:
    """Counter of wall pairs whose bounding boxes meet: an estimate of the cost of intersecting two rooms."""

    def __init__(self, rooms: Sequence[Room]) -> None:
        self._rooms = rooms
        self._trees: dict[int, shapely.STRtree] = {}

    def between(self, first: int, second: int) -> int:
        pairs = self._tree(first).query(self._tree(second).geometries).shape[1]
        return len(self._rooms[first].walls_m) + len(self._rooms[second].walls_m) + pairs

    def _tree(self, room: int) -> shapely.STRtree:
        if room not in self._trees:
            ends = self._rooms[room].walls_m.reshape(-1, 2, 2)
            self._trees[room] = shapely.STRtree([shapely.LineString(wall) for wall in ends])
        return self._trees[room]
