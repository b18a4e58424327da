"""Exact cost of prototypes: walls, openings, ceiling and room type as in `matching_cost.py`, but coarser.

Differences to the matching cost of grid poses:

* There are 32 azimuths, and at most 32 hypotheses of the heading.
* The reach is that of a grid with the prototypes' spacing.
* Walls that are seen through openings are ignored.
* Openings have less weight, as they appear displaced from a prototype up to half a metre away from the camera.
  `PrototypeAlignment` solves for the displacement.
* The openings' term is relative to the best class of a plan that shows all openings, so that plans with different
  trusts in their openings can be compared. Trusts have four levels.
"""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from lalaloc_core.bundle import MatchingWeights
from lalaloc_core.conventions import OPENING_CLASSES, ROOM_TYPES, TWO_PI, column_azimuths
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
from lalaloc_core.localise.venue.prototypes import AZIMUTHS, PER_BYTE, azimuths, trust_of_claims, unpacked_openings

# Distance of neighbouring prototypes in grid steps: the diagonal of a chessboard square.
_GRID_STEPS = math.sqrt(2.0)
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
# Reaches of the two steps and of the comparison, as shares of the prototypes' reach.
_STEPS, _COMPARISON = (1.0, 0.7), 0.5
# Maximum displacement in reaches, as walls farther away are hidden by others.
_MAX_REACHES = 1.5
# Maximum slope: walls seen at less than 14 degrees have too few azimuths to measure it.
_MAX_SLOPE = 4.0
# Pairs aligned at a time, few enough to stay in the processor's cache.
_ALIGNED_CHUNK = 512


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
        self.reach_m = config.grid_reach * _GRID_STEPS * step_m
        self.centre = query.profile.log_m[:: self._every, self._columns].astype(np.float32)
        self.precision = self.precisions(self.reach_m)
        self.offsets = _offsets(query)
        # Losses of openings by the arguments of `opening_loss`; a venue has few claims.
        self._opening_loss: dict[tuple[int, float, float], np.ndarray] = {}
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

    def opening_loss(
        self, claims: int, reach: float = 1.0, share: float = _OPENINGS_SHARE
    ) -> Float[np.ndarray, "k a c"]:
        """Return the weighted cost of each opening class by hypothesis and azimuth, for claims of `prototypes.ROW`.

        The openings' term is the sum over the azimuths. Openings appear displaced by up to `reach` times the reach of
        prototypes; their weight is a share of the matching cost's.
        """
        key = claims, reach, share
        if key not in self._opening_loss:
            predicted = self._query.openings
            assert predicted is not None
            probability = np.exp(predicted.log_probability[:: self._every])
            spread = reach * self.reach_m / median_distance_m(self.centre[0], self.precision[0])
            probability = smoothed(probability, spread)[:, self._columns]
            floor, appearance = self._config.floor, self._weights.appearance
            loss, shown = (
                class_losses(probability, predicted.prior, trust, floor, appearance).astype(np.float32)
                for trust in (trust_of_claims(claims), [1.0] * _CLASSES)
            )
            # Costs are relative to the best class for a plan that shows all openings.
            loss = loss - shown.min(axis=-1, keepdims=True)
            self._opening_loss[key] = loss * np.float32(share * self._weights.openings / AZIMUTHS)
        return self._opening_loss[key]

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


class PrototypeAlignment:
    """Alignment of pairs of a prototype and a hypothesis for one query: their cost at the best pose nearby.

    The camera is up to half a metre from the nearest prototype, and its heading between two hypotheses, so the cost of
    a prototype tolerates differences of that size, and many plans fit. Alignment solves for the four unknowns u: the
    displacement (x, y) from the prototype, the turn from the hypothesis, and the log of the camera height from its
    hypothesis. The log wall profile of a displaced camera follows from the prototype's own, because the visible walls
    have slopes g = ∂ log d / ∂ azimuth:

        log d' = log d + J u    J_xy = (g t - s) / d    J_turn = g    J_height = -1

    with the ray's direction s = (sin a, cos a) and t = (cos a, -sin a) at right angles to it. Two Gauss-Newton steps
    lower `T walls(u) + ½ sum (u / σ)²`, where σ is the reach of prototypes, and the spread between neighbouring
    hypotheses. A ray of the displaced camera meets the wall that the prototype sees at the azimuth
    a + t·(x, y) / d + turn, and shows the opening class there. After alignment, walls and openings are compared with
    half of the reach, and openings with their full weight.
    """

    def __init__(self, costs: PrototypeCosts) -> None:
        self._costs = costs
        reach_m = costs.reach_m
        self._precisions = [costs.precisions(share * reach_m) for share in (*_STEPS, _COMPARISON)]
        self._max_m = _MAX_REACHES * reach_m
        azimuth = costs.azimuths
        self._along = np.stack([np.sin(azimuth), np.cos(azimuth)]).astype(np.float32)
        self._across = np.stack([np.cos(azimuth), -np.sin(azimuth)]).astype(np.float32)
        sigma = np.array([reach_m, reach_m, costs.sector / math.sqrt(12.0), costs.height_spread])
        # Unknowns that the query states exactly are left out.
        self._free = np.flatnonzero(sigma > 0.0)
        self._stiffness = (1.0 / np.square(sigma[self._free])).astype(np.float32)

    def pairs(
        self, rows: np.ndarray, hypothesis: Int[np.ndarray, "n"], offset: Int[np.ndarray, "n"]
    ) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n 4"]]:
        """Align prototypes, each under one hypothesis; the arguments are as in `PrototypeCosts.pairs`.

        Returns the costs at the aligned poses, with the prior of the unknowns; and the unknowns: x, y (m), turn
        (radians) and log height, 0 for those that the query states exactly.
        """
        cost, unknowns = np.empty(len(rows), np.float32), np.zeros((len(rows), 4), np.float32)
        for begin in range(0, len(rows), _ALIGNED_CHUNK):
            part = slice(begin, begin + _ALIGNED_CHUNK)
            cost[part], unknowns[part, self._free] = self._pairs(rows[part], hypothesis[part], offset[part])
        return cost, unknowns

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
            row, loss = np.flatnonzero(rows["claims"] == claims), self._costs.opening_loss(claims, _COMPARISON, 1.0)
            cost[row] = loss[hypothesis[row, None], np.arange(AZIMUTHS), kind[row]].sum(axis=1)
        return cost


def _slopes(log_m: Float[np.ndarray, "n a"]) -> Float[np.ndarray, "n a"]:
    """Return the slopes of log wall profiles by azimuth: the smaller one of both sides, 0 at corners and edges."""
    after = (np.roll(log_m, -1, axis=1) - log_m) * np.float32(AZIMUTHS / TWO_PI)
    before = np.roll(after, 1, axis=1)
    smaller = np.where(np.abs(after) < np.abs(before), after, before)
    return np.clip(np.where(after * before > 0.0, smaller, np.float32(0.0)), -_MAX_SLOPE, _MAX_SLOPE)
