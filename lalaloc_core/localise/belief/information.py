"""Information of a photograph about the place, and advice where it is too little."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

from lalaloc_core.conventions import TWO_PI
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.belief.posterior import area_shares
from lalaloc_core.localise.query import SeenObjects
from lalaloc_core.render.sampling import PoseSet

# Confidence from which no advice is given.
CONFIDENT = 0.5
# Azimuths (radians) that usually suffice; a photograph that shows less can lack what tells places apart.
_ENOUGH = math.radians(240.0)
# Confidence below which an answer without any warning gets a reason, whatever the photograph shows.
UNSURE = 0.1
# Arcs that are closer than this (radians) are one.
_TOUCHING = math.radians(0.5)


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


def reason_for(confidence: float, elsewhere: float, objects: SeenObjects | None, *, is_warned: bool) -> str | None:
    """Return why an answer's confidence is low; None where it is not, or where a warning tells already.

    `elsewhere` is the probability that the photograph shows no place of the plan, `objects` what it shows.
    """
    if confidence < CONFIDENT and objects is not None and objects.outside > 0.0:
        return (
            "no furniture or fittings are recognised in the photograph, as in one of a façade or a garden: send one "
            "that was taken in a room of the plan"
        )
    if confidence >= UNSURE or is_warned:
        return None
    low = f"the confidence is {confidence:.1%}, below {UNSURE:.0%}"
    if elsewhere < CONFIDENT:
        return f"{low}: several places look alike; send hints, such as the heading or the room, or more photographs"
    return (
        f"{low}: the photograph fits no place of the plan; check that the plan shows these rooms and is in metres, the "
        "camera height, the projection and the tilt"
    )
