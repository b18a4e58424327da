"""A first look at all poses of a grid under all hypotheses and heights, which tells the few that are worth a second.

Of every pose a few azimuths are compared, and these by a table: log distances are put into bins (`binned_layouts.py`),
so what an azimuth says of a pose is one row of

    table[azimuth, bin] = log(1 + r²) for every δ and hypothesis, over the number of azimuths

and what a pose costs under all of them at once is the sum of its rows: the product of a sparse matrix, which belongs to
the plan, with the table, which belongs to the query. That is a tenth of the work for each azimuth, and there are fewer
of them. Openings are rows as well; what lies behind them is left to the second look.

Of a large plan most poses do not even get that. A bound comes first: what a pose costs at least, whatever δ and
whichever of some neighbouring hypotheses, by a table of the least of all these in short integers, which stays in the
cache. Poses are then looked at by rising bounds, until no other can be among those that are wanted.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from lalaloc_core.conventions import WALL_CODE
from lalaloc_core.localise.binned_layouts import OPENING_ROWS, BinnedLayouts
from lalaloc_core.localise.matching_cost import MatchingCost

# Poses that are looked at together, so that what is summed up stays in the processor's cache.
_CHUNK = 512
# ... when they are looked at by rising bounds: few at first, as these tell how far to go; and for their bounds.
_FIRST_CHUNK, _LAST_CHUNK, _BOUNDED_CHUNK = 128, 1024, 4096
# So many neighbouring hypotheses share a bound.
_NEIGHBOURS = 2
# Sums of bounds stay below this, which is almost what a short integer holds.
_MAX_SUM = 30_000


class LowestCosts:
    """Of pairs of a pose and a hypothesis that are offered, slice by slice, those of least cost."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._bound = np.inf
        self._cost: list[Float[np.ndarray, "_"]] = []
        self._place: list[Int[np.ndarray, "_"]] = []
        self._kept = 0

    @property
    def bound(self) -> float:
        """What costs as much as this is none of them; infinite as long as there are fewer."""
        return self._bound

    def offer(self, pose: Int[np.ndarray, "n"], cost: Float[np.ndarray, "n k"]) -> None:
        """Costs of all pairs of some poses, by their numbers; infinite ones are no pairs."""
        place = np.flatnonzero(cost < self._bound)
        row, hypothesis = np.divmod(place, cost.shape[1])
        self._cost.append(cost.ravel()[place])
        self._place.append(pose[row] * cost.shape[1] + hypothesis)
        self._kept += len(place)
        if self._kept > 2 * self._limit:
            self._drop()

    def ranked(self) -> tuple[Float[np.ndarray, "m"], Int[np.ndarray, "m"]]:
        """Their costs, rising, and their places: pose times the number of hypotheses, plus hypothesis."""
        self._drop()
        cost, place = self._cost[0], self._place[0]
        order = np.lexsort((place, cost))
        return cost[order], place[order]

    def _drop(self) -> None:
        cost, place = np.concatenate(self._cost), np.concatenate(self._place)
        if len(cost) > self._limit:
            kept = np.argpartition(cost, self._limit)[: self._limit]
            cost, place = cost[kept], place[kept]
            self._bound = float(cost.max())
        self._cost, self._place, self._kept = [cost], [place], len(cost)


@dataclass(frozen=True, kw_only=True)
class PairLimits:
    """Which pairs of a pose and a hypothesis are looked for.

    Attributes:
        at_most: so many at most.
        at_least: so many at least, if there are as many.
        window: the others only if they cost at most this more than the best.
    """

    at_most: int
    at_least: int
    window: float = 0.0


def likeliest(
    binned: BinnedLayouts,
    evidence: MatchingCost,
    room_index: Int[np.ndarray, "n"],
    wanted: PairLimits,
    against: Float[np.ndarray, "n"] | None = None,
) -> tuple[Float[np.ndarray, "m"], Int[np.ndarray, "m"]]:
    """Rough costs, rising, and places (pose times the number of hypotheses, plus hypothesis) of the likeliest pairs.

    They are those of all `first_costs`; some that are beyond `wanted` may follow.

    Args:
        against: what is added to the costs of every pose; infinite: it is not possible.
    """
    table, by_room = _table(binned, evidence), evidence.by_room()
    shape = (-1, len(evidence.offsets), evidence.hypotheses)
    bound = _bounds(binned, table.reshape(len(table), *shape[1:])) + by_room.min(axis=0)[room_index]
    bound = bound if against is None else bound + against
    possible = np.flatnonzero(np.isfinite(bound))
    # Short integers are sorted in no time.
    order = possible[np.argsort(_shortened(bound[possible]), kind="stable")]
    least_after = np.minimum.accumulate(bound[order][::-1])[::-1]
    best, least = LowestCosts(wanted.at_most), LowestCosts(wanted.at_least)
    lowest, first, count = np.inf, 0, _FIRST_CHUNK
    while first < len(order) and least_after[first] <= min(best.bound, max(lowest + wanted.window, least.bound)):
        pose = order[first : first + count]
        cost = _least(binned.rows[pose] @ table, by_room[:, room_index[pose]], shape)
        cost = cost if against is None else cost + against[pose, None]
        best.offer(pose, cost)
        least.offer(pose, cost)
        lowest = min(lowest, float(cost.min()))
        first, count = first + count, min(2 * count, _LAST_CHUNK)
    return best.ranked()


def _shortened(bound: Float[np.ndarray, "n"]) -> Int[np.ndarray, "n"]:
    """Numbers in about the same order."""
    low, span = float(bound.min(initial=np.inf)), float(np.ptp(bound)) if len(bound) else 0.0
    return ((bound - low) * (_MAX_SUM / max(span, 1e-9))).astype(np.int16)


def _bounds(binned: BinnedLayouts, table: Float[np.ndarray, "r j k"]) -> Float[np.ndarray, "n"]:
    """Of every pose what its walls and openings cost at least, whatever the δ and the hypothesis."""
    azimuths = len(binned.columns)
    least = np.minimum.reduceat(table.min(axis=1), np.arange(0, table.shape[2], _NEIGHBOURS), axis=1)
    walls, openings = np.split(least, [azimuths * len(binned.bins)])
    # Every azimuth has one row of walls, and at most one of openings.
    most = azimuths * float(np.abs(walls).max() + np.abs(openings).max(initial=0.0))
    scale = _MAX_SUM / max(most, 1e-6)
    short = np.floor(least * scale).astype(np.int16)
    bound = np.empty(len(binned), np.float32)
    for first in range(0, len(binned), _BOUNDED_CHUNK):
        part = slice(first, first + _BOUNDED_CHUNK)
        bound[part] = (binned.rows[part] @ short).min(axis=1)
    # Rounding of single precision aside.
    return bound / scale - 1e-5


def _least(
    costs: Float[np.ndarray, "n c"], by_room: Float[np.ndarray, "j n"], shape: tuple[int, int, int]
) -> Float[np.ndarray, "n k"]:
    """What poses cost under every hypothesis, each at its best δ."""
    costs = costs.reshape(shape)
    costs += by_room.T[:, :, None]
    return costs.min(axis=1)


def first_costs(
    binned: BinnedLayouts, evidence: MatchingCost, room_index: Int[np.ndarray, "n"]
) -> Iterator[tuple[int, Float[np.ndarray, "n k"]]]:
    """Rough costs of all poses under all hypotheses, each at its best δ: the first pose of a slice, and its costs."""
    table, by_room = _table(binned, evidence), evidence.by_room()
    shape = (-1, len(evidence.offsets), evidence.hypotheses)
    for first in range(0, len(binned), _CHUNK):
        part = slice(first, first + _CHUNK)
        yield first, _least(binned.rows[part] @ table, by_room[:, room_index[part]], shape)


def _table(binned: BinnedLayouts, evidence: MatchingCost) -> Float[np.ndarray, "r c"]:
    """What each row says under every δ and hypothesis, δ by δ."""
    centre, precision, loss = evidence.predicted(binned.columns)
    azimuths, bins = len(binned.columns), len(binned.bins)
    shape = (len(evidence.offsets), evidence.hypotheses)
    # Hypotheses are one prediction that is turned, so few pairs of a centre and a precision are different.
    pairs, which = np.unique((centre + 1j * precision).ravel(), return_inverse=True)
    apart = binned.bins[:, None, None] - evidence.offsets.astype(np.float32)[:, None] - pairs.real.astype(np.float32)
    walls = np.log1p(np.square(apart * pairs.imag.astype(np.float32))) / azimuths
    table = np.zeros((azimuths * (bins + OPENING_ROWS), *shape), np.float32)
    of_walls = table[: azimuths * bins].reshape(azimuths, bins, *shape)
    of_openings = table[azimuths * bins :].reshape(azimuths, OPENING_ROWS, *shape)
    for azimuth, pair in enumerate(which.reshape(centre.shape).T):
        of_walls[azimuth] = walls[:, :, pair]
    if loss is not None:
        loss = loss.transpose(1, 2, 0)[:, :, None] / azimuths
        of_walls += loss[:, WALL_CODE, None]
        of_openings[:] = loss[:, 1:] - loss[:, :1]
    return table.reshape(len(table), -1)
