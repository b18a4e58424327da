"""Coarse pass: an estimate of the cost of all pairs of a grid pose and a hypothesis, which selects those to compare.

A few azimuths of every pose are compared, by a table: log distances are binned (`binned_layouts.py`), so the cost of a
pose at an azimuth is one row of

    table[azimuth, bin] = log(1 + r²) for every δ and hypothesis, over the number of azimuths

and its cost under all δ and hypotheses is the sum of its rows: the product of a sparse matrix, made from the plan, with
the table, made from the query (`coarse_table.py`). This takes a tenth of the time per azimuth, and there are fewer
azimuths. Openings have rows as well, the same for every δ; views through them are left to the full comparison.

In large plans most poses are excluded before that, by a lower bound of their cost over all δ and some neighbouring
hypotheses. The bounds come from a table of minima in short integers, which stays in the cache. Poses are compared by
rising bounds until no other can be among the wanted ones.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from lalaloc_core.localise.match.binned_layouts import BinnedLayouts
from lalaloc_core.localise.match.coarse_table import MAX_SUM, CoarseTable
from lalaloc_core.localise.match.matching_cost import MatchingCost
from lalaloc_core.localise.match.place_cost import PlaceCost

# Poses compared at a time by rising bounds, in plans of more than the last number: few at first, as these limit the
# number of poses.
_FIRST_CHUNK, _LAST_CHUNK = 128, 1024


class LowestCosts:
    """Pairs of a pose and a hypothesis with the lowest costs, of pairs that are offered slice by slice."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._bound = np.inf
        self._cost: list[Float[np.ndarray, "_"]] = []
        self._place: list[Int[np.ndarray, "_"]] = []
        self._kept = 0

    @property
    def bound(self) -> float:
        """Upper bound of the kept costs; infinite until the limit is reached."""
        return self._bound

    def offer(self, pose: Int[np.ndarray, "n"], cost: Float[np.ndarray, "n k"]) -> None:
        """Add the costs of all pairs of some poses, by their numbers; infinite costs are left out."""
        place = np.flatnonzero(cost < self._bound)
        row, hypothesis = np.divmod(place, cost.shape[1])
        self._cost.append(cost.ravel()[place])
        self._place.append(pose[row] * cost.shape[1] + hypothesis)
        self._kept += len(place)
        if self._kept > 2 * self._limit:
            self._drop()

    def ranked(self) -> tuple[Float[np.ndarray, "m"], Int[np.ndarray, "m"]]:
        """Return the costs, rising, and the pairs: pose times the number of hypotheses, plus hypothesis."""
        self._drop()
        cost, place = self._cost[0], self._place[0]
        order = np.argsort(cost)
        rising = cost[order]
        # Sorting all by both takes three times as long, and few costs are equal.
        equal, same = np.zeros(len(order), bool), rising[1:] == rising[:-1]
        equal[1:] |= same
        equal[:-1] |= same
        tied = order[equal]
        order[equal] = tied[np.lexsort((place[tied], rising[equal]))]
        return rising, place[order]

    def _drop(self) -> None:
        cost, place = np.concatenate(self._cost), np.concatenate(self._place)
        if len(cost) > self._limit:
            kept = np.argpartition(cost, self._limit)[: self._limit]
            cost, place = cost[kept], place[kept]
            self._bound = float(cost.max())
        self._cost, self._place, self._kept = [cost], [place], len(cost)


def likeliest(
    binned: BinnedLayouts,
    matching_cost: MatchingCost,
    room_index: Int[np.ndarray, "n"],
    place_cost: PlaceCost | None = None,
    *,
    at_most: int,
    at_least: int,
    window: float = 0.0,
) -> tuple[Float[np.ndarray, "m"], Int[np.ndarray, "m"]]:
    """Return the coarse costs, rising, and the pairs (pose times number of hypotheses, plus hypothesis) of the best.

    There are at least `at_least` pairs if so many exist; those beyond cost at most `window` more than the best. The
    result equals the best of all `coarse_costs`; some pairs beyond these and `at_most` can follow. `place_cost` is
    added to the costs of all pairs; infinite excludes a pair.
    """
    best = LowestCosts(at_most)
    if len(binned) <= _LAST_CHUNK:
        cost = coarse_costs(binned, matching_cost, room_index)
        every = np.arange(len(binned))
        best.offer(every, cost if place_cost is None else cost + place_cost.of_poses(every))
        return best.ranked()
    table = CoarseTable(binned, matching_cost)
    bound = table.bounds(binned, room_index, place_cost)
    possible = np.flatnonzero(np.isfinite(bound))
    # Short integers sort fastest.
    order = possible[np.argsort(_shortened(bound[possible]), kind="stable")]
    least_after = np.minimum.accumulate(bound[order][::-1])[::-1]
    least = LowestCosts(at_least)
    lowest, first, count = np.inf, 0, _FIRST_CHUNK
    while first < len(order) and least_after[first] <= min(best.bound, max(lowest + window, least.bound)):
        pose = order[first : first + count]
        cost = table.costs(binned.part(pose), room_index[pose])
        cost = cost if place_cost is None else cost + place_cost.of_poses(pose)
        best.offer(pose, cost)
        least.offer(pose, cost)
        lowest = min(lowest, float(cost.min()))
        first, count = first + count, min(2 * count, _LAST_CHUNK)
    return best.ranked()


def coarse_costs(
    binned: BinnedLayouts, matching_cost: MatchingCost, room_index: Int[np.ndarray, "n"]
) -> Float[np.ndarray, "n k"]:
    """Return the coarse costs of all poses under all hypotheses, each at its best δ."""
    table = CoarseTable(binned, matching_cost)
    costs, first = [], 0
    for part in binned.parts:
        costs.append(table.costs(part, room_index[first : first + len(part)]))
        first += len(part)
    return np.concatenate(costs)


def _shortened(bound: Float[np.ndarray, "n"]) -> Int[np.ndarray, "n"]:
    """Return short integers in nearly the same order."""
    low, span = float(bound.min(initial=np.inf)), float(np.ptp(bound)) if len(bound) else 0.0
    return ((bound - low) * (MAX_SUM / max(span, 1e-9))).astype(np.int16)
