"""Closed shapes that lines of a picture enclose: the parts of symbols of fixtures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import shapely
from jaxtyping import Float

from lalaloc_core.importers.picture.ink import Ink

# Size of parts of symbols (m², m), and most parts of a picture.
_PART, _MOST = (0.004, 4.0), 3000
# Share of the box that a rectangle fills, and range of that of an ellipse with its deviation.
_FILLED, _ELLIPSE, _OFF_ELLIPSE = 0.9, (0.7, 0.86), 0.06
_CIRCLE = 1.2
# Corners that are cut by this share of the short side, and by these pixels, are rounded.
_ROUNDED, _ROUNDED_PX = 0.05, 2.5


@dataclass(frozen=True, eq=False)
class Shape:
    """Closed shape in plan metres; `pixel_m` is the size of a pixel."""

    outline: shapely.Polygon
    pixel_m: float

    @classmethod
    def around(cls, shapes: Sequence[Shape]) -> Shape:
        """Return the hull of some shapes."""
        hull = shapely.MultiPolygon([shape.outline for shape in shapes]).convex_hull
        assert isinstance(hull, shapely.Polygon)
        return cls(hull, shapes[0].pixel_m)

    @cached_property
    def box(self) -> Float[np.ndarray, "4 2"]:
        """Corners of the smallest box; the first two are the ends of a long side."""
        corners = shapely.get_coordinates(self.outline.minimum_rotated_rectangle)[:4]
        first, second = np.linalg.norm(corners[1] - corners[0]), np.linalg.norm(corners[2] - corners[1])
        return corners if first >= second else np.roll(corners, -1, axis=0)

    @cached_property
    def long_m(self) -> float:
        """Longer side of the box."""
        return float(np.linalg.norm(self.box[1] - self.box[0]))

    @cached_property
    def short_m(self) -> float:
        """Shorter side of the box."""
        return float(np.linalg.norm(self.box[2] - self.box[1]))

    @cached_property
    def axis(self) -> Float[np.ndarray, "2"]:
        """Unit vector along the longer side."""
        return (self.box[1] - self.box[0]) / max(self.long_m, 1e-9)

    @property
    def frame(self) -> Float[np.ndarray, "2 2"]:
        """Unit vectors along the longer and the shorter side, in columns."""
        return np.column_stack([self.axis, [-self.axis[1], self.axis[0]]])

    @cached_property
    def centre(self) -> Float[np.ndarray, "2"]:
        """Centre of the box."""
        return self.box.mean(axis=0)

    @property
    def area(self) -> float:
        """Area (m²)."""
        return self.outline.area

    @cached_property
    def filled(self) -> float:
        """Share of the box that the shape fills."""
        return self.area / max(self.long_m * self.short_m, 1e-9)

    @property
    def is_box(self) -> bool:
        """True if the shape fills its box."""
        return self.filled >= _FILLED

    @cached_property
    def is_oval(self) -> bool:
        """True if the shape is an ellipse."""
        x, y = ((shapely.get_coordinates(self.outline) - self.centre) @ self.frame).T
        radius = np.hypot(x / (0.5 * self.long_m), y / (0.5 * self.short_m))
        # Small shapes are blocks of pixels.
        slack = 0.6 * self.pixel_m / self.short_m
        return _ELLIPSE[0] <= self.filled <= _ELLIPSE[1] + slack and float(radius.std()) <= _OFF_ELLIPSE + slack

    @property
    def is_circle(self) -> bool:
        """True if the shape is a circle."""
        return self.is_oval and self.long_m <= _CIRCLE * self.short_m

    @cached_property
    def rounded_corners(self) -> int:
        """Number of corners of the box that the shape leaves out."""
        least = max(_ROUNDED * self.short_m, _ROUNDED_PX * self.pixel_m)
        return sum(bool(shapely.distance(shapely.Point(corner), self.outline) >= least) for corner in self.box)

    def holds(self, other: Shape) -> bool:
        """Return whether another, smaller shape lies inside."""
        return other.area < 0.95 * self.area and self.outline.covers(shapely.Point(other.centre))


def closed_shapes(ink: Ink, sizes: tuple[float, float] = _PART, *, is_faint: bool = False) -> list[Shape]:
    """Return the areas that lines enclose, with their holes filled, from an area (m²) up to a length (m).

    There are none if too many. With `is_faint`, faint lines count, and small gaps in lines are closed.
    """
    lines = ink.mask.astype(np.uint8)
    if is_faint:
        lines = cv2.morphologyEx(ink.lines.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    _, found, stats, _ = cv2.connectedComponentsWithStats(1 - lines, connectivity=4)
    labels, pixel_m = np.asarray(found, dtype=np.int32), ink.metres_per_pixel
    area_m2 = stats[:, cv2.CC_STAT_AREA] * pixel_m**2
    long_m = stats[:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]].max(axis=1) * pixel_m
    is_part = (area_m2 >= sizes[0]) & (long_m <= sizes[1])
    is_part[0] = False
    shapes = []
    for number in np.flatnonzero(is_part).tolist() if is_part.sum() <= _MOST else ():
        x, y, width, height = stats[number, :4].tolist()
        left, top = max(x - 1, 0), max(y - 1, 0)
        window = labels[top : y + height + 1, left : x + width + 1] == number
        contours, _ = cv2.findContours(window.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        contour = max(contours, key=len)
        if len(contour) < 4:
            continue
        # Contours run through the centres of pixels; outlines through the middle of lines.
        outline = shapely.Polygon(ink.to_plan(contour.reshape(-1, 2) + np.array([left + 0.5, top + 0.5])))
        outline = outline.buffer(pixel_m, join_style="mitre").simplify(0.3 * pixel_m)
        if isinstance(outline, shapely.Polygon) and outline.area > 0.0:
            shapes.append(Shape(shapely.Polygon(outline.exterior), pixel_m))
    return shapes
