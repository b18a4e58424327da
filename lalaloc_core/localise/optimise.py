"""Latent pose optimisation (LPO): move a pose until the latent of its layout meets the query's (paper, section 4.2.1).

`min over pose of | Φ_layout(Ω(pose, plan)) - f |₂`, with the closed-form renderer Ω. Where the model predicts a wall
profile with its uncertainty, the layout's profile is compared with that, by the cost of `localise.evidence`. Two
optimisers share one evaluation (residuals and their derivatives by forward-mode differentiation, 2 or 3 unknowns
against 128 residuals; the log of true over stated camera height is one more where profiles are compared):

* Levenberg-Marquardt (default): under 15 evaluations, and more exact.
* Adam with the paper's schedule (section A.3): the reference.

Several starting poses are refined as one batch; every pose stays inside the room it started in. The network may be any
differentiable function of a layout (`PoseOptimiser`): comparing layouts themselves in place of their latents is a
baseline of the paper's.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from lalaloc_core.bundle import LAYOUT_WEIGHTS, Bundle
from lalaloc_core.errors import BundleError, ConfigError
from lalaloc_core.localise.poses import RefinementJob, RefinementResult
from lalaloc_core.nets import LayoutEncoder, load_layout_encoder
from lalaloc_core.nets.ring import RingLayoutEncoder
from lalaloc_core.render.profile import cast_rays, wall_profile

# What is compared with the targets (k, d): a function of wall profiles (k, columns), camera and ceiling heights (k,).
Embedding = Callable[[Tensor, Tensor, Tensor], Tensor]
# The distance that is minimised: Euclidean, the mean absolute difference, or the mean of log(1 + r²).
Norm = Literal["l2", "l1", "cauchy"]


@dataclass(frozen=True, kw_only=True)
class LpoConfig:
    """Settings of both optimisers.

    Attributes:
        margin_m: poses keep this distance to walls, so that none ends on the other side of one.
        tolerance_m: a Levenberg-Marquardt step shorter than this ends the search.
        tolerance_cost: and so does one that lowers the cost by less than this share, or would by the linear model.
        max_step_m, max_turn: longest step (m) and turn (radians) per iteration.
        prune_after, prune_ratio: after so many evaluations, starts farther than the best by this factor are left
            where they are: they will not become the answer.
        prune_margin: the same of wall profiles, by how much their cost exceeds the best; it is a log likelihood.
        adam_*: the paper's schedule.
    """

    method: Literal["levenberg-marquardt", "adam"] = "levenberg-marquardt"
    margin_m: float = 0.03
    max_iterations: int = 15
    tolerance_m: float = 1e-3
    tolerance_cost: float = 1e-2
    initial_damping: float = 1e-2
    max_step_m: float = 0.5
    max_turn: float = 0.2
    prune_after: int = 3
    prune_ratio: float = 1.5
    prune_margin: float = 0.6
    adam_learning_rate: float = 0.01
    adam_steps: int = 150
    adam_plateau_threshold: float = 0.05
    adam_plateau_patience: int = 10
    adam_stop_threshold: float = 0.001
    adam_stop_patience: int = 20


@dataclass(frozen=True)
class _Evaluation:
    """Residuals at a pose and their derivatives by its unknowns; `cost` is what Levenberg-Marquardt lowers.

    `value` are the unknowns themselves, held at zero with the squares of `stiffness`: a normal prior.
    """

    residual: Float[Tensor, "k d"]
    jacobian: Float[Tensor, "k d p"]
    norm: Norm
    value: Float[Tensor, "k p"]
    stiffness: Float[Tensor, "p"]

    @property
    def cost(self) -> Float[Tensor, "k"]:
        held = 0.5 * (self.value * self.stiffness).square().sum(dim=1)
        if self.norm == "cauchy":
            return 0.5 * self.residual.square().log1p().sum(dim=1) + held
        return 0.5 * self.residual.square().sum(dim=1) + held

    @property
    def weighted(self) -> Float[Tensor, "k d p"]:
        """The Jacobian, its rows weighted so that squares have the slope of `cost` (iteratively re-weighted)."""
        if self.norm == "cauchy":
            return self.jacobian / (1.0 + self.residual.square())[:, :, None]
        return self.jacobian

    @property
    def information(self) -> Float[Tensor, "k p p"]:
        """Curvature of `cost` by the unknowns, after Gauss and Newton."""
        return torch.einsum("kdp,kdq->kpq", self.weighted, self.jacobian) + torch.diag(self.stiffness.square())

    @property
    def distance(self) -> Float[Tensor, "k"]:
        if self.norm == "l1":
            return self.residual.abs().mean(dim=1)
        if self.norm == "cauchy":
            return self.residual.square().log1p().mean(dim=1)
        return torch.linalg.vector_norm(self.residual, dim=1)

    @property
    def slope(self) -> Float[Tensor, "k p"]:
        """Derivative of `cost` by the unknowns."""
        held = self.value * self.stiffness.square()
        return torch.einsum("kdp,kd->kp", self.weighted, self.residual) + held

    @property
    def gradient(self) -> Float[Tensor, "k p"]:
        """Derivative of the distance by the unknowns."""
        if self.norm == "l1":
            return torch.einsum("kdp,kd->kp", self.jacobian, self.residual.sign()) / self.residual.shape[1]
        if self.norm == "cauchy":
            return 2.0 * torch.einsum("kdp,kd->kp", self.weighted, self.residual) / self.residual.shape[1]
        return torch.einsum("kdp,kd->kp", self.jacobian, self.residual) / self.distance.clamp_min(1e-9)[:, None]

    def take_over(self, rows: Tensor, other: _Evaluation, chosen: Tensor) -> None:
        """Replace by those rows of `other`, which holds `rows` of this one, that are `chosen`."""
        self.value[rows[chosen]] = other.value[chosen]
        self.residual[rows[chosen]] = other.residual[chosen]
        self.jacobian[rows[chosen]] = other.jacobian[chosen]


class PoseOptimiser:
    """Refines poses until what an embedding makes of their layouts is nearest to the targets."""

    def __init__(
        self,
        embedding: Embedding,
        columns: int,
        *,
        norm: Norm = "l2",
        config: LpoConfig | None = None,
        device: torch.device | None = None,
    ) -> None:
        """Choose what is compared, and how.

        Args:
            columns: azimuth columns of the wall profiles that the embedding takes.

        Raises:
            ConfigError: Levenberg-Marquardt is asked to minimise absolute differences.
        """
        self.config = config or LpoConfig()
        if norm == "l1" and self.config.method != "adam":
            raise ConfigError(f"optimiser '{self.config.method}' needs a smooth cost; norm '{norm}' needs 'adam'")
        self._embedding = embedding
        self._columns = columns
        self._norm: Norm = norm
        self._device = device or torch.device("cpu")

    def refine(self, job: RefinementJob) -> RefinementResult:
        """Refine every starting pose of a job within its own room by its `targets`, and `precision` where it has some.

        Both distances of the result are by this optimiser's norm.
        """
        problem = _Problem(self._embedding, self._columns, self._norm, job, self._device)
        adam = self.config.method == "adam"
        with torch.no_grad():
            pose, here, converged, evaluations = (_adam if adam else _levenberg_marquardt)(problem, self.config)
        position, heading, height_offset = problem.unpack(pose)
        information = here.information if height_offset is None else _without_last(here.information)
        distance = here.distance.cpu().numpy()
        return RefinementResult(
            position_m=position.cpu().numpy().astype(np.float64) + problem.origin,
            heading=heading.cpu().numpy().astype(np.float64),
            cost=distance,
            latent_distance=distance,
            information=information.cpu().numpy(),
            converged=converged.cpu().numpy(),
            evaluations=np.full(len(distance), evaluations),
            height_offset=None if height_offset is None else height_offset.cpu().numpy().astype(np.float64),
        )


class LatentPoseOptimiser:
    """Refines poses with one layout encoder, by predicted wall profiles where a job has them."""

    def __init__(self, layout_encoder: LayoutEncoder, config: LpoConfig | None = None) -> None:
        layout_encoder = layout_encoder.eval().requires_grad_(False)
        self.encoder = layout_encoder.fused() if isinstance(layout_encoder, RingLayoutEncoder) else layout_encoder
        self._device = next(layout_encoder.parameters()).device
        self._config = config or LpoConfig()
        self._columns = self.encoder.config.profile_columns

    @classmethod
    def from_bundle(cls, bundle: Bundle, config: LpoConfig | None = None) -> LatentPoseOptimiser:
        """Load the layout encoder of a bundle.

        Raises:
            BundleError: weights are missing, altered, or do not fit the manifest's configuration.
        """
        manifest = bundle.manifest
        try:
            encoder = load_layout_encoder(manifest.architecture, manifest.layout_config, bundle.read(LAYOUT_WEIGHTS))
        except (RuntimeError, ValueError, TypeError) as error:
            raise BundleError(f"bundle '{bundle.folder}': layout encoder does not load: {error}") from error
        return cls(encoder, config)

    def refine(self, job: RefinementJob) -> RefinementResult:
        """Refine every starting pose of a job within its own room."""
        if job.log_profile is None or job.precision is None:
            return self._optimiser(self.encoder, "l2").refine(replace(job, precision=None))
        by_profile = replace(job, targets=job.log_profile)
        result = self._optimiser(_log_profile, "cauchy").refine(by_profile)
        distance = self._latent_distance(job, result)
        return replace(result, cost=result.cost + job.latent_weight * distance, latent_distance=distance)

    def _optimiser(self, embedding: Embedding, norm: Norm) -> PoseOptimiser:
        return PoseOptimiser(embedding, self._columns, norm=norm, config=self._config, device=self._device)

    @torch.no_grad()
    def _latent_distance(self, job: RefinementJob, result: RefinementResult) -> Float[np.ndarray, "k"]:
        """How far the latents of the refined poses are from the query's."""

        def tensor(array: np.ndarray) -> Tensor:
            return torch.tensor(array, dtype=torch.float32, device=self._device)

        relative = tensor(job.walls_m - np.tile(result.position_m, 2)[:, None, :])
        profile = wall_profile(torch.zeros_like(relative[:, 0, :2]), tensor(result.heading), relative, self._columns)
        latent = self.encoder(profile, tensor(job.camera_height_m), tensor(job.ceiling_height_m))
        return torch.linalg.vector_norm(latent - tensor(job.targets), dim=1).cpu().numpy()


def _log_profile(profile_m: Tensor, _camera_height_m: Tensor, _ceiling_height_m: Tensor) -> Tensor:
    return torch.log(profile_m)


class _Problem:
    """The residuals of one job as a function of the unknowns: x, y, then heading and height offset where wanted.

    Positions are relative to each starting pose, so that single precision does not lose millimetres in large plans.
    """

    def __init__(
        self, embedding: Embedding, columns: int, norm: Norm, job: RefinementJob, device: torch.device
    ) -> None:
        def tensor(array: np.ndarray) -> Tensor:
            return torch.tensor(array, dtype=torch.float32, device=device)

        self.embedding = embedding
        self.columns = columns
        self.norm: Norm = norm
        self.origin = job.position_m
        self.walls_m = tensor(job.walls_m - np.tile(job.position_m, 2)[:, None, :])
        self.heading = tensor(job.heading)
        self.camera_height_m = tensor(job.camera_height_m)
        self.ceiling_height_m = tensor(job.ceiling_height_m)
        self.targets = tensor(job.targets)
        self.precision = None if job.precision is None else tensor(job.precision)
        # Those that move the layout; the camera height is one more behind them.
        self.moving = 3 if job.optimise_heading else 2
        self.height_bounds = job.height_bounds
        stiffness = [0.0] * self.moving
        start = torch.zeros(len(job.targets), self.moving, device=device)
        if job.height_offset is not None:
            start = torch.cat([start, tensor(job.height_offset)[:, None]], dim=1)
            stiffness.append(job.height_stiffness)
        self.start = start
        self.stiffness = torch.tensor(stiffness, device=device)

    def unpack(
        self, pose: Float[Tensor, "k p"]
    ) -> tuple[Float[Tensor, "k 2"], Float[Tensor, "k"], Float[Tensor, "k"] | None]:
        """Position (m, relative to the start), heading (radians), and the height's offset where it is solved for."""
        turned = self.heading + pose[:, 2] if self.moving == 3 else self.heading
        return pose[:, :2], turned, pose[:, self.moving] if pose.shape[1] > self.moving else None

    def evaluate(self, pose: Float[Tensor, "m p"], rows: Tensor) -> _Evaluation:
        """Residuals and Jacobian of these rows of the job, all unknowns at once: each row repeated per unknown."""
        count = len(pose)

        def repeat(value: Tensor) -> Tensor:
            return value[rows].repeat_interleave(self.moving, dim=0)

        walls, camera, ceiling = map(repeat, (self.walls_m, self.camera_height_m, self.ceiling_height_m))
        start_heading = repeat(self.heading)

        def embedded(unknowns: Tensor) -> Tensor:
            heading = start_heading + unknowns[:, 2] if self.moving == 3 else start_heading
            profile = wall_profile(unknowns[:, :2], heading, walls, self.columns)
            return self.embedding(profile, camera, ceiling)

        tangent = torch.eye(self.moving, device=pose.device).repeat(count, 1)
        repeated = pose[:, : self.moving].repeat_interleave(self.moving, dim=0)
        value, derivative = torch.func.jvp(embedded, (repeated,), (tangent,))[:2]
        residual = value[:: self.moving] - self.targets[rows]
        jacobian = derivative.reshape(count, self.moving, -1).transpose(1, 2)
        if pose.shape[1] > self.moving:
            # The offset is added to the target, the same for all azimuths.
            residual = residual - pose[:, self.moving, None]
            jacobian = torch.cat([jacobian, -torch.ones_like(residual)[:, :, None]], dim=2)
        if self.precision is not None:
            residual, jacobian = residual * self.precision[rows], jacobian * self.precision[rows][:, :, None]
        return _Evaluation(residual, jacobian, self.norm, pose.clone(), self.stiffness)

    def stay_inside(
        self, pose: Float[Tensor, "m p"], step: Float[Tensor, "m p"], rows: Tensor, config: LpoConfig
    ) -> Float[Tensor, "m p"]:
        """The step, shortened where it is too long or would come closer to a wall than the margin."""
        length = torch.linalg.vector_norm(step[:, :2], dim=1)
        azimuth = torch.atan2(step[:, 0], step[:, 1])
        free = cast_rays(pose[:, :2], azimuth[:, None], self.walls_m[rows])[:, 0] - config.margin_m
        allowed = free.clamp(0.0, config.max_step_m)
        scale = torch.where(length > allowed, allowed / length.clamp_min(1e-9), torch.ones_like(length))
        turn = step[:, 2 : self.moving].clamp(-config.max_turn, config.max_turn)
        height, (low, high) = pose[:, self.moving :], self.height_bounds
        return torch.cat(
            [step[:, :2] * scale[:, None], turn, (height + step[:, self.moving :]).clamp(low, high) - height], dim=1
        )


def _without_last(information: Float[Tensor, "k p p"]) -> Float[Tensor, "k q q"]:
    """Information about all unknowns but the last, which is integrated out (Schur complement)."""
    cross, last = information[:, :-1, -1], information[:, -1, -1].clamp_min(1e-9)
    return information[:, :-1, :-1] - cross[:, :, None] * cross[:, None, :] / last[:, None, None]


# Poses, the evaluation there, whether each converged, and the number of evaluations.
_Outcome = tuple[Tensor, _Evaluation, Tensor, int]


def _levenberg_marquardt(problem: _Problem, config: LpoConfig) -> _Outcome:
    """Damped Gauss-Newton with Marquardt's scaling; each pose has its own damping and stops on its own."""
    pose = problem.start.clone()
    rows = torch.arange(len(pose), device=pose.device)
    here = problem.evaluate(pose, rows)
    damping = torch.full((len(pose),), config.initial_damping, device=pose.device)
    converged = torch.zeros(len(pose), dtype=torch.bool, device=pose.device)
    evaluations = 1
    while evaluations < config.max_iterations:
        active = ~converged
        if evaluations >= config.prune_after:
            active &= here.distance <= _worth_going_on(here, config)
        rows = active.nonzero()[:, 0]
        if len(rows) == 0:
            break
        gradient = here.slope[rows]
        hessian = here.information[rows]
        scaling = torch.diagonal(hessian, dim1=1, dim2=2) * damping[rows, None] + 1e-8
        step = -torch.linalg.solve(hessian + torch.diag_embed(scaling), gradient)
        step = problem.stay_inside(pose[rows], step, rows, config)
        there = problem.evaluate(pose[rows] + step, rows)
        evaluations += 1
        better = there.cost < here.cost[rows]
        # What the linear model promised: little promised is little to lose, whether the step was good or not.
        promised = -torch.einsum("kp,kp->k", gradient, step) - 0.5 * torch.einsum("kp,kpq,kq->k", step, hessian, step)
        least = config.tolerance_cost * here.cost[rows]
        gained = here.cost[rows] - there.cost
        short = torch.linalg.vector_norm(step, dim=1) < config.tolerance_m
        converged[rows] = short | (promised < least) | (better & (gained < least))
        pose[rows[better]] += step[better]
        here.take_over(rows, there, better)
        damping[rows] = (damping[rows] * torch.where(better, 0.2, 6.0)).clamp(1e-6, 1e8)
    return pose, here, converged, evaluations


def _worth_going_on(here: _Evaluation, config: LpoConfig) -> Tensor:
    """The distance up to which poses may still become the best."""
    nearest = here.distance.min()
    return nearest + config.prune_margin if here.norm == "cauchy" else config.prune_ratio * nearest


def _adam(problem: _Problem, config: LpoConfig) -> _Outcome:
    """Adam, its rate halved on plateaus, stopped when the cost no longer falls (paper, section A.3)."""
    pose = problem.start
    count = len(pose)
    first, second = torch.zeros_like(pose), torch.zeros_like(pose)
    rate = torch.full((count,), config.adam_learning_rate, device=pose.device)
    plateau_best = stop_best = best = torch.full((count,), math.inf, device=pose.device)
    plateau_age = torch.zeros(count, device=pose.device)
    stop_age = torch.zeros(count, device=pose.device)
    best_pose = pose
    rows = torch.arange(count, device=pose.device)
    step_number = 0
    while step_number < config.adam_steps and not bool((stop_age >= config.adam_stop_patience).all()):
        step_number += 1
        here = problem.evaluate(pose, rows)
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
        pose = pose + problem.stay_inside(pose, -rate[:, None] * direction, rows, config)
    return best_pose, problem.evaluate(best_pose, rows), stop_age >= config.adam_stop_patience, step_number
