"""Computes a latent grid in chunks, and says how large it will be."""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter

import numpy as np

from lalaloc_core.errors import InvalidPoseError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.encoders import Encoders
from lalaloc_core.localise.layouts import joined_layouts
from lalaloc_core.localise.poses import PoseGrid
from lalaloc_core.render.sampling import PoseSet, grid_size, pose_grid
from service.errors import PlanTooLargeError
from service.settings import Settings

# Poses between two of which queries go first; networks embed fewer at a time than are rendered.
_RENDERED, _EMBEDDED = 256, 128
# What queries make of a pose at first use: for every azimuth its log distance, in half precision where there are no
# latents, and a code; what is seen through openings; and what the first look sees.
_BYTES_PER_COLUMN, _BYTES_PER_POSE = 3, 400


def embed(
    plan: FloorPlan,
    encoders: Encoders,
    *,
    step_m: float,
    camera_height_m: float,
    after_chunk: Callable[[float, float], None],
) -> PoseGrid:
    """Sample and render the grid of a plan, and embed it where the model compares poses by their latents.

    Args:
        after_chunk: called with the share that is done (0 to 1) and the seconds that the last chunk took, and with 0
            when the poses of another room are found; what it raises ends the work.

    Raises:
        InvalidPoseError: the networks have no latents for this plan at this camera height.
    """
    poses = pose_grid(plan, step_m, after_room=lambda: after_chunk(0.0, 0.0))
    chunk = _RENDERED if encoders.predicts_profile else _EMBEDDED
    layouts, latents = [], []
    for first in range(0, len(poses), chunk):
        begin = perf_counter()
        part = PoseSet(poses.position_m[first : first + chunk], poses.room_index[first : first + chunk])
        seen = encoders.rendered(plan, part)
        layouts.append(seen)
        is_finite = bool(np.isfinite(seen.log_profile).all())
        if not encoders.predicts_profile:
            heights = np.full(len(part), camera_height_m)
            latent = encoders.layouts(np.exp(seen.log_profile), heights, plan.ceiling_heights_m[part.room_index])
            latents.append(latent.astype(np.float32, copy=False))
            is_finite &= bool(np.isfinite(latent).all())
        if not is_finite:
            raise InvalidPoseError(f"the model has no latents at camera_height_m {camera_height_m:g}")
        after_chunk(min(first + chunk, len(poses)) / len(poses), perf_counter() - begin)
    whole = joined_layouts(layouts, poses.room_index)
    if not latents:
        return PoseGrid.without_latents(poses, whole, step_m, camera_height_m)
    profile_m = np.exp(whole.log_profile)
    return PoseGrid.with_layouts(poses, np.concatenate(latents), profile_m, step_m, camera_height_m, whole)


def check_size(plan: FloorPlan, settings: Settings) -> None:
    """Refuse a plan whose grid would be too large.

    Raises:
        PlanTooLargeError: states the estimated number of poses and the limit.
    """
    estimate = grid_size(plan, settings.grids.grid_step_m)
    if estimate > settings.grids.max_grid_poses:
        raise PlanTooLargeError(estimate, settings.grids.max_grid_poses, settings.grids.grid_step_m)


def grid_bytes(grid: PoseGrid) -> int:
    """The memory that a grid takes, with what queries make of it."""
    arrays = (grid.latents, grid.profile_m, grid.poses.position_m, grid.poses.room_index)
    stored = sum(array.nbytes for array in arrays if array is not None)
    return stored + len(grid.poses) * (_BYTES_PER_COLUMN * grid.profile_m.shape[1] + _BYTES_PER_POSE)
