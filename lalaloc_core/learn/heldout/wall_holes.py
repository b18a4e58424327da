"""Doors, passages and windows: holes in walls and their fillings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import shapely
from jaxtyping import Float

from lalaloc_core.floorplan import FloorPlan, Room
from lalaloc_core.learn.heldout.grown_plans import HeldoutPlan

OpeningKind = Literal["open door", "shut door", "arch", "passage", "front door", "window"]
_CORNER_M = 0.1
_OUTLOOK_M = 1.6
_OUTER_WALL_M = 0.28
_MAX_WALL_M = 0.4
_PLAN_KINDS = {
    "open door": "door",
    "shut door": "door",
    "front door": "door",
    "arch": "passage",
    "passage": "passage",
    "window": "window",
}


@dataclass(frozen=True, eq=False)
class Wall:
    """Edge of a room: starts at `start_m`, runs along the unit vector `along`; `outward` points out of the room."""

    room: int
    edge: int
    start_m: Float[np.ndarray, "2"]
    along: Float[np.ndarray, "2"]
    length_m: float

    @property
    def outward(self) -> Float[np.ndarray, "2"]:
        """Unit normal out of the room."""
        return np.array([self.along[1], -self.along[0]])

    def point_m(self, along_m: float, out_m: float = 0.0) -> Float[np.ndarray, "2"]:
        """Return the point `along_m` from the start and `out_m` behind the wall's face."""
        return self.start_m + along_m * self.along + out_m * self.outward


@dataclass(frozen=True, kw_only=True, eq=False)
class Opening:
    """A hole through one wall, or through two walls back to back.

    Attributes:
        wall: the wall it is described in.
        behind: the wall of the room behind; None for windows and front doors.
        left_m, right_m: where along `wall` it begins and ends.
        sill_m, top_m: heights over the floor.
        depth_m: from the face of `wall` to the other face.
        swing: of an open door's leaf, radians.
    """

    kind: OpeningKind
    wall: Wall
    behind: Wall | None
    left_m: float
    right_m: float
    sill_m: float
    top_m: float
    depth_m: float
    swing: float = 0.0

    @property
    def arched(self) -> bool:
        """True for a passage with an arch."""
        return self.kind == "arch"


def walls_of(room: Room, index: int) -> list[Wall]:
    """Return the walls of room number `index`."""
    edges = room.walls_m[:, 2:] - room.walls_m[:, :2]
    lengths = np.linalg.norm(edges, axis=1)
    return [
        Wall(index, k, room.walls_m[k, :2], edges[k] / lengths[k], float(lengths[k])) for k in range(len(room.walls_m))
    ]


def sample_openings(plan: HeldoutPlan, rng: np.random.Generator) -> list[Opening]:
    """Draw doors that connect all rooms, a front door, and windows in outer walls."""
    rooms = plan.plan.rooms
    walls = [wall for index, room in enumerate(rooms) for wall in walls_of(room, index)]
    holes = _Holes(rooms)
    openings = _sample_doors(plan, walls, holes, rng)
    outer = [wall for wall in walls if wall.length_m > 0.9 and _has_outlook(wall, rooms)]
    fronts = [wall for wall in outer if wall.length_m > 1.3 and plan.kinds[wall.room] in ("living", "corridor")]
    if fronts:
        front = fronts[rng.integers(len(fronts))]
        left_m = rng.uniform(0.15, front.length_m - 1.15)
        openings.append(holes.open("front door", front, (left_m, left_m + 0.95), (0.0, 2.1), _OUTER_WALL_M))
    for wall in outer:
        openings += _sample_windows(wall, plan, holes, rng)
    return openings


def with_openings(plan: HeldoutPlan, openings: Sequence[Opening]) -> HeldoutPlan:
    """Return the plan with its openings."""
    rooms = plan.plan.rooms
    entries = [
        {
            "kind": _PLAN_KINDS[opening.kind],
            "line": [opening.wall.point_m(along_m).tolist() for along_m in (opening.left_m, opening.right_m)],
            "sill_m": opening.sill_m,
            "head_m": opening.top_m,
            "rooms": [rooms[wall.room].id for wall in (opening.wall, opening.behind) if wall is not None],
        }
        for opening in openings
    ]
    document = plan.plan.to_dict() | {
        "openings": entries,
        "opening_kinds": ["door", "window", "passage"],
        "opening_tolerance_m": _MAX_WALL_M,
    }
    return replace(plan, plan=FloorPlan.from_dict(document))


def _sample_doors(plan: HeldoutPlan, walls: list[Wall], holes: _Holes, rng: np.random.Generator) -> list[Opening]:
    contacts = [
        contact
        for first in walls
        for second in walls
        if first.room < second.room
        for contact in _contact(first, second)
    ]
    joined = {0}
    doors: list[Opening] = []
    waiting = [contacts[k] for k in rng.permutation(len(contacts))]
    pairs: set[tuple[int, int]] = set()
    while waiting:
        # Doors that connect a new room come first, then some that close loops.
        index = next((k for k, c in enumerate(waiting) if (c[0].room in joined) != (c[1].room in joined)), 0)
        first, second, low, high, depth = waiting.pop(index)
        new = (first.room in joined) != (second.room in joined)
        if (first.room, second.room) in pairs or not (new or rng.random() < 0.35):
            continue
        door = _sample_door(plan, first, second, (low, high), depth, holes, rng)
        if door is not None:
            doors.append(door)
            pairs.add((first.room, second.room))
            joined |= {first.room, second.room}
    return doors


def _sample_door(
    plan: HeldoutPlan,
    first: Wall,
    second: Wall,
    span: tuple[float, float],
    depth: float,
    holes: _Holes,
    rng: np.random.Generator,
) -> Opening | None:
    low, high = span[0] + _CORNER_M, span[1] - _CORNER_M
    social = {"living", "kitchen", "corridor"}
    wide = {plan.kinds[first.room], plan.kinds[second.room]} <= social and high - low > 1.5 and rng.random() < 0.5
    width = min(rng.uniform(1.4, 2.8), high - low) if wide else min(rng.uniform(0.72, 0.95), high - low)
    kinds: tuple[OpeningKind, ...] = ("passage", "arch") if wide else ("open door", "shut door", "arch", "passage")
    kind = kinds[rng.choice(len(kinds), p=(0.7, 0.3) if wide else (0.5, 0.32, 0.08, 0.1))]
    left = rng.uniform(low, max(low, high - width))
    ceiling = min(plan.plan.rooms[wall.room].ceiling_height_m for wall in (first, second))
    top = min(rng.uniform(2.0, 2.4) if wide else rng.uniform(1.98, 2.12), ceiling - 0.12)
    span_behind = _seen_from(second, first, left, left + width)
    if not (holes.is_free(first, left, left + width) and holes.is_free(second, *span_behind)):
        return None
    swing = float(np.radians(rng.uniform(15, 110)))
    return holes.open(kind, first, (left, left + width), (0.0, top), depth, behind=second, swing=swing)


def _sample_windows(wall: Wall, plan: HeldoutPlan, holes: _Holes, rng: np.random.Generator) -> list[Opening]:
    if plan.kinds[wall.room] == "closet" or rng.random() < (0.55 if plan.kinds[wall.room] == "corridor" else 0.25):
        return []
    ceiling = plan.plan.rooms[wall.room].ceiling_height_m
    count = max(1, int(rng.uniform(0.6, 1.0) * wall.length_m / 2.2))
    slot = wall.length_m / count
    full_length = rng.random() < 0.25 and plan.kinds[wall.room] in ("living", "bedroom", "kitchen")
    sill = 0.05 if full_length else rng.uniform(0.55, 1.1)
    top = min(rng.uniform(2.0, 2.45), ceiling - 0.1)
    width = min(rng.uniform(0.6, 2.0), slot - 0.25)
    lefts = [slot * k + (slot - width) / 2 for k in range(count)]
    return [
        holes.open("window", wall, (left, left + width), (sill, top), _OUTER_WALL_M)
        for left in lefts
        if holes.is_free(wall, left, left + width)
    ]


class _Holes:
    """Occupied stretches of the walls of a home."""

    def __init__(self, rooms: Sequence[Room]) -> None:
        self._rooms = rooms
        self._taken: dict[tuple[int, int], list[tuple[float, float]]] = {}

    def is_free(self, wall: Wall, left: float, right: float) -> bool:
        taken = self._taken.get((wall.room, wall.edge), [])
        return all(right + 0.15 < low or left - 0.15 > high for low, high in taken)

    def open(
        self,
        kind: OpeningKind,
        wall: Wall,
        span_m: tuple[float, float],
        heights_m: tuple[float, float],
        depth_m: float,
        *,
        behind: Wall | None = None,
        swing: float = 0.0,
    ) -> Opening:
        """Return an opening, and mark its stretch of the wall as taken."""
        (left, right), (sill, top) = span_m, heights_m
        self._taken.setdefault((wall.room, wall.edge), []).append((left, right))
        if behind is not None:
            self._taken.setdefault((behind.room, behind.edge), []).append(_seen_from(behind, wall, left, right))
        return Opening(
            kind=kind,
            wall=wall,
            behind=behind,
            left_m=float(left),
            right_m=float(right),
            sill_m=float(sill),
            top_m=float(min(top, self._rooms[wall.room].ceiling_height_m - 0.05)),
            depth_m=float(depth_m),
            swing=swing,
        )


def span_behind(opening: Opening) -> tuple[float, float]:
    """Return the ends of the opening along the wall behind."""
    assert opening.behind is not None
    return _seen_from(opening.behind, opening.wall, opening.left_m, opening.right_m)


def _seen_from(behind: Wall, wall: Wall, left: float, right: float) -> tuple[float, float]:
    ends = [float((wall.point_m(along_m) - behind.start_m) @ behind.along) for along_m in (right, left)]
    return ends[0], ends[1]


def _contact(first: Wall, second: Wall) -> list[tuple[Wall, Wall, float, float, float]]:
    """Return where two walls stand back to back: from, to (along `first`) and distance; at most one entry."""
    if first.along @ second.along > -0.99999:
        return []
    apart = float((second.start_m - first.start_m) @ first.outward)
    far = float((second.start_m - first.start_m) @ first.along)
    low, high = max(0.0, far - second.length_m), min(first.length_m, far)
    return [(first, second, low, high, apart)] if 0.03 < apart < _MAX_WALL_M and high - low > 0.95 else []


def _has_outlook(wall: Wall, rooms: tuple[Room, ...]) -> bool:
    corners = [wall.point_m(0.0, 0.02), wall.point_m(wall.length_m, 0.02)]
    corners += [wall.point_m(wall.length_m, _OUTLOOK_M), wall.point_m(0.0, _OUTLOOK_M)]
    outlook = shapely.Polygon(corners)
    return not any(outlook.intersects(room.shape) for room in rooms)
