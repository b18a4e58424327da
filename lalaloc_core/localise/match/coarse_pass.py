"""Coarse pass: an estimate of the cost of all pairs of a grid pose and a hypothesis, which selects those to compare.

A few azimuths of every pose are compared, by a table: log distances are binned (`BinnedLayouts`), so the cost of a
pose at an azimuth is one row of

    table[azimuth, bin] = log(1 + r²) for every δ and hypothesis, over the number of azimuths

and its cost under all δ and hypotheses is the sum of its rows: the product of a sparse matrix, made from the plan, with
the table, made from the query. This takes a tenth of the time per azimuth, and there are fewer
azimuths. Openings have rows as well, the same for every δ; walls seen through them are left to the full comparison.

In large plans most poses are excluded before that, by a lower bound of their cost over all δ and some neighbouring
hypotheses. The bounds come from a table of minima in short integers, which stays in the cache. Poses are compared by
rising bounds until no other can be among the wanted ones.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from lalaloc_core.conventions import WALL_CODE
from lalaloc_core.localise.match.matching_cost import MatchingCost
from lalaloc_core.localise.match.place_cost import PlaceCost
from lalaloc_core.localise.match.pose_grid import OPENING_ROWS, BinnedLayouts

# Poses compared at a time by rising bounds, in plans of more than the last number: few at first, as these limit the
# number of poses.
_FIRST_CHUNK, _LAST_CHUNK = 128, 1024
# Neighbouring hypotheses that share a bound.
_NEIGHBOURS = 2
# Poses whose bounds are computed at a time: those of the largest plans would take hundreds of megabytes.
_BOUNDED = 2**15
# Sums of bounds stay below this, close to the largest short integer.
_MAX_SUM = 30_000


class _Sector(NamedTuple):
    """Costs of walls in one sector: (rows, δ, hypothesis), for `length` hypotheses around the circle from `first`."""

    walls: Float[np.ndarray, "r j l"]
    first: int

    @property
    def length(self) -> int:
        return self.walls.shape[2]


class CoarseTable:
    """Costs of all rows of binned layouts, over the number of azimuths, for one query.

    Attributes:
        hypotheses: number of hypotheses.
    """

    def __init__(self, binned: BinnedLayouts, matching_cost: MatchingCost, *, usual_height: bool = False) -> None:
        offsets = matching_cost.offsets
        tried = np.argsort(np.abs(offsets), kind="stable")[: 1 if usual_height else len(offsets)]
        self.hypotheses, self._offsets = matching_cost.hypotheses, len(tried)
        self._room_costs, self._trust_number = matching_cost.room_costs[tried], matching_cost.trust_number
        azimuths = len(binned.columns)
        cost, which = _wall_costs(binned, matching_cost, offsets[tried])
        is_told = np.any(cost != 0.0, axis=(0, 1))[which]
        self._sectors = [
            _sector(cost, which[:, part], np.any(is_told[:, part], axis=1)) for part in binned.sectors_of_azimuths
        ]
        # A wall costs its loss as an opening class, and an opening the difference; by trust.
        self._openings: Float[np.ndarray, "t r k"] | None = None
        self._without_openings = np.zeros((1, self.hypotheses), np.float32)
        loss = matching_cost.opening_costs(binned.columns)
        if loss is not None:
            loss = loss.transpose(0, 2, 3, 1) / azimuths
            self._without_openings = loss[:, :, WALL_CODE].sum(axis=1)
            differences = np.delete(loss, WALL_CODE, axis=2) - loss[:, :, [WALL_CODE]]
            differences = differences.reshape(len(loss), azimuths * OPENING_ROWS, -1)
            self._openings = np.ascontiguousarray(differences, np.float32)

    def costs(self, binned: BinnedLayouts, room_index: Int[np.ndarray, "n"]) -> Float[np.ndarray, "n k"]:
        """Return the coarse cost of poses in some rooms under every hypothesis, each at its best δ."""
        total = np.zeros((len(binned), self._offsets, self.hypotheses), np.float32)
        for rows, sector in zip(binned.walls, self._sectors, strict=True):
            if sector.length:
                table = sector.walls.reshape(len(sector.walls), -1)
                _add_around(total, (rows @ table).reshape(len(binned), self._offsets, -1), sector.first)
        total += self._room_costs.T[room_index, :, None]
        best = total.min(axis=1)
        if self._openings is None:
            return best
        for rows, trust in self._by_trust(room_index):
            best[rows] += self._without_openings[trust] + binned.openings[rows] @ self._openings[trust]
        return best

    def _by_trust(self, room_index: Int[np.ndarray, "n"]) -> Iterator[tuple[slice | Int[np.ndarray, "m"], int]]:
        """Yield the poses of each trust in openings, with its number."""
        if len(self._without_openings) == 1:
            yield slice(None), 0
            return
        number = self._trust_number[room_index]
        for trust in np.unique(number).tolist():
            yield np.flatnonzero(number == trust), trust

    def bounds(
        self, binned: BinnedLayouts, room_index: Int[np.ndarray, "n"], place_cost: PlaceCost | None = None
    ) -> Float[np.ndarray, "n"]:
        """Return a lower bound of the cost of every pose over all δ and hypotheses, with its place cost."""
        least = [_least(sector.walls.min(axis=1)) for sector in self._sectors if sector.length]
        openings = None if self._openings is None else [_least(table) for table in self._openings]
        # Every azimuth has one row of walls, and at most one of openings.
        highest = max((float(part.max()) for part in least), default=0.0)
        highest += 0.0 if openings is None else float(np.abs(openings).max())
        scale = _MAX_SUM / max(len(binned.columns) * highest, 1e-6)
        total = np.zeros((len(binned), -(-self.hypotheses // _NEIGHBOURS)), np.int16)
        told = [(rows, sector.first) for rows, sector in zip(binned.walls, self._sectors, strict=True) if sector.length]
        for (rows, first), part in zip(told, least, strict=True):
            _add_around(total, rows @ _floored(part, scale), first // _NEIGHBOURS)
        bound, without = np.empty(len(binned), np.float32), _least(self._without_openings)
        every = np.arange(len(binned))
        for rows, trust in self._by_trust(room_index):
            part, pose = total[rows], every[rows]
            if openings is not None:
                part = part + binned.openings[rows] @ _floored(openings[trust], scale)
            for first in range(0, len(pose), _BOUNDED):
                some = slice(first, first + _BOUNDED)
                by_neighbours = part[some] / np.float32(scale) + without[trust]
                if place_cost is not None:
                    by_neighbours = by_neighbours + place_cost.lowest(pose[some], _NEIGHBOURS)
                bound[pose[some]] = by_neighbours.min(axis=1)
        # The costs themselves are rounded to single precision.
        return bound + self._room_costs.min(axis=0)[room_index] - 1e-5


def _wall_costs(
    binned: BinnedLayouts, matching_cost: MatchingCost, offsets: Float[np.ndarray, "j"]
) -> tuple[Float[np.ndarray, "b j d"], Int[np.ndarray, "k a"]]:
    """Return the costs of the bins under some δ for the d different predictions, and which of them holds where."""
    different, which = matching_cost.predicted_modes(binned.columns)
    apart = binned.bins[:, None, None] - offsets.astype(np.float32)[:, None]
    likelihood = sum(
        odds / (1.0 + np.square((apart - centre) * precision))
        for centre, precision, odds in different.transpose(1, 2, 0)
    )
    cost = -np.log(np.minimum(likelihood, 1.0)) / len(binned.columns)
    return cost.astype(np.float32, copy=False), which


def _sector(cost: Float[np.ndarray, "b j d"], which: Int[np.ndarray, "k a"], is_told: Bool[np.ndarray, "k"]) -> _Sector:
    """Return the table of a sector: the different costs at its azimuths, for the hypotheses that it tells about."""
    first, length = _part_of_circle(is_told)
    place = (first + np.arange(length)) % len(which)
    table = np.empty((which.shape[1], *cost.shape[:2], length), np.float32)
    for azimuth, prediction in enumerate(which[place].T):
        np.take(cost, prediction, axis=2, out=table[azimuth], mode="clip")
    return _Sector(table.reshape(len(cost) * which.shape[1], cost.shape[1], length), first)


def _part_of_circle(wanted: Bool[np.ndarray, "k"]) -> tuple[int, int]:
    """Return the first hypothesis and the length of the shortest part of the circle with all that are wanted.

    Both are multiples of the neighbours that share a bound, except at the end of an odd number of hypotheses.
    """
    count, places = len(wanted), np.flatnonzero(wanted)
    if not len(places):
        return 0, 0
    gaps = np.diff(np.append(places, places[0] + count))
    widest = int(gaps.argmax())
    first, length = int(places[(widest + 1) % len(places)]), count - int(gaps[widest]) + 1
    if count % _NEIGHBOURS:
        # Pairs of neighbours do not continue across the end.
        first, length = int(places[0]), int(places[-1] - places[0]) + 1
    length += first % _NEIGHBOURS
    first -= first % _NEIGHBOURS
    length = -(-length // _NEIGHBOURS) * _NEIGHBOURS
    if count % _NEIGHBOURS:
        return first, min(length, count - first)
    return (0, count) if length >= count else (first, length)


def _add_around(total: np.ndarray, part: np.ndarray, first: int) -> None:
    """Add a part of the circle, the last axis, to the whole, from `first` on."""
    before = min(part.shape[-1], total.shape[-1] - first)
    total[..., first : first + before] += part[..., :before]
    total[..., : part.shape[-1] - before] += part[..., before:]


def _least(values: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n l"]:
    """Return the least values of neighbouring hypotheses."""
    return np.minimum.reduceat(values, np.arange(0, values.shape[1], _NEIGHBOURS), axis=1)


def _floored(values: Float[np.ndarray, "n l"], scale: float) -> Int[np.ndarray, "n l"]:
    return np.floor(values * scale).astype(np.int16)


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
    binned: BinnedLayouts, matching_cost: MatchingCost, room_index: Int[np.ndarray, "n"], *, usual_height: bool = False
) -> Float[np.ndarray, "n k"]:
    """Return the coarse costs of all poses under all hypotheses, each at its best δ, or at that of the usual height."""
    table = CoarseTable(binned, matching_cost, usual_height=usual_height)
    costs, first = [], 0
    for part in binned.parts:
        costs.append(table.costs(part, room_index[first : first + len(part)]))
        first += len(part)
    return np.concatenate(costs)


def _shortened(bound: Float[np.ndarray, "n"]) -> Int[np.ndarray, "n"]:
    """Return short integers in nearly the same order."""
    low, span = float(bound.min(initial=np.inf)), float(np.ptp(bound)) if len(bound) else 0.0
    return ((bound - low) * (_MAX_SUM / max(span, 1e-9))).astype(np.int16)
