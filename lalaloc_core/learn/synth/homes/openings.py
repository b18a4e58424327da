"""Doors, wide openings and windows between rooms and to the outdoors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import shapely
from jaxtyping import Float

OpeningKind = Literal["door_shut", "door_open", "opening", "window"]

_CORNER_CLEARANCE_M = 0.06
_MIN_DOOR_M = 0.65
_MAX_OPENING_M = 5.0
_WIDE_M = 1.2
# Shares of open doors per home (closed, usual, all open), and the probability of each.
_OPEN_SHARES, _OPEN_SHARE_SHARES = (0.3, 0.65, 0.95), (0.2, 0.4, 0.4)
_PUBLIC = ("living", "kitchen", "corridor", "dining", "hall")
_WINDOWLESS = ("corridor", "closet", "storage")


@dataclass(frozen=True, kw_only=True)
class Opening:
    """A hole in one wall of one room, as seen from that room; a door between two rooms is two openings.

    Attributes:
        wall: index of the edge of the room's `polygon_m`.
        kind: kind of opening; open doors, wide openings and windows are see-through.
        neighbour: index of the room behind it, -1 for the outdoors or a room outside the plan.
    """

    room: int
    wall: int
    start_m: float
    end_m: float
    sill_m: float
    head_m: float
    kind: OpeningKind
    neighbour: int

    @property
    def is_see_through(self) -> bool:
        """True if another room of the plan is visible through it."""
        return self.kind in ("door_open", "opening") and self.neighbour >= 0


class _Facing(NamedTuple):
    """Two walls that face each other across one wall thickness; both intervals are metres along their walls."""

    first: tuple[int, int]
    second: tuple[int, int]
    first_interval: tuple[float, float]
    second_interval: tuple[float, float]

    @property
    def length_m(self) -> float:
        return self.first_interval[1] - self.first_interval[0]


class _Walls:
    """Edges of all rooms in one table, and their occupied stretches."""

    def __init__(self, polygons_m: Sequence[Float[np.ndarray, "_ 2"]]) -> None:
        self.owner = [(room, edge) for room, polygon in enumerate(polygons_m) for edge in range(len(polygon))]
        self.start = np.concatenate(polygons_m)
        self.along = np.concatenate([np.roll(polygon, -1, axis=0) - polygon for polygon in polygons_m])
        self.length = np.linalg.norm(self.along, axis=1)
        self.along = self.along / self.length[:, None]
        self._taken: dict[tuple[int, int], list[tuple[float, float]]] = {}

    def is_free(self, wall: tuple[int, int], start: float, end: float) -> bool:
        return all(end + 0.12 < taken[0] or start - 0.12 > taken[1] for taken in self._taken.get(wall, []))

    def open(
        self,
        wall: tuple[int, int],
        span_m: tuple[float, float],
        heights_m: tuple[float, float],
        kind: OpeningKind,
        neighbour: int = -1,
    ) -> Opening:
        """Return an opening of a wall, whose stretch is then occupied; heights are those of sill and head."""
        self._taken.setdefault(wall, []).append(span_m)
        (room, edge), (start, end), (sill, head) = wall, span_m, heights_m
        return Opening(
            room=room,
            wall=edge,
            start_m=start,
            end_m=end,
            sill_m=float(sill),
            head_m=float(head),
            kind=kind,
            neighbour=neighbour,
        )

    def facing(self, max_gap_m: float) -> list[_Facing]:
        """Return all pairs of walls of different rooms that face each other over at least the width of a door."""
        normal = np.stack([-self.along[:, 1], self.along[:, 0]], axis=1)
        offset = self.start[None, :] - self.start[:, None]
        # A room lies to the left of its walls, so a facing wall lies to the right: negative along the normal.
        gap = -(offset * normal[:, None]).sum(axis=-1)
        near = (self.along @ self.along.T < -0.9999) & (gap > 0.0) & (gap < max_gap_m)
        found = []
        for i, j in np.argwhere(np.triu(near)):
            if self.owner[i][0] == self.owner[j][0]:
                continue
            shift = float(offset[i, j] @ self.along[i])
            low, high = max(0.0, shift - float(self.length[j])), min(float(self.length[i]), shift)
            low, high = low + _CORNER_CLEARANCE_M, high - _CORNER_CLEARANCE_M
            if high - low >= _MIN_DOOR_M:
                found.append(_Facing(self.owner[i], self.owner[j], (low, high), (shift - high, shift - low)))
        return found


def place_openings(
    names: Sequence[str],
    polygons_m: Sequence[Float[np.ndarray, "_ 2"]],
    ceilings_m: Sequence[float],
    cells_m: Sequence[Float[np.ndarray, "_ 2"]],
    max_gap_m: float,
    rng: np.random.Generator,
    *,
    french_window_share: float,
) -> tuple[Opening, ...]:
    """Place doors, openings and windows that do not touch each other.

    Room names decide the places of windows and wide openings. Outlines are counter-clockwise; everything outside
    `cells_m`, the gross cells, is outdoors. Two walls at most `max_gap_m` apart can share a door. `french_window_share`
    is the share of windows that reach down to the floor.
    """
    walls = _Walls(polygons_m)
    openings = _connect_rooms(walls, names, ceilings_m, max_gap_m, rng)
    openings += _windows(walls, names, ceilings_m, cells_m, rng, french_window_share)
    openings += _blind_doors(walls, {opening.room for opening in openings if opening.kind != "window"}, rng)
    return tuple(openings)


def _connect_rooms(
    walls: _Walls, names: Sequence[str], ceilings_m: Sequence[float], max_gap_m: float, rng: np.random.Generator
) -> list[Opening]:
    """Return a spanning tree of doors, and a few more."""
    group = list(range(len(names)))
    openings: list[Opening] = []
    facings = walls.facing(max_gap_m)
    public = [name.startswith(_PUBLIC) for name in names]
    open_share = float(rng.choice(_OPEN_SHARES, p=_OPEN_SHARE_SHARES))
    rank = [rng.random() + public[f.first[0]] + public[f.second[0]] for f in facings]
    for index in np.argsort(rank)[::-1]:
        facing = facings[index]
        i, j = facing.first[0], facing.second[0]
        joins = group[i] != group[j]
        if not joins and rng.random() > 0.25:
            continue
        pair = _door_or_opening(
            walls, facing, public[i] and public[j], min(ceilings_m[i], ceilings_m[j]), open_share, rng
        )
        openings += pair
        if joins and pair:
            group = [group[i] if g == group[j] else g for g in group]
    return openings


def _door_or_opening(
    walls: _Walls, facing: _Facing, is_public: bool, ceiling_m: float, open_share: float, rng: np.random.Generator
) -> list[Opening]:
    kind: OpeningKind = "door_open" if rng.random() < open_share else "door_shut"
    width, head = rng.uniform(_MIN_DOOR_M, 1.0), rng.uniform(1.95, min(2.15, ceiling_m - 0.1))
    if rng.random() < 0.1:
        width = rng.uniform(1.2, 1.7)
    # Doors stand near a corner more often than in the middle of a wall.
    side = float(np.clip(rng.choice([0.0, 1.0, rng.random()]) + rng.normal(0.0, 0.05), 0.0, 1.0))
    if rng.random() < (0.7 if is_public else 0.06):
        kind = "opening"
        head = ceiling_m if rng.random() < 0.45 else rng.uniform(2.0, ceiling_m)
        stubs = np.where(rng.random(2) < 0.3, 0.0, rng.uniform(0.05, 0.6, 2))
        if is_public and rng.random() < 0.6 and facing.length_m - stubs.sum() > _WIDE_M:
            # Open plan: at most stubs remain at the ends of the wall.
            width, side = facing.length_m - stubs.sum(), stubs[0] / max(stubs.sum(), 1e-6)
        elif is_public:
            width = rng.uniform(0.8, max(0.9, facing.length_m))
    width = min(width, facing.length_m, _MAX_OPENING_M)
    shift = (facing.length_m - width) * float(side)
    first = (facing.first_interval[0] + shift, facing.first_interval[0] + shift + width)
    second = (facing.second_interval[1] - shift - width, facing.second_interval[1] - shift)
    if not (walls.is_free(facing.first, *first) and walls.is_free(facing.second, *second)):
        return []
    return [
        walls.open(wall, span, (0.0, head), kind, other[0])
        for wall, span, other in ((facing.first, first, facing.second), (facing.second, second, facing.first))
    ]


def _windows(
    walls: _Walls,
    names: Sequence[str],
    ceilings_m: Sequence[float],
    cells_m: Sequence[Float[np.ndarray, "_ 2"]],
    rng: np.random.Generator,
    french_share: float,
) -> list[Opening]:
    outward = np.stack([walls.along[:, 1], -walls.along[:, 0]], axis=1)
    probe = walls.start[:, None] + walls.along[:, None] * (
        walls.length[:, None, None] * np.array([0.2, 0.5, 0.8])[:, None]
    )
    probe = probe + 0.5 * outward[:, None]
    indoors = np.zeros(probe.shape[:2], dtype=bool)
    for cell in cells_m:
        indoors |= shapely.contains_xy(shapely.Polygon(cell), probe[..., 0], probe[..., 1])
    openings = []
    for index, (room, edge) in enumerate(walls.owner):
        length = float(walls.length[index])
        if length < 0.9 or indoors[index].any() or names[room].startswith(_WINDOWLESS) or rng.random() < 0.25:
            continue
        for _ in range(1 + int(length > 3.0 and rng.random() < 0.5)):
            widest = 5.0 if rng.random() < 0.2 else 2.8
            width = rng.uniform(0.5, min(widest, length - 0.3))
            start = rng.uniform(0.12, length - width - 0.12)
            if not walls.is_free((room, edge), start, start + width):
                continue
            sill = rng.uniform(0.0, 0.08) if rng.random() < french_share else rng.uniform(0.5, 1.2)
            head = rng.uniform(max(sill + 0.5, 1.8), ceilings_m[room] - 0.08)
            openings.append(walls.open((room, edge), (start, start + width), (sill, head), "window"))
    return openings


def _blind_doors(walls: _Walls, connected: set[int], rng: np.random.Generator) -> list[Opening]:
    """Return closed doors that lead outside the plan: entrances, cupboards, and the door of an unconnected room."""
    openings = []
    without_door = {room for room, _ in walls.owner} - connected
    for index in rng.permutation(len(walls.owner)):
        room, edge = walls.owner[index]
        length = float(walls.length[index])
        wanted = room in without_door or rng.random() < 0.08
        if not wanted or length < _MIN_DOOR_M + 0.2:
            continue
        width = rng.uniform(_MIN_DOOR_M, min(1.0 if rng.random() < 0.7 else 2.0, length - 0.15))
        start = rng.uniform(0.06, length - width - 0.06)
        if not walls.is_free((room, edge), start, start + width):
            continue
        without_door.discard(room)
        head = rng.uniform(1.95, 2.12)
        openings.append(walls.open((room, edge), (start, start + width), (0.0, head), "door_shut"))
    return openings
