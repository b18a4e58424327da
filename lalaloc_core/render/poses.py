"""Wall profiles of poses in a plan."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.render.profile import wall_profile

_FAR_OUT_M = 1000.0


def profiles_at(
    plan: FloorPlan,
    position_m: Float[np.ndarray, "n 2"],
    room_index: Int[np.ndarray, "n"],
    heading: Float[np.ndarray, "n"],
    columns: int,
    dtype: type[np.floating] = np.float64,
) -> Float[np.ndarray, "n {columns}"]:
    """Wall profiles (m) of poses, each within its own room.

    Args:
        heading: azimuth of the centre column, radians.
        dtype: single precision is enough for networks, and twice as fast.
    """
    origin_m = _origin_m(plan)
    walls_m = plan.walls_m[room_index] - np.tile(origin_m, 2)
    return wall_profile((position_m - origin_m).astype(dtype), heading.astype(dtype), walls_m.astype(dtype), columns)


def _origin_m(plan: FloorPlan) -> Float[np.ndarray, "2"]:
    """What to count coordinates from: a place in a plan that lies far out, as surveyed ones do, in whole metres.

    A hundred kilometres from the origin single precision tells centimetres apart, at ten thousand only metres.
    """
    x_min, y_min, x_max, y_max = plan.bounds_m
    if max(abs(x_min), abs(y_min), abs(x_max), abs(y_max)) < _FAR_OUT_M:
        return np.zeros(2)
    return np.rint([x_min, y_min])
