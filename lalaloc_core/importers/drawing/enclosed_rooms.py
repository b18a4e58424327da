"""Rooms enclosed by walls, after the gaps that openings leave in the walls are closed.

Walls are areas (hatches, filled shapes, dark parts of a picture) or lines, single or double. Lines are joined where
they nearly meet, and thin areas between them are walls. The end of a wall that faces another wall across a narrow gap
is the jamb of an opening. All lengths are in metres.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import shapely
from jaxtyping import Float, Int
from shapely.geometry.base import BaseGeometry

from lalaloc_core.importers.common.geometry import WallAreas, check_network, cross, distinct, point_xy, polygons_of
from lalaloc_core.importers.common.import_limits import CheckTime
from lalaloc_core.importers.common.room_bounds import ROOM_BOUNDS, WallConfig

# Smallest sine of a corner at the end of a wall, and largest gap between two short ends (m).
_CORNER, _MAX_BETWEEN_NIBS = 0.8, 1.3
# Largest offset between two jambs, and half the width of slits that are closed (m).
_OUT_OF_LINE_M, _SLIT_M = 0.35, 0.001
# Share of the lines' length without a second face from which walls can be single lines, and smallest room that counts
# in a comparison of readings (m²).
_MOSTLY_SINGLE, _SMALLEST_COUNTED_M2 = 0.5, 1.0
# Long outlines (m) bound a wall if they are this slim nearly everywhere, and nowhere wider, relative to the thickest.
_LONG_M, _USUAL, _WIDEST = 10.0, 0.75, 2.5
# Ends of walls before which gaps are looked for at a time, and a distance farther than any gap (m).
_ENDS_AT_A_TIME, _FAR_M = 1000, 1e9
# Piers are so much thicker than the usual ends of walls, and shorter than so many times their own thickness.
_PIER, _PIER_NIB = 1.6, 2.0


@dataclass(frozen=True, eq=False)
class Gap:
    """Gap in a wall.

    Attributes:
        shape: quadrilateral between the two jambs.
        start, end: middle line along the wall.
        is_sure: the walls alone identify an opening. False if a jamb is a short nib or the jambs are not in line.
        is_between_ends: both sides are ends of walls, not an end and the face of another wall.
        is_painted, is_bluish: a light area hides the wall here, and has the colour of glass.
        is_pane: lines run through it like the panes of a window.
    """

    shape: shapely.Polygon
    start: tuple[float, float]
    end: tuple[float, float]
    is_sure: bool = True
    is_between_ends: bool = False
    is_painted: bool = False
    is_bluish: bool = False
    is_pane: bool = False

    @property
    def width(self) -> float:
        """Length along the wall."""
        return math.dist(self.start, self.end)


def _rank_by_walls(gap: Gap) -> int | None:
    """Rank a gap by the walls alone: accept sure gaps only."""
    return 0 if gap.is_sure else None


@dataclass(frozen=True, eq=False)
class Enclosed:
    """Rooms, gaps and walls of a drawing."""

    rooms: list[shapely.Polygon]
    gaps: list[Gap]
    walls: BaseGeometry


def enclose(
    bodies: Sequence[shapely.Polygon],
    lines: Sequence[shapely.LineString],
    closers: Sequence[BaseGeometry] = (),
    config: WallConfig = ROOM_BOUNDS.walls,
    check_time: CheckTime = lambda: None,
    rank: Callable[[Gap], int | None] = _rank_by_walls,
) -> Enclosed:
    """Find the rooms between walls.

    `bodies` and `lines` are walls drawn as areas and as lines; `closers` are doors and windows drawn as areas in the
    walls. `check_time` is called between steps and raises an exception to stop. `rank` ranks a gap, lowest first; a gap
    of rank None is not an opening and stays open.
    """
    bodies, lines, closers = distinct(bodies), distinct(lines), distinct(closers)
    check_network([*bodies, *lines, *closers])
    check_time()
    faces, loose = _faces(lines, config, check_time) if lines else ([], [])
    thin = [face for face in faces if _is_wall(face, config)]
    # Lines that were rounded to 1 mm leave slits between the parts of a wall.
    grown = shapely.unary_union([face.buffer(_SLIT_M, join_style="mitre") for face in (*bodies, *thin)])
    solid = grown.buffer(-_SLIT_M, join_style="mitre")
    if solid.area < 0.05:
        return _from_single_lines(lines, closers, config, check_time)
    around = solid.buffer(0.02)
    shapely.prepare(around)
    unpaired = [line for line in loose if not around.covers(line) and line.length >= config.nib]
    blocked = shapely.unary_union([solid, *closers, *(line.buffer(0.01, cap_style="flat") for line in unpaired)])
    check_time()
    gaps = find_gaps(blocked, config, check_time, rank)
    paired = Enclosed(_insides([blocked, *(gap.shape for gap in gaps)], config, check_time), gaps, solid)
    # Pillars, stairs or one thick wall beside single lines are no reason to look for the other face of every line.
    drawn_m = sum(line.length for line in lines)
    if bodies or sum(line.length for line in lines if not around.covers(line)) < _MOSTLY_SINGLE * drawn_m:
        return paired
    single = _from_single_lines(lines, closers, config, check_time)
    return max(paired, single, key=lambda found: explained_size(found.rooms))


def explained_size(rooms: Sequence[shapely.Polygon]) -> float:
    """Return a measure of the drawing that rooms explain: the sum of the roots of their areas.

    Rooms too small for a person count nothing.
    """
    return sum((math.sqrt(room.area) for room in rooms if room.area >= _SMALLEST_COUNTED_M2), 0.0)


def find_gaps(
    walls: BaseGeometry,
    config: WallConfig,
    check_time: CheckTime = lambda: None,
    rank: Callable[[Gap], int | None] = _rank_by_walls,
) -> list[Gap]:
    """Return gaps between the ends of walls and the walls that they face, by rank and width, without overlaps."""
    areas = WallAreas([simple for part in polygons_of(walls) for simple in polygons_of(part.simplify(0.004))])
    rings = shapely.get_rings(shapely.orient_polygons(areas.parts))
    ends = [end for ring in rings for end in _ends(shapely.get_coordinates(ring), config)]
    check_time()
    coarse = shapely.simplify(rings, config.blunt) if config.blunt else []
    blunt = [end for ring in coarse for end in _ends(shapely.get_coordinates(ring), config)]
    usual = float(np.median([wall.thickness for wall in ends if wall.thickness <= config.thickest] or [0.0]))
    # Most ends are found twice, as they are and blunt.
    found: dict[tuple[tuple[float, float], tuple[float, float]], Gap] = {}
    all_ends = [*ends, *blunt]
    for begin in range(0, len(all_ends), _ENDS_AT_A_TIME):
        check_time()
        for index, gap in _gaps_before(all_ends[begin : begin + _ENDS_AT_A_TIME], areas, config):
            wall = all_ends[begin + index]
            is_broad = wall.thickness > config.thickest
            if gap.is_between_ends or is_broad or not wall.is_pier(usual):
                # The direction of a blunt end is inexact, so its gap needs a symbol, as that beside a broad pier.
                gap = gap if begin + index < len(ends) and not is_broad else replace(gap, is_sure=False)
                found.setdefault((gap.start, gap.end), gap)
    ranked = [(priority, gap.width, gap) for gap in found.values() if (priority := rank(gap)) is not None]
    gaps = [gap for _, _, gap in sorted(ranked, key=lambda item: item[:2])]
    return [gaps[index] for index in without_overlaps([gap.shape for gap in gaps], 0.25, check_time)]


def without_overlaps(areas: Sequence[shapely.Polygon], share: float, check_time: CheckTime = lambda: None) -> list[int]:
    """Return the numbers of the areas that share less than a part of their area with each that was kept before."""
    tree, is_kept = shapely.STRtree(areas), np.zeros(len(areas), bool)
    for index, shape in enumerate(areas):
        check_time()
        near = tree.query(shape)
        shared = (shapely.intersection(shape, areas[k]).area for k in near[is_kept[near]])
        is_kept[index] = all(shared_area < share * shape.area for shared_area in shared)
    return np.flatnonzero(is_kept).tolist()


@dataclass(frozen=True, eq=False)
class _End:
    """End of a wall: its edge, the outward direction, and the length of the wall behind it (`nib`)."""

    start: Float[np.ndarray, "2"]
    end: Float[np.ndarray, "2"]
    outward: Float[np.ndarray, "2"]
    nib: float

    @property
    def thickness(self) -> float:
        """Length of the edge."""
        return float(np.linalg.norm(self.end - self.start))

    def is_pier(self, usual: float) -> bool:
        """Return whether this is the face of a pier, shaft or chimney, among walls of a usual thickness."""
        return self.thickness > _PIER * usual and self.nib < _PIER_NIB * self.thickness


def _ends(ring: Float[np.ndarray, "n 2"], config: WallConfig) -> list[_End]:
    """Return the edges of a ring that are ends of walls; the wall lies to the left of the ring.

    An end is as short as walls are thick and has a right-angled corner at both sides. Its outward direction follows the
    longer neighbouring edge, because short edges are less accurate.
    """
    points = ring[:-1]
    if len(points) < 4:
        return []
    steps = np.roll(points, -1, axis=0) - points
    lengths = np.linalg.norm(steps, axis=1)
    directions = steps / np.maximum(lengths, 1e-12)[:, None]
    turns = cross(directions, np.roll(directions, -1, axis=0))
    is_end = (lengths >= config.thinnest) & (lengths <= max(config.thickest, config.widest_pier))
    found = []
    for i in np.flatnonzero(is_end & (np.minimum(np.roll(turns, 1), turns) >= _CORNER)).tolist():
        following = (i + 1) % len(points)
        nib = max(lengths[i - 1], lengths[following])
        outward = directions[i - 1] if lengths[i - 1] >= lengths[following] else -directions[following]
        found.append(_End(points[i], points[following], outward, float(nib)))
    return found


def _gaps_before(walls: Sequence[_End], areas: WallAreas, config: WallConfig) -> list[tuple[int, Gap]]:
    """Return the gaps in front of ends of walls that are within the limits of width, with the number of each end."""
    start, outward = np.array([wall.start for wall in walls]), np.array([wall.outward for wall in walls])
    edge = np.array([wall.end for wall in walls]) - start
    origins = start[:, None] + np.array([0.15, 0.5, 0.85])[:, None] * edge[:, None]
    origins = (origins + 0.5 * config.thinnest * outward[:, None]).reshape(-1, 2)
    rays = np.stack([origins, origins + config.widest_gap * np.repeat(outward, 3, axis=0)], axis=1)
    distances = np.minimum(0.5 * config.thinnest + areas.distances_along(rays), _FAR_M).reshape(-1, 3)
    # One of the three rays can miss if the walls are not quite in line.
    nearest, middle, farthest = np.sort(distances, axis=1).T
    width = np.where(farthest - middle <= 0.25 * config.thickest, farthest, middle)
    is_gap = (width - nearest <= _OUT_OF_LINE_M) & (width >= config.narrowest_gap) & (width <= config.widest_gap)
    # The other side is the end of a wall of similar thickness if no wall lies beside the corners of the gap.
    a = start + (width + 0.02)[:, None] * outward
    b, side = a + edge, 0.12 * edge / np.linalg.norm(edge, axis=1)[:, None]
    outside = np.stack([np.stack([a - side, a - 0.3 * side], axis=1), np.stack([b + 0.3 * side, b + side], axis=1)])
    is_at_face = np.zeros(len(walls), bool)
    to_walls = areas.distances_along(outside[:, is_gap].reshape(-1, 2, 2))
    is_at_face[is_gap] = np.isfinite(to_walls).reshape(2, -1).any(axis=0)
    found = []
    for index in np.flatnonzero(is_gap).tolist():
        wall, width_m = walls[index], float(width[index])
        is_sure = width_m - float(nearest[index]) <= 0.25 * config.thickest and (
            wall.nib >= config.nib or (not is_at_face[index] and width_m <= _MAX_BETWEEN_NIBS)
        )
        # Overlap both walls slightly, so that no slit stays open.
        near, far = -0.02 * wall.outward, (width_m + 0.02) * wall.outward
        shape = shapely.Polygon([wall.start + near, wall.end + near, wall.end + far, wall.start + far])
        begin = 0.5 * (wall.start + wall.end)
        if shape.is_valid:
            reach = point_xy(begin + width_m * wall.outward)
            found.append((index, Gap(shape, point_xy(begin), reach, is_sure, not is_at_face[index])))
    return found


def _faces(
    lines: Sequence[shapely.LineString], config: WallConfig, check_time: CheckTime
) -> tuple[list[shapely.Polygon], list[shapely.LineString]]:
    """Return the areas between the joined lines, and the lines that bound no area."""
    segments = _network(lines)
    check_time()
    joined = shapely.unary_union([*segments, *_joints(segments, config)])
    check_time()
    polygons, cuts, dangles, _ = shapely.polygonize_full(list(shapely.get_parts(joined)))
    return list(shapely.get_parts(polygons)), [*shapely.get_parts(cuts), *shapely.get_parts(dangles)]


def _network(lines: Sequence[shapely.LineString]) -> list[shapely.LineString]:
    """Return the pieces of lines between their crossings, rounded to 1 mm."""
    joined = shapely.unary_union(shapely.set_precision(shapely.multilinestrings(list(lines)), 0.001))
    return [part for part in shapely.get_parts(joined) if part.length > 0.0]


def _joints(segments: Sequence[shapely.LineString], config: WallConfig) -> list[shapely.LineString]:
    """Return lines that join loose ends to the line they nearly touch, or to the other face of their wall as a jamb."""
    ends, directions = _loose_ends(segments)
    if not len(ends):
        return []
    tree = shapely.STRtree(list(segments))
    points = [shapely.Point(end) for end in ends]
    ends_tree = shapely.STRtree(points)
    joints = []
    for index, point in enumerate(points):
        near = tree.geometries[tree.query(point, predicate="dwithin", distance=config.snap)]
        apart = shapely.distance(near, point)
        if (apart > 1e-9).any():
            joints.append(shapely.shortest_line(point, near[np.where(apart > 1e-9, apart, np.inf).argmin()]))
            continue
        beside = _near(ends_tree, point, config.thickest)
        steps = ends[beside] - ends[index]
        apart = np.linalg.norm(steps, axis=1)
        across = np.abs(steps @ directions[index]) < 0.25 * np.maximum(apart, 1e-12)
        parallel = np.abs(cross(directions[beside], directions[index][None])) < 0.1
        partners = np.flatnonzero((apart > config.thinnest) & (apart <= config.thickest) & across & parallel)
        if len(partners):
            partner = beside[partners[np.argmin(apart[partners])]]
            joints.append(shapely.LineString([ends[index], ends[partner]]))
    return joints


def _near(tree: shapely.STRtree, point: shapely.Point, distance_m: float) -> Int[np.ndarray, "n"]:
    """Return the points of a tree in a square that contains the circle around a point, in order."""
    return np.sort(tree.query(point.buffer(1.01 * distance_m, cap_style="square")))


def _loose_ends(segments: Sequence[shapely.LineString]) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
    """Return the ends that no other segment shares, and the outward unit vectors of their lines."""
    # Both ends of each line, with the next point.
    ends = np.array([np.asarray(segment.coords)[[0, 1, -1, -2]] for segment in segments]).reshape(-1, 2, 2)
    tips, steps = ends[:, 0], ends[:, 0] - ends[:, 1]
    outward = steps / np.maximum(np.linalg.norm(steps, axis=1, keepdims=True), 1e-12)
    _, inverse, counts = np.unique(np.round(tips, 4), axis=0, return_inverse=True, return_counts=True)
    loose = counts[inverse.reshape(-1)] == 1
    return tips[loose], outward[loose]


def _from_single_lines(
    lines: Sequence[shapely.LineString], closers: Sequence[BaseGeometry], config: WallConfig, check_time: CheckTime
) -> Enclosed:
    """Find rooms between walls without thickness; gaps lie in front of loose ends."""
    if not lines:
        return Enclosed([], [], shapely.Polygon())
    segments = _network(lines)
    ends, outward = _loose_ends(segments)
    tree, ends_tree = shapely.STRtree(segments), shapely.STRtree(np.asarray(shapely.points(ends)))
    gaps: list[Gap] = []
    corners: list[shapely.LineString] = []
    for end, direction in zip(ends, outward, strict=True):
        check_time()
        near = ends[_near(ends_tree, shapely.Point(end), config.snap)]
        meeting = [shapely.LineString([end, tip]) for tip in near if 1e-9 < math.dist(tip, end) <= config.snap]
        if meeting:
            corners += meeting
            continue
        ray = shapely.LineString([end + 1e-4 * direction, end + config.widest_gap * direction])
        hits = [segments[k].intersection(ray) for k in tree.query(ray, predicate="intersects")]
        reached = [shapely.distance(shapely.Point(end), hit) for hit in hits if not hit.is_empty]
        steps = ends[_near(ends_tree, shapely.Point(end), config.widest_gap)] - end
        apart = np.linalg.norm(steps, axis=1)
        is_facing = (apart > 1e-6) & (apart <= config.widest_gap) & (steps @ direction > 0.99 * apart)
        width = min([*reached, *apart[is_facing].tolist()], default=0.0)
        if width > 0.0:
            line = shapely.LineString([end, end + (width + 0.002) * direction])
            gaps.append(Gap(line.buffer(0.001), point_xy(end), point_xy(end + width * direction)))
    joints = [line.buffer(0.002) for line in (*corners, *(shapely.LineString([g.start, g.end]) for g in gaps))]
    walls = shapely.unary_union([line.buffer(0.002) for line in segments])
    distinct = {tuple(sorted((gap.start, gap.end))): gap for gap in gaps if gap.width >= config.narrowest_gap}
    return Enclosed(_insides([walls, *joints, *closers], config, check_time), list(distinct.values()), walls)


def _insides(pieces: Sequence[BaseGeometry], config: WallConfig, check_time: CheckTime) -> list[shapely.Polygon]:
    """Return the areas enclosed by the union of some pieces that are large enough for a room, the largest first."""
    parts = polygons_of(shapely.unary_union(list(pieces)))
    filled = shapely.union_all([shapely.Polygon(part.exterior) for part in parts])
    rooms = []
    for floor in polygons_of(shapely.difference(filled, shapely.MultiPolygon(parts))):
        check_time()
        if floor.area >= config.smallest_room_m2 and not _is_thin(floor, config.shallowest_room):
            rooms.append(floor.simplify(0.004))
    return sorted(rooms, key=lambda room: -room.area)


def _is_thin(face: shapely.Polygon, depth_m: float) -> bool:
    return face.buffer(-0.5 * depth_m).is_empty


def _is_wall(face: shapely.Polygon, config: WallConfig) -> bool:
    """Return whether the area between lines is a wall, at most widened by shafts, chimneys and acute corners."""
    if _is_thin(face, config.thickest):
        return True
    usual = 2.0 * face.area / face.length
    is_slim = face.length >= _LONG_M and usual <= _USUAL * config.thickest
    return is_slim and face.buffer(-0.5 * _WIDEST * config.thickest).is_empty
