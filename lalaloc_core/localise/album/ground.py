"""Ground of an album: the plan, or the plans of a venue side by side, that its photographs are pinned to."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from lalaloc_core.conventions import heading_from_degrees
from lalaloc_core.errors import InvalidCorrectionError
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.album.entry import AlbumPhotograph
from lalaloc_core.localise.album.pins import PinPose, RoomShare
from lalaloc_core.localise.match import PoseGrid
from lalaloc_core.localise.venue.merged_plans import MergedPlans


@dataclass(frozen=True, eq=False)
class AlbumGround:
    """Places that the photographs of an album are compared with: plans side by side, and the ids that pins name."""

    plan_ids: tuple[str, ...]
    merged: MergedPlans

    @classmethod
    def of_plan(cls, plan_id: str, plan: FloorPlan, grid: PoseGrid) -> AlbumGround:
        """Return the ground of one plan."""
        return cls((plan_id,), MergedPlans.of_plan(plan, grid))

    @property
    def plan(self) -> FloorPlan:
        """The plan, or all side by side."""
        return self.merged.plan

    @property
    def grid(self) -> PoseGrid:
        """The pose grid of `plan`."""
        return self.merged.grid

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the plans: what is known about photographs in other plans does not hold here."""
        document = [list(self.plan_ids), [plan.to_dict() for plan in self.merged.plans], self.grid.step_m]
        return hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()

    def room_of(self, plan_id: str, room_id: str) -> int | None:
        """Return the number of a room of `plan`; None if there is none."""
        for number, room in enumerate(self.plan.rooms):
            if room.id == room_id and self.plan_ids[self.merged.plan_of(number)] == plan_id:
                return number
        return None

    def pose(self, position_m: Float[np.ndarray, "2"], room_index: int, heading: float | None) -> PinPose:
        """Return a place in the frame of `plan` as a pose of its own plan."""
        number, room = self.merged.plan_of(room_index), self.plan.rooms[room_index]
        own = position_m - self.merged.shift_m[number]
        return PinPose(
            plan_id=self.plan_ids[number],
            room_id=room.id,
            room=room.name,
            x_m=float(own[0]),
            y_m=float(own[1]),
            heading=heading,
        )

    def share(self, room_index: int, probability: float) -> RoomShare:
        """Return a room's probability."""
        room = self.plan.rooms[room_index]
        plan_id = self.plan_ids[self.merged.plan_of(room_index)]
        return RoomShare(plan_id=plan_id, room_id=room.id, room=room.name, probability=probability)

    def position_of(self, plan_id: str, x_m: float, y_m: float) -> tuple[Float[np.ndarray, "2"], int] | None:
        """Return a place of a plan in the frame of `plan`, and its room, the nearest one; None for an unknown plan."""
        if plan_id not in self.plan_ids:
            return None
        number = self.plan_ids.index(plan_id)
        position = np.array([x_m, y_m]) + self.merged.shift_m[number]
        own = [index for index in range(len(self.plan.rooms)) if self.merged.plan_of(index) == number]
        inside = int(self.plan.room_index_at(position[None])[0])
        if inside in own:
            return position, inside
        poses = self.grid.poses
        rows = np.flatnonzero(np.isin(poses.room_index, own))
        if not len(rows):
            return None
        nearest = rows[int(np.linalg.norm(poses.position_m[rows] - position, axis=1).argmin())]
        return position, int(poses.room_index[nearest])


@dataclass(frozen=True, eq=False)
class Constraint:
    """A stated place.

    Attributes:
        room: number of the room; None for none of the rooms.
        position_m: the position in the frame of the ground's plan; None where only the room is known.
        heading: heading, radians; None if it is not stated.
    """

    room: int | None
    position_m: Float[np.ndarray, "2"] | None = None
    heading: float | None = None


def constraint_of(ground: AlbumGround, photograph: AlbumPhotograph) -> Constraint:
    """Return the constraint of a photograph's correction."""
    stated = photograph.correction
    assert stated is not None
    if stated.kind == "elsewhere":
        return Constraint(None)
    assert stated.plan_id is not None
    if stated.kind == "room":
        assert stated.room_id is not None
        room = ground.room_of(stated.plan_id, stated.room_id)
        if room is None:
            raise InvalidCorrectionError(
                f"photograph '{photograph.id:.50}' is corrected to room '{stated.room_id:.50}' of plan "
                f"'{stated.plan_id:.50}', which does not exist; state another room, or undo the correction"
            )
        return Constraint(room)
    assert stated.x_m is not None
    assert stated.y_m is not None
    found = ground.position_of(stated.plan_id, stated.x_m, stated.y_m)
    if found is None:
        raise InvalidCorrectionError(
            f"photograph '{photograph.id:.50}' is corrected to a position in plan '{stated.plan_id:.50}', which does "
            "not exist or has no room; state another one, or undo the correction"
        )
    heading = None if stated.heading_deg is None else heading_from_degrees(stated.heading_deg)
    return Constraint(found[1], found[0], heading)
