"""A plan's walls and openings as arrays for the renderer, in one table; walls also padded per room."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from lalaloc_core.floorplan.openings import Opening, OpeningFace
from lalaloc_core.floorplan.rooms import Room, frozen


def pad_walls(walls_m: Float[np.ndarray, "n 4"], length: int) -> Float[np.ndarray, "length 4"]:
    """Pad wall segments to `length` rows by repeating the first, which changes no ray's distance."""
    return np.concatenate([walls_m, np.repeat(walls_m[:1], length - len(walls_m), axis=0)])


@dataclass(frozen=True, eq=False, kw_only=True)
class WallTable:
    """All n walls and m opening faces of a plan, in metres, room after room without padding.

    Attributes:
        first: (s,) index of each room's first wall, followed by the number of walls.
        start_m, end_m: (n, 2) ends of the walls. Rooms lie to the left of their walls.
        is_free: (n,) True for free-standing walls, with the room on both sides.
        opening_begin: (m,) ascending start of each face: index of its wall plus the share of the wall's length.
        opening_end: (m,) end of each face, in the same form.
        opening_kind: (m,) codes as in `conventions.OPENING_CLASSES`.
        sill_m, head_m: (m,) heights; -inf and inf if the plan does not give them.
        behind: (m,) index of the room behind; -1 for none.
        exit_m: (m, 4) the opening on the wall of the room behind; meaningless if there is none.
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
    def build(cls, rooms: Sequence[Room], openings: Sequence[Opening], faces: Sequence[OpeningFace]) -> WallTable:
        """Build the table of a plan."""
        first = np.concatenate([[0], np.cumsum([len(room.walls_m) for room in rooms])])
        walls_m = np.concatenate([room.walls_m for room in rooms])
        is_free = np.zeros(len(walls_m), bool)
        for room, end in zip(rooms, first[1:], strict=True):
            is_free[end - len(room.inner_walls_m) : end] = True
        # Sorted stably: the last of several faces with the same start wins.
        faces = sorted(faces, key=lambda face: first[face.room] + face.wall + face.start)
        sources = [openings[face.opening] for face in faces]
        wall = np.array([first[face.room] + face.wall for face in faces], np.float64)
        # Faces without a room behind need a placeholder: their own wall.
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
            sill_m=frozen(np.array([-np.inf if source.sill_m is None else source.sill_m for source in sources])),
            head_m=frozen(np.array([np.inf if source.head_m is None else source.head_m for source in sources])),
            behind=frozen(np.array([face.behind for face in faces], np.intp)),
            exit_m=frozen(np.concatenate(leave_m, axis=1)),
        )

    @classmethod
    def joined(cls, tables: Sequence[WallTable]) -> WallTable:
        """Return one table for several plans, each in its own frame; rooms are numbered plan after plan."""
        walls = np.cumsum([0, *(len(table.start_m) for table in tables)])
        rooms = np.cumsum([0, *(len(table.first) - 1 for table in tables)])
        shifted = {
            "first": [table.first[:-1] + shift for table, shift in zip(tables, walls, strict=False)] + [walls[-1:]],
            "opening_begin": [table.opening_begin + shift for table, shift in zip(tables, walls, strict=False)],
            "opening_end": [table.opening_end + shift for table, shift in zip(tables, walls, strict=False)],
            "behind": [
                np.where(table.behind < 0, -1, table.behind + shift)
                for table, shift in zip(tables, rooms, strict=False)
            ],
        }
        names = [field.name for field in fields(cls)]
        parts = {name: shifted.get(name) or [getattr(table, name) for table in tables] for name in names}
        return cls(**{name: frozen(np.concatenate(arrays)) for name, arrays in parts.items()})

    @property
    def nbytes(self) -> int:
        """Memory of the arrays."""
        return sum(getattr(self, field.name).nbytes for field in fields(self))
