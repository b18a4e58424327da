"""Vogel disc re-sampling (VDR): compare denser poses around a candidate (paper, sections 4.2 and A.2)."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from lalaloc_core.conventions import TWO_PI
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.encode.layout_encoder import LayoutEncoder
from lalaloc_core.localise.match import MatchingConfig, MatchingCost, PlaceCost, layouts_at
from lalaloc_core.localise.match.cost_terms import latent_distances
from lalaloc_core.localise.query import NO_HINTS, Candidate, Hints, Query
from lalaloc_core.render.sampling import PoseSet

_GOLDEN_RATIO = (1.0 + math.sqrt(5.0)) / 2.0


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
