"""Exact cost of prototypes: walls, openings, ceiling and room type as in `matching_cost.py`, but coarser.

Differences to the matching cost of grid poses:

* There are 32 azimuths, and at most 32 hypotheses of the heading.
* The reach is that of a grid with the prototypes' spacing.
* Views through openings are ignored.
* Openings have less weight, as they appear displaced from a prototype up to half a metre away from the camera.
  `prototype_alignment` solves for the displacement.
* The openings' term is relative to the best class of a plan that shows all openings, so that plans with different
  trusts in their openings can be compared. Trusts have four levels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from lalaloc_core.bundle import MatchingWeights
from lalaloc_core.conventions import OPENING_CLASSES, ROOM_TYPES, column_azimuths
from lalaloc_core.localise.match import MatchingConfig
from lalaloc_core.localise.match.cost_terms import (
    ceiling_costs,
    class_losses,
    mean_log,
    median_distance_m,
    precisions,
    room_type_losses,
    smoothed,
)
from lalaloc_core.localise.query import PredictedCeiling, Query
from lalaloc_core.localise.venue.prototypes import (
    AZIMUTHS,
    PER_BYTE,
    STEPS,
    azimuths,
    trust_of_claims,
    unpacked_openings,
)

# Spacing of the tried logs of the camera height; prototypes' distances are too coarse for smaller differences.
_OFFSET_SPACING = 0.2
# Weight of openings relative to the matching cost's.
_OPENINGS_SHARE = 0.6
# Pairs compared at a time, few enough to stay in the processor's cache.
_CHUNK = 1024
# `log` is slow, so multiply this many factors, each at most the maximum, before taking it.
_FACTORS, _MAX_FACTOR = 8, 1e4
_CLASSES = len(OPENING_CLASSES)
# Classes at the four azimuths of every byte.
_CLASSES_BY_BYTE = unpacked_openings(np.arange(256, dtype=np.uint8)[:, None])


class PrototypeCosts:
    """Costs of prototypes for one query under k hypotheses of the heading and j of the camera height.

    Attributes:
        centre: (k, a) predicted log wall profile (m) at the prototypes' azimuths.
        precision: (k, a) factors that turn differences of log distance into residuals.
        reach_m: distance (m) of the camera from the best prototype, at most.
        offsets: (j,) logs of true over stated camera height.
        penalty: (j,) prior cost of each height.
    """

    def __init__(self, query: Query, step_m: float, weights: MatchingWeights, config: MatchingConfig) -> None:
        assert query.profile is not None, "without a predicted profile there is nothing to compare prototypes with"
        self._query, self._weights, self._config = query, weights, config
        self._columns = azimuths(query.profile.log_m.shape[1])
        # Hypotheses closer than two azimuths of the prototypes cannot be distinguished.
        self._every = max(1, len(query.roll) // AZIMUTHS)
        self.reach_m = config.grid_reach * STEPS * step_m
        self.centre = query.profile.log_m[:: self._every, self._columns].astype(np.float32)
        self.precision = self.precisions(self.reach_m)
        self.offsets = _offsets(query)
        # Losses of openings by claims, of which a venue has few.
        self._opening_loss: dict[int, np.ndarray] = {}
        self._byte_losses: dict[int, np.ndarray] = {}
        self.penalty = query.camera_height.penalty(self.offsets) / weights.temperature

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of hypotheses of the heading and of the height."""
        return len(self.centre), len(self.offsets)

    @property
    def temperature(self) -> float:
        """Factor that turns costs into negative log likelihoods."""
        return self._weights.temperature

    @property
    def azimuths(self) -> Float[np.ndarray, "a"]:
        """Azimuths (radians) that are compared."""
        assert self._query.profile is not None
        return column_azimuths(self._query.profile.log_m.shape[1])[self._columns]

    @property
    def sector(self) -> float:
        """Angle (radians) between neighbouring hypotheses; 0 for a single one."""
        return self._every * self._query.sector

    @property
    def height_spread(self) -> float:
        """Standard deviation of the log of the true height over that of the best hypothesis."""
        return min(self._query.camera_height.log_std, _OFFSET_SPACING / math.sqrt(12.0))

    def precisions(self, reach_m: float) -> Float[np.ndarray, "k a"]:
        """Return the factors of differences of log distance for a camera within a reach (m)."""
        profile = self._query.profile
        assert profile is not None
        precision = precisions(profile.log_m, profile.log_scale, reach_m, self._weights.tail)
        return precision[:: self._every, self._columns].astype(np.float32)

    def pairs(
        self, rows: np.ndarray, hypothesis: Int[np.ndarray, "n"], offset: Int[np.ndarray, "n"]
    ) -> Float[np.ndarray, "n"]:
        """Return the cost of prototypes, each under one hypothesis.

        `rows` are records of type `prototypes.ROW`; `hypothesis` and `offset` are numbers of heading and height
        hypotheses.
        """
        cost = np.empty(len(rows), np.float32)
        for begin in range(0, len(rows), _CHUNK):
            part = slice(begin, begin + _CHUNK)
            cost[part] = self._pairs(rows[part], hypothesis[part], offset[part])
        return cost

    def _pairs(self, rows: np.ndarray, hypothesis: np.ndarray, offset: np.ndarray) -> Float[np.ndarray, "n"]:
        log_profile = rows["log_profile"].astype(np.float32)
        cost = _walls(log_profile - self.shifted[hypothesis, offset], self.precision[hypothesis])
        cost += self.room_costs(rows, offset)
        if self.compares_openings:
            cost += self._openings(rows, hypothesis)
        return cost

    @cached_property
    def shifted(self) -> Float[np.ndarray, "k j a"]:
        """Predicted log wall profile (m) under every hypothesis."""
        return self.centre[:, None] + self.offsets[None, :, None].astype(np.float32)

    def ceilings(self, ceiling_m: Float[np.ndarray, "n"]) -> Float[np.ndarray, "j n"]:
        """Return the cost of ceilings at some heights (m) under every hypothesis of the camera's height."""
        if self._query.ceiling is None or not self._config.use_ceiling:
            return np.zeros((len(self.offsets), len(ceiling_m)))
        return self._ceilings(self._query.ceiling, ceiling_m, self.offsets[:, None])

    @cached_property
    def room_types(self) -> Float[np.ndarray, "t"]:
        """Cost of each room type, by recognised objects if the query has some."""
        objects, predicted = self._query.objects, self._query.room_type
        weight = self._weights.room_type
        if objects is not None:
            predicted, weight = objects.room_type, 1.0 / self._weights.temperature
        if predicted is None or not self._config.use_room_type:
            return np.zeros(len(ROOM_TYPES))
        return weight * room_type_losses(predicted, self._config.floor)

    def room_costs(self, rows: np.ndarray, offset: np.ndarray) -> Float[np.ndarray, "n"]:
        """Return the cost of each prototype's room type and ceiling, and the penalty of its height hypothesis."""
        cost = self.penalty[offset] + self.room_types[rows["room_type"]]
        if self._query.ceiling is not None and self._config.use_ceiling:
            cost += self._ceilings(self._query.ceiling, rows["ceiling_m"].astype(np.float64), self.offsets[offset])
        return cost

    def _ceilings(self, predicted: PredictedCeiling, ceiling_m: np.ndarray, offset: np.ndarray) -> np.ndarray:
        clearance_m = ceiling_m - self._query.camera_height.height_m * np.exp(offset)
        return self._weights.ceiling * ceiling_costs(predicted, clearance_m, offset, self._weights.tail)

    def _openings(self, rows: np.ndarray, hypothesis: np.ndarray) -> Float[np.ndarray, "n"]:
        """Return the openings' term, by one table entry for every byte."""
        packed, cost = rows["openings"], np.zeros(len(rows), np.float32)
        for claims in np.unique(rows["claims"]).tolist():
            row = np.flatnonzero(rows["claims"] == claims)
            table, begin = self._byte_loss(claims), hypothesis[row] * packed.shape[1]
            for byte in range(packed.shape[1]):
                cost[row] += table[(begin + byte) * 256 + packed[row, byte]]
        return cost

    @property
    def compares_openings(self) -> bool:
        """True if the query has openings that are compared."""
        return self._query.openings is not None and self._config.use_openings

    def opening_loss(self, claims: int) -> Float[np.ndarray, "k a c"]:
        """Return the `opening_losses` of prototypes with some claims."""
        if claims not in self._opening_loss:
            (self._opening_loss[claims],) = self.opening_losses([claims], self.reach_m, _OPENINGS_SHARE)
        return self._opening_loss[claims]

    def opening_losses(self, claims: Sequence[int], reach_m: float, share: float) -> Float[np.ndarray, "m k a c"]:
        """Return the weighted cost of each opening class by claims, hypothesis and azimuth.

        The openings' term is the sum over the azimuths. There are m claims, see `prototypes.ROW`. Openings appear
        displaced by up to `reach_m`; their weight is a share of the matching cost's.
        """
        predicted = self._query.openings
        assert predicted is not None
        probability = np.exp(predicted.log_probability[:: self._every])
        spread = reach_m / median_distance_m(self.centre[0], self.precision[0])
        probability = smoothed(probability, spread)[:, self._columns]
        trusts = [*map(trust_of_claims, claims), [1.0] * _CLASSES]
        floor, appearance = self._config.floor, self._weights.appearance
        loss = np.stack(
            [class_losses(probability, predicted.prior, trust, floor, appearance) for trust in trusts]
        ).astype(np.float32)
        # Costs are relative to the best class for a plan that shows all openings.
        loss = loss[:-1] - loss[-1].min(axis=-1, keepdims=True)
        return loss * np.float32(share * self._weights.openings / AZIMUTHS)

    def _byte_loss(self, claims: int) -> Float[np.ndarray, "t"]:
        """Return sums of `opening_loss` over the four azimuths of a byte, by hypothesis, byte and its value."""
        if claims not in self._byte_losses:
            loss = self.opening_loss(claims).reshape(-1, PER_BYTE, _CLASSES)
            sums = sum(loss[:, i, _CLASSES_BY_BYTE[:, i]] for i in range(PER_BYTE))
            self._byte_losses[claims] = np.ascontiguousarray(sums).ravel()
        return self._byte_losses[claims]


def _offsets(query: Query) -> Float[np.ndarray, "j"]:
    """Return the logs of true over stated camera height that are tried."""
    tried = query.camera_height.offsets
    reach = float(tried[-1] - tried[0])
    if reach <= _OFFSET_SPACING * (1.0 + 1e-9):
        return np.array([0.5 * (tried[0] + tried[-1])])
    return np.linspace(tried[0], tried[-1], int(np.ceil(reach / _OFFSET_SPACING)) + 1)


def _walls(factor: Float[np.ndarray, "n a"], precision: Float[np.ndarray, "n a"]) -> Float[np.ndarray, "n"]:
    """Return the mean over azimuths of log(1 + r²); `factor` has log differences and is overwritten."""
    factor *= precision
    np.square(factor, out=factor)
    factor += 1.0
    return mean_log(factor, factors=_FACTORS, max_factor=_MAX_FACTOR)
