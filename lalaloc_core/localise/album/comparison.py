"""Comparison of one photograph with all poses of an album's ground, for every error of the camera height.

The cost of a wall at an azimuth depends on its log distance, the kind of opening there, and the error of the camera's
height alone. For each azimuth of a photograph a table has that cost for every bin of distance, kind and height error;
the cost of a pose under a heading is a sum of entries, as in `localise.match.coarse_pass`, at all azimuths.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int

from lalaloc_core.bundle import MatchingWeights
from lalaloc_core.conventions import OPENING_CLASSES, PASSAGE_CODE, TWO_PI
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.match import Layouts, MatchingConfig
from lalaloc_core.localise.match.cost_terms import median_distance_m, opening_losses, precisions, smoothed
from lalaloc_core.localise.query import PredictedProfile, Query

_CONFIG = MatchingConfig()
# Poses compared at a time.
_CHUNK = 1024
# Width of the bins of log distance, and range of distances (m).
_BIN = 0.05
_MIN_M, _MAX_M = 0.1, 60.0
_FIRST_BIN = math.floor(math.log(_MIN_M) / _BIN)
_BINS = math.ceil(math.log(_MAX_M) / _BIN) - _FIRST_BIN
_KINDS = len(OPENING_CLASSES)


@dataclass(frozen=True, eq=False)
class BinnedGround:
    """Binned layouts of n poses.

    Attributes:
        index: (n, 2w) bin of the distance times the number of kinds, plus the kind, twice around the horizon.
        row, column: (e,) pose and azimuth column of the walls that are seen through openings.
        own, behind: (e,) bin of the own wall and its kind as in `index`, and bin of the wall behind.
        odds: (e,) odds that a prediction is of the wall behind.
    """

    index: Int[np.ndarray, "n v"]
    row: Int[np.ndarray, "e"]
    column: Int[np.ndarray, "e"]
    own: Int[np.ndarray, "e"]
    behind: Int[np.ndarray, "e"]
    odds: Float[np.ndarray, "e"]

    @classmethod
    def of(cls, layouts: Layouts) -> BinnedGround:
        """Bin layouts at heading 0."""
        index = _bins(layouts.log_profile.astype(np.float32)) * _KINDS
        if layouts.kind is not None:
            index += layouts.kind
        seen = layouts.seen
        if seen is None:
            none = np.zeros(0, np.intp)
            return cls(np.concatenate([index, index], axis=1), none, none, none, none, np.zeros(0, np.float32))
        share = np.where(seen.kind == PASSAGE_CODE, _CONFIG.open_passage, _CONFIG.open_door).astype(np.float32)
        return cls(
            index=np.concatenate([index, index], axis=1),
            row=seen.row.astype(np.intp),
            column=seen.column.astype(np.intp),
            own=index[seen.row, seen.column],
            behind=_bins(seen.log_behind.astype(np.float32)),
            odds=share / (1.0 - share),
        )

    def __len__(self) -> int:
        return len(self.index)

    @property
    def columns(self) -> int:
        """Azimuth columns of the horizon."""
        return self.index.shape[1] // 2

    def part(self, rows: slice) -> BinnedGround:
        """Return successive poses."""
        begin, end = np.searchsorted(self.row, (rows.start, rows.stop))
        seen = (values[begin:end] for values in (self.row - rows.start, self.column, self.own, self.behind, self.odds))
        return BinnedGround(self.index[rows], *seen)


def _bins(log_m: Float[np.ndarray, "*n"]) -> Int[np.ndarray, "*n"]:
    return np.clip(np.floor(log_m / _BIN).astype(np.intp) - _FIRST_BIN, 0, _BINS - 1)


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

        The best pose is within `reach_m` of the camera; `offsets` are logs of true over stated camera height.
        """
        assert query.profile is not None
        width = query.profile.log_m.shape[1]
        columns = np.flatnonzero(np.isfinite(query.profile.log_scale[0]))
        bins = _BIN * (_FIRST_BIN + 0.5 + np.arange(_BINS))
        centres = bins[None, :, None] - offsets[None, None, :]
        likelihood = np.zeros((len(columns), _BINS, len(offsets)))
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
            cost = cost.reshape(len(cost), _BINS * _KINDS, self.walls.shape[2])
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
                own, kind = np.divmod(ground.own, _KINDS)
                either = self.likelihood[number][own] + ground.odds[:, None] * self.likelihood[number][ground.behind]
                either = -np.log(np.minimum(either, 1.0)) + openings[number][kind][:, None]
                total[ground.row, turn] += either - cost[number][ground.own]
        total = total if len(self.shifts) == width else total[:, self.shifts]
        total *= -self.factor
        return total


def _modes(profile: PredictedProfile, columns: np.ndarray) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return centre, log scale and odds of each predicted mode at some columns."""
    modes = [(profile.log_m[0][columns], profile.log_scale[0][columns], np.ones(len(columns)))]
    if (rival := profile.rival) is not None:
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
        return np.zeros((len(trusts), profile.log_m.shape[1], _KINDS), np.float32)
    precision = precisions(profile.log_m[0], profile.log_scale[0], reach_m, weights.tail)
    spread = reach_m / median_distance_m(profile.log_m[0], precision)
    probability = smoothed(np.exp(predicted.log_probability[:1]), spread)[0]
    loss = opening_losses(probability, predicted.prior, trusts, _CONFIG.floor, weights.appearance)
    return np.float32(weights.openings) * loss
