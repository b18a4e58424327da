"""Probability of places, and confidence and covariance of an answer.

Begin with `posterior.py`, the probability of all places; `ranking.py` orders candidates. `confidence.py` has the
probability that an answer is right, its covariance, and advice where the photograph tells too little.
"""

from lalaloc_core.localise.belief.confidence import CONFIDENT, Confidence, confidence_of, pose_uncertainty, signals_of
from lalaloc_core.localise.belief.posterior import (
    RIGHT_WITHIN_M,
    GridCosts,
    Posterior,
    ProbabilityMap,
    Support,
    area_shares,
    or_misread,
    probability_map,
)
from lalaloc_core.localise.belief.ranking import HEADING_SEPARATION, distinct, photograph_heading, suppress
