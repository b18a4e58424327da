"""Rooms from walls: what walls enclose, once the gaps that doors leave in them are closed.

Walls come as areas (hatches, filled shapes, what is dark in a picture) or as lines, single or double. Lines are joined
where they nearly meet; thin areas between them are walls. The end of a wall that faces another wall across a gap no
wider than a door is the jamb of an opening. All lengths in metres.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from jaxtyping import Float
from shapely.geometry.base import BaseGeometry

from lalaloc_core.importers.model.geometry import polygons_of

# Sine of the least angle of a corner at the end of a wall; and how far apart two short ends are jambs of one door (m).
_CORNER, _MAX_BETWEEN_NIBS = 0.8, 1.3
# Jambs that are not in line by more than this are none (m).
_OUT_OF_LINE_M = 0.35


@dataclass(frozen=True, kw_only=True)
class WallConfig:
    """What walls and the openings in them measure (m).

    Attributes:
        thickest: beyond, an area is a room, not a wall.
        thinnest: shorter ends of walls are corners that a drawing rounds.
        widest_gap: wider gaps are left open, the rooms beside them are one.
        narrowest_gap: of an opening.
        nib: a wall's end must be that long to be the jamb of a gap by itself; shorter ones need one that faces them.
        snap: ends of lines that are nearer than this to another line are meant to touch it.
        smallest_room_m2: of what walls enclose, less is a duct.
    """

    thickest: float = 0.55
    thinnest: float = 0.03
    widest_gap: float = 1.9
    narrowest_gap: float = 0.3
    nib: float = 0.28
    snap: float = 0.06
    smallest_room_m2: float = 0.6


DEFAULT_WALLS = WallConfig()


@dataclass(frozen=True, eq=False)
class Gap:
    """An opening in a wall: the quadrilateral between two jambs, and its middle line along the wall.

    `is_sure` is False where the walls alone do not tell: one end is a short nib, or the two are not quite in line.
    `is_between_ends` tells that both sides are ends of walls, not an end and the face of another.
    """

    shape: shapely.Polygon
    start: tuple[float, float]
    end: tuple[float, float]
    is_sure: bool = True
    is_between_ends: bool = False

    @property
    def width(self) -> float:
        """Length along the wall."""
        return math.dist(self.start, self.end)


def judge_by_walls(gap: Gap) -> int | None:
    """Where nothing but walls is known: only what they leave no doubt of."""
    return 0 if gap.is_sure else None


@dataclass(frozen=True, eq=False)
class Enclosed:
    """What walls enclose."""

    rooms: list[shapely.Polygon]
    gaps: list[Gap]
    walls: BaseGeometry


def enclose(
    bodies: Sequence[shapely.Polygon],
    lines: Sequence[shapely.LineString],
    closers: Sequence[BaseGeometry] = (),
    config: WallConfig = DEFAULT_WALLS,
    tick: Callable[[], None] = lambda: None,
    judge: Callable[[Gap], int | None] = judge_by_walls,
) -> Enclosed:
    """The rooms between walls.

    Args:
        bodies: walls as areas.
        lines: walls as lines.
        closers: doors and windows that are drawn as areas in the walls.
        tick: called between steps; may raise to end it.
        judge: how good a gap between two walls is, the least is the best; None: it is no opening, and stays open.
    """
    faces, loose = _faces(lines, config, tick) if lines else ([], [])
    thin = [face for face in faces if _is_thin(face, config)]
    solid = shapely.unary_union([*bodies, *thin]) if bodies or thin else shapely.Polygon()
    if solid.area < 0.05:
        return _from_single_lines(lines, closers, config, tick)
    leftovers = [line for line in loose if not solid.buffer(0.02).covers(line) and line.length >= config.nib]
    blocked = shapely.unary_union([solid, *closers, *(line.buffer(0.01, cap_style="flat") for line in leftovers)])
    tick()
    gaps = find_gaps(blocked, config, tick, judge)
    return Enclosed(_insides([blocked, *(gap.shape for gap in gaps)], config), gaps, solid)


def find_gaps(
    walls: BaseGeometry,
    config: WallConfig,
    tick: Callable[[], None] = lambda: None,
    judge: Callable[[Gap], int | None] = judge_by_walls,
) -> list[Gap]:
    """Openings between ends of walls and what they face, the best and then the narrowest first; none overlaps."""
    parts = [simple for part in polygons_of(walls) for simple in polygons_of(part.simplify(0.004))]
    tree = shapely.STRtree(parts)
    found: list[Gap] = []
    for part in parts:
        oriented = shapely.geometry.polygon.orient(part)
        for ring in (oriented.exterior, *oriented.interiors):
            for wall in _ends(np.asarray(ring.coords), config):
                tick()
                gap = _gap_before(wall, parts, tree, config)
                if gap is not None:
                    found.append(gap)
    kept: list[Gap] = []
    ranked = [(rank, gap.width, gap) for gap in found if (rank := judge(gap)) is not None]
    for _, _, gap in sorted(ranked, key=lambda item: item[:2]):
        if all(shapely.intersection(gap.shape, other.shape).area < 0.25 * gap.shape.area for other in kept):
            kept.append(gap)
    return kept


@dataclass(frozen=True, eq=False)
class _End:
    """The end of a wall: its edge, where it looks, and how long the wall behind it is."""

    start: Float[np.ndarray, "2"]
    end: Float[np.ndarray, "2"]
    outward: Float[np.ndarray, "2"]
    nib: float


def _ends(ring: Float[np.ndarray, "n 2"], config: WallConfig) -> list[_End]:
    """Edges that end a wall, of a ring with the wall to its left.

    Ends are as short as walls are thick, with a right-angled corner at both sides. They look along the longer of their
    neighbours: of a drawing's edges the short ones are the least exact.
    """
    points = ring[:-1]
    if len(points) < 4:
        return []
    steps = np.roll(points, -1, axis=0) - points
    lengths = np.linalg.norm(steps, axis=1)
    directions = steps / np.maximum(lengths, 1e-12)[:, None]
    turns = _cross(directions, np.roll(directions, -1, axis=0))
    found = []
    for i in range(len(points)):
        following = (i + 1) % len(points)
        if not config.thinnest <= lengths[i] <= config.thickest or min(turns[i - 1], turns[i]) < _CORNER:
            continue
        behind = max(lengths[i - 1], lengths[following])
        outward = directions[i - 1] if lengths[i - 1] >= lengths[following] else -directions[following]
        found.append(_End(points[i], points[following], outward, float(behind)))
    return found


def _gap_before(wall: _End, parts: Sequence[shapely.Polygon], tree: shapely.STRtree, config: WallConfig) -> Gap | None:
    """The gap between the end of a wall and what it faces; None where that is too near, too far or nothing."""
    outward = wall.outward
    distances = []
    for share in (0.15, 0.5, 0.85):
        origin = wall.start + share * (wall.end - wall.start) + 0.5 * config.thinnest * outward
        ray = shapely.LineString([origin, origin + config.widest_gap * outward])
        hits = [parts[index].intersection(ray) for index in tree.query(ray, predicate="intersects")]
        reached = [shapely.distance(shapely.Point(origin), hit) for hit in hits if not hit.is_empty]
        distances.append(0.5 * config.thinnest + float(min(reached, default=math.inf)))
    # One of three may miss, where walls are not quite in line.
    nearest, middle, farthest = sorted(distances)
    width = farthest if farthest - middle <= 0.25 * config.thickest else middle
    if width - nearest > _OUT_OF_LINE_M or not config.narrowest_gap <= width <= config.widest_gap:
        return None
    is_between_ends = _faces_an_end(wall.start, wall.end, outward, width, tree)
    is_sure = width - nearest <= 0.25 * config.thickest and (
        wall.nib >= config.nib or (is_between_ends and width <= _MAX_BETWEEN_NIBS)
    )
    # A little into both walls, so that nothing is left open beside it.
    near, far = -0.02 * outward, (width + 0.02) * outward
    shape = shapely.Polygon([wall.start + near, wall.end + near, wall.end + far, wall.start + far])
    if not shape.is_valid:
        return None
    begin = 0.5 * (wall.start + wall.end)
    reach = begin + width * outward
    return Gap(shape, (float(begin[0]), float(begin[1])), (float(reach[0]), float(reach[1])), is_sure, is_between_ends)


def _faces_an_end(
    start: Float[np.ndarray, "2"],
    end: Float[np.ndarray, "2"],
    outward: Float[np.ndarray, "2"],
    width: float,
    tree: shapely.STRtree,
) -> bool:
    """Whether the other side of a gap is the end of a wall as well, about as thick."""
    a, b = start + (width + 0.02) * outward, end + (width + 0.02) * outward
    side = 0.12 * (b - a) / np.linalg.norm(b - a)
    outside = shapely.LineString([a - side, a - 0.3 * side]), shapely.LineString([b + 0.3 * side, b + side])
    return not any(len(tree.query(piece, predicate="intersects")) > 0 for piece in outside)


def _faces(
    lines: Sequence[shapely.LineString], config: WallConfig, tick: Callable[[], None]
) -> tuple[list[shapely.Polygon], list[shapely.LineString]]:
    """(areas between lines, once they are joined; lines that bound none)."""
    network = shapely.unary_union(shapely.set_precision(shapely.multilinestrings(list(lines)), 0.001))
    tick()
    segments = [part for part in shapely.get_parts(network) if part.length > 0.0]
    joined = shapely.unary_union([*segments, *_joints(segments, config)])
    tick()
    polygons, cuts, dangles, _ = shapely.polygonize_full(list(shapely.get_parts(joined)))
    loose = [*shapely.get_parts(cuts), *shapely.get_parts(dangles)]
    return list(shapely.get_parts(polygons)), [line for line in loose if isinstance(line, shapely.LineString)]


def _joints(segments: Sequence[shapely.LineString], config: WallConfig) -> list[shapely.LineString]:
    """What joins loose ends: to the line that they nearly touch, or, as a jamb, to the other face of their wall."""
    ends, directions = _loose_ends(segments)
    if not len(ends):
        return []
    tree = shapely.STRtree(list(segments))
    points = [shapely.Point(end) for end in ends]
    joints = []
    for index, point in enumerate(points):
        near = [
            segments[k]
            for k in tree.query(point, predicate="dwithin", distance=config.snap)
            if shapely.distance(segments[k], point) > 1e-9
        ]
        if near:
            nearest = min(near, key=lambda line: shapely.distance(line, point))
            joints.append(shapely.shortest_line(point, nearest))
            continue
        steps = ends - ends[index]
        apart = np.linalg.norm(steps, axis=1)
        across = np.abs(steps @ directions[index]) < 0.25 * np.maximum(apart, 1e-12)
        parallel = np.abs(_cross(directions, directions[index][None])) < 0.1
        partners = np.flatnonzero((apart > config.thinnest) & (apart <= config.thickest) & across & parallel)
        if len(partners):
            other = partners[np.argmin(apart[partners])]
            joints.append(shapely.LineString([ends[index], ends[other]]))
    return joints


def _loose_ends(
    segments: Sequence[shapely.LineString],
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
    """(ends that no other segment shares, unit vectors that lead out of the line there)."""
    tips, outward = [], []
    for segment in segments:
        points = np.asarray(segment.coords)
        for tip, inner in ((points[0], points[1]), (points[-1], points[-2])):
            tips.append(tip)
            outward.append((tip - inner) / max(float(np.linalg.norm(tip - inner)), 1e-12))
    if not tips:
        return np.empty((0, 2)), np.empty((0, 2))
    array = np.array(tips)
    _, inverse, counts = np.unique(np.round(array, 4), axis=0, return_inverse=True, return_counts=True)
    loose = counts[inverse.reshape(-1)] == 1
    return array[loose], np.array(outward)[loose]


def _from_single_lines(
    lines: Sequence[shapely.LineString],
    closers: Sequence[BaseGeometry],
    config: WallConfig,
    tick: Callable[[], None],
) -> Enclosed:
    """Walls without thickness: gaps lie between loose ends and what lies straight before them."""
    if not lines:
        return Enclosed([], [], shapely.Polygon())
    network = shapely.unary_union(shapely.set_precision(shapely.multilinestrings(list(lines)), 0.001))
    segments = [part for part in shapely.get_parts(network) if part.length > 0.0]
    ends, outward = _loose_ends(segments)
    tree = shapely.STRtree(segments)
    gaps: list[Gap] = []
    for end, direction in zip(ends, outward, strict=True):
        tick()
        ray = shapely.LineString([end + 1e-4 * direction, end + config.widest_gap * direction])
        hits = [segments[k].intersection(ray) for k in tree.query(ray, predicate="intersects")]
        reached = [shapely.distance(shapely.Point(end), hit) for hit in hits if not hit.is_empty]
        facing = [
            float(np.linalg.norm(other - end))
            for other in ends
            if 1e-6 < np.linalg.norm(other - end) <= config.widest_gap
            and float((other - end) @ direction) > 0.99 * float(np.linalg.norm(other - end))
        ]
        width = min([*reached, *facing], default=0.0)
        if width <= 0.0:
            continue
        far = end + width * direction
        line = shapely.LineString([end, end + (width + 0.002) * direction])
        gaps.append(Gap(line.buffer(0.001), (float(end[0]), float(end[1])), (float(far[0]), float(far[1]))))
    joints = [shapely.LineString([gap.start, gap.end]).buffer(0.002) for gap in gaps]
    walls = shapely.unary_union([line.buffer(0.002) for line in segments])
    distinct = {tuple(sorted((gap.start, gap.end))): gap for gap in gaps if gap.width >= config.narrowest_gap}
    return Enclosed(_insides([walls, *joints, *closers], config), list(distinct.values()), walls)


def _insides(pieces: Sequence[BaseGeometry], config: WallConfig) -> list[shapely.Polygon]:
    """What the union of some areas encloses and is large enough for a room."""
    union = shapely.unary_union(list(pieces))
    rooms = []
    for part in polygons_of(union):
        for ring in part.interiors:
            inside = shapely.Polygon(ring).difference(union)
            for floor in polygons_of(inside):
                if floor.area >= config.smallest_room_m2 and not _is_thin(floor, config):
                    rooms.append(floor.simplify(0.004))
    return _distinct(rooms)


def _distinct(rooms: list[shapely.Polygon]) -> list[shapely.Polygon]:
    """An island of walls in a room encloses rooms that its own loop found as well."""
    kept: list[shapely.Polygon] = []
    for room in sorted(rooms, key=lambda each: -each.area):
        if all(shapely.intersection(room, other).area < 0.5 * room.area for other in kept):
            kept.append(room)
    return kept


def _is_thin(face: shapely.Polygon, config: WallConfig) -> bool:
    return face.buffer(-0.5 * config.thickest).is_empty


def _cross(a: Float[np.ndarray, "n 2"], b: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "n"]:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
