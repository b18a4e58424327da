"""Camera poses in a plan: the regular pose grid of retrieval and training triplets (paper, sections 5 and A.1.3)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Bool, Float, Int

from lalaloc_core.errors import InvalidInputError
from lalaloc_core.floorplan import FloorPlan

# Minimum distance of grid poses from walls, if the room is wide enough.
WALL_MARGIN_M = 0.15
_MIN_RADIUS_M = 1e-3
# Lattice points tested at once, to bound memory: the box around a slanting corridor is much larger than the corridor.
_LATTICE_POINTS = 65_536
# Each round draws twice the wanted negatives; if fewer than one in twelve is far enough, the plan is too small.
_NEGATIVE_ROUNDS = 6


@dataclass(frozen=True, eq=False)
class PoseSet:
    """Camera positions of one plan and the room of each."""

    position_m: Float[np.ndarray, "n 2"]
    room_index: Int[np.ndarray, "n"]

    def __len__(self) -> int:
        return len(self.position_m)


def grid_size(plan: FloorPlan, step_m: float) -> int:
    """Estimate the number of poses of `pose_grid` from areas alone; many narrow rooms can hold twice as many."""
    return len(plan.rooms) + int(plan.area_m2 / step_m**2)


def pose_grid(plan: FloorPlan, step_m: float, after_room: Callable[[], None] = lambda: None) -> PoseSet:
    """Return the poses on the lattice of multiples of `step_m` that lie in rooms.

    A room too small or narrow for any lattice point gets one interior pose, so that no room is missing. `after_room` is
    called after each room; an exception that it raises ends the computation.
    """
    if not step_m > 0.0:
        raise InvalidInputError(f"the grid step is {step_m} m; it must be positive (step_m)")
    positions, rooms = [], []
    for index, room in enumerate(plan.rooms):
        x_min, y_min, x_max, y_max = room.shape.bounds
        xs = np.arange(np.ceil(x_min / step_m), np.floor(x_max / step_m) + 1) * step_m
        ys = np.arange(np.ceil(y_min / step_m), np.floor(y_max / step_m) + 1) * step_m
        floor = room.free_floor(WALL_MARGIN_M)
        shapely.prepare(floor)
        columns = max(1, _LATTICE_POINTS // max(1, len(ys)))
        parts = [np.empty((0, 2))]
        for first in range(0, len(xs), columns):
            lattice = np.stack(np.meshgrid(xs[first : first + columns], ys, indexing="ij"), axis=-1).reshape(-1, 2)
            parts.append(lattice[shapely.contains_xy(floor, lattice[:, 0], lattice[:, 1])])
        chosen = np.concatenate(parts)
        if len(chosen) == 0:
            chosen = room.interior_point()[None]
        positions.append(chosen)
        rooms.append(np.full(len(chosen), index))
        after_room()
    return PoseSet(np.concatenate(positions), np.concatenate(rooms))


def random_poses(plan: FloorPlan, count: int, rng: np.random.Generator, margin_m: float = WALL_MARGIN_M) -> PoseSet:
    """Draw poses uniformly over the plan's floor, at least `margin_m` from their room's walls.

    Raises:
        InvalidInputError: no room is wide enough for the margin.
    """
    inner = [room.free_floor(margin_m) for room in plan.rooms]
    areas = np.array([shape.area for shape in inner])
    if not areas.sum() > 0.0:
        raise InvalidInputError(f"no room is wide enough for a margin of {margin_m:g} m to its walls (margin_m)")
    shares = rng.multinomial(count, areas / areas.sum())
    positions, rooms = [np.empty((0, 2))], [np.empty(0, dtype=int)]
    for index, (shape, wanted) in enumerate(zip(inner, shares, strict=True)):
        x_min, y_min, x_max, y_max = shape.bounds if wanted else (0.0, 0.0, 1.0, 1.0)
        while wanted > 0:
            candidates = rng.uniform((x_min, y_min), (x_max, y_max), size=(4 * wanted + 8, 2))
            candidates = candidates[shapely.contains_xy(shape, candidates[:, 0], candidates[:, 1])][:wanted]
            positions.append(candidates)
            rooms.append(np.full(len(candidates), index))
            wanted -= len(candidates)
    order = rng.permutation(count)
    return PoseSet(np.concatenate(positions)[order], np.concatenate(rooms)[order])


@dataclass(frozen=True, kw_only=True)
class TripletSampling:
    """Numbers and radii of an anchor's neighbours in training (paper, A.1.3: 1 positive to 20 negatives)."""

    positives: int = 1
    negatives: int = 20
    positive_radius_m: float = 0.5
    negative_radius_m: float = 2.0


def sample_triplets(
    plan: FloorPlan, anchors: int, sampling: TripletSampling, rng: np.random.Generator
) -> tuple[PoseSet, Int[np.ndarray, "{anchors} 1+{sampling.positives}+{sampling.negatives}"]] | None:
    """Draw anchors with their positives and negatives.

    Returns:
        the poses, and per anchor a row of indices into them: the anchor, its positives (closer than
        `positive_radius_m`), its negatives (farther than `negative_radius_m`); None if the plan is too small for
        negatives.
    """
    pool = random_poses(plan, 4 * (anchors + sampling.negatives), rng)
    distance = np.linalg.norm(pool.position_m[:, None] - pool.position_m[None], axis=-1)
    usable = np.flatnonzero((distance > sampling.negative_radius_m).sum(axis=1) >= sampling.negatives)
    if len(usable) < anchors:
        return None
    chosen = rng.choice(usable, anchors, replace=False)
    positives = _sample_near(plan, pool, chosen, sampling, rng)
    rows = []
    for k, anchor in enumerate(chosen):
        far = np.flatnonzero(distance[anchor] > sampling.negative_radius_m)
        negatives = rng.choice(far, sampling.negatives, replace=False)
        near = len(pool) + k * sampling.positives + np.arange(sampling.positives)
        rows.append(np.concatenate([[anchor], near, negatives]))
    merged = PoseSet(
        np.concatenate([pool.position_m, positives.position_m]), np.concatenate([pool.room_index, positives.room_index])
    )
    return merged, np.stack(rows)


def sample_neighbours(
    plan: FloorPlan, anchor: PoseSet, sampling: TripletSampling, rng: np.random.Generator, lowest_ceiling_m: float = 0.0
) -> PoseSet | None:
    """Draw the positives, then the negatives, of a given pose.

    Rooms with a ceiling below `lowest_ceiling_m` are excluded, since a camera cannot stand in them.

    Returns:
        `sampling.positives` + `sampling.negatives` poses; None if too little of the plan is far enough.
    """
    open_rooms = plan.ceiling_heights_m >= lowest_ceiling_m
    far_position, far_room = [np.empty((0, 2))], [np.empty(0, dtype=int)]
    for _ in range(_NEGATIVE_ROUNDS):
        pool = random_poses(plan, 2 * sampling.negatives, rng)
        distance = np.linalg.norm(pool.position_m - anchor.position_m[0], axis=1)
        far = (distance > sampling.negative_radius_m) & open_rooms[pool.room_index]
        far_position.append(pool.position_m[far])
        far_room.append(pool.room_index[far])
        if sum(map(len, far_room)) >= sampling.negatives:
            near = _sample_near(plan, anchor, np.array([0]), sampling, rng, open_rooms)
            return PoseSet(
                np.concatenate([near.position_m, np.concatenate(far_position)[: sampling.negatives]]),
                np.concatenate([near.room_index, np.concatenate(far_room)[: sampling.negatives]]),
            )
    return None


def _sample_near(
    plan: FloorPlan,
    pool: PoseSet,
    anchors: Int[np.ndarray, "k"],
    sampling: TripletSampling,
    rng: np.random.Generator,
    open_rooms: Bool[np.ndarray, "r"] | None = None,
) -> PoseSet:
    """Draw positions in rooms, uniform on a disc around each anchor; the disc shrinks in tight corners."""
    count = len(anchors) * sampling.positives
    centre = np.repeat(pool.position_m[anchors], sampling.positives, axis=0)
    # In overlapping rooms even the smallest disc can lie in another room: then the anchor is its own neighbour.
    result = PoseSet(centre.copy(), np.repeat(pool.room_index[anchors], sampling.positives))
    radius = np.full(count, sampling.positive_radius_m)
    missing = np.arange(count)
    while len(missing):
        angle = rng.uniform(0.0, 2.0 * np.pi, len(missing))
        length = radius[missing] * np.sqrt(rng.uniform(0.0, 1.0, len(missing)))
        candidates = centre[missing] + length[:, None] * np.stack([np.sin(angle), np.cos(angle)], axis=-1)
        room = plan.room_index_at(candidates)
        found = (room >= 0) & (True if open_rooms is None else open_rooms[room])
        result.position_m[missing[found]] = candidates[found]
        result.room_index[missing[found]] = room[found]
        missing = missing[~found]
        radius[missing] *= 0.7
        missing = missing[radius[missing] > _MIN_RADIUS_M]
    return result
