"""Openings that are painted over continuous walls, as in brochures: a light area hides a part of a wall."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.importers.common.geometry import opening_line, polygons_from_geometry, side_lengths
from lalaloc_core.importers.drawing.enclosed_rooms import DEFAULT_WALLS, Gap
from lalaloc_core.importers.drawing.vector_drawing import Patch

# Lengths of painted openings, and thinnest wall (m).
_OPENING_M, _THINNEST_M = (0.3, 8.0), 0.03
# Walls go on at both ends of an opening within this distance, and not along its sides: at most this multiple of the
# wall's thickness touches walls.
_AT_END_M, _ENDS = 0.05, 2.6
# Rounding at the edges of hidden parts.
_TOUCHING_M = 0.01
# Pairs of a wall and a light area over it.
_PAIRS, _PAIRS_PER_AREA = 1000, 4


@dataclass(frozen=True, eq=False)
class PaintedWalls:
    """Visible parts of walls, and the gaps that are painted into them."""

    bodies: list[shapely.Polygon]
    gaps: list[Gap]


def cut_painted(
    bodies: Sequence[tuple[shapely.Polygon, int]], patches: Sequence[Patch], check_time: Callable[[], None]
) -> PaintedWalls:
    """Take what is hidden from walls, which come with their places in the order of painting, in metres."""
    tree = shapely.STRtree([patch.shape for patch in patches])
    visible: list[shapely.Polygon] = []
    hidden: dict[int, list[shapely.Geometry]] = {}
    pairs, limit = 0, _PAIRS + _PAIRS_PER_AREA * (len(bodies) + len(patches))
    for body, order in bodies:
        check_time()
        over = [int(k) for k in tree.query(body, predicate="intersects") if patches[k].order > order]
        pairs += len(over)
        if pairs > limit:
            raise InvalidFloorPlanError(
                f"{len(patches)} light areas hide {len(bodies)} walls in more than {limit} places, the limit for "
                "as many; remove areas that are drawn over walls"
            )
        parts = [(k, shapely.intersection(body, patches[k].shape)) for k in over]
        covered = [part for _, part in parts if part.area > 0.0]
        for k, part in parts:
            if part.area > 0.0:
                hidden.setdefault(k, []).append(part)
        visible += polygons_from_geometry(shapely.difference(body, shapely.union_all(covered))) if covered else [body]
    walls = shapely.STRtree(visible)
    gaps: list[Gap] = []
    for k, parts in hidden.items():
        check_time()
        for piece in polygons_from_geometry(shapely.union_all(parts)):
            gap = _gap(piece, walls, patches[k])
            if gap is not None:
                gaps.append(gap)
    return PaintedWalls(visible, gaps)


def _gap(piece: shapely.Polygon, walls: shapely.STRtree, patch: Patch) -> Gap | None:
    """Return the gap that a hidden piece of a wall is, None if the wall does not go on at both ends of it."""
    thickness, length = side_lengths(piece)
    ends = opening_line(piece)
    if ends is None or not (
        _THINNEST_M <= thickness <= DEFAULT_WALLS.thickest + _AT_END_M and _OPENING_M[0] <= length <= _OPENING_M[1]
    ):
        return None
    near = walls.geometries[np.sort(walls.query(piece, predicate="dwithin", distance=_AT_END_M))]
    around = shapely.union_all(near) if len(near) else shapely.Polygon()
    goes_on = all(shapely.distance(around, shapely.Point(end)) <= _AT_END_M for end in ends)
    beside = shapely.intersection(piece.boundary, around.buffer(_TOUCHING_M, quad_segs=2)).length
    if not goes_on or beside > _ENDS * thickness or math.dist(*ends) < _OPENING_M[0]:
        return None
    return Gap(piece, *ends, is_between_ends=True, is_painted=True, is_bluish=patch.is_bluish)
