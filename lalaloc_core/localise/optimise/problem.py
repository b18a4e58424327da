"""Problem of pose refinement: the cost of poses as a function of the unknowns, and its derivatives.

The unknowns u of a pose are x and y, then the heading and the height offset δ if they are refined. With the log wall
profile of the layout at u, the embedding Φ of the layout (or the log profile itself), the targets f and the factors p
(`RefinementJob.precision`, or 1), the residuals are

    r = p (Φ(layout(u)) - f - δ)                                           `Problem.evaluate`

with the Jacobian J = ∂r / ∂u: the derivative of the renderer in closed form, times that of Φ by forward-mode
differentiation (`Problem._embedded`). The cost that Levenberg-Marquardt lowers, its slope and its Gauss-Newton
curvature are

    C = ½ Σ ρ(r) + ½ Σ (s u)²    C' = J w r + s² u    H = J w Jᵀ + s²      `Problem._evaluation`

with ρ(r) = log(1 + r²) and w = 1 / (1 + r²) for the norm "cauchy", else ρ(r) = r² and w = 1; s is the stiffness of
unknowns with a normal prior. Results report the distance D, and Adam lowers it: the root of Σ r² for "l2", the mean of
absolute residuals for "l1", and the mean of log(1 + r²) for "cauchy", which is the walls' term of the matching cost.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from lalaloc_core.localise.poses import RefinementJob
from lalaloc_core.render.gradient import ProfileJacobian, free_travel_m, log_profile_gradient

# Function of wall profiles (k, columns), camera and ceiling heights (k,), compared with the targets (k, d).
Embedding = Callable[[Tensor, Tensor, Tensor], Tensor]
# Distance that is minimised: Euclidean, mean absolute difference, or the mean of log(1 + r²).
Norm = Literal["l2", "l1", "cauchy"]


@dataclass(frozen=True, kw_only=True)
class LpoConfig:
    """Settings of both optimisers.

    Attributes:
        margin_m: smallest distance of poses to walls, so that none crosses one.
        max_iterations: maximum number of Levenberg-Marquardt evaluations, including the first at the start.
        profile_iterations: the same for wall profiles; more steps would follow errors of the prediction.
        exact_cost: poses below this cost continue up to `max_iterations`.
        tolerance_m: a Levenberg-Marquardt step shorter than this ends the search.
        tolerance_cost: a step that lowers the cost by less than this share, or would by the linear model, ends it too.
        initial_damping: damping of the first step.
        max_step_m, max_turn: longest step (m) and turn (radians) per iteration.
        prune_after: number of evaluations after which starts that cannot become the answer are left.
        prune_ratio: such starts are farther than the best by this factor.
        prune_margin: the same for wall profiles: their cost exceeds the best by this.
        adam_*: the paper's schedule.
    """

    method: Literal["levenberg-marquardt", "adam"] = "levenberg-marquardt"
    margin_m: float = 0.03
    max_iterations: int = 15
    profile_iterations: int = 4
    exact_cost: float = 0.01
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
class Evaluation:
    """Costs of k poses with derivatives by p unknowns; the symbols are those of the module's docstring.

    Attributes:
        cost: (k,) C, with the prior.
        slope: (k, p) C', the derivative of the cost.
        information: (k, p, p) H, the curvature of the cost.
        distance: (k,) D, without the prior.
        gradient: (k, p) derivative of the distance.
    """

    cost: Float[Tensor, "k"]
    slope: Float[Tensor, "k p"]
    information: Float[Tensor, "k p p"]
    distance: Float[Tensor, "k"]
    gradient: Float[Tensor, "k p"]

    def rows(self, index: Int[Tensor, "m"]) -> Evaluation:
        """Return the evaluation of some of the poses."""
        return Evaluation(*(value[index] for value in vars(self).values()))

    def take_over(self, index: Int[Tensor, "m"], other: Evaluation) -> None:
        """Replace these rows by those of `other`."""
        for name, value in vars(self).items():
            value[index] = getattr(other, name)


class Problem:
    """Residuals of one job as a function of the unknowns: x, y, then heading and height offset if they are refined.

    Positions are relative to each starting pose, to keep millimetres in single precision in large plans.
    """

    def __init__(
        self, embedding: Embedding | None, columns: int, norm: Norm, job: RefinementJob, device: torch.device
    ) -> None:
        """Set up the problem.

        The arguments are those of `PoseOptimiser`, and the refinement job.
        """

        def tensor(array: np.ndarray) -> Tensor:
            return torch.as_tensor(array, dtype=torch.float32, device=device)

        self._embedding = embedding
        self._columns = columns
        self.norm: Norm = norm
        self.origin = job.position_m
        self._walls_m = tensor(job.walls_m - np.tile(job.position_m, 2)[:, None, :])
        self._heading = tensor(job.heading)
        self._camera_height_m = tensor(job.camera_height_m)
        self._ceiling_height_m = tensor(job.ceiling_height_m)
        self._targets = tensor(job.targets)
        self._precision = None if job.precision is None else tensor(job.precision)
        # Number of unknowns that move the layout; the camera height follows them.
        self._moving = 3 if job.optimise_heading else 2
        self._height_bounds = job.height_bounds
        stiffness = [0.0] * self._moving
        start = torch.zeros(len(job.targets), self._moving, device=device)
        if job.height_offset is not None:
            start = torch.cat([start, tensor(job.height_offset)[:, None]], dim=1)
            stiffness.append(job.height_stiffness)
        self.start = start
        self._stiffness = torch.tensor(stiffness, device=device).square()

    def unpack(
        self, pose: Float[Tensor, "k p"]
    ) -> tuple[Float[Tensor, "k 2"], Float[Tensor, "k"], Float[Tensor, "k"] | None]:
        """Return position (m, relative to the start), heading (radians), and height offset if it is solved for."""
        turned = self._heading + pose[:, 2] if self._moving == 3 else self._heading
        return pose[:, :2], turned, pose[:, self._moving] if pose.shape[1] > self._moving else None

    def rows(self, index: Int[Tensor, "m"]) -> Problem:
        """Return the problem of some of the poses."""
        part = object.__new__(Problem)
        part.__dict__.update(self.__dict__)
        for name in ("_walls_m", "_heading", "_camera_height_m", "_ceiling_height_m", "_targets", "_precision"):
            value = getattr(self, name)
            setattr(part, name, None if value is None else value[index])
        part.start, part.origin = self.start[index], self.origin[index.cpu().numpy()]
        return part

    def evaluate(self, pose: Float[Tensor, "k p"]) -> Evaluation:
        """Return the costs at these poses with their derivatives, from the residuals r and the Jacobian J."""
        position_m, heading, height_offset = self.unpack(pose)
        layout = log_profile_gradient(position_m, heading, self._walls_m, self._columns)
        value, jacobian = self._embedded(layout)
        residual = value - self._targets
        if height_offset is not None:
            # The offset adds to the target, equally at all azimuths, so its column of J is -1.
            residual = residual - height_offset[:, None]
            jacobian = torch.cat([jacobian, torch.full_like(residual, -1.0)[:, None]], dim=1)
        if self._precision is not None:
            residual, jacobian = residual * self._precision, jacobian * self._precision[:, None]
        return self._evaluation(pose, residual, jacobian)

    def _embedded(self, layout: ProfileJacobian) -> tuple[Float[Tensor, "k d"], Float[Tensor, "k m d"]]:
        """Return Φ of the layouts, and its derivatives by the m unknowns that move the layout."""
        by_pose = layout.by_pose[:, : self._moving]
        if self._embedding is None:
            return layout.log_m, by_pose
        profile_m = layout.log_m.exp()
        count = len(profile_m)

        def repeat(value: Tensor) -> Tensor:
            return value.repeat_interleave(self._moving, dim=0)

        camera, ceiling = repeat(self._camera_height_m), repeat(self._ceiling_height_m)
        embedding = self._embedding
        tangent = (by_pose * profile_m[:, None]).flatten(0, 1)
        value, derivative = torch.func.jvp(
            lambda profile: embedding(profile, camera, ceiling), (repeat(profile_m),), (tangent,)
        )[:2]
        return value[:: self._moving], derivative.reshape(count, self._moving, -1)

    def _evaluation(
        self, pose: Float[Tensor, "k p"], residual: Float[Tensor, "k d"], jacobian: Float[Tensor, "k p d"]
    ) -> Evaluation:
        """Return C, C', H, D and its gradient, from r and J; `self._stiffness` is s²."""
        prior_slope = pose * self._stiffness
        prior = 0.5 * (pose * prior_slope).sum(dim=1)
        if self.norm == "cauchy":
            factor = 1.0 + residual.square()
            total, weight = factor.log().sum(dim=1), 1.0 / factor
            slope = _by_unknown(jacobian, residual * weight)
            distance, gradient = total / residual.shape[1], 2.0 * slope / residual.shape[1]
            information = (jacobian * weight[:, None]) @ jacobian.mT
        else:
            total = residual.square().sum(dim=1)
            slope, information = _by_unknown(jacobian, residual), jacobian @ jacobian.mT
            if self.norm == "l1":
                distance = residual.abs().mean(dim=1)
                gradient = _by_unknown(jacobian, residual.sign()) / residual.shape[1]
            else:
                distance = total.sqrt()
                gradient = slope / distance.clamp_min(1e-9)[:, None]
        information = information + torch.diag(self._stiffness)
        return Evaluation(0.5 * total + prior, slope + prior_slope, information, distance, gradient)

    def stay_inside(
        self, pose: Float[Tensor, "k p"], step: Float[Tensor, "k p"], config: LpoConfig
    ) -> Float[Tensor, "k p"]:
        """Return the steps, shortened so that poses keep the margin to walls and all limits of the settings."""
        length = torch.linalg.vector_norm(step[:, :2], dim=1)
        allowed = free_travel_m(pose[:, :2], step[:, :2], self._walls_m, config.margin_m).clamp(max=config.max_step_m)
        scale = torch.where(length > allowed, allowed / length.clamp_min(1e-9), torch.ones_like(length))
        turn = step[:, 2 : self._moving].clamp(-config.max_turn, config.max_turn)
        height, (low, high) = pose[:, self._moving :], self._height_bounds
        return torch.cat(
            [step[:, :2] * scale[:, None], turn, (height + step[:, self._moving :]).clamp(low, high) - height], dim=1
        )


def _by_unknown(jacobian: Float[Tensor, "k p d"], values: Float[Tensor, "k d"]) -> Float[Tensor, "k p"]:
    """Return the product of the Jacobian and the values of each pose."""
    return (jacobian @ values[:, :, None])[:, :, 0]
