"""How sure an answer is: the posterior within 1 m of it, times the probability that the picture fits the plan at all.

Whether it fits is judged by signals that do not compare places: how badly the best one fits, also in units of how
badly places of other homes do (`localise.cohort`), how sure the image encoder is, and how far the latents are apart.
How these become a probability is fitted on validation queries and on photographs of something else
(`lalaloc_core.evaluate.calibrate`), and travels with the model (`bundle.ConfidenceModel`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from lalaloc_core.localise.cohort import log_cost_to_chance
from lalaloc_core.localise.poses import Candidate, Query
from lalaloc_core.localise.posterior import RIGHT_WITHIN_M, Posterior

__all__ = ["RIGHT_WITHIN_M", "Signals", "signals_of"]

# No posterior is surer than this, either way.
_MAX_LOG_ODDS = 6.0


@dataclass(frozen=True, kw_only=True)
class Signals:
    """What speaks for an answer and against it.

    Attributes:
        log_odds: of the camera being within 1 m of the answer, by the posterior.
        cost: how badly the answer fits.
        uncertainty: mean log of the scales that the image encoder predicts; 0 where it predicts none.
        latent_distance: of the answer. Pictures of no room at all fit anywhere, as nothing is predicted of them with
            any certainty, but their latents are like no layout's.
        cost_to_chance: log of the cost of the plan's best grid pose in units of what fits by chance.
        answer_to_chance: the same of the answer, whose cost refinement has lowered, most of all at the right place.
    """

    log_odds: float
    cost: float
    uncertainty: float
    latent_distance: float
    cost_to_chance: float
    answer_to_chance: float


def signals_of(
    query: Query, answer: Candidate, posterior: Posterior, grid_cost: float, by_chance: float | None
) -> Signals:
    """Signals of an answer, the first candidate of the posterior.

    Args:
        grid_cost: of the best pose of the plan's grid.
        by_chance: what fits the query by chance, see `localise.cohort`.
    """
    mass = min(max(posterior.position, 1e-9), 1.0 - 1e-9)
    log_odds = math.log(mass / (1.0 - mass))
    return Signals(
        log_odds=max(-_MAX_LOG_ODDS, min(_MAX_LOG_ODDS, log_odds)),
        cost=answer.cost,
        uncertainty=0.0 if query.profile is None else float(query.profile.log_scale.mean()),
        latent_distance=answer.latent_distance,
        cost_to_chance=log_cost_to_chance(grid_cost, by_chance),
        answer_to_chance=log_cost_to_chance(answer.cost, by_chance),
    )
