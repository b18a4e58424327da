"""Closed rings: chaining unordered lines into the outline of a floor, and outlines that cross themselves."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import numpy as np
import shapely
from jaxtyping import Float


class OpenRingError(ValueError):
    """Lines that do not close; the message names the junction."""


def chain_rings(lines: Sequence[tuple[int, int]]) -> list[list[int]]:
    """Chain lines, each given by the junctions at its ends, into closed rings.

    Args:
        lines: in any order and direction.

    Returns:
        junctions of every ring, in walking order, the first not repeated at the end.

    Raises:
        OpenRingError: a junction that does not join exactly two lines, or a ring of fewer than three junctions.
    """
    at_junction: dict[int, list[int]] = defaultdict(list)
    for number, ends in enumerate(lines):
        for junction in ends:
            at_junction[junction].append(number)
    for junction, joined in at_junction.items():
        if len(joined) != 2:
            raise OpenRingError(
                f"the ring does not close: junction {junction} joins {len(joined)} of its lines, not exactly two"
            )
    rings, used = [], [False] * len(lines)
    for first, (start, junction) in enumerate(lines):
        if used[first]:
            continue
        ring, line = [start], first
        used[first] = True
        while junction != start:
            ring.append(junction)
            one, other = at_junction[junction]
            line = other if line == one else one
            used[line] = True
            near, far = lines[line]
            junction = far if near == junction else near
        if len(ring) < 3:
            raise OpenRingError(f"a ring has {len(ring)} junctions {sorted(ring)}, at least three are needed")
        rings.append(ring)
    return rings


def signed_area(polygon: Float[np.ndarray, "n 2"]) -> float:
    """Area inside a ring, positive when it runs counter-clockwise."""
    following = np.roll(polygon, -1, axis=0)
    return float(polygon[:, 0] @ following[:, 1] - polygon[:, 1] @ following[:, 0]) / 2.0


def uncrossed(polygon: Float[np.ndarray, "n 2"]) -> tuple[Float[np.ndarray, "m 2"], float]:
    """The largest simple polygon within a ring that may cross or touch itself.

    Returns:
        it, and its share of all the area that the ring encloses; the ring itself and 1 where it is simple already.
    """
    shape = shapely.Polygon(polygon)
    if shape.is_valid:
        return polygon, 1.0
    # A collection may hold multi-polygons, so parts are taken twice.
    parts = shapely.get_parts(shapely.get_parts(shapely.make_valid(shape)))
    areas = [part.area for part in parts]
    if not sum(areas) > 0.0:
        return polygon, 0.0
    largest = parts[int(np.argmax(areas))]
    return np.array(largest.exterior.coords)[:-1], float(largest.area / sum(areas))
