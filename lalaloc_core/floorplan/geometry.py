"""A plan's walls and openings as padded arrays, one row per room: what the layout renderer casts its rays against."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from array_api_compat import array_namespace, device
from jaxtyping import Float, Int

from lalaloc_core.conventions import WALL_CODE, Array
from lalaloc_core.floorplan.arrays import frozen
from lalaloc_core.floorplan.openings import Opening, OpeningFace
from lalaloc_core.floorplan.rooms import Room


@dataclass(frozen=True, eq=False, kw_only=True)
class PlanGeometry:
    """Arrays over the rooms of one plan; index them with a pose's room. Lengths in metres.

    Rows of `walls_m` are padded by repeating a room's first wall, rows of openings with kind 0, which is none.

    Attributes:
        walls_m: (r, n, 4) wall segments (x0, y0, x1, y1).
        wall_count: (r) how many of them are no padding.
        opening_kind: (r, m) codes as in `conventions.OPENING_CLASSES`.
        opening_m: (r, m, 4) the opening on the room's own wall.
        opening_wall: (r, m) that wall's index, -1 in the padding.
        opening_share: (r, m, 2) where on it the opening begins and ends, as shares of its length.
        sill_m, head_m: (r, m) heights of the opening; -inf and inf where the plan does not say.
        behind: (r, m) index of the room behind, -1 where the plan shows none.
        exit_m: (r, m, 4) the opening on the wall of the room behind; its own piece where there is none.
        opening: (r, m) index in the plan's `openings`, -1 in the padding.
    """

    walls_m: Float[Array, "r n 4"]
    wall_count: Int[Array, "r"]
    opening_kind: Int[Array, "r m"]
    opening_m: Float[Array, "r m 4"]
    opening_wall: Int[Array, "r m"]
    opening_share: Float[Array, "r m 2"]
    sill_m: Float[Array, "r m"]
    head_m: Float[Array, "r m"]
    behind: Int[Array, "r m"]
    exit_m: Float[Array, "r m 4"]
    opening: Int[Array, "r m"]

    @property
    def nbytes(self) -> int:
        """Memory that numpy arrays of it take."""
        return sum(getattr(self, field.name).nbytes for field in fields(self))

    def like(self, array: Array) -> PlanGeometry:
        """The same geometry in the library, on the device and with the float type of another array."""
        xp, where = array_namespace(array), device(array)
        if type(self.walls_m) is type(array) and self.walls_m.dtype == array.dtype and device(self.walls_m) == where:
            return self

        def moved(value: Array) -> Array:
            is_float = array_namespace(value).isdtype(value.dtype, "real floating")
            # Torch warns of memory that it may not write to.
            source = value.copy() if isinstance(value, np.ndarray) else value
            return xp.asarray(source, dtype=array.dtype if is_float else xp.int64, device=where)

        return replace(self, **{field.name: moved(getattr(self, field.name)) for field in fields(self)})


def build_geometry(rooms: Sequence[Room], openings: Sequence[Opening], faces: Sequence[OpeningFace]) -> PlanGeometry:
    """The arrays of a plan."""
    longest = max(len(room.walls_m) for room in rooms)
    walls_m = np.stack([pad_walls(room.walls_m, longest) for room in rooms])
    by_room: list[list[OpeningFace]] = [[] for _ in rooms]
    for face in faces:
        by_room[face.room].append(face)
    shape = (len(rooms), max(map(len, by_room)))
    kind, wall, behind, opening = (np.full(shape, value) for value in (WALL_CODE, -1, -1, -1))
    sill_m, head_m = np.full(shape, -np.inf), np.full(shape, np.inf)
    opening_m, exit_m, share = np.zeros((*shape, 4)), np.zeros((*shape, 4)), np.zeros((*shape, 2))
    for room, group in enumerate(by_room):
        for k, face in enumerate(group):
            source = openings[face.opening]
            at = (room, k)
            kind[at], wall[at], behind[at], opening[at] = source.code, face.wall, face.behind, face.opening
            sill_m[at] = -np.inf if source.sill_m is None else source.sill_m
            head_m[at] = np.inf if source.head_m is None else source.head_m
            share[at] = face.start, face.end
            opening_m[at] = _piece(rooms[room].walls_m[face.wall], face.start, face.end)
            exit_m[at] = opening_m[at]
            if face.behind >= 0:
                exit_m[at] = _piece(rooms[face.behind].walls_m[face.exit_wall], face.exit_start, face.exit_end)
    return PlanGeometry(
        walls_m=frozen(walls_m),
        wall_count=frozen(np.array([len(room.walls_m) for room in rooms])),
        opening_kind=frozen(kind),
        opening_m=frozen(opening_m),
        opening_wall=frozen(wall),
        opening_share=frozen(share),
        sill_m=frozen(sill_m),
        head_m=frozen(head_m),
        behind=frozen(behind),
        exit_m=frozen(exit_m),
        opening=frozen(opening),
    )


def pad_walls(walls_m: Float[np.ndarray, "n 4"], length: int) -> Float[np.ndarray, "length 4"]:
    """Pad wall segments to `length` rows by repeating the first, which no ray caster can tell from the original."""
    return np.concatenate([walls_m, np.repeat(walls_m[:1], length - len(walls_m), axis=0)])


def _piece(wall_m: Float[np.ndarray, "4"], start: float, end: float) -> Float[np.ndarray, "4"]:
    edge = wall_m[2:] - wall_m[:2]
    return np.concatenate([wall_m[:2] + start * edge, wall_m[:2] + end * edge])
