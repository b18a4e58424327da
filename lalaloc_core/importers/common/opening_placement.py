"""Placement of openings on walls.

Drawings show openings across a wall or along one of its faces. A plan has them along the wall: midway between the walls
of two rooms, or on the inner face of an outer wall.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import shapely
from jaxtyping import Float

from lalaloc_core.importers.common.geometry import lines_of, point_xy, polygons_of, segments_of
from lalaloc_core.importers.common.sketch import Point, SketchedOpening

# Limits of wall thickness (m), of the sine between opening and wall, and of the length of an opening (m).
_MAX_WALL_THICKNESS_M = 0.7
_STRAIGHT = math.sin(math.radians(12.0))
_MIN_LENGTH_M = 0.25
# Rounding of points that should lie on a wall (m).
_ON_WALL_M = 0.05
_KIND_RANK = {"door": 0, "window": 1, "passage": 2}


def place_openings(
    openings: Sequence[SketchedOpening], rooms: Sequence[shapely.Polygon]
) -> tuple[list[SketchedOpening], list[SketchedOpening], int]:
    """Move every opening onto the walls beside it.

    Returns the openings on walls, those on no wall, and the number of those left out: if two overlap in a wall, a door
    is kept before a window and a window before a passage.
    """
    edges = _edges(rooms)
    tree = shapely.STRtree(lines_of(edges))
    kept: list[SketchedOpening] = []
    off_wall, overlapping = [], 0
    for opening in sorted(openings, key=lambda opening: (_KIND_RANK[opening.kind], -opening.line.length)):
        placed = _place(opening, edges, tree)
        if placed is None:
            off_wall.append(opening)
            continue
        free = _free_part(placed, kept)
        if free is None:
            overlapping += 1
            _stack_window(placed, kept)
        else:
            kept.append(free)
    return kept, off_wall, overlapping


class WallLines:
    """Straight walls of rooms, for openings drawn as points.

    Vertices that lie on a straight wall within 5 cm, as the doors of OpenStreetMap do, do not divide it.
    """

    def __init__(self, rooms: Sequence[shapely.Polygon]) -> None:
        walls = [part for room in rooms for part in polygons_of(room.simplify(_ON_WALL_M))]
        self._tree = shapely.STRtree(lines_of(_edges(walls)))

    def line_at(self, point: shapely.Point, width_m: float) -> tuple[Point, Point] | None:
        """Return the ends of an opening of a width on the longest of the walls nearest to a point, None if none is."""
        near = self._tree.query(point, predicate="dwithin", distance=_MAX_WALL_THICKNESS_M)
        if not len(near):
            return None
        segments = self._tree.geometries[near]
        apart = shapely.distance(segments, point)
        wall = max(segments[apart <= apart.min() + _ON_WALL_M], key=lambda segment: segment.length)
        half = 0.5 * min(width_m, wall.length)
        middle = min(max(wall.project(point), half), wall.length - half)
        start, end = wall.interpolate(middle - half), wall.interpolate(middle + half)
        return (start.x, start.y), (end.x, end.y)


def _edges(rooms: Sequence[shapely.Polygon]) -> Float[np.ndarray, "n 4"]:
    return segments_of([shapely.geometry.polygon.orient(room) for room in rooms])


def _place(opening: SketchedOpening, edges: Float[np.ndarray, "n 4"], tree: shapely.STRtree) -> SketchedOpening | None:
    """Return the opening on the line of its wall, None if no wall runs along it."""
    start, end = np.array(opening.start), np.array(opening.end)
    length = math.dist(start, end)
    if length < 1e-6:
        return None
    along = (end - start) / length
    left = np.array([-along[1], along[0]])
    beside = edges[tree.query(opening.line, predicate="dwithin", distance=_MAX_WALL_THICKNESS_M)].reshape(-1, 2, 2)
    steps = beside[:, 1] - beside[:, 0]
    places = np.sort((beside - start) @ along, axis=1)
    offsets = (beside.mean(axis=1) - start) @ left
    is_wall = np.abs(steps @ left) <= _STRAIGHT * np.linalg.norm(steps, axis=1)
    is_wall &= places[:, 1].clip(max=length) - places[:, 0].clip(min=0.0) >= min(0.5 * length, 0.5)
    is_wall &= np.abs(offsets) <= _MAX_WALL_THICKNESS_M
    if not is_wall.any():
        return None
    # Rings are counter-clockwise: the room lies to the left of its edges.
    is_left = steps @ along > 0.0
    shift = _offset_of_wall(offsets[is_wall & is_left], offsets[is_wall & ~is_left])
    return replace(opening, start=point_xy(start + shift * left), end=point_xy(end + shift * left))


def _offset_of_wall(left: Float[np.ndarray, "n"], right: Float[np.ndarray, "m"]) -> float:
    """Return the offset (m, to the left) from an opening to the middle of its wall, by those of rooms to either side.

    The wall lies between the nearest pair of a room to its right and a room to its left.
    """
    pairs = [0.5 * (a + b) for a in left for b in right if -1e-6 <= a - b <= _MAX_WALL_THICKNESS_M]
    return float(min(pairs or [*left, *right], key=abs))


def _free_part(opening: SketchedOpening, kept: Sequence[SketchedOpening]) -> SketchedOpening | None:
    """Return the longest part of an opening that overlaps no kept opening, None if too little is left."""
    start, end = np.array(opening.start), np.array(opening.end)
    length = float(np.linalg.norm(end - start))
    along = (end - start) / length
    # Parts of the line that kept openings in its wall take, as distances from its start.
    ends = np.array([(*taken.start, *taken.end) for taken in kept]).reshape(-1, 2, 2) - start
    apart = np.abs(along[0] * ends[..., 1] - along[1] * ends[..., 0]).max(axis=1, initial=0.0)
    places = np.sort(ends @ along, axis=1)
    overlaps = (apart <= 0.5 * _MAX_WALL_THICKNESS_M) & (places[:, 0] < length) & (places[:, 1] > 0.0)
    free = [(0.0, length)]
    for low, high in places[overlaps].tolist():
        free = [piece for lo, hi in free for piece in ((lo, min(hi, low)), (max(lo, high), hi)) if piece[1] > piece[0]]
    low, high = max(free, key=lambda piece: piece[1] - piece[0], default=(0.0, 0.0))
    if high - low < max(_MIN_LENGTH_M, 0.5 * length):
        return None
    return replace(opening, start=point_xy(start + low * along), end=point_xy(start + high * along))


def _stack_window(opening: SketchedOpening, kept: list[SketchedOpening]) -> None:
    """Merge a window with the window below or above it, from the lowest sill to the highest head."""
    if opening.kind != "window" or opening.head_m is None:
        return
    near = opening.line.buffer(0.5 * _MAX_WALL_THICKNESS_M, cap_style="flat")
    for index, window in enumerate(kept):
        if window.kind != "window" or window.head_m is None or near.intersection(window.line).length < _MIN_LENGTH_M:
            continue
        sill_m = min(opening.sill_m or 0.0, window.sill_m or 0.0)
        kept[index] = replace(window, sill_m=sill_m, head_m=max(opening.head_m, window.head_m))
