"""What only all rooms of a plan together can break: its size, and rooms that overlap."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan.limits import PlanLimits
from lalaloc_core.floorplan.rooms import Room

# Looking for overlaps ends after so many found, or so many pairs looked at: their number grows with the square.
_MAX_OVERLAPS, _MAX_PAIRS = 20, 5000
# Two combs of two hundred corners may cross ten thousand times: what is looked at is bounded by pairs of walls that may
# cross, over all pairs of rooms. Counting them is not worth it where there are few.
_MAX_WORK, _FEW = 100_000, 400


def check_size(rooms: Sequence[Room], limits: PlanLimits) -> None:
    """Refuse a plan that is too large, as one drawn in millimetres is.

    Raises:
        InvalidFloorPlanError: it is.
    """
    corners = np.concatenate([room.polygon_m for room in rooms])
    extent = float(np.ptp(corners, axis=0).max())
    if extent > limits.max_extent_m:
        raise InvalidFloorPlanError(
            f"the plan is {extent:.6g} m across, at most {limits.max_extent_m:g} m is allowed (max_extent_m); "
            "are the coordinates in metres?"
        )
    area_m2 = sum(room.area_m2 for room in rooms)
    if area_m2 > limits.max_area_m2:
        raise InvalidFloorPlanError(
            f"the floor area is {area_m2:.6g} m², at most {limits.max_area_m2:g} m² is allowed (max_area_m2); "
            "are the coordinates in metres?"
        )
    boxes_m2 = sum(float(np.prod(np.ptp(room.polygon_m, axis=0))) for room in rooms)
    if boxes_m2 > limits.max_bounds_area_m2:
        raise InvalidFloorPlanError(
            f"the boxes around all rooms cover {boxes_m2:.6g} m², at most {limits.max_bounds_area_m2:g} m² is allowed "
            "(max_bounds_area_m2)"
        )


def overlap_warnings(rooms: Sequence[Room], limits: PlanLimits) -> tuple[str, ...]:
    """Pairs of rooms that share floor, the first twenty of them, and of pairs that are worth their work only."""
    shapes = [room.shape for room in rooms]
    # Whose boxes meet; whether the rooms themselves do is asked of each pair, and of not too many.
    first, second = shapely.STRtree(shapes).query(shapes)
    pairs = sorted((int(i), int(j)) for i, j in zip(first, second, strict=True) if i < j)
    crossings = _Crossings(rooms)
    warnings: list[str] = []
    work, is_complete = 0, len(pairs) <= _MAX_PAIRS
    for i, j in pairs[:_MAX_PAIRS]:
        if len(warnings) == _MAX_OVERLAPS:
            is_complete = False
            break
        # Pairs of simple rooms are always looked at, whatever stands beside them.
        if len(rooms[i].walls_m) * len(rooms[j].walls_m) > _FEW:
            # Counting is work as well: once there was too much of it, it ends.
            work += crossings.between(i, j) if work <= _MAX_WORK else 0
            if work > _MAX_WORK:
                is_complete = False
                continue
        shared = float(shapely.intersection(shapes[i], shapes[j]).area)
        if shared > limits.overlap_tolerance_m2:
            warnings.append(f"rooms '{rooms[i].name}' and '{rooms[j].name}' overlap by {shared:.2f} m²")
    if not is_complete:
        warnings.append("more rooms may overlap, the rest was not looked at")
    return tuple(warnings)


class _Crossings:
    """Counts pairs of walls whose boxes meet: what the intersection of two rooms costs, without computing it."""

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
