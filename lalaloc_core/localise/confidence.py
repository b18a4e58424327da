"""What the confidence of an answer is judged by: the posterior over candidates, the fit, and the predicted uncertainty.

The candidates are the modes of a posterior over poses, each with a likelihood of `exp(-n c)`, with its cost c and the
number n of azimuths that err independently. How these signals become a probability is fitted on validation queries
(`lalaloc_core.calibrate`) and travels with the model (`bundle.ConfidenceModel`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lalaloc_core.localise.poses import Candidate, Query

# Neighbouring azimuths err alike: 128 of them are worth about so many.
_INDEPENDENT = 16.0
# An answer is right within this distance.
RIGHT_WITHIN_M = 1.0
# No posterior over a handful of candidates is surer than this, either way.
_MAX_LOG_ODDS = 6.0


@dataclass(frozen=True, kw_only=True)
class Signals:
    """What speaks for an answer and against it.

    Attributes:
        log_odds: of the candidates within 1 m of the best against all others.
        cost: how badly the best candidate fits.
        uncertainty: mean log of the scales that the image encoder predicts; 0 where it predicts none.
        latent_distance: of the best candidate. Pictures of no room at all fit anywhere, as nothing is predicted of them
            with any certainty, but their latents are like no layout's.
    """

    log_odds: float
    cost: float
    uncertainty: float
    latent_distance: float


def signals_of(query: Query, candidates: Sequence[Candidate], *, complete: bool) -> Signals:
    """Signals of the best of some candidates whose costs can be compared.

    Args:
        complete: whether these are all candidates that there are. If not, as many again, as likely as the least likely
            of these, stand for the others: where nothing tells places apart, those looked at may all be at one.
    """
    cost = np.array([candidate.cost for candidate in candidates])
    best = int(cost.argmin())
    position = np.stack([candidate.position_m for candidate in candidates])
    log_likelihood = -_INDEPENDENT * (cost - cost[best])
    here = np.linalg.norm(position - position[best], axis=1) < RIGHT_WITHIN_M
    # Starts that met in one pose are one candidate: of those near the best, the best speaks for all.
    rivals = log_likelihood[~here]
    if not complete:
        rivals = np.append(rivals, log_likelihood.min() + np.log(len(cost)))
    against = np.logaddexp.reduce(rivals) if len(rivals) else -_MAX_LOG_ODDS
    return Signals(
        log_odds=float(np.clip(-against, -_MAX_LOG_ODDS, _MAX_LOG_ODDS)),
        cost=float(cost[best]),
        uncertainty=0.0 if query.profile is None else float(query.profile.log_scale.mean()),
        latent_distance=candidates[best].latent_distance,
    )
