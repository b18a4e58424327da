"""Comparison of one photograph with all poses of an album's ground, for every error of the camera height."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int

from lalaloc_core.bundle import MatchingWeights
from lalaloc_core.conventions import TWO_PI
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.album.binned_ground import BINS, KINDS, BinnedGround, bin_centres
from lalaloc_core.localise.match import MatchingConfig
from lalaloc_core.localise.match.cost_terms import median_distance_m, opening_losses, precisions, smoothed
from lalaloc_core.localise.query import PredictedProfile, Query

_CONFIG = MatchingConfig()
# Poses compared at a time.
_CHUNK = 1024


@dataclass(frozen=True, eq=False)
class Comparison:
    """Tables of one photograph.

    Attributes:
        columns: (s,) azimuth columns that the photograph shows, if it looks along azimuth 0.
        shifts: (k,) columns that each hypothesis of the heading turns it by.
        walls: (s, b, j) cost of walls by bin and height error.
        likelihood: (s, b, j) likelihood of walls; at most 1 counts.
        openings: (t, s, k) cost of each kind of opening, by the room's trust.
        factor: log likelihood of a unit of cost.
    """

    columns: np.ndarray
    shifts: np.ndarray
    walls: Float[np.ndarray, "s b j"]
    likelihood: Float[np.ndarray, "s b j"]
    openings: Float[np.ndarray, "t s c"]
    factor: float

    @classmethod
    def of(
        cls, plan: FloorPlan, query: Query, reach_m: float, weights: MatchingWeights, offsets: Float[np.ndarray, "j"]
    ) -> Comparison:
        """Return the tables of a query with an unknown heading.

        Args:
            plan: the plan, whose drawn openings count.
            query: the photograph.
            reach_m: distance from the camera within which the best pose is.
            weights: weights of the matching cost.
            offsets: logs of true over stated camera height.
        """
        assert query.profile is not None
        width = query.profile.log_m.shape[1]
        columns = np.flatnonzero(np.isfinite(query.profile.log_scale[0]))
        centres = bin_centres()[None, :, None] - offsets[None, None, :]
        likelihood = np.zeros((len(columns), BINS, len(offsets)))
        for centre, log_scale, odds in _modes(query.profile, columns):
            precision = precisions(centre, log_scale, reach_m, weights.tail)
            apart = (centres - centre[:, None, None]) * precision[:, None, None]
            likelihood += odds[:, None, None] / (1.0 + np.square(apart))
        walls = -np.log(np.minimum(likelihood, 1.0))
        return cls(
            columns=columns,
            shifts=np.rint(query.roll / TWO_PI * width).astype(int) % width,
            walls=walls.astype(np.float32),
            likelihood=np.ascontiguousarray(likelihood, np.float32),
            openings=_opening_losses(plan, query, reach_m, weights)[:, columns],
            factor=weights.temperature / width,
        )

    def log_likelihoods(
        self, ground: BinnedGround, trust_number: Int[np.ndarray, "n"]
    ) -> Iterator[tuple[slice, Float[np.ndarray, "m k j"]]]:
        """Yield the log likelihood of walls and openings under every hypothesis and height error, by some poses.

        `trust_number` is the number of each pose's trust in openings.
        """
        ends = [*(np.flatnonzero(np.diff(trust_number)) + 1).tolist(), len(ground)]
        for begin, end in pairwise([0, *ends]):
            openings = self.openings[trust_number[begin]]
            cost = self.walls[:, :, None, :] + openings[:, None, :, None]
            cost = cost.reshape(len(cost), BINS * KINDS, self.walls.shape[2])
            for first in range(begin, end, _CHUNK):
                part = slice(first, min(first + _CHUNK, end))
                yield part, self._part(ground.part(part), cost, openings)

    def _part(
        self, ground: BinnedGround, cost: Float[np.ndarray, "s e j"], openings: Float[np.ndarray, "s c"]
    ) -> Float[np.ndarray, "n k j"]:
        width = ground.columns
        total = np.zeros((len(ground), width, cost.shape[2]), np.float32)
        for number, column in enumerate(self.columns.tolist()):
            # A turn by s columns shows the wall of column c + s where the photograph shows it at c.
            total += cost[number].take(ground.index[:, column : column + width], axis=0)
            if len(ground.row):
                turn = (ground.column - column) % width
                own, kind = np.divmod(ground.own, KINDS)
                either = self.likelihood[number][own] + ground.odds[:, None] * self.likelihood[number][ground.behind]
                either = -np.log(np.minimum(either, 1.0)) + openings[number][kind][:, None]
                total[ground.row, turn] += either - cost[number][ground.own]
        total = total if len(self.shifts) == width else total[:, self.shifts]
        total *= -self.factor
        return total


Mode = tuple[Float[np.ndarray, "s"], Float[np.ndarray, "s"], Float[np.ndarray, "s"]]


def _modes(profile: PredictedProfile, columns: np.ndarray) -> list[Mode]:
    """Return centre, log scale and odds of each predicted mode at some columns."""
    modes = [(profile.log_m[0][columns], profile.log_scale[0][columns], np.ones(len(columns)))]
    rival = profile.rival
    if rival is not None:
        modes.append((rival.log_m[0][columns], rival.log_scale[0][columns], rival.odds[0][columns]))
    return modes


def _opening_losses(
    plan: FloorPlan, query: Query, reach_m: float, weights: MatchingWeights
) -> Float[np.ndarray, "t w c"]:
    """Return the weighted cost of every kind of opening by trust and column; zero if openings are not compared."""
    predicted, profile = query.openings, query.profile
    assert profile is not None
    trusts, _ = plan.class_trusts
    if predicted is None or not trusts.any():
        return np.zeros((len(trusts), profile.log_m.shape[1], KINDS), np.float32)
    precision = precisions(profile.log_m[0], profile.log_scale[0], reach_m, weights.tail)
    spread = reach_m / median_distance_m(profile.log_m[0], precision)
    probability = smoothed(np.exp(predicted.log_probability[:1]), spread)[0]
    loss = opening_losses(probability, predicted.prior, trusts, _CONFIG.floor, weights.appearance)
    return np.float32(weights.openings) * loss
