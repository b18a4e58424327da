"""Cost of prototypes: walls, openings, ceiling and room type as in `matching_cost.py`, but coarser.

There are 32 azimuths and as many hypotheses of the heading at most, and the reach is that of a grid as fine as the
prototypes. What is seen through openings is left out. A prototype may stand half a metre away from the camera, where
openings appear displaced, so these count for less. Kinds of openings that a plan does not claim are neither for nor
against it: in their place stands what an unknown class would cost, so that plans with and without openings can be
compared.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from lalaloc_core.conventions import OPENING_CLASSES, ROOM_TYPES, WALL_CODE
from lalaloc_core.localise.bundle import MatchingWeights
from lalaloc_core.localise.matching_cost import (
    MatchingConfig,
    ceiling_costs,
    mean_log,
    precisions,
    room_type_losses,
    smoothed,
)
from lalaloc_core.localise.poses import PredictedCeiling, Query
from lalaloc_core.localise.venue.prototypes import AZIMUTHS, PER_BYTE, STEPS, azimuths, unpacked_openings

# Camera heights whose logs are nearer than this are not told apart by prototypes, whose distances are farther off.
_OFFSETS_APART = 0.2
# What openings count, as a share of what they count where poses are half a step away.
_OPENINGS_SHARE = 0.6
# Pairs that are compared at a time, few enough to stay in the processor's cache.
_CHUNK = 1024
# Of so many factors, none above the limit, the product is taken before the logarithm.
_FACTORS, _MAX_FACTOR = 8, 1e4
_CLASSES = len(OPENING_CLASSES)
# All combinations of classes that a byte can say.
_BYTES = unpacked_openings(np.arange(256, dtype=np.uint8)[:, None])


class PrototypeCosts:
    """Compares prototypes with one query, each under hypotheses of the heading (k) and of the camera height (j).

    Attributes:
        penalty: (j,) what each height has against it, in units of the cost.
    """

    def __init__(self, query: Query, step_m: float, weights: MatchingWeights, config: MatchingConfig) -> None:
        assert query.profile is not None, "without a predicted profile there is nothing to compare prototypes with"
        self._query, self._weights, self._config = query, weights, config
        self._columns = azimuths(query.profile.log_m.shape[1])
        # Hypotheses between two azimuths of the prototypes tell nothing new.
        self._every = max(1, len(query.roll) // AZIMUTHS)
        self._reach_m = config.grid_reach * STEPS * step_m
        self.centre = query.profile.log_m[:: self._every, self._columns].astype(np.float32)
        self.precision = precisions(query, self._reach_m, config)[:: self._every, self._columns].astype(np.float32)
        self.offsets = _offsets(query)
        self.penalty = query.camera_height.penalty(self.offsets) / weights.temperature

    @property
    def shape(self) -> tuple[int, int]:
        """The numbers of hypotheses of the heading and of the height."""
        return len(self.centre), len(self.offsets)

    def of(
        self, rows: np.ndarray, hypothesis: Int[np.ndarray, "n"], offset: Int[np.ndarray, "n"]
    ) -> Float[np.ndarray, "n"]:
        """Return the cost of prototypes, each under one hypothesis of heading and height, by their numbers."""
        cost = np.empty(len(rows), np.float32)
        for begin in range(0, len(rows), _CHUNK):
            part = slice(begin, begin + _CHUNK)
            cost[part] = self._of(rows[part], hypothesis[part], offset[part])
        return cost

    def _of(self, rows: np.ndarray, hypothesis: np.ndarray, offset: np.ndarray) -> Float[np.ndarray, "n"]:
        log_profile = rows["log_profile"].astype(np.float32)
        cost = _walls(log_profile - self._shifted[hypothesis, offset], self.precision[hypothesis])
        cost += self._by_room(rows, offset)
        if self.opening_loss is not None:
            cost += self._openings(rows, hypothesis)
        return cost

    @cached_property
    def _shifted(self) -> Float[np.ndarray, "k j a"]:
        return self.centre[:, None] + self.offsets[None, :, None].astype(np.float32)

    def of_ceilings(self, ceiling_m: Float[np.ndarray, "n"]) -> Float[np.ndarray, "j n"]:
        """Return the cost of ceilings under every hypothesis of the camera's height."""
        if self._query.ceiling is None or not self._config.use_ceiling:
            return np.zeros((len(self.offsets), len(ceiling_m)))
        return self._ceilings(self._query.ceiling, ceiling_m, self.offsets[:, None])

    @cached_property
    def of_room_types(self) -> Float[np.ndarray, "t"]:
        """What types of rooms cost."""
        if self._query.room_type is None or not self._config.use_room_type:
            return np.zeros(len(ROOM_TYPES))
        return self._weights.room_type * room_type_losses(self._query.room_type, self._config)

    def _by_room(self, rows: np.ndarray, offset: np.ndarray) -> Float[np.ndarray, "n"]:
        cost = self.penalty[offset] + self.of_room_types[rows["room_type"]]
        if self._query.ceiling is not None and self._config.use_ceiling:
            cost += self._ceilings(self._query.ceiling, rows["ceiling_m"].astype(np.float64), self.offsets[offset])
        return cost

    def _ceilings(self, predicted: PredictedCeiling, ceiling_m: np.ndarray, offset: np.ndarray) -> np.ndarray:
        clearance_m = ceiling_m - self._query.camera_height.height_m * np.exp(offset)
        return self._weights.ceiling * ceiling_costs(predicted, clearance_m, offset, self._config)

    def _openings(self, rows: np.ndarray, hypothesis: np.ndarray) -> Float[np.ndarray, "n"]:
        table, packed = self._byte_losses, rows["openings"]
        begin = (rows["claims"].astype(np.intp) * len(self.centre) + hypothesis) * packed.shape[1]
        cost = np.zeros(len(rows), np.float32)
        for place in range(packed.shape[1]):
            cost += table[(begin + place) * 256 + packed[:, place]]
        return cost

    @cached_property
    def opening_loss(self) -> Float[np.ndarray, "m k a c"] | None:
        """Weighted cost of each class by azimuth and by what a plan claims, which has a bit for each class.

        Sums over the azimuths are costs. None where openings are not compared.
        """
        predicted = self._query.openings
        if predicted is None or not self._config.use_openings:
            return None
        floor = self._config.floor
        probability = np.exp(predicted.log_probability[:: self._every])
        probability = smoothed(probability, self._reach_m / float(np.exp(np.median(self.centre[0]))))
        probability = probability[:, self._columns]
        loss = np.empty((1 << _CLASSES, *probability.shape), np.float32)
        for claims in range(len(loss)):
            merged, prior = probability.copy(), predicted.prior.copy()
            for code in range(_CLASSES):
                if code != WALL_CODE and not claims >> code & 1:
                    merged[..., WALL_CODE] += merged[..., code]
                    prior[WALL_CODE] += prior[code]
            loss[claims] = -np.log(floor + (1.0 - floor) * merged / prior)
            for code in range(_CLASSES):
                if code != WALL_CODE and not claims >> code & 1:
                    loss[claims, ..., code] = loss[claims, ..., WALL_CODE]
        # The best that a plan could say which claims everything.
        loss -= loss[-1].min(axis=-1, keepdims=True)
        return loss * np.float32(_OPENINGS_SHARE * self._weights.openings / AZIMUTHS)

    @cached_property
    def _byte_losses(self) -> Float[np.ndarray, "t"]:
        """`opening_loss` of four azimuths at a time, by claims, hypothesis, byte and what the byte says."""
        assert self.opening_loss is not None
        loss = self.opening_loss.reshape(-1, PER_BYTE, _CLASSES)
        return np.ascontiguousarray(sum(loss[:, place, _BYTES[:, place]] for place in range(PER_BYTE))).ravel()


def _offsets(query: Query) -> Float[np.ndarray, "j"]:
    """Return the logs of true over stated camera height that are tried."""
    tried = query.camera_height.offsets
    reach = float(tried[-1] - tried[0])
    if reach <= _OFFSETS_APART * (1.0 + 1e-9):
        return np.array([0.5 * (tried[0] + tried[-1])])
    return np.linspace(tried[0], tried[-1], int(np.ceil(reach / _OFFSETS_APART)) + 1)


def _walls(factor: Float[np.ndarray, "n a"], precision: Float[np.ndarray, "n a"]) -> Float[np.ndarray, "n"]:
    """Mean log of 1 + r² by azimuth, of differences, which are overwritten."""
    factor *= precision
    np.square(factor, out=factor)
    factor += 1.0
    return mean_log(factor, factors=_FACTORS, max_factor=_MAX_FACTOR)
