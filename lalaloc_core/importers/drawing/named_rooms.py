"""Rooms joined by a passage without a symbol that is wider than a door, where their names tell them apart."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import combinations

import shapely
from shapely.geometry.base import BaseGeometry

from lalaloc_core.importers.common.geometry import polygons_from_geometry
from lalaloc_core.importers.drawing.enclosed_rooms import DEFAULT_WALLS, Gap, find_gaps
from lalaloc_core.importers.drawing.vector_drawing import Lettering

# Widest passage (m) between rooms with names of their own, and smallest room (m²) that it divides off.
_WIDEST_M, _SMALLEST_M2 = 5.0, 1.5
# Gaps of a room that are tried, the narrowest first.
_MOST_GAPS = 12


def split_named_rooms(
    rooms: Sequence[shapely.Polygon],
    walls: BaseGeometry,
    closed: Sequence[Gap],
    letterings: Sequence[Lettering],
    check_time: Callable[[], None],
) -> tuple[list[shapely.Polygon], list[Gap]]:
    """Divide rooms with several names of rooms at gaps between ends of walls that leave a name on both sides.

    Args:
        rooms: the rooms.
        walls: the walls around them.
        closed: gaps that are closed already.
        letterings: texts of the drawing.
        check_time: called between steps; raises an exception to stop.

    Returns:
        The rooms in the order given, parts beside each other, and the gaps that divide them.
    """
    places = [shapely.Point(text.position) for text in letterings if text.room_type is not None]
    names = shapely.STRtree(places)
    if all(len(names.query(room, predicate="contains")) < 2 for room in rooms):
        return list(rooms), []
    around = shapely.union_all([walls, *(gap.shape for gap in closed)])
    gaps = find_gaps(around, replace(DEFAULT_WALLS, widest_gap=_WIDEST_M), check_time)
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
    pieces: Sequence[shapely.Polygon], gaps: Sequence[Gap], names: shapely.STRtree, check_time: Callable[[], None]
) -> tuple[int, list[shapely.Polygon], tuple[Gap, ...]] | None:
    """Return the number of a piece with its two sides and the gaps between them; None if no gaps divide names."""
    # One passage, or two beside a wall that stands free.
    for group in (*combinations(gaps, 1), *combinations(gaps, 2)):
        check_time()
        cut = shapely.union_all([gap.shape for gap in group])
        for index, piece in enumerate(pieces):
            sides = polygons_from_geometry(piece.difference(cut))
            named = [side for side in sides if len(names.query(side, predicate="contains"))]
            if len(named) == len(sides) == 2 and all(side.area >= _SMALLEST_M2 for side in sides):
                return index, sides, group
    return None
