"""Probability of the places of a plan, for maps: the posterior at the refined places.

Candidates that end at one place can begin up to a metre from it, so a map of the grid's poses would show the
probability beside the answer.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.posterior import Posterior
from lalaloc_core.render.sampling import PoseSet

# Places are merged on a lattice of this step.
_STEP_M = 0.01


@dataclass(frozen=True, eq=False)
class ProbabilityMap:
    """Places with their probabilities.

    Attributes:
        position_m: (k, 2) positions (m).
        room_index: (k,) rooms.
        probability: (k,) probabilities; the sum is one.
    """

    position_m: Float[np.ndarray, "k 2"]
    room_index: Int[np.ndarray, "k"]
    probability: Float[np.ndarray, "k"]


def probability_map(plan: FloorPlan, poses: PoseSet, posterior: Posterior) -> ProbabilityMap:
    """Return the places of a posterior over the grid `poses` of a plan.

    Places that refinement moved out of their rooms are left out, unless all were.
    """
    support = posterior.support
    key = np.concatenate([support.pose[:, None], np.rint(support.position_m / _STEP_M).astype(np.int64)], axis=1)
    _, first, which = np.unique(key, axis=0, return_index=True, return_inverse=True)
    weight = np.bincount(which.ravel(), support.weight, minlength=len(first))
    position_m, room = support.position_m[first], poses.room_index[support.pose[first]]
    inside = plan.room_index_at(position_m) == room
    if not weight[inside].sum() > 0.0:
        position_m, inside = poses.position_m[support.pose[first]], np.ones(len(first), bool)
    left = weight[inside]
    return ProbabilityMap(position_m[inside], room[inside], left / left.sum())
