"""Stairs among the lines of a drawing: parallel lines of one length at equal distances."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable

import numpy as np
import shapely

_MIN_LINES, _MAX_LINES = 6, 5000
# Largest deviation of distances, and of ends as a share of a line's length.
_EVEN, _FLUSH = 0.1, 0.05
# Width of a stair in treads; wider patterns are hatches.
_WIDE = (2.3, 8.0)


def tread_spacings(lines: Iterable[shapely.LineString]) -> list[float]:
    """Return the distance of the lines of every flight of stairs along an axis, in units of the drawing."""
    across: dict[tuple[bool, int, int], list[tuple[float, float]]] = defaultdict(list)
    for line in list(lines)[:_MAX_LINES]:
        x0, y0, x1, y1 = line.bounds
        width, height = x1 - x0, y1 - y0
        length = max(width, height)
        if length <= 0.0 or min(width, height) > 0.02 * length:
            continue
        is_vertical = height > width
        first, last, level = (y0, y1, x0) if is_vertical else (x0, x1, y0)
        # Lines of one flight begin and end at the same places.
        size = round(np.log(length) / (2.0 * _FLUSH))
        unit = 2.0 * _FLUSH * np.exp(2.0 * _FLUSH * size)
        across[is_vertical, size, round((first + last) / unit)].append((level, length))
    found = []
    for group in across.values():
        if len(group) >= _MIN_LINES:
            found += _flights(sorted(group))
    return found


def _flights(lines: list[tuple[float, float]]) -> list[float]:
    """Return the spacing of each run of equally spaced lines, given as (level, length)."""
    levels = np.array([level for level, _ in lines])
    length = float(np.median([length for _, length in lines]))
    levels = levels[np.concatenate([[True], np.diff(levels) > 1e-6 * length])]
    steps = np.diff(levels)
    found: list[float] = []
    begin = 0
    for end in range(1, len(steps) + 1):
        if end < len(steps) and abs(steps[end] / steps[begin] - 1.0) <= _EVEN:
            continue
        spacing = float(np.mean(steps[begin:end]))
        if end - begin >= _MIN_LINES - 1 and _WIDE[0] <= length / spacing <= _WIDE[1]:
            found.append(spacing)
        begin = end
    return found
