"""Rooms as plain drawings, not yet part of a plan: outline, openings, and transformations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely
from jaxtyping import Float

from lalaloc_core.conventions import OPENING_CLASSES, ROOM_TYPES
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.learn.data.drawn_openings import DrawnOpening

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
        """Direction of the walls weighted by length (radians, counter-clockwise from +x, in (-π/4, π/4]).

        Rotated by the negative angle, most walls of a right-angled room are parallel to the axes.
        """
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


def plan_of_rooms(name: str, rooms: Sequence[DrawnRoom], camera_height_m: float) -> FloorPlan:
    """Build a floor plan of rooms at their drawn positions, complete with openings.

    Raises:
        InvalidFloorPlanError: an outline is not a valid room, or openings overlap.
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
