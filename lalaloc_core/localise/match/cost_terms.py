"""Formulas of the matching cost's terms (`matching_cost.py` has the equations), for grid poses and prototypes alike."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from lalaloc_core.conventions import TWO_PI, WALL_CODE
from lalaloc_core.localise.query import PredictedCeiling, PredictedRoomType

# Smallest trusted scale of a predicted log distance: a centimetre at ten metres.
_MIN_SCALE = 1e-3
# Smallest trusted scale of a predicted log ceiling height, as plans round their ceilings.
_MIN_CEILING_SCALE = 0.04
_MIN_CLEARANCE_M = 0.05
# `log` is slow, so multiply this many factors, each at most the maximum, before taking it.
_FACTORS, _MAX_FACTOR = 4, 1e9
# Seen columns are compared alone if they are at most this share of all.
_FEW_SEEN = 0.75


class WallMode(NamedTuple):
    """Mode of the predicted walls: centres, precisions and odds."""

    centre: Float[np.ndarray, "k w"]
    precision: Float[np.ndarray, "k w"]
    odds: Float[np.ndarray, "k w"]

    @classmethod
    def of(
        cls,
        log_m: Float[np.ndarray, "k w"],
        log_scale: Float[np.ndarray, "k w"],
        odds: Float[np.ndarray, "k w"],
        reach_m: float,
        tail: float,
        stride: int,
    ) -> WallMode:
        """Return a mode for poses within a reach (m), at the columns that are multiples of `stride`."""
        values = log_m, precisions(log_m, log_scale, reach_m, tail), odds
        return cls(*(np.ascontiguousarray(value[:, ::stride], np.float32) for value in values))

    def turned(self, columns: Int[np.ndarray, "k w"]) -> WallMode:
        """Return the mode, of one hypothesis, with columns of it for each of several."""
        return WallMode(*(value[0].take(columns) for value in self))

    def at(self, columns: Int[np.ndarray, "k s"]) -> WallMode:
        """Return the mode, of all values, at some columns of each hypothesis."""
        return WallMode(*(np.take_along_axis(value, columns, axis=1) for value in self))

    def likelihood(self, log_m: np.ndarray, place: Any) -> np.ndarray:
        """Return the likelihoods of log distances at places: an index into (k, w)."""
        centre, precision = self.centre[place], self.precision[place]
        return self.odds[place] / (1.0 + np.square((log_m - centre) * precision))

    def likelihood_at(self, log_m: Float[np.ndarray, "n"], place: Int[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
        """Return the likelihoods of log distances at flat places."""
        return self.odds.take(place) / (1.0 + np.square((log_m - self.centre.take(place)) * self.precision.take(place)))


class SeenWalls(NamedTuple):
    """Modes at the columns that each hypothesis shows, of which views have few; others cost nothing.

    Attributes:
        modes: the modes at these columns, each (k, s).
        columns: (k, s) the columns, filled up with unseen ones.
        place: (k, w) the place of every column in a row of `columns`; -1 for those that are left out.
    """

    modes: tuple[WallMode, ...]
    columns: Int[np.ndarray, "k s"]
    place: Int[np.ndarray, "k w"]

    @classmethod
    def of(cls, modes: Sequence[WallMode]) -> SeenWalls:
        """Return the modes at the seen columns; all, if most are seen."""
        hypotheses, width = modes[0].centre.shape
        is_seen = np.any([mode.precision > 0.0 for mode in modes], axis=0)
        count = -(-max(int(is_seen.sum(axis=1).max(initial=0)), 1) // _FACTORS) * _FACTORS
        if count > _FEW_SEEN * width:
            every = np.broadcast_to(np.arange(width), (hypotheses, width))
            return cls(tuple(modes), every, every)
        columns = np.argsort(~is_seen, axis=1, kind="stable")[:, :count]
        place = np.full((hypotheses, width), -1)
        np.put_along_axis(place, columns, np.arange(count), axis=1)
        return cls(tuple(mode.at(columns) for mode in modes), columns, place)


def precisions(
    log_m: Float[np.ndarray, "*n"], log_scale: Float[np.ndarray, "*n"], reach_m: float, tail: float
) -> Float[np.ndarray, "*n"]:
    """Return 1 / (κ s) for every hypothesis and azimuth, the factor of differences of log distance."""
    scale = np.maximum(np.exp(log_scale), _MIN_SCALE)
    return 1.0 / (tail * np.hypot(scale, reach_m * np.exp(-log_m)))


def median_distance_m(centre: Float[np.ndarray, "w"], precision: Float[np.ndarray, "w"]) -> float:
    """Return the median distance (m) of the walls that are seen, by log distances; infinite if none is."""
    seen = centre[precision > 0]
    return float(np.exp(np.median(seen))) if len(seen) else np.inf


def ceiling_costs(
    predicted: PredictedCeiling, clearance_m: Float[np.ndarray, "*#n"], offset: Float[np.ndarray, "*#n"], tail: float
) -> Float[np.ndarray, "*n"]:
    """Return the cost of ceilings at some heights (m) above the camera, each at a δ."""
    difference = np.log(np.maximum(clearance_m, _MIN_CLEARANCE_M)) - (predicted.log_m + offset)
    scale = tail * np.hypot(np.exp(predicted.log_scale), _MIN_CEILING_SCALE)
    return np.log1p(np.square(difference / scale))


def room_type_losses(predicted: PredictedRoomType, floor: float) -> Float[np.ndarray, "t"]:
    """Return the cost of every room type; the unknown type costs as much as an uninformative prediction."""
    ratio = floor + (1.0 - floor) * np.exp(predicted.log_probability) / np.maximum(predicted.prior, 1e-4)
    loss = np.log(ratio[1:].max()) - np.log(np.concatenate([[1.0], ratio[1:]]))
    return np.maximum(loss, 0.0)


def losses_of_rooms(loss: Float[np.ndarray, "t"], type_shares: Float[np.ndarray, "r t"]) -> Float[np.ndarray, "r"]:
    """Return the cost of every room's types: a photograph of a room with several shows any of them."""
    return -np.log(type_shares @ np.exp(-loss))


def class_losses(
    probability: Float[np.ndarray, "*n c"],
    prior: Float[np.ndarray, "c"],
    trust: Sequence[float],
    floor: float,
    appearance: Sequence[Sequence[float]] | None = None,
) -> Float[np.ndarray, "*n c"]:
    """Return `-log q` of every opening class that a plan can show (`matching_cost.py` has the equation).

    `probability` and `prior` are those of the classes seen; `trust` is t, `floor` is ε, and `appearance` is a.
    """
    drawn = np.array(trust)
    drawn[WALL_CODE] = 0.0
    missing = prior * (1.0 - drawn)
    kind = drawn[:, None] * np.eye(len(drawn)) + (1.0 - drawn[:, None]) * (missing / missing.sum())
    seen = kind if appearance is None else kind @ np.asarray(appearance)
    ratio = probability / prior.astype(probability.dtype)
    return -np.log(floor + ratio @ ((1.0 - floor) * seen.T).astype(probability.dtype))


def opening_losses(
    probability: Float[np.ndarray, "*n c"],
    prior: Float[np.ndarray, "c"],
    trusts: Float[np.ndarray, "t c"],
    floor: float,
    appearance: Sequence[Sequence[float]] | None,
) -> Float[np.ndarray, "t *n c"]:
    """Return the `class_losses` of some trusts, over those of the best class.

    A right pose in a plan that draws no openings would always cost less than one in a plan that draws them, so trusts
    with a lower expected loss at the right pose have the difference to the highest added.
    """
    loss = np.empty((len(trusts), *probability.shape), np.float32)
    for number, trust in enumerate(trusts):
        loss[number] = class_losses(probability, prior, trust.tolist(), floor, appearance)
    loss -= loss.min(axis=-1, keepdims=True)
    expected = np.array([float(np.sum(probability * part, axis=-1).mean()) for part in loss])
    loss += (expected.max() - expected).astype(np.float32).reshape(-1, *[1] * probability.ndim)
    return loss


def latent_distances(latents: Float[np.ndarray, "n d"], targets: Float[np.ndarray, "k d"]) -> Float[np.ndarray, "k n"]:
    """Return the Euclidean distance of each target to each latent, both of unit length."""
    return np.sqrt(np.maximum(2.0 - 2.0 * (targets @ latents.T), 0.0))


def mean_log(
    factor: Float[np.ndarray, "n w"],
    *,
    columns: int | None = None,
    factors: int = _FACTORS,
    max_factor: float = _MAX_FACTOR,
) -> Float[np.ndarray, "n"]:
    """Return the mean logarithm of each row.

    The sums are divided by `columns` if it is given; factors that are left out are 1.

    Values of `factor`, from 1 upwards, are overwritten. So many `factors` are multiplied before the logarithm if they
    divide the number of columns; values above `max_factor` count as that, so that products stay finite.
    """
    given = factor.shape[1]
    columns = given if columns is None else columns
    if given % factors:
        return np.log(factor).sum(axis=1) / columns
    np.minimum(factor, max_factor, out=factor)
    width = given // factors
    product = factor[:, :width].copy()
    for begin in range(width, given, width):
        product *= factor[:, begin : begin + width]
    return np.log(product).sum(axis=1) / columns


def smoothed(probability: Float[np.ndarray, "k w c"], spread: float) -> Float[np.ndarray, "k w c"]:
    """Return probabilities by azimuth, blurred around the horizon by a Gaussian of `spread` radians."""
    columns = probability.shape[1]
    deviation = spread / TWO_PI * columns
    if deviation < 0.3:
        return probability
    offset = (np.arange(columns) + columns // 2) % columns - columns // 2
    kernel = np.exp(-0.5 * np.square(offset / deviation)).astype(probability.dtype)
    kernel = (kernel / kernel.sum())[(np.arange(columns)[:, None] - np.arange(columns)[None]) % columns]
    # One matrix product for all hypotheses.
    blurred = kernel @ probability.transpose(1, 0, 2).reshape(columns, -1)
    return blurred.reshape(columns, len(probability), -1).transpose(1, 0, 2)
