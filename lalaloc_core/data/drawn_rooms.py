"""Rooms as plain drawings, before they are part of a plan: an outline, what is in its walls, and how to move it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import shapely
from jaxtyping import Float

DrawnKind = Literal["door", "window", "passage"]


@dataclass(frozen=True, eq=False)
class DrawnOpening:
    """A door, window or passage: its ends (x, y) on the outline, in metres."""

    kind: DrawnKind
    line_m: Float[np.ndarray, "2 2"]


@dataclass(frozen=True, eq=False, kw_only=True)
class DrawnRoom:
    """A room in a frame of its own.

    Attributes:
        polygon_m: counter-clockwise, not closed.
        room_type: what the room is for, in the words of whoever drew it; None where nothing is said.
    """

    name: str
    polygon_m: Float[np.ndarray, "n 2"]
    ceiling_height_m: float
    openings: tuple[DrawnOpening, ...] = ()
    room_type: str | None = None

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

    def _mapped(self, matrix: Float[np.ndarray, "2 2"]) -> DrawnRoom:
        openings = tuple(replace(one, line_m=one.line_m @ matrix.T) for one in self.openings)
        return replace(self, polygon_m=self.polygon_m @ matrix.T, openings=openings)
