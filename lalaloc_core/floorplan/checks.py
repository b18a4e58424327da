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


def overlap_warnings(rooms: Sequence[Room], limits: PlanLimits) -> tuple[str, ...]:
    """Pairs of rooms that share floor, the first twenty of them."""
    shapes = [room.shape for room in rooms]
    # Whose boxes meet; whether the rooms themselves do is asked of each pair, and of not too many.
    first, second = shapely.STRtree(shapes).query(shapes)
    pairs = sorted((int(i), int(j)) for i, j in zip(first, second, strict=True) if i < j)
    warnings: list[str] = []
    for looked_at, (i, j) in enumerate(pairs):
        if len(warnings) == _MAX_OVERLAPS or looked_at == _MAX_PAIRS:
            warnings.append("more rooms may overlap, the rest was not looked at")
            break
        shared = float(shapely.intersection(shapes[i], shapes[j]).area)
        if shared > limits.overlap_tolerance_m2:
            warnings.append(f"rooms '{rooms[i].name}' and '{rooms[j].name}' overlap by {shared:.2f} m²")
    return tuple(warnings)
