"""Small things about shapes that several importers need."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import shapely
from jaxtyping import Float
from shapely.geometry.base import BaseGeometry


def polygons_of(geometry: BaseGeometry) -> list[shapely.Polygon]:
    """The polygons of any geometry, made valid, slivers left out."""
    if geometry.is_empty:
        return []
    valid = geometry if geometry.is_valid else shapely.make_valid(geometry)
    parts: Iterable[BaseGeometry] = shapely.get_parts(valid)
    found: list[shapely.Polygon] = []
    for part in parts:
        if isinstance(part, shapely.Polygon):
            if part.area > 0.0:
                found.append(part)
        elif isinstance(part, shapely.MultiPolygon | shapely.GeometryCollection):
            found.extend(polygons_of(part))
    return found


def opening_line(shape: BaseGeometry) -> tuple[tuple[float, float], tuple[float, float]] | None:
    """The ends of an opening that is drawn as a line, or as an area across its wall: its longer middle line."""
    if shapely.get_dimensions(shape) == 1 and not shape.is_empty:
        points = shapely.get_coordinates(shape)
        apart = np.linalg.norm(points[:, None] - points[None], axis=2)
        if len(points) <= 500 and apart.max() > 0.0:
            i, j = np.unravel_index(int(apart.argmax()), apart.shape)
            return _xy(points[i]), _xy(points[j])
        return None
    box = shapely.minimum_rotated_rectangle(shape)
    if not isinstance(box, shapely.Polygon):
        return None
    corners = np.asarray(box.exterior.coords)[:4]
    sides = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    if sides[0] < sides[1]:
        corners = np.roll(corners, -1, axis=0)
    return _xy(0.5 * (corners[0] + corners[3])), _xy(0.5 * (corners[1] + corners[2]))


def cross(a: Float[np.ndarray, "2"], b: Float[np.ndarray, "2"]) -> float:
    """The third component of a cross product: positive where b points to the left of a."""
    return float(a[0] * b[1] - a[1] * b[0])


def _xy(point: Float[np.ndarray, "2"]) -> tuple[float, float]:
    return float(point[0]), float(point[1])
