"""Rooms and openings of a grey picture of known scale, with the guesses made."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import shapely

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.floorplan.opening_trust import reached_rooms
from lalaloc_core.importers.common import Budget, ReportBuilder
from lalaloc_core.importers.common.geometry import polygons_of
from lalaloc_core.importers.common.room_bounds import WallConfig
from lalaloc_core.importers.common.sketch import OpeningKind, Sketch, SketchedFixture, SketchedOpening, SketchedRoom
from lalaloc_core.importers.drawing.enclosed_rooms import Enclosed, Gap, enclose
from lalaloc_core.importers.drawing.sketch_drawing import is_between_rooms, split_named_rooms
from lalaloc_core.importers.drawing.vector_drawing import Lettering
from lalaloc_core.importers.picture.ink import FINEST_M, Gray, Ink, read_ink
from lalaloc_core.importers.picture.symbol_shapes import Shape, closed_shapes
from lalaloc_core.importers.picture.symbols import Symbol, find_symbols, fixtures_in, is_taken, without_symbols
from lalaloc_core.importers.picture.wall_mask import (
    WallMask,
    align_edges,
    dark_walls,
    outlined_walls,
    usual_thickness,
    wall_polygons,
)
from lalaloc_core.importers.picture.wall_symbols import GapContent, GapReader, windows_in_walls

# Windows are gaps in dark walls and wider than doors. A wide gap without a symbol is not an opening.
_CONFIG = WallConfig(widest_gap=6.0, narrowest_gap=0.4, thinnest=0.04, blunt=0.05, shallowest_room=0.4, widest_pier=1.2)
_WIDEST_WITH_ONE_LINE_M = 3.6
_MAX_BARE_GAP_M, _MAX_BARE_GAP_AT_A_FACE_M = 1.9, 1.1
# Thickness of the ends of walls beside a gap: least share of thin walls, and largest share of the usual beside an empty
# one; other ends are of furniture. Share of the walls that thin ones have, and of a symbol that is drawn in part.
_LIKE_WALL, _THIN, _WEAK = (0.6, 1.5), 0.08, 0.8
_MIN_ROOM_M2 = 0.5
_MAX_ISLAND_M2 = 2.0
# Smallest area (m²) and largest length (m) of a terrace, and its distance (m) from the rooms and from its name.
_TERRACE, _AT_TERRACE_M = (1.5, 20.0), 1.0
# Dark walls are more reliable: outlined walls are preferred only if they enclose this much more area, or all rooms of
# the dark walls and more.
_OUTLINE_ADVANTAGE = 1.6
# Smallest intersection over union of the same room in two readings.
_SAME_ROOM = 0.9
_SURE = 0.85
# Share of drawn openings that are found and classified (benchmarks.plans).
_RECALL = 0.95
# Gaps of twice this width are closed to find the drawn area; parts of it thinner than the walls and the clearance (m)
# are no rooms. A smaller share covered by rooms gives a warning, with its largest parts.
_CLOSING_M, _CLEARANCE_M, _COVERED, _MAX_NAMED = 1.5, 0.2, 0.9, 5
_COARSE_M = 0.03
_MAX_WALL_THICKNESS_M, _THICK_M = 1.2, 0.6
# Wider openings in inner walls are glass. Rooms beside a wall are searched at this distance from it. Least width of the
# gate of a garage, and width of windows relative to a clearly wider one.
_WIDEST_DOOR_M, _BESIDE_M, _GATE_M, _NARROWER = 1.3, 0.25, 2.0, 0.8
# Least number of doors that are drawn without a swing, least share of other openings that have more lines, and share of
# a line that is drawn: dashes in an inner wall are a beam.
_DOORS_ALIKE, _UNLIKE, _DASHED = 3, 0.5, 0.7
# Smallest shape (m²) inside a room that is counted if it is not used.
_COUNTED_M2 = 0.05
# Usual width of lines (pixels).
_PEN_PX = 2.0
# Smallest warmth of coloured lines (of 255): glass is blue, wood is brown.
_COLOURED = 25.0


@dataclass(frozen=True, eq=False)
class _Reading:
    """Rooms and gaps under one assumption about how walls are drawn."""

    walls: WallMask
    enclosed: Enclosed
    contents: dict[int, GapContent]
    is_dark: bool

    @property
    def area_m2(self) -> float:
        return float(sum(room.area for room in self.enclosed.rooms))

    def extends(self, smaller: _Reading) -> bool:
        """Return whether this reading has all rooms of another one and more."""
        if self.area_m2 < smaller.area_m2 + _MIN_ROOM_M2 or not smaller.enclosed.rooms:
            return False
        known, found = np.array(smaller.enclosed.rooms), np.array(self.enclosed.rooms)
        a, b = shapely.STRtree(found).query(known, predicate="intersects")
        shared = shapely.area(shapely.intersection(known[a], found[b]))
        is_same = shared >= _SAME_ROOM * (shapely.area(known[a]) + shapely.area(found[b]) - shared)
        return len(np.unique(a[is_same])) == len(known)

    def divided(self, letterings: Sequence[Lettering], budget: Budget) -> _Reading:
        """Return the reading with rooms that have several names divided at passages wider than a door."""
        found = self.enclosed
        rooms, wide = split_named_rooms(found.rooms, found.walls, found.gaps, letterings, budget.check_time)
        contents = self.contents | {id(gap): GapContent("nothing", 1.0) for gap in wide}
        return replace(self, enclosed=Enclosed(rooms, [*found.gaps, *wide], found.walls), contents=contents)


def sketch_picture(
    gray: Gray,
    metres_per_pixel: float,
    builder: ReportBuilder,
    budget: Budget,
    warmth: Gray | None = None,
    *,
    straighten: bool = True,
    has_symbols: bool = True,
    letterings: Sequence[Lettering] = (),
) -> Sketch:
    """Find the rooms that walls enclose, and classify gaps in walls by their content.

    Walls are read twice, as dark thick areas and as pairs of lines; the reading that encloses more area is used.
    Rows of `gray` are from the top, and 255 is white; `warmth` is 128 without colour, higher towards red, lower towards
    blue. Without `straighten`, the coordinates are those of the picture even if its lines are skew; without
    `has_symbols`, fixtures are not looked for. `letterings` are texts in plan metres: rooms with several names are
    divided at wide passages.
    """
    budget.begin("straightening the picture")
    ink = read_ink(gray, metres_per_pixel, warmth, straighten=straighten)
    shapes, symbols = list[Shape](), list[Symbol]()
    if has_symbols:
        shapes = closed_shapes(ink)
        symbols = find_symbols(shapes, closed_shapes(ink, is_faint=True), budget.check_time)
    readings: list[_Reading] = []
    # Walls that cannot be read without the symbols are read with them.
    for part in (without_symbols(ink, symbols), ink) if symbols else (ink,):
        hypotheses = (dark_walls(part), True), (outlined_walls(part), False)
        readings = [_read(walls, part, is_dark, budget) for walls, is_dark in hypotheses if walls is not None]
        if any(reading.area_m2 > 0.0 for reading in readings):
            ink = part
            break
    if not readings:
        builder.use("ink", "ignored (no possible walls)", 1)
        return Sketch()
    best = readings[0]
    for reading in readings[1:]:
        if reading.area_m2 > _OUTLINE_ADVANTAGE * best.area_m2 or reading.extends(best):
            best = reading
    builder.use("ink", "walls", len(shapely.get_parts(best.enclosed.walls)))
    if best.walls.thickness_m > _MAX_WALL_THICKNESS_M:
        raise InvalidFloorPlanError(
            f"the walls are {best.walls.thickness_m:.2f} m thick at {metres_per_pixel:g} m per pixel; the limit is "
            f"{_MAX_WALL_THICKNESS_M:g} m; check the scale (metres_per_pixel, known_distance or scale)"
        )
    best = best.divided(letterings, budget)
    _report(best, ink, metres_per_pixel, builder)
    _report_coverage(best, builder)
    if budget.trace is not None:
        budget.trace.add("wall", [best.enclosed.walls])
        budget.trace.add("gap", [gap.shape for gap in best.enclosed.gaps])
        budget.trace.add("room", best.enclosed.rooms)
        budget.trace.add("no room", builder.no_room)
    budget.begin("finding doors and windows")
    rooms = [SketchedRoom(align_edges(_without_islands(room, builder))) for room in best.enclosed.rooms]
    terraces = _terraces(best, ink, letterings)
    rooms += [SketchedRoom(align_edges(area)) for area in terraces]
    outside = shapely.unary_union([room.buffer(0.05) for room in best.enclosed.rooms])
    # A gap away from all rooms lies between other strokes.
    gaps = [gap for gap in best.enclosed.gaps if outside.intersects(gap.shape)]
    garages = [shapely.Point(text.position) for text in letterings if "garage" in text.room_types]
    openings = _openings(best, gaps, terraces, garages, ink, builder, budget)
    fixtures = _fixtures(symbols, shapes, best, builder) if has_symbols else []
    # Faces of walls are the middles of their lines.
    pen_m = 0.0 if best.is_dark else _PEN_PX * ink.metres_per_pixel
    return Sketch(
        rooms=rooms,
        openings=openings,
        fixtures=fixtures,
        recall=_RECALL,
        drawn=best.enclosed.walls.envelope,
        walls=best.enclosed.walls,
        leaves_m=[leaf_m + pen_m for gap in gaps if (leaf_m := best.contents[id(gap)].leaf_m) > 0.0],
        wall_m=best.walls.thickness_m,
    )


def _read(walls: WallMask, ink: Ink, is_dark: bool, budget: Budget) -> _Reading:
    budget.begin(f"finding rooms between {'dark walls' if is_dark else 'outlined walls'}")
    reader = GapReader(ink, walls)
    contents: dict[int, GapContent] = {}
    thin_m = usual_thickness(walls.mask.astype(np.uint8), _THIN) * ink.metres_per_pixel

    def rank(gap: Gap) -> int | None:
        contents[id(gap)] = found = reader.classify(gap)
        widest = _MAX_BARE_GAP_M if gap.is_between_ends else _MAX_BARE_GAP_AT_A_FACE_M
        is_bare = found.kind in ("leaf", "nothing") or (found.kind == "line" and not gap.is_between_ends)
        depth_m = gap.shape.area / gap.width
        is_sure = gap.is_sure and depth_m >= _LIKE_WALL[0] * thin_m
        is_passage = is_sure and gap.width <= widest and depth_m <= _LIKE_WALL[1] * walls.thickness_m
        if (is_bare and not is_passage) or (found.confidence <= _WEAK and not is_sure):
            return None
        if found.kind != "pane" and gap.width > _WIDEST_WITH_ONE_LINE_M:
            return None
        # Gaps overlap both walls by 2 cm, so that narrow ones seem deeper by up to a tenth.
        if depth_m > 1.1 * _CONFIG.thickest and (found.kind != "pane" or gap.width <= _MAX_BARE_GAP_M):
            return None
        return ("swing", "pane", "line", "leaf", "nothing").index(found.kind)

    enclosed = enclose(wall_polygons(walls, ink, budget.check_time), [], (), _CONFIG, budget.check_time, rank)
    rooms = [room for room in enclosed.rooms if room.area >= _MIN_ROOM_M2]
    return _Reading(walls, Enclosed(rooms, enclosed.gaps, enclosed.walls), contents, is_dark)


def _terraces(reading: _Reading, ink: Ink, letterings: Sequence[Lettering]) -> list[shapely.Polygon]:
    """Return the areas beside the rooms that thin lines enclose and the name of a balcony or terrace is written at."""
    rooms = shapely.union_all(reading.enclosed.rooms)
    places = [shapely.Point(text.position) for text in letterings if "balcony" in text.room_types]
    names = [place for place in places if not rooms.covers(place)]
    if not names or rooms.is_empty:
        return []
    blocked = ink.mask.astype(np.uint8)
    rings = [ink.to_pixels(np.asarray(gap.shape.exterior.coords)) - 0.5 for gap in reading.enclosed.gaps]
    cv2.fillPoly(blocked, [np.round(ring).astype(np.int32) for ring in rings], 1)
    inside = rooms.buffer(-_BESIDE_M)
    outlines = [shape.outline for shape in closed_shapes(replace(ink, mask=blocked > 0), _TERRACE)]
    beside = [each for each in outlines if each.dwithin(rooms, _AT_TERRACE_M) and not each.intersects(inside)]
    _, nearest = shapely.STRtree(beside).query_nearest(names, max_distance=_AT_TERRACE_M, all_matches=False)
    return [beside[index] for index in np.unique(nearest)]


def _without_islands(room: shapely.Polygon, builder: ReportBuilder) -> shapely.Polygon:
    """Fill small holes: letters and furniture look like walls. Columns are lost with them."""
    large = [ring for ring in room.interiors if shapely.Polygon(ring).area > _MAX_ISLAND_M2]
    if small := len(room.interiors) - len(large):
        builder.unsure.append(f"{small} dark shapes inside a room are taken for furniture, not for columns")
    return shapely.Polygon(room.exterior, large)


def _fixtures(
    symbols: Sequence[Symbol], shapes: Sequence[Shape], reading: _Reading, builder: ReportBuilder
) -> list[SketchedFixture]:
    """Return the fixtures that clear symbols show; report them as guesses, and the number of other shapes in rooms."""
    rooms = reading.enclosed.rooms
    found = fixtures_in(symbols, rooms)
    if found:
        counts = Counter(fixture.kind for fixture in found)
        named = ", ".join(f"{count} x {kind}" for kind, count in sorted(counts.items()))
        builder.unsure.append(f"fixtures are taken from their symbols: {named}; check them")
    taken = shapely.union_all([reading.enclosed.walls, *(gap.shape.buffer(0.1) for gap in reading.enclosed.gaps)])
    large = [shape for shape in shapes if shape.area >= _COUNTED_M2 and not is_taken(shape.outline, found)]
    inner = shapely.STRtree([room.buffer(-0.05) for room in rooms])
    unused = [
        shape
        for shape in large
        if len(inner.query(shape.outline.representative_point(), predicate="within"))
        and not shape.outline.intersects(taken)
        and not any(other.holds(shape) for other in large)
    ]
    if unused:
        builder.notes.append(f"{len(unused)} drawn shapes in rooms are no clear symbols of fixtures and were not used")
    return found


def _openings(
    reading: _Reading,
    gaps: Sequence[Gap],
    terraces: Sequence[shapely.Polygon],
    garages: Sequence[shapely.Point],
    ink: Ink,
    builder: ReportBuilder,
    budget: Budget,
) -> list[SketchedOpening]:
    """Return the openings: gaps by their content and the areas beside them, and windows drawn into walls."""
    candidates = [(gap.start, gap.end, reading.contents[id(gap)]) for gap in gaps]
    if not reading.is_dark:
        panes = windows_in_walls(reading.walls, ink, budget.check_time)
        candidates += [(pane.start, pane.end, GapContent("pane", 1.0)) for pane in panes]
    rooms, reach_m = shapely.STRtree(reading.enclosed.rooms), 0.5 * reading.walls.thickness_m + _BESIDE_M
    placed = [
        (content, math.dist(start, end), is_between_rooms(start, end, reach_m, rooms))
        for start, end, content in candidates
    ]
    # Leaves that open onto a terrace are cut out of it.
    around = [terrace.convex_hull.difference(shapely.union_all(rooms.geometries)) for terrace in terraces]
    areas = [*reading.enclosed.rooms, *around]
    found, beside, lines_of_doors = list[SketchedOpening](), list[list[int]](), _lines_of_doors(placed)
    for (start, end, _), (content, width, is_inner) in zip(candidates, placed, strict=True):
        budget.check_time()
        kind = _kind(content, width, lines_of_doors, is_inner=is_inner)
        own = reached_rooms(areas, [shapely.LineString([start, end])])
        if is_inner and len(own) < 2 and content.kind in ("leaf", "nothing"):
            continue  # Between a wall and furniture.
        found.append(SketchedOpening(kind, start, end))
        beside.append(own)
        if (doubt := _doubt(content, kind)) is not None:
            position = f"({start[0]:.2f}, {start[1]:.2f})"
            builder.unsure.append(f"a gap of {width:.2f} m at {position} is taken for a {kind}: {doubt}")
            builder.places[builder.unsure[-1]] = shapely.Point(start)
    widths = [opening.line.length for opening in found]
    for number, area in enumerate(areas):
        # Sliding doors of closets and terraces, and gates of garages, are drawn like windows.
        least_m = _GATE_M if any(map(area.covers, garages)) else 0.0
        wide = [k for k, own in enumerate(beside) if number in own and widths[k] >= least_m]
        panes = sorted((k for k in wide if least_m or len(beside[k]) > 1), key=lambda k: widths[k])
        is_clear = len(panes) == 1 or (len(panes) > 1 and widths[panes[-2]] <= _NARROWER * widths[panes[-1]])
        if is_clear and all(found[k].kind == "window" for k in wide):
            gate = found[panes[-1]] = replace(found[panes[-1]], kind="door")
            x, y = gate.start
            builder.unsure.append(f"a window at ({x:.2f}, {y:.2f}) is taken for a door, as no other leads there")
            builder.places[builder.unsure[-1]] = shapely.Point(x, y)
    return found


def _lines_of_doors(placed: Sequence[tuple[GapContent, float, bool]]) -> float:
    """Return the lines of doors without a swing, by openings with width (m) and place; 0 if windows have no more."""
    panes = [(opening.lines, is_inner and m <= _WIDEST_DOOR_M) for opening, m, is_inner in placed if opening.lines > 1]
    doors = [lines for lines, is_door in panes if is_door]
    usual = float(np.median(doors or [0]))
    have_more = [lines > usual for lines, is_door in panes if not is_door]
    least = max(_DOORS_ALIKE, sum(opening.kind == "swing" for opening, *_ in placed))
    return usual if len(doors) >= least and np.mean(have_more or [False]) >= _UNLIKE else 0.0


def _kind(content: GapContent, width: float, lines_of_doors: float, *, is_inner: bool) -> OpeningKind:
    """Classify an opening. Lines in an inner wall are a door without a swing, in an outer wall a window."""
    if content.kind in ("swing", "leaf"):
        return "door"
    if content.kind == "nothing":
        return "passage"
    if abs(content.warmth) >= _COLOURED:
        return "door" if content.warmth > 0.0 else "window"
    if is_inner and (content.kind == "line" or content.confidence < _DASHED):
        return "passage"
    if content.kind == "pane" and 0 < content.lines <= lines_of_doors:
        return "door"
    return "door" if is_inner and width <= _WIDEST_DOOR_M else "window"


def _doubt(content: GapContent, kind: OpeningKind) -> str | None:
    """Return the reason for doubt about the kind of an opening, None without doubt."""
    if content.kind == "nothing":
        return "nothing is drawn in it"
    if content.kind == "line":
        return "a single line is drawn in it"
    if content.kind == "pane" and kind == "door":
        return "it is drawn like a window, but " + ("brown" if content.warmth >= _COLOURED else "as doors inside are")
    return f"{content.confidence:.0%} of its symbol is drawn" if content.confidence < _SURE else None


def _report_coverage(reading: _Reading, builder: ReportBuilder) -> None:
    """Report the share of the drawn area that became rooms, and the parts that did not."""
    walls = shapely.union_all([reading.enclosed.walls, *(gap.shape for gap in reading.enclosed.gaps)])
    closed = walls.buffer(_CLOSING_M, join_style="mitre")
    drawn = shapely.union_all([shapely.Polygon(part.exterior) for part in polygons_of(closed)])
    inside = drawn.buffer(-_CLOSING_M, join_style="mitre").difference(walls)
    rooms = shapely.union_all(reading.enclosed.rooms)
    half_m = 0.5 * reading.walls.thickness_m + _CLEARANCE_M
    missing = polygons_of(inside.difference(rooms).buffer(-half_m).buffer(half_m))
    lost = sorted((part for part in missing if part.area >= _MIN_ROOM_M2), key=lambda part: -part.area)
    if inside.area <= 0.0:
        return
    builder.no_room += lost
    share = 1.0 - sum(part.area for part in lost) / inside.area
    builder.notes.append(f"rooms cover {share:.0%} of the area inside the drawn walls")
    if share < _COVERED:
        middles = (part.representative_point() for part in lost[:_MAX_NAMED])
        places = ", ".join(
            f"{part.area:.0f} m² at ({p.x:.1f}, {p.y:.1f})" for part, p in zip(lost, middles, strict=False)
        )
        builder.warnings.append(
            f"rooms cover only {share:.0%} of the area inside the drawn walls; without a room are {places}; draw these "
            "rooms, or send a larger picture whose walls are closed"
        )


def _report(reading: _Reading, ink: Ink, metres_per_pixel: float, builder: ReportBuilder) -> None:
    style = "dark and thick" if reading.is_dark else "drawn with two lines"
    builder.notes.append(f"walls are {style}, usually {reading.walls.thickness_m:.2f} m thick")
    if reading.walls.thickness_m > _THICK_M:
        builder.warnings.append(
            f"walls of {reading.walls.thickness_m:.2f} m are thicker than usual ({_THICK_M:g} m): check the scale; if "
            "dark or coloured floors were taken for walls, save the picture with white floors"
        )
    if ink.skew_deg:
        builder.turned_deg = -ink.skew_deg
        builder.notes.append(f"the picture was turned by {ink.skew_deg:.2f}° to straighten it")
    if ink.metres_per_pixel > max(metres_per_pixel, FINEST_M) * 1.001:
        builder.notes.append(
            f"the picture is large and was read at {100 * ink.metres_per_pixel:.2g} cm per pixel; crop it to one storey"
        )
    if metres_per_pixel > _COARSE_M:
        builder.unsure.append(
            f"a pixel is {100 * metres_per_pixel:.1f} cm; above {100 * _COARSE_M:g} cm walls are too thin; "
            "use a larger picture"
        )
