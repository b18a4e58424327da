"""Openings as drawn by data sets, often once per room, and their conversion to single entries of a plan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from lalaloc_core.floorplan import DEFAULT_OPENING_TOLERANCE_M
from lalaloc_core.floorplan.openings import TOUCHING_M, is_above

# Shorter openings are drawing errors.
_MIN_LENGTH_M = 0.02
# Openings belong to the same wall if their lines are parallel within 15 degrees.
_MIN_COSINE = 0.966


@dataclass(frozen=True, eq=False, kw_only=True)
class DrawnOpening:
    """Door, window or passage of a data set, in the plan frame.

    Attributes:
        kind: one of `conventions.OPENING_CLASSES`.
        line_m: both ends.
        sill_m, head_m: heights above the floor; None if unknown.
        rooms: names of the rooms that it opens into; empty if only its position determines them.
    """

    kind: str
    line_m: Float[np.ndarray, "2 2"]
    sill_m: float | None = None
    head_m: float | None = None
    rooms: tuple[str, ...] = ()


def opening_entries(drawn: Sequence[DrawnOpening], ids: dict[str, str]) -> tuple[list[dict[str, Any]], list[str]]:
    """Return the entries of a plan's `openings`, each opening once, and warnings about those left out.

    The first of two overlapping openings is kept. The far side of the same door causes no warning. `ids` maps the names
    of the plan's rooms to their ids.
    """
    kept: list[DrawnOpening] = []
    warnings = []
    for opening in drawn:
        length_m = float(np.hypot(*(opening.line_m[1] - opening.line_m[0])))
        if length_m < _MIN_LENGTH_M:
            warnings.append(f"a {opening.kind} of {length_m:.2f} m is left out: the minimum is {_MIN_LENGTH_M:g} m")
            continue
        shared_m = max((_shared_m(previous, opening) for previous in kept), default=0.0)
        if shared_m > TOUCHING_M:
            if shared_m < 0.5 * length_m:
                x, y = opening.line_m.mean(axis=0)
                warnings.append(f"a {opening.kind} at ({x:.2f}, {y:.2f}) m is left out: it overlaps another opening")
            continue
        kept.append(opening)
    return [_entry(opening, ids) for opening in kept], warnings


def _shared_m(first: DrawnOpening, second: DrawnOpening) -> float:
    """Return the length of wall shared by two openings; 0 on different walls or above each other."""
    if is_above(first.sill_m, second.head_m) or is_above(second.sill_m, first.head_m):
        return 0.0
    start = first.line_m[0]
    along = first.line_m[1] - start
    length_m = float(np.hypot(*along))
    along = along / length_m
    offset = second.line_m - start
    direction = second.line_m[1] - second.line_m[0]
    if abs(float(along @ direction)) < _MIN_COSINE * float(np.hypot(*direction)):
        return 0.0
    if np.abs(offset @ np.array([-along[1], along[0]])).min() > DEFAULT_OPENING_TOLERANCE_M:
        return 0.0
    low, high = np.sort(offset @ along)
    return float(min(length_m, high) - max(0.0, low))


def _entry(opening: DrawnOpening, ids: dict[str, str]) -> dict[str, Any]:
    entry: dict[str, Any] = {"kind": opening.kind, "line": opening.line_m.tolist()}
    if opening.sill_m is not None and opening.head_m is not None and 0.0 <= opening.sill_m < opening.head_m:
        entry |= {"sill_m": opening.sill_m, "head_m": opening.head_m}
    rooms = [ids[room] for room in opening.rooms if room in ids]
    return entry | ({"rooms": rooms} if rooms else {})
