"""Evidence of one photograph alone: its best states, and how well it fits each room."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from lalaloc_core.bundle import MatchingWeights
from lalaloc_core.conventions import ROOM_TYPES
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.album.binned_ground import BinnedGround
from lalaloc_core.localise.album.comparison import Comparison
from lalaloc_core.localise.album.memory import Arrays
from lalaloc_core.localise.encode.photograph_encoder import PhotographEncoder
from lalaloc_core.localise.match import MatchingConfig, PlaceCost, PoseGrid, layouts_at
from lalaloc_core.localise.match.cost_terms import ceiling_costs, room_type_losses
from lalaloc_core.localise.query import NO_HINTS, CameraHeight, Query
from lalaloc_core.photograph import Photograph
from lalaloc_core.render.sampling import PoseSet, grid_size, pose_grid

# Finer grid for plans of at most so many poses, and the distance (m) within which its best pose counts as exact:
# single photographs name the right room more often than with the grid of queries.
FINE_STEP_M, _FINE_REACH_M, _MAX_FINE = 0.25, 0.08, 8000
# Logs of true over usual camera height that are tried, and the height (m) that people hold cameras at.
OFFSETS = np.linspace(-0.36, 0.36, 9)
USUAL_HEIGHT_M, USUAL_LOG_SD = 1.5, 0.15
# States that are kept: of every room, at least so many, and of all.
_PER_ROOM, _MAX_STATES = 96, 8192
# Every so many of the poses of other homes are compared: about as many as a home has.
_EVERY = 4
_CONFIG = MatchingConfig()


@dataclass(frozen=True, eq=False)
class SearchedPlan:
    """The plan of an album as photographs are compared with it.

    Attributes:
        poses: its poses.
        reach_m: distance (m) from the camera within which the best pose is.
    """

    plan: FloorPlan
    poses: PoseSet
    reach_m: float
    binned: BinnedGround

    @classmethod
    def of(cls, plan: FloorPlan, grid: PoseGrid, columns: int) -> SearchedPlan:
        """Return the plan with a fine grid, or if it is too large with the given one."""
        if grid_size(plan, FINE_STEP_M) > _MAX_FINE:
            reach_m = _CONFIG.grid_reach * grid.step_m
            return cls(plan, grid.poses, reach_m, BinnedGround.of(grid.layouts(plan)))
        poses = pose_grid(plan, FINE_STEP_M)
        layouts = layouts_at(plan, poses, np.zeros(len(poses)), columns)
        return cls(plan, poses, _FINE_REACH_M, BinnedGround.of(layouts))

    @cached_property
    def types(self) -> Int[np.ndarray, "r"]:
        """Number of each room's type in `conventions.ROOM_TYPES`."""
        return np.array([ROOM_TYPES.index(room.type) for room in self.plan.rooms])


def single_evidence(searched: SearchedPlan, encoder: PhotographEncoder, view: Photograph) -> Arrays:
    """Compare a photograph with all poses.

    Returns:
        `pose`, `position_m`, `room`, `hypothesis` and `log_likelihood` of the states that are kept;
        `room_types` (r,), the log likelihood of the type of every room; `heights` (j,), the log evidence of each height
        offset; `chance`, the log likelihood of the best of as many poses of other homes.
    """
    weights = encoder.manifest.evidence_for(view=not view.is_sphere)
    query = encoder.query(view, None, CameraHeight(USUAL_HEIGHT_M, 0.0))
    compared = Comparison.of(searched.plan, query, searched.reach_m, weights, OFFSETS)
    usual = (0.5 * np.square(OFFSETS / USUAL_LOG_SD)).astype(np.float32)
    ceilings = (usual + _ceilings(searched.plan, query, weights)).astype(np.float32)
    best = np.empty((len(searched.poses), len(query.roll)), np.float32)
    heights = np.full(len(OFFSETS), -np.inf)
    trusts = searched.plan.class_trusts[1][searched.poses.room_index]
    pose = np.arange(len(best))
    places = PlaceCost.of(searched.plan, query, NO_HINTS, 1.0, searched.poses.position_m, searched.poses.room_index)
    for part, log in compared.log_likelihoods(searched.binned, trusts):
        log -= ceilings[searched.poses.room_index[part], None, :]
        heights = np.logaddexp(heights, [_log_sum(log[:, :, number]) for number in range(len(OFFSETS))])
        best[part] = log.max(axis=2)
        if places is not None:
            best[part] -= places.of_poses(pose[part])
    kept = _kept(best, searched.poses.room_index, len(searched.plan.rooms))
    pose, hypothesis = np.divmod(kept, best.shape[1])
    return {
        "pose": pose.astype(np.int32),
        "position_m": searched.poses.position_m[pose].astype(np.float32),
        "room": searched.poses.room_index[pose].astype(np.int32),
        "hypothesis": hypothesis.astype(np.uint8),
        "log_likelihood": best.ravel()[kept].astype(np.float32),
        "room_types": _room_types(searched, query, weights).astype(np.float32),
        "heights": heights.astype(np.float32),
        "chance": np.array(_by_chance(encoder, compared, usual, int(trusts[best.max(axis=1).argmax()])), np.float32),
    }


def _by_chance(
    encoder: PhotographEncoder, compared: Comparison, usual: Float[np.ndarray, "j"], trust_number: int
) -> float:
    """Return the log likelihood of the best pose of other homes, under one trust; -inf if the model has none."""
    cohort = encoder.cohort
    if cohort is None:
        return -math.inf
    layouts = cohort.layouts.rows(np.arange(0, len(cohort.layouts), _EVERY))
    ground, trusts = BinnedGround.of(layouts), np.full(len(layouts), trust_number)
    return max(float((log - usual).max()) for _, log in compared.log_likelihoods(ground, trusts))


def _kept(best: Float[np.ndarray, "n k"], room_index: Int[np.ndarray, "n"], rooms: int) -> Int[np.ndarray, "m"]:
    """Return the row-major numbers of the best states of every room."""
    each = max(min(_PER_ROOM, _MAX_STATES // rooms), 1)
    parts = []
    for room in range(rooms):
        rows = np.flatnonzero(room_index == room)
        values = best[rows].ravel()
        top = np.argpartition(-values, min(each, len(values) - 1))[:each] if len(values) else np.zeros(0, int)
        place, hypothesis = np.divmod(top, best.shape[1])
        parts.append(rows[place] * best.shape[1] + hypothesis)
    return np.concatenate(parts)


def _room_types(searched: SearchedPlan, query: Query, weights: MatchingWeights) -> Float[np.ndarray, "r"]:
    """Return the log likelihood of every room's type.

    As in the matching cost, recognised objects replace the encoder's own prediction.
    """
    if query.objects is not None:
        return -room_type_losses(query.objects.room_type, _CONFIG.floor)[searched.types]
    if query.room_type is None:
        return np.zeros(len(searched.types))
    losses = room_type_losses(query.room_type, _CONFIG.floor)
    return -weights.room_type * weights.temperature * losses[searched.types]


def _ceilings(plan: FloorPlan, query: Query, weights: MatchingWeights) -> Float[np.ndarray, "r j"]:
    """Return the negative log likelihood of every room's ceiling at each height."""
    if query.ceiling is None:
        return np.zeros((len(plan.rooms), len(OFFSETS)))
    clearance_m = plan.ceiling_heights_m[:, None] - USUAL_HEIGHT_M * np.exp(OFFSETS)
    return weights.ceiling * weights.temperature * ceiling_costs(query.ceiling, clearance_m, OFFSETS, weights.tail)


def _log_sum(values: np.ndarray) -> float:
    highest = float(values.max())
    return highest + math.log(float(np.exp(values - highest).sum()))
