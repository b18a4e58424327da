"""Order of poses by cost, and which of them are distinct.

Copies of a flat, or the headings of a square room, cost the same up to rounding, which differs between processors.
Costs that differ by less than `TIED` are a tie, and ties are ordered by position and heading.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from lalaloc_core.conventions import wrap_angle
from lalaloc_core.localise.query import Candidate, Query

# Neighbouring costs that differ by less than this are a tie.
TIED = 1e-6
# Two poses at one place are distinct if their headings differ by more than this (radians).
HEADING_SEPARATION = np.radians(25.0)
# Ties are ordered along a direction oblique to walls, mirror axes and rows of copies, so that keys do not tie.
_OBLIQUE = np.array([1.0, 0.6180, 0.2719, 0.1133])


def photograph_heading(query: Query, candidate: Candidate) -> float:
    """Return the azimuth (radians) of the photograph's centre column that a candidate implies."""
    return float(wrap_angle(query.roll[candidate.hypothesis] + candidate.frame_heading))


def ranking(
    cost: Float[np.ndarray, "n"], position_m: Float[np.ndarray, "n 2"], heading: Float[np.ndarray, "n"] | None = None
) -> Int[np.ndarray, "n"]:
    """Return the order of poses by rising cost, ties by position and heading (radians)."""
    order = np.argsort(cost, kind="stable")
    tie = np.concatenate([[0], np.cumsum(np.diff(cost[order]) >= TIED)])[: len(order)]
    key = position_m @ _OBLIQUE[:2]
    if heading is not None:
        key = key + _OBLIQUE[2] * np.cos(heading) + _OBLIQUE[3] * np.sin(heading)
    return order[np.lexsort((key[order], tie))]


def ranked(candidates: Sequence[Candidate], query: Query) -> Int[np.ndarray, "n"]:
    """Return the order of candidates by rising total cost."""
    return ranking(
        np.array([candidate.total_cost for candidate in candidates]),
        np.stack([candidate.position_m for candidate in candidates]),
        np.array([photograph_heading(query, candidate) for candidate in candidates]),
    )


def suppress(
    position_m: Float[np.ndarray, "n 2"],
    cost: Float[np.ndarray, "n"],
    *,
    separation_m: float,
    limit: int,
    heading: Float[np.ndarray, "n"] | None = None,
    ceiling: float = -np.inf,
    limit_below: int = 0,
) -> list[int]:
    """Return the indices of distinct poses by rising cost (non-maximum suppression).

    Poses closer than `separation_m` to a better one are dropped; with `heading` (radians), poses at one place are
    distinct if their headings differ. At most `limit` poses are returned; poses below the cost `ceiling` are limited by
    `limit_below` instead, if that is larger.
    """
    order = ranking(cost, position_m, heading)
    x_m, y_m = np.ascontiguousarray(position_m[order].T)
    left, first = np.ones(len(order), bool), 0
    kept: list[int] = []
    while len(kept) < max(limit, limit_below) and left[first:].any():
        first += int(left[first:].argmax())
        index = int(order[first])
        if len(kept) >= limit and not cost[index] < ceiling:
            break
        kept.append(index)
        near = first + np.flatnonzero(
            left[first:]
            & (np.sqrt(np.square(x_m[first:] - x_m[first]) + np.square(y_m[first:] - y_m[first])) < separation_m)
        )
        if heading is not None:
            turned = wrap_angle(heading[order[near]] - heading[index])
            near = near[np.abs(turned) <= HEADING_SEPARATION]
        left[near] = left[first] = False
    return kept


def distinct(candidates: Sequence[Candidate], query: Query, separation_m: float, limit: int) -> list[Candidate]:
    """Return the first `limit` candidates of which no two share a place and a heading."""
    kept = suppress(
        np.stack([candidate.position_m for candidate in candidates]),
        np.arange(len(candidates), dtype=float),
        separation_m=separation_m,
        limit=limit,
        heading=np.array([photograph_heading(query, candidate) for candidate in candidates]),
    )
    return [candidates[index] for index in kept]
