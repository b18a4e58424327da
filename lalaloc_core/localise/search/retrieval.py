"""Retrieval: the poses of the plan's grid that fit a query best (paper, section 4.1).

Vogel disc re-sampling (VDR) compares denser poses around a candidate (sections 4.2 and A.2).
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np
from jaxtyping import Float, Int

from lalaloc_core.bundle import MatchingWeights
from lalaloc_core.conventions import TWO_PI
from lalaloc_core.errors import InvalidHintError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.belief import GridCosts, suppress
from lalaloc_core.localise.belief.posterior import NEGLIGIBLE
from lalaloc_core.localise.encode.layout_encoder import LayoutEncoder
from lalaloc_core.localise.match import MatchingConfig, MatchingCost, PlaceCost, PoseGrid, grid_candidate, layouts_at
from lalaloc_core.localise.match.coarse_pass import likeliest
from lalaloc_core.localise.match.cost_terms import latent_distances
from lalaloc_core.localise.match.pose_grid import SPHERE_AZIMUTHS, VIEW_AZIMUTHS
from lalaloc_core.localise.query import NO_HINTS, CameraHeight, Candidate, HintName, Hints, Query
from lalaloc_core.render.sampling import PoseSet

# Limits of the number of pairs of a pose and a hypothesis that are compared in full, and the most a pose between them.
_MIN_COMPARED, _MANY_COMPARED, _MAX_COMPARED, _PER_POSE = 1024, 2048, 4096, 4
# Up to this number of pairs, as in a single room, all are compared in full.
_ALL_COMPARED = 2560
# Maximum number of pairs whose cost the coarse pass estimates.
_ESTIMATED = 65_536
# Largest gain of refinement plus error of the coarse pass, in units of the cost.
_MARGIN = 0.35
# The last pairs compared in full, which calibrate the coarse pass for the other pairs.
_CALIBRATING = 256
# Best pairs that are searched for distinct candidates at first.
_FIRST_RANKED = 1024
_GOLDEN_RATIO = (1.0 + math.sqrt(5.0)) / 2.0


def grid_costs(
    plan: FloorPlan,
    grid: PoseGrid,
    query: Query,
    weights: MatchingWeights,
    config: MatchingConfig,
    hints: Hints = NO_HINTS,
    *,
    best_only: bool = False,
) -> GridCosts:
    """Return the costs of the best and all probable pairs of a grid pose and a hypothesis.

    The coarse pass (`coarse_pass.py`) excludes most pairs; the rest, or all of few pairs, are compared in full. With
    `best_only`, just the best are, which answers need, but not their probabilities.
    """
    place_cost = _place_cost(plan, grid, query, weights, hints)
    if not config.compares_profiles(query):
        costs = GridCosts.of_all(grid.poses, latent_distances(grid.known_latents, query.latents))
        places = None if place_cost is None else place_cost.of_pairs(costs.pose, costs.hypothesis)
        return replace(costs, place_cost=places)
    matching_cost = MatchingCost(plan, query, config.grid_reach * grid.step_m, weights, config)
    relaxed = _place_cost(plan, grid, query, weights, hints.relaxed) if hints.strict else None
    temperature = weights.temperature
    window = 0.0 if best_only else _MARGIN + NEGLIGIBLE / temperature
    pair, compared, coarse, estimate = _choose(plan, grid, matching_cost, window, place_cost, relaxed)
    pose, hypothesis = np.divmod(pair, len(query.roll))
    cost, offset = matching_cost.pairs(grid.layouts(plan), pose[:compared], hypothesis[:compared])
    if config.latent_weight:
        latents, targets = grid.known_latents[pose[: len(cost)]], query.latents[hypothesis[: len(cost)]]
        cost += config.latent_weight * np.linalg.norm(latents - targets, axis=1)
    error = _coarse_error(cost[: len(coarse)], coarse, temperature) if len(estimate) else 0.0
    estimate = np.maximum(estimate + error, cost.min())
    return GridCosts(
        poses=grid.poses,
        pose=pose,
        hypothesis=hypothesis,
        cost=np.append(cost, estimate),
        offset=np.append(offset, np.zeros(len(estimate))),
        place_cost=None if place_cost is None else place_cost.of_pairs(pose, hypothesis),
        compared=compared,
    )


def _choose(
    plan: FloorPlan,
    grid: PoseGrid,
    matching_cost: MatchingCost,
    window: float,
    place_cost: PlaceCost | None,
    relaxed: PlaceCost | None,
) -> tuple[Int[np.ndarray, "m"], int, Float[np.ndarray, "c"], Float[np.ndarray, "e"]]:
    """Choose the pairs to compare in full and to estimate.

    Pairs that cost `window` more than the best are improbable. `place_cost` is that of hints and fixtures, and
    `relaxed` the same if strict hints were not; the best pairs by that are compared as well.
    """
    pairs, nothing = len(grid.poses) * matching_cost.hypotheses, np.empty(0, np.float32)
    if pairs <= _ALL_COMPARED:
        return np.arange(pairs), pairs, nothing, nothing
    binned = grid.binned(plan, VIEW_AZIMUTHS if matching_cost.is_view else SPHERE_AZIMUTHS)
    compare = partial(likeliest, binned, matching_cost, grid.poses.room_index, at_least=_MIN_COMPARED)
    total, pair = compare(place_cost, at_most=_ESTIMATED if window else _MIN_COMPARED, window=window)
    probable = int(np.searchsorted(total, total[0] + window))
    most = min(max(_PER_POSE * len(grid.poses), _MANY_COMPARED), _MAX_COMPARED)
    compared = min(max(probable, _MIN_COMPARED), most, len(pair))
    cost = total if place_cost is None else total - place_cost.of_pairs(*np.divmod(pair, matching_cost.hypotheses))
    first, others = pair[:compared], pair[compared:probable]
    if relaxed is not None:
        excluded = compare(relaxed, at_most=_MIN_COMPARED)[1]
        first = np.append(first, np.setdiff1d(excluded, pair[:probable]))
    return np.append(first, others), len(first), cost[:compared], cost[compared:probable]


def _coarse_error(cost: Float[np.ndarray, "c"], coarse: Float[np.ndarray, "c"], temperature: float) -> float:
    """Return the correction of estimates that makes their total probability right, by pairs that were compared.

    The last pairs compared in full are the most similar to the estimated ones.
    """
    last = slice(max(len(coarse) - _CALIBRATING, 0), len(coarse))
    weight = -temperature * (cost[last] - coarse[last]).astype(np.float64)
    return float(np.log(len(weight)) - np.logaddexp.reduce(weight)) / temperature


def missed_hints(plan: FloorPlan, costs: GridCosts, weights: MatchingWeights, hints: Hints) -> tuple[HintName, ...]:
    """Return the hints that would not hold at the best place if they were not strict."""
    penalty = hints.relaxed.penalty(plan, costs.poses.position_m, costs.poses.room_index) / weights.temperature
    relaxed = penalty[costs.pose]
    pose = costs.pose[int((costs.cost + relaxed)[: costs.compared].argmin())]
    return hints.missed(costs.poses.position_m[pose], int(costs.poses.room_index[pose]))


def _place_cost(
    plan: FloorPlan, grid: PoseGrid, query: Query, weights: MatchingWeights, hints: Hints
) -> PlaceCost | None:
    poses = grid.poses
    cost = PlaceCost.of(plan, query, hints, weights.temperature, poses.position_m, poses.room_index)
    if cost is None or np.isfinite(cost.hint).any():
        return cost
    raise InvalidHintError(
        "strict",
        f"none of the {len(poses)} grid poses, {grid.step_m:g} m apart, meets all hints: widen them or omit strict",
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
    """Return the `top_k` best grid poses, best first, no two closer than `separation_m` at about one heading.

    Up to `limit` candidates are returned if they cost less than `margin` more than the best.
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
        # On a fine grid the best pairs can all be of a few places.
        ranks *= 4
    return [
        grid_candidate(
            grid,
            int(costs.pose[index]),
            query,
            int(costs.hypothesis[index]),
            cost=float(costs.cost[index]),
            height_offset=float(costs.offset[index]),
            place_cost=0.0 if costs.place_cost is None else float(costs.place_cost[index]),
        )
        for index in pair[kept].tolist()
    ]


def contradicted(
    plan: FloorPlan,
    grid: PoseGrid,
    query: Query,
    weights: MatchingWeights,
    config: MatchingConfig,
    *,
    given: GridCosts | None = None,
) -> bool:
    """Return whether the picture fits another heading so much better that the given one must be wrong.

    `given` are the costs of the grid at the given heading, without hints, if they are known already.

    A given heading is wrong with the probability `heading_doubt`; then every heading that is searched is as likely. It
    is kept where its best place fits as well as right headings do, and where the search fits better by no more than
    beside right headings (`MatchingWeights.usual_cost`, `usual_gain`).
    """
    if query.searched is None or not config.compares_profiles(query) or not config.heading_doubt:
        return False
    given = grid_costs(plan, grid, query, weights, config) if given is None else given
    best = int(given.cost[: given.compared].argmin())
    odds = (1.0 - config.heading_doubt) / config.heading_doubt
    if given.cost[best] <= max(np.log(odds) / weights.temperature, weights.usual_cost):
        return False
    searched = query.searched.value
    doubt = np.log(odds * len(searched.roll)) / weights.temperature
    # Costs are non-negative, so no heading is better by more than the given one's cost.
    if given.cost[best] <= doubt:
        return False
    # One camera height, the best at the given heading, is accurate enough to compare headings.
    offset = float(given.offset[best])
    height_m = query.camera_height.height_m * float(np.exp(offset))
    exact = replace(searched.scaled(offset), camera_height=CameraHeight(height_m, 0.0))
    any_heading = grid_costs(plan, grid, exact, weights, config)
    gain = given.cost[best] - any_heading.cost[: any_heading.compared].min()
    return bool(gain > max(doubt, weights.usual_gain * given.cost[best]))


def vogel_disc(samples: int) -> Float[np.ndarray, "samples 2"]:
    """Return nearly even points on the unit disc: `r_i = sqrt(i / N)`, `θ_i = i 2π (1 - 1/φ)`.

    The paper's appendix prints the angle without its index i, which would put all points on one ray.
    """
    index = np.arange(samples)
    radius = np.sqrt(index / samples)
    angle = index * (TWO_PI * (1.0 - 1.0 / _GOLDEN_RATIO))
    return radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def disc_poses(
    plan: FloorPlan, centre_m: Float[np.ndarray, "2"], *, samples: int, radius_m: float
) -> tuple[PoseSet, Int[np.ndarray, "k"]]:
    """Return the poses of a Vogel disc around a place that lie in rooms, and their numbers on the disc."""
    position = centre_m + radius_m * vogel_disc(samples)
    room_index = plan.room_index_at(position)
    kept = np.flatnonzero(room_index >= 0)
    return PoseSet(position[kept], room_index[kept]), kept


def resample(
    plan: FloorPlan,
    encoder: LayoutEncoder,
    query: Query,
    candidate: Candidate,
    *,
    camera_height_m: float,
    samples: int,
    radius_m: float,
    matching: MatchingConfig | None = None,
    hints: Hints = NO_HINTS,
) -> Candidate:
    """Return the best pose of a Vogel disc around a candidate; the candidate itself if none is better.

    If the heading is searched, the samples also cover the sector of headings of the candidate's hypothesis.
    """
    matching = matching or MatchingConfig()
    weights = encoder.manifest.evidence_for(view=query.is_view)
    disc, number = disc_poses(plan, candidate.position_m, samples=samples, radius_m=radius_m)
    # The candidate comes first, so that it is kept if others cost the same.
    poses = PoseSet(
        np.concatenate([candidate.position_m[None], disc.position_m]),
        np.concatenate([[candidate.room_index], disc.room_index]),
    )
    heading = np.full(len(poses), candidate.frame_heading)
    if not query.heading_known:
        # A second low-discrepancy sequence covers headings and positions together.
        sequence = (number * (math.sqrt(2.0) - 1.0)) % 1.0
        heading[1:] += (sequence - 0.5) * query.sector
    latents: Float[np.ndarray, "n d"] | None = None
    target = query.latents[candidate.hypothesis][None]
    by_walls = matching.compares_profiles(query)
    if not by_walls or matching.latent_weight:
        latents, _ = encoder.poses(plan, poses, heading, camera_height_m)
    offset = np.full(len(poses), candidate.height_offset)
    cost = np.zeros(len(poses)) if latents is None else latent_distances(latents, target)[0]
    if by_walls:
        layouts = layouts_at(plan, poses, heading, encoder.manifest.profile_columns)
        matching_cost = MatchingCost(plan, query, matching.fine_reach_m, weights, matching)
        layout_cost, offsets = matching_cost.costs(layouts, np.array([candidate.hypothesis]))
        cost, offset = layout_cost[0] + matching.latent_weight * cost, offsets[0]
    place_cost = np.zeros(len(poses))
    places = PlaceCost.of(plan, query, hints, weights.temperature, poses.position_m, poses.room_index)
    if places is not None:
        place_cost = places.of_pairs(np.arange(len(poses)), np.array([candidate.hypothesis]))
    index = int((cost + place_cost).argmin())
    chosen = PoseSet(poses.position_m[[index]], poses.room_index[[index]])
    if latents is None:
        # The latent of one pose is cheap, and is reported with the answer.
        latents, _ = encoder.poses(plan, chosen, heading[[index]], camera_height_m)
    else:
        latents = latents[[index]]
    return replace(
        candidate,
        x_m=float(chosen.position_m[0, 0]),
        y_m=float(chosen.position_m[0, 1]),
        room_index=int(chosen.room_index[0]),
        frame_heading=float(heading[index]),
        cost=float(cost[index]),
        latent_distance=float(latent_distances(latents, target)[0, 0]),
        height_offset=float(offset[index]),
        place_cost=float(place_cost[index]),
    )
