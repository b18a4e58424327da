"""Coarse retrieval: the poses of the plan's grid that fit a query best (paper, section 4.1)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from lalaloc_core.conventions import wrap_angle
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.encoders import Encoders
from lalaloc_core.localise.evidence import EvidenceConfig, latent_distances, profile_costs, targets
from lalaloc_core.localise.poses import Candidate, LatentGrid, Query
from lalaloc_core.sampling import pose_grid

# Poses times hypotheses whose profiles are compared; of larger grids, the poses with the nearest latents.
_MAX_PAIRS = 200_000
# The best pairs, which are looked at for distinct candidates; more if they hold too few.
_FIRST_RANKED = 4096
# Two candidates at one place are distinct if they are turned against each other by this much (radians).
_SEPARATION = np.radians(25.0)


def build_grid(plan: FloorPlan, encoders: Encoders, *, step_m: float, camera_height_m: float) -> LatentGrid:
    """Sample the plan's pose grid, render every layout and embed it."""
    poses = pose_grid(plan, step_m)
    latents, profile_m = encoders.poses(plan, poses, np.zeros(len(poses)), camera_height_m)
    return LatentGrid(poses, latents, profile_m, step_m, camera_height_m)


def retrieve(
    grid: LatentGrid, query: Query, *, top_k: int, separation_m: float, evidence: EvidenceConfig | None = None
) -> list[Candidate]:
    """The `top_k` best grid poses, best first, no two closer than `separation_m` and turned alike."""
    evidence = evidence or EvidenceConfig()
    distance = latent_distances(grid.latents, query.latents)
    hypotheses = len(query.roll)
    poses = np.arange(len(grid.poses))
    cost = distance
    if evidence.compares_profiles(query):
        if hypotheses * len(poses) > _MAX_PAIRS:
            most = max(_MAX_PAIRS // hypotheses, top_k)
            poses = np.argpartition(distance.min(axis=0), most)[:most] if most < len(poses) else poses
        log_profile = np.log(grid.profile_m[poses])
        centre, precision = targets(query, np.arange(hypotheses), evidence.grid_reach * grid.step_m, evidence)
        cost = np.stack([profile_costs(log_profile, *one) for one in zip(centre, precision, strict=True)])
        cost += evidence.latent_weight * distance[:, poses]
    ranked, ranks = np.argsort(cost, axis=None), max(_FIRST_RANKED, top_k)
    while True:
        hypothesis, column = np.unravel_index(ranked[:ranks], cost.shape)
        pose = poses[column]
        kept = suppress(
            grid.poses.position_m[pose],
            cost[hypothesis, column],
            separation_m=separation_m,
            limit=top_k,
            heading=query.roll[hypothesis],
        )
        if len(kept) == top_k or ranks >= len(ranked):
            break
        # On a fine grid the best pairs may all be of a few places.
        ranks *= 4
    return [
        Candidate(
            x_m=float(grid.poses.position_m[pose[index], 0]),
            y_m=float(grid.poses.position_m[pose[index], 1]),
            room_index=int(grid.poses.room_index[pose[index]]),
            frame_heading=query.frame_heading,
            hypothesis=int(hypothesis[index]),
            cost=float(cost[hypothesis[index], column[index]]),
            latent_distance=float(distance[hypothesis[index], pose[index]]),
        )
        for index in kept
    ]


def suppress(
    position_m: Float[np.ndarray, "n 2"],
    cost: Float[np.ndarray, "n"],
    *,
    separation_m: float,
    limit: int,
    heading: Float[np.ndarray, "n"] | None = None,
) -> list[int]:
    """Non-maximum suppression: indices by rising cost, skipping what lies within `separation_m` of a kept one.

    Args:
        heading: radians; with it, poses at one place are kept if they are turned against each other.
    """
    remaining: Int[np.ndarray, "m"] = np.argsort(cost, kind="stable")
    kept: list[int] = []
    while len(remaining) and len(kept) < limit:
        index = int(remaining[0])
        kept.append(index)
        apart = np.linalg.norm(position_m[remaining] - position_m[index], axis=1) >= separation_m
        if heading is not None:
            apart |= np.abs(wrap_angle(heading[remaining] - heading[index])) > _SEPARATION
            apart[0] = False
        remaining = remaining[apart]
    return kept
