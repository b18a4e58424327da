"""Coarse retrieval: the poses of the plan's grid that fit a query best (paper, section 4.1)."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from lalaloc_core.conventions import wrap_angle
from lalaloc_core.errors import InvalidHintError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.bundle import MatchingWeights
from lalaloc_core.localise.camera_height import CameraHeight
from lalaloc_core.localise.coarse_pass import PairLimits, likeliest
from lalaloc_core.localise.encoders import Encoders
from lalaloc_core.localise.hints import NO_HINTS, HintName, Hints
from lalaloc_core.localise.matching_cost import MatchingConfig, MatchingCost, latent_distances
from lalaloc_core.localise.poses import Candidate, PoseGrid, Query, grid_candidate
from lalaloc_core.localise.posterior import HEADING_SEPARATION, NEGLIGIBLE, GridCosts
from lalaloc_core.render.sampling import PoseSet, pose_grid

# Pairs of a pose and a hypothesis that are compared in full: so many, and up to so many of those that may be probable.
_MIN_COMPARED, _MAX_COMPARED = 1024, 4096
# Where there are no more than that, all of them, as in a single room.
_ALL_COMPARED = 2560
# Of so many the cost is estimated by the first look, as they share what is probable.
_ESTIMATED = 65_536
# What refinement gains and the first look errs at most: pairs that cost so much more than what is negligible weigh
# nothing.
_MARGIN = 0.35
# The last so many of those compared in full tell how the first look errs about those that were not.
_CALIBRATING = 256
# The best pairs, which are looked at for distinct candidates; more if they hold too few.
_FIRST_RANKED = 1024


def build_grid(
    plan: FloorPlan, encoders: Encoders, *, step_m: float, camera_height_m: float, latents: bool = True
) -> PoseGrid:
    """Sample the plan's pose grid, render every layout and, with `latents`, embed it: dear, and often not needed."""
    poses = pose_grid(plan, step_m)
    if not latents:
        return PoseGrid.without_latents(poses, encoders.rendered(plan, poses), step_m, camera_height_m)
    embedded, profile_m = encoders.poses(plan, poses, np.zeros(len(poses)), camera_height_m)
    return PoseGrid(poses, embedded, profile_m, step_m, camera_height_m)


def grid_costs(
    plan: FloorPlan,
    grid: PoseGrid,
    query: Query,
    weights: MatchingWeights,
    config: MatchingConfig,
    hints: Hints = NO_HINTS,
) -> GridCosts:
    """Costs of the pairs of a pose of the grid and a hypothesis that may be the best, or are probable.

    All pairs get a first look (`coarse_pass.py`), and those that are the best by that are compared in full.

    Raises:
        InvalidHintError: no pose of the grid is left.
        InvalidInputError: latents are compared, and the grid was made without.
    """
    against = _hint_costs(plan, grid, weights, hints)
    if not config.compares_profiles(query):
        distance = latent_distances(grid.known_latents, query.latents)
        return GridCosts.of_all(grid.poses, distance, np.zeros_like(distance), against)
    evidence = MatchingCost(plan, query, config.grid_reach * grid.step_m, weights, config)
    doubted = _hint_costs(plan, grid, weights, hints.doubted) if hints.strict else None
    chosen = _chosen(plan, grid, evidence, weights.temperature, against, doubted)
    pose, hypothesis = np.divmod(chosen.pair, len(query.roll))
    cost, offset = evidence.pairs(grid.layouts(plan), pose[: chosen.compared], hypothesis[: chosen.compared])
    if config.latent_weight:
        latents, targets = grid.known_latents[pose[: len(cost)]], query.latents[hypothesis[: len(cost)]]
        cost += config.latent_weight * np.linalg.norm(latents - targets, axis=1)
    estimated = np.maximum(chosen.estimate + chosen.error(cost, weights.temperature), cost.min())
    cost, offset = np.append(cost, estimated), np.append(offset, np.zeros(len(estimated)))
    return GridCosts(
        poses=grid.poses,
        pose=pose,
        hypothesis=hypothesis,
        cost=cost,
        offset=offset,
        hint_cost=None if against is None else against[pose],
        compared=chosen.compared,
    )


class _Chosen(NamedTuple):
    """What the first look leaves.

    Attributes:
        pair: pose times the number of hypotheses, plus hypothesis: those to be compared in full, then the others.
        compared: how many are to be compared in full.
        seen: what the first ones cost at first look.
        estimate: what the others cost at first look.
    """

    pair: Int[np.ndarray, "m"]
    compared: int
    seen: Float[np.ndarray, "c"]
    estimate: Float[np.ndarray, "e"]

    def error(self, cost: Float[np.ndarray, "c"], temperature: float) -> float:
        """What the first look is to be corrected by, so that what pairs weigh together is right.

        Those that were only just compared in full are most like those that were not.
        """
        if not len(self.estimate):
            return 0.0
        last = slice(max(len(self.seen) - _CALIBRATING, 0), len(self.seen))
        weight = -temperature * (cost[: len(self.seen)][last] - self.seen[last]).astype(np.float64)
        return float(np.log(len(weight)) - np.logaddexp.reduce(weight)) / temperature


def _chosen(
    plan: FloorPlan,
    grid: PoseGrid,
    evidence: MatchingCost,
    temperature: float,
    against: Float[np.ndarray, "n"] | None,
    doubted: Float[np.ndarray, "n"] | None,
) -> _Chosen:
    """The pairs that are worth more than a first look.

    Args:
        against: what hints have against every pose.
        doubted: the same if they were no fences, where they are: what would be the best then is compared as well.
    """
    pairs, nothing = len(grid.poses) * evidence.hypotheses, np.empty(0, np.float32)
    if pairs <= _ALL_COMPARED:
        return _Chosen(np.arange(pairs), pairs, nothing, nothing)
    window = _MARGIN + NEGLIGIBLE / temperature
    binned, room_index = grid.binned(plan), grid.poses.room_index
    wanted = PairLimits(at_most=_ESTIMATED, at_least=_MIN_COMPARED, window=window)
    total, pair = likeliest(binned, evidence, room_index, wanted, against)
    probable = int(np.searchsorted(total, total[0] + window))
    compared = min(max(probable, _MIN_COMPARED), _MAX_COMPARED, len(pair))
    cost = total if against is None else total - against[pair // evidence.hypotheses]
    seen, estimate = cost[:compared], cost[compared:probable]
    first, others = pair[:compared], pair[compared:probable]
    if doubted is not None:
        wanted = PairLimits(at_most=_MIN_COMPARED, at_least=_MIN_COMPARED)
        beyond = likeliest(binned, evidence, room_index, wanted, doubted)[1]
        first = np.append(first, np.setdiff1d(beyond, pair[:probable]))
    return _Chosen(np.append(first, others), len(first), seen, estimate)


def missed_hints(plan: FloorPlan, costs: GridCosts, weights: MatchingWeights, hints: Hints) -> tuple[HintName, ...]:
    """The hints that would not hold where the picture fits best, if they were no fences."""
    doubted = _penalties(plan, costs.poses, weights, hints.doubted)[costs.pose]
    pose = costs.pose[int((costs.cost + doubted)[: costs.compared].argmin())]
    return hints.missed(costs.poses.position_m[pose], int(costs.poses.room_index[pose]))


def _penalties(plan: FloorPlan, poses: PoseSet, weights: MatchingWeights, hints: Hints) -> Float[np.ndarray, "n"]:
    """What hints have against poses, in units of the cost."""
    return hints.penalty(plan, poses.position_m, poses.room_index) / weights.temperature


def _hint_costs(
    plan: FloorPlan, grid: PoseGrid, weights: MatchingWeights, hints: Hints
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


def retrieve(
    costs: GridCosts,
    grid: PoseGrid,
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
    total = costs.total[: costs.compared]
    ranked, ranks = np.argsort(total, kind="stable"), max(_FIRST_RANKED, top_k)
    ranked = ranked[: np.isfinite(total).sum()]
    limit, ceiling = max(limit, top_k), float(total.min()) + margin
    while True:
        pair = ranked[:ranks]
        kept = suppress(
            grid.poses.position_m[costs.pose[pair]],
            total[pair],
            separation_m=separation_m,
            limit=top_k,
            heading=query.roll[costs.hypothesis[pair]],
            ceiling=ceiling,
            limit_below=limit,
        )
        if len(kept) >= top_k or ranks >= len(ranked):
            break
        # On a fine grid the best pairs may all be of a few places.
        ranks *= 4
    return [_candidate(costs, query, grid, int(pair[index])) for index in kept]


def _candidate(costs: GridCosts, query: Query, grid: PoseGrid, pair: int) -> Candidate:
    return grid_candidate(
        grid,
        int(costs.pose[pair]),
        query,
        int(costs.hypothesis[pair]),
        cost=float(costs.cost[pair]),
        height_offset=float(costs.offset[pair]),
        hint_cost=0.0 if costs.hint_cost is None else float(costs.hint_cost[pair]),
    )


def contradicted(
    plan: FloorPlan, grid: PoseGrid, query: Query, weights: MatchingWeights, config: MatchingConfig
) -> bool:
    """Whether the picture fits another heading so much better that the one that was said must be wrong.

    It is wrong with the probability `heading_doubt`, and then may be any of those that can be searched.
    """
    searched = query.searched
    if searched is None or not config.compares_profiles(query) or not config.heading_doubt:
        return False
    doubt = np.log((1.0 - config.heading_doubt) / config.heading_doubt * len(searched.roll)) / weights.temperature
    said = grid_costs(plan, grid, query, weights, config)
    best = int(said.cost[: said.compared].argmin())
    if said.cost[best] <= doubt:
        # Nothing costs less than nothing.
        return False
    # The height that is best at the heading that was said is good enough for a doubt.
    offset = float(said.offset[best])
    height_m = query.camera_height.height_m * float(np.exp(offset))
    exact = replace(searched.scaled(offset), camera_height=CameraHeight(height_m, 0.0))
    any_heading = grid_costs(plan, grid, exact, weights, config)
    return bool(said.cost[best] - any_heading.cost[: any_heading.compared].min() > doubt)


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
            apart |= np.abs(wrap_angle(heading[remaining] - heading[index])) > HEADING_SEPARATION
            apart[0] = False
        remaining = remaining[apart]
    return kept
