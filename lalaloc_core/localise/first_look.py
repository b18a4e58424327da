"""A first look at all poses of a grid under all hypotheses and heights, which tells the few that are worth a second.

Of every pose a few azimuths are compared, and these by a table: log distances are put into bins (`sketch.py`), so what
an azimuth says of a pose is one row of

    table[azimuth, bin] = log(1 + r²) for every δ and hypothesis, over the number of azimuths

and what a pose costs under all of them at once is the sum of its rows: the product of a sparse matrix, which belongs to
the plan, with the table, which belongs to the query. That is a tenth of the work for each azimuth, and there are fewer
of them. Openings are rows as well; what lies behind them is left to the second look.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, Int

from lalaloc_core.conventions import WALL_CODE
from lalaloc_core.localise.evidence import Evidence
from lalaloc_core.localise.sketch import OPENING_ROWS, Sketch

# Poses that are looked at together, so that what is summed up stays in the processor's cache.
_CHUNK = 512


class Fewest:
    """Of pairs of a pose and a hypothesis that are offered, slice by slice, those of least cost."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._bound = np.inf
        self._cost: list[Float[np.ndarray, "_"]] = []
        self._place: list[Int[np.ndarray, "_"]] = []
        self._kept = 0

    def offer(self, first: int, cost: Float[np.ndarray, "n k"]) -> None:
        """Costs of all pairs of the poses from number `first` on; infinite ones are no pairs."""
        place = np.flatnonzero(cost < self._bound)
        self._cost.append(cost.ravel()[place])
        self._place.append(place + first * cost.shape[1])
        self._kept += len(place)
        if self._kept > 2 * self._limit:
            self._drop()

    def told(self) -> tuple[Float[np.ndarray, "m"], Int[np.ndarray, "m"]]:
        """Their costs, rising, and their places: pose times the number of hypotheses, plus hypothesis."""
        self._drop()
        cost, place = self._cost[0], self._place[0]
        order = np.argsort(cost, kind="stable")
        return cost[order], place[order]

    def _drop(self) -> None:
        cost, place = np.concatenate(self._cost), np.concatenate(self._place)
        if len(cost) > self._limit:
            kept = np.argpartition(cost, self._limit)[: self._limit]
            cost, place = cost[kept], place[kept]
            self._bound = float(cost.max())
        self._cost, self._place, self._kept = [cost], [place], len(cost)


def first_costs(
    sketch: Sketch, evidence: Evidence, room_index: Int[np.ndarray, "n"]
) -> Iterator[tuple[int, Float[np.ndarray, "n k"]]]:
    """Rough costs of all poses under all hypotheses, each at its best δ: the first pose of a slice, and its costs."""
    table, by_room = _table(sketch, evidence), evidence.by_room()
    shape = (-1, len(evidence.offsets), evidence.hypotheses)
    for first in range(0, len(sketch), _CHUNK):
        part = slice(first, first + _CHUNK)
        cost = (sketch.rows[part] @ table).reshape(shape)
        cost += by_room[:, room_index[part]].T[:, :, None]
        yield first, cost.min(axis=1)


def _table(sketch: Sketch, evidence: Evidence) -> Float[np.ndarray, "r c"]:
    """What each row says under every δ and hypothesis, δ by δ."""
    centre, precision, loss = evidence.predicted(sketch.columns)
    azimuths, bins = len(sketch.columns), len(sketch.bins)
    shape = (len(evidence.offsets), evidence.hypotheses)
    # Hypotheses are one prediction that is turned, so few pairs of a centre and a precision are different.
    pairs, which = np.unique((centre + 1j * precision).ravel(), return_inverse=True)
    apart = sketch.bins[:, None, None] - evidence.offsets.astype(np.float32)[:, None] - pairs.real.astype(np.float32)
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
