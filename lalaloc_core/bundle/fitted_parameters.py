"""Parameters that calibration fits: those of the matching cost, and of the confidence and covariance of answers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from lalaloc_core.conventions import OPENING_CLASSES
from lalaloc_core.errors import ConfigError


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

    def probability(
        self,
        *,
        log_odds: float,
        cost: float,
        uncertainty: float,
        latent_distance: float,
        cost_to_chance: float = 0.0,
        answer_to_chance: float = 0.0,
    ) -> float:
        """Return the probability for some signals."""
        logit = self.bias + self.log_odds * log_odds + self.cost * cost
        logit += self.uncertainty * uncertainty + self.latent_distance * latent_distance
        logit += self.cost_to_chance * cost_to_chance + self.answer_to_chance * answer_to_chance
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
        """Check the shape and the sums of `appearance`."""
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
