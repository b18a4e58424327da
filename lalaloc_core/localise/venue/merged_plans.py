"""Several plans as one: laid side by side, so far apart that nothing of one is near anything of another.

A panorama is then searched for in all of them at once, by the same code and at the same cost as in a single plan, and
the posterior over all their poses is the one of that plan, with the same prior for every square metre of floor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from lalaloc_core.floorplan import FloorPlan, OpeningFace, Room
from lalaloc_core.localise.layouts import joined_layouts
from lalaloc_core.localise.poses import Candidate, PoseGrid
from lalaloc_core.render.sampling import PoseSet

# Between the boxes around two plans; farther than any two poses that are taken for one place.
_GAP_M = 10.0


@dataclass(frozen=True, eq=False)
class MergedPlans:
    """Some plans and their grids as one plan and one grid.

    Attributes:
        plans: the plans themselves.
        plan: all of them in one frame. Of the openings, those kinds count that every one of them shows completely: what
            only some of them show would make these fit worse than those that say nothing.
        grid: their poses in that frame, in the order of the plans.
        shift_m: (p, 2) what each plan was moved by.
    """

    plans: tuple[FloorPlan, ...]
    plan: FloorPlan
    grid: PoseGrid
    shift_m: Float[np.ndarray, "p 2"]
    _poses: Int[np.ndarray, "p"] = field(repr=False)

    @classmethod
    def of(cls, plans: Sequence[FloorPlan], grids: Sequence[PoseGrid], camera_height_m: float) -> MergedPlans:
        """Lay plans out, in rows and columns: a single row of many would be so long that single precision feels it.

        Args:
            plans: the plans.
            grids: one for each plan, all with the same step and for the same model.
            camera_height_m: that of the query.
        """
        shift_m = _places(plans)
        plan = FloorPlan(
            name="",
            rooms=tuple(_moved(room, shift) for plan, shift in zip(plans, shift_m, strict=True) for room in plan.rooms),
            camera_height_m=camera_height_m,
            openings=tuple(
                replace(opening, line_m=opening.line_m + shift)
                for plan, shift in zip(plans, shift_m, strict=True)
                for opening in plan.openings
            ),
            opening_kinds=frozenset.intersection(*(plan.opening_kinds for plan in plans)),
            opening_faces=_faces(plans),
        )
        grid = _grid(plans, grids, shift_m, camera_height_m)
        return cls(tuple(plans), plan, grid, shift_m, np.array([len(one.poses) for one in grids]))

    @cached_property
    def first_room(self) -> Int[np.ndarray, "p"]:
        """The index that the first room of each plan has among all."""
        return _starts([len(plan.rooms) for plan in self.plans])

    def plan_of(self, room_index: int) -> int:
        """Which plan a room of the one plan is of."""
        return int(np.searchsorted(self.first_room, room_index, side="right")) - 1

    def in_own_plan(self, candidate: Candidate) -> tuple[int, Candidate]:
        """Which plan a candidate lies in, and the candidate in the frame of that plan."""
        index = self.plan_of(candidate.room_index)
        x_m, y_m = candidate.position_m - self.shift_m[index]
        room = candidate.room_index - int(self.first_room[index])
        return index, replace(candidate, x_m=float(x_m), y_m=float(y_m), room_index=room)

    def by_plan(self, pose: Float[np.ndarray, "n"]) -> Float[np.ndarray, "p"]:
        """Return the sums over the poses of each plan."""
        return np.add.reduceat(pose, _starts(self._poses))


def _starts(counts: Sequence[int] | Int[np.ndarray, "p"]) -> Int[np.ndarray, "p"]:
    return np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(int)


def _places(plans: Sequence[FloorPlan]) -> Float[np.ndarray, "p 2"]:
    """Return the shift of each plan that places them in the cells of a square."""
    bounds = np.array([plan.bounds_m for plan in plans])
    cell_m = (bounds[:, 2:] - bounds[:, :2]).max(axis=0) + _GAP_M
    columns = int(np.ceil(np.sqrt(len(plans))))
    index = np.arange(len(plans))
    return np.stack([index % columns, index // columns], axis=1) * cell_m - bounds[:, :2]


def _moved(room: Room, shift_m: Float[np.ndarray, "2"]) -> Room:
    return replace(
        room,
        polygon_m=room.polygon_m + shift_m,
        holes_m=tuple(hole + shift_m for hole in room.holes_m),
        inner_walls_m=room.inner_walls_m + np.tile(shift_m, 2),
    )


def _faces(plans: Sequence[FloorPlan]) -> tuple[OpeningFace, ...]:
    """Pieces of walls that openings take up, with the indices that rooms and openings have among all."""
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
    return PoseGrid.with_layouts(
        poses,
        None if any(grid.latents is None for grid in grids) else np.concatenate([grid.known_latents for grid in grids]),
        np.concatenate([grid.profile_m for grid in grids]),
        grids[0].step_m,
        camera_height_m,
        joined_layouts([grid.layouts(plan) for grid, plan in zip(grids, plans, strict=True)], poses.room_index),
    )
