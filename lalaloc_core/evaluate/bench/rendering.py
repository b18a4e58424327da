"""What rendering takes: the closed form against the ray-casting oracle, and a plan's latent grid."""

from __future__ import annotations

import numpy as np
import torch

from lalaloc_core.evaluate.bench.homes import home_of_area
from lalaloc_core.evaluate.bench.timing import median_ms
from lalaloc_core.localise.bundle import Bundle
from lalaloc_core.localise.encoders import Encoders
from lalaloc_core.localise.retrieval import build_grid
from lalaloc_core.render.depth import layout_depth
from lalaloc_core.render.profile import wall_profile
from lalaloc_core.render.reference import reference_depth
from lalaloc_core.render.sampling import random_poses

_GRID_STEP_M = 0.5


def bench_rendering(bundle: Bundle, poses: int = 200) -> dict[str, float]:
    """Closed-form layout depth against the ray-casting oracle in the same run, and the grid of a 100 m² home."""
    home = home_of_area(100.0)
    plan = home.plan
    drawn = random_poses(plan, poses, np.random.default_rng(0))
    camera, ceiling = np.full(poses, 1.5), plan.ceiling_heights_m[drawn.room_index]
    arrays = (drawn.position_m, np.zeros(poses), plan.walls_m[drawn.room_index], camera, ceiling)
    position, heading, walls, cameras, ceilings = (torch.tensor(a, dtype=torch.float32) for a in arrays)

    def closed_form() -> None:
        layout_depth(wall_profile(position, heading, walls, 256), cameras, ceilings, 128)

    sample = range(0, poses, poses // 10)

    def oracle() -> None:
        for index in sample:
            room = plan.rooms[drawn.room_index[index]]
            reference_depth(room, drawn.position_m[index], 0.0, 1.5, 128, 256)

    encoders = Encoders(bundle)
    closed_form_ms = median_ms(closed_form) / poses
    oracle_ms = median_ms(oracle, repeats=3) / len(sample)
    grid = build_grid(plan, encoders, step_m=_GRID_STEP_M, camera_height_m=1.5)
    return {
        "layout_depth_128x256_ms_per_pose": closed_form_ms,
        "oracle_128x256_ms_per_pose": oracle_ms,
        "oracle_to_closed_form_ratio": oracle_ms / closed_form_ms,
        "grid_area_m2": plan.area_m2,
        "grid_poses": len(grid.poses),
        "grid_seconds": median_ms(lambda: build_grid(plan, encoders, step_m=_GRID_STEP_M, camera_height_m=1.5)) / 1e3,
    }
