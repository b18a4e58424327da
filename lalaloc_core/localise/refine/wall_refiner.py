"""Pose refinement by wall profiles on numpy: in a third of the time that torch takes for arrays as small as these."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from lalaloc_core.localise.refine.descent_methods import descend
from lalaloc_core.localise.refine.refinement_job import RefinementJob, RefinementResult
from lalaloc_core.localise.refine.refinement_problem import LpoConfig, Problem


def refined_by_walls(job: RefinementJob) -> bool:
    """Return whether `refine_walls` does all of a job: its poses are compared by wall profiles alone."""
    return job.log_profile is not None and job.precision is not None and not job.latent_weight


def refine_walls(
    job: RefinementJob, config: LpoConfig | None = None, *, wanted: Callable[[], bool] = lambda: True
) -> RefinementResult | None:
    """Refine every starting pose of a job within its own room by its predicted wall profile.

    Args:
        job: the job, with `log_profile` and `precision`; its latents are not used.
        config: settings of the optimiser.
        wanted: asked before each iteration whether the result is still wanted.

    Returns:
        The result without latent distances; None if it was not wanted any more.
    """
    assert job.log_profile is not None
    by_profile = replace(job, targets=job.log_profile)
    problem = Problem(job.log_profile.shape[1], "cauchy", by_profile, np.empty(0, np.float32))
    result = descend(problem, config or LpoConfig(), wanted)
    return None if result is None else replace(result, latent_distance=None)
