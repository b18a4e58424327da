"""What a plan shows at some poses, in the form that evidence is weighed in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8

from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.render.layout import layout_view
from lalaloc_core.render.poses import profiles_at
from lalaloc_core.sampling import PoseSet

# Poses whose openings are looked through at a time, to bound memory.
_CHUNK = 1024


@dataclass(frozen=True, eq=False)
class SeenThrough:
    """The azimuths at which one may look through an opening: pose, column, kind, and log distance (m) behind it."""

    row: Int[np.ndarray, "m"]
    column: Int[np.ndarray, "m"]
    kind: UInt8[np.ndarray, "m"]
    log_behind: Float[np.ndarray, "m"]


@dataclass(frozen=True, eq=False)
class Layouts:
    """Layouts of n poses, in single precision.

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


def layouts_at(
    plan: FloorPlan,
    poses: PoseSet,
    heading: Float[np.ndarray, "n"],
    columns: int,
    *,
    profile_m: Float[np.ndarray, "n w"] | None = None,
) -> Layouts:
    """Render the layouts of some poses; openings count as the plan's own camera height sees them.

    Args:
        profile_m: their wall profiles (m), where they are known already.
    """
    position_m, turned = poses.position_m.astype(np.float32), heading.astype(np.float32)
    if not plan.opening_faces:
        if profile_m is None:
            profile_m = profiles_at(plan, poses.position_m, poses.room_index, heading, columns, np.float32)
        return Layouts(np.log(np.asarray(profile_m, np.float32)), poses.room_index)
    shape = (len(poses), columns)
    log_profile, kind = np.empty(shape, np.float32), np.empty(shape, np.uint8)
    parts: list[SeenThrough] = []
    for first in range(0, len(poses), _CHUNK):
        part = slice(first, first + _CHUNK)
        view = layout_view(
            position_m[part], turned[part], poses.room_index[part], plan.geometry, columns, plan.camera_height_m
        )
        log_profile[part], kind[part] = np.log(view.distance_m), view.kind
        row, column = np.nonzero(view.behind_m > view.distance_m)
        behind = np.log(view.behind_m[row, column], dtype=np.float32)
        parts.append(SeenThrough(row + first, column, kind[part][row, column], behind))
    seen = SeenThrough(*(np.concatenate([getattr(one, name) for one in parts]) for name in SeenThrough.__annotations__))
    return Layouts(log_profile, poses.room_index, kind, seen if len(seen.row) else None)
