"""Rooms and openings as plain drawings, not yet part of a plan.

Data sets draw openings often once per room; `opening_entries` converts them to single entries of a plan.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import shapely
from jaxtyping import Float

from lalaloc_core.conventions import OPENING_CLASSES, ROOM_TYPES
from lalaloc_core.floorplan import DEFAULT_OPENING_TOLERANCE_M, FloorPlan
from lalaloc_core.floorplan.openings import TOUCHING_M, is_above

# Shorter openings are drawing errors.
_MIN_LENGTH_M = 0.02
# Openings belong to the same wall if their lines are parallel within 15 degrees.
_MIN_COSINE = 0.966


@dataclass(frozen=True, eq=False, kw_only=True)
class DrawnOpening:
    """Door, window or passage of a data set; `rooms` is empty if only its position determines them."""

    kind: str
    line_m: Float[np.ndarray, "2 2"]
    sill_m: float | None = None
    head_m: float | None = None
    rooms: tuple[str, ...] = ()


def opening_entries(drawn: Sequence[DrawnOpening], ids: dict[str, str]) -> tuple[list[dict[str, Any]], list[str]]:
    """Return the entries of a plan's `openings`, each opening once, and warnings about those left out.

    The first of two overlapping openings is kept. The far side of the same door causes no warning. `ids` maps the names
    of the plan's rooms to their ids.
    """
    kept: list[DrawnOpening] = []
    warnings = []
    for opening in drawn:
        length_m = float(np.hypot(*(opening.line_m[1] - opening.line_m[0])))
        if length_m < _MIN_LENGTH_M:
            warnings.append(f"a {opening.kind} of {length_m:.2f} m is left out: the minimum is {_MIN_LENGTH_M:g} m")
            continue
        shared_m = max((_shared_m(previous, opening) for previous in kept), default=0.0)
        if shared_m > TOUCHING_M:
            if shared_m < 0.5 * length_m:
                x, y = opening.line_m.mean(axis=0)
                warnings.append(f"a {opening.kind} at ({x:.2f}, {y:.2f}) m is left out: it overlaps another opening")
            continue
        kept.append(opening)
    return [_entry(opening, ids) for opening in kept], warnings


def _shared_m(first: DrawnOpening, second: DrawnOpening) -> float:
    """Return the length of wall shared by two openings; 0 on different walls or above each other."""
    if is_above(first.sill_m, second.head_m) or is_above(second.sill_m, first.head_m):
        return 0.0
    start = first.line_m[0]
    along = first.line_m[1] - start
    length_m = float(np.hypot(*along))
    along = along / length_m
    offset = second.line_m - start
    direction = second.line_m[1] - second.line_m[0]
    if abs(float(along @ direction)) < _MIN_COSINE * float(np.hypot(*direction)):
        return 0.0
    if np.abs(offset @ np.array([-along[1], along[0]])).min() > DEFAULT_OPENING_TOLERANCE_M:
        return 0.0
    low, high = np.sort(offset @ along)
    return float(min(length_m, high) - max(0.0, low))


def _entry(opening: DrawnOpening, ids: dict[str, str]) -> dict[str, Any]:
    entry: dict[str, Any] = {"kind": opening.kind, "line": opening.line_m.tolist()}
    if opening.sill_m is not None and opening.head_m is not None and 0.0 <= opening.sill_m < opening.head_m:
        entry |= {"sill_m": opening.sill_m, "head_m": opening.head_m}
    rooms = [ids[room] for room in opening.rooms if room in ids]
    return entry | ({"rooms": rooms} if rooms else {})


# Openings are drawn on their walls; the tolerance covers rounding.
_ON_THE_WALL_M = 0.01


@dataclass(frozen=True, eq=False, kw_only=True)
class DrawnRoom:
    """Room in its own frame.

    The polygon is counter-clockwise, not closed; openings lie on it, without heights.
    """

    name: str
    polygon_m: Float[np.ndarray, "n 2"]
    ceiling_height_m: float
    openings: tuple[DrawnOpening, ...] = ()
    room_type: str = ROOM_TYPES[0]

    @property
    def size_m(self) -> float:
        """Side of a square of the same area."""
        return float(np.sqrt(shapely.Polygon(self.polygon_m).area))

    @property
    def extent_m(self) -> Float[np.ndarray, "2"]:
        """Width and depth of the bounding box."""
        return np.ptp(self.polygon_m, axis=0)

    @property
    def main_direction(self) -> float:
        """Direction of the walls weighted by length (radians, counter-clockwise from +x, in (-π/4, π/4])."""
        edges = np.roll(self.polygon_m, -1, axis=0) - self.polygon_m
        # Multiplying the angle by four makes the directions of right-angled walls equal.
        turned = np.exp(4j * np.arctan2(edges[:, 1], edges[:, 0]))
        return float(np.angle((np.hypot(*edges.T) * turned).sum())) / 4.0

    def turned(self, angle: float) -> DrawnRoom:
        """Rotate counter-clockwise about the origin, by radians."""
        cosine, sine = np.cos(angle), np.sin(angle)
        return self._mapped(np.array([[cosine, -sine], [sine, cosine]]))

    def scaled(self, factor: float) -> DrawnRoom:
        """Scale in the plane; the ceiling height stays."""
        return self._mapped(factor * np.eye(2))

    def mirrored(self) -> DrawnRoom:
        """Mirror x to -x."""
        drawn = self._mapped(np.diag([-1.0, 1.0]))
        return replace(drawn, polygon_m=drawn.polygon_m[::-1].copy())

    def moved(self, by_m: Float[np.ndarray, "2"]) -> DrawnRoom:
        """Move by (x, y)."""
        openings = tuple(replace(opening, line_m=opening.line_m + by_m) for opening in self.openings)
        return replace(self, polygon_m=self.polygon_m + by_m, openings=openings)

    @property
    def walls_m(self) -> Float[np.ndarray, "n 4"]:
        """Wall segments (x0, y0, x1, y1), one per edge of the polygon."""
        return np.concatenate([self.polygon_m, np.roll(self.polygon_m, -1, axis=0)], axis=1)

    def _mapped(self, matrix: Float[np.ndarray, "2 2"]) -> DrawnRoom:
        openings = tuple(replace(opening, line_m=opening.line_m @ matrix.T) for opening in self.openings)
        return replace(self, polygon_m=self.polygon_m @ matrix.T, openings=openings)


def drawn_room(name: str, plan: FloorPlan, index: int) -> DrawnRoom:
    """Return a room of a plan with its openings, without their heights."""
    room = plan.rooms[index]
    openings = []
    for face in plan.opening_faces:
        if face.room == index:
            start, end = room.walls_m[face.wall].reshape(2, 2)
            line_m = start + np.array([[face.start], [face.end]]) * (end - start)
            openings.append(DrawnOpening(kind=plan.openings[face.opening].kind, line_m=line_m))
    return DrawnRoom(
        name=name,
        polygon_m=room.polygon_m,
        ceiling_height_m=room.ceiling_height_m,
        openings=tuple(openings),
        room_type=room.type,
    )


def plan_of_rooms(name: str, rooms: Sequence[DrawnRoom], camera_height_m: float) -> FloorPlan:
    """Build a floor plan of rooms at their drawn positions, complete with openings."""
    numbered = [(f"room-{number}", room) for number, room in enumerate(rooms)]
    return FloorPlan.from_dict(
        {
            "name": name,
            "camera_height_m": camera_height_m,
            "rooms": [
                {
                    "id": key,
                    "name": room.name,
                    "type": room.room_type,
                    "polygon": room.polygon_m.tolist(),
                    "ceiling_height_m": room.ceiling_height_m,
                }
                for key, room in numbered
            ],
            "openings": [
                {"kind": opening.kind, "line": opening.line_m.tolist(), "rooms": [key]}
                for key, room in numbered
                for opening in room.openings
            ],
            "opening_kinds": list(OPENING_CLASSES[1:]),
            "opening_tolerance_m": _ON_THE_WALL_M,
        }
    )
