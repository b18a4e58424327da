"""Results of calibration: parameters of matching cost, confidence and covariance, errors of predictions.

Predictions are drawn from the measured errors. Those of log distances are normal scores with the measured correlation
around the horizon, mapped to the measured quantiles. Their correlation at large angles is that of the error of scale,
which all azimuths of one photograph share. The predicted scales and the opening classes are drawn likewise.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Integer

from lalaloc_core.conventions import OPENING_CLASSES
from lalaloc_core.errors import ConfigError

# Quantiles of errors and of predicted scales.
LEVELS = (0.0, 0.005, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98, 0.995, 1.0)
_MIN_PROBABILITY = 1e-4


@dataclass(frozen=True, kw_only=True)
class LogisticModel:
    """Probability that a picture fits its plan, a logistic function of the signals of `localise.belief.confidence`.

    The class is here because its weights are part of the manifest; `confidence.confidence_of` computes the confidence
    of an answer from it.

    Weights of signals that a model was not fitted with are 0: `answer_to_chance` and, without a cohort,
    `cost_to_chance` in models of earlier versions; `log_odds` in models that are fitted now.
    """

    bias: float
    log_odds: float
    cost: float
    uncertainty: float
    latent_distance: float
    cost_to_chance: float = 0.0
    answer_to_chance: float = 0.0

    def probability(self, **signals: float) -> float:
        """Return the probability for some signals, each by the name of its weight."""
        logit = self.bias + sum(getattr(self, name) * value for name, value in signals.items())
        return 1.0 / (1.0 + math.exp(-max(-30.0, min(30.0, logit))))


@dataclass(frozen=True, kw_only=True)
class MatchingWeights:
    """Weights of the terms of the matching cost, fitted on validation queries; see `localise.match.matching_cost`.

    Attributes:
        openings, ceiling, room_type: weights in units of the walls'.
        tail: κ, the scale of errors of walls and ceilings over the predicted one.
        temperature: T, the number of independent azimuths: likelihoods are `exp(-T cost)`.
        appearance: for every opening class of a plan (rows, in the order of `conventions.OPENING_CLASSES`) the
            probabilities of what it looks like (columns); None if every class looks like itself.
        usual_cost: cost of the best place at a right heading, below which a given heading is not doubted.
        usual_gain: share of that cost by which a search over all headings lowers it beside a right heading; only a
            larger gain overrules a given heading.
    """

    openings: float = 0.7
    ceiling: float = 0.05
    room_type: float = 0.05
    tail: float = 3.0
    temperature: float = 16.0
    appearance: tuple[tuple[float, ...], ...] | None = None
    usual_cost: float = 0.0
    usual_gain: float = 0.0

    def __post_init__(self) -> None:
        if self.appearance is None:
            return
        classes = len(OPENING_CLASSES)
        is_square = len(self.appearance) == classes and all(len(row) == classes for row in self.appearance)
        if not is_square or any(min(row) < 0.0 or abs(sum(row) - 1.0) > 1e-3 for row in self.appearance):
            raise ConfigError(
                f"evidence.appearance must have {classes} rows of {classes} probabilities that sum to 1, "
                f"not {self.appearance}"
            )


@dataclass(frozen=True, kw_only=True)
class AlbumWeights:
    """Weights of what counts in albums only, as `evaluate.bench.album_weights` fits them.

    Attributes:
        misread: share of photographs whose walls and openings are misread, before those of an album tell.
        misfit: the same found in an album, above which its photographs do not fit the plan.
        pairs: weight of the log odds that two photographs are of one room.
        crowding: how much the number of photographs of a room keeps to what its size lets expect.
        confidence: bias of the log odds that a room is right, weight of those by its share of the probability, and of
            the share of misread photographs.
    """

    misread: float = 0.2
    misfit: float = 0.3
    pairs: float = 0.6
    crowding: float = 1.6
    confidence: tuple[float, float, float] = (0.94, 0.69, -7.0)

    def __post_init__(self) -> None:
        if not 0.0 < self.misread < 1.0:
            raise ConfigError(f"album.misread is {self.misread:g}; it must be between 0 and 1")


@dataclass(frozen=True, kw_only=True)
class ConfidenceModel:
    """Models of the confidence and covariance of answers, fitted on validation queries.

    Attributes:
        known_heading, searched_heading: models by the last stage of the search ("retrieval", "vdr", "lpo").
        position_factor: covariance (m²) of the position over the inverse of the cost's curvature, for known headings.
        position_factor_searched, heading_factor: the same of the position (m²) and the heading (radians²), for
            searched headings.
    """

    known_heading: dict[str, LogisticModel]
    searched_heading: dict[str, LogisticModel]
    position_factor: float | None = None
    position_factor_searched: float | None = None
    heading_factor: float | None = None

    def fit_probability(self, stage: str, signals: Mapping[str, float], *, heading_known: bool) -> float | None:
        """Return the probability that a picture is of the plan; None for a stage that the model was not fitted on."""
        model = (self.known_heading if heading_known else self.searched_heading).get(stage)
        return None if model is None else model.probability(**signals)


@dataclass(frozen=True, kw_only=True)
class PredictionErrors:
    """Errors of the predictions of spheres or of views.

    Attributes:
        error_quantiles: of the error of the log distance over the predicted scale, at `LEVELS`.
        error_correlation: correlation of the normal scores of these errors by difference of azimuth, in columns from 0.
        scale_quantiles, scale_correlation: the same for the logs of the predicted scales.
        seen: for every opening class of a plan (rows) the probabilities of the class predicted (columns).
        seen_correlation: correlation of the scores that the predicted classes are drawn by.
        class_probability: for every class of a plan and every class predicted, the mean predicted probabilities.
        spread: factor of the errors, fitted so that as many validation photographs are found as are predicted to be.
    """

    error_quantiles: tuple[float, ...]
    error_correlation: tuple[float, ...]
    scale_quantiles: tuple[float, ...]
    scale_correlation: tuple[float, ...]
    seen: tuple[tuple[float, ...], ...]
    seen_correlation: tuple[float, ...]
    class_probability: tuple[tuple[tuple[float, ...], ...], ...]
    spread: float = 1.0

    def __post_init__(self) -> None:
        for name in ("error_quantiles", "scale_quantiles"):
            if len(getattr(self, name)) != len(LEVELS):
                raise ConfigError(f"{name} has {len(getattr(self, name))} values; it must have {len(LEVELS)}")
        classes = len(OPENING_CLASSES)
        table = np.shape(self.seen), np.shape(self.class_probability)
        if table != ((classes, classes), (classes, classes, classes)):
            raise ConfigError(f"seen and class_probability have the shapes {table}; there are {classes} classes")
        if not self.spread > 0.0:
            raise ConfigError(f"spread is {self.spread:g}; it must be positive")

    def thinned(self, stride: int) -> PredictionErrors:
        """Return the errors at every azimuth whose column is a multiple of `stride`."""
        names = ("error_correlation", "scale_correlation", "seen_correlation")
        return replace(self, **{name: getattr(self, name)[::stride] for name in names})

    def profile(
        self, log_m: Float[np.ndarray, "n w"], rng: np.random.Generator
    ) -> tuple[Float[np.ndarray, "n w"], Float[np.ndarray, "n w"]]:
        """Draw predicted log distances (m) and logs of their scales for layouts."""
        count, columns = log_m.shape
        scale_level, error_level = (
            _normal_probability(correlated(correlation, count, columns, rng))
            for correlation in (self.scale_correlation, self.error_correlation)
        )
        log_scale = np.interp(scale_level, LEVELS, self.scale_quantiles)
        error = np.interp(error_level, LEVELS, self.error_quantiles)
        return log_m + self.spread * np.exp(log_scale) * error, log_scale

    def openings(self, kind: Integer[np.ndarray, "n w"], rng: np.random.Generator) -> Float[np.ndarray, "n w c"]:
        """Draw log probabilities of the opening classes for layouts, by their codes."""
        level = _normal_probability(correlated(self.seen_correlation, len(kind), kind.shape[1], rng))
        above = np.cumsum(np.array(self.seen), axis=1)[kind]
        seen = np.minimum((level[..., None] > above).sum(axis=-1), len(OPENING_CLASSES) - 1)
        return np.log(np.maximum(np.array(self.class_probability)[kind, seen], _MIN_PROBABILITY))


def _normal_probability(score: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Return the probability of a smaller standard normal score."""
    # Loading it takes as long as a query, and every program that opens a bundle loads this module.
    from scipy.special import ndtr

    return ndtr(score)


def correlated(
    correlation: tuple[float, ...], count: int, columns: int, rng: np.random.Generator
) -> Float[np.ndarray, "n w"]:
    """Draw standard normal scores around the horizon with a correlation by difference of azimuth.

    Differences beyond the last measured one have its correlation.
    """
    lag = np.minimum(np.arange(columns), columns - np.arange(columns))
    covariance = np.asarray(correlation)[np.minimum(lag, len(correlation) - 1)]
    # Measured correlations are not exactly those of a process.
    power = np.maximum(np.fft.fft(covariance).real, 0.0)
    power *= columns / power.sum()
    noise = np.fft.fft(rng.standard_normal((count, columns)), axis=1)
    return np.fft.ifft(noise * np.sqrt(power), axis=1).real
