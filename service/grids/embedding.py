"""Computes a latent grid in chunks, and says how large it will be."""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter

import numpy as np

from lalaloc_core.errors import InvalidPoseError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.encoders import Encoders
from lalaloc_core.localise.poses import LatentGrid
from lalaloc_core.sampling import PoseSet, grid_size, pose_grid
from service.errors import PlanTooLargeError
from service.settings import Settings

# Rays times walls that are cast at once: bounds the memory of a plan with rooms of many corners.
_CAST_AT_ONCE = 2_000_000
_MAX_CHUNK, _MIN_CHUNK = 256, 8


def embed(
    plan: FloorPlan,
    encoders: Encoders,
    *,
    step_m: float,
    camera_height_m: float,
    after_chunk: Callable[[float, float], None],
) -> LatentGrid:
    """Sample, render and embed the grid of a plan.

    Args:
        after_chunk: called with the share that is done (0 to 1) and the seconds that the last chunk took, and with 0
            when the poses of another room are found; what it raises ends the work.

    Raises:
        InvalidPoseError: the networks have no latents for this plan at this camera height.
    """
    poses = pose_grid(plan, step_m, after_room=lambda: after_chunk(0.0, 0.0))
    rays = encoders.manifest.profile_columns * plan.walls_m.shape[1]
    chunk = min(max(_CAST_AT_ONCE // rays, _MIN_CHUNK), _MAX_CHUNK)
    latents, profiles_m = [], []
    for first in range(0, len(poses), chunk):
        begin = perf_counter()
        part = PoseSet(poses.position_m[first : first + chunk], poses.room_index[first : first + chunk])
        latent, profile_m = encoders.poses(plan, part, np.zeros(len(part)), camera_height_m)
        if not (np.isfinite(latent).all() and np.isfinite(profile_m).all()):
            raise InvalidPoseError(f"the model has no latents at camera_height_m {camera_height_m:g}")
        latents.append(latent.astype(np.float32, copy=False))
        profiles_m.append(profile_m.astype(np.float32, copy=False))
        after_chunk(min(first + chunk, len(poses)) / len(poses), perf_counter() - begin)
    return LatentGrid(poses, np.concatenate(latents), np.concatenate(profiles_m), step_m, camera_height_m)


def check_size(plan: FloorPlan, settings: Settings) -> None:
    """Refuse a plan whose grid would be too large.

    Raises:
        PlanTooLargeError: states the estimated number of poses and the limit.
    """
    estimate = grid_size(plan, settings.grid_step_m)
    if estimate > settings.max_grid_poses:
        raise PlanTooLargeError(estimate, settings.max_grid_poses, settings.grid_step_m)


def grid_bytes(grid: LatentGrid) -> int:
    """The memory that a grid takes."""
    arrays = (grid.latents, grid.profile_m, grid.poses.position_m, grid.poses.room_index)
    return sum(array.nbytes for array in arrays)
