"""Wall profiles of poses in a plan."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.render.sweep import swept_profiles


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
        dtype: of the result.
    """
    return swept_profiles(position_m, heading, room_index, plan.wall_table, columns, dtype)
