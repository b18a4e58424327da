"""The walls of all rooms of a plan one after another, none padded, with the openings in them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from lalaloc_core.floorplan.arrays import frozen
from lalaloc_core.floorplan.geometry import PlanGeometry


@dataclass(frozen=True, eq=False, kw_only=True)
class WallTable:
    """All n walls and all m pieces of openings of a plan, in metres.

    Attributes:
        first: (s,) where the walls of each room begin, and where the last ones end.
        start_m, end_m: (n, 2) of the walls. Rooms lie to the left of their walls.
        is_free: (n,) whether a wall stands free, with the room on both sides.
        opening_begin: (m,) rising: the wall that a piece of an opening lies on, and as a fraction where it begins.
        opening_end: (m,) the same of where it ends.
        opening_kind: (m,) codes as in `conventions.OPENING_CLASSES`.
        sill_m, head_m: (m,) its heights; -inf and inf where the plan does not say.
        behind: (m,) the room behind; -1 where the plan shows none.
        exit_m: (m, 4) the opening on the wall of the room behind.
    """

    first: Int[np.ndarray, "s"]
    start_m: Float[np.ndarray, "n 2"]
    end_m: Float[np.ndarray, "n 2"]
    is_free: Bool[np.ndarray, "n"]
    opening_begin: Float[np.ndarray, "m"]
    opening_end: Float[np.ndarray, "m"]
    opening_kind: Int[np.ndarray, "m"]
    sill_m: Float[np.ndarray, "m"]
    head_m: Float[np.ndarray, "m"]
    behind: Int[np.ndarray, "m"]
    exit_m: Float[np.ndarray, "m 4"]

    @classmethod
    def of(cls, geometry: PlanGeometry, free_walls: Int[np.ndarray, "r"]) -> WallTable:
        """The table of a plan's geometry.

        Args:
            free_walls: how many of each room's walls, the last ones, stand free.
        """
        count = geometry.wall_count
        first = np.concatenate([[0], np.cumsum(count)])
        number = np.arange(geometry.walls_m.shape[1])[None]
        walls_m = geometry.walls_m[number < count[:, None]]
        is_free = (number >= (count - free_walls)[:, None])[number < count[:, None]]
        room, place = np.nonzero(geometry.opening >= 0)
        wall = first[room] + geometry.opening_wall[room, place]
        begin = wall + geometry.opening_share[room, place, 0]
        order = np.argsort(begin, kind="stable")
        room, place = room[order], place[order]
        return cls(
            first=frozen(first),
            start_m=frozen(walls_m[:, :2].copy()),
            end_m=frozen(walls_m[:, 2:].copy()),
            is_free=frozen(is_free),
            opening_begin=frozen(begin[order]),
            opening_end=frozen(wall[order] + geometry.opening_share[room, place, 1]),
            opening_kind=frozen(geometry.opening_kind[room, place]),
            sill_m=frozen(geometry.sill_m[room, place]),
            head_m=frozen(geometry.head_m[room, place]),
            behind=frozen(geometry.behind[room, place]),
            exit_m=frozen(geometry.exit_m[room, place]),
        )
