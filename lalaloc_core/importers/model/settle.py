"""Openings as drawings have them (across a wall, along one of its faces) put where a plan has them: along the wall.

An opening between two rooms comes to lie midway between their walls, one in an outer wall on the wall's inner face.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely
from jaxtyping import Float

from lalaloc_core.importers.model.geometry import cross
from lalaloc_core.importers.model.sketch import SketchedOpening

# Of what lies beside an opening: walls are thinner, drawn lines are straighter, and a jamb is no opening.
MAX_WALL_THICKNESS_M = 0.7
_STRAIGHT = math.sin(math.radians(12.0))
_MIN_LENGTH_M = 0.25
_KIND_RANK = {"door": 0, "window": 1, "passage": 2}


@dataclass(frozen=True)
class SettledOpenings:
    """Openings on walls, and those that lie on none."""

    openings: list[SketchedOpening]
    off_wall: list[SketchedOpening]
    merged: int


def settle_openings(openings: Sequence[SketchedOpening], rooms: Sequence[shapely.Polygon]) -> SettledOpenings:
    """Put every opening on the walls beside it.

    Of two openings that overlap in a wall, the door stays before the window, and the window before the passage.
    """
    edges = _edges(rooms)
    tree = shapely.STRtree([_segment(edge) for edge in edges])
    kept: list[SketchedOpening] = []
    off_wall, merged = [], 0
    for opening in sorted(openings, key=lambda each: (_KIND_RANK[each.kind], -each.line.length)):
        placed = _place(opening, edges, tree)
        if placed is None:
            off_wall.append(opening)
            continue
        free = _beside(placed, kept)
        if free is None:
            merged += 1
            _stack(placed, kept)
        else:
            kept.append(free)
    return SettledOpenings(kept, off_wall, merged)


def _edges(rooms: Sequence[shapely.Polygon]) -> Float[np.ndarray, "n 4"]:
    turned = [shapely.geometry.polygon.orient(room) for room in rooms]
    rings = [np.asarray(ring.coords) for room in turned for ring in (room.exterior, *room.interiors)]
    pieces = [np.concatenate([ring[:-1], ring[1:]], axis=1) for ring in rings]
    return np.concatenate(pieces) if pieces else np.empty((0, 4))


def _segment(edge: Float[np.ndarray, "4"]) -> shapely.LineString:
    return shapely.LineString(edge.reshape(2, 2))


def _place(opening: SketchedOpening, edges: Float[np.ndarray, "n 4"], tree: shapely.STRtree) -> SketchedOpening | None:
    """The opening on the line of its wall, None where no wall runs along it."""
    start, end = np.array(opening.start), np.array(opening.end)
    length = float(np.linalg.norm(end - start))
    if length < 1e-6:
        return None
    along = (end - start) / length
    near = tree.query(opening.line, predicate="dwithin", distance=MAX_WALL_THICKNESS_M)
    beside: list[tuple[float, float]] = []
    for edge in edges[near]:
        first, second = edge[:2], edge[2:]
        direction = second - first
        size = float(np.linalg.norm(direction))
        if size < 1e-6 or abs(cross(along, direction / size)) > _STRAIGHT:
            continue
        a, b = sorted((float((first - start) @ along), float((second - start) @ along)))
        shared = min(b, length) - max(a, 0.0)
        if shared < min(0.5 * length, 0.5):
            continue
        offset = cross(along, 0.5 * (first + second) - start)
        if abs(offset) <= MAX_WALL_THICKNESS_M:
            # The room lies to the left of its edges.
            side = 1.0 if direction @ along > 0.0 else -1.0
            beside.append((offset, side))
    shift = _offset_of_wall(beside)
    if shift is None:
        return None
    normal = np.array([-along[1], along[0]])
    return replace(opening, start=_point(start + shift * normal), end=_point(end + shift * normal))


def _offset_of_wall(beside: list[tuple[float, float]]) -> float | None:
    """Where between the walls beside it an opening belongs, as an offset to the left of it."""
    if not beside:
        return None
    left = [offset for offset, side in beside if side > 0.0]
    right = [offset for offset, side in beside if side < 0.0]
    # The wall lies between a room to its right and one to its left, the nearest pair of them.
    pairs = [(a, b) for a in left for b in right if -1e-6 <= a - b <= MAX_WALL_THICKNESS_M]
    if pairs:
        a, b = min(pairs, key=lambda pair: abs(pair[0] + pair[1]))
        return 0.5 * (a + b)
    return min((offset for offset, _ in beside), key=abs)


def _beside(opening: SketchedOpening, kept: Sequence[SketchedOpening]) -> SketchedOpening | None:
    """The part of an opening that no other takes already, None where too little is left."""
    start, end = np.array(opening.start), np.array(opening.end)
    length = float(np.linalg.norm(end - start))
    along = (end - start) / length
    free = [(0.0, length)]
    for other in kept:
        a, b = np.array(other.start) - start, np.array(other.end) - start
        apart = max(abs(cross(along, a)), abs(cross(along, b)))
        if apart > 0.5 * MAX_WALL_THICKNESS_M:
            continue
        low, high = sorted((float(a @ along), float(b @ along)))
        free = [piece for lo, hi in free for piece in ((lo, min(hi, low)), (max(lo, high), hi)) if piece[1] > piece[0]]
    longest = max(free, key=lambda piece: piece[1] - piece[0], default=(0.0, 0.0))
    if longest[1] - longest[0] < max(_MIN_LENGTH_M, 0.5 * length):
        return None
    low, high = longest
    return replace(opening, start=_point(start + low * along), end=_point(start + high * along))


def _stack(opening: SketchedOpening, kept: list[SketchedOpening]) -> None:
    """Windows above each other are one, from the lowest sill to the highest head."""
    if opening.kind != "window" or opening.head_m is None:
        return
    near = opening.line.buffer(0.5 * MAX_WALL_THICKNESS_M, cap_style="flat")
    for index, other in enumerate(kept):
        if other.kind != "window" or other.head_m is None or near.intersection(other.line).length < _MIN_LENGTH_M:
            continue
        sills = [each.sill_m or 0.0 for each in (opening, other)]
        kept[index] = replace(other, sill_m=min(sills), head_m=max(opening.head_m, other.head_m))


def _point(point_m: Float[np.ndarray, "2"]) -> tuple[float, float]:
    return float(point_m[0]), float(point_m[1])
