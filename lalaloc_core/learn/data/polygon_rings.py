"""Closed rings: chaining unordered lines into outlines, and repair of outlines that cross themselves."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import numpy as np
import shapely
from jaxtyping import Float

# Minimum share of the floor beside a hole that stays connected.
_MIN_CONNECTED = 0.9


class OpenRingError(ValueError):
    """Lines that do not form closed rings; the message names the junction."""


def chain_rings(lines: Sequence[tuple[int, int]]) -> list[list[int]]:
    """Chain lines, pairs of junctions in any order and direction, into closed rings without repeated ends.

    Raises:
        OpenRingError: a junction does not join exactly two lines, or a ring has fewer than three junctions.
    """
    at_junction: dict[int, list[int]] = defaultdict(list)
    for number, ends in enumerate(lines):
        for junction in ends:
            at_junction[junction].append(number)
    for junction, joined in at_junction.items():
        if len(joined) != 2:
            raise OpenRingError(
                f"the ring does not close: junction {junction} joins {len(joined)} of its lines, not two"
            )
    rings, used = [], [False] * len(lines)
    for first, (start, junction) in enumerate(lines):
        if used[first]:
            continue
        ring, line = [start], first
        used[first] = True
        while junction != start:
            ring.append(junction)
            first_line, second_line = at_junction[junction]
            line = second_line if line == first_line else first_line
            used[line] = True
            near, far = lines[line]
            junction = far if near == junction else near
        if len(ring) < 3:
            raise OpenRingError(f"a ring has {len(ring)} junctions {sorted(ring)}; the minimum is three")
        rings.append(ring)
    return rings


def signed_area(polygon: Float[np.ndarray, "n 2"]) -> float:
    """Return the area inside a ring; positive for counter-clockwise rings."""
    following = np.roll(polygon, -1, axis=0)
    return float(polygon[:, 0] @ following[:, 1] - polygon[:, 1] @ following[:, 0]) / 2.0


def largest_simple_part(polygon: Float[np.ndarray, "n 2"]) -> tuple[Float[np.ndarray, "m 2"], float]:
    """Return the largest simple polygon within a ring that may cross or touch itself.

    Returns:
        The polygon and its share of the enclosed area; a simple ring returns itself and 1.
    """
    shape = shapely.Polygon(polygon)
    if shape.is_valid:
        return polygon, 1.0
    # A collection may hold multi-polygons, so it is split twice.
    parts = shapely.get_parts(shapely.get_parts(shapely.make_valid(shape)))
    areas = [part.area for part in parts]
    if not sum(areas) > 0.0:
        return polygon, 0.0
    largest = parts[int(np.argmax(areas))]
    return np.array(largest.exterior.coords)[:-1], float(largest.area / sum(areas))


def floor_without(
    polygon: Float[np.ndarray, "n 2"], holes: Sequence[Float[np.ndarray, "_ 2"]]
) -> tuple[shapely.Polygon, int]:
    """Return the area inside a simple ring and outside some holes, and the number of holes that are left out.

    Holes may touch or cross the ring. One that encloses nothing inside it, or that cuts off more than a tenth of the
    floor, is left out.
    """
    floor, left_out = shapely.Polygon(polygon), 0
    for hole in holes:
        shape = shapely.make_valid(shapely.Polygon(hole)) if len(hole) > 2 else shapely.Point()
        parts = [part for part in shapely.get_parts(floor.difference(shape)) if isinstance(part, shapely.Polygon)]
        rest = max(parts, key=lambda part: part.area, default=floor)
        if rest.area < _MIN_CONNECTED * sum(part.area for part in parts) or not rest.area < floor.area:
            left_out += 1
        else:
            floor = rest
    return floor, left_out
