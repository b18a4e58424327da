"""The two optimisers: Levenberg-Marquardt, and Adam with the paper's schedule."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lalaloc_core.localise.optimise.problem import Evaluation, LpoConfig, Problem


class DescentResult(NamedTuple):
    """Refined poses, their evaluation, whether they converged, and the number of evaluations."""

    pose: Float[Tensor, "k p"]
    evaluation: Evaluation
    converged: Bool[Tensor, "k"]
    evaluations: int


def levenberg_marquardt(problem: Problem, config: LpoConfig) -> DescentResult:
    """Damped Gauss-Newton with Marquardt's scaling; each pose has its own damping and stops on its own."""
    pose = problem.start.clone()
    here = problem.evaluate(pose)
    damping = torch.full((len(pose),), config.initial_damping, device=pose.device)
    converged = torch.zeros(len(pose), dtype=torch.bool, device=pose.device)
    part, rows = problem, torch.arange(len(pose), device=pose.device)
    evaluations = 1
    while evaluations < config.max_iterations:
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
        curved = torch.einsum("kp,kpq,kq->k", step, before.information, step)
        promised = -(before.slope * step).sum(dim=1) - 0.5 * curved
        least = config.tolerance_cost * before.cost
        gained = before.cost - there.cost
        short = torch.linalg.vector_norm(step, dim=1) < config.tolerance_m
        converged[rows] = short | (promised < least) | (better & (gained < least))
        chosen = better.nonzero()[:, 0]
        pose[rows[chosen]] += step[chosen]
        here.take_over(rows[chosen], there.rows(chosen))
        damping[rows] = (damping[rows] * torch.where(better, 0.2, 6.0)).clamp(1e-6, 1e8)
    return DescentResult(pose, here, converged, evaluations)


def _step(here: Evaluation, damping: Float[Tensor, "k"]) -> Float[Tensor, "k p"]:
    """Return the damped step of the linear model."""
    scaling = torch.diagonal(here.information, dim1=1, dim2=2) * damping[:, None] + 1e-8
    return -torch.linalg.solve(here.information + torch.diag_embed(scaling), here.slope)


def _worth_going_on(problem: Problem, here: Evaluation, config: LpoConfig) -> Tensor:
    """Return the distance up to which poses can still become the best."""
    nearest = here.distance.min()
    return nearest + config.prune_margin if problem.norm == "cauchy" else config.prune_ratio * nearest


def adam(problem: Problem, config: LpoConfig) -> DescentResult:
    """Adam, its rate halved on plateaus, stopped when the cost no longer falls (paper, section A.3)."""
    pose = problem.start
    count = len(pose)
    first, second = torch.zeros_like(pose), torch.zeros_like(pose)
    rate = torch.full((count,), config.adam_learning_rate, device=pose.device)
    plateau_best = stop_best = best = torch.full((count,), math.inf, device=pose.device)
    plateau_age = torch.zeros(count, device=pose.device)
    stop_age = torch.zeros(count, device=pose.device)
    best_pose = pose
    step_number = 0
    while step_number < config.adam_steps and not bool((stop_age >= config.adam_stop_patience).all()):
        step_number += 1
        here = problem.evaluate(pose)
        cost = here.distance
        best_pose = torch.where((cost < best)[:, None], pose, best_pose)
        best = torch.minimum(cost, best)
        improved = cost < plateau_best * (1.0 - config.adam_plateau_threshold)
        plateau_best = torch.where(improved, cost, plateau_best)
        plateau_age = torch.where(improved, torch.zeros_like(plateau_age), plateau_age + 1)
        stale = plateau_age > config.adam_plateau_patience
        rate = torch.where(stale, 0.5 * rate, rate)
        plateau_age = torch.where(stale, torch.zeros_like(plateau_age), plateau_age)
        fell = cost < stop_best - config.adam_stop_threshold
        stop_best = torch.where(fell, cost, stop_best)
        stop_age = torch.where(fell, torch.zeros_like(stop_age), stop_age + 1)

        gradient = here.gradient
        first = 0.9 * first + 0.1 * gradient
        second = 0.999 * second + 0.001 * gradient.square()
        direction = first / (1.0 - 0.9**step_number) / ((second / (1.0 - 0.999**step_number)).sqrt() + 1e-8)
        pose = pose + problem.stay_inside(pose, -rate[:, None] * direction, config)
    return DescentResult(best_pose, problem.evaluate(best_pose), stop_age >= config.adam_stop_patience, step_number)
