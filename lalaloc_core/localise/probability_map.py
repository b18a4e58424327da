"""How probable the places of a plan are, for maps: the posterior where refinement moved it to.

A grid pose stands for what lies around it, and what is refined from it ends elsewhere: candidates that end at one place
have begun up to a metre from it. A map of the grid's poses would be dark where they began, and pale at the answer.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.posterior import Posterior
from lalaloc_core.render.sampling import PoseSet

# Places that are nearer to each other than this are told as one.
_APART_M = 0.01


@dataclass(frozen=True, eq=False)
class ProbabilityMap:
    """Places of rooms with their probabilities, which sum to one.

    Attributes:
        position_m: (k, 2) x and y.
        room_index: (k,) the room that each lies in.
    """

    position_m: Float[np.ndarray, "k 2"]
    room_index: Int[np.ndarray, "k"]
    probability: Float[np.ndarray, "k"]


def probability_map(plan: FloorPlan, poses: PoseSet, posterior: Posterior) -> ProbabilityMap:
    """The places that a posterior over the grid `poses` of a plan weighs.

    What was moved out of its room is left out: no camera stands in a wall.
    """
    support = posterior.support
    key = np.concatenate([support.pose[:, None], np.rint(support.position_m / _APART_M).astype(np.int64)], axis=1)
    _, first, which = np.unique(key, axis=0, return_index=True, return_inverse=True)
    weight = np.bincount(which.ravel(), support.weight, minlength=len(first))
    position_m, room = support.position_m[first], poses.room_index[support.pose[first]]
    inside = plan.room_index_at(position_m) == room
    if not weight[inside].sum() > 0.0:
        position_m, inside = poses.position_m[support.pose[first]], np.ones(len(first), bool)
    left = weight[inside]
    return ProbabilityMap(position_m[inside], room[inside], left / left.sum())
