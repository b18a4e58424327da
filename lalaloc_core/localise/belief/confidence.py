"""Confidence of an answer: the posterior within 1 m of it, times the probability that the photograph fits the plan.

The fit is judged by signals that do not compare places: the cost of the best place, also relative to the cost of places
in other homes (`localise.match.cohort`), the uncertainty that the image encoder predicts, and the latent distance. A
logistic model of the signals is fitted on validation queries and on photographs of unknown places
(`lalaloc_core.evaluate.calibrate`).

`confidence_of` computes the confidence of an answer; `sequence.sequence_search` combines it for several photographs.
The classes of the logistic model (`bundle.ConfidenceModel`, `bundle.LogisticModel`) are in `bundle`, because their
weights are part of the manifest.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

from lalaloc_core.bundle import ConfidenceModel
from lalaloc_core.localise.belief.posterior import Posterior
from lalaloc_core.localise.match import log_cost_to_chance
from lalaloc_core.localise.query import Candidate, Query

# Limit of the posterior's log odds, either way.
_MAX_LOG_ODDS = 6.0


@dataclass(frozen=True, kw_only=True)
class Signals:
    """Signals of an answer's confidence.

    Attributes:
        log_odds: of the camera being within 1 m of the answer, by the posterior.
        cost: matching cost of the answer.
        uncertainty: mean log of the scales that the image encoder predicts; 0 if it predicts none, or saw no wall.
        latent_distance: of the answer. Pictures without a room fit anywhere, as their predictions are uncertain, but
            their latents are far from every layout's.
        cost_to_chance: log of the cost of the plan's best grid pose over the cost of a fit by chance.
        answer_to_chance: the same for the refined answer; refinement lowers the cost most at the right place.
    """

    log_odds: float
    cost: float
    uncertainty: float
    latent_distance: float
    cost_to_chance: float
    answer_to_chance: float


@dataclass(frozen=True)
class Confidence:
    """Calibrated probabilities of an answer.

    Attributes:
        fit: the photograph is of the plans that were searched.
        position: the answer is right within 1 m.
        heading: its heading is right within 5°.
        candidates: each candidate is right within 1 m, with its heading; at most `fit` in sum.
    """

    fit: float
    position: float
    heading: float
    candidates: tuple[float, ...]

    @property
    def elsewhere(self) -> float:
        """Probability that the photograph is of none of the places of the plans that were searched."""
        return max(1.0 - self.fit, 0.0)


def signals_of(
    query: Query, answer: Candidate, posterior: Posterior, grid_cost: float, by_chance: float | None
) -> Signals:
    """Return the signals of an answer.

    The answer is the posterior's first candidate; `grid_cost` is the cost of the best pose of the plan's grid, and
    `by_chance` that of a fit by chance (`localise.match.cohort`).
    """
    mass = min(max(posterior.position, 1e-9), 1.0 - 1e-9)
    log_odds = math.log(mass / (1.0 - mass))
    return Signals(
        log_odds=max(-_MAX_LOG_ODDS, min(_MAX_LOG_ODDS, log_odds)),
        cost=answer.cost,
        uncertainty=_uncertainty(query),
        latent_distance=answer.latent_distance,
        cost_to_chance=log_cost_to_chance(grid_cost, by_chance),
        answer_to_chance=log_cost_to_chance(answer.cost, by_chance),
    )


def _uncertainty(query: Query) -> float:
    """Return the mean log of the predicted scales of the walls that are seen."""
    if query.profile is None or not query.profile.seen.any():
        return 0.0
    return float(query.profile.log_scale[query.profile.seen].mean())


def confidence_of(
    model: ConfidenceModel | None,
    stage: str,
    signals: Signals,
    posterior: Posterior,
    *,
    heading_known: bool,
    share: float = 1.0,
    linked_fit: float = 0.0,
) -> Confidence | None:
    """Return the confidence of an answer; None without a model, or if the model was not fitted on the stage.

    `signals` are the answer's after `stage`; `heading_known` states that the heading was given exactly; `share` is the
    probability that the place is among those that were searched. `linked_fit` is the highest probability that a
    photograph which measured motions link to this one is of the plan: then this one is, too.
    """
    fit = None if model is None else model.fit_probability(stage, asdict(signals), heading_known=heading_known)
    if fit is None:
        return None
    fit = max(fit, linked_fit) * share
    return Confidence(
        fit=fit,
        position=fit * posterior.position,
        heading=fit * min(posterior.heading, 1.0),
        candidates=tuple(fit * probability for probability in posterior.candidate),
    )
