"""Probability of places, and confidence and covariance of an answer.

Begin with `posterior.py`, the probability of all places; `ranking.py` orders candidates. `confidence.py` has the
probability that an answer is right, `covariance.py` its covariance, and `information.py` the information in the
photograph.
"""

from lalaloc_core.localise.belief.confidence import Confidence, Signals, confidence_of, signals_of
from lalaloc_core.localise.belief.covariance import PoseUncertainty, marginal_information, pose_uncertainty
from lalaloc_core.localise.belief.information import CONFIDENT, advice_for, information_bits, reason_for, union_of_arcs
from lalaloc_core.localise.belief.posterior import (
    HEADING_WITHIN,
    NEGLIGIBLE,
    RIGHT_WITHIN_M,
    GridCosts,
    Posterior,
    ProbabilityMap,
    Support,
    WeightedPlaces,
    area_shares,
    probability_map,
    weighted_places,
)
from lalaloc_core.localise.belief.ranking import HEADING_SEPARATION, distinct, photograph_heading, ranked, suppress
