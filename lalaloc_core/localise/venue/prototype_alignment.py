"""Alignment of prototypes: their cost at the pose nearby that fits the query best.

The camera is up to half a metre from the nearest prototype, and its heading between two hypotheses, so the cost of a
prototype (`prototype_costs`) tolerates differences of that size, and many plans fit. Alignment solves for the four
unknowns u: the displacement (x, y) from the prototype, the turn from the hypothesis, and the log of the camera height
from its hypothesis. The log wall profile of a displaced camera follows from the prototype's own, because the visible
walls have slopes g = ∂ log d / ∂ azimuth:

    log d' = log d + J u    J_xy = (g t - s) / d    J_turn = g    J_height = -1

with the ray's direction s = (sin a, cos a) and t = (cos a, -sin a) at right angles to it. Two Gauss-Newton steps lower

    T walls(u) + ½ sum (u / σ)²

where σ is the reach of prototypes, and the spread between neighbouring hypotheses. A ray of the displaced camera meets
the wall that the prototype sees at the azimuth a + t·(x, y) / d + turn, and shows the opening class there. After
alignment, walls and openings are compared with half of the reach, and openings with their full weight.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from lalaloc_core.conventions import TWO_PI
from lalaloc_core.localise.venue.prototype_costs import PrototypeCosts
from lalaloc_core.localise.venue.prototypes import AZIMUTHS, unpacked_openings

# Reaches of the two steps and of the comparison, as shares of the prototypes' reach.
_STEPS, _COMPARISON = (1.0, 0.7), 0.5
# Weight of openings relative to the matching cost's.
_OPENINGS_SHARE = 1.0
# Maximum displacement in reaches, as walls farther away are hidden by others.
_MAX_REACHES = 1.5
# Maximum slope: walls seen at less than 14 degrees have too few azimuths to measure it.
_MAX_SLOPE = 4.0
# Pairs aligned at a time, few enough to stay in the processor's cache.
_CHUNK = 512


class Aligned(NamedTuple):
    """Aligned pairs of a prototype and a hypothesis.

    Attributes:
        cost: (n,) cost at the aligned pose, with the prior of the unknowns.
        step: (n, 4) unknowns: x, y (m), turn (radians) and log height; 0 for those that the query states exactly.
    """

    cost: Float[np.ndarray, "n"]
    step: Float[np.ndarray, "n 4"]


class PrototypeAlignment:
    """Alignment of pairs of a prototype and a hypothesis for one query."""

    def __init__(self, costs: PrototypeCosts) -> None:
        self._costs = costs
        reach_m = costs.reach_m
        self._precisions = [costs.precisions(share * reach_m) for share in (*_STEPS, _COMPARISON)]
        self._opening_loss: dict[int, np.ndarray] = {}
        self._max_m = _MAX_REACHES * reach_m
        azimuth = costs.azimuths
        self._along = np.stack([np.sin(azimuth), np.cos(azimuth)]).astype(np.float32)
        self._across = np.stack([np.cos(azimuth), -np.sin(azimuth)]).astype(np.float32)
        sigma = np.array([reach_m, reach_m, costs.sector / math.sqrt(12.0), costs.height_spread])
        # Unknowns that the query states exactly are left out.
        self._free = np.flatnonzero(sigma > 0.0)
        self._stiffness = (1.0 / np.square(sigma[self._free])).astype(np.float32)

    def pairs(self, rows: np.ndarray, hypothesis: Int[np.ndarray, "n"], offset: Int[np.ndarray, "n"]) -> Aligned:
        """Align prototypes, each under one hypothesis; the arguments are as in `PrototypeCosts.pairs`."""
        aligned = Aligned(np.empty(len(rows), np.float32), np.zeros((len(rows), 4), np.float32))
        for begin in range(0, len(rows), _CHUNK):
            part = slice(begin, begin + _CHUNK)
            aligned.cost[part], step = self._pairs(rows[part], hypothesis[part], offset[part])
            aligned.step[part, self._free] = step
        return aligned

    def _pairs(
        self, rows: np.ndarray, hypothesis: np.ndarray, offset: np.ndarray
    ) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n u"]]:
        log_m, temperature = rows["log_profile"].astype(np.float32), self._costs.temperature
        difference, inverse_m = log_m - self._costs.shifted[hypothesis, offset], np.exp(-log_m)
        jacobian = self._jacobian(log_m, inverse_m)
        step, moved = np.zeros(jacobian.shape[:2], np.float32), difference
        for precision in self._precisions[:-1]:
            step = self._step(jacobian, difference, moved, precision[hypothesis])
            moved = difference + (step[:, None] @ jacobian)[:, 0]
        factor = 1.0 + np.square(moved * self._precisions[-1][hypothesis])
        # No product of matrices over pairs: its rounding depends on their number, and copies would get other masses.
        prior = (np.square(step) * self._stiffness).sum(axis=1)
        cost = np.log(factor).mean(axis=1) + 0.5 * prior / temperature
        cost += self._costs.room_costs(rows, offset)
        if self._costs.compares_openings:
            cost += self._openings(rows, hypothesis, inverse_m, step)
        return cost, step

    def _jacobian(self, log_m: Float[np.ndarray, "n a"], inverse_m: Float[np.ndarray, "n a"]) -> np.ndarray:
        """Return (n, u, a) derivatives of the log wall profiles by the free unknowns."""
        slope = _slopes(log_m)
        by_position = (slope[:, None] * self._across - self._along) * inverse_m[:, None]
        jacobian = np.concatenate([by_position, slope[:, None], np.full_like(slope, -1.0)[:, None]], axis=1)
        return jacobian if len(self._free) == jacobian.shape[1] else np.ascontiguousarray(jacobian[:, self._free])

    def _step(
        self,
        jacobian: Float[np.ndarray, "n u a"],
        difference: Float[np.ndarray, "n a"],
        moved: Float[np.ndarray, "n a"],
        precision: Float[np.ndarray, "n a"],
    ) -> Float[np.ndarray, "n u"]:
        """Return the unknowns of the linear model, with the robust weights of the residuals after the last step."""
        square = np.square(precision)
        weight = (2.0 * self._costs.temperature / AZIMUTHS) * square / (1.0 + square * np.square(moved))
        weighted = jacobian * weight[:, None]
        information = weighted @ jacobian.transpose(0, 2, 1)
        every = np.arange(len(self._stiffness))
        information[:, every, every] += self._stiffness
        step = -np.linalg.solve(information, weighted @ difference[:, :, None])[:, :, 0]
        length_m = np.linalg.norm(step[:, :2], axis=1, keepdims=True)
        step[:, :2] *= np.minimum(1.0, self._max_m / np.maximum(length_m, 1e-6))
        return step

    def _openings(
        self,
        rows: np.ndarray,
        hypothesis: np.ndarray,
        inverse_m: Float[np.ndarray, "n a"],
        step: Float[np.ndarray, "n u"],
    ) -> Float[np.ndarray, "n"]:
        """Return the openings' term, with the class that each ray of the displaced camera meets."""
        aside = (step[:, :1] * self._across[0] + step[:, 1:2] * self._across[1]) * inverse_m
        if 2 in self._free:
            aside += step[:, 2:3]
        place = (np.arange(AZIMUTHS) + np.rint(aside * (AZIMUTHS / TWO_PI)).astype(np.intp)) % AZIMUTHS
        kind = np.take_along_axis(unpacked_openings(rows["openings"]), place, axis=1)
        cost = np.empty(len(rows), np.float32)
        for claims in np.unique(rows["claims"]).tolist():
            row = np.flatnonzero(rows["claims"] == claims)
            cost[row] = self._loss(claims)[hypothesis[row, None], np.arange(AZIMUTHS), kind[row]].sum(axis=1)
        return cost

    def _loss(self, claims: int) -> Float[np.ndarray, "k a c"]:
        """Return the losses of opening classes after alignment."""
        if claims not in self._opening_loss:
            reach_m = _COMPARISON * self._costs.reach_m
            (self._opening_loss[claims],) = self._costs.opening_losses([claims], reach_m, _OPENINGS_SHARE)
        return self._opening_loss[claims]


def _slopes(log_m: Float[np.ndarray, "n a"]) -> Float[np.ndarray, "n a"]:
    """Return the slopes of log wall profiles by azimuth: the smaller one of both sides, 0 at corners and edges."""
    after = (np.roll(log_m, -1, axis=1) - log_m) * np.float32(AZIMUTHS / TWO_PI)
    before = np.roll(after, 1, axis=1)
    smaller = np.where(np.abs(after) < np.abs(before), after, before)
    return np.clip(np.where(after * before > 0.0, smaller, np.float32(0.0)), -_MAX_SLOPE, _MAX_SLOPE)
