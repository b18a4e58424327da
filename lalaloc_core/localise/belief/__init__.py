"""Probability of places, and confidence and covariance of an answer.

Begin with `posterior.py`, the probability of all places; `ranking.py` orders candidates. `confidence.py` has the
probability that an answer is right, its covariance, and advice where the photograph tells too little.
"""

from lalaloc_core.localise.belief.confidence import (
    CONFIDENT,
    Confidence,
    PoseUncertainty,
    Signals,
    advice_for,
    confidence_of,
    information_bits,
    is_outside,
    marginal_information,
    pose_uncertainty,
    reason_for,
    signals_of,
    union_of_arcs,
)
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
    or_misread,
    probability_map,
    weighted_places,
)
from lalaloc_core.localise.belief.ranking import HEADING_SEPARATION, distinct, photograph_heading, ranked, suppress
