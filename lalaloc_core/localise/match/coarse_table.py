"""Table of the coarse pass: the cost of every binned distance and opening under the hypotheses of one query.

A view shows a part of the horizon, so a sector of azimuths tells something about a part of the headings only; the
table of a sector has just these hypotheses.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from lalaloc_core.conventions import WALL_CODE
from lalaloc_core.localise.match.binned_layouts import OPENING_ROWS, BinnedLayouts
from lalaloc_core.localise.match.matching_cost import MatchingCost
from lalaloc_core.localise.match.place_cost import PlaceCost

# Neighbouring hypotheses that share a bound.
_NEIGHBOURS = 2
# Poses whose bounds are computed at a time: those of the largest plans would take hundreds of megabytes.
_BOUNDED = 2**15
# Sums of bounds stay below this, close to the largest short integer.
MAX_SUM = 30_000


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

    def __init__(self, binned: BinnedLayouts, matching_cost: MatchingCost) -> None:
        self.hypotheses, self._offsets = matching_cost.hypotheses, len(matching_cost.offsets)
        self._room_costs, self._trust_number = matching_cost.room_costs, matching_cost.trust_number
        azimuths = len(binned.columns)
        cost, which = _wall_costs(binned, matching_cost)
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
        scale = MAX_SUM / max(len(binned.columns) * highest, 1e-6)
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
    binned: BinnedLayouts, matching_cost: MatchingCost
) -> tuple[Float[np.ndarray, "b j d"], Int[np.ndarray, "k a"]]:
    """Return the costs of the bins under every δ for the d different predictions, and which of them holds where."""
    # Hypotheses are one prediction, turned, so there are few different ones at an azimuth.
    modes = matching_cost.predicted_modes(binned.columns)
    different, which = _different(modes.reshape(-1, modes.shape[2]))
    apart = binned.bins[:, None, None] - matching_cost.offsets.astype(np.float32)[:, None]
    likelihood = sum(
        odds / (1.0 + np.square((apart - centre) * precision))
        for centre, precision, odds in different.reshape(len(different), -1, 3).transpose(1, 2, 0)
    )
    cost = -np.log(np.minimum(likelihood, 1.0)) / len(binned.columns)
    return cost.astype(np.float32, copy=False), which.reshape(modes.shape[:2])


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


def _different(rows: Float[np.ndarray, "n v"]) -> tuple[Float[np.ndarray, "d v"], Int[np.ndarray, "n"]]:
    """Return the different rows, and which of them each row is; as `np.unique`, which compares column by column."""
    rows = np.ascontiguousarray(rows)
    whole = rows.view(np.dtype((np.void, rows.itemsize * rows.shape[1]))).ravel()
    _, first, which = np.unique(whole, return_index=True, return_inverse=True)
    return rows[first], which
