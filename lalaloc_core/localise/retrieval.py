"""Coarse retrieval: the poses of the plan's grid that fit a query best (paper, section 4.1)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from lalaloc_core.bundle import EvidenceModel
from lalaloc_core.conventions import wrap_angle
from lalaloc_core.errors import InvalidHintError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.camera_height import CameraHeight
from lalaloc_core.localise.encoders import Encoders
from lalaloc_core.localise.evidence import Evidence, EvidenceConfig, latent_distances
from lalaloc_core.localise.hints import NO_HINTS, HintName, Hints
from lalaloc_core.localise.poses import Candidate, LatentGrid, Query
from lalaloc_core.localise.posterior import TURNED_APART, GridCosts
from lalaloc_core.sampling import PoseSet, pose_grid

# Poses times hypotheses times height offsets that are compared in full; of more, the poses that are best by every
# `_STRIDE`th azimuth.
_MAX_COMPARISONS = 1_000_000
_STRIDE = 4
# The best pairs, which are looked at for distinct candidates; more if they hold too few.
_FIRST_RANKED = 4096


def build_grid(plan: FloorPlan, encoders: Encoders, *, step_m: float, camera_height_m: float) -> LatentGrid:
    """Sample the plan's pose grid, render every layout and embed it."""
    poses = pose_grid(plan, step_m)
    latents, profile_m = encoders.poses(plan, poses, np.zeros(len(poses)), camera_height_m)
    return LatentGrid(poses, latents, profile_m, step_m, camera_height_m)


def grid_costs(
    plan: FloorPlan,
    grid: LatentGrid,
    query: Query,
    weights: EvidenceModel,
    config: EvidenceConfig,
    hints: Hints = NO_HINTS,
) -> GridCosts:
    """Cost of every pose of the grid under every hypothesis; of large grids, of the poses that may be the best.

    Raises:
        InvalidHintError: no pose of the grid is left.
    """
    against = _hint_costs(plan, grid, weights, hints)
    if not config.compares_profiles(query):
        distance = latent_distances(grid.latents, query.latents)
        return GridCosts(grid.poses, np.arange(len(grid.poses)), distance, np.zeros_like(distance), against)
    layouts, index = grid.layouts(plan), np.arange(len(grid.poses))
    reach_m = config.grid_reach * grid.step_m
    comparisons = len(query.roll) * len(query.camera_height.offsets)
    kept = max(_MAX_COMPARISONS // comparisons, _FIRST_RANKED)
    if kept < len(index):
        coarse, _ = Evidence(plan, query, reach_m, weights, config, stride=_STRIDE).costs(layouts)
        index = _shortlist(coarse.min(axis=0), kept, against, _hint_costs(plan, grid, weights, hints.doubted))
        layouts = layouts.rows(index)
    cost, offset = Evidence(plan, query, reach_m, weights, config).costs(layouts)
    if config.latent_weight:
        cost += config.latent_weight * latent_distances(grid.latents[index], query.latents)
    return GridCosts(grid.poses, index, cost, offset, None if against is None else against[index])


def missed_hints(plan: FloorPlan, costs: GridCosts, weights: EvidenceModel, hints: Hints) -> tuple[HintName, ...]:
    """The hints that would not hold where the picture fits best, if they were no fences."""
    doubted = _penalties(plan, costs.poses, weights, hints.doubted)[costs.index]
    pose = costs.index[int((costs.cost + doubted).min(axis=0).argmin())]
    return hints.missed(costs.poses.position_m[pose], int(costs.poses.room_index[pose]))


def _penalties(plan: FloorPlan, poses: PoseSet, weights: EvidenceModel, hints: Hints) -> Float[np.ndarray, "n"]:
    """What hints have against poses, in units of the cost."""
    return hints.penalty(plan, poses.position_m, poses.room_index) / weights.temperature


def _hint_costs(
    plan: FloorPlan, grid: LatentGrid, weights: EvidenceModel, hints: Hints
) -> Float[np.ndarray, "n"] | None:
    if hints.are_none:
        return None
    against = _penalties(plan, grid.poses, weights, hints)
    if np.isfinite(against).any():
        return against
    raise InvalidHintError(
        "strict",
        f"none of the {len(against)} places that are compared, {grid.step_m:g} m apart, is where all hints hold: "
        "allow for more, or leave strict out",
    )


def _shortlist(
    cost: Float[np.ndarray, "n"],
    kept: int,
    against: Float[np.ndarray, "n"] | None,
    doubted: Float[np.ndarray, "n"] | None,
) -> Int[np.ndarray, "m"]:
    """The poses that may be the best, in rising order: by the hints, and if those were no fences."""
    if against is None or doubted is None:
        return np.sort(np.argpartition(cost, kept)[:kept])
    strictly = np.argpartition(cost + against, kept)[:kept]
    return np.union1d(strictly[np.isfinite(against[strictly])], np.argpartition(cost + doubted, kept)[:kept])


def retrieve(
    costs: GridCosts,
    grid: LatentGrid,
    query: Query,
    *,
    top_k: int,
    separation_m: float,
    margin: float = 0.0,
    limit: int = 0,
) -> list[Candidate]:
    """The `top_k` best grid poses, best first, no two closer than `separation_m` and turned alike.

    Args:
        margin, limit: up to `limit` of them where they cost less than this more than the best.
    """
    ranked, ranks = np.argsort(costs.total, axis=None), max(_FIRST_RANKED, top_k)
    ranked = ranked[: np.isfinite(costs.total).sum()]
    limit, ceiling = max(limit, top_k), float(costs.total.min()) + margin
    while True:
        hypothesis, column = np.unravel_index(ranked[:ranks], costs.total.shape)
        pose = costs.index[column]
        kept = suppress(
            grid.poses.position_m[pose],
            costs.total[hypothesis, column],
            separation_m=separation_m,
            limit=top_k,
            heading=query.roll[hypothesis],
            ceiling=ceiling,
            limit_below=limit,
        )
        if len(kept) >= top_k or ranks >= len(ranked):
            break
        # On a fine grid the best pairs may all be of a few places.
        ranks *= 4
    return [_candidate(costs, query, grid, int(hypothesis[index]), int(column[index])) for index in kept]


def _candidate(costs: GridCosts, query: Query, grid: LatentGrid, hypothesis: int, column: int) -> Candidate:
    pose = int(costs.index[column])
    distance = latent_distances(grid.latents[pose][None], query.latents[hypothesis][None])
    return Candidate(
        x_m=float(grid.poses.position_m[pose, 0]),
        y_m=float(grid.poses.position_m[pose, 1]),
        room_index=int(grid.poses.room_index[pose]),
        frame_heading=query.frame_heading,
        hypothesis=hypothesis,
        cost=float(costs.cost[hypothesis, column]),
        latent_distance=float(distance[0, 0]),
        height_offset=float(costs.offset[hypothesis, column]),
        hint_cost=0.0 if costs.hint_cost is None else float(costs.hint_cost[column]),
    )


def contradicted(
    plan: FloorPlan, grid: LatentGrid, query: Query, weights: EvidenceModel, config: EvidenceConfig
) -> bool:
    """Whether the picture fits another heading so much better that the one that was said must be wrong.

    It is wrong with the probability `heading_doubt`, and then may be any of those that can be searched.
    """
    searched = query.searched
    if searched is None or not config.compares_profiles(query) or not config.heading_doubt:
        return False
    layouts, reach_m = grid.layouts(plan), config.grid_reach * grid.step_m
    said, offset = Evidence(plan, query, reach_m, weights, config, stride=_STRIDE).costs(layouts)
    # The height that is best at the heading that was said is good enough for a doubt.
    best = np.unravel_index(said.argmin(), said.shape)
    height_m = query.camera_height.height_m * float(np.exp(offset[best]))
    exact = replace(searched.scaled(float(offset[best])), camera_height=CameraHeight(height_m, 0.0))
    any_heading, _ = Evidence(plan, exact, reach_m, weights, config, stride=_STRIDE).costs(layouts)
    doubt = np.log((1.0 - config.heading_doubt) / config.heading_doubt * len(searched.roll))
    return bool(weights.temperature * (said.min() - any_heading.min()) > doubt)


def suppress(
    position_m: Float[np.ndarray, "n 2"],
    cost: Float[np.ndarray, "n"],
    *,
    separation_m: float,
    limit: int,
    heading: Float[np.ndarray, "n"] | None = None,
    ceiling: float = -np.inf,
    limit_below: int = 0,
) -> list[int]:
    """Non-maximum suppression: indices by rising cost, skipping what lies within `separation_m` of a kept one.

    Args:
        heading: radians; with it, poses at one place are kept if they are turned against each other.
        ceiling, limit_below: as many as `limit_below` are kept of those that cost less than the ceiling.
    """
    remaining: Int[np.ndarray, "m"] = np.argsort(cost, kind="stable")
    kept: list[int] = []
    while len(remaining) and len(kept) < max(limit, limit_below):
        index = int(remaining[0])
        if len(kept) >= limit and not cost[index] < ceiling:
            break
        kept.append(index)
        apart = np.linalg.norm(position_m[remaining] - position_m[index], axis=1) >= separation_m
        if heading is not None:
            apart |= np.abs(wrap_angle(heading[remaining] - heading[index])) > TURNED_APART
            apart[0] = False
        remaining = remaining[apart]
    return kept
