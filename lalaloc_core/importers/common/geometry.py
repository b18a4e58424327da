"""Geometry that several importers share: polygons, ends of openings, areas of walls, and the frame of a map.

Limits on lines that cross are checked before the geometry library divides the lines where they do.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import shapely
from jaxtyping import Bool, Float, Int
from shapely.geometry.base import BaseGeometry

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.importers.common.import_limits import CheckTime
from lalaloc_core.importers.common.import_report import ReportBuilder

# Largest coordinate of a file, in any unit: 10,000 km in millimetres.
MAX_COORDINATE = 1e10
Shape = TypeVar("Shape", bound=BaseGeometry)
# Outlines are repaired in time quadratic in their crossings: a second for 2,000.
_PER_OUTLINE, _MAX_PER_OUTLINE = 20, 2000
# Lines of walls can be a pattern of tiles; the areas between 10,000 crossings take five seconds.
_PER_NETWORK = 10_000
# Pairs of areas whose boxes meet. A storey's outline meets all of its rooms.
_PAIRS, _PAIRS_PER_AREA = 10_000, 100
# Pairs of lines whose boxes meet, which are compared, and comparisons at a time.
_MAX_PAIRS, _PAIRS_AT_A_TIME, _AREAS_AT_A_TIME = 20_000_000, 500_000, 200
# Faces steeper than 45° are walls: the vertical part of their normal is smaller.
_FLAT = 0.7
# Faces up to this height above the lowest are floor, and so are their neighbours up to a high step (m). The faces of
# one step touch within the rounding of the file.
_LEVEL_M, STEP_M, _TOUCHING_M = 0.05, 0.6, 0.01
# A face over this share of faces that are floor is a ceiling.
_OVER = 0.5
# Rounding gaps between faces that are closed.
_SEAM_M = 1e-4
# Rise of a floor (m), and share of a room that is higher than its floor, that are reported.
_UNEVEN_M, _MIN_HIGHER = 0.1, 0.02


def check_network(lines: Sequence[BaseGeometry]) -> None:
    """Check the crossings of lines that are about to be joined."""
    segments = segments_of(lines)
    limit = _PER_NETWORK + len(segments)
    if _has_more_crossings(segments, limit):
        raise InvalidFloorPlanError(
            f"{len(segments)} lines that could be walls cross more than {limit} times, the limit for as many lines; "
            "set layers to the layers of the walls, or remove patterns such as tiles"
        )


def distinct(shapes: Sequence[Shape]) -> list[Shape]:
    """Return shapes without those that equal another: joining a hundred equal shapes takes as long as ten thousand."""
    keys = shapely.to_wkb(shapely.normalize(np.array(list(shapes), dtype=object)))
    return list(dict(zip(reversed(keys), reversed(shapes), strict=True)).values())[::-1]


def check_overlaps(shapes: Sequence[BaseGeometry], what: str) -> None:
    """Check the number of areas that lie over one another, before each pair is compared; errors call them `what`."""
    limit, pairs = _PAIRS + _PAIRS_PER_AREA * len(shapes), 0
    tree = shapely.STRtree(list(shapes))
    for begin in range(0, len(shapes), _AREAS_AT_A_TIME):
        pairs += tree.query(list(shapes[begin : begin + _AREAS_AT_A_TIME])).shape[1]
        if pairs > limit:
            raise InvalidFloorPlanError(
                f"{len(shapes)} {what} lie over one another in more than {limit} pairs, the limit for as many; remove "
                "those that are drawn twice, or set layers to the layers of the plan"
            )


def segments_of(shapes: Sequence[BaseGeometry]) -> Float[np.ndarray, "n 4"]:
    """Return the straight pieces of lines and outlines, without those of no length."""
    rings = shapely.get_parts(shapely.boundary([s for s in shapes if shapely.get_dimensions(s) == 2]))
    lines = [s for s in shapes if shapely.get_dimensions(s) == 1]
    points, owner = shapely.get_coordinates([*rings, *lines], return_index=True)
    pieces = np.concatenate([points[:-1], points[1:]], axis=1)[owner[:-1] == owner[1:]]
    return pieces[np.any(pieces[:, :2] != pieces[:, 2:], axis=1)]


def lines_of(segments: Float[np.ndarray, "n 4"]) -> list[shapely.LineString]:
    """Return segments as lines."""
    return np.asarray(shapely.linestrings(segments.reshape(-1, 2, 2))).tolist()


def _has_more_crossings(segments: Float[np.ndarray, "n 4"], limit: int) -> bool:
    """Return whether more pairs of segments meet, except at common ends, or too many pairs are near each other."""
    if len(segments) * (len(segments) - 1) // 2 <= limit:
        return False
    lines = lines_of(segments)
    tree = shapely.STRtree(lines)
    crossings = pairs = begin = 0
    step = max(_PAIRS_AT_A_TIME // len(segments), 1)
    while begin < len(segments):
        chunk = slice(begin, begin + step)
        first, second = tree.query(lines[chunk])
        first = first + begin
        pairs += len(first)
        is_new = first < second
        crossings += int(_meet_inside(segments, first[is_new], second[is_new]).sum())
        if crossings > limit or pairs > _MAX_PAIRS:
            return True
        begin += step
        # Most lines are near few others.
        step = max(min(8 * step, _PAIRS_AT_A_TIME * begin // max(pairs, 1)), 1)
    return False


def _meet_inside(
    segments: Float[np.ndarray, "n 4"], first: Int[np.ndarray, "k"], second: Int[np.ndarray, "k"]
) -> Bool[np.ndarray, "k"]:
    """Return whether each pair of segments, whose boxes meet, has a common point and no common end."""
    a, b = segments[first, :2], segments[first, 2:]
    c, d = segments[second, :2], segments[second, 2:]
    is_apart = (_side(a, b, c) * _side(a, b, d) > 0.0) | (_side(c, d, a) * _side(c, d, b) > 0.0)
    has_common_end = np.any([(p == q).all(axis=1) for p in (a, b) for q in (c, d)], axis=0)
    return ~is_apart & ~has_common_end


def _side(
    start: Float[np.ndarray, "k 2"], end: Float[np.ndarray, "k 2"], point: Float[np.ndarray, "k 2"]
) -> Float[np.ndarray, "k"]:
    """Return the sign of the side of a line that a point lies on."""
    return np.sign(cross(end - start, point - start))


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


def polygons_of(geometry: BaseGeometry) -> list[shapely.Polygon]:
    """Return the polygons of a geometry, made valid, without those of no area."""
    if geometry.is_empty:
        return []
    valid = geometry
    if not geometry.is_valid:
        check_coordinates(shapely.get_coordinates(geometry), "an outline")
        segments = segments_of([geometry])
        limit = min(_PER_OUTLINE + len(segments), _MAX_PER_OUTLINE)
        if _has_more_crossings(segments, limit):
            x, y = segments[0][:2]
            raise InvalidFloorPlanError(
                f"an outline of {len(segments)} points that begins at ({x:.6g}, {y:.6g}) crosses itself more than "
                f"{limit} times, the limit for as many points; draw the outline once around its area"
            )
        valid = shapely.make_valid(geometry)
    if isinstance(valid, shapely.Polygon):
        return [valid] if valid.area > 0.0 else []
    has_parts = isinstance(valid, shapely.MultiPolygon | shapely.GeometryCollection)
    return [polygon for part in shapely.get_parts(valid) if has_parts for polygon in polygons_of(part)]


def even_odd_polygons(rings: Iterable[shapely.Polygon], *, is_nonzero: bool = False) -> list[shapely.Polygon]:
    """Return the area between nested outlines, as hatches and paths fill it (even-odd rule).

    With the rule `is_nonzero`, outlines in one direction are joined where they overlap.
    """
    shapes: list[BaseGeometry] = list(rings)
    check_network(shapes)
    if is_nonzero and len(shapes) > 1:
        is_ccw = shapely.is_ccw(shapely.get_exterior_ring(shapes))
        shapes = [shapely.union_all(np.array(shapes)[is_ccw == direction]) for direction in (True, False)]
    # In pairs, so that the time is not quadratic in the number of outlines.
    while len(shapes) > 1:
        pairs = zip(shapes[::2], shapes[1::2], strict=False)
        shapes = [*(shapely.symmetric_difference(a, b) for a, b in pairs), *shapes[len(shapes) & ~1 :]]
    return polygons_of(shapes[0]) if shapes else []


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


def extent_of(shapes: Sequence[BaseGeometry]) -> float:
    """Return the longer side of the box around shapes, whose sides are along the axes; NaN without any."""
    x0, y0, x1, y1 = shapely.total_bounds(shapes)
    return float(max(x1 - x0, y1 - y0))


def clusters(shapes: Sequence[BaseGeometry], reach_m: float) -> list[BaseGeometry]:
    """Group shapes that are near each other into one geometry each."""
    if not shapes:
        return []
    check_network(shapes)
    around = shapely.union_all(shapely.buffer(shapes, 0.5 * reach_m, quad_segs=2))
    tree = shapely.STRtree(shapely.get_parts(around))
    members: dict[int, list[BaseGeometry]] = {}
    for index, region in zip(*tree.query(shapes, predicate="intersects").tolist(), strict=True):
        members.setdefault(region, []).append(shapes[index])
    return [shapely.GeometryCollection(group) for group in members.values()]


def label_position(room: shapely.Polygon) -> tuple[float, float]:
    """Return the centre of the largest circle in a room."""
    return point_xy(shapely.maximum_inscribed_circle(room, 0.01).coords[0])


def cross(a: Float[np.ndarray, "*n 2"], b: Float[np.ndarray, "*m 2"]) -> Float[np.ndarray, "*n"]:
    """Return the third component of cross products; it is positive where b points to the left of a."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def point_xy(point: Float[np.ndarray, "2"] | tuple[float, ...]) -> tuple[float, float]:
    """Return a point as two floats."""
    return float(point[0]), float(point[1])


@dataclass(frozen=True)
class MapFrame:
    """Grid of a map, with the size of a cell, and the numbers of rows and columns.

    `origin` is the place of the lower left corner (m) and the grid's counter-clockwise rotation in the map frame.
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


class WallAreas:
    """Areas of walls that do not overlap."""

    def __init__(self, parts: Sequence[shapely.Polygon]) -> None:
        self.parts = parts
        self._areas = shapely.STRtree(parts)
        shapely.prepare(self._areas.geometries)
        self._edges = shapely.STRtree(lines_of(segments_of(parts)))

    def distances_along(self, rays: Float[np.ndarray, "n 2 2"]) -> Float[np.ndarray, "n"]:
        """Return the distance from the start of each ray to the first wall on it, infinite if there is none."""
        lines, origins = np.asarray(shapely.linestrings(rays)), np.asarray(shapely.points(rays[:, 0]))
        found = np.full(len(rays), math.inf)
        ray, edge = self._edges.query(lines, predicate="intersects")
        hits = shapely.intersection(self._edges.geometries[edge], lines[ray])
        np.minimum.at(found, ray, shapely.distance(hits, origins[ray]))
        # A tree's predicate would prepare the points, and look at all edges of an area for each.
        ray, area = self._areas.query(origins)
        found[ray[shapely.intersects(self._areas.geometries[area], origins[ray])]] = 0.0
        return found


@dataclass(frozen=True, eq=False)
class Floor:
    """Outlines of the floor of a solid, the height of its lowest point, and that of its highest above the lowest.

    `higher_m2` is the area of the solid that lies beside its floor, more than a step above it.
    """

    parts: list[shapely.Polygon]
    low_m: float
    rise_m: float
    higher_m2: float


def find_floor(faces: Iterable[Float[np.ndarray, "_ 3"]], check_time: CheckTime) -> Floor | None:
    """Return the floor among the faces of a solid, or of a surface, in metres; None if all faces are steep.

    The floor begins with the lowest face and grows over faces that touch it, up to a step of 60 cm each. `check_time`
    raises an exception to stop.
    """
    flat = [(shape, face[:, 2]) for face in faces if (shape := _seen_from_above(face)) is not None]
    if not flat:
        return None
    shapes = [shape for shape, _ in flat]
    lows = np.array([heights.min() for _, heights in flat])
    highs = np.array([heights.max() for _, heights in flat])
    tree = shapely.STRtree(shapes)
    found = np.zeros(len(flat), bool)
    queue = [(float(lows[index]), int(index)) for index in np.flatnonzero(lows <= lows.min() + _LEVEL_M)]
    heapq.heapify(queue)
    queued = {index for _, index in queue}
    while queue:
        check_time()
        _, index = heapq.heappop(queue)
        near = tree.query(shapes[index], predicate="dwithin", distance=_TOUCHING_M)
        below = near[found[near]]
        covered = shapely.area(shapely.intersection(shapes[index], [shapes[k] for k in below])).sum()
        if covered > _OVER * shapes[index].area:
            continue
        found[index] = True
        for other in near:
            step = max(lows[index], lows[other]) - min(highs[index], highs[other])
            if step <= STEP_M and int(other) not in queued:
                queued.add(int(other))
                heapq.heappush(queue, (float(lows[other]), int(other)))
    floor = join_faces([shape for shape, is_floor in zip(shapes, found, strict=True) if is_floor])
    whole = join_faces(shapes)
    higher_m2 = sum(part.area for part in whole) - sum(part.area for part in floor)
    return Floor(floor, float(lows.min()), float(highs[found].max() - lows.min()), higher_m2)


def report_floor(name: str, floor: Floor, builder: ReportBuilder) -> None:
    """Report a floor that is not level, and parts of a room that are higher than its floor."""
    if floor.rise_m > _UNEVEN_M:
        builder.notes.append(f"the floor of {name} rises by {floor.rise_m:.2f} m; heights count from its lowest point")
    whole_m2 = floor.higher_m2 + sum(part.area for part in floor.parts)
    if floor.higher_m2 > _MIN_HIGHER * whole_m2:
        builder.warnings.append(
            f"{floor.higher_m2:.1f} m² of {name} ({100.0 * floor.higher_m2 / whole_m2:.0f} %) lie more than "
            f"{STEP_M:g} m above its floor and were left out; make it two spaces if they are floor"
        )


def join_faces(shapes: list[shapely.Polygon]) -> list[shapely.Polygon]:
    """Return the area that faces cover, without the gaps that rounding leaves between them."""
    union = shapely.unary_union([shape.buffer(_SEAM_M, join_style="mitre") for shape in shapes])
    return polygons_of(union.buffer(-_SEAM_M, join_style="mitre"))


def _seen_from_above(face: Float[np.ndarray, "n 3"]) -> shapely.Polygon | None:
    """Return the outline of a face, None if it is steep or has no area."""
    if len(face) < 3:
        return None
    # Newell's method: the normal of a polygon that need not be plane.
    local = face - face[0]
    normal = 0.5 * np.cross(local, np.roll(local, -1, axis=0)).sum(axis=0)
    size = float(np.linalg.norm(normal))
    if size < 1e-9 or abs(normal[2]) < _FLAT * size:
        return None
    parts = polygons_of(shapely.Polygon(face[:, :2]))
    return max(parts, key=lambda part: part.area, default=None)
