"""Readings of a drawing, which compete: rooms that the file marks, and rooms that walls of several kinds enclose.

Walls are what the layers name so, dark areas and thick lines, or all lines. The reading that explains most of the
drawing wins, and the report says by what.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import shapely
from shapely.geometry.base import BaseGeometry

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.importers.common.crossings import check_network, check_overlaps
from lalaloc_core.importers.common.geometry import point_xy, polygons_from_geometry, side_lengths
from lalaloc_core.importers.common.import_limits import Budget
from lalaloc_core.importers.common.import_report import ReportBuilder
from lalaloc_core.importers.common.vocabulary import room_type_from_name
from lalaloc_core.importers.drawing.drawn_panes import drawn_panes
from lalaloc_core.importers.drawing.enclosed_rooms import DEFAULT_WALLS, Enclosed, Gap, enclose, explained_size
from lalaloc_core.importers.drawing.painted_openings import cut_painted
from lalaloc_core.importers.drawing.vector_drawing import Area, Drawing, Swing

# Largest distance between parts of one symbol (leaf, frame, panes).
SYMBOL_M = 0.12
# Largest distance of a hinge from an end of its gap, and width of a leaf as a share of the gap.
_HINGE_M, _LEAF_OF_GAP = 0.4, (0.7, 1.35)
# Largest distance of the tip of an open leaf from the other end of its gap, as a share of the gap: open by 90°.
_OPEN_LEAF = 1.45
# Overlap of a painted opening with its wall (m).
_SEAM_M = 0.005
# Width of pens that draw walls.
_THICK_M = (0.05, 0.6)
# Size and width of strokes of letters that are drawn as areas.
_LETTER_M, _LETTER_STROKE_M = 0.5, 0.06
# Largest pillar or chimney that is dark, and that is an outline (m); share of a wall's area that may be thicker.
_PILLAR_M, _OUTLINED_PILLAR_M, _THICKER = 1.3, 0.8, 0.5
_MAX_SEGMENTS = 60_000
# A room that a layer names by its use may lie in other rooms by this share, and is at least this large (m²).
_SHARED, _SMALLEST_ROOM_M2 = 0.1, 0.6
# Explanation that a door on a gap adds; a room with a name counts more.
_DOOR, _NAMED = 0.5, 1.25
# A later reading wins if it explains so much more and covers so much more, or explains more still.
_BETTER, _LARGER, _MUCH_BETTER, _NOT_SMALLER = 1.3, 1.15, 1.8, 0.85
# Rooms that the file marks are given up for a multiple of that.
_TRUST_IN_MARKS = 1.5
# Share of the box around the drawing from which marked rooms are complete.
_COMPLETE = 0.25
_MAX_NAMED = 8


@dataclass(frozen=True, eq=False)
class Reading:
    """Rooms of a drawing by one kind of evidence.

    Attributes:
        source: what the rooms are, in words.
        walls: walls that enclose the rooms; None for rooms that the file marks.
        doors: gaps that leaves of doors close.
        named: rooms with a name that is a use.
    """

    source: str
    rooms: list[Area]
    gaps: list[Gap] = field(default_factory=list)
    walls: BaseGeometry | None = None
    doors: int = 0
    named: int = 0

    @property
    def area_m2(self) -> float:
        """Area of all rooms."""
        return float(sum(room.shape.area for room in self.rooms))

    @property
    def explained(self) -> float:
        """Measure of the drawing that the reading explains, see `explained_size`; names and doors add to it."""
        shapes = [room.shape for room in self.rooms]
        named = 1.0 + (_NAMED - 1.0) * self.named / max(len(shapes), 1)
        return named * explained_size(shapes) + _DOOR * self.doors

    def __str__(self) -> str:
        return (
            f"{self.source}: {len(self.rooms)} rooms, {self.area_m2:.1f} m², {self.doors} doors in gaps, "
            f"{self.named} rooms with a name"
        )


def choose_reading(
    drawing: Drawing, marked: list[Area], leaves: Sequence[Swing], builder: ReportBuilder, budget: Budget
) -> Reading:
    """Return the reading that explains most of a drawing in metres, and report the others.

    Args:
        drawing: the drawing, without leaves of doors among its lines.
        marked: rooms that the file marks, see `marked_rooms`.
        leaves: leaves and swings of doors.
        builder: the report.
        budget: the budget.
    """
    readings: list[Reading] = []
    if marked:
        readings.append(
            _count_doors_and_names(Reading("the areas that the file marks as rooms", marked), drawing, leaves)
        )
    # Rooms that layers mark by a word for rooms are complete, unless they are a small part of the drawing.
    is_by_word = any(area.role == "room" for area in marked)
    box_m2 = shapely.box(*shapely.total_bounds(drawing.shapes)).area if drawing.shapes else 0.0
    if not is_by_word or readings[0].area_m2 < _COMPLETE * box_m2:
        refused: InvalidFloorPlanError | None = None
        for source, read in _WALLS.items():
            budget.begin(f"finding rooms between {source}")
            try:
                found = read(drawing, budget)
            except InvalidFloorPlanError as error:
                budget.check_time()
                refused = error
                continue
            if found is not None:
                shapes = [Area(shape, "", "room") for shape in found.rooms]
                reading = Reading(f"the areas enclosed by {source}", shapes, found.gaps, found.walls)
                readings.append(_count_doors_and_names(reading, drawing, leaves))
        if refused is not None and not any(reading.rooms for reading in readings):
            raise refused
    best = readings[0] if readings else Reading("the areas enclosed by all lines", [], walls=shapely.Polygon())
    for reading in readings[1:]:
        if _is_better(reading, best):
            best = reading
    closed = f"; gaps up to {DEFAULT_WALLS.widest_gap:g} m were closed" if best.walls is not None else ""
    builder.notes.append(f"rooms are {best.source}{closed}")
    rivals = [reading for reading in readings if reading is not best and reading.rooms]
    if rivals:
        builder.notes.append(f"chosen: {best}; other readings: {' | '.join(str(reading) for reading in rivals)}")
    return best


def _is_better(reading: Reading, best: Reading) -> bool:
    if not best.rooms:
        return bool(reading.rooms)
    trust = _TRUST_IN_MARKS if best.walls is None else 1.0
    ratio = reading.explained / max(best.explained, 1e-9) / trust
    larger = reading.area_m2 / max(best.area_m2, 1e-9)
    return (ratio >= _BETTER and larger >= _LARGER) or (ratio >= _MUCH_BETTER and larger >= _NOT_SMALLER)


def _count_doors_and_names(reading: Reading, drawing: Drawing, leaves: Sequence[Swing]) -> Reading:
    """Return a reading with its doors and names counted."""
    finder = GapFinder(reading.gaps)
    closed = {index for leaf in leaves if (index := finder.closed_by(leaf)) is not None}
    names = [t.position for t in drawing.letterings if room_type_from_name(t.text) is not None]
    named: set[int] = set()
    if names and reading.rooms:
        tree = shapely.STRtree([room.shape for room in reading.rooms])
        named = set(tree.query(shapely.points(names), predicate="within")[1].tolist())
    return replace(reading, doors=len(closed), named=len(named))


def marked_rooms(drawing: Drawing, builder: ReportBuilder) -> list[Area]:
    """Return the closed outlines on layers named after rooms: by a word for rooms, or by the use of a room."""
    by_word = [area for area in drawing.areas if area.role == "room"]
    by_use = [area for area in drawing.areas if area.role is None and _use(area) is not None and is_room_like(area)]
    check_overlaps([area.shape for area in (*by_word, *by_use)], what="rooms")
    rooms = _without_containers([*by_word, *by_use], builder)
    # Furniture of a kitchen can lie on a layer of that name, inside the room.
    tree = shapely.STRtree([room.shape for room in rooms])
    kept = []
    for index, room in enumerate(rooms):
        near = [rooms[k] for k in tree.query(room.shape, predicate="intersects") if k != index]
        larger = [other for other in near if other.role == "room" or other.shape.area > room.shape.area]
        shared = sum(shapely.intersection(room.shape, other.shape).area for other in larger)
        if room.role == "room" or shared <= _SHARED * room.shape.area:
            kept.append(room if room.kind else replace(room, kind=_use(room)))
    return kept


def _use(area: Area) -> str | None:
    """Return the words that name the use of a closed outline, None if nothing does."""
    return next((text for text in (area.kind, area.name, area.layer) if room_type_from_name(text) is not None), None)


def is_room_like(area: Area) -> bool:
    """Return whether a closed outline is as large as a room, and no wall."""
    return area.shape.area >= _SMALLEST_ROOM_M2 and _is_outline(area)


def report_unused(drawing: Drawing, rooms: Sequence[Area], builder: ReportBuilder) -> None:
    """Warn about closed outlines beside the marked rooms that are not used, with their layers and share of the area."""
    union = shapely.union_all([room.shape for room in rooms])
    shapely.prepare(union)
    unused: dict[str, list[float]] = {}
    for area in drawing.areas:
        if (
            area.role is None
            and is_room_like(area)
            and union.disjoint(area.shape.buffer(-0.5 * DEFAULT_WALLS.thickest))
        ):
            unused.setdefault(area.layer or area.name or "(none)", []).append(area.shape.area)
    if unused:
        left_m2 = sum(map(sum, unused.values()))
        largest = sorted(unused.items(), key=lambda item: -sum(item[1]))[:_MAX_NAMED]
        named = ", ".join(f"{len(areas)} on '{name}' ({sum(areas):.1f} m²)" for name, areas in largest)
        builder.warnings.append(
            f"{sum(map(len, unused.values()))} closed outlines beside the rooms were not used, {left_m2:.1f} m² or "
            f"{100.0 * left_m2 / (left_m2 + union.area):.0f} % of the outlined area: {named}; if they are rooms, name "
            "their layers after rooms (ROOM)"
        )


def _without_containers(rooms: Sequence[Area], builder: ReportBuilder) -> list[Area]:
    """Drop duplicates and the outlines of flats and storeys around several rooms."""
    tree = shapely.STRtree([room.shape for room in rooms])
    kept = []
    for index, room in enumerate(rooms):
        inside = [k for k in tree.query(room.shape) if k != index and _covers(room.shape, rooms[k].shape)]
        same = [k for k in inside if _covers(rooms[k].shape, room.shape)]
        if any(k < index for k in same):
            continue
        smaller = [rooms[k].shape for k in inside if k not in same]
        if sum(shape.area for shape in smaller) > 0.5 * room.shape.area:
            builder.notes.append(f"an outline of {room.shape.area:.1f} m² around {len(smaller)} rooms was ignored")
            continue
        kept.append(room)
    return kept


def _covers(outer: shapely.Polygon, inner: shapely.Polygon) -> bool:
    return outer.area >= 0.98 * inner.area and shapely.intersection(outer, inner).area > 0.95 * inner.area


def _by_named_walls(drawing: Drawing, budget: Budget) -> Enclosed | None:
    """Return the areas that walls on layers named after walls enclose, None without such walls."""
    areas = [area for area in drawing.areas if area.role == "wall"]
    lines = [stroke.line for stroke in drawing.strokes if stroke.role == "wall"]
    if not areas and not lines:
        return None
    outlines = [ring for area in areas if _is_outline(area) for ring in _rings(area.shape)]
    bodies = [area.shape for area in areas if not _is_outline(area)]
    return enclose(bodies, split_lines([*lines, *outlines]), _closers(drawing), check_time=budget.check_time)


def _by_dark_areas(drawing: Drawing, budget: Budget) -> Enclosed | None:
    """Return the areas between dark areas and lines of a thick pen, without the parts that are painted over."""
    drawn = [(area.shape, area.order) for area in drawing.areas if area.is_dark and area.role is None]
    drawn = [(shape, order) for shape, order in drawn if not _is_stroke_of_letter(shape)]
    pens = [(stroke.line, stroke.width, stroke.order) for stroke in drawing.strokes if stroke.role is None]
    pens += [(area.shape.boundary, area.width, area.order) for area in drawing.areas if area.role is None]
    for line, width, order in pens:
        if _THICK_M[0] <= width <= _THICK_M[1]:
            body = line.buffer(0.5 * width, cap_style="square", join_style="mitre")
            drawn += [(part, order) for part in polygons_from_geometry(body)]
    painted = cut_painted(drawn, drawing.patches, budget.check_time)
    bodies = [shape for shape in painted.bodies if not _is_outline(Area(shape, "", is_dark=True))]
    if not bodies:
        return None
    gaps = [*painted.gaps, *_panes(drawing, shapely.unary_union(bodies), 2, budget)]
    closers = [*_closers(drawing), *(gap.shape.buffer(_SEAM_M, join_style="mitre") for gap in gaps)]
    found = enclose(bodies, [], closers, check_time=budget.check_time)
    return replace(found, gaps=[*gaps, *found.gaps])


def _by_all_lines(drawing: Drawing, budget: Budget) -> Enclosed | None:
    """Return the areas between all lines on layers without a role, None if there are none."""
    lines = [stroke.line for stroke in drawing.strokes if stroke.role in (None, "room")]
    lines += [ring for area in drawing.areas if area.role is None for ring in _rings(area.shape)]
    if not lines:
        return None
    found = enclose([], split_lines(lines), _closers(drawing), check_time=budget.check_time)
    # A wall has two lines, too.
    return replace(found, gaps=[*_panes(drawing, found.walls, 3, budget), *found.gaps])


def _panes(drawing: Drawing, walls: BaseGeometry, least: int, budget: Budget) -> list[Gap]:
    """Return the windows that thin lines on layers without a role draw; see `drawn_panes`."""
    lines = [stroke.line for stroke in drawing.strokes if stroke.role is None and stroke.width < _THICK_M[0]]
    lines += [area.shape.exterior for area in drawing.areas if area.role is None and not area.is_dark]
    found = drawn_panes(split_lines(lines), walls, least, budget.check_time)
    ends = [(area, shapely.get_coordinates(line)) for area, line in found]
    return [Gap(area, point_xy(a), point_xy(b), is_between_ends=True, is_pane=True) for area, (a, b) in ends]


def _rings(shape: shapely.Polygon) -> list[shapely.LinearRing]:
    return [shape.exterior, *shape.interiors]


def _is_outline(area: Area) -> bool:
    """Return whether a closed line runs along the faces of a room, and is not the body of a wall or pillar.

    Walls can be thicker at a chimney, but not in most of their area.
    """
    reach = 0.5 * DEFAULT_WALLS.thickest
    core = area.shape.buffer(-reach)
    if core.is_empty:
        return False
    largest = _PILLAR_M if area.is_dark else _OUTLINED_PILLAR_M
    return side_lengths(area.shape)[1] > largest and core.buffer(reach).area > _THICKER * area.shape.area


def _is_stroke_of_letter(shape: shapely.Polygon) -> bool:
    """Return whether a dark area is too small and thin for a wall or pillar, as letters that are drawn are."""
    return side_lengths(shape)[1] < _LETTER_M and shape.buffer(-0.5 * _LETTER_STROKE_M).is_empty


def split_lines(lines: Iterable[BaseGeometry]) -> list[shapely.LineString]:
    """Return the straight pieces of lines."""
    pieces = []
    for line in lines:
        points = shapely.get_coordinates(line)
        pieces += [shapely.LineString(pair) for pair in pairwise(points) if (pair[0] != pair[1]).any()]
    if len(pieces) > _MAX_SEGMENTS:
        raise InvalidFloorPlanError(
            f"{len(pieces)} lines could be walls; the limit is {_MAX_SEGMENTS}; set layers to the layers of the walls"
        )
    return pieces


def _closers(drawing: Drawing) -> list[BaseGeometry]:
    """Return doors and windows drawn as areas across their wall, or as lines in it."""
    areas = [area.shape for area in drawing.areas if area.role in ("door", "window", "passage")]
    panes = [stroke.line for stroke in drawing.strokes if stroke.role == "window"]
    hulls = [shapely.convex_hull(cluster) for cluster in clusters(panes, SYMBOL_M)]
    windows: list[BaseGeometry] = [hull if hull.area > 0.0 else hull.buffer(0.002, cap_style="flat") for hull in hulls]
    # Drawn from corner to corner of a wall that is cut, they can miss it by a rounding error.
    return [shape.buffer(_SEAM_M, join_style="mitre") for shape in (*areas, *windows) if side_lengths(shape)[0] < 0.7]


class GapFinder:
    """Gaps by their ends, to find those that leaves close."""

    def __init__(self, gaps: Sequence[Gap]) -> None:
        self.gaps = gaps
        self._ends = [pair for gap in gaps for pair in ((gap.start, gap.end), (gap.end, gap.start))]
        self._tree = shapely.STRtree([shapely.Point(near) for near, _ in self._ends])

    def closed_by(self, swing: Swing) -> int | None:
        """Return the index of the gap that a leaf closes, alone or as one of two leaves."""
        best: tuple[float, int] | None = None
        for end in sorted(self._tree.query(shapely.Point(swing.hinge), predicate="dwithin", distance=_HINGE_M)):
            (near, far), gap = self._ends[end], self.gaps[end // 2]
            distance = math.dist(swing.hinge, near)
            shares = [leaves * swing.radius / max(gap.width, 1e-6) for leaves in (1, 2)]
            fits = any(_LEAF_OF_GAP[0] <= share <= _LEAF_OF_GAP[1] for share in shares)
            tip_distance = min(math.dist(swing.first, far), math.dist(swing.last, far))
            if fits and tip_distance <= _OPEN_LEAF * gap.width and (best is None or distance < best[0]):
                best = (distance, int(end) // 2)
        return None if best is None else best[1]


def clusters(shapes: Sequence[BaseGeometry], reach_m: float) -> list[BaseGeometry]:
    """Group shapes that are near each other into one geometry each."""
    if not shapes:
        return []
    check_network(shapes)
    around = shapely.unary_union([shape.buffer(0.5 * reach_m, quad_segs=2) for shape in shapes])
    regions = list(shapely.get_parts(around))
    tree = shapely.STRtree(regions)
    members: dict[int, list[BaseGeometry]] = {}
    for shape in shapes:
        indices = tree.query(shape, predicate="intersects")
        if len(indices):
            members.setdefault(int(indices[0]), []).append(shape)
    return [shapely.GeometryCollection(group) for group in members.values()]


# Walls by which rooms are looked for, in words, in the order of trust.
_WALLS: Mapping[str, Callable[[Drawing, Budget], Enclosed | None]] = {
    "the walls": _by_named_walls,
    "the dark areas and thick lines": _by_dark_areas,
    "all lines": _by_all_lines,
}
