"""Openings: projection of each opening's line onto the walls of all rooms that it belongs to.

A door between two rooms is one entry of the plan. Room polygons are the inner faces of walls, a wall's thickness apart,
so an opening is projected at right angles onto every wall that is nearly parallel and near enough. If several walls of
a room lie behind each other, only the nearest gets the opening.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import shapely
from jaxtyping import Float, Int

from lalaloc_core.conventions import OPENING_CLASSES
from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan.json_values import PlanLimits
from lalaloc_core.floorplan.rooms import Room

DEFAULT_OPENING_TOLERANCE_M = 0.35
# Lower and upper edge (m over the floor) for drawing openings without heights.
USUAL_HEIGHTS_M = {"door": (0.0, 2.05), "window": (0.9, 2.1), "passage": (0.0, 2.2)}
# Walls within 15 degrees of an opening's line are nearly parallel.
_MIN_COSINE = float(np.cos(np.radians(15.0)))
# A shorter overlap with a wall is the end of an opening beside it, except half of a narrow opening.
_MIN_PIECE_M = 0.1
# Openings that share less than this of a wall touch.
TOUCHING_M = 0.01
_ROUNDING_M = 1e-6
# Longest piece of an opening that is compared with walls by its bounding box, unless it would have too many pieces.
_PIECE_M, _MAX_PIECES = 8.0, 16
# Openings that are compared at once.
_BATCH = 16


@dataclass(frozen=True, eq=False)
class Opening:
    """A door, window or passage of the plan.

    Attributes:
        kind: `door`, `window` or `passage` (an opening without a leaf).
        line_m: (2, 2) its two ends.
        sill_m, head_m: heights of its lower and upper edge over the floor; None if the plan does not give them.
        rooms: ids of the rooms that it belongs to; None for all rooms whose wall it lies on.
    """

    kind: str
    line_m: Float[np.ndarray, "2 2"]
    sill_m: float | None = None
    head_m: float | None = None
    name: str | None = None
    rooms: tuple[str, ...] | None = None

    @property
    def code(self) -> int:
        """The index of its kind in `conventions.OPENING_CLASSES`."""
        return OPENING_CLASSES.index(self.kind)


@dataclass(frozen=True, kw_only=True)
class OpeningFace:
    """The part of a room's wall that an opening occupies, with at most one room behind it.

    Attributes:
        wall: index of the wall in the room's `walls_m`.
        start, end: ends of the part, as shares of the wall's length.
        behind: index of the room behind, the room itself at a free-standing wall, -1 for none.
        exit_wall: index of the wall of the room behind that the opening leads through, -1 for none.
        exit_start, exit_end: ends of the opening on that wall, as shares of its length.
    """

    opening: int
    room: int
    wall: int
    start: float
    end: float
    behind: int = -1
    exit_wall: int = -1
    exit_start: float = 0.0
    exit_end: float = 0.0


@dataclass(frozen=True)
class _Contact:
    """An opening's overlap with a wall: range along the opening's line, distance, and side of the room."""

    room: int
    wall: int
    low: float
    high: float
    away_m: float
    side: int


class _Walls:
    """The walls of all rooms in one table with a spatial index."""

    def __init__(self, rooms: Sequence[Room]) -> None:
        counts = [len(room.walls_m) for room in rooms]
        self.room = np.repeat(np.arange(len(rooms)), counts)
        self.number = np.concatenate([np.arange(count) for count in counts])
        ends = np.concatenate([room.walls_m for room in rooms])
        self.is_free_standing = self.number >= np.repeat(
            [n - len(r.inner_walls_m) for n, r in zip(counts, rooms, strict=True)], counts
        )
        self.start, self.edge = ends[:, :2], ends[:, 2:] - ends[:, :2]
        self.length_m = np.hypot(*self.edge.T)
        self._first = np.concatenate([[0], np.cumsum(counts)])
        self._tree = shapely.STRtree(np.asarray(shapely.linestrings(ends.reshape(-1, 2, 2))))

    def near(
        self, line_m: Float[np.ndarray, "k 2 2"], tolerance_m: float
    ) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"], int]:
        """Return the sorted pairs (line, wall) whose bounding boxes are near each other, and the number of comparisons.

        Long lines are cut first, because the bounding box of a diagonal has walls that are far from it.
        """
        along = line_m[:, 1] - line_m[:, 0]
        pieces = np.clip(np.ceil(np.hypot(*along.T) / _PIECE_M), 1, _MAX_PIECES).astype(int)
        line = np.repeat(np.arange(len(line_m)), pieces)
        number = np.arange(len(line)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
        begin, end = (line_m[line, 0] + ((number + k) / pieces[line])[:, None] * along[line] for k in (0, 1))
        low, high = np.minimum(begin, end) - tolerance_m, np.maximum(begin, end) + tolerance_m
        piece, wall = self._tree.query(shapely.box(*low.T, *high.T))
        pairs = np.unique(line[piece] * len(self.room) + wall)
        return *np.divmod(pairs, len(self.room)), len(line) + len(wall)

    def shares(self, room: int, wall: int, ends_m: Sequence[tuple[float, float]]) -> list[float]:
        """Project points onto a wall; return shares of its length, ascending and clipped to 0 and 1."""
        index = self._first[room] + wall
        (x, y), (dx, dy) = self.start[index].tolist(), self.edge[index].tolist()
        squared = float(self.length_m[index]) ** 2
        return sorted(min(max(((px - x) * dx + (py - y) * dy) / squared, 0.0), 1.0) for px, py in ends_m)


def place_openings(
    openings: Sequence[Opening], rooms: Sequence[Room], tolerance_m: float, limits: PlanLimits
) -> tuple[tuple[OpeningFace, ...], tuple[int, ...]]:
    """Project openings onto the walls that they lie on.

    `tolerance_m`, the largest distance between an opening's line and a wall, is at least the thickness of a wall.

    Returns:
        faces of the openings, and the indices of openings that lie on no wall.
    """
    if not openings:
        return (), ()
    walls = _Walls(rooms)
    faces: list[OpeningFace] = []
    lost = []
    in_room = Counter[int]()
    for index, contacts in enumerate(_all_contacts(openings, rooms, walls, tolerance_m, limits)):
        found = [face for contact in contacts for face in _faces(index, openings[index], contact, contacts, walls)]
        faces += found
        if not found:
            lost.append(index)
        in_room.update(face.room for face in found)
        # Checked at every opening, because overlapping rooms can cut openings into thousands of faces.
        _check_counts(in_room, {face.room for face in found}, len(faces), rooms, limits)
    _check_overlaps(openings, faces, rooms)
    return tuple(faces), tuple(lost)


def label(opening: Opening, index: int) -> str:
    """Return an opening's name for messages."""
    return f"opening {index} ({opening.kind}{f' {opening.name!r}' if opening.name else ''})"


def _check_counts(
    in_room: Counter[int], changed: set[int], faces: int, rooms: Sequence[Room], limits: PlanLimits
) -> None:
    for room in changed:
        if in_room[room] > limits.max_openings_per_room:
            raise InvalidFloorPlanError(
                f"{in_room[room]} openings on its walls; the limit is {limits.max_openings_per_room} "
                "(PlanLimits.max_openings_per_room)",
                room=rooms[room].name,
            )
    if faces > limits.max_opening_faces:
        raise InvalidFloorPlanError(
            f"the openings cover more than {limits.max_opening_faces} parts of walls, the limit "
            "(PlanLimits.max_opening_faces); remove rooms and openings that lie on each other"
        )


def _all_contacts(
    openings: Sequence[Opening], rooms: Sequence[Room], walls: _Walls, tolerance_m: float, limits: PlanLimits
) -> Iterator[list[_Contact]]:
    """Yield the walls that each opening lies on, in batches that bound the memory."""
    by_id: dict[str, list[int]] = {}
    for number, room in enumerate(rooms):
        by_id.setdefault(room.id, []).append(number)
    compared = 0
    for first in range(0, len(openings), _BATCH):
        batch = openings[first : first + _BATCH]
        line_m = np.stack([opening.line_m for opening in batch])
        line, wall, comparisons = walls.near(line_m, tolerance_m)
        compared += comparisons
        if compared > limits.max_opening_pairs:
            raise InvalidFloorPlanError(
                f"the openings are near more than {limits.max_opening_pairs} walls in total, the limit "
                "(PlanLimits.max_opening_pairs); remove long openings, and rooms that lie on each other"
            )
        on_wall = _on_walls(line_m, line, wall, walls, tolerance_m)
        for number, opening in enumerate(batch):
            contacts = on_wall.get(number, [])
            if opening.rooms is not None:
                own = {room for name in opening.rooms for room in by_id.get(name, ())}
                contacts = [contact for contact in contacts if contact.room in own]
            if len(contacts) > limits.max_walls_per_opening:
                raise InvalidFloorPlanError(
                    f"{label(opening, first + number)} lies on {len(contacts)} walls; the limit is "
                    f"{limits.max_walls_per_opening} (PlanLimits.max_walls_per_opening)"
                )
            yield _nearest(contacts, float(np.hypot(*(line_m[number, 1] - line_m[number, 0]))))


def _on_walls(
    line_m: Float[np.ndarray, "k 2 2"],
    line: Int[np.ndarray, "n"],
    wall: Int[np.ndarray, "n"],
    walls: _Walls,
    tolerance_m: float,
) -> dict[int, list[_Contact]]:
    """Return the contacts of pairs (line, wall) that lie on each other, by line, in the order of the walls."""
    vector = line_m[:, 1] - line_m[:, 0]
    lengths_m = np.hypot(*vector.T)
    direction = vector / lengths_m[:, None]
    parallel = np.abs((walls.edge[wall] * direction[line]).sum(axis=1)) >= _MIN_COSINE * walls.length_m[wall]
    line, wall = line[parallel], wall[parallel]
    length_m, along = lengths_m[line], direction[line]
    first = walls.start[wall] - line_m[line, 0]
    ends = np.stack([first, first + walls.edge[wall]], axis=1)
    along_m = (ends * along[:, None]).sum(axis=2)
    aside_m = ends[..., 0] * along[:, 1:] - ends[..., 1] * along[:, :1]
    low, high = np.clip(along_m.min(axis=1), 0.0, length_m), np.clip(along_m.max(axis=1), 0.0, length_m)
    # Distance of the wall at both ends of its overlap with the opening.
    slope = np.divide(aside_m[:, 1] - aside_m[:, 0], along_m[:, 1] - along_m[:, 0])
    off_m = np.abs(aside_m[:, :1] + slope[:, None] * (np.stack([low, high], axis=1) - along_m[:, :1]))
    least_m = np.minimum(_MIN_PIECE_M, 0.5 * length_m)
    on = np.flatnonzero((off_m.max(axis=1) <= tolerance_m + _ROUNDING_M) & (high - low >= least_m))
    # A room lies to the left of its walls.
    side = np.sign((walls.edge[wall[on]] * along[on]).sum(axis=1)).astype(int)
    side[walls.is_free_standing[wall[on]]] = 0
    columns = (
        line[on],
        walls.room[wall[on]],
        walls.number[wall[on]],
        low[on] / length_m[on],
        high[on] / length_m[on],
        off_m[on].mean(axis=1),
        side,
    )
    found: dict[int, list[_Contact]] = {}
    for number, *values in zip(*(column.tolist() for column in columns), strict=True):
        found.setdefault(number, []).append(_Contact(*values))
    return found


def _nearest(contacts: Sequence[_Contact], length_m: float) -> list[_Contact]:
    """Keep only the nearest wall of a room at each point of an opening."""
    kept: list[_Contact] = []
    for contact in sorted(contacts, key=lambda contact: contact.away_m):
        own = (other for other in kept if other.room == contact.room)
        shared = [min(contact.high, other.high) - max(contact.low, other.low) for other in own]
        if length_m * max(shared, default=0.0) <= TOUCHING_M:
            kept.append(contact)
    return sorted(kept, key=lambda contact: (contact.room, contact.wall))


def _faces(
    index: int, opening: Opening, contact: _Contact, contacts: Sequence[_Contact], walls: _Walls
) -> list[OpeningFace]:
    """Split a contact wherever the room behind changes."""
    (x, y), (x1, y1) = opening.line_m.tolist()
    beyond = [contact] if contact.side == 0 else [other for other in contacts if other.side == -contact.side]
    least = TOUCHING_M / math.hypot(x1 - x, y1 - y)
    ends_beyond = {end for other in beyond for end in (other.low, other.high)}
    cuts = {end for end in ends_beyond if contact.low + least < end < contact.high - least}
    faces = []
    for low, high in pairwise(sorted({contact.low, contact.high, *cuts})):
        ends = [(x + share * (x1 - x), y + share * (y1 - y)) for share in (low, high)]
        own = walls.shares(contact.room, contact.wall, ends)
        middle = 0.5 * (low + high)
        behind = [other for other in beyond if other.low <= middle <= other.high]
        face = OpeningFace(opening=index, room=contact.room, wall=contact.wall, start=own[0], end=own[1])
        if behind:
            other = min(behind, key=lambda contact: contact.away_m)
            leaving = walls.shares(other.room, other.wall, ends)
            face = replace(face, behind=other.room, exit_wall=other.wall, exit_start=leaving[0], exit_end=leaving[1])
        faces.append(face)
    return faces


def _check_overlaps(openings: Sequence[Opening], faces: Sequence[OpeningFace], rooms: Sequence[Room]) -> None:
    """Refuse openings that overlap on a wall, unless their heights put one above the other."""
    on_wall: dict[tuple[int, int], list[OpeningFace]] = {}
    for face in faces:
        on_wall.setdefault((face.room, face.wall), []).append(face)
    for (room, wall), group in on_wall.items():
        length_m = float(np.hypot(*(rooms[room].walls_m[wall, 2:] - rooms[room].walls_m[wall, :2])))
        group.sort(key=lambda face: face.start)
        pair = _first_overlap([openings[face.opening] for face in group], group, length_m)
        if pair is not None:
            first, second = (group[k].opening for k in pair)
            raise InvalidFloorPlanError(
                f"{label(openings[first], first)} and {label(openings[second], second)} overlap; move one, or give "
                "both sill_m and head_m if one is above the other",
                room=rooms[room].name,
            )


def _first_overlap(
    openings: Sequence[Opening], faces: Sequence[OpeningFace], length_m: float
) -> tuple[int, int] | None:
    """Return the first two faces on a wall, sorted by start, whose openings overlap; None without any."""
    if len(faces) < 2:
        return None
    start, end = np.array([(face.start, face.end) for face in faces]).T
    number = np.array([face.opening for face in faces])
    sill_m, head_m = np.array([(opening.sill_m, opening.head_m) for opening in openings], float).T
    later = np.triu(np.ones((len(faces), len(faces)), bool), 1)
    shared = (np.minimum(end[:, None], end) - start) * length_m > TOUCHING_M
    # Faces after the first one that only touches are not compared.
    near = np.logical_and.accumulate(shared | ~later, axis=1) & later
    # Unknown heights are NaN, which is above nothing.
    stacked = (sill_m[:, None] >= head_m) | (sill_m >= head_m[:, None])
    pairs = np.argwhere(near & ~stacked & (number[:, None] != number))
    return (int(pairs[0, 0]), int(pairs[0, 1])) if len(pairs) else None


def is_above(sill_m: float | None, head_m: float | None) -> bool:
    """Return True if an opening with this sill is above one with this head; None means unknown."""
    return sill_m is not None and head_m is not None and sill_m >= head_m
