"""Several plans merged into one plan, side by side with gaps between them.

The search of a single plan then searches all of them, with the same code and the same cost per pose. Its posterior
covers the poses of all plans, with an equal prior for every square metre of floor.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float, Int

from lalaloc_core.conventions import OPENING_CLASSES
from lalaloc_core.floorplan import FloorPlan, OpeningFace, Room
from lalaloc_core.localise.match import PoseGrid
from lalaloc_core.localise.match.pose_grid import joined_layouts
from lalaloc_core.localise.query import Candidate
from lalaloc_core.localise.venue.prototypes import claims_of_trust, trust_of_claims
from lalaloc_core.render.sampling import PoseSet

# Candidates, and other poses with the same fields.
PoseT = TypeVar("PoseT", bound=Any)
# Gap between the bounding boxes of two plans, larger than any distance at which poses count as one place.
GAP_M = 10.0
# Each distinct trust takes a table of costs; beyond these, trusts are rounded to the few levels of the index.
_MAX_TRUSTS = 8


@dataclass(frozen=True, eq=False)
class MergedPlans:
    """Merged plan of p plans, and its pose grid.

    Attributes:
        plan: the merged plan. Its rooms have the trust in openings of their plans (`FloorPlan.room_trust`).
        grid: poses of all plans in the merged frame, in the order of the plans.
        shift_m: (p, 2) translation (m) of each plan into the merged frame.
    """

    plans: tuple[FloorPlan, ...]
    plan: FloorPlan
    grid: PoseGrid
    shift_m: Float[np.ndarray, "p 2"]
    _poses: Int[np.ndarray, "p"] = field(repr=False)

    @classmethod
    def of_plan(cls, plan: FloorPlan, grid: PoseGrid) -> MergedPlans:
        """Return one plan by itself, in its own frame."""
        return cls((plan,), plan, grid, np.zeros((1, 2)), np.array([len(grid.poses)]))

    @classmethod
    def of(
        cls, plans: Sequence[FloorPlan], grids: Sequence[PoseGrid], camera_height_m: float, gap_m: float = GAP_M
    ) -> MergedPlans:
        """Merge plans, laid out in a square of cells at least `gap_m` apart.

        A single row would be so long that coordinates lose precision in single precision. All grids have the same step
        and are for the same model; the camera height (m) is the query's.
        """
        bounds = np.array([plan.bounds_m for plan in plans])
        cell_m = (bounds[:, 2:] - bounds[:, :2]).max(axis=0) + gap_m
        columns, index = int(np.ceil(np.sqrt(len(plans)))), np.arange(len(plans))
        shift_m = np.stack([index % columns, index // columns], axis=1) * cell_m - bounds[:, :2]
        placed = list(zip(plans, shift_m, strict=True))
        plan = FloorPlan(
            name="",
            rooms=tuple(_moved(room, shift) for plan, shift in placed for room in plan.rooms),
            camera_height_m=camera_height_m,
            openings=tuple(
                replace(opening, line_m=opening.line_m + shift) for plan, shift in placed for opening in plan.openings
            ),
            room_trust=_room_trust(plans),
            opening_faces=_faces(plans),
            fixtures=tuple(
                replace(fixture, outline_m=fixture.outline_m + shift)
                for plan, shift in placed
                for fixture in plan.fixtures
            ),
        )
        grid = _grid(plans, grids, shift_m, camera_height_m)
        return cls(tuple(plans), plan, grid, shift_m, np.array([len(grid.poses) for grid in grids]))

    @cached_property
    def first_room(self) -> Int[np.ndarray, "p"]:
        """Number of each plan's first room in the merged plan."""
        return _starts([len(plan.rooms) for plan in self.plans])

    def plan_of(self, room_index: int) -> int:
        """Return the number of the plan that a room of the merged plan belongs to."""
        return int(np.searchsorted(self.first_room, room_index, side="right")) - 1

    def in_own_plan(self, candidate: Candidate) -> tuple[int, Candidate]:
        """Return the number of a candidate's plan, and the candidate in that plan's frame."""
        index = self.plan_of(candidate.room_index)
        return index, translated(candidate, -self.shift_m[index], -int(self.first_room[index]))

    def by_plan(self, values: Float[np.ndarray, "n"]) -> Float[np.ndarray, "p"]:
        """Return the sum of each plan's values, given one value for each grid pose."""
        return np.add.reduceat(values, _starts(self._poses))


def translated(pose: PoseT, shift_m: Float[np.ndarray, "2"], rooms: int) -> PoseT:
    """Return a pose in another frame: shifted (m), with the number of its room raised."""
    x_m, y_m = pose.position_m + shift_m
    return replace(pose, x_m=float(x_m), y_m=float(y_m), room_index=pose.room_index + rooms)


def _starts(counts: Sequence[int] | Int[np.ndarray, "p"]) -> Int[np.ndarray, "p"]:
    return np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(int)


def _moved(room: Room, shift_m: Float[np.ndarray, "2"]) -> Room:
    return replace(
        room,
        polygon_m=room.polygon_m + shift_m,
        holes_m=tuple(hole + shift_m for hole in room.holes_m),
        inner_walls_m=room.inner_walls_m + np.tile(shift_m, 2),
    )


def _room_trust(plans: Sequence[FloorPlan]) -> tuple[Mapping[str, float], ...]:
    """Return the trust in openings of each room's plan."""
    trusts: list[Mapping[str, float]] = [plan.opening_trust for plan in plans]
    if len({frozenset(trust.items()) for trust in trusts}) > _MAX_TRUSTS:
        levels = [trust_of_claims(claims_of_trust(trust)) for trust in trusts]
        trusts = [dict(zip(map(str, OPENING_CLASSES), level, strict=True)) for level in levels]
    return tuple(trust for plan, trust in zip(plans, trusts, strict=True) for _ in plan.rooms)


def _faces(plans: Sequence[FloorPlan]) -> tuple[OpeningFace, ...]:
    """Return the opening faces of all plans, with the numbers of rooms and openings in the merged plan."""
    rooms = _starts([len(plan.rooms) for plan in plans])
    openings = _starts([len(plan.openings) for plan in plans])
    return tuple(
        replace(
            face,
            opening=face.opening + int(opening),
            room=face.room + int(room),
            behind=face.behind + int(room) if face.behind >= 0 else -1,
        )
        for plan, room, opening in zip(plans, rooms, openings, strict=True)
        for face in plan.opening_faces
    )


def _grid(
    plans: Sequence[FloorPlan], grids: Sequence[PoseGrid], shift_m: Float[np.ndarray, "p 2"], camera_height_m: float
) -> PoseGrid:
    rooms = _starts([len(plan.rooms) for plan in plans])
    poses = PoseSet(
        np.concatenate([grid.poses.position_m + shift for grid, shift in zip(grids, shift_m, strict=True)]),
        np.concatenate([grid.poses.room_index + first for grid, first in zip(grids, rooms, strict=True)]),
    )
    return PoseGrid(
        poses,
        None if any(grid.latents is None for grid in grids) else np.concatenate([grid.known_latents for grid in grids]),
        np.concatenate([grid.profile_m for grid in grids]),
        grids[0].step_m,
        camera_height_m,
        joined_layouts([grid.layouts(plan) for grid, plan in zip(grids, plans, strict=True)], poses.room_index),
    )
