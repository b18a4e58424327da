"""A vector drawing before it is understood: shapes with the layer that they lie on, in the drawing's own units.

SVG, PDF and DXF become a `Drawing`; `understand` makes rooms and openings of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
import shapely
from jaxtyping import Float
from shapely.geometry.base import BaseGeometry

from lalaloc_core.importers.model.words import Role

# Curves are followed to this share of their size.
# Fills of less luminance (of 255) may be walls; a curve becomes so many straight pieces.
DARK = 110.0
CURVE_STEPS = 12
_STEPS = 24
_QUARTER_DEG = (55.0, 125.0)
_ROUND = 0.03


@dataclass(frozen=True, eq=False)
class Area:
    """A closed shape."""

    shape: shapely.Polygon
    layer: str
    role: Role | None = None
    name: str | None = None
    # Words that tell what a room is for, such as the class of an SVG element.
    kind: str | None = None
    # Dark enough to be a wall; None where the drawing says nothing of filling.
    is_dark: bool | None = None


@dataclass(frozen=True, eq=False)
class Stroke:
    """A polyline; `width` is that of the pen, 0 where the drawing gives none."""

    line: shapely.LineString
    layer: str
    role: Role | None = None
    width: float = 0.0


@dataclass(frozen=True)
class Swing:
    """A quarter of a circle, as doors are drawn: the leaf turns about `hinge`, from `first` to `last`."""

    hinge: tuple[float, float]
    first: tuple[float, float]
    last: tuple[float, float]
    layer: str = ""

    @property
    def radius(self) -> float:
        """Width of the leaf."""
        return math.dist(self.hinge, self.first)


@dataclass(frozen=True)
class Lettering:
    """A text and where it stands (its middle, or where it begins)."""

    text: str
    at: tuple[float, float]
    layer: str = ""


@dataclass
class Drawing:
    """Everything on one page."""

    areas: list[Area] = field(default_factory=list)
    strokes: list[Stroke] = field(default_factory=list)
    swings: list[Swing] = field(default_factory=list)
    letterings: list[Lettering] = field(default_factory=list)

    def scaled(self, factor: float, *, turn_over: bool) -> Drawing:
        """The drawing in metres, and with y up."""
        by = np.array([factor, -factor if turn_over else factor])

        def point(at: tuple[float, float]) -> tuple[float, float]:
            return float(at[0] * by[0]), float(at[1] * by[1])

        def shape(geometry: BaseGeometry) -> BaseGeometry:
            return shapely.transform(geometry, lambda points: points * by)

        return Drawing(
            [replace(area, shape=shape(area.shape)) for area in self.areas],
            [replace(s, line=shape(s.line), width=s.width * factor) for s in self.strokes],
            [replace(s, hinge=point(s.hinge), first=point(s.first), last=point(s.last)) for s in self.swings],
            [replace(lettering, at=point(lettering.at)) for lettering in self.letterings],
        )


def swing_of(points: Float[np.ndarray, "n 2"], layer: str) -> Swing | None:
    """The quarter circle that a curve follows, None where it is none: too long, too short, not round."""
    if len(points) < 4 or not np.isfinite(points).all():
        return None
    middle = points.mean(axis=0)
    local = points - middle
    # x² + y² = 2 a x + 2 b y + c, linear in (a, b, c).
    matrix = np.column_stack([2.0 * local, np.ones(len(local))])
    solution, _, rank, _ = np.linalg.lstsq(matrix, np.sum(local**2, axis=1), rcond=None)
    if rank < 3:
        return None
    centre = solution[:2]
    radii = np.linalg.norm(local - centre, axis=1)
    radius = float(radii.mean())
    if radius <= 0.0 or float(np.abs(radii - radius).max()) > _ROUND * radius:
        return None
    angles = np.unwrap(np.arctan2(*(local - centre).T[::-1]))
    if not _QUARTER_DEG[0] <= math.degrees(float(abs(angles[-1] - angles[0]))) <= _QUARTER_DEG[1]:
        return None
    hinge, first, last = centre + middle, points[0], points[-1]
    return Swing((float(hinge[0]), float(hinge[1])), (float(first[0]), float(first[1])),
                 (float(last[0]), float(last[1])), layer)  # fmt: skip


def arc_points(
    centre: tuple[float, float], radius: float, start_deg: float, end_deg: float
) -> Float[np.ndarray, "n 2"]:
    """Points of an arc, counter-clockwise from one angle to the other."""
    sweep = (end_deg - start_deg) % 360.0 or 360.0
    angles = np.radians(start_deg + np.linspace(0.0, sweep, max(4, math.ceil(_STEPS * sweep / 90.0) + 1)))
    return np.array(centre) + radius * np.column_stack([np.cos(angles), np.sin(angles)])


def luminance(red: float, green: float, blue: float) -> float:
    """Of a colour, 0 to 255 like its channels (ITU-R BT.601)."""
    return 0.299 * red + 0.587 * green + 0.114 * blue
