"""Computation of a pose grid in chunks, and estimates of its size."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace

import numpy as np

from lalaloc_core.errors import InvalidPoseError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.match import PoseGrid
from lalaloc_core.localise.match.pose_grid import joined_layouts, layouts_of_plans
from lalaloc_core.render.sampling import PoseSet, grid_size, pose_grid
from service.errors import PlanTooLargeError
from service.settings import Settings
from service.storage.grid_format import SortedPrototypes
from service.storage.records import millimetres

# Poses per chunk, for models with wall profiles and for models with latents; queries go first between chunks.
RENDERED, _EMBEDDED = 256, 128
# Poses of small plans that are rendered together.
_TOGETHER = 512
# Memory that queries add at first use. Per azimuth: the log distance, in half precision without latents, and a code.
# Per pose: views through openings, and arrays of the coarse pass.
_BYTES_PER_COLUMN, _BYTES_PER_POSE = 3, 400


def embed(
    plan: FloorPlan,
    encoders: PhotographEncoder,
    *,
    step_m: float,
    camera_height_m: float,
    computing: Callable[[], AbstractContextManager[None]] = nullcontext,
    after_room: Callable[[], None] = lambda: None,
    after_chunk: Callable[[float], None] = lambda _progress: None,
) -> PoseGrid:
    """Sample and render the poses of a plan, and embed them if the model compares latents.

    `computing` is entered for the sampling and for each chunk, so that queries take turns with them. `after_room` is
    called after each room of the sampling, and `after_chunk` with the share done (0 to 1), without a core; an error
    that either raises ends the work.
    """
    with computing():
        poses = pose_grid(plan, step_m, after_room)
    chunk = RENDERED if encoders.predicts_profile else _EMBEDDED
    layouts, latents = [], []
    for first in range(0, len(poses), chunk):
        part = PoseSet(poses.position_m[first : first + chunk], poses.room_index[first : first + chunk])
        with computing():
            seen = encoders.layouts.rendered(plan, part)
            layouts.append(seen)
            is_finite = bool(np.isfinite(seen.log_profile).all())
            if not encoders.predicts_profile:
                heights = np.full(len(part), camera_height_m)
                latent = encoders.layouts.latents(
                    np.exp(seen.log_profile), heights, plan.ceiling_heights_m[part.room_index]
                )
                latents.append(latent.astype(np.float32, copy=False))
                is_finite &= bool(np.isfinite(latent).all())
        if not is_finite:
            raise InvalidPoseError(f"the model has no latents at camera_height_m {camera_height_m:g}")
        after_chunk(min(first + chunk, len(poses)) / len(poses))
    with computing():
        whole = joined_layouts(layouts, poses.room_index)
        if not latents:
            return PoseGrid.without_latents(poses, whole, step_m, camera_height_m)
        profile_m = np.exp(whole.log_profile)
        return PoseGrid(poses, np.concatenate(latents), profile_m, step_m, camera_height_m, whole)


def embed_small(
    plans: Sequence[FloorPlan],
    encoders: PhotographEncoder,
    *,
    step_m: float,
    computing: Callable[[], AbstractContextManager[None]],
) -> Iterator[list[tuple[PoseGrid, SortedPrototypes]]]:
    """Make the own grids of small plans and their prototypes as `embed` does, and yield those of some plans at a time.

    The networks predict wall profiles. `computing` is entered for at most about `_TOGETHER` poses at a time.
    """
    begin, poses = 0, np.cumsum([grid_size(plan, step_m) for plan in plans])
    while begin < len(plans):
        past = int(poses[begin - 1]) if begin else 0
        end = max(begin + 1, int(np.searchsorted(poses, past + _TOGETHER, side="right")))
        part, begin = plans[begin:end], end
        with computing():
            sampled = [pose_grid(plan, step_m) for plan in part]
            layouts = layouts_of_plans(part, sampled, encoders.manifest.profile_columns)
            grids = [
                PoseGrid.without_latents(poses, seen, step_m, millimetres(plan.camera_height_m) / 1000.0)
                for plan, poses, seen in zip(part, sampled, layouts, strict=True)
            ]
            prototypes = SortedPrototypes.of_grids(grids, part)
            # Without layouts, which take most of the memory; queries render them.
            grids = [replace(grid) for grid in grids]
        yield list(zip(grids, prototypes, strict=True))


def check_size(plan: FloorPlan, settings: Settings, level: str | None = None) -> None:
    """Check the estimated number of poses of a plan; the error names its level."""
    estimate = grid_size(plan, settings.grids.grid_step_m)
    if estimate > settings.grids.max_grid_poses:
        raise PlanTooLargeError(estimate, settings.grids.max_grid_poses, settings.grids.grid_step_m, level)


def grid_bytes(grid: PoseGrid) -> int:
    """Return the memory of a grid, including the arrays that queries derive from it."""
    arrays = (grid.latents, grid.profile_m, grid.poses.position_m, grid.poses.room_index)
    stored = sum(array.nbytes for array in arrays if array is not None)
    return stored + len(grid.poses) * (_BYTES_PER_COLUMN * grid.profile_m.shape[1] + _BYTES_PER_POSE)
