"""How badly a pose fits a panorama: the sum of what its walls, openings, ceiling and room say.

Every term is a negative log likelihood per azimuth, up to constants, and hardly above 0 where the picture fits as well
as can be. Neighbouring azimuths err alike, so each term has a weight that says how much it may count, fitted on
validation queries (`lalaloc_core.evaluate.calibrate`), and is in units of the walls':

    cost(pose, δ) = walls + β_o openings + β_c ceiling + β_t room type + penalty(δ) / T

* **Walls.** The picture gives a log wall profile μ and, for every azimuth w, a scale b. With the heavy tails of a
  Cauchy distribution `mean_w log(1 + r_w²)`, `r_w = (log d_w - μ_w - δ) / (κ s_w)`, `s_w² = b_w² + (reach / exp μ_w)²`,
  the tail factor κ, and the `reach`: how far (m) the pose may lie from the camera even if it is the best looked at.
  Where the plan has a door or a passage, 1 / (1 + r²) is that for the distance d to the opening, plus that for what
  lies behind it times the odds that the network looked through, and at most 1.
* **Openings.** `mean_w log(max_c q_w(c) / q_w(c_w))`, `q_w(c) = ε + (1 - ε) p_w(c) / π(c)`: the probability of the
  class that the plan shows, in units of how frequent the class is. Kinds that the plan does not claim are wall.
* **Ceiling.** `log(1 + r²)` of the log height of the room's ceiling above the camera.
* **Room type.** As openings, once.

A weighted latent distance may be added. Models that predict no wall profile are compared by latent distance alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8

from lalaloc_core.conventions import OPENING_CLASSES, PASSAGE_CODE, ROOM_TYPES, TWO_PI, WALL_CODE
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.bundle import MatchingWeights
from lalaloc_core.localise.layouts import Layouts
from lalaloc_core.localise.poses import PredictedCeiling, PredictedRoomType, Query

# A prediction is never trusted beyond this: the scale of log distance of a centimetre at ten metres.
_MIN_SCALE = 1e-3
# A predicted ceiling height is never trusted beyond this, as plans round their ceilings.
_MIN_CEILING_SCALE = 0.04
_MIN_CLEARANCE_M = 0.05
# Logarithms are dear: of so many factors, none above the limit, the product is taken before.
_FACTORS, _MAX_FACTOR = 4, 1e9
# Poses whose openings are compared at a time, to bound memory; pairs, few enough to stay in the processor's cache.
_CHUNK = 512


@dataclass(frozen=True, kw_only=True)
class MatchingConfig:
    """What poses are compared by.

    Attributes:
        use_profile: compare wall profiles where the model predicts them; else latents alone.
        use_openings, use_ceiling, use_room_type, use_see_through: leave a term out even where model and plan have it.
        latent_weight: weight of the latent distance in the cost of a profile.
        tail: κ.
        grid_reach: reach on a grid, in units of its step; cameras are at most 0.7 of it from the nearest pose.
        fine_reach_m: reach of poses that were re-sampled or optimised.
        open_door, open_passage: probability that the prediction is of what lies behind a door or a passage, which the
            network should look at as wall.
        floor: ε, the probability that what is said of a class is worth nothing.
        heading_doubt: probability that a heading that is said to be known is wrong altogether.
    """

    use_profile: bool = True
    use_openings: bool = True
    use_ceiling: bool = True
    use_room_type: bool = True
    use_see_through: bool = True
    latent_weight: float = 0.0
    tail: float = 3.0
    grid_reach: float = 0.6
    fine_reach_m: float = 0.07
    open_door: float = 0.05
    open_passage: float = 0.1
    floor: float = 0.03
    heading_doubt: float = 0.02

    def compares_profiles(self, query: Query) -> bool:
        """Whether this query's poses are compared by their wall profiles."""
        return self.use_profile and query.profile is not None


class Terms(NamedTuple):
    """What each term says of some poses, each (n,), not weighted; `height` is δ's penalty."""

    walls: Float[np.ndarray, "n"]
    openings: Float[np.ndarray, "n"]
    ceiling: Float[np.ndarray, "n"]
    room_type: Float[np.ndarray, "n"]
    height: Float[np.ndarray, "n"]

    def total(self, weights: MatchingWeights) -> Float[np.ndarray, "n"]:
        """The cost: terms by their weights."""
        return (
            self.walls
            + weights.openings * self.openings
            + weights.ceiling * self.ceiling
            + weights.room_type * self.room_type
            + self.height / weights.temperature
        )


class _Shown(NamedTuple):
    log_profile: Float[np.ndarray, "m w"]
    room_index: Int[np.ndarray, "m"]
    kind_at: Int[np.ndarray, "m w"] | None
    row: Int[np.ndarray, "e"]
    column: Int[np.ndarray, "e"]
    log_behind: Float[np.ndarray, "e"]
    odds: Float[np.ndarray, "e"]
    place: Int[np.ndarray, "e"]


class MatchingCost:
    """Compares poses of one plan with one query.

    Args:
        reach_m: how far (m) the poses may lie from the camera.
        weights: of the terms, from the model's bundle.
        stride: compare every `stride`th azimuth alone.
    """

    def __init__(
        self,
        plan: FloorPlan,
        query: Query,
        reach_m: float,
        weights: MatchingWeights,
        config: MatchingConfig,
        *,
        stride: int = 1,
    ) -> None:
        assert query.profile is not None, "without a predicted profile poses are compared by their latents"
        self._plan, self._query, self._reach_m = plan, query, reach_m
        self._weights, self._config, self._stride = weights, config, stride
        self._centre = query.profile.log_m[:, ::stride].astype(np.float32)
        self._precision = precisions(query, reach_m, config)[:, ::stride].astype(np.float32)

    def costs(
        self, layouts: Layouts, hypotheses: Int[np.ndarray, "k"] | None = None
    ) -> tuple[Float[np.ndarray, "k n"], Float[np.ndarray, "k n"]]:
        """Return the cost of every pose under some hypotheses of the heading (all), and the δ that gives it."""
        hypotheses = np.arange(self.hypotheses) if hypotheses is None else hypotheses
        layouts = layouts.thinned(self._stride) if self._stride > 1 else layouts
        cost = np.empty((len(hypotheses), len(layouts)), np.float32)
        chosen = np.empty(cost.shape, np.intp)
        for first in range(0, len(layouts), _CHUNK):
            part = slice(first, first + _CHUNK)
            shown = self._shown(layouts, np.arange(len(layouts))[part])
            for row, hypothesis in enumerate(hypotheses):
                cost[row, part], chosen[row, part] = self._best(shown, hypothesis[None])
        return cost, self.offsets[chosen]

    def pairs(
        self, layouts: Layouts, pose: Int[np.ndarray, "m"], hypothesis: Int[np.ndarray, "m"]
    ) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m"]]:
        """Return the cost of some pairs of a pose and a hypothesis, and the δ that gives it."""
        cost, chosen = np.empty(len(pose), np.float32), np.empty(len(pose), np.intp)
        for first in range(0, len(pose), _CHUNK):
            part = slice(first, first + _CHUNK)
            cost[part], chosen[part] = self._best(self._shown(layouts, pose[part]), hypothesis[part])
        return cost, self.offsets[chosen]

    def terms(self, layouts: Layouts, hypothesis: Int[np.ndarray, "n"], offset: Float[np.ndarray, "n"]) -> Terms:
        """What each term says of poses that each have their own hypothesis and δ."""
        every = np.arange(len(layouts))
        shown = self._shown(layouts, every)
        return Terms(
            walls=self._walls(shown, hypothesis, offset[None])[0].astype(np.float64),
            openings=self._openings(shown, hypothesis).astype(np.float64),
            ceiling=self._ceilings(offset)[every, layouts.room_index],
            room_type=self._room_types[layouts.room_index],
            height=self._query.camera_height.penalty(offset),
        )

    @property
    def hypotheses(self) -> int:
        """How many there are."""
        return len(self._centre)

    @property
    def offsets(self) -> Float[np.ndarray, "j"]:
        """The δ that are tried."""
        return self._query.camera_height.offsets

    @cached_property
    def _room_costs(self) -> Float[np.ndarray, "j r"]:
        return self.by_room()

    def by_room(self) -> Float[np.ndarray, "j r"]:
        """What δ and the room alone cost: the height's penalty, the ceiling and the room's type."""
        penalty = self._query.camera_height.penalty(self.offsets)[:, None] / self._weights.temperature
        types = self._weights.room_type * self._room_types
        return (penalty + self._weights.ceiling * self._ceilings(self.offsets) + types).astype(np.float32)

    def predicted(
        self, columns: Int[np.ndarray, "a"]
    ) -> tuple[Float[np.ndarray, "k a"], Float[np.ndarray, "k a"], Float[np.ndarray, "k a c"] | None]:
        """What is compared at some azimuths: centres, precisions, and the weighted cost of every class of opening.

        The latter is None where openings are not compared; kinds that the plan does not claim cost what walls do.
        """
        loss = self._claimed_loss
        loss = None if loss is None else self._weights.openings * loss[:, columns]
        return self._centre[:, columns], self._precision[:, columns], loss

    def shut_share(self, layouts: Layouts, index: int, hypothesis: int, offset: float) -> Float[np.ndarray, "w"]:
        """Probability by azimuth that a pose's walls are met, and not what lies behind an opening in them."""
        share = np.ones(self._centre.shape[1])
        row = layouts.rows(np.array([index]))
        if row.seen is None or not self._config.use_see_through:
            return share
        at = row.seen.column
        centre, precision = self._centre[hypothesis, at] + offset, self._precision[hypothesis, at]
        shut = 1.0 / (1.0 + np.square((row.log_profile[0, at] - centre) * precision))
        opened = self._open_odds(row.seen.kind) / (1.0 + np.square((row.seen.log_behind - centre) * precision))
        share[at] = shut / (shut + opened)
        return share

    def _shown(self, layouts: Layouts, pose: Int[np.ndarray, "m"]) -> _Shown:
        seen = layouts.seen if self._config.use_see_through else None
        row = column = np.empty(0, int)
        log_behind = odds = np.empty(0, np.float32)
        if seen is not None:
            row, entry = seen.of(pose)
            column, log_behind, odds = seen.column[entry], seen.log_behind[entry], self._open_odds(seen.kind[entry])
        return _Shown(
            log_profile=layouts.log_profile[pose].astype(np.float32, copy=False),
            room_index=layouts.room_index[pose],
            kind_at=None
            if layouts.kind is None
            else layouts.kind[pose] + np.arange(layouts.kind.shape[1]) * len(OPENING_CLASSES),
            row=row,
            column=column,
            log_behind=log_behind,
            odds=odds,
            place=row * layouts.log_profile.shape[1] + column,
        )

    def _best(
        self, shown: _Shown, hypothesis: Int[np.ndarray, "#m"]
    ) -> tuple[Float[np.ndarray, "m"], Int[np.ndarray, "m"]]:
        """Return the cost of poses, each under one hypothesis, at the best δ, and the number of that δ."""
        cost = self._walls(shown, hypothesis, self.offsets[:, None])
        cost += self._room_costs[:, shown.room_index]
        return cost.min(axis=0) + self._weights.openings * self._openings(shown, hypothesis), cost.argmin(axis=0)

    def _walls(
        self, shown: _Shown, hypothesis: Int[np.ndarray, "#m"], offset: Float[np.ndarray, "j #m"]
    ) -> Float[np.ndarray, "j m"]:
        precision, offset = self._precision[hypothesis], offset.astype(np.float32)
        apart = shown.log_profile - self._centre[hypothesis]
        apart *= precision
        columns = apart.shape[1]
        at = np.broadcast_to(hypothesis * columns, len(apart))[shown.row] + shown.column
        sharp = self._precision.take(at)
        behind = (shown.log_behind - self._centre.take(at)) * sharp
        seen_offset = offset if offset.shape[1] == 1 else offset[:, shown.row]
        cost = np.empty((len(offset), len(apart)), np.float32)
        for j in range(len(offset)):
            # The last δ overwrites the differences.
            factor = np.subtract(apart, offset[j][:, None] * precision, out=apart if j == len(offset) - 1 else None)
            np.square(factor, out=factor)
            factor += 1.0
            if len(shown.place):
                beyond = np.square(behind - seen_offset[j] * sharp) + 1.0
                # A wall that fits costs nothing, even if it is a door: networks learn to see the wall there.
                either = np.maximum(1.0 / (1.0 / factor.take(shown.place) + shown.odds / beyond), 1.0)
                factor.put(shown.place, either)
            cost[j] = mean_log(factor)
        return cost

    def _openings(self, shown: _Shown, hypothesis: Int[np.ndarray, "#m"]) -> Float[np.ndarray, "m"]:
        loss = self._claimed_loss
        if loss is None or shown.kind_at is None:
            return np.zeros(len(shown.room_index), np.float32)
        columns, classes = loss.shape[1:]
        at = hypothesis[:, None] * (columns * classes) + shown.kind_at
        return loss.take(at).mean(axis=1)

    def _open_odds(self, kind: UInt8[np.ndarray, "m"]) -> Float[np.ndarray, "m"]:
        """Odds that one looks through openings of some kinds."""
        is_passage = kind == PASSAGE_CODE
        open_share = np.where(is_passage, self._config.open_passage, self._config.open_door).astype(np.float32)
        return open_share / (1.0 - open_share)

    @cached_property
    def _claimed(self) -> list[int]:
        """Codes of the kinds of openings that the plan shows completely."""
        return [OPENING_CLASSES.index(kind) for kind in sorted(self._plan.opening_kinds)]

    @cached_property
    def _claimed_loss(self) -> Float[np.ndarray, "k w c"] | None:
        """As `_opening_loss` of all hypotheses, where kinds that the plan does not claim cost what walls do."""
        loss = self._opening_loss(np.arange(self.hypotheses))
        if loss is not None:
            unclaimed = [code for code in range(len(OPENING_CLASSES)) if code not in self._claimed]
            loss[..., unclaimed] = loss[..., [WALL_CODE]]
        return loss

    def _opening_loss(self, hypotheses: Int[np.ndarray, "k"]) -> Float[np.ndarray, "k w c"] | None:
        """Cost of each class by azimuth; None where openings are not compared."""
        predicted = self._query.openings
        if predicted is None or not self._claimed or not self._config.use_openings:
            return None
        probability, prior = np.exp(predicted.log_probability[hypotheses]), predicted.prior.copy()
        for code in range(len(OPENING_CLASSES)):
            if code != WALL_CODE and code not in self._claimed:
                probability[..., WALL_CODE] += probability[..., code]
                prior[WALL_CODE] += prior[code]
        probability = smoothed(probability, self._spread)
        possible = [WALL_CODE, *self._claimed]
        loss = -np.log(self._config.floor + (1.0 - self._config.floor) * probability / prior)
        loss -= loss[..., possible].min(axis=-1, keepdims=True)
        return np.ascontiguousarray(loss[:, :: self._stride], np.float32)

    @property
    def _spread(self) -> float:
        """How far (radians) openings may appear from where a pose has them: by the reach, at a usual distance."""
        return float(self._reach_m / np.exp(np.median(self._centre[0])))

    @cached_property
    def _room_types(self) -> Float[np.ndarray, "r"]:
        """Cost of the type of every room; rooms of unknown type cost what says nothing."""
        predicted = self._query.room_type
        if predicted is None or not self._config.use_room_type:
            return np.zeros(len(self._plan.rooms))
        losses = room_type_losses(predicted, self._config)
        return losses[[ROOM_TYPES.index(room.type) for room in self._plan.rooms]]

    def _ceilings(self, offset: Float[np.ndarray, "j"]) -> Float[np.ndarray, "j r"]:
        """Cost of every room's ceiling at each δ."""
        predicted, height = self._query.ceiling, self._query.camera_height
        if predicted is None or not self._config.use_ceiling:
            return np.zeros((len(offset), len(self._plan.rooms)))
        clearance_m = self._plan.ceiling_heights_m[None] - height.height_m * np.exp(offset)[:, None]
        return ceiling_costs(predicted, clearance_m, offset[:, None], self._config)


def precisions(query: Query, reach_m: float, config: MatchingConfig) -> Float[np.ndarray, "k w"]:
    """1 / (κ s), which differences of log distance are multiplied with, for every hypothesis."""
    assert query.profile is not None
    scale = np.maximum(np.exp(query.profile.log_scale), _MIN_SCALE)
    return 1.0 / (config.tail * np.hypot(scale, reach_m * np.exp(-query.profile.log_m)))


def ceiling_costs(
    predicted: PredictedCeiling,
    clearance_m: Float[np.ndarray, "*#n"],
    offset: Float[np.ndarray, "*#n"],
    config: MatchingConfig,
) -> Float[np.ndarray, "*n"]:
    """Cost of ceilings that are so far (m) above the camera, each at a δ."""
    difference = np.log(np.maximum(clearance_m, _MIN_CLEARANCE_M)) - (predicted.log_m + offset)
    scale = config.tail * np.hypot(np.exp(predicted.log_scale), _MIN_CEILING_SCALE)
    return np.log1p(np.square(difference / scale))


def room_type_losses(predicted: PredictedRoomType, config: MatchingConfig) -> Float[np.ndarray, "t"]:
    """Cost of every type of room; the unknown type costs what says nothing."""
    ratio = config.floor + (1.0 - config.floor) * np.exp(predicted.log_probability) / np.maximum(predicted.prior, 1e-4)
    loss = np.log(ratio[1:].max()) - np.log(np.concatenate([[1.0], ratio[1:]]))
    return np.maximum(loss, 0.0)


def latent_distances(latents: Float[np.ndarray, "n d"], targets: Float[np.ndarray, "k d"]) -> Float[np.ndarray, "k n"]:
    """Euclidean distance of each target to each latent, both of unit length."""
    return np.sqrt(np.maximum(2.0 - 2.0 * (targets @ latents.T), 0.0))


def mean_log(
    factor: Float[np.ndarray, "n w"], *, factors: int = _FACTORS, max_factor: float = _MAX_FACTOR
) -> Float[np.ndarray, "n"]:
    """Mean of the logarithms of each row, of values from 1 on, which are overwritten.

    Args:
        factors: of so many the product is taken before the logarithm, if they divide the columns.
        max_factor: larger ones count as this, so that products stay finite.
    """
    columns = factor.shape[1]
    if columns % factors:
        return np.log(factor).mean(axis=1)
    np.minimum(factor, max_factor, out=factor)
    width = columns // factors
    product = factor[:, :width].copy()
    for begin in range(width, columns, width):
        product *= factor[:, begin : begin + width]
    return np.log(product).sum(axis=1) / columns


def smoothed(probability: Float[np.ndarray, "k w c"], spread: float) -> Float[np.ndarray, "k w c"]:
    """Probabilities by azimuth, blurred around the horizon by a Gaussian with a deviation of `spread` radians."""
    columns = probability.shape[1]
    deviation = spread / TWO_PI * columns
    if deviation < 0.3:
        return probability
    offset = (np.arange(columns) + columns // 2) % columns - columns // 2
    kernel = np.exp(-0.5 * np.square(offset / deviation))
    kernel = (kernel / kernel.sum())[(np.arange(columns)[:, None] - np.arange(columns)[None]) % columns]
    # One product of matrices, not one for each hypothesis.
    blurred = kernel @ probability.transpose(1, 0, 2).reshape(columns, -1)
    return blurred.reshape(columns, len(probability), -1).transpose(1, 0, 2)
