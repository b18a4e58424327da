"""The posterior in the words of the API."""

from __future__ import annotations

import numpy as np

from lalaloc_core.localise.poses import LatentGrid
from lalaloc_core.localise.posterior import Posterior
from service.schemas import PosteriorAnswer

# What is less probable would be told as 0.
_LEAST = 5e-7


def posterior_answer(grid: LatentGrid, posterior: Posterior) -> PosteriorAnswer:
    """Places of the grid with their probabilities, without those that have next to none."""
    index = np.flatnonzero(posterior.pose >= _LEAST)
    position = grid.poses.position_m[index]
    return PosteriorAnswer(
        step_m=grid.step_m,
        x_m=position[:, 0].tolist(),
        y_m=position[:, 1].tolist(),
        probability=posterior.pose[index].tolist(),
    )
