"""Conversion of a drawing to rooms and openings.

Rooms are the areas on layers named after rooms. Without them, they are the areas that walls enclose; if no layer names
walls, the areas that all lines enclose.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from lalaloc_core.errors import InvalidFloorPlanError
from lalaloc_core.importers.common.geometry import opening_line, side_lengths
from lalaloc_core.importers.common.import_limits import Budget
from lalaloc_core.importers.common.import_report import ReportBuilder, Trace, TracePart
from lalaloc_core.importers.common.sketch import OpeningKind, Sketch, SketchedOpening, SketchedRoom
from lalaloc_core.importers.common.vocabulary import Role, room_type_from_name
from lalaloc_core.importers.drawing.door_leaves import (
    LEAF_M,
    drawn_leaves,
    take_leaves,
    with_half_open_doors,
    without_leaves,
)
from lalaloc_core.importers.drawing.drawing_scale import check_areas
from lalaloc_core.importers.drawing.enclosed_rooms import DEFAULT_WALLS, Enclosed, Gap, enclose
from lalaloc_core.importers.drawing.vector_drawing import Area, Drawing, Lettering, Swing

# Names in a room besides its own that are listed.
_MAX_OTHERS = 5
# Largest distance between parts of one symbol (leaf, frame, panes).
_SYMBOL_M = 0.12
_OPENING_M = (0.3, 8.0)
# Largest distance of a hinge from an end of its gap, and width of a leaf as a share of the gap.
_HINGE_M, _LEAF_OF_GAP = 0.4, (0.7, 1.35)
# Largest distance of the tip of an open leaf from the other end of its gap, as a share of the gap: open by 90°.
_OPEN_LEAF = 1.45
# Area written after a room's name.
_SIZE = re.compile(r"\(?\d+(?:[.,]\d+)?\s*(?:m²|m2|qm|sqm|sq\.? ?ft|sf)(?![a-z])\)?", re.IGNORECASE)
# Width of pens that draw walls.
_THICK_M = (0.05, 0.6)
# Size and width of strokes of letters that are drawn as areas.
_LETTER_M, _LETTER_STROKE_M = 0.5, 0.06
# Lines of walls nearer to a room's outline are its own walls.
_OFF_WALL_M = 0.03
_MAX_SEGMENTS = 60_000
# Parts of a trace by the roles of lines.
_TRACED: Mapping[Role | None, TracePart] = {None: "line", "wall": "wall line", "room": "line", "door": "door",
                                            "window": "window", "passage": "passage", "obstacle": "other",
                                            "ignored": "other", "text": "other"}  # fmt: skip


def sketch_drawing(drawing: Drawing, builder: ReportBuilder, budget: Budget) -> Sketch:
    """Find the rooms and openings of a drawing in metres, y up.

    Raises:
        InvalidFloorPlanError: the drawing has too many lines that could be walls, or the time is over.
    """
    sketch = Sketch()
    drawing = with_half_open_doors(drawing)
    _trace_drawing(drawing, budget.trace)
    rooms = [area for area in drawing.areas if area.role == "room"]
    sketch.obstacles = [area.shape for area in drawing.areas if area.role == "obstacle"]
    gaps: Sequence[Gap] = ()
    leaves: Sequence[Swing] = ()
    if rooms:
        shapes = _without_containers(rooms, builder)
        sketch.inner_walls = _free_standing(drawing, shapes)
        builder.notes.append("rooms are the areas that the file marks as rooms")
    else:
        walls = take_leaves([stroke for stroke in drawing.strokes if stroke.role in (None, "wall")], drawing.swings)
        others = [stroke for stroke in drawing.strokes if stroke.role not in (None, "wall")]
        leaves = walls.swings
        areas = without_leaves(drawing.areas, [*drawing.swings, *leaves])
        drawing = replace(drawing, strokes=[*walls.strokes, *others], areas=areas)
        enclosed, source = _enclose_drawing(drawing, budget)
        gaps = enclosed.gaps
        sketch.drawn = enclosed.walls.envelope
        if leaves:
            builder.notes.append(f"{len(leaves)} leaves of doors and their arcs are not walls")
        if budget.trace is not None:
            budget.trace.add("wall", [enclosed.walls])
            budget.trace.add("gap", [gap.shape for gap in gaps])
        shapes = [Area(shape, "", "room") for shape in enclosed.rooms]
        builder.notes.append(
            f"rooms are the areas enclosed by {source}; gaps up to {DEFAULT_WALLS.widest_gap:g} m were closed"
        )
    sketch.rooms = name_rooms(shapes, drawing.letterings, builder, sketch.drawn)
    if budget.trace is not None:
        budget.trace.add("room", [room.shape for room in sketch.rooms])
    # A leaf shows a door only where it closes a gap; a slanted line elsewhere is not along a wall.
    closing = [swing for swing in (*leaves, *drawn_leaves(drawing)) if _gap_of(swing, gaps) is not None]
    sketch.openings = [*_symbols(drawing, closing), *_swings([*drawing.swings, *closing], gaps, shapes)]
    taken = shapely.union_all([opening.line.buffer(0.3) for opening in sketch.openings])
    for gap in gaps:
        line = shapely.LineString([gap.start, gap.end])
        if taken.is_empty or shapely.intersection(line, taken).length < 0.3 * line.length:
            sketch.openings.append(SketchedOpening("passage", gap.start, gap.end))
            builder.unsure.append(
                f"the gap of {gap.width:.2f} m at ({gap.start[0]:.2f}, {gap.start[1]:.2f}) has no symbol of a door or "
                "window; it is taken for a passage"
            )
    budget.check_time()
    return sketch


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
    pieces = _pieces(stroke.line for stroke in drawing.strokes if stroke.role == "wall")
    return [piece for piece in pieces if len(tree.query(piece, predicate="within"))]


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


def _enclose_drawing(drawing: Drawing, budget: Budget) -> tuple[Enclosed, str]:
    """Return the enclosed areas, and a description of what was taken for walls."""
    named_bodies = [area.shape for area in drawing.areas if area.role == "wall"]
    named_lines = [stroke.line for stroke in drawing.strokes if stroke.role == "wall"]
    closers = _closers(drawing)
    if named_bodies or named_lines:
        outlines = [shape.exterior for shape in named_bodies if _is_outline(shape)]
        bodies = [shape for shape in named_bodies if not _is_outline(shape)]
        return enclose(bodies, _pieces([*named_lines, *outlines]), closers, check_time=budget.check_time), "the walls"
    dark = [area.shape for area in drawing.areas if area.is_dark and area.role is None]
    dark = [shape for shape in dark if not (_is_outline(shape) or _is_stroke_of_letter(shape))]
    thick = [stroke for stroke in drawing.strokes if stroke.role is None and _THICK_M[0] <= stroke.width <= _THICK_M[1]]
    dark += [stroke.line.buffer(0.5 * stroke.width, cap_style="square", join_style="mitre") for stroke in thick]
    if dark and (found := enclose(dark, [], closers, check_time=budget.check_time)).rooms:
        return found, "the dark areas and thick lines"
    unnamed = [stroke.line for stroke in drawing.strokes if stroke.role is None]
    unnamed += [area.shape.exterior for area in drawing.areas if area.role is None]
    return enclose([], _pieces(unnamed), closers, check_time=budget.check_time), "all lines"


def _is_outline(shape: shapely.Polygon) -> bool:
    """Return whether a closed wall polyline runs along the faces of a room, and is not the body of a wall."""
    return not shape.buffer(-0.5 * DEFAULT_WALLS.thickest).is_empty


def _is_stroke_of_letter(shape: shapely.Polygon) -> bool:
    """Return whether a dark area is too small and thin for a wall or pillar, as letters that are drawn are."""
    return side_lengths(shape)[1] < _LETTER_M and shape.buffer(-0.5 * _LETTER_STROKE_M).is_empty


def _pieces(lines: Iterable[BaseGeometry]) -> list[shapely.LineString]:
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
    hulls = [shapely.convex_hull(cluster) for cluster in clusters(panes, _SYMBOL_M)]
    windows: list[BaseGeometry] = [hull if hull.area > 0.0 else hull.buffer(0.002, cap_style="flat") for hull in hulls]
    return [shape for shape in (*areas, *windows) if side_lengths(shape)[0] < 0.7]


def name_rooms(
    shapes: Sequence[Area], letterings: Sequence[Lettering], builder: ReportBuilder, drawn: BaseGeometry | None = None
) -> list[SketchedRoom]:
    """Name rooms by the first text inside that is a name, preferably a known room type; compare the areas written.

    Names of rooms that are written in no room, but in the box `drawn` around the walls, give a warning.
    """
    tree = shapely.STRtree([area.shape for area in shapes])
    texts: dict[int, list[str]] = {}
    lost: list[str] = []
    for lettering in letterings:
        inside = tree.query(shapely.Point(lettering.position), predicate="within")
        if len(inside):
            smallest = min(inside, key=lambda index: shapes[index].shape.area)
            texts.setdefault(int(smallest), []).append(lettering.text)
        elif drawn is not None and drawn.covers(shapely.Point(lettering.position)):
            lost.append(_without_size(lettering.text))
    if named := [f"'{text}'" for text in dict.fromkeys(lost) if _is_name(text) and room_type_from_name(text)]:
        builder.warnings.append(
            f"no room was found where {', '.join(named[:_MAX_OTHERS])} is written; close its walls, or draw the room"
        )
    rooms = []
    for index, area in enumerate(shapes):
        words = [text for raw in texts.get(index, []) if _is_name(text := _without_size(raw))]
        known = [text for text in words if room_type_from_name(text) is not None]
        name = area.name or next(iter(known or words), None)
        rooms.append(SketchedRoom(area.shape, name, room_type_from_name(area.kind) or room_type_from_name(name)))
        if others := [text for text in dict.fromkeys(known) if text != name]:
            builder.unsure.append(
                f"'{', '.join(others[:_MAX_OTHERS])}' is written in room '{name}' too; check that it is one room"
            )
    check_areas(rooms, [texts.get(index, []) for index in range(len(rooms))], builder)
    unnamed = sum(room.name is None for room in rooms)
    if unnamed:
        builder.notes.append(f"{unnamed} rooms have no name in the file")
    return rooms


def _without_size(text: str) -> str:
    return _SIZE.sub("", text).strip(" ,;:-\n\t")


def _is_name(text: str) -> bool:
    """Return whether a text is neither a size ("12.5 m²", "3,20 x 4,10") nor a door number."""
    letters = sum(character.isalpha() for character in text)
    digits = sum(character.isdigit() for character in text)
    return letters >= 2 and letters > digits


def _symbols(drawing: Drawing, closing: Sequence[Swing]) -> list[SketchedOpening]:
    """Return the openings on layers named after them, one per cluster of shapes, without leaves that close a gap."""
    found = []
    for kind in ("door", "window", "passage"):
        shapes: list[BaseGeometry] = [area.shape for area in drawing.areas if area.role == kind]
        swinging = [*drawing.swings, *closing] if kind == "door" else []
        hinges = shapely.MultiPoint([swing.hinge for swing in swinging]) if swinging else None
        shapes += [stroke.line for stroke in drawing.strokes if stroke.role == kind]
        for cluster in clusters(shapes, _SYMBOL_M):
            if hinges is not None and shapely.distance(cluster, hinges) < _SYMBOL_M:
                continue  # The swing locates the door more precisely.
            found += _opening_of(kind, cluster)
    return found


def clusters(shapes: Sequence[BaseGeometry], reach_m: float) -> list[BaseGeometry]:
    """Group shapes that are near each other into one geometry each."""
    if not shapes:
        return []
    around = shapely.unary_union([shape.buffer(0.5 * reach_m, quad_segs=2) for shape in shapes])
    regions = list(shapely.get_parts(around))
    tree = shapely.STRtree(regions)
    members: dict[int, list[BaseGeometry]] = {}
    for shape in shapes:
        indices = tree.query(shape, predicate="intersects")
        if len(indices):
            members.setdefault(int(indices[0]), []).append(shape)
    return [shapely.GeometryCollection(group) for group in members.values()]


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


def _swings(swings: Sequence[Swing], gaps: Sequence[Gap], rooms: Sequence[Area]) -> list[SketchedOpening]:
    """Return doors from their swings: the gap that a leaf closes, else the leaf in its closed position."""
    walls = shapely.union_all([area.shape.exterior for area in rooms]) if rooms else shapely.LineString()
    found: list[SketchedOpening] = []
    closed: set[int] = set()
    for swing in swings:
        if not LEAF_M[0] <= swing.radius <= LEAF_M[1]:
            continue
        index = _gap_of(swing, gaps)
        if index is not None:
            if index not in closed:
                closed.add(index)
                found.append(SketchedOpening("door", gaps[index].start, gaps[index].end))
        elif not walls.is_empty:
            found.append(_closed_leaf(swing, walls))
    return found


def _gap_of(swing: Swing, gaps: Sequence[Gap]) -> int | None:
    """Return the index of the gap that a leaf closes, alone or as one of two leaves."""
    best: tuple[float, int] | None = None
    for index, gap in enumerate(gaps):
        for near, far in ((gap.start, gap.end), (gap.end, gap.start)):
            distance = math.dist(swing.hinge, near)
            shares = [leaves * swing.radius / max(gap.width, 1e-6) for leaves in (1, 2)]
            fits = any(_LEAF_OF_GAP[0] <= share <= _LEAF_OF_GAP[1] for share in shares)
            tip_distance = min(math.dist(swing.first, far), math.dist(swing.last, far))
            if (
                distance <= _HINGE_M
                and fits
                and tip_distance <= _OPEN_LEAF * gap.width
                and (best is None or distance < best[0])
            ):
                best = (distance, index)
    return None if best is None else best[1]


def _closed_leaf(swing: Swing, walls: BaseGeometry) -> SketchedOpening:
    """Return the leaf in the position that lies along a wall."""

    def distance_to_wall(tip: tuple[float, float]) -> float:
        line = shapely.LineString([swing.hinge, tip])
        return max(shapely.distance(walls, line.interpolate(share, normalized=True)) for share in (0.2, 0.5, 0.9))

    tip = min((swing.first, swing.last), key=distance_to_wall)
    return SketchedOpening("door", swing.hinge, tip)
