"""Matching cost: how badly a pose fits a photograph, by its walls, openings, ceiling and room type.

Every term is a negative log likelihood per azimuth, up to constants, and close to 0 for a perfect fit. The errors of
neighbouring azimuths are correlated, so each term has a weight in units of the walls', fitted on validation queries
(`lalaloc_core.evaluate.calibrate`):

    cost(pose, δ) = walls + β_o openings + β_c ceiling + β_t room type + (objects + penalty(δ)) / T

* **Walls.** The image encoder predicts a log wall profile μ and a scale b for every azimuth w. The term has the heavy
  tails of a Cauchy distribution: `mean_w log(1 + r_w²)`, with `r_w = (log d_w - μ_w - δ) / (κ s_w)` and `s_w² = b_w² +
  (reach / exp μ_w)²`. κ (`MatchingWeights.tail`) is chosen on validation queries, δ is the log of true over stated
  camera height, and `reach` the distance (m) from the camera within which the best of the compared poses lies. At a
  door or passage the prediction can be of the wall behind it. `1 / (1 + r²)` is then replaced by `min(1, 1 / (1 + r²) +
  o / (1 + r'²))`, with r' for the wall behind and o for the odds that the prediction is of that wall. Likewise for a
  model that predicts a second mode, with r' for that mode and o for its odds. Azimuths that the photograph does not
  show have an infinite b and cost nothing.
* **Openings.** `mean_w log(max_c q_w(c) / q_w(c_w))` for the class c_w that the plan shows, with
  `q_w(c) = ε + (1 - ε) sum_{s,k} a(s | k) m(k | c) p_w(s) / π(s)`: the predicted probability p of seeing the class s,
  over its frequency π. a is the probability that a class looks like another (`MatchingWeights.appearance`): an open
  door looks like a passage, a patio door like a window. m is the probability that the class k is where the plan draws
  c. The plan draws a share t_c of the openings of a kind (`FloorPlan.opening_trust`; t = 0 for walls), and as many that
  do not exist as it misses: m(k | c) = t_c [k = c] + (1 - t_c) m(k), with m(k) ∝ π(k) (1 - t_k) where no opening is
  drawn. Merged plans keep their trusts: constants make the expected losses at the right pose equal (`opening_losses`).
* **Ceiling.** `log(1 + r²)` of the log height of the room's ceiling above the camera.
* **Room type.** As openings, once per room. A room with several types has the mean likelihood of these.
* **Objects.** As the room type, by the objects that a classifier of photographs recognises. It replaces the room type,
  because encoders that learnt from renderings do not recognise real rooms, and is an unweighted log likelihood.

`MatchingConfig.latent_weight` adds a latent distance. Models that predict no wall profile use latent distance alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from lalaloc_core.bundle import MatchingWeights
from lalaloc_core.conventions import OPENING_CLASSES, PASSAGE_CODE, TWO_PI
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.match.cost_terms import (
    SeenWalls,
    WallMode,
    ceiling_costs,
    losses_of_rooms,
    mean_log,
    median_distance_m,
    opening_losses,
    room_type_losses,
    smoothed,
)
from lalaloc_core.localise.match.pose_grid import Layouts
from lalaloc_core.localise.query import PredictedRoomType, Query

# Pairs compared at a time, few enough to stay in the processor's cache.
_CHUNK = 512


@dataclass(frozen=True, kw_only=True)
class MatchingConfig:
    """Settings of the matching cost.

    Attributes:
        use_profile: compare wall profiles if the model predicts them; else latents alone.
        use_openings, use_ceiling, use_room_type, use_see_through: switches of terms that model and plan provide.
        latent_weight: weight of the latent distance in the cost.
        grid_reach: reach of grid poses, in units of the grid's step; cameras are at most 0.7 from the nearest pose.
        fine_reach_m: reach of re-sampled and refined poses.
        open_door, open_passage: probability that the prediction is of the wall behind a door or a passage.
        floor: ε, the probability that a predicted class is noise.
        heading_doubt: probability that a given heading is wrong.
    """

    use_profile: bool = True
    use_openings: bool = True
    use_ceiling: bool = True
    use_room_type: bool = True
    use_see_through: bool = True
    latent_weight: float = 0.0
    grid_reach: float = 0.6
    fine_reach_m: float = 0.07
    open_door: float = 0.05
    open_passage: float = 0.1
    floor: float = 0.03
    heading_doubt: float = 0.02

    def compares_profiles(self, query: Query) -> bool:
        """Return whether this query's poses are compared by their wall profiles."""
        return self.use_profile and query.profile is not None


class Terms(NamedTuple):
    """Unweighted terms of the cost of some poses, each (n,); `height` is δ's penalty.

    `objects` and `height` are log likelihoods, the others by azimuth.
    """

    walls: Float[np.ndarray, "n"]
    openings: Float[np.ndarray, "n"]
    ceiling: Float[np.ndarray, "n"]
    room_type: Float[np.ndarray, "n"]
    objects: Float[np.ndarray, "n"]
    height: Float[np.ndarray, "n"]

    def total(self, weights: MatchingWeights) -> Float[np.ndarray, "n"]:
        """Return the cost: the weighted sum of the terms."""
        return (
            self.walls
            + weights.openings * self.openings
            + weights.ceiling * self.ceiling
            + weights.room_type * self.room_type
            + (self.objects + self.height) / weights.temperature
        )


class _Gathered(NamedTuple):
    """Layouts of m poses, ready to be compared.

    `opening` is the place of each azimuth's class in w x c losses of its trust. The e azimuths `pose`, `column` show a
    wall through an opening: `log_behind` is the log distance (m) of the wall behind, and `odds` those that the
    prediction is of that wall.
    """

    log_profile: Float[np.ndarray, "m w"]
    opening: Int[np.ndarray, "m w"] | None
    room_index: Int[np.ndarray, "m"]
    pose: Int[np.ndarray, "e"]
    column: Int[np.ndarray, "e"]
    log_behind: Float[np.ndarray, "e"]
    odds: Float[np.ndarray, "e"]


class MatchingCost:
    """Matching cost of the poses of one plan for one query.

    The query must have a predicted wall profile. `reach_m` is the distance from the camera within which the best of the
    poses lies. Only azimuths whose column is a multiple of `stride` are compared.
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
        first, rival = query.profile, query.profile.rival
        modes = [(first.log_m, first.log_scale, np.ones_like(first.log_m))]
        modes += [] if rival is None else [(rival.log_m, rival.log_scale, rival.odds)]
        # Hypotheses are mostly one prediction, turned, of which everything is computed once.
        values = np.array(modes).reshape(-1, *first.log_m.shape).transpose(1, 2, 0)
        self._turned = self._turned_columns(values) if stride == 1 else None
        own, rest = slice(None if self._turned is None else 1), (reach_m, weights.tail, stride)
        self._turning = [WallMode.of(log_m[own], scale[own], odds[own], *rest) for log_m, scale, odds in modes]
        self._modes = [mode if self._turned is None else mode.turned(self._turned) for mode in self._turning]
        self._first = self._modes[0]

    def costs(
        self, layouts: Layouts, hypotheses: Int[np.ndarray, "k"] | None = None
    ) -> tuple[Float[np.ndarray, "k n"], Float[np.ndarray, "k n"]]:
        """Return the cost of every pose under some hypotheses of the heading (default: all), and the best δ of each."""
        hypotheses = np.arange(self.hypotheses) if hypotheses is None else hypotheses
        layouts = layouts.thinned(self._stride) if self._stride > 1 else layouts
        cost = np.empty((len(hypotheses), len(layouts)), np.float32)
        best = np.empty(cost.shape, np.intp)
        for first in range(0, len(layouts), _CHUNK):
            part = slice(first, first + _CHUNK)
            gathered = self._gathered(layouts, np.arange(len(layouts))[part])
            for row, hypothesis in enumerate(hypotheses):
                cost[row, part], best[row, part] = self._compared(gathered, hypothesis[None])
        return cost, self.offsets[best]

    def pairs(
        self, layouts: Layouts, pose: Int[np.ndarray, "m"], hypothesis: Int[np.ndarray, "m"]
    ) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m"]]:
        """Return the cost of some pairs of a pose and a hypothesis, and the best δ of each."""
        cost, best = np.empty(len(pose), np.float32), np.empty(len(pose), np.intp)
        for first in range(0, len(pose), _CHUNK):
            part = slice(first, first + _CHUNK)
            cost[part], best[part] = self._compared(self._gathered(layouts, pose[part]), hypothesis[part])
        return cost, self.offsets[best]

    def by_azimuth(self, layouts: Layouts) -> Float[np.ndarray, "k n w"]:
        """Return the cost of walls and openings of every pose at each azimuth under every hypothesis, at δ = 0.

        The means over the azimuths are costs without those of rooms. For photographs that show all around.
        """
        gathered = self._gathered(layouts, np.arange(len(layouts)))
        cost = np.empty((self.hypotheses, *gathered.log_profile.shape), np.float32)
        for number in range(self.hypotheses):
            hypothesis = np.array([number])
            (factor,) = self._factors(gathered, hypothesis, np.zeros((1, 1), np.float32))
            np.log(factor, out=cost[number])
            cost[number] += self._weights.openings * self._openings(gathered, hypothesis)
        return cost

    def terms(self, layouts: Layouts, hypothesis: Int[np.ndarray, "n"], offset: Float[np.ndarray, "n"]) -> Terms:
        """Return the terms of the cost of poses that each have their own hypothesis and δ."""
        every = np.arange(len(layouts))
        gathered = self._gathered(layouts, every)
        return Terms(
            walls=self._walls(gathered, hypothesis, offset[None])[0].astype(np.float64),
            openings=self._openings(gathered, hypothesis).mean(axis=1).astype(np.float64),
            ceiling=self._ceilings(offset)[every, layouts.room_index],
            room_type=self._room_types[layouts.room_index],
            objects=self._objects[layouts.room_index],
            height=self._query.camera_height.penalty(offset),
        )

    def wall_shares(
        self, layouts: Layouts, hypothesis: Int[np.ndarray, "n"], offset: Float[np.ndarray, "n"]
    ) -> Float[np.ndarray, "n w"]:
        """Return the probability by azimuth that the prediction is of the pose's own wall, not of one behind it."""
        gathered = self._gathered(layouts, np.arange(len(layouts)))
        share = np.ones(gathered.log_profile.shape)
        k, pose, column = hypothesis[gathered.pose], gathered.pose, gathered.column
        moved = offset[pose].astype(np.float32)
        shut = self._likelihood(gathered.log_profile[pose, column] - moved, (k, column))
        opened = gathered.odds * self._likelihood(gathered.log_behind - moved, (k, column))
        share[pose, column] = shut / (shut + opened)
        return share

    def nearest_mode(
        self, layouts: Layouts, hypothesis: Int[np.ndarray, "n"], offset: Float[np.ndarray, "n"]
    ) -> tuple[Float[np.ndarray, "n w"], Float[np.ndarray, "n w"]]:
        """Return centre and precision, by azimuth, of the predicted mode that each pose's own wall fits better."""
        centre, precision = self._first.centre[hypothesis], self._first.precision[hypothesis]
        log_m = layouts.log_profile - offset[:, None].astype(np.float32)
        for rival in self._modes[1:]:
            is_rival = rival.likelihood(log_m, hypothesis) > self._first.likelihood(log_m, hypothesis)
            centre = np.where(is_rival, rival.centre[hypothesis], centre)
            precision = np.where(is_rival, rival.precision[hypothesis], precision)
        return centre, precision

    @property
    def hypotheses(self) -> int:
        """Number of hypotheses of the heading."""
        return len(self._first.centre)

    @property
    def is_view(self) -> bool:
        """True if the encoder of views read the photograph."""
        return self._query.is_view

    @property
    def offsets(self) -> Float[np.ndarray, "j"]:
        """The δ that are tried."""
        return self._query.camera_height.offsets

    @cached_property
    def room_costs(self) -> Float[np.ndarray, "j r"]:
        """Cost of each δ in each room alone: the height's penalty, the ceiling, the room type and objects."""
        penalty = self._query.camera_height.penalty(self.offsets)[:, None] + self._objects
        penalty = penalty / self._weights.temperature
        types = self._weights.room_type * self._room_types
        return (penalty + self._weights.ceiling * self._ceilings(self.offsets) + types).astype(np.float32)

    def predicted_modes(
        self, columns: Int[np.ndarray, "a"]
    ) -> tuple[Float[np.ndarray, "d m 3"], Int[np.ndarray, "k a"]]:
        """Return predictions of walls, centre, precision and odds of each mode, and which of them are at azimuths."""
        predicted = np.stack([np.stack(mode, axis=-1) for mode in self._turning], axis=2)
        which = np.arange(predicted.shape[0] * predicted.shape[1]).reshape(predicted.shape[:2])
        turned = which if self._turned is None else self._turned
        return predicted.reshape(-1, *predicted.shape[2:]), turned[:, columns]

    @property
    def trust_number(self) -> Int[np.ndarray, "r"]:
        """Number of each room's trust in openings."""
        return self._plan.class_trusts[1]

    def opening_costs(self, columns: Int[np.ndarray, "a"]) -> Float[np.ndarray, "t k a c"] | None:
        """Return the weighted cost of every opening class at some azimuths, by trust; None if none is compared."""
        loss = self._opening_losses
        return None if loss is None else self._weights.openings * loss[:, :, columns]

    def _likelihood(self, log_m: Float[np.ndarray, "n"], place: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        """Return the likelihood of walls at places (hypothesis, column), over that of the first mode's centre."""
        return np.add.reduce([mode.likelihood(log_m, place) for mode in self._modes])

    def _gathered(self, layouts: Layouts, pose: Int[np.ndarray, "m"]) -> _Gathered:
        opening, room = None, layouts.room_index[pose]
        if layouts.kind is not None:
            opening = layouts.kind[pose] + np.arange(layouts.kind.shape[1]) * len(OPENING_CLASSES)
            if len(self._plan.class_trusts[0]) > 1:
                opening += self.trust_number[room][:, None] * self.hypotheses * opening.shape[1] * len(OPENING_CLASSES)
        row = column = np.empty(0, np.intp)
        log_behind = odds = np.empty(0, np.float32)
        if layouts.seen is not None and self._config.use_see_through:
            row, entry = layouts.seen.entries(pose)
            column, log_behind = layouts.seen.column[entry], layouts.seen.log_behind[entry]
            is_passage = layouts.seen.kind[entry] == PASSAGE_CODE
            share = np.where(is_passage, self._config.open_passage, self._config.open_door).astype(np.float32)
            odds = share / (1.0 - share)
        log_profile = layouts.log_profile[pose].astype(np.float32, copy=False)
        return _Gathered(log_profile, opening, room, row, column, log_behind, odds)

    def _compared(
        self, gathered: _Gathered, hypothesis: Int[np.ndarray, "#m"]
    ) -> tuple[Float[np.ndarray, "m"], Int[np.ndarray, "m"]]:
        """Return the cost of poses under their hypotheses, one each or one for all, and the number of the best δ."""
        cost = self._walls(gathered, hypothesis, self.offsets[:, None])
        cost += self.room_costs[:, gathered.room_index]
        openings = self._openings(gathered, hypothesis).mean(axis=1)
        return cost.min(axis=0) + self._weights.openings * openings, cost.argmin(axis=0)

    def _walls(
        self, gathered: _Gathered, hypothesis: Int[np.ndarray, "#m"], offset: Float[np.ndarray, "j #m"]
    ) -> Float[np.ndarray, "j m"]:
        """Return the walls' term at each of several δ."""
        width, factors = gathered.log_profile.shape[1], self._factors(gathered, hypothesis, offset.astype(np.float32))
        return np.stack([mean_log(factor, columns=width) for factor in factors])

    def _factors(
        self, gathered: _Gathered, hypothesis: Int[np.ndarray, "#m"], offset: Float[np.ndarray, "j #m"]
    ) -> Iterator[Float[np.ndarray, "m s"]]:
        """Yield the factors whose logs are the cost of walls at the s seen azimuths, for each of several δ."""
        seen = self._seen_walls
        first, *rivals = seen.modes
        (count, width), shown = gathered.log_profile.shape, first.centre.shape[1]
        log_profile = gathered.log_profile
        if shown < width:
            log_profile = log_profile.take(seen.columns[hypothesis] + np.arange(count)[:, None] * width)
        precision = first.precision[hypothesis]
        # Residuals at δ = 0 for the opening or the pose's own wall; the offset is subtracted for each δ.
        residual = log_profile - first.centre[hypothesis]
        residual *= precision
        # Residuals of the walls behind openings, by flat indices, which numpy takes fastest.
        own = np.broadcast_to(hypothesis, count)[gathered.pose]
        pose, log_behind, odds, place = gathered.pose, gathered.log_behind, gathered.odds, gathered.column
        if shown < width:
            place = seen.place.take(own * width + gathered.column)
            (kept,) = np.nonzero(place >= 0)
            own, pose, log_behind, odds, place = (part[kept] for part in (own, pose, log_behind, odds, place))
        predicted, place = own * shown + place, pose * shown + place
        precision_behind = first.precision.take(predicted)
        residual_behind = (log_behind - first.centre.take(predicted)) * precision_behind
        offset_behind = offset if offset.shape[1] == 1 else offset[:, pose]
        for j in range(len(offset)):
            # The last δ reuses the memory of the residuals.
            out = residual if j == len(offset) - 1 else None
            factor = np.subtract(residual, offset[j, :, None] * precision, out=out)
            np.square(factor, out=factor)
            factor += 1.0
            for mode in rivals:
                factor = np.maximum(
                    1.0 / (1.0 / factor + mode.likelihood(log_profile - offset[j, :, None], hypothesis)), 1.0
                )
            if len(place):
                behind = np.square(residual_behind - offset_behind[j] * precision_behind) + 1.0
                for mode in rivals:
                    behind = 1.0 / (1.0 / behind + mode.likelihood_at(log_behind - offset_behind[j], predicted))
                # At least 1: an opening costs nothing where its own wall fits, as networks learn to see that wall.
                either = np.maximum(1.0 / (1.0 / factor.take(place) + odds / behind), 1.0)
                factor.put(place, either)
            yield factor

    def _openings(self, gathered: _Gathered, hypothesis: Int[np.ndarray, "#m"]) -> Float[np.ndarray, "m #w"]:
        """Return the unweighted cost of openings at every azimuth."""
        loss = self._opening_losses
        if loss is None or gathered.opening is None:
            return np.zeros((len(gathered.room_index), 1), np.float32)
        return loss.take(hypothesis[:, None] * loss[0, 0].size + gathered.opening)

    @cached_property
    def _seen_walls(self) -> SeenWalls:
        """Predicted walls at the columns that count."""
        return SeenWalls.of(self._modes)

    @cached_property
    def _opening_losses(self) -> Float[np.ndarray, "t k w c"] | None:
        """Unweighted cost of each class by trust, hypothesis and azimuth; None if openings are not compared."""
        predicted, (trusts, _) = self._query.openings, self._plan.class_trusts
        if predicted is None or not trusts.any() or not self._config.use_openings:
            return None
        # Openings appear displaced by up to the reach, seen at the median distance.
        median_m = median_distance_m(self._first.centre[0], self._first.precision[0])
        turned = self._turned_columns(predicted.log_probability) if self._stride == 1 else None
        log_probability = predicted.log_probability if turned is None else predicted.log_probability[:1]
        probability = smoothed(np.exp(log_probability), self._reach_m / median_m)
        loss = opening_losses(
            probability[:, :: self._stride], predicted.prior, trusts, self._config.floor, self._weights.appearance
        )
        return loss if turned is None else loss[:, 0].take(turned, axis=1)

    def _turned_columns(self, values: Float[np.ndarray, "k w c"]) -> Int[np.ndarray, "k w"] | None:
        """Return the columns of the first hypothesis that all others have, by column; None if they are not turned."""
        width, roll = values.shape[1], self._query.roll
        shift = np.rint((roll - roll[0]) / TWO_PI * width).astype(np.intp)
        columns = (np.arange(width) - shift[:, None]) % width
        return columns if np.array_equal(values[0].take(columns, axis=0), values) else None

    @cached_property
    def _room_types(self) -> Float[np.ndarray, "r"]:
        """Cost of the type of every room by the encoder of photographs."""
        return self._by_room(self._query.room_type if self._query.objects is None else None)

    @cached_property
    def _objects(self) -> Float[np.ndarray, "r"]:
        """Cost of the type of every room by recognised objects."""
        return self._by_room(None if self._query.objects is None else self._query.objects.room_type)

    def _by_room(self, predicted: PredictedRoomType | None) -> Float[np.ndarray, "r"]:
        if predicted is None or not self._config.use_room_type:
            return np.zeros(len(self._plan.rooms))
        return losses_of_rooms(room_type_losses(predicted, self._config.floor), self._plan.type_shares)

    def _ceilings(self, offset: Float[np.ndarray, "j"]) -> Float[np.ndarray, "j r"]:
        """Return the cost of every room's ceiling at each δ."""
        predicted, height = self._query.ceiling, self._query.camera_height
        if predicted is None or not self._config.use_ceiling:
            return np.zeros((len(offset), len(self._plan.rooms)))
        clearance_m = self._plan.ceiling_heights_m[None] - height.height_m * np.exp(offset)[:, None]
        return ceiling_costs(predicted, clearance_m, offset[:, None], self._weights.tail)
