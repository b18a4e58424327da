"""Pose refinement from the search's side: jobs for the refiner, and candidates from its results.

`refinement_job` makes a `RefinementJob` of candidates, the caller has it run, and `refined_candidates` turns the
`RefinementResult` into candidates. `descent_methods.refine_walls` runs jobs by walls, and `latent_refiner.PoseRefiner`
those by latents, in this process or a worker.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from jaxtyping import Bool

from lalaloc_core.bundle import MatchingWeights
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.encode.layout_encoder import LayoutEncoder
from lalaloc_core.localise.match import MatchingConfig, MatchingCost, PlaceCost, layouts_at
from lalaloc_core.localise.query import NO_HINTS, Candidate, Hints, Query
from lalaloc_core.localise.refine.refinement_problem import RefinementJob, RefinementResult
from lalaloc_core.render.sampling import PoseSet


def refinement_job(
    plan: FloorPlan,
    query: Query,
    candidates: list[Candidate],
    camera_height_m: float,
    weights: MatchingWeights,
    matching: MatchingConfig,
) -> RefinementJob:
    """Return the job that refines candidates, each within its own room.

    The refiner compares walls, or latents if the model predicts no walls; other terms do not move poses. An azimuth
    that shows a wall through an opening counts by the probability that the prediction is of the pose's own wall; of two
    predicted modes, the one that the wall fits better is its target.
    """
    rooms = np.array([candidate.room_index for candidate in candidates])
    hypotheses = np.array([candidate.hypothesis for candidate in candidates])
    job = RefinementJob(
        targets=query.latents[hypotheses],
        position_m=np.stack([candidate.position_m for candidate in candidates]),
        heading=np.array([candidate.frame_heading for candidate in candidates]),
        walls_m=plan.room_walls(rooms),
        camera_height_m=np.full(len(rooms), camera_height_m),
        ceiling_height_m=plan.ceiling_heights_m[rooms],
        optimise_heading=not query.heading_known,
        latent_weight=matching.latent_weight,
    )
    if not matching.compares_profiles(query):
        return job
    assert query.profile is not None
    offsets, height = np.array([candidate.height_offset for candidate in candidates]), query.camera_height
    columns = query.profile.log_m.shape[1]
    layouts = layouts_at(plan, PoseSet(job.position_m, rooms), job.heading, columns)
    matching_cost = MatchingCost(plan, query, matching.fine_reach_m, weights, matching)
    wall_shares = matching_cost.wall_shares(layouts, hypotheses, offsets)
    log_profile, precision = matching_cost.nearest_mode(layouts, hypotheses, offsets)
    # The refiner sums over azimuths, the matching cost averages: the height's prior is stiffer by the same factor.
    stiffness = 0.0
    if not (height.is_exact or height.is_unknown):
        stiffness = math.sqrt(0.5 * columns / weights.temperature) / height.log_std
    return replace(
        job,
        log_profile=log_profile,
        precision=precision * np.sqrt(wall_shares),
        height_offset=None if height.is_exact else offsets,
        height_stiffness=stiffness,
        height_bounds=height.bounds,
    )


def refined_candidates(
    plan: FloorPlan,
    encoder: LayoutEncoder,
    query: Query,
    starts: list[Candidate],
    result: RefinementResult,
    matching: MatchingConfig,
    hints: Hints = NO_HINTS,
) -> list[Candidate]:
    """Return candidates at their refined poses, with every term of the matching cost there.

    A candidate that left the region of strict hints stays at its start.
    """
    weights = encoder.manifest.evidence_for(view=query.is_view)
    rooms = np.array([start.room_index for start in starts])
    excluded = ~np.isfinite(hints.penalty(plan, result.position_m, rooms))
    result = _put_back(starts, result, excluded)
    hypotheses = np.array([start.hypothesis for start in starts])
    places = PlaceCost.of(plan, query, hints, weights.temperature, result.position_m, rooms)
    place_cost = np.zeros(len(starts)) if places is None else places.of_pairs(np.arange(len(starts)), hypotheses)
    offsets = result.height_offset
    offsets = np.array([start.height_offset for start in starts]) if offsets is None else offsets
    distance = result.latent_distance
    if distance is None:
        distance = np.array([start.latent_distance for start in starts])
    cost, terms = result.cost, [{} for _ in starts]
    if matching.compares_profiles(query):
        columns = encoder.manifest.profile_columns
        layouts = layouts_at(plan, PoseSet(result.position_m, rooms), result.heading, columns)
        matching_cost = MatchingCost(plan, query, matching.fine_reach_m, weights, matching)
        by_term = matching_cost.terms(layouts, hypotheses, offsets)
        cost = by_term.total(weights)
        if matching.latent_weight:
            cost = cost + matching.latent_weight * distance
        terms = [{name: float(values[k]) for name, values in by_term._asdict().items()} for k in range(len(starts))]
    return [
        replace(
            start,
            x_m=float(result.position_m[k, 0]),
            y_m=float(result.position_m[k, 1]),
            frame_heading=float(result.heading[k]),
            cost=float(cost[k]),
            latent_distance=float(distance[k]),
            height_offset=float(offsets[k]),
            place_cost=float(place_cost[k]),
            terms=terms[k],
            information=None if excluded[k] else result.information[k],
        )
        for k, start in enumerate(starts)
    ]


def _put_back(starts: list[Candidate], result: RefinementResult, excluded: Bool[np.ndarray, "k"]) -> RefinementResult:
    if not excluded.any():
        return result
    own = {
        "position_m": [start.position_m for start in starts],
        "heading": [start.frame_heading for start in starts],
        **{name: [getattr(start, name) for start in starts] for name in ("cost", "latent_distance", "height_offset")},
    }
    back = {}
    for name, values in own.items():
        if (refined := getattr(result, name)) is not None:
            back[name] = np.where(excluded[:, None] if name == "position_m" else excluded, values, refined)
    return replace(result, **back)


def with_latents(
    plan: FloorPlan, encoder: LayoutEncoder, query: Query, candidates: list[Candidate], camera_height_m: float
) -> list[Candidate]:
    """Return candidates with the latent distances at their poses.

    Distances are computed for candidates that were moved by their walls alone, or come from a grid without latents.
    """
    moved = [
        k
        for k, candidate in enumerate(candidates)
        if candidate.information is not None or math.isnan(candidate.latent_distance)
    ]
    if not moved:
        return candidates
    # Views have no latents, and those of layouts are of unit length.
    distance, chosen = np.ones(len(moved)), [candidates[k] for k in moved]
    if query.latents.any():
        rooms = np.array([candidate.room_index for candidate in chosen])
        poses = PoseSet(np.stack([candidate.position_m for candidate in chosen]), rooms)
        heading = np.array([candidate.frame_heading for candidate in chosen])
        latents, _ = encoder.poses(plan, poses, heading, camera_height_m)
        distance = np.linalg.norm(latents - query.latents[[candidate.hypothesis for candidate in chosen]], axis=1)
    completed = list(candidates)
    for row, k in enumerate(moved):
        completed[k] = replace(candidates[k], latent_distance=float(distance[row]))
    return completed
