"""Symbols of fixtures in pictures, as most programs draw them; only clear ones are taken.

A stove is a box with four circles in two rows. A toilet is an oval before the middle of a cistern at a wall. A bath is
a box at a wall with a rounded tub inside. A basin is a box at a wall with an oval in its middle, which is no circle in
a square, as of a washing machine. A sink is a box at a wall with two bowls side by side, or one at an end. A shower is
a square at a wall with a drain in its middle or a corner, and nothing else than diagonals that end there. A bed is
a box with pillows at its head, which is at a wall. Stairs are treads of one size in a row.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import shapely
from jaxtyping import Float
from shapely.geometry.base import BaseGeometry

from lalaloc_core.importers.common.import_limits import CheckTime
from lalaloc_core.importers.common.sketch import SketchedFixture
from lalaloc_core.importers.picture.ink import Ink
from lalaloc_core.importers.picture.symbol_shapes import Shape

# Largest distance (m) of a fixture from its wall.
_AT_WALL_M = 0.18
# Sides of symbols and their parts (m), the longer first.
_BURNER_M, _BURNERS_M, _HOB_M = (0.09, 0.33), (0.15, 0.5), ((0.4, 1.0), (0.4, 0.8))
_BOWL_M, _CISTERN_M, _TOILET_M = ((0.32, 0.6), (0.26, 0.46)), ((0.3, 0.62), (0.08, 0.27)), (0.48, 0.88)
_BATH_M, _TUB, _DRAIN_M2 = ((1.35, 1.95), (0.6, 0.95)), (0.5, 0.93), 0.03
_BASIN_M, _BASIN_BOWL, _SQUARE = ((0.36, 0.8), (0.26, 0.6)), (0.25, 0.85), 1.2
_SINK_M, _SINK_BOWL, _INSET_M, _OFF_MIDDLE = ((0.7, 1.3), (0.42, 0.68)), (0.15, 0.5), 0.02, 0.1
_SHOWER_M, _SHOWER_DRAIN_M, _LEFT_OUT = ((0.7, 1.3), (0.68, 1.1)), (0.06, 0.2), 0.12
_BED_M, _PILLOW_M, _DOUBLE_M = ((1.85, 2.3), (0.75, 2.1)), ((0.33, 0.95), (0.2, 0.6)), 1.2
_ROUNDED_M2, _FURNITURE_M2, _TOUCHING_M = 0.03, 1.3, 0.06
_TREAD_M, _TREADS, _FLIGHT_M = ((0.34, 2.2), (0.18, 0.36)), 5, 0.7
# Reach (pixels) of the outline of a symbol.
_LINE_PX = 2


@dataclass(frozen=True, eq=False)
class Symbol:
    """Symbol, and its part that is at a wall; None if it can stand anywhere. Furniture of an unclear kind has None."""

    kind: str | None
    outline: shapely.Polygon
    back: BaseGeometry | None = None

    def is_in(self, room: shapely.Polygon) -> bool:
        """Return whether the symbol stands in a room as its kind does."""
        inside = room.contains(self.outline.centroid)
        return inside and (self.back is None or bool(shapely.distance(self.back, room.exterior) <= _AT_WALL_M))


def find_symbols(strict: Sequence[Shape], faint: Sequence[Shape], check_time: CheckTime) -> list[Symbol]:
    """Return the clear symbols among the closed shapes of a picture, read without and with faint lines.

    `check_time` is called between steps and raises an exception to stop.
    """
    clear = [symbol for symbol in _symbols(strict, (), check_time) if symbol.kind is not None]
    return _symbols(faint, clear, check_time)


def _symbols(shapes: Sequence[Shape], given: Sequence[Symbol], check_time: CheckTime) -> list[Symbol]:
    """Return the symbols that are given, and others among shapes."""
    tree = shapely.STRtree([shape.outline for shape in shapes])
    found = list(given)
    clear = (*_stairs(shapes), *_toilets(shapes), *_crossed_showers(shapes))
    found += [symbol for symbol in clear if not is_taken(symbol.outline, given)]
    boxes = [shape for shape in shapes if shape.area >= _HOB_M[0][0] * _HOB_M[1][0] and shape.is_box]
    for shape in sorted([*boxes, *_beds(boxes)], key=lambda shape: -shape.area):
        check_time()
        parts = [shapes[k] for k in tree.query(shape.outline, predicate="intersects") if shape.holds(shapes[k])]
        symbol = _symbol(shape, parts)
        if symbol is not None and not is_taken(shape.outline, found):
            found.append(symbol)
    return found


def fixtures_in(symbols: Sequence[Symbol], rooms: Sequence[shapely.Polygon]) -> list[SketchedFixture]:
    """Return the symbols that stand in a room as their kind does."""
    return [
        SketchedFixture(symbol.kind, symbol.outline)
        for symbol in symbols
        if symbol.kind is not None and any(symbol.is_in(room) for room in rooms)
    ]


def is_taken(outline: shapely.Polygon, found: Sequence[Symbol | SketchedFixture]) -> bool:
    """Return whether a shape is a part of a symbol."""
    areas = (symbol.outline if isinstance(symbol, Symbol) else symbol.shape for symbol in found)
    return any(shapely.intersection(outline, area).area > 0.3 * min(outline.area, area.area) for area in areas)


def without_symbols(ink: Ink, symbols: Sequence[Symbol]) -> Ink:
    """Return the ink without the inner lines of symbols; outlines stay, because they can be lines of walls."""
    inside = np.zeros(ink.mask.shape, np.uint8)
    for symbol in symbols:
        corners = np.asarray(symbol.outline.exterior.coords)
        cv2.fillPoly(inside, [np.round(ink.to_pixels(corners) - 0.5).astype(np.int32)], 1)
    paper = cv2.erode(inside, np.ones((2 * _LINE_PX + 1,) * 2, np.uint8)) > 0
    return replace(ink, gray=np.where(paper, np.uint8(255), ink.gray), mask=ink.mask & ~paper, lines=ink.lines & ~paper)


def _symbol(shape: Shape, parts: Sequence[Shape]) -> Symbol | None:
    """Return the symbol that a box is, by the parts inside; boxes with rounded parts are furniture of some kind."""
    outline = shapely.Polygon(shape.box)
    if _is_stove(shape, parts):
        return Symbol("stove", outline)
    washed_in = (("bath", _is_bath), ("basin", _is_basin), ("sink", _is_sink), ("shower", _is_shower))
    if kind := next((kind for kind, is_kind in washed_in if is_kind(shape, parts)), None):
        return Symbol(kind, outline, outline)
    if (head := _head_of_bed(shape, parts)) is not None:
        return Symbol("bed", outline, head)
    # Letters are smaller, and rooms larger.
    rounded = [part for part in parts if part.area >= _ROUNDED_M2 and (part.is_oval or part.rounded_corners >= 2)]
    return Symbol(None, outline) if rounded and shape.area <= _FURNITURE_M2 else None


def _is_stove(shape: Shape, parts: Sequence[Shape]) -> bool:
    circles = [part for part in parts if part.is_circle and _BURNER_M[0] <= part.long_m <= _BURNER_M[1]]
    burners = _outermost(circles)
    if not _fits(shape, _HOB_M) or len(burners) != 4:
        return False
    # Centres in the four quarters of the box, as far from its middle.
    places = (np.array([burner.centre for burner in burners]) - shape.centre) @ shape.frame
    is_apart = np.all((np.abs(places) >= 0.5 * _BURNERS_M[0]) & (np.abs(places) <= 0.5 * _BURNERS_M[1]))
    return bool(is_apart) and len({(x > 0.0, y > 0.0) for x, y in places}) == 4


def _toilets(shapes: Sequence[Shape]) -> list[Symbol]:
    """Return the toilets: ovals before the middle of a cistern."""
    ovals = [
        part
        for part in shapes
        if _fits(part, _BOWL_M) and (part.is_oval or (0.78 <= part.filled <= 0.95 and part.rounded_corners in (2, 4)))
    ]
    around = shapely.STRtree([oval.outline for oval in ovals])
    bowls = [oval for oval in ovals if not any(ovals[k].holds(oval) for k in around.query(oval.outline))]
    cisterns = [part for part in shapes if _fits(part, _CISTERN_M) and part.filled >= 0.85]
    tree, found = shapely.STRtree([cistern.outline for cistern in cisterns]), list[Symbol]()
    for bowl in bowls:
        for number in tree.query(bowl.outline, predicate="dwithin", distance=_TOUCHING_M):
            cistern = cisterns[number]
            step, both = cistern.centre - bowl.centre, Shape.around([bowl, cistern])
            is_before = abs(float(bowl.axis @ cistern.axis)) < 0.2 or bowl.is_circle
            is_apart = float(np.linalg.norm(step)) >= 0.5 * cistern.short_m + 0.3 * bowl.long_m
            is_in_middle = abs(float(step @ cistern.axis)) <= 0.07
            has_size = _TOILET_M[0] <= both.long_m <= _TOILET_M[1]
            if is_before and is_apart and is_in_middle and has_size and not is_taken(bowl.outline, found):
                found.append(Symbol("toilet", shapely.Polygon(both.box), cistern.outline))
    return found


def _is_bath(shape: Shape, parts: Sequence[Shape]) -> bool:
    tubs = [part for part in parts if _TUB[0] * shape.area <= part.area <= _TUB[1] * shape.area]
    inner = _outermost(tubs)
    if not _fits(shape, _BATH_M) or len(inner) != 1:
        return False
    (tub,) = inner
    others = [part for part in parts if part not in tubs and part.area > _DRAIN_M2]
    is_along = abs(float(tub.axis @ shape.axis)) > 0.95 and tub.long_m > 1.3 * tub.short_m
    is_centred = float(np.linalg.norm(tub.centre - shape.centre)) < 0.15
    return is_along and is_centred and not others and tub.rounded_corners >= 2


def _is_basin(shape: Shape, parts: Sequence[Shape]) -> bool:
    bowls = _outermost([part for part in parts if part.area > _DRAIN_M2])
    if not _fits(shape, _BASIN_M) or len(bowls) != 1:
        return False
    (bowl,) = bowls
    is_washer = bowl.is_circle and shape.long_m <= _SQUARE * shape.short_m
    is_share = _BASIN_BOWL[0] * shape.area <= bowl.area <= _BASIN_BOWL[1] * shape.area
    return bowl.is_oval and is_share and not is_washer and float(np.linalg.norm(bowl.centre - shape.centre)) < 0.08


def _is_sink(shape: Shape, parts: Sequence[Shape]) -> bool:
    bowls = _outermost([part for part in parts if part.area > _DRAIN_M2])
    if not _fits(shape, _SINK_M) or not all(_is_sink_bowl(bowl, shape) for bowl in bowls):
        return False
    places = [float((bowl.centre - shape.centre) @ shape.axis) for bowl in bowls]
    if len(places) == 1:
        return abs(places[0]) > _OFF_MIDDLE * shape.long_m
    return len(places) == 2 and places[0] * places[1] < 0.0


def _is_sink_bowl(bowl: Shape, sink: Shape) -> bool:
    """Return whether a part lies as a bowl in a sink: off its edges, and nearly as deep."""
    reach = np.abs((bowl.box - sink.centre) @ sink.frame).max(axis=0)
    depth = 2.0 * reach[1]
    is_inset = bool(np.all(reach <= np.array([sink.long_m, sink.short_m]) / 2.0 - _INSET_M))
    is_share = _SINK_BOWL[0] * sink.area <= bowl.area <= _SINK_BOWL[1] * sink.area
    return is_inset and is_share and depth >= 0.55 * sink.short_m and bowl.filled >= 0.8


def _crossed_showers(shapes: Sequence[Shape]) -> list[Symbol]:
    """Return the showers that diagonals divide into four triangles, which end at a drain."""
    triangles = [shape for shape in shapes if 0.4 <= shape.filled <= 0.65 and _fits(shape, (_SHOWER_M[0], (0.0, 1.0)))]
    tree, found = shapely.STRtree([triangle.outline for triangle in triangles]), []
    for number, triangle in enumerate(triangles):
        near = tree.query(triangle.outline, predicate="dwithin", distance=_SHOWER_DRAIN_M[1])
        box = Shape.around([triangles[k] for k in near])
        if len(near) != 4 or near.min() != number or not (box.is_box and _is_tray(box)):
            continue
        radii = [float(shapely.distance(shapely.Point(box.centre), triangles[k].outline)) for k in near]
        # Diagonals without a drain meet; such boxes are shafts as well.
        if min(radii) >= max(0.5 * _SHOWER_DRAIN_M[0], 2.5 * box.pixel_m) and max(radii) <= 0.5 * _SHOWER_DRAIN_M[1]:
            tray = shapely.Polygon(box.box)
            found.append(Symbol("shower", tray, tray))
    return found


def _is_tray(shape: Shape) -> bool:
    return _fits(shape, _SHOWER_M) and shape.long_m <= _SQUARE * shape.short_m


def _is_shower(shape: Shape, parts: Sequence[Shape]) -> bool:
    least_m, most_m = _SHOWER_DRAIN_M
    drains = _outermost([part for part in parts if part.is_circle and least_m <= part.long_m <= most_m])
    if not _is_tray(shape) or len(drains) != 1:
        return False
    (drain,) = drains
    reach = np.abs((drain.centre - shape.centre) @ shape.frame) / np.array([shape.long_m, shape.short_m])
    is_placed = bool(np.all(reach < _LEFT_OUT) or np.all(reach > 0.5 - 2.0 * _LEFT_OUT))
    return is_placed and all(part is drain or drain.holds(part) for part in parts)


def _outermost(parts: Sequence[Shape]) -> list[Shape]:
    return [part for part in parts if not any(other.holds(part) for other in parts)]


def _beds(boxes: Sequence[Shape]) -> list[Shape]:
    """Return beds of two boxes: the head, and the cover from its edge on."""
    tree, found = shapely.STRtree([box.outline for box in boxes]), []
    for number, box in enumerate(boxes):
        near = tree.query(box.outline.buffer(3.0 * box.pixel_m), predicate="intersects")
        for other in (boxes[k] for k in near[near > number] if boxes[k].long_m <= _BED_M[0][1] >= box.long_m):
            both = Shape.around([box, other])
            if _fits(both, _BED_M) and box.area + other.area >= 0.9 * both.long_m * both.short_m:
                found.append(both)
    return found


def _head_of_bed(shape: Shape, parts: Sequence[Shape]) -> shapely.Point | None:
    """Return the middle of the end of a bed that has pillows, in its middle or side by side; None without them."""
    if not _fits(shape, _BED_M):
        return None
    pillows = [part for part in parts if _fits(part, _PILLOW_M) and part.filled >= 0.8]
    along, across = shape.frame.T
    # Nearly square beds can have the head at any side.
    axes = (along, -along) if shape.short_m < 1.8 else (along, -along, across, -across)
    ends = [shapely.Point(shape.centre + 0.5 * axis * np.ptp(shape.box @ axis)) for axis in axes]
    return next((end for axis, end in zip(axes, ends, strict=True) if _has_pillows(shape, pillows, axis)), None)


def _has_pillows(shape: Shape, parts: Sequence[Shape], head: Float[np.ndarray, "2"]) -> bool:
    length, width = (float(np.ptp(shape.box @ side)) for side in (head, _left(head)))
    places = [(part, part.centre - shape.centre) for part in parts if abs(float(part.axis @ head)) < 0.3]
    pillows = [(part, float(away @ _left(head))) for part, away in places if 0.5 * length - away @ head <= 0.45]
    if width < _DOUBLE_M:
        return len(pillows) == 1 and abs(pillows[0][1]) <= 0.1 and pillows[0][0].long_m >= 0.45 * width
    if len(pillows) != 2:
        return False
    (first, left), (second, right) = pillows
    return abs(left + right) <= 0.12 and left * right < 0.0 and abs(first.long_m - second.long_m) <= 0.1


def _left(axis: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
    return np.array([-axis[1], axis[0]])


def _stairs(shapes: Sequence[Shape]) -> list[Symbol]:
    """Return the flights of stairs: at least five treads of one size, one behind the other."""
    treads = [part for part in shapes if _fits(part, _TREAD_M) and part.filled >= 0.88]
    tree, left, found = shapely.STRtree([tread.outline for tread in treads]), set(range(len(treads))), []
    while left:
        numbers = [left.pop()]
        for number in numbers:
            near = tree.query(treads[number].outline, predicate="dwithin", distance=_TREAD_M[1][1]).tolist()
            following = [k for k in near if k in left and _continues(treads[k], treads[number])]
            left.difference_update(following)
            numbers += following
        row = [treads[number] for number in numbers]
        levels = np.sort([float(tread.centre @ _left(row[0].axis)) for tread in row])
        steps = 1 + int((np.diff(levels) > 0.5 * row[0].short_m).sum())
        flight = Shape.around(row)
        is_whole = sum(tread.area for tread in row) >= 0.8 * flight.long_m * flight.short_m
        width = flight.area / max(steps * row[0].short_m, 1e-9)
        if steps >= _TREADS and is_whole and width >= _FLIGHT_M:
            found.append(Symbol("stairs", shapely.Polygon(flight.box)))
    return found


def _continues(tread: Shape, other: Shape) -> bool:
    """Return whether a tread follows another of its size, or is the other half beside an arrow."""
    step = tread.centre - other.centre
    along, across = abs(float(step @ other.axis)), abs(float(step @ _left(other.axis)))
    depth = 0.5 * (tread.short_m + other.short_m)
    if abs(float(tread.axis @ other.axis)) < 0.98 or abs(tread.short_m - other.short_m) > 0.05:
        return False
    # One tread may be unreadable.
    follows = along <= 0.05 and 0.75 * depth <= across <= 2.4 * depth and abs(tread.long_m - other.long_m) <= 0.06
    return follows or (across <= 0.04 and abs(along - 0.5 * (tread.long_m + other.long_m)) <= 0.06)


def _fits(shape: Shape, sides: tuple[tuple[float, float], tuple[float, float]]) -> bool:
    """Return whether the longer and the shorter side are in their ranges (m)."""
    (low, high), (short_low, short_high) = sides
    return low <= shape.long_m <= high and short_low <= shape.short_m <= short_high
