"""Camera poses in a plan: the regular grid of retrieval, and training triplets (paper, sections 5 and A.1.3)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Bool, Float, Int
from shapely.geometry.base import BaseGeometry

from lalaloc_core.errors import InvalidInputError
from lalaloc_core.floorplan import FloorPlan

# Cameras do not stand in walls; grid poses keep this distance where the room allows it.
WALL_MARGIN_M = 0.15
_MIN_RADIUS_M = 1e-3
# Points of a lattice that are looked at together: the box around a slanting corridor holds many more than the corridor.
_LATTICE_POINTS = 65_536
# Twice the negatives wanted are drawn at a time; where fewer than one in twelve is far enough, the plan is too small.
_NEGATIVE_ROUNDS = 6


@dataclass(frozen=True, eq=False)
class PoseSet:
    """Camera positions of one plan and the room each lies in."""

    position_m: Float[np.ndarray, "n 2"]
    room_index: Int[np.ndarray, "n"]

    def __len__(self) -> int:
        return len(self.position_m)


def grid_size(plan: FloorPlan, step_m: float) -> int:
    """About how many poses `pose_grid` would return, from areas alone; many narrow rooms may hold twice as many."""
    return len(plan.rooms) + int(plan.area_m2 / step_m**2)


def pose_grid(plan: FloorPlan, step_m: float, after_room: Callable[[], None] = lambda: None) -> PoseSet:
    """Poses on the lattice of multiples of `step_m`, clipped to the rooms.

    A room too small or narrow for any lattice point gets one pose well inside it, so that no room is missing.

    Args:
        plan: the plan.
        step_m: distance of neighbouring poses.
        after_room: called when the poses of a room are found; what it raises ends the work.

    Raises:
        InvalidInputError: `step_m` is not positive.
    """
    if not step_m > 0.0:
        raise InvalidInputError(f"the grid step is {step_m} m, it must be positive")
    positions, rooms = [], []
    for index, room in enumerate(plan.rooms):
        x_min, y_min, x_max, y_max = room.shape.bounds
        xs = np.arange(np.ceil(x_min / step_m), np.floor(x_max / step_m) + 1) * step_m
        ys = np.arange(np.ceil(y_min / step_m), np.floor(y_max / step_m) + 1) * step_m
        floor = room.free_floor(WALL_MARGIN_M)
        shapely.prepare(floor)
        columns = max(1, _LATTICE_POINTS // max(1, len(ys)))
        chosen = np.concatenate(
            [np.empty((0, 2))]
            + [_lattice_inside(floor, xs[first : first + columns], ys) for first in range(0, len(xs), columns)]
        )
        if len(chosen) == 0:
            chosen = room.inmost_point()[None]
        positions.append(chosen)
        rooms.append(np.full(len(chosen), index))
        after_room()
    return PoseSet(np.concatenate(positions), np.concatenate(rooms))


def _lattice_inside(
    floor: BaseGeometry, xs: Float[np.ndarray, "c"], ys: Float[np.ndarray, "r"]
) -> Float[np.ndarray, "n 2"]:
    """The points of a lattice that lie on a floor."""
    lattice = np.stack(np.meshgrid(xs, ys, indexing="ij"), axis=-1).reshape(-1, 2)
    return lattice[shapely.contains_xy(floor, lattice[:, 0], lattice[:, 1])]


def random_poses(plan: FloorPlan, count: int, rng: np.random.Generator, margin_m: float = WALL_MARGIN_M) -> PoseSet:
    """Poses uniform over the plan's floor, at least `margin_m` from their room's walls.

    Raises:
        InvalidInputError: no room is wide enough for the margin.
    """
    inner = [room.free_floor(margin_m) for room in plan.rooms]
    areas = np.array([shape.area for shape in inner])
    if not areas.sum() > 0.0:
        raise InvalidInputError(f"no room leaves a margin of {margin_m:g} m to its walls")
    shares = rng.multinomial(count, areas / areas.sum())
    positions, rooms = [np.empty((0, 2))], [np.empty(0, dtype=int)]
    for index, (shape, wanted) in enumerate(zip(inner, shares, strict=True)):
        x_min, y_min, x_max, y_max = shape.bounds if wanted else (0.0, 0.0, 1.0, 1.0)
        while wanted > 0:
            drawn = rng.uniform((x_min, y_min), (x_max, y_max), size=(4 * wanted + 8, 2))
            drawn = drawn[shapely.contains_xy(shape, drawn[:, 0], drawn[:, 1])][:wanted]
            positions.append(drawn)
            rooms.append(np.full(len(drawn), index))
            wanted -= len(drawn)
    order = rng.permutation(count)
    return PoseSet(np.concatenate(positions)[order], np.concatenate(rooms)[order])


@dataclass(frozen=True, kw_only=True)
class TripletSampling:
    """How training draws the neighbours of an anchor (paper, A.1.3: 1 positive to 20 negatives)."""

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
        `positive_radius_m`), its negatives (farther than `negative_radius_m`); None when the plan is too small to
        hold an anchor's negatives.
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
        np.concatenate([pool.position_m, positives.position_m]),
        np.concatenate([pool.room_index, positives.room_index]),
    )
    return merged, np.stack(rows)


def sample_neighbours(
    plan: FloorPlan, anchor: PoseSet, sampling: TripletSampling, rng: np.random.Generator, lowest_ceiling_m: float = 0.0
) -> PoseSet | None:
    """Draw the positives, then the negatives, of one given pose.

    Args:
        plan: the plan.
        anchor: one pose.
        sampling: how many, and how near or far.
        rng: source of randomness.
        lowest_ceiling_m: rooms with a lower ceiling are left out; a camera cannot stand in them.

    Returns:
        `sampling.positives` + `sampling.negatives` poses; None where hardly any of the plan is far enough.
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
    """Positions uniform on the disc around each anchor that lie in some room; anchors in tight corners shrink it."""
    count = len(anchors) * sampling.positives
    centre = np.repeat(pool.position_m[anchors], sampling.positives, axis=0)
    # Where rooms overlap, even the smallest disc may lie in another one: then the anchor is its own neighbour.
    result = PoseSet(centre.copy(), np.repeat(pool.room_index[anchors], sampling.positives))
    radius = np.full(count, sampling.positive_radius_m)
    missing = np.arange(count)
    while len(missing):
        angle = rng.uniform(0.0, 2.0 * np.pi, len(missing))
        length = radius[missing] * np.sqrt(rng.uniform(0.0, 1.0, len(missing)))
        drawn = centre[missing] + length[:, None] * np.stack([np.sin(angle), np.cos(angle)], axis=-1)
        room = plan.room_index_at(drawn)
        found = (room >= 0) & (True if open_rooms is None else open_rooms[room])
        result.position_m[missing[found]] = drawn[found]
        result.room_index[missing[found]] = room[found]
        missing = missing[~found]
        radius[missing] *= 0.7
        missing = missing[radius[missing] > _MIN_RADIUS_M]
    return result
