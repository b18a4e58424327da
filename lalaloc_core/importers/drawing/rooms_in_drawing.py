"""Readings of a drawing, which compete: rooms that the file marks, and rooms that walls of several kinds enclose.

Walls are what the layers name so, dark areas and thick lines, or all lines. The reading that explains most of the
drawing wins, and the report says by what. `room_bounds.py` has the bounds that decide.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce

import shapely
from shapely.geometry.base import BaseGeometry

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan.plan_words import Role
from lalaloc_core.floorplan.room_types import room_types_from_name
from lalaloc_core.importers.common import Budget, ReportBuilder
from lalaloc_core.importers.common.geometry import check_overlaps, clusters, polygons_of, side_lengths
from lalaloc_core.importers.common.room_bounds import ROOM_BOUNDS, RoomBounds
from lalaloc_core.importers.drawing.drawn_openings import cut_painted, drawn_panes
from lalaloc_core.importers.drawing.enclosed_rooms import Enclosed, Gap, enclose, explained_size
from lalaloc_core.importers.drawing.vector_drawing import Area, Drawing, Stroke, Swing, line_of, split_lines

_MAX_NAMED = 8
_NAMED = "the walls"


@dataclass(frozen=True, eq=False)
class Reading:
    """Rooms of a drawing by one kind of evidence, which `source` names in words.

    `walls` enclose the rooms; None for rooms that the file marks. `doors` is the number of gaps that leaves close, and
    `named` that of the rooms with a name that is a use.
    """

    source: str
    rooms: list[Area]
    gaps: list[Gap] = field(default_factory=list)
    walls: BaseGeometry | None = None
    doors: int = 0
    named: int = 0
    bounds: RoomBounds = ROOM_BOUNDS

    @property
    def area_m2(self) -> float:
        """Area of all rooms."""
        return float(sum(room.shape.area for room in self.rooms))

    @property
    def explained(self) -> float:
        """Measure of the drawing that the reading explains, see `explained_size`; names and doors add to it."""
        shapes = [room.shape for room in self.rooms]
        named = 1.0 + (self.bounds.named - 1.0) * self.named / max(len(shapes), 1)
        return named * explained_size(shapes) + self.bounds.door * self.doors

    def __str__(self) -> str:
        return (
            f"{self.source}: {len(self.rooms)} rooms, {self.area_m2:.1f} m², {self.doors} doors in gaps, "
            f"{self.named} rooms with a name"
        )


def choose_reading(
    drawing: Drawing, marked: list[Area], leaves: Sequence[Swing], builder: ReportBuilder, budget: Budget
) -> Reading:
    """Return the reading that explains most of a drawing in metres, and report the others.

    The drawing has no leaves of doors among its lines; `leaves` are these and the swings of doors. `marked` are the
    rooms that the file marks, see `marked_rooms`.
    """
    bounds = budget.limits.rooms
    readings = [Reading("the areas that the file marks as rooms", marked, bounds=bounds)] if marked else []
    # Rooms that layers mark by a word for rooms are complete, unless they are a small part of the drawing.
    is_by_word = any(area.role == "room" for area in marked)
    box_m2 = shapely.box(*shapely.total_bounds(drawing.shapes)).area if drawing.shapes else 0.0
    if not is_by_word or readings[0].area_m2 < bounds.complete * box_m2:
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
                rooms = [Area(shape, "", "room") for shape in found.rooms]
                named = f"the areas enclosed by {source}"
                readings.append(Reading(named, rooms, found.gaps, found.walls, bounds=bounds))
        if refused is not None and not any(reading.rooms for reading in readings):
            raise refused
    nothing = Reading("the areas enclosed by all lines", [], walls=shapely.Polygon(), bounds=bounds)
    readings = [_count_doors_and_names(reading, drawing, leaves) for reading in readings or [nothing]]
    best = reduce(lambda best, reading: reading if _is_better(reading, best) else best, readings)
    closed = f"; gaps up to {bounds.walls.widest_gap:g} m were closed" if best.walls is not None else ""
    builder.notes.append(f"rooms are {best.source}{closed}")
    rivals = [reading for reading in readings if reading is not best and reading.rooms]
    if rivals:
        builder.notes.append(f"chosen: {best}; other readings: {' | '.join(str(reading) for reading in rivals)}")
    return best


def _is_better(reading: Reading, best: Reading) -> bool:
    if not best.rooms:
        return bool(reading.rooms)
    # A plot around the named walls of a building is no room.
    named = shapely.union_all([room.shape for room in best.rooms]) if best.source.endswith(_NAMED) else None
    if named is not None and any(shapely.covers(room.shape, named) for room in reading.rooms):
        return False
    bounds = best.bounds
    trust = bounds.trust_in_marks if best.walls is None else 1.0
    ratio = reading.explained / max(best.explained, 1e-9) / trust
    larger = reading.area_m2 / max(best.area_m2, 1e-9)
    is_larger = ratio >= bounds.better and larger >= bounds.larger
    return is_larger or (ratio >= bounds.much_better and larger >= bounds.not_smaller)


def _count_doors_and_names(reading: Reading, drawing: Drawing, leaves: Sequence[Swing]) -> Reading:
    finder = GapFinder(reading.gaps, reading.bounds)
    closed = {index for leaf in leaves if (index := finder.closed_by(leaf)) is not None}
    names = [t.position for t in drawing.letterings if room_types_from_name(t.text)]
    named: set[int] = set()
    if names and reading.rooms:
        tree = shapely.STRtree([room.shape for room in reading.rooms])
        named = set(tree.query(shapely.points(names), predicate="within")[1].tolist())
    return replace(reading, doors=len(closed), named=len(named))


def marked_rooms(drawing: Drawing, builder: ReportBuilder, bounds: RoomBounds) -> list[Area]:
    """Return the closed outlines on layers named after rooms: by a word for rooms, or by the use of a room."""
    by_word = [area for area in drawing.areas if area.role == "room"]
    unnamed = [area for area in drawing.areas if area.role is None]
    by_use = [area for area in unnamed if _use(area) is not None and _is_room_like(area, bounds)]
    check_overlaps([area.shape for area in (*by_word, *by_use)], what="rooms")
    rooms = _without_containers([*by_word, *by_use], builder)
    # Furniture of a kitchen can lie on a layer of that name, inside the room.
    tree = shapely.STRtree([room.shape for room in rooms])
    kept = []
    for index, room in enumerate(rooms):
        near = [rooms[k] for k in tree.query(room.shape, predicate="intersects") if k != index]
        larger = [other for other in near if other.role == "room" or other.shape.area > room.shape.area]
        shared = sum(shapely.intersection(room.shape, other.shape).area for other in larger)
        if room.role == "room" or shared <= bounds.shared * room.shape.area:
            kept.append(room if room.kind else replace(room, kind=_use(room)))
    return kept


def _use(area: Area) -> str | None:
    """Return the words that name the use of a closed outline, None if nothing does."""
    return next((text for text in (area.kind, area.name, area.layer) if room_types_from_name(text)), None)


def _is_room_like(area: Area, bounds: RoomBounds) -> bool:
    """Return whether a closed outline is as large as a room, and no wall."""
    return area.shape.area >= bounds.smallest_room_m2 and _is_outline(area, bounds)


def report_unused(drawing: Drawing, rooms: Sequence[Area], builder: ReportBuilder, bounds: RoomBounds) -> None:
    """Warn about closed outlines beside the marked rooms that are not used, with their layers and share of the area."""
    union = shapely.union_all([room.shape for room in rooms])
    shapely.prepare(union)
    unused: dict[str, list[float]] = {}
    outlines = [area for area in drawing.areas if area.role is None and _is_room_like(area, bounds)]
    for area in outlines:
        if union.disjoint(area.shape.buffer(-0.5 * bounds.walls.thickest)):
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
    bounds = budget.limits.rooms
    thick = [part for part, _ in _drawn_thick(drawing, "wall", bounds)]
    areas = [area for area in drawing.areas if area.role == "wall" and not _is_thick(area, bounds)]
    lines = [stroke.line for stroke in drawing.strokes if stroke.role == "wall" and not _is_thick(stroke, bounds)]
    if not areas and not lines and not thick:
        return None
    outlines = [ring for area in areas if _is_outline(area, bounds) for ring in _rings(area.shape)]
    bodies = [*thick, *(area.shape for area in areas if not _is_outline(area, bounds))]
    return enclose(bodies, split_lines([*lines, *outlines]), _closers(drawing, bounds), bounds.walls, budget.check_time)


def _by_dark_areas(drawing: Drawing, budget: Budget) -> Enclosed | None:
    """Return the areas between dark areas and lines of a thick pen, without the parts that are painted over."""
    bounds = budget.limits.rooms
    dark = [area for area in drawing.areas if area.is_dark and area.role is None]
    drawn = [(area.shape, area.order) for area in dark if not _is_stroke_of_letter(area.shape, bounds)]
    drawn += _drawn_thick(drawing, None, bounds)
    visible, painted = cut_painted(drawn, drawing.patches, bounds.walls.thickest, budget.check_time)
    bodies = [shape for shape in visible if not _is_outline(Area(shape, "", is_dark=True), bounds)]
    if not bodies:
        return None
    gaps = [*painted, *_panes(drawing, shapely.unary_union(bodies), 2, budget)]
    painted_over = [gap.shape.buffer(bounds.seam_m, join_style="mitre") for gap in gaps]
    found = enclose(bodies, [], [*_closers(drawing, bounds), *painted_over], bounds.walls, budget.check_time)
    return replace(found, gaps=[*gaps, *found.gaps])


def _drawn_thick(drawing: Drawing, role: Role | None, bounds: RoomBounds) -> list[tuple[shapely.Polygon, int]]:
    """Return what lines of a thick pen cover, of one role, with their places in the order of painting."""
    drawn = [item for item in drawing.lines if item.role == role and _is_thick(item, bounds)]
    return [(part, item.order) for item in drawn for part in polygons_of(_covered(item, bounds))]


def _covered(item: Stroke | Area, bounds: RoomBounds) -> BaseGeometry:
    """Return what a line of a thick pen covers; the outline of a wall or pillar is its faces, whatever the pen."""
    if isinstance(item, Area) and not _is_outline(item, bounds):
        return item.shape
    return line_of(item).buffer(0.5 * item.width, cap_style="square", join_style="mitre")


def _is_thick(drawn: Stroke | Area, bounds: RoomBounds) -> bool:
    """Return whether the pen of a line is as wide as walls are thick."""
    return bounds.thick_m[0] <= drawn.width <= bounds.thick_m[1]


def _by_all_lines(drawing: Drawing, budget: Budget) -> Enclosed | None:
    """Return the areas between all lines on layers without a role, None if there are none."""
    lines = [stroke.line for stroke in drawing.strokes if stroke.role in (None, "room")]
    lines += [ring for area in drawing.areas if area.role is None for ring in _rings(area.shape)]
    if not lines:
        return None
    bounds = budget.limits.rooms
    found = enclose([], split_lines(lines), _closers(drawing, bounds), bounds.walls, budget.check_time)
    # A wall has two lines, too.
    return replace(found, gaps=[*_panes(drawing, found.walls, 3, budget), *found.gaps])


def _panes(drawing: Drawing, walls: BaseGeometry, least: int, budget: Budget) -> list[Gap]:
    """Return the windows that thin lines on layers without a role draw; see `drawn_panes`."""
    thick_m, _ = budget.limits.rooms.thick_m
    lines = [stroke.line for stroke in drawing.strokes if stroke.role is None and stroke.width < thick_m]
    lines += [area.shape.exterior for area in drawing.areas if area.role is None and not area.is_dark]
    return drawn_panes(split_lines(lines), walls, least, budget.check_time)


def _rings(shape: shapely.Polygon) -> list[shapely.LinearRing]:
    return [shape.exterior, *shape.interiors]


def _is_outline(area: Area, bounds: RoomBounds) -> bool:
    """Return whether a closed line runs along the faces of a room, and is not the body of a wall or pillar.

    Walls can be thicker at a chimney, but not in most of their area.
    """
    reach = 0.5 * bounds.walls.thickest
    core = area.shape.buffer(-reach)
    if core.is_empty:
        return False
    largest = bounds.pillar_m if area.is_dark else bounds.outlined_pillar_m
    return side_lengths(area.shape)[1] > largest and core.buffer(reach).area > bounds.thicker * area.shape.area


def _is_stroke_of_letter(shape: shapely.Polygon, bounds: RoomBounds) -> bool:
    """Return whether a dark area is too small and thin for a wall or pillar, as letters that are drawn are."""
    return side_lengths(shape)[1] < bounds.letter_m and shape.buffer(-0.5 * bounds.letter_stroke_m).is_empty


def _closers(drawing: Drawing, bounds: RoomBounds) -> list[BaseGeometry]:
    """Return doors and windows drawn as areas across their wall, or as lines in it."""
    areas = [area.shape for area in drawing.areas if area.role in ("door", "window", "passage")]
    panes = [stroke.line for stroke in drawing.strokes if stroke.role == "window"]
    hulls = [shapely.convex_hull(cluster) for cluster in clusters(panes, bounds.symbol_m)]
    windows: list[BaseGeometry] = [hull if hull.area > 0.0 else hull.buffer(0.002, cap_style="flat") for hull in hulls]
    # Drawn from corner to corner of a wall that is cut, they can miss it by a rounding error.
    found = [shape for shape in (*areas, *windows) if side_lengths(shape)[0] < 0.7]
    return [shape.buffer(bounds.seam_m, join_style="mitre") for shape in found]


class GapFinder:
    """Gaps by their ends, to find those that leaves close."""

    def __init__(self, gaps: Sequence[Gap], bounds: RoomBounds) -> None:
        self.gaps, self._bounds = gaps, bounds
        self._ends = [pair for gap in gaps for pair in ((gap.start, gap.end), (gap.end, gap.start))]
        self._tree = shapely.STRtree([shapely.Point(near) for near, _ in self._ends])

    def closed_by(self, swing: Swing) -> int | None:
        """Return the index of the gap that a leaf closes, alone or as one of two leaves."""
        found: list[tuple[float, int]] = []
        hinge_m, (narrow, wide) = self._bounds.hinge_m, self._bounds.leaf_of_gap
        for end in self._tree.query(shapely.Point(swing.hinge), predicate="dwithin", distance=hinge_m):
            (near, far), gap = self._ends[end], self.gaps[end // 2]
            shares = [leaves * swing.radius / max(gap.width, 1e-6) for leaves in (1, 2)]
            fits = any(narrow <= share <= wide for share in shares)
            tip_distance = min(math.dist(swing.first, far), math.dist(swing.last, far))
            if fits and tip_distance <= self._bounds.open_leaf * gap.width:
                found.append((math.dist(swing.hinge, near), int(end) // 2))
        return min(found)[1] if found else None


# Walls by which rooms are looked for, in words, in the order of trust.
_WALLS: Mapping[str, Callable[[Drawing, Budget], Enclosed | None]] = {
    _NAMED: _by_named_walls,
    "the dark areas and thick lines": _by_dark_areas,
    "all lines": _by_all_lines,
}
