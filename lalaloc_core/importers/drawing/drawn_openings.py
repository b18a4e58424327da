"""Openings that are drawn without a layer's or class's word.

Panes are parallel lines from end to end of a gap in a wall. In brochures, openings are painted over continuous walls: a
light area hides a part of a wall.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import shapely
from jaxtyping import Bool, Float
from shapely.geometry.base import BaseGeometry

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.importers.common.geometry import check_network, opening_line, point_xy, polygons_of, side_lengths
from lalaloc_core.importers.common.import_limits import CheckTime
from lalaloc_core.importers.drawing.enclosed_rooms import Gap
from lalaloc_core.importers.drawing.vector_drawing import Patch

# Lengths of panes and their distances across a wall (m).
_LENGTH_M, _DEPTH_M = (0.3, 6.0), (0.02, 0.6)
# Ends of the lines of a pane lie this near to each other, and the wall begins this near behind them.
_ALIGNED_M, _BEHIND_M = 0.03, 0.04
# Share of the strip behind the ends of a pane that is wall, and of those beside it that may be.
_IN_WALL, _FREE = 0.6, 0.2
# Corners of a pane beside which a wall may run on: those at one end, as in the corner of a room. Stairs have four.
_CORNERS, _BESIDE_M = 2, 0.1
# Lines of one pane; more are hatching. Sine of the largest angle between them.
_MOST_LINES, _TURN = 8, 0.02
# Lengths of painted openings, and thinnest wall (m).
_OPENING_M, _THINNEST_M = (0.3, 8.0), 0.03
# Walls go on at both ends of an opening within this distance, and not along its sides: at most this multiple of the
# wall's thickness touches walls.
_AT_END_M, _ENDS = 0.05, 2.6
# Rounding at the edges of hidden parts.
_TOUCHING_M = 0.01
# Pairs of a wall and a light area over it.
_PAIRS, _PAIRS_PER_AREA = 1000, 4


def drawn_panes(lines: list[shapely.LineString], walls: BaseGeometry, least: int, check_time: CheckTime) -> list[Gap]:
    """Return the windows among the thin lines of a drawing (m).

    The walls include the areas between the lines of windows, if walls are drawn with two lines. At least `least` lines
    make a window: two do in a gap; a wall with two faces is such a pair itself. `check_time` is called between steps
    and raises an exception to stop.
    """
    candidates = [line for line in lines if _LENGTH_M[0] <= line.length <= _LENGTH_M[1]]
    if not candidates or walls.is_empty:
        return []
    shapely.prepare(walls)
    check_network(candidates)
    ends = np.array([np.asarray(line.coords)[[0, -1]] for line in candidates])
    is_near = np.asarray(shapely.dwithin(shapely.points(ends), walls, _ALIGNED_M))
    ends = ends[is_near[:, 0] & is_near[:, 1]]
    tree, found = shapely.STRtree(np.asarray(shapely.linestrings(ends))), []
    is_used = np.zeros(len(ends), bool)
    for index, line in enumerate(tree.geometries):
        check_time()
        if is_used[index]:
            continue
        near = np.sort(tree.query(line, predicate="dwithin", distance=_DEPTH_M[1]))
        beside = near[~is_used[near]]
        beside = beside[_are_beside(ends[index], ends[beside])]
        if not least <= len(beside) <= _MOST_LINES:
            continue
        area = _box(ends[index], ends[beside])
        if area is not None and _is_in_wall(area, walls):
            is_used[beside] = True
            start, end = np.asarray(area.exterior.coords)[[[0, 3], [1, 2]]].mean(axis=1)
            found.append(Gap(area, point_xy(start), point_xy(end), is_between_ends=True, is_pane=True))
    return found


def _are_beside(line: Float[np.ndarray, "2 2"], others: Float[np.ndarray, "n 2 2"]) -> Bool[np.ndarray, "n"]:
    """Return which lines are parallel to a line, given by their ends, and end beside it; a line is beside itself."""
    along = (line[1] - line[0]) / math.dist(*line)
    places = np.sort((others - line[0]) @ along, axis=1)
    step = others[:, 1] - others[:, 0]
    turn = np.abs(step[:, 0] * along[1] - step[:, 1] * along[0]) / np.maximum(np.linalg.norm(step, axis=1), 1e-9)
    apart = np.abs(places - [0.0, math.dist(*line)]).max(axis=1)
    return (apart <= _ALIGNED_M) & (turn <= _TURN)


def _box(line: Float[np.ndarray, "2 2"], lines: Float[np.ndarray, "n 2 2"]) -> shapely.Polygon | None:
    """Return the rectangle along a line that contains parallel lines, its long sides first; None if it is too flat."""
    a, b = line
    along = (b - a) / math.dist(a, b)
    across = np.array([-along[1], along[0]])
    offsets = (lines.mean(axis=1) - a) @ across
    if not _DEPTH_M[0] <= float(np.ptp(offsets)) <= min(_DEPTH_M[1], 0.8 * math.dist(a, b)):
        return None
    low, high = offsets.min() * across, offsets.max() * across
    return shapely.Polygon([a + low, b + low, b + high, a + high])


def _is_in_wall(area: shapely.Polygon, walls: BaseGeometry) -> bool:
    """Return whether the wall goes on behind both ends of an area, and neither beside it nor around its ends."""
    a, b, c, d = np.asarray(area.exterior.coords)[:4]
    along, across = (b - a) / math.dist(a, b), (d - a) / math.dist(a, d)

    def share(corner: Float[np.ndarray, "2"], *steps: Float[np.ndarray, "2"]) -> float:
        first, second = steps
        strip = shapely.Polygon([corner, corner + first, corner + first + second, corner + second])
        return shapely.intersection(strip, walls).area / max(strip.area, 1e-12)

    behind, aside = _BEHIND_M * along, _BESIDE_M * across
    if min(share(a, -behind, d - a), share(b, behind, c - b)) < _IN_WALL:
        return False
    inner = 0.1 * (b - a)
    if max(share(a + inner, 0.8 * (b - a), -aside), share(d + inner, 0.8 * (c - d), aside)) > _FREE:
        return False
    corners = ((a, -behind, -aside), (b, behind, -aside), (c, behind, aside), (d, -behind, aside))
    return sum(share(*corner) > 0.5 for corner in corners) <= _CORNERS


def cut_painted(
    bodies: Sequence[tuple[shapely.Polygon, int]], patches: Sequence[Patch], thickest_m: float, check_time: CheckTime
) -> tuple[list[shapely.Polygon], list[Gap]]:
    """Take what is hidden from walls, which come with their places in the order of painting, in metres.

    Returns the visible parts of walls, and the gaps that are painted into walls of at most `thickest_m`.
    """
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
        covered = [(k, part) for k, part in parts if part.area > 0.0]
        for k, part in covered:
            hidden.setdefault(k, []).append(part)
        rest = shapely.difference(body, shapely.union_all([part for _, part in covered]))
        visible += polygons_of(rest) if covered else [body]
    walls = shapely.STRtree(visible)
    gaps: list[Gap] = []
    for k, parts in hidden.items():
        check_time()
        pieces = polygons_of(shapely.union_all(parts))
        gaps += filter(None, [_gap(piece, walls, patches[k], thickest_m) for piece in pieces])
    return visible, gaps


def _gap(piece: shapely.Polygon, walls: shapely.STRtree, patch: Patch, thickest_m: float) -> Gap | None:
    """Return the gap that a hidden piece of a wall is, None if the wall does not go on at both ends of it."""
    thickness, length = side_lengths(piece)
    ends = opening_line(piece)
    has_size = _THINNEST_M <= thickness <= thickest_m + _AT_END_M and _OPENING_M[0] <= length <= _OPENING_M[1]
    if ends is None or not has_size:
        return None
    near = walls.geometries[np.sort(walls.query(piece, predicate="dwithin", distance=_AT_END_M))]
    around = shapely.union_all(near) if len(near) else shapely.Polygon()
    goes_on = all(shapely.distance(around, shapely.Point(end)) <= _AT_END_M for end in ends)
    beside = shapely.intersection(piece.boundary, around.buffer(_TOUCHING_M, quad_segs=2)).length
    if not goes_on or beside > _ENDS * thickness or math.dist(*ends) < _OPENING_M[0]:
        return None
    return Gap(piece, *ends, is_between_ends=True, is_painted=True, is_bluish=patch.is_bluish)
