"""Rooms as plain drawings, before they are part of a plan: an outline, what is in its walls, and how to move it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely
from jaxtyping import Float

from lalaloc_core.conventions import OPENING_CLASSES, ROOM_TYPES
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.drawn_openings import DrawnOpening

# Openings are drawn on their walls, but for rounding.
_ON_THE_WALL_M = 0.01


@dataclass(frozen=True, eq=False, kw_only=True)
class DrawnRoom:
    """A room in a frame of its own.

    Attributes:
        polygon_m: counter-clockwise, not closed.
        openings: on the outline, without heights.
        room_type: one of `conventions.ROOM_TYPES`.
    """

    name: str
    polygon_m: Float[np.ndarray, "n 2"]
    ceiling_height_m: float
    openings: tuple[DrawnOpening, ...] = ()
    room_type: str = ROOM_TYPES[0]

    @property
    def size_m(self) -> float:
        """Side of the square of the same area."""
        return float(np.sqrt(shapely.Polygon(self.polygon_m).area))

    @property
    def extent_m(self) -> Float[np.ndarray, "2"]:
        """Width and depth of the box around it, along the axes."""
        return np.ptp(self.polygon_m, axis=0)

    @property
    def main_direction(self) -> float:
        """Angle (radians, counter-clockwise from +x, in (-π/4, π/4]) of its walls, longer ones counting for more.

        Turned by its negative, most of the walls of a right-angled room run along the axes.
        """
        edges = np.roll(self.polygon_m, -1, axis=0) - self.polygon_m
        # Four times the angle is the same for all four directions of right-angled walls.
        turned = np.exp(4j * np.arctan2(edges[:, 1], edges[:, 0]))
        return float(np.angle((np.hypot(*edges.T) * turned).sum())) / 4.0

    def turned(self, angle: float) -> DrawnRoom:
        """Turned about the origin, counter-clockwise by radians."""
        cosine, sine = np.cos(angle), np.sin(angle)
        return self._mapped(np.array([[cosine, -sine], [sine, cosine]]))

    def scaled(self, factor: float) -> DrawnRoom:
        """Larger by a factor in the plane; ceilings stay."""
        return self._mapped(factor * np.eye(2))

    def mirrored(self) -> DrawnRoom:
        """Its mirror image, x to -x."""
        drawn = self._mapped(np.diag([-1.0, 1.0]))
        return replace(drawn, polygon_m=drawn.polygon_m[::-1].copy())

    def moved(self, by_m: Float[np.ndarray, "2"]) -> DrawnRoom:
        """Moved by (x, y)."""
        openings = tuple(replace(one, line_m=one.line_m + by_m) for one in self.openings)
        return replace(self, polygon_m=self.polygon_m + by_m, openings=openings)

    @property
    def walls_m(self) -> Float[np.ndarray, "n 4"]:
        """Wall segments (x0, y0, x1, y1), one per edge of the polygon."""
        return np.concatenate([self.polygon_m, np.roll(self.polygon_m, -1, axis=0)], axis=1)

    def _mapped(self, matrix: Float[np.ndarray, "2 2"]) -> DrawnRoom:
        openings = tuple(replace(one, line_m=one.line_m @ matrix.T) for one in self.openings)
        return replace(self, polygon_m=self.polygon_m @ matrix.T, openings=openings)


def plan_of_rooms(name: str, rooms: Sequence[DrawnRoom], camera_height_m: float) -> FloorPlan:
    """A floor plan of rooms where they were drawn, which shows all of their openings.

    Raises:
        InvalidFloorPlanError: an outline cannot be a room's, or openings overlap.
    """
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
