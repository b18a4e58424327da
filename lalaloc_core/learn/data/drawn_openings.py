"""Openings as data sets draw them: often once for each room, at times twice, to be one entry of a plan each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from lalaloc_core.floorplan import DEFAULT_OPENING_TOLERANCE_M
from lalaloc_core.floorplan.openings import TOUCHING_M, is_above

# What is shorter is a slip of the drawing.
_MIN_LENGTH_M = 0.02
# Openings are the same wall's when their lines are parallel to 15 degrees.
_MIN_COSINE = 0.966


@dataclass(frozen=True, eq=False, kw_only=True)
class DrawnOpening:
    """A door, window or passage of a data set, in the plan frame.

    Attributes:
        kind: one of `conventions.OPENING_CLASSES`.
        line_m: its ends.
        sill_m, head_m: heights over the floor; None where the data set does not say.
        rooms: names of the rooms that it opens into; empty where only its place says so.
    """

    kind: str
    line_m: Float[np.ndarray, "2 2"]
    sill_m: float | None = None
    head_m: float | None = None
    rooms: tuple[str, ...] = ()


def opening_entries(drawn: Sequence[DrawnOpening], ids: dict[str, str]) -> tuple[list[dict[str, Any]], list[str]]:
    """Entries of a plan's `openings`, each opening once, and warnings about what was left out.

    Of two that share a stretch of wall the first one stays. The far side of the same door is no reason for a warning.

    Args:
        ids: of the plan's rooms by their names.
    """
    kept: list[DrawnOpening] = []
    warnings = []
    for opening in drawn:
        length_m = float(np.hypot(*(opening.line_m[1] - opening.line_m[0])))
        if length_m < _MIN_LENGTH_M:
            warnings.append(f"a {opening.kind} of {length_m:.2f} m is left out: it is shorter than {_MIN_LENGTH_M:g} m")
            continue
        shared_m = max((_shared_m(other, opening) for other in kept), default=0.0)
        if shared_m > TOUCHING_M:
            if shared_m < 0.5 * length_m:
                x, y = opening.line_m.mean(axis=0)
                warnings.append(f"a {opening.kind} at ({x:.2f}, {y:.2f}) m is left out: it overlaps another opening")
            continue
        kept.append(opening)
    return [_entry(opening, ids) for opening in kept], warnings


def _shared_m(first: DrawnOpening, second: DrawnOpening) -> float:
    """Length that two openings share of one wall, 0 where they are not in one or stand above each other."""
    if is_above(first.sill_m, second.head_m) or is_above(second.sill_m, first.head_m):
        return 0.0
    start = first.line_m[0]
    along = first.line_m[1] - start
    length_m = float(np.hypot(*along))
    along = along / length_m
    other = second.line_m - start
    turn = second.line_m[1] - second.line_m[0]
    if abs(float(along @ turn)) < _MIN_COSINE * float(np.hypot(*turn)):
        return 0.0
    if np.abs(other @ np.array([-along[1], along[0]])).min() > DEFAULT_OPENING_TOLERANCE_M:
        return 0.0
    low, high = np.sort(other @ along)
    return float(min(length_m, high) - max(0.0, low))


def _entry(opening: DrawnOpening, ids: dict[str, str]) -> dict[str, Any]:
    entry: dict[str, Any] = {"kind": opening.kind, "line": opening.line_m.tolist()}
    if opening.sill_m is not None and opening.head_m is not None and 0.0 <= opening.sill_m < opening.head_m:
        entry |= {"sill_m": opening.sill_m, "head_m": opening.head_m}
    rooms = [ids[room] for room in opening.rooms if room in ids]
    return entry | ({"rooms": rooms} if rooms else {})
