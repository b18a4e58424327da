"""Coarse retrieval: nearest latents in the plan's grid (paper, section 4.1)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.encoders import Encoders
from lalaloc_core.localise.poses import Candidate, LatentGrid, Query
from lalaloc_core.sampling import pose_grid


def build_grid(plan: FloorPlan, encoders: Encoders, *, step_m: float, camera_height_m: float) -> LatentGrid:
    """Sample the plan's pose grid, render every layout and embed it."""
    poses = pose_grid(plan, step_m)
    latents = encoders.poses(plan, poses, np.zeros(len(poses)), camera_height_m)
    return LatentGrid(poses, latents, step_m, camera_height_m)


def latent_distances(latents: Float[np.ndarray, "n d"], targets: Float[np.ndarray, "k d"]) -> Float[np.ndarray, "k n"]:
    """Euclidean distance of each target to each latent, both of unit length."""
    return np.sqrt(np.maximum(2.0 - 2.0 * (targets @ latents.T), 0.0))


def retrieve(grid: LatentGrid, query: Query, *, top_k: int, separation_m: float) -> list[Candidate]:
    """The `top_k` best grid poses, best first, no two closer than `separation_m`.

    Every pose is taken at its best heading hypothesis, so candidates are distinct places.
    """
    distances = latent_distances(grid.latents, query.latents)
    hypothesis = distances.argmin(axis=0)
    best = distances[hypothesis, np.arange(len(hypothesis))]
    kept = suppress(grid.poses.position_m, best, separation_m=separation_m, limit=top_k)
    return [
        Candidate(
            x_m=float(grid.poses.position_m[index, 0]),
            y_m=float(grid.poses.position_m[index, 1]),
            room_index=int(grid.poses.room_index[index]),
            frame_heading=query.frame_heading,
            hypothesis=int(hypothesis[index]),
            latent_distance=float(best[index]),
        )
        for index in kept
    ]


def suppress(
    position_m: Float[np.ndarray, "n 2"], distance: Float[np.ndarray, "n"], *, separation_m: float, limit: int
) -> list[int]:
    """Non-maximum suppression: indices by rising distance, skipping what lies within `separation_m` of a kept one."""
    remaining: Int[np.ndarray, "m"] = np.argsort(distance, kind="stable")
    kept: list[int] = []
    while len(remaining) and len(kept) < limit:
        index = int(remaining[0])
        kept.append(index)
        apart = np.linalg.norm(position_m[remaining] - position_m[index], axis=1) >= separation_m
        remaining = remaining[apart]
    return kept
