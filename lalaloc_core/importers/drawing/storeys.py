"""Several storeys that are drawn beside each other on one page or picture."""

from __future__ import annotations

from collections.abc import Callable

import shapely

from lalaloc_core.importers.common.geometry import polygons_from_geometry
from lalaloc_core.importers.common.import_report import ReportBuilder
from lalaloc_core.importers.common.sketch import Sketch

# Rooms farther apart (m) are of different drawings; smaller ones, by their share of the largest, are outbuildings.
_APART_M, _SHARE, _MIN_M2 = 1.0, 0.3, 12.0
# Margin (m) around the rooms of a part, for its walls.
_MARGIN_M = 0.5
_REACH_M = 0.6
_MAX_NAMED = 6

Box = tuple[float, float, float, float]


def choose_storey(sketch: Sketch, builder: ReportBuilder, in_file: Callable[[Box], Box], *, is_chosen: bool) -> Sketch:
    """Return the largest of several storeys that are drawn side by side; warn with the `crop` of every one.

    Args:
        sketch: rooms in metres.
        builder: receives the warning.
        in_file: converts a box in metres (left, lowest, right, highest) to the file's coordinates.
        is_chosen: leave out the other storeys; otherwise they are only named.
    """
    together = shapely.union_all([room.shape.buffer(0.5 * _APART_M) for room in sketch.rooms])
    parts = polygons_from_geometry(together)
    areas = [sum(room.shape.area for room in sketch.rooms if part.covers(room.shape)) for part in parts]
    largest = max(areas, default=0.0)
    storeys = sorted(
        ((area, part) for area, part in zip(areas, parts, strict=True) if area >= max(_SHARE * largest, _MIN_M2)),
        key=lambda storey: -storey[0],
    )
    if len(storeys) < 2:
        return sketch
    named = "; ".join(
        f"{area:.0f} m² at crop={','.join(f'{number:.0f}' for number in in_file(_around(part)))}"
        for area, part in storeys[:_MAX_NAMED]
    )
    read = "only the first was read" if is_chosen else "they were read as one"
    builder.warnings.append(
        f"{len(storeys)} storeys seem to be drawn side by side, {named}; {read}: set crop to read one"
    )
    if not is_chosen:
        return sketch
    chosen, near = storeys[0][1], storeys[0][1].buffer(_REACH_M)
    rooms = [room for room in sketch.rooms if chosen.covers(room.shape)]
    builder.no_room = [area for area in builder.no_room if near.covers(area)]
    sketch.rooms = rooms
    sketch.openings = [opening for opening in sketch.openings if near.covers(opening.line)]
    sketch.fixtures = [fixture for fixture in sketch.fixtures if near.covers(fixture.shape)]
    return sketch


def name_storeys(sketch: Sketch, builder: ReportBuilder, *, flip_y: bool) -> Sketch:
    """Warn of storeys that are drawn side by side in a vector drawing, which can also be buildings of one site."""
    unit = builder.metres_per_unit

    def in_units(box: Box) -> Box:
        x0, y0, x1, y1 = (number / unit for number in box)
        return (x0, -y1, x1, -y0) if flip_y else (x0, y0, x1, y1)

    return choose_storey(sketch, builder, in_units, is_chosen=False)


def _around(part: shapely.Polygon) -> Box:
    x0, y0, x1, y1 = part.buffer(_MARGIN_M - 0.5 * _APART_M).bounds
    return x0, y0, x1, y1
