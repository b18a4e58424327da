"""Conversion of a drawing to rooms and openings.

`rooms_in_drawing.py` finds the rooms; here they get names, and doors and windows their places. Rooms joined by a
passage without a symbol that is wider than a door are divided where their names tell them apart.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from lalaloc_core.floorplan.plan_words import Role
from lalaloc_core.floorplan.room_types import room_types_from_name
from lalaloc_core.importers.common.geometry import clusters, opening_line, polygons_of, side_lengths
from lalaloc_core.importers.common.import_limits import Budget, CheckTime
from lalaloc_core.importers.common.import_report import ReportBuilder, Trace, TracePart
from lalaloc_core.importers.common.plausibility import check_leaves
from lalaloc_core.importers.common.room_bounds import ROOM_BOUNDS
from lalaloc_core.importers.common.sketch import OpeningKind, Point, Sketch, SketchedOpening, SketchedRoom
from lalaloc_core.importers.drawing.door_leaves import LEAF_M, drawn_leaves, take_leaves, with_swings, without_leaves
from lalaloc_core.importers.drawing.drawing_scale import check_areas, texts_of_rooms, without_sizes, written_dimensions
from lalaloc_core.importers.drawing.enclosed_rooms import Gap, find_gaps
from lalaloc_core.importers.drawing.rooms_in_drawing import GapFinder, choose_reading, marked_rooms, report_unused
from lalaloc_core.importers.drawing.scale_guess import Measures, ScaleGuess, first_scale, guess_scale
from lalaloc_core.importers.drawing.vector_drawing import Area, Drawing, Lettering, Swing, split_lines, without_frames

# Letters of a line of prose, and the least number of such lines on a page of text.
_LINE_LETTERS, _MIN_LINES_OF_TEXT = 25, 8
# Names in a room besides its own that are listed.
_MAX_OTHERS = 5
_OPENING_M = (0.3, 8.0)
# Distance from a wall at which a place is in the room beside it (m).
_BESIDE_M = 0.15
# Lines of walls nearer to a room's outline are its own walls.
_OFF_WALL_M = 0.03
# Parts of a trace by the roles of lines.
_TRACED: Mapping[Role | None, TracePart] = {None: "line", "wall": "wall line", "room": "line", "door": "door",
                                            "window": "window", "passage": "passage", "obstacle": "other",
                                            "ignored": "other", "text": "other"}  # fmt: skip
# Widest passage (m) between rooms with names of their own, and smallest room (m²) that it divides off.
_WIDEST_M, _SMALLEST_M2 = 5.0, 1.5
# Gaps of a room that are tried, the narrowest first.
_MOST_GAPS = 12


def split_named_rooms(
    rooms: Sequence[shapely.Polygon],
    walls: BaseGeometry,
    closed: Sequence[Gap],
    letterings: Sequence[Lettering],
    check_time: CheckTime,
) -> tuple[list[shapely.Polygon], list[Gap]]:
    """Divide rooms with several names of rooms at gaps between ends of walls that leave a name on both sides.

    Returns the rooms in the order given, parts beside each other, and the gaps that divide them. `closed` are gaps that
    are closed already; `check_time` is called between steps and raises an exception to stop.
    """
    places = [shapely.Point(text.position) for text in letterings if text.room_types]
    names = shapely.STRtree(places)
    if all(len(names.query(room, predicate="contains")) < 2 for room in rooms):
        return list(rooms), []
    around = shapely.union_all([walls, *(gap.shape for gap in closed)])
    gaps = find_gaps(around, replace(ROOM_BOUNDS.walls, widest_gap=_WIDEST_M), check_time)
    parts: list[shapely.Polygon] = []
    dividing: list[Gap] = []
    for room in rooms:
        near = sorted((gap for gap in gaps if gap.shape.intersects(room)), key=lambda gap: gap.width)[:_MOST_GAPS]
        pieces = [room]
        # Each division can leave a passage as the only one between two of the pieces.
        while (found := _division(pieces, near, names, check_time)) is not None:
            index, sides, group = found
            pieces[index : index + 1] = sides
            dividing += group
            near = [gap for gap in near if gap not in group]
        parts += pieces
    return parts, dividing


def _division(
    pieces: Sequence[shapely.Polygon], gaps: Sequence[Gap], names: shapely.STRtree, check_time: CheckTime
) -> tuple[int, list[shapely.Polygon], tuple[Gap, ...]] | None:
    """Return the number of a piece with its two sides and the gaps between them; None if no gaps divide names."""
    # One passage, or two beside a wall that stands free.
    for group in (*combinations(gaps, 1), *combinations(gaps, 2)):
        check_time()
        cut = shapely.union_all([gap.shape for gap in group])
        for index, piece in enumerate(pieces):
            sides = polygons_of(piece.difference(cut))
            named = [side for side in sides if len(names.query(side, predicate="contains"))]
            if len(named) == len(sides) == 2 and all(side.area >= _SMALLEST_M2 for side in sides):
                return index, sides, group
    return None


def text_hints(letterings: Sequence[Lettering], subject: str) -> list[str]:
    """Return what errors say of a page of text, most of whose texts are lines of prose; empty for another one."""
    prose = sum(len(lettering.text) >= _LINE_LETTERS for lettering in letterings)
    if prose < max(_MIN_LINES_OF_TEXT, 0.5 * len(letterings)):
        return []
    return [f"{subject} is a page of text with {prose} lines, not a floor plan; send the page with the plan"]


def sketch_drawing(drawing: Drawing, builder: ReportBuilder, budget: Budget) -> Sketch:
    """Find the rooms and openings of a drawing in metres, y up."""
    sketch = Sketch(fixtures=drawing.fixtures)
    if hidden := len(drawing.strokes) - len(drawing.on_paper().strokes):
        builder.notes.append(f"{hidden} white lines were left out: they cannot be seen on paper")
    drawing, frames = without_frames(drawing.on_paper(), budget.check_time)
    for frame in frames:
        short, long = side_lengths(frame)
        builder.unsure.append(
            f"a rectangle of {long:.1f} m x {short:.1f} m is taken for the sheet's frame, and was left out with the "
            "lines beside it; if it is a wall, set crop to the walls"
        )
    drawing, plot = drawing.without_plot()
    if plot is not None:
        builder.unsure.append(
            f"an outline of {plot.area:.0f} m² around all walls, of one line, is taken for the plot and was left out; "
            "if it is a wall, draw both of its faces, or write the name of its room beside it"
        )
    drawing = with_swings(drawing)
    _trace_drawing(drawing, budget.trace)
    sketch.obstacles = [area.shape for area in drawing.areas if area.role == "obstacle"]
    budget.begin("finding doors and walls")
    bounds = budget.limits.rooms
    marked = marked_rooms(drawing, builder, bounds)
    lines = [stroke for stroke in drawing.strokes if stroke.role in (None, "wall")]
    walls, leaves = take_leaves(lines, drawing.swings, drawing.areas)
    others = [stroke for stroke in drawing.strokes if stroke.role not in (None, "wall")]
    areas = without_leaves(drawing.areas, [*drawing.swings, *leaves])
    without = replace(drawing, strokes=[*walls, *others], areas=areas)
    reading = choose_reading(without, marked, [*drawing.swings, *leaves], builder, budget)
    gaps, shapes = reading.gaps, reading.rooms
    if reading.walls is None:
        sketch.inner_walls = _free_standing(drawing, shapes)
        leaves = []
        report_unused(drawing, shapes, builder, bounds)
    else:
        drawing = without
        sketch.drawn, sketch.walls = reading.walls.envelope, reading.walls
        outlines = [room.shape for room in shapes]
        parts, wide = split_named_rooms(outlines, reading.walls, gaps, drawing.letterings, budget.check_time)
        if wide:
            shapes, gaps = [Area(part, "", "room") for part in parts], [*gaps, *wide]
        if leaves:
            builder.notes.append(f"{len(leaves)} leaves of doors and their arcs are not walls")
        if budget.trace is not None:
            budget.trace.add("wall", [reading.walls])
            budget.trace.add("gap", [gap.shape for gap in gaps])
    budget.begin("placing names and openings")
    sketch.rooms = name_rooms(shapes, drawing.letterings, builder, sketch.drawn)
    for room in (room for room in sketch.rooms if room.name is None and len(sketch.rooms) > 1):
        if all(shapely.covers(shapely.Polygon(room.shape.exterior), [other.shape for other in sketch.rooms])):
            builder.warnings.append(
                f"a room of {room.shape.area:.0f} m² without a name lies around all others; if it is the plot, set "
                "layers or crop to the walls"
            )
    if budget.trace is not None:
        budget.trace.add("room", [room.shape for room in sketch.rooms])
    # A leaf shows a door only where it closes a gap; a slanted line elsewhere is not along a wall.
    finder = GapFinder(gaps, bounds)
    closing = [swing for swing in (*leaves, *drawn_leaves(drawing)) if finder.closed_by(swing) is not None]
    swings = [swing for swing in (*drawing.swings, *closing) if LEAF_M[0] <= swing.radius <= LEAF_M[1]]
    sketch.openings = [*_symbols(drawing, closing, bounds.symbol_m), *_swings(swings, finder, shapes)]
    # Widths of leaves that close a gap, one for every gap; of all leaves without gaps.
    leaf_m = {index: swing.radius for swing in swings if (index := finder.closed_by(swing)) is not None}
    sketch.leaves_m = list(leaf_m.values()) or [swing.radius for swing in swings]
    drawn_m = [swing.radius for swing in (*drawing.swings, *leaves)]
    is_sure = any(finder.closed_by(swing) is not None for swing in drawing.swings)
    builder.warnings += check_leaves(drawn_m, builder.metres_per_unit, 1 if is_sure else 2)
    sketch.wall_m = float(np.median([side_lengths(gap.shape)[0] for gap in gaps])) if gaps else 0.0
    taken = shapely.STRtree([opening.line.buffer(0.3) for opening in sketch.openings])
    rooms = shapely.STRtree([room.shape for room in shapes])
    for gap in gaps:
        budget.check_time()
        line = shapely.LineString([gap.start, gap.end])
        near = shapely.union_all(taken.geometries[taken.query(line, predicate="intersects")])
        if shapely.intersection(line, near).length < 0.3 * line.length:
            kind = _kind_without_symbol(gap, rooms) if gap.is_painted or gap.is_pane else "passage"
            sketch.openings.append(SketchedOpening(kind, gap.start, gap.end))
            if gap.is_pane and kind == "window":
                continue
            builder.unsure.append(
                f"the gap of {gap.width:.2f} m at ({gap.start[0]:.2f}, {gap.start[1]:.2f}) has no symbol of a door or "
                f"window; it is taken for a {kind}"
            )
            builder.places[builder.unsure[-1]] = line
    budget.check_time()
    return sketch


def guess_drawing(drawing: Drawing, budget: Budget, *, flip_y: bool) -> ScaleGuess | None:
    """Return the scale of a vector drawing by the usual sizes of its parts, None if they are too few."""
    if not drawing.shapes:
        return None
    dimensions = written_dimensions(drawing, budget.check_time)

    def measure(scale: float) -> Measures:
        scaled = drawing.scaled(scale, flip_y=flip_y)
        sketch = sketch_drawing(scaled, ReportBuilder(), budget)
        return Measures.of(sketch, scale, scaled.letterings, drawing, dimensions)

    start = first_scale(drawing.extent, [swing.radius for swing in drawing.swings])
    return guess_scale(measure, start, budget)


def _kind_without_symbol(gap: Gap, rooms: shapely.STRtree) -> OpeningKind:
    """Return the kind of an opening that is painted over a wall: a window if it is blue or leads outside."""
    if gap.is_bluish:
        return "window"
    reach_m = 0.5 * side_lengths(gap.shape)[0] + _BESIDE_M
    return "passage" if is_between_rooms(gap.start, gap.end, reach_m, rooms) else "window"


def is_between_rooms(start: Point, end: Point, reach_m: float, rooms: shapely.STRtree) -> bool:
    """Return whether a room lies at this distance to both sides of an opening; it can be the same room."""
    a, b = np.array(start), np.array(end)
    along = (b - a) / max(math.dist(start, end), 1e-9)
    step = reach_m * np.array([-along[1], along[0]])
    places = [shapely.Point(0.5 * (a + b) + side * step) for side in (1.0, -1.0)]
    return all(len(rooms.query(place, predicate="within")) for place in places)


def _trace_drawing(drawing: Drawing, trace: Trace | None) -> None:
    """Add the lines of a drawing to a trace, by their roles."""
    if trace is None:
        return
    for role, part in _TRACED.items():
        trace.add(part, [stroke.line for stroke in drawing.strokes if stroke.role == role])
        trace.add(part, [area.shape.boundary for area in drawing.areas if area.role == role])
    swings = [np.array([swing.first, swing.hinge, swing.last]) for swing in drawing.swings]
    trace.add("door", [shapely.LineString(points) for points in swings])


def _free_standing(drawing: Drawing, rooms: Sequence[Area]) -> list[shapely.LineString]:
    """Return the lines of walls inside a room, away from its own walls."""
    inner = [room.shape.buffer(-_OFF_WALL_M) for room in rooms]
    tree = shapely.STRtree(inner)
    pieces = split_lines(stroke.line for stroke in drawing.strokes if stroke.role == "wall")
    return [piece for piece in pieces if len(tree.query(piece, predicate="within"))]


def name_rooms(
    shapes: Sequence[Area], letterings: Sequence[Lettering], builder: ReportBuilder, drawn: BaseGeometry | None = None
) -> list[SketchedRoom]:
    """Name rooms by the first text inside that is a name, preferably a known room type; compare the areas written.

    Names of rooms that are written in no room, but in the box `drawn` around the walls, give a warning.
    """
    texts, outside = texts_of_rooms([area.shape for area in shapes], letterings)
    for found in _names(outside):
        if drawn is not None and found.room_types and drawn.covers(place := shapely.Point(found.position)):
            line = f"no room was found where '{found.text}' is written; close its walls, or draw the room"
            builder.warnings, builder.places[line] = [*builder.warnings, line], place
    rooms = []
    for area, inside in zip(shapes, texts, strict=True):
        words = _names(inside)
        known = {found.text: types for found in words if (types := found.room_types)}
        name = area.name or next(iter([*known, *(found.text for found in words)]), None)
        written = [kind for types in known.values() for kind in types]
        types = dict.fromkeys([*known.get(name or "", room_types_from_name(name)), *written])
        rooms.append(SketchedRoom(area.shape, name, room_types_from_name(area.kind) or tuple(types)))
        if others := [text for text in known if text != name]:
            names = " and ".join(f"'{text}'" for text in (name, *others[:_MAX_OTHERS]))
            builder.warnings.append(
                f"{names} are written in one room of {area.shape.area:.0f} m²; if they are two rooms, draw the wall "
                "between them"
            )
            builder.places[builder.warnings[-1]] = area.shape
    check_areas(rooms, [[raw.text for raw in inside] for inside in texts], [raw.text for raw in outside], builder)
    unnamed = sum(room.name is None for room in rooms)
    if unnamed:
        builder.notes.append(f"{unnamed} rooms have no name in the file")
    return rooms


def _names(letterings: Sequence[Lettering]) -> list[Lettering]:
    """Return the texts that are names, without the sizes beside them."""
    texts = (replace(lettering, text=without_sizes(lettering.text).strip(" ,;:-\n\t")) for lettering in letterings)
    return [lettering for lettering in texts if _is_name(lettering.text)]


def _is_name(text: str) -> bool:
    """Return whether a text is neither a size ("12.5 m²", "3,20 x 4,10") nor a door number."""
    letters, digits = sum(map(str.isalpha, text)), sum(map(str.isdigit, text))
    return letters >= 2 and letters > digits


def _symbols(drawing: Drawing, closing: Sequence[Swing], symbol_m: float) -> list[SketchedOpening]:
    """Return the openings on layers named after them, one per cluster of shapes, without leaves that close a gap."""
    found = []
    for kind in ("door", "window", "passage"):
        shapes: list[BaseGeometry] = [area.shape for area in drawing.areas if area.role == kind]
        swinging = [*drawing.swings, *closing] if kind == "door" else []
        hinges = shapely.MultiPoint([swing.hinge for swing in swinging]) if swinging else None
        shapes += [stroke.line for stroke in drawing.strokes if stroke.role == kind]
        for cluster in clusters(shapes, symbol_m):
            if hinges is not None and shapely.distance(cluster, hinges) < symbol_m:
                continue  # The swing locates the door more precisely.
            found += _opening_of(kind, cluster)
    return found


def _opening_of(kind: OpeningKind, cluster: BaseGeometry) -> list[SketchedOpening]:
    # A frame or threshold across the wall is more precise than the hull of frame and leaf.
    frames = [part for part in shapely.get_parts(cluster) if part.area > 0.0 and _is_frame(part)]
    ends = opening_line(max(frames, key=lambda part: part.area) if frames else shapely.convex_hull(cluster))
    if ends is None or not _OPENING_M[0] <= math.dist(*ends) <= _OPENING_M[1]:
        return []
    return [SketchedOpening(kind, *ends)]


def _is_frame(part: BaseGeometry) -> bool:
    short, long = side_lengths(part)
    return 0.02 <= short <= 0.6 and long >= max(1.3 * short, _OPENING_M[0])


def _swings(swings: Sequence[Swing], finder: GapFinder, rooms: Sequence[Area]) -> list[SketchedOpening]:
    """Return doors from their swings: the gap that a leaf closes, else the leaf in its closed position."""
    closed = [finder.closed_by(swing) for swing in swings]
    gaps = [finder.gaps[index] for index in dict.fromkeys(closed) if index is not None]
    walls = shapely.union_all([area.shape.exterior for area in rooms])
    others = [swing for swing, index in zip(swings, closed, strict=True) if index is None and not walls.is_empty]
    doors = [SketchedOpening("door", gap.start, gap.end) for gap in gaps]
    return [*doors, *(_closed_leaf(swing, walls) for swing in others)]


def _closed_leaf(swing: Swing, walls: BaseGeometry) -> SketchedOpening:
    """Return the leaf in the position that lies along a wall."""

    def distance_to_wall(tip: tuple[float, float]) -> float:
        line = shapely.LineString([swing.hinge, tip])
        return max(shapely.distance(walls, line.interpolate(share, normalized=True)) for share in (0.2, 0.5, 0.9))

    tip = min((swing.first, swing.last), key=distance_to_wall)
    return SketchedOpening("door", swing.hinge, tip)
