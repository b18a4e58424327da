"""Limits on lines that cross, checked before the geometry library divides the lines where they do."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
import shapely
from jaxtyping import Bool, Float, Int
from shapely.geometry.base import BaseGeometry

from lalaloc_core.errors import InvalidFloorPlanError

Shape = TypeVar("Shape", bound=BaseGeometry)
# Outlines are repaired in time quadratic in their crossings: a second for 2,000.
_PER_OUTLINE, _MAX_PER_OUTLINE = 20, 2000
# Lines of walls can be a pattern of tiles; the areas between 10,000 crossings take five seconds.
_PER_NETWORK = 10_000
# Pairs of areas whose boxes meet. A storey's outline meets all of its rooms.
_PAIRS, _PAIRS_PER_AREA = 10_000, 100
# Pairs of lines whose boxes meet, which are compared, and comparisons at a time.
_MAX_PAIRS, _PAIRS_AT_A_TIME, _AREAS_AT_A_TIME = 20_000_000, 500_000, 200


def check_outline(shape: BaseGeometry) -> None:
    """Check the crossings of an outline that is about to be repaired."""
    segments = _segments([shape])
    limit = min(_PER_OUTLINE + len(segments), _MAX_PER_OUTLINE)
    if _has_more_crossings(segments, limit):
        x, y = segments[0][:2]
        raise InvalidFloorPlanError(
            f"an outline of {len(segments)} points that begins at ({x:.6g}, {y:.6g}) crosses itself more than {limit} "
            "times, the limit for as many points; draw the outline once around its area"
        )


def check_network(lines: Sequence[BaseGeometry]) -> None:
    """Check the crossings of lines that are about to be joined."""
    segments = _segments(lines)
    limit = _PER_NETWORK + len(segments)
    if _has_more_crossings(segments, limit):
        raise InvalidFloorPlanError(
            f"{len(segments)} lines that could be walls cross more than {limit} times, the limit for as many lines; "
            "set layers to the layers of the walls, or remove patterns such as tiles"
        )


def distinct(shapes: Sequence[Shape]) -> list[Shape]:
    """Return shapes without those that equal another: joining a hundred equal shapes takes as long as ten thousand."""
    keys = shapely.to_wkb(shapely.normalize(np.array(list(shapes), dtype=object)))
    return list(dict(zip(reversed(keys), reversed(shapes), strict=True)).values())[::-1]


def check_overlaps(
    shapes: Sequence[BaseGeometry], others: Sequence[BaseGeometry] | None = None, what: str = "areas"
) -> None:
    """Check the number of areas that lie over one another, or over `others`, before each pair is compared."""
    number = len(shapes) + len(others or ())
    limit, pairs = _PAIRS + _PAIRS_PER_AREA * number, 0
    tree = shapely.STRtree(list(shapes if others is None else others))
    for begin in range(0, len(shapes), _AREAS_AT_A_TIME):
        pairs += tree.query(list(shapes[begin : begin + _AREAS_AT_A_TIME])).shape[1]
        if pairs > limit:
            raise InvalidFloorPlanError(
                f"{number} {what} lie over one another in more than {limit} pairs, the limit for as many; remove those "
                "that are drawn twice, or set layers to the layers of the plan"
            )


def _segments(shapes: Sequence[BaseGeometry]) -> Float[np.ndarray, "n 4"]:
    """Return the straight pieces of lines and outlines, without those of no length."""
    rings = shapely.get_parts(shapely.boundary([s for s in shapes if shapely.get_dimensions(s) == 2]))
    lines = [s for s in shapes if shapely.get_dimensions(s) == 1]
    points, owner = shapely.get_coordinates([*rings, *lines], return_index=True)
    pieces = np.concatenate([points[:-1], points[1:]], axis=1)[owner[:-1] == owner[1:]]
    return pieces[np.any(pieces[:, :2] != pieces[:, 2:], axis=1)]


def _has_more_crossings(segments: Float[np.ndarray, "n 4"], limit: int) -> bool:
    """Return whether more pairs of segments meet, except at common ends, or too many pairs are near each other."""
    if len(segments) * (len(segments) - 1) // 2 <= limit:
        return False
    lines = np.asarray(shapely.linestrings(segments.reshape(-1, 2, 2)))
    tree = shapely.STRtree(lines)
    crossings = pairs = begin = 0
    step = max(_PAIRS_AT_A_TIME // len(segments), 1)
    while begin < len(segments):
        chunk = slice(begin, begin + step)
        first, second = tree.query(lines[chunk])
        first = first + begin
        pairs += len(first)
        is_new = first < second
        crossings += int(_meet_inside(segments, first[is_new], second[is_new]).sum())
        if crossings > limit or pairs > _MAX_PAIRS:
            return True
        begin += step
        # Most lines are near few others.
        step = max(min(8 * step, _PAIRS_AT_A_TIME * begin // max(pairs, 1)), 1)
    return False


def _meet_inside(
    segments: Float[np.ndarray, "n 4"], first: Int[np.ndarray, "k"], second: Int[np.ndarray, "k"]
) -> Bool[np.ndarray, "k"]:
    """Return whether each pair of segments, whose boxes meet, has a common point and no common end."""
    a, b = segments[first, :2], segments[first, 2:]
    c, d = segments[second, :2], segments[second, 2:]
    is_apart = (_side(a, b, c) * _side(a, b, d) > 0.0) | (_side(c, d, a) * _side(c, d, b) > 0.0)
    has_common_end = np.zeros(len(first), bool)
    for p in (a, b):
        for q in (c, d):
            has_common_end |= (p == q).all(axis=1)
    return ~is_apart & ~has_common_end


def _side(
    start: Float[np.ndarray, "k 2"], end: Float[np.ndarray, "k 2"], point: Float[np.ndarray, "k 2"]
) -> Float[np.ndarray, "k"]:
    """Return the sign of the side of a line that a point lies on."""
    along, away = end - start, point - start
    return np.sign(along[:, 0] * away[:, 1] - along[:, 1] * away[:, 0])
