"""The posterior in the words of the API."""

from __future__ import annotations

from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.poses import PoseGrid
from lalaloc_core.localise.posterior import Posterior
from lalaloc_core.localise.probability_map import probability_map
from service.schemas import PosteriorAnswer

# What is less probable would be told as 0.
_MIN_PROBABILITY = 5e-7


def posterior_answer(plan: FloorPlan, grid: PoseGrid, posterior: Posterior) -> PosteriorAnswer:
    """Places with their probabilities, without those that have next to none."""
    places = probability_map(plan, grid.poses, posterior)
    told = places.probability >= _MIN_PROBABILITY
    position_m = places.position_m[told]
    return PosteriorAnswer(
        step_m=grid.step_m,
        x_m=position_m[:, 0].tolist(),
        y_m=position_m[:, 1].tolist(),
        probability=places.probability[told].tolist(),
    )
