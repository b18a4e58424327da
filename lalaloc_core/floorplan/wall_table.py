"""The walls of all rooms of a plan one after another, none padded, with the openings in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from lalaloc_core.floorplan.arrays import frozen
from lalaloc_core.floorplan.openings import Opening, OpeningFace
from lalaloc_core.floorplan.rooms import Room


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
        exit_m: (m, 4) the opening on the wall of the room behind; of no meaning where there is none.
    """

    first: Int[np.ndarray, "s"]
    start_m: Float[np.ndarray, "n 2"]
    end_m: Float[np.ndarray, "n 2"]
    is_free: Bool[np.ndarray, "n"]
    opening_begin: Float[np.ndarray, "m"]
    opening_end: Float[np.ndarray, "m"]
    opening_kind: UInt8[np.ndarray, "m"]
    sill_m: Float[np.ndarray, "m"]
    head_m: Float[np.ndarray, "m"]
    behind: Int[np.ndarray, "m"]
    exit_m: Float[np.ndarray, "m 4"]

    @classmethod
    def of(cls, rooms: Sequence[Room], openings: Sequence[Opening], faces: Sequence[OpeningFace]) -> WallTable:
        """The table of a plan."""
        first = np.concatenate([[0], np.cumsum([len(room.walls_m) for room in rooms])])
        walls_m = np.concatenate([room.walls_m for room in rooms])
        is_free = np.zeros(len(walls_m), bool)
        for room, end in zip(rooms, first[1:], strict=True):
            is_free[end - len(room.inner_walls_m) : end] = True
        # Of pieces that begin at one place the last one counts, as in `render.layout`.
        faces = sorted(faces, key=lambda face: first[face.room] + face.wall + face.start)
        sources = [openings[face.opening] for face in faces]
        wall = np.array([first[face.room] + face.wall for face in faces], np.float64)
        # Where no room is behind, nobody goes through: any piece will do.
        exits = [(face.behind, face.exit_wall) if face.behind >= 0 else (face.room, face.wall) for face in faces]
        ends = np.array([(face.exit_start, face.exit_end) for face in faces]).reshape(-1, 2)
        through = walls_m[[first[room] + number for room, number in exits]].reshape(-1, 2, 2)
        edge = through[:, 1] - through[:, 0]
        leave_m = [through[:, 0] + ends[:, [k]] * edge for k in (0, 1)]
        return cls(
            first=frozen(first),
            start_m=frozen(walls_m[:, :2].copy()),
            end_m=frozen(walls_m[:, 2:].copy()),
            is_free=frozen(is_free),
            opening_begin=frozen(wall + [face.start for face in faces]),
            opening_end=frozen(wall + [face.end for face in faces]),
            opening_kind=frozen(np.array([source.code for source in sources], np.uint8)),
            sill_m=frozen(np.array([-np.inf if one.sill_m is None else one.sill_m for one in sources])),
            head_m=frozen(np.array([np.inf if one.head_m is None else one.head_m for one in sources])),
            behind=frozen(np.array([face.behind for face in faces], np.intp)),
            exit_m=frozen(np.concatenate(leave_m, axis=1)),
        )

    @property
    def nbytes(self) -> int:
        """Memory that the arrays take."""
        return sum(getattr(self, field.name).nbytes for field in fields(self))
