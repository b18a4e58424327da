"""Layouts of poses: what the plan shows there, in the form that the matching cost compares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int, UInt8

from lalaloc_core.conventions import WALL_CODE
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.floorplan.geometry import WallTable
from lalaloc_core.render.sampling import PoseSet
from lalaloc_core.render.sweep import profiles_at, sweep_layouts


@dataclass(frozen=True, eq=False)
class SeenThrough:
    """Walls seen through openings.

    Attributes:
        row: (m,) numbers of the poses, rising.
        column: (m,) azimuth columns.
        kind: (m,) codes of the openings.
        log_behind: (m,) log distances (m) of the walls behind.
    """

    row: Int[np.ndarray, "m"]
    column: Int[np.ndarray, "m"]
    kind: UInt8[np.ndarray, "m"]
    log_behind: Float[np.ndarray, "m"]

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays."""
        return sum(array.nbytes for array in vars(self).values())

    def chosen(self, kept: Int[np.ndarray, "k"]) -> SeenThrough:
        """Return some of the entries."""
        return SeenThrough(*(array[kept] for array in vars(self).values()))

    def entries(self, pose: Int[np.ndarray, "k"]) -> tuple[Int[np.ndarray, "e"], Int[np.ndarray, "e"]]:
        """Return the entries of some poses: for each entry the place of its pose in `pose`, and its number."""
        begin = np.searchsorted(self.row, pose)
        count = np.searchsorted(self.row, pose, side="right") - begin
        place = np.repeat(np.arange(len(pose)), count)
        return place, np.arange(len(place)) - np.repeat(np.cumsum(count) - count - begin, count)


@dataclass(frozen=True, eq=False)
class Layouts:
    """Layouts of n poses, in single precision; in half precision for grids without latents.

    Attributes:
        log_profile: (n, w) log wall profiles (m).
        kind: (n, w) codes as in `conventions.OPENING_CLASSES`; None if the plan has no openings.
        seen: walls seen through openings; None without any.
    """

    log_profile: Float[np.ndarray, "n w"]
    room_index: Int[np.ndarray, "n"]
    kind: UInt8[np.ndarray, "n w"] | None = None
    seen: SeenThrough | None = None

    def __len__(self) -> int:
        return len(self.room_index)

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays."""
        kind = 0 if self.kind is None else self.kind.nbytes
        return self.log_profile.nbytes + self.room_index.nbytes + kind + (0 if self.seen is None else self.seen.nbytes)

    def rows(self, index: Int[np.ndarray, "m"]) -> Layouts:
        """Return the layouts of some poses, by their numbers in rising order."""
        seen = self.seen
        if seen is not None:
            place = np.searchsorted(index, seen.row)
            kept = np.flatnonzero(index[np.minimum(place, len(index) - 1)] == seen.row)
            seen = replace(seen.chosen(kept), row=place[kept])
        kind = None if self.kind is None else self.kind[index]
        return Layouts(self.log_profile[index], self.room_index[index], kind, seen)

    def thinned(self, stride: int) -> Layouts:
        """Return the layouts at every azimuth whose column is a multiple of `stride`."""
        seen = self.seen
        if seen is not None:
            seen = seen.chosen(np.flatnonzero(seen.column % stride == 0))
            seen = replace(seen, column=seen.column // stride)
        kind = None if self.kind is None else self.kind[:, ::stride]
        return Layouts(np.ascontiguousarray(self.log_profile[:, ::stride]), self.room_index, kind, seen)


def layouts_at(plan: FloorPlan, poses: PoseSet, heading: Float[np.ndarray, "n"], columns: int) -> Layouts:
    """Render the layouts of poses at some headings (radians); openings are seen from the plan's camera height."""
    if not plan.opening_faces:
        profile_m = profiles_at(plan, poses.position_m, poses.room_index, heading, columns, np.float32)
        return Layouts(np.log(profile_m), poses.room_index)
    swept = sweep_layouts(poses.position_m, heading, poses.room_index, plan.wall_table, columns, plan.camera_height_m)
    behind = swept.row, swept.column, swept.kind[swept.row, swept.column], np.log(swept.behind_m)
    seen = SeenThrough(*behind) if len(swept.row) else None
    return Layouts(np.log(swept.distance_m), poses.room_index, swept.kind, seen)


def layouts_of_plans(plans: Sequence[FloorPlan], poses: Sequence[PoseSet], columns: int) -> list[Layouts]:
    """Render poses of several plans at heading 0 in one pass; the layouts of each plan are those of `layouts_at`.

    The cost of a pass hardly depends on the number of poses while they are few, as in small plans.
    """
    tables = [plan.wall_table for plan in plans]
    rooms = np.cumsum([0, *(len(plan.rooms) for plan in plans)])
    first = np.cumsum([0, *map(len, poses)])
    eye_m = np.repeat([plan.camera_height_m for plan in plans], [len(table.sill_m) for table in tables])
    position_m = np.concatenate([part.position_m for part in poses])
    room_index = np.concatenate([part.room_index + shift for part, shift in zip(poses, rooms, strict=False)])
    heading, walls = np.zeros(len(position_m)), WallTable.joined(tables)
    swept = sweep_layouts(position_m, heading, room_index, walls, columns, eye_m)
    log_profile, log_behind = np.log(swept.distance_m), np.log(swept.behind_m)
    kind, through = swept.kind[swept.row, swept.column], np.searchsorted(swept.row, first)
    layouts = []
    for number, (plan, part) in enumerate(zip(plans, poses, strict=True)):
        own, seen = slice(first[number], first[number + 1]), slice(through[number], through[number + 1])
        if not plan.opening_faces:
            layouts.append(Layouts(log_profile[own], part.room_index))
            continue
        behind = swept.row[seen] - own.start, swept.column[seen], kind[seen], log_behind[seen]
        ways = SeenThrough(*behind) if len(behind[0]) else None
        layouts.append(Layouts(log_profile[own], part.room_index, swept.kind[own], ways))
    return layouts


def joined_layouts(parts: Sequence[Layouts], room_index: Int[np.ndarray, "n"]) -> Layouts:
    """Concatenate layouts, with new room numbers."""
    log_profile = np.concatenate([part.log_profile for part in parts])
    if all(part.kind is None for part in parts):
        return Layouts(log_profile, room_index)
    kind = np.full(log_profile.shape, WALL_CODE, np.uint8)
    first, seen = 0, []
    for part in parts:
        if part.kind is not None:
            kind[first : first + len(part)] = part.kind
        if part.seen is not None:
            seen.append(replace(part.seen, row=part.seen.row + first))
        first += len(part)
    if not seen:
        return Layouts(log_profile, room_index, kind)
    through = zip(*(vars(part).values() for part in seen), strict=True)
    return Layouts(log_profile, room_index, kind, SeenThrough(*map(np.concatenate, through)))
