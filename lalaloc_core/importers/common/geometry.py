"""Geometry that several importers share: polygons, ends of openings, and the frame of a map."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Float, Int
from shapely.geometry.base import BaseGeometry

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.importers.common.crossings import check_network, check_outline

# Largest coordinate of a file, in any unit: 10,000 km in millimetres.
MAX_COORDINATE = 1e10


def check_coordinates(points: Float[np.ndarray, "..."], where: str) -> None:
    """Check coordinates before they are computed with."""
    if not in_range(points):
        wrong = ~(np.abs(points) <= MAX_COORDINATE)
        raise InvalidFloorPlanError(
            f"{where} has the coordinate {np.asarray(points)[wrong][0]:g}; the limit is {MAX_COORDINATE:g} units to "
            "either side; correct it, and export the file again"
        )


def in_range(points: Float[np.ndarray, "..."]) -> bool:
    """Return whether all coordinates are finite and within `MAX_COORDINATE`."""
    return bool((np.abs(points) <= MAX_COORDINATE).all())


def polygons_from_geometry(geometry: BaseGeometry) -> list[shapely.Polygon]:
    """Return the polygons of a geometry, made valid, without those of no area."""
    if geometry.is_empty:
        return []
    valid = geometry
    if not geometry.is_valid:
        check_coordinates(shapely.get_coordinates(geometry), "an outline")
        check_outline(geometry)
        valid = shapely.make_valid(geometry)
    parts: Iterable[BaseGeometry] = shapely.get_parts(valid)
    found: list[shapely.Polygon] = []
    for part in parts:
        if isinstance(part, shapely.Polygon):
            if part.area > 0.0:
                found.append(part)
        elif isinstance(part, shapely.MultiPolygon | shapely.GeometryCollection):
            found.extend(polygons_from_geometry(part))
    return found


def even_odd_polygons(rings: Iterable[shapely.Polygon]) -> list[shapely.Polygon]:
    """Return the area between nested outlines, as hatches and paths fill it (even-odd rule)."""
    shapes: list[BaseGeometry] = list(rings)
    check_network(shapes)
    # In pairs, so that the time is not quadratic in the number of outlines.
    while len(shapes) > 1:
        pairs = zip(shapes[::2], shapes[1::2], strict=False)
        shapes = [*(shapely.symmetric_difference(a, b) for a, b in pairs), *shapes[len(shapes) & ~1 :]]
    return polygons_from_geometry(shapes[0]) if shapes else []


def opening_line(shape: BaseGeometry) -> tuple[tuple[float, float], tuple[float, float]] | None:
    """Return the ends of an opening drawn as a line, or as an area across its wall (its longer middle line)."""
    if shapely.get_dimensions(shape) == 1 and not shape.is_empty:
        points = shapely.get_coordinates(shape)
        apart = np.linalg.norm(points[:, None] - points[None], axis=2)
        if len(points) <= 500 and apart.max() > 0.0:
            i, j = np.unravel_index(int(apart.argmax()), apart.shape)
            return point_xy(points[i]), point_xy(points[j])
        return None
    box = shapely.minimum_rotated_rectangle(shape)
    if not isinstance(box, shapely.Polygon):
        return None
    corners = np.asarray(box.exterior.coords)[:4]
    sides = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    if sides[0] < sides[1]:
        corners = np.roll(corners, -1, axis=0)
    return point_xy(0.5 * (corners[0] + corners[3])), point_xy(0.5 * (corners[1] + corners[2]))


def side_lengths(shape: BaseGeometry) -> tuple[float, float]:
    """Return the shorter and the longer side of the smallest rectangle around a shape."""
    points = shapely.get_coordinates(shapely.minimum_rotated_rectangle(shape))
    if len(points) < 4:
        return 0.0, float(shape.length)
    first, second = np.linalg.norm(points[1] - points[0]), np.linalg.norm(points[2] - points[1])
    return float(min(first, second)), float(max(first, second))


def label_position(room: shapely.Polygon) -> tuple[float, float]:
    """Return the centre of the largest circle in a room."""
    return point_xy(shapely.maximum_inscribed_circle(room, 0.01).coords[0])


def cross(a: Float[np.ndarray, "2"], b: Float[np.ndarray, "2"]) -> float:
    """Return the third component of the cross product; it is positive where b points to the left of a."""
    return float(a[0] * b[1] - a[1] * b[0])


def point_xy(point: Float[np.ndarray, "2"] | tuple[float, ...]) -> tuple[float, float]:
    """Return a point as two floats."""
    return float(point[0]), float(point[1])


@dataclass(frozen=True)
class MapFrame:
    """Grid of a map.

    Attributes:
        resolution_m: size of a cell.
        origin: place of the lower left corner (m) and the grid's counter-clockwise rotation in the map frame.
        size: rows and columns.
    """

    resolution_m: float
    origin: tuple[float, float, float]
    size: tuple[int, int]

    def to_map(self, points_m: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Convert points (m) from the lower left corner along the grid to the map frame."""
        x, y, yaw = self.origin
        c, s = math.cos(yaw), math.sin(yaw)
        return points_m @ np.array([[c, s], [-s, c]]) + np.array([x, y])

    def cells(self, row: int) -> Float[np.ndarray, "n 2"]:
        """Return the centres of a row's cells in the map frame; rows are from the top."""
        rows, columns = self.size
        x, y = np.arange(columns), np.full(columns, rows - 1 - row)
        return self.to_map((np.column_stack([x, y]) + 0.5) * self.resolution_m)

    def cells_at(self, points_m: Float[np.ndarray, "n 2"]) -> tuple[Int[np.ndarray, "n"], Int[np.ndarray, "n"]]:
        """Return rows from the top and columns of the cells at points of the map frame, the nearest for others."""
        x, y, yaw = self.origin
        c, s = math.cos(yaw), math.sin(yaw)
        along = (points_m - np.array([x, y])) @ np.array([[c, -s], [s, c]]) / self.resolution_m
        rows, columns = self.size
        column, row = np.floor(along).astype(int).T
        return np.clip(rows - 1 - row, 0, rows - 1), np.clip(column, 0, columns - 1)
