"""What a plan shows at some poses, in the form that evidence is weighed in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int, UInt8

from lalaloc_core.conventions import WALL_CODE
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.render.sampling import PoseSet
from lalaloc_core.render.sweep import profiles_at, swept_views


@dataclass(frozen=True, eq=False)
class SeenThrough:
    """Where one may look through an opening: pose (rising), azimuth column, kind, and log distance (m) behind it."""

    row: Int[np.ndarray, "m"]
    column: Int[np.ndarray, "m"]
    kind: UInt8[np.ndarray, "m"]
    log_behind: Float[np.ndarray, "m"]

    @property
    def nbytes(self) -> int:
        """Memory that the arrays take."""
        return self.row.nbytes + self.column.nbytes + self.kind.nbytes + self.log_behind.nbytes

    def of(self, pose: Int[np.ndarray, "k"]) -> tuple[Int[np.ndarray, "e"], Int[np.ndarray, "e"]]:
        """What some poses see through: for each entry which of them it is of, and its place here."""
        begin = np.searchsorted(self.row, pose)
        count = np.searchsorted(self.row, pose, side="right") - begin
        of = np.repeat(np.arange(len(pose)), count)
        return of, np.arange(len(of)) - np.repeat(np.cumsum(count) - count - begin, count)


@dataclass(frozen=True, eq=False)
class Layouts:
    """Layouts of n poses, in single precision; those of grids that have no latents in half.

    Attributes:
        log_profile: (n, w) log wall profiles (m).
        room_index: (n,) rooms.
        kind: (n, w) codes as in `conventions.OPENING_CLASSES`; None where the plan has no openings.
        seen: where one may look through; None where nowhere.
    """

    log_profile: Float[np.ndarray, "n w"]
    room_index: Int[np.ndarray, "n"]
    kind: UInt8[np.ndarray, "n w"] | None = None
    seen: SeenThrough | None = None

    def __len__(self) -> int:
        return len(self.room_index)

    @property
    def nbytes(self) -> int:
        """Memory that the arrays take."""
        kind = 0 if self.kind is None else self.kind.nbytes
        return self.log_profile.nbytes + self.room_index.nbytes + kind + (0 if self.seen is None else self.seen.nbytes)

    def rows(self, index: Int[np.ndarray, "m"]) -> Layouts:
        """The layouts of some poses, in rising order, alone."""
        seen = self.seen
        if seen is not None:
            place = np.searchsorted(index, seen.row)
            kept = np.flatnonzero(index[np.minimum(place, len(index) - 1)] == seen.row)
            seen = SeenThrough(place[kept], seen.column[kept], seen.kind[kept], seen.log_behind[kept])
        kind = None if self.kind is None else self.kind[index]
        return Layouts(self.log_profile[index], self.room_index[index], kind, seen)

    def thinned(self, stride: int) -> Layouts:
        """Every `stride`th azimuth alone."""
        seen = self.seen
        if seen is not None:
            kept = np.flatnonzero(seen.column % stride == 0)
            seen = SeenThrough(seen.row[kept], seen.column[kept] // stride, seen.kind[kept], seen.log_behind[kept])
        kind = None if self.kind is None else self.kind[:, ::stride]
        return Layouts(np.ascontiguousarray(self.log_profile[:, ::stride]), self.room_index, kind, seen)


def layouts_at(plan: FloorPlan, poses: PoseSet, heading: Float[np.ndarray, "n"], columns: int) -> Layouts:
    """Render the layouts of some poses; openings count as the plan's own camera height sees them."""
    if not plan.opening_faces:
        profile_m = profiles_at(plan, poses.position_m, poses.room_index, heading, columns, np.float32)
        return Layouts(np.log(profile_m), poses.room_index)
    view = swept_views(poses.position_m, heading, poses.room_index, plan.wall_table, columns, plan.camera_height_m)
    behind = view.row, view.column, view.kind[view.row, view.column], np.log(view.behind_m)
    seen = SeenThrough(*behind) if len(view.row) else None
    return Layouts(np.log(view.distance_m), poses.room_index, view.kind, seen)


def joined_layouts(parts: Sequence[Layouts], room_index: Int[np.ndarray, "n"]) -> Layouts:
    """Layouts that were rendered in parts, one after the other; rooms get other numbers."""
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
    through = SeenThrough(
        *(np.concatenate([getattr(one, name) for one in seen]) for name in ("row", "column", "kind", "log_behind"))
    )
    return Layouts(log_profile, room_index, kind, through)
