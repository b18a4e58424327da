"""Openings: projection of each opening's line onto the walls of all rooms that it belongs to.

A door between two rooms is one entry of the plan. Room polygons are the inner faces of walls, a wall's thickness apart,
so an opening is projected at right angles onto every wall that is nearly parallel and near enough. If several walls of
a room lie behind each other, only the nearest gets the opening.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import shapely
from jaxtyping import Float

from lalaloc_core.conventions import OPENING_CLASSES
from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan.limits import PlanLimits
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
        self._tree = shapely.STRtree([shapely.LineString(wall) for wall in ends.reshape(-1, 2, 2)])

    def near(self, line_m: Float[np.ndarray, "2 2"], tolerance_m: float) -> np.ndarray:
        """Return the indices of walls whose bounding boxes are near a line."""
        low, high = line_m.min(axis=0) - tolerance_m, line_m.max(axis=0) + tolerance_m
        return np.sort(self._tree.query(shapely.box(*low, *high)))

    def shares(self, room: int, wall: int, points_m: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n"]:
        """Project points onto a wall; return shares of its length, clipped to 0 and 1."""
        index = self._first[room] + wall
        along = (points_m - self.start[index]) @ self.edge[index] / self.length_m[index] ** 2
        return np.clip(along, 0.0, 1.0)


def place_openings(
    openings: Sequence[Opening], rooms: Sequence[Room], tolerance_m: float, limits: PlanLimits
) -> tuple[tuple[OpeningFace, ...], tuple[int, ...]]:
    """Project openings onto the walls that they lie on.

    `tolerance_m`, the largest distance between an opening's line and a wall, is at least the thickness of a wall.

    Returns:
        faces of the openings, and the indices of openings that lie on no wall.

    Raises:
        InvalidFloorPlanError: openings overlap, or a room or an opening has too many faces.
    """
    if not openings:
        return (), ()
    walls = _Walls(rooms)
    by_id: dict[str, list[int]] = {}
    for number, room in enumerate(rooms):
        by_id.setdefault(room.id, []).append(number)
    faces: list[OpeningFace] = []
    lost = []
    for index, opening in enumerate(openings):
        contacts = _contacts(index, opening, by_id, walls, tolerance_m, limits)
        found = [face for contact in contacts for face in _faces(index, opening, contact, contacts, walls)]
        faces += found
        if not found:
            lost.append(index)
    for room, count in Counter(face.room for face in faces).items():
        if count > limits.max_openings_per_room:
            raise InvalidFloorPlanError(
                f"{count} openings on its walls; the limit is {limits.max_openings_per_room} "
                "(PlanLimits.max_openings_per_room)",
                room=rooms[room].name,
            )
    _check_overlaps(openings, faces, rooms)
    return tuple(faces), tuple(lost)


def label(opening: Opening, index: int) -> str:
    """Return an opening's name for messages."""
    return f"opening {index} ({opening.kind}{f' {opening.name!r}' if opening.name else ''})"


def _contacts(
    index: int, opening: Opening, by_id: dict[str, list[int]], walls: _Walls, tolerance_m: float, limits: PlanLimits
) -> list[_Contact]:
    """Return the walls that an opening lies on; at each point of the opening only the nearest wall of a room."""
    start = opening.line_m[0]
    along = opening.line_m[1] - start
    length_m = float(np.hypot(*along))
    direction = along / length_m
    near = walls.near(opening.line_m, tolerance_m)
    if opening.rooms is not None:
        near = near[np.isin(walls.room[near], [room for name in opening.rooms for room in by_id.get(name, [])])]
    near = near[np.abs(walls.edge[near] @ direction) >= _MIN_COSINE * walls.length_m[near]]
    first = walls.start[near] - start
    ends = np.stack([first, first + walls.edge[near]], axis=1)
    along_m = ends @ direction
    aside_m = ends[..., 0] * direction[1] - ends[..., 1] * direction[0]
    low, high = np.clip(along_m.min(axis=1), 0.0, length_m), np.clip(along_m.max(axis=1), 0.0, length_m)
    # Distance of the wall at both ends of its overlap with the opening.
    slope = np.divide(aside_m[:, 1] - aside_m[:, 0], along_m[:, 1] - along_m[:, 0])
    off_m = aside_m[:, :1] + slope[:, None] * (np.stack([low, high], axis=1) - along_m[:, :1])
    least_m = min(_MIN_PIECE_M, 0.5 * length_m)
    on = (np.abs(off_m).max(axis=1) <= tolerance_m + _ROUNDING_M) & (high - low >= least_m)
    if on.sum() > limits.max_walls_per_opening:
        raise InvalidFloorPlanError(
            f"{label(opening, index)} lies on {on.sum()} walls; the limit is {limits.max_walls_per_opening} "
            "(PlanLimits.max_walls_per_opening)"
        )
    away_m = np.abs(off_m).mean(axis=1)
    contacts: list[_Contact] = []
    for k in np.flatnonzero(on)[np.argsort(away_m[on], kind="stable")]:
        wall = near[k]
        # A room lies to the left of its walls.
        side = 0 if walls.is_free_standing[wall] else int(np.sign(walls.edge[wall] @ direction))
        contact = _Contact(
            int(walls.room[wall]),
            int(walls.number[wall]),
            float(low[k] / length_m),
            float(high[k] / length_m),
            float(away_m[k]),
            side,
        )
        shared_m = [_shared(contact, other) * length_m for other in contacts if other.room == contact.room]
        if max(shared_m, default=0.0) <= TOUCHING_M:
            contacts.append(contact)
    return sorted(contacts, key=lambda contact: (contact.room, contact.wall))


def _shared(first: _Contact, second: _Contact) -> float:
    return min(first.high, second.high) - max(first.low, second.low)


def _faces(
    index: int, opening: Opening, contact: _Contact, contacts: Sequence[_Contact], walls: _Walls
) -> list[OpeningFace]:
    """Split a contact wherever the room behind changes."""
    start, along = opening.line_m[0], opening.line_m[1] - opening.line_m[0]
    beyond = [contact] if contact.side == 0 else [other for other in contacts if other.side == -contact.side]
    least = TOUCHING_M / float(np.hypot(*along))
    ends_beyond = {end for other in beyond for end in (other.low, other.high)}
    cuts = {end for end in ends_beyond if contact.low + least < end < contact.high - least}
    faces = []
    for low, high in pairwise(sorted({contact.low, contact.high, *cuts})):
        ends = start + np.array([[low], [high]]) * along
        own = sorted(walls.shares(contact.room, contact.wall, ends).tolist())
        middle = 0.5 * (low + high)
        behind = [other for other in beyond if other.low <= middle <= other.high]
        face = OpeningFace(opening=index, room=contact.room, wall=contact.wall, start=own[0], end=own[1])
        if behind:
            other = min(behind, key=lambda contact: contact.away_m)
            leaving = sorted(walls.shares(other.room, other.wall, ends).tolist())
            face = OpeningFace(
                opening=index,
                room=contact.room,
                wall=contact.wall,
                start=own[0],
                end=own[1],
                behind=other.room,
                exit_wall=other.wall,
                exit_start=leaving[0],
                exit_end=leaving[1],
            )
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
        for k, face in enumerate(group):
            for other in group[k + 1 :]:
                if (min(face.end, other.end) - other.start) * length_m <= TOUCHING_M:
                    break
                first, second = openings[face.opening], openings[other.opening]
                if face.opening != other.opening and not _stacked(first, second):
                    raise InvalidFloorPlanError(
                        f"{label(first, face.opening)} and {label(second, other.opening)} overlap; move one, or give "
                        "both sill_m and head_m if one is above the other",
                        room=rooms[room].name,
                    )


def _stacked(first: Opening, second: Opening) -> bool:
    return is_above(first.sill_m, second.head_m) or is_above(second.sill_m, first.head_m)


def is_above(sill_m: float | None, head_m: float | None) -> bool:
    """Return True if an opening with this sill is above one with this head; None means unknown."""
    return sill_m is not None and head_m is not None and sill_m >= head_m
