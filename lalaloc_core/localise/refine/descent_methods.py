"""The two optimisers, Levenberg-Marquardt and Adam with the paper's schedule, and refinement by wall profiles.

Refinement by walls runs on numpy, in a third of the time that torch takes for arrays as small as these.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from array_api_compat import array_namespace, device
from jaxtyping import Float

from lalaloc_core.conventions import Array
from lalaloc_core.localise.refine.refinement_problem import (
    Evaluation,
    LpoConfig,
    Problem,
    RefinementJob,
    RefinementResult,
    clipped,
    diagonal,
)

# Refined poses and their evaluation; None if they are not wanted any more.
_Descent = tuple[Float[Array, "k p"], Evaluation] | None


def descend(problem: Problem, config: LpoConfig, wanted: Callable[[], bool] = lambda: True) -> RefinementResult | None:
    """Run the optimiser of the settings; None if the result is not `wanted` any more, asked before each iteration."""
    method = _adam if config.method == "adam" else _levenberg_marquardt
    found = method(problem, config, wanted)
    return None if found is None else problem.result(*found)


def refined_by_walls(job: RefinementJob) -> bool:
    """Return whether `refine_walls` does all of a job: its poses are compared by wall profiles alone."""
    return job.log_profile is not None and job.precision is not None and not job.latent_weight


def refine_walls(
    job: RefinementJob, config: LpoConfig | None = None, *, wanted: Callable[[], bool] = lambda: True
) -> RefinementResult | None:
    """Refine every starting pose of a job within its own room by its predicted wall profile; latents are not used.

    The result is without latent distances; None if it is not `wanted` any more, asked before each iteration.
    """
    assert job.log_profile is not None
    by_profile = replace(job, targets=job.log_profile)
    problem = Problem(job.log_profile.shape[1], "cauchy", by_profile, np.empty(0, np.float32))
    result = descend(problem, config or LpoConfig(), wanted)
    return None if result is None else replace(result, latent_distance=None)


def _levenberg_marquardt(problem: Problem, config: LpoConfig, wanted: Callable[[], bool]) -> _Descent:
    """Damped Gauss-Newton with Marquardt's scaling; each pose has its own damping and stops on its own."""
    xp = array_namespace(problem.start)
    pose = xp.asarray(problem.start, copy=True)
    here = problem.evaluate(pose)
    damping = xp.full_like(pose[:, 0], config.initial_damping)
    converged = xp.zeros(len(pose), dtype=xp.bool, device=device(pose))
    part, rows = problem, xp.arange(len(pose), device=device(pose))
    evaluations = 1
    while evaluations < config.max_iterations:
        if not wanted():
            return None
        going_on = ~converged[rows]
        if evaluations >= config.prune_after:
            going_on &= here.distance[rows] <= _worth_going_on(problem, here, config)
        if problem.norm == "cauchy" and evaluations >= config.profile_iterations:
            going_on &= here.distance[rows] < config.exact_cost
        left = rows[going_on]
        if len(left) == 0:
            break
        if len(left) < len(rows):
            part, rows = problem.rows(left), left
        before, start = here.rows(rows), pose[rows]
        step = part.stay_inside(start, _step(before, damping[rows]), config)
        there = part.evaluate(start + step)
        evaluations += 1
        better = there.cost < before.cost
        # A small decrease predicted by the linear model ends the search, even if the step failed.
        curved = (step[:, None, :] @ before.information @ step[:, :, None])[:, 0, 0]
        promised = -xp.sum(before.slope * step, axis=1) - 0.5 * curved
        least = config.tolerance_cost * before.cost
        gained = before.cost - there.cost
        short = xp.linalg.vector_norm(step, axis=1) < config.tolerance_m
        converged[rows] = short | (promised < least) | (better & (gained < least))
        chosen = xp.nonzero(better)[0]
        pose[rows[chosen]] += step[chosen]
        here.take_over(rows[chosen], there.rows(chosen))
        factor = xp.where(better, xp.full_like(damping[rows], 0.2), xp.full_like(damping[rows], 6.0))
        damping[rows] = clipped(damping[rows] * factor, 1e-6, 1e8)
    return pose, here


def _step(here: Evaluation, damping: Float[Array, "k"]) -> Float[Array, "k p"]:
    """Return the damped step of the linear model."""
    xp = array_namespace(damping)
    scaling = xp.linalg.diagonal(here.information) * damping[:, None] + 1e-8
    return -xp.linalg.solve(here.information + diagonal(scaling), here.slope[:, :, None])[:, :, 0]


def _worth_going_on(problem: Problem, here: Evaluation, config: LpoConfig) -> Array:
    """Return the distance up to which poses can still become the best."""
    nearest = array_namespace(here.distance).min(here.distance)
    return nearest + config.prune_margin if problem.norm == "cauchy" else config.prune_ratio * nearest


def _adam(problem: Problem, config: LpoConfig, wanted: Callable[[], bool]) -> _Descent:
    """Adam, its rate halved on plateaus, stopped when the cost no longer falls (paper, section A.3)."""
    pose = problem.start
    xp = array_namespace(pose)
    none = xp.zeros_like(pose[:, 0])
    first, second = xp.zeros_like(pose), xp.zeros_like(pose)
    rate = none + config.adam_learning_rate
    plateau_best = stop_best = best = none + math.inf
    plateau_age = stop_age = none
    best_pose = pose
    step_number = 0
    while step_number < config.adam_steps and not bool(xp.all(stop_age >= config.adam_stop_patience)):
        if not wanted():
            return None
        step_number += 1
        here = problem.evaluate(pose)
        cost = here.distance
        best_pose = xp.where((cost < best)[:, None], pose, best_pose)
        best = xp.minimum(cost, best)
        improved = cost < plateau_best * (1.0 - config.adam_plateau_threshold)
        plateau_best = xp.where(improved, cost, plateau_best)
        plateau_age = xp.where(improved, none, plateau_age + 1)
        stale = plateau_age > config.adam_plateau_patience
        rate = xp.where(stale, 0.5 * rate, rate)
        plateau_age = xp.where(stale, none, plateau_age)
        fell = cost < stop_best - config.adam_stop_threshold
        stop_best = xp.where(fell, cost, stop_best)
        stop_age = xp.where(fell, none, stop_age + 1)

        gradient = here.gradient
        first = 0.9 * first + 0.1 * gradient
        second = 0.999 * second + 0.001 * xp.square(gradient)
        direction = first / (1.0 - 0.9**step_number) / (xp.sqrt(second / (1.0 - 0.999**step_number)) + 1e-8)
        pose = pose + problem.stay_inside(pose, -rate[:, None] * direction, config)
    return best_pose, problem.evaluate(best_pose)
