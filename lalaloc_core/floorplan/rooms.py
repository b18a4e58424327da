"""One room: its outline, what stands in it, and where a camera may be."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import shapely
from jaxtyping import Float
from shapely.geometry.base import BaseGeometry

from lalaloc_core.conventions import ROOM_TYPES
from lalaloc_core.floorplan.arrays import frozen, ring_edges
from lalaloc_core.floorplan.inmost import inmost_place

# No camera stands on a free-standing wall, however thin: what is kept of the floor where no margin fits.
_WALL_CORE_M = 1e-3


def _no_walls() -> Float[np.ndarray, "0 4"]:
    return frozen(np.empty((0, 4)))


@dataclass(frozen=True, eq=False)
class Room:
    """One room.

    Attributes:
        name: what the user calls it; names may repeat.
        polygon_m: (n, 2), counter-clockwise, not closed (the last vertex joins the first).
        ceiling_height_m: over the floor.
        id: what tells it from the other rooms of its plan.
        type: one of `conventions.ROOM_TYPES`.
        holes_m: what is no floor inside the outline, such as columns and shafts: each (k, 2), clockwise, not closed.
        inner_walls_m: free-standing walls up to the ceiling, segments (x0, y0, x1, y1).
    """

    name: str
    polygon_m: Float[np.ndarray, "n 2"]
    ceiling_height_m: float
    id: str = ""
    type: str = ROOM_TYPES[0]
    holes_m: tuple[Float[np.ndarray, "_ 2"], ...] = ()
    inner_walls_m: Float[np.ndarray, "k 4"] = field(default_factory=_no_walls)

    @cached_property
    def shape(self) -> shapely.Polygon:
        """The floor as a shapely geometry: the outline without the holes."""
        return shapely.Polygon(self.polygon_m, self.holes_m)

    @property
    def area_m2(self) -> float:
        """Floor area, without holes."""
        return float(self.shape.area)

    @cached_property
    def walls_m(self) -> Float[np.ndarray, "n 4"]:
        """Wall segments (x0, y0, x1, y1): edges of the polygon, edges of the holes, free-standing walls.

        The room lies to the left of the edges, and on both sides of the free-standing walls.
        """
        return frozen(
            np.concatenate([ring_edges(ring) for ring in (self.polygon_m, *self.holes_m)] + [self.inner_walls_m])
        )

    def free_floor(self, margin_m: float) -> BaseGeometry:
        """The floor at least `margin_m` from all walls, free-standing ones included; may be empty."""
        floor = self.shape.buffer(-margin_m)
        if not len(self.inner_walls_m):
            return floor
        segments = shapely.MultiLineString(self.inner_walls_m.reshape(-1, 2, 2).tolist())
        return floor.difference(segments.buffer(margin_m))

    def inmost_point(self) -> Float[np.ndarray, "2"]:
        """A place about as far from all walls as any."""
        floor = self.shape
        if len(self.inner_walls_m):
            floor = shapely.MultiPolygon(polygons_of(self.free_floor(_WALL_CORE_M)))
        return inmost_place(floor)[0]


def polygons_of(shape: shapely.Geometry) -> list[shapely.Polygon]:
    """The polygons that a geometry consists of; lines and points are left out."""
    return [part for part in shapely.get_parts(shape) if isinstance(part, shapely.Polygon)]
