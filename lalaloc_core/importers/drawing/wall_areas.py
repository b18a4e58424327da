"""Walls as areas, searched by their edges: one area can have all walls of a building."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import shapely
from jaxtyping import Float


class WallAreas:
    """Areas of walls that do not overlap."""

    def __init__(self, parts: Sequence[shapely.Polygon]) -> None:
        self.parts = parts
        shapely.prepare(list(parts))
        self._areas = shapely.STRtree(parts)
        rings = shapely.get_parts(shapely.boundary(np.array(parts, dtype=object)))
        points, ring = shapely.get_coordinates(rings, return_index=True)
        pairs = np.stack([points[:-1], points[1:]], axis=1)[ring[:-1] == ring[1:]]
        self._edges = shapely.STRtree(np.asarray(shapely.linestrings(pairs)))

    def covers(self, point: Float[np.ndarray, "2"]) -> bool:
        """Return whether a point lies in a wall or on its edge."""
        place = shapely.Point(point)
        return any(self.parts[index].intersects(place) for index in self._areas.query(place))

    def distance_along(self, ray: shapely.LineString) -> float:
        """Return the distance from the start of a ray to the first wall on it, infinite if there is none."""
        origin = shapely.get_coordinates(ray)[0]
        if self.covers(origin):
            return 0.0
        edges = self._edges.geometries[self._edges.query(ray, predicate="intersects")]
        hits = shapely.intersection(edges, ray)
        return float(shapely.distance(hits, shapely.Point(origin)).min(initial=math.inf))

    def meets(self, line: shapely.LineString) -> bool:
        """Return whether a line meets a wall."""
        return len(self._edges.query(line, predicate="intersects")) > 0 or self.covers(shapely.get_coordinates(line)[0])
