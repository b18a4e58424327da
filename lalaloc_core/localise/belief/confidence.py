"""Confidence and covariance of an answer.

The confidence is the posterior within 1 m of the answer, times the probability that the photograph fits the plan.
The fit is judged by signals that do not compare places: the cost of the best place, also relative to that of a fit by
chance (`match.fit_by_chance`), the uncertainty that the image encoder predicts, and the latent distance. A logistic
model of the signals (`bundle.ConfidenceModel`) is fitted on validation queries and on photographs of unknown places
(`lalaloc_core.evaluate.calibrate`).

Near its minimum the cost is a parabola, and the inverse of its curvature (`Candidate.information`) is the covariance
up to a factor, which is fitted on validation queries as well. If the heading was searched, position and heading are
each reported with the other integrated out.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

import numpy as np
from jaxtyping import Float

from lalaloc_core.bundle import ConfidenceModel
from lalaloc_core.conventions import TWO_PI
from lalaloc_core.floorplan import FloorPlan, Room
from lalaloc_core.localise.belief.posterior import Posterior, area_shares
from lalaloc_core.localise.match import log_cost_to_chance
from lalaloc_core.localise.query import Candidate, Query, SeenObjects
from lalaloc_core.render.sampling import PoseSet

# Limit of the posterior's log odds, either way.
_MAX_LOG_ODDS = 6.0
# Curvatures are single precision; eigenvalues below this share of the largest are rounding errors.
_PRECISION = 1e-6
# Standard deviation (radians) of an unknown heading.
_ANY_HEADING_STD = math.pi / math.sqrt(3.0)
# Confidence from which no advice is given.
CONFIDENT = 0.5
# Azimuths (radians) that usually suffice; a photograph that shows less can lack what tells places apart.
_ENOUGH = math.radians(240.0)
# Confidence below which an answer without any warning gets a reason, whatever the photograph shows.
_UNSURE = 0.1
# Arcs that are closer than this (radians) are one.
_TOUCHING = math.radians(0.5)


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
    `by_chance` that of a fit by chance (`localise.match.fit_by_chance`).
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
) -> Confidence | None:
    """Return the confidence of an answer; None without a model, or if the model was not fitted on the stage.

    `signals` are the answer's after `stage`; `heading_known` states that the heading was given exactly; `share` is the
    probability that the place is among those that were searched.
    """
    fit = None if model is None else model.fit_probability(stage, asdict(signals), heading_known=heading_known)
    if fit is None:
        return None
    fit *= share
    return Confidence(
        fit=fit,
        position=fit * posterior.position,
        heading=fit * min(posterior.heading, 1.0),
        candidates=tuple(fit * probability for probability in posterior.candidate),
    )


def pose_uncertainty(
    information: Float[np.ndarray, "p p"], room: Room, model: ConfidenceModel
) -> tuple[Float[np.ndarray, "2 2"], float | None] | None:
    """Return the uncertainty of a pose in a room; None if the model has no factors for it.

    It is the covariance of (x, y) in m², plan frame, and the standard deviation of the heading (radians), None if the
    heading was given.

    Standard deviations are limited to those of a uniform distribution: over the room's longest extent (its length over
    √12), as along a corridor without visible ends, and over all headings (π/√3).
    """
    searched = len(information) == 3
    factor = model.position_factor_searched if searched else model.position_factor
    if factor is None or (searched and model.heading_factor is None):
        return None
    by_position, by_heading = marginal_information(information)
    widest_m = float(np.hypot(*np.ptp(room.polygon_m, axis=0))) / math.sqrt(12.0)
    curvature, axes = np.linalg.eigh(by_position)
    variance = factor / np.maximum(curvature, factor / widest_m**2) if factor > 0.0 else np.zeros(2)
    covariance = (axes * variance) @ axes.T
    heading_std = None
    if by_heading is not None and model.heading_factor is not None:
        heading_std = _ANY_HEADING_STD
        if by_heading > 0.0:
            heading_std = min(math.sqrt(model.heading_factor / by_heading), _ANY_HEADING_STD)
    return 0.5 * (covariance + covariance.T), heading_std


def marginal_information(information: Float[np.ndarray, "p p"]) -> tuple[Float[np.ndarray, "2 2"], float | None]:
    """Return the information about the position with the heading integrated out, and about the heading likewise.

    Both are inverses of blocks of the inverse (Schur complements), and exist where that does not. The information is by
    x, y (m) and, if it was searched, the heading (radians).
    """
    full = np.asarray(information, dtype=np.float64)
    by_position = full[:2, :2]
    if len(full) == 2:
        return by_position, None
    cross, by_heading = full[:2, 2], full[2, 2]
    known_position = cross @ np.linalg.pinv(by_position, rcond=_PRECISION, hermitian=True) @ cross
    left = max(by_heading - known_position, 0.0)
    if by_heading > 0.0:
        by_position = by_position - np.outer(cross, cross) / by_heading
    return by_position, float(left)


def information_bits(plan: FloorPlan, poses: PoseSet, probability: Float[np.ndarray, "n"]) -> float:
    """Return the information of a query about the place, in bits.

    It is the Kullback-Leibler divergence of the posterior `probability` of grid poses from their shares of the plan's
    area: 0 if all places stay equally likely, one more bit for each halving of the area that is left.
    """
    log_prior = area_shares(poses, plan.areas_m2)
    log_prior = log_prior - np.logaddexp.reduce(log_prior)
    likely = probability > 0.0
    share = probability[likely]
    return max(float((share * (np.log2(share) - log_prior[likely] / math.log(2.0))).sum()), 0.0)


def union_of_arcs(arcs: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return the union of arcs of azimuths (radians, first and last), each beginning in [-π, π)."""
    turned = sorted(
        (begin - TWO_PI * math.floor((begin + math.pi) / TWO_PI), min(end - begin, TWO_PI)) for begin, end in arcs
    )
    union: list[tuple[float, float]] = []
    for begin, length in turned:
        if union and begin <= union[-1][1] + _TOUCHING:
            union[-1] = (union[-1][0], max(union[-1][1], begin + length))
        else:
            union.append((begin, begin + length))
    # Arcs that pass ±π can reach the first ones.
    while len(union) > 1 and union[-1][1] - TWO_PI + _TOUCHING >= union[0][0]:
        first = union.pop(0)
        union[-1] = (union[-1][0], max(union[-1][1], first[1] + TWO_PI))
    if union[0][1] - union[0][0] >= TWO_PI - _TOUCHING:
        return [(-math.pi, math.pi)]
    return union


def advice_for(arcs: list[tuple[float, float]], confidence: float) -> str | None:
    """Return advice how to photograph a place whose answer has a low confidence; None where there is none.

    `arcs` are the azimuths that were seen, from `union_of_arcs`.
    """
    seen = sum(end - begin for begin, end in arcs)
    if confidence >= CONFIDENT or seen >= _ENOUGH:
        return None
    return (
        f"turn around: {math.degrees(seen):.0f}° of the surroundings are too little to tell the place; take more "
        "photographs from the same spot, each turned by at most half the field of view, and send them as one query "
        "with motion=turn"
    )


def is_outside(confidence: Confidence | None, objects: SeenObjects | None) -> bool:
    """Return whether a photograph was probably taken outside, by its fit and, as in albums, by what it shows."""
    if objects is None or objects.outside <= 0.0:
        return False
    return confidence is None or confidence.elsewhere * math.exp(objects.outside) >= confidence.fit


def reason_for(confidence: float, elsewhere: float, objects: SeenObjects | None, *, is_warned: bool) -> str | None:
    """Return why an answer's confidence is low; None where it is not, or where a warning tells already.

    `elsewhere` is the probability that the photograph shows no place of the plan, `objects` what it shows.
    """
    if confidence < CONFIDENT and objects is not None and objects.outside > 0.0:
        return (
            "no furniture or fittings are recognised in the photograph, as in one of a façade or a garden: send one "
            "that was taken in a room of the plan"
        )
    if confidence >= _UNSURE or is_warned:
        return None
    low = f"the confidence is {confidence:.1%}, below {_UNSURE:.0%}"
    if elsewhere < CONFIDENT:
        return f"{low}: several places look alike; send hints, such as the heading or the room, or more photographs"
    return (
        f"{low}: the photograph fits no place of the plan; check that the plan shows these rooms and is in metres, the "
        "camera height, the field of view (also after cropping), the projection and the tilt"
    )
