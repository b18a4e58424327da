"""Problem of pose refinement: the cost of poses as a function of the unknowns, and its derivatives.

The unknowns u of a pose are x and y, then the heading and the height offset δ if they are refined. With the log wall
profile of the layout at u, the embedding Φ of the layout (or the log profile itself), the targets f and the factors p
(`RefinementJob.precision`, or 1), the residuals are

    r = p (Φ(layout(u)) - f - δ)                                           `Problem.evaluate`

with the Jacobian J = ∂r / ∂u: the derivative of the renderer in closed form, times that of Φ, which a subclass of
`Problem` provides (`embedded`). The cost that Levenberg-Marquardt lowers, its slope and its Gauss-Newton
curvature are

    C = ½ Σ ρ(r) + ½ Σ (s u)²    C' = J w r + s² u    H = J w Jᵀ + s²      `Problem._evaluation`

with ρ(r) = log(1 + r²) and w = 1 / (1 + r²) for the norm "cauchy", else ρ(r) = r² and w = 1; s is the stiffness of
unknowns with a normal prior. Results report the distance D, and Adam lowers it: the root of Σ r² for "l2", the mean of
absolute residuals for "l1", and the mean of log(1 + r²) for "cauchy", which is the walls' term of the matching cost.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from array_api_compat import array_namespace, device, to_device
from jaxtyping import Float, Int

from lalaloc_core.conventions import Array
from lalaloc_core.render.profile import ProfileJacobian, free_travel_m, log_profile_gradient

# Distance that is minimised: Euclidean, mean absolute difference, or the mean of log(1 + r²).
Norm = Literal["l2", "l1", "cauchy"]


@dataclass(frozen=True, eq=False)
class RefinementJob:
    """Starting poses for pose refinement, each with its own targets and room.

    `descent_methods.refine_walls` compares wall profiles with `log_profile`, on numpy. `latent_refiner.PoseOptimiser`
    compares embedded layouts with `targets`, by differences times `precision` if that is not None.
    `PoseRefiner` runs `refine_walls` for a job with `log_profile`, whose `targets`, latents, give the latent distance
    alone; for others it compares latents and ignores `precision`.

    Attributes:
        targets: (k, d) latents, or other embeddings for an optimiser with another embedding.
        heading: (k,) headings (radians) in the frame.
        walls_m: (k, n, 4) walls of each pose's room (m), padded.
        optimise_heading: whether the heading is refined as well.
        log_profile: (k, w) centres of the predicted log wall profiles (m); None compares latents alone.
        precision: (k, w) factors that turn differences of log distance into residuals.
        latent_weight: weight of the latent distance in the cost of poses that were refined by their profiles.
        height_offset: (k,) start of the log of true over stated camera height; None keeps it at 0.
        height_stiffness: factor that turns that log into a residual among those of the profile's columns.
        height_bounds: smallest and largest log.
    """

    targets: Float[np.ndarray, "k d"]
    position_m: Float[np.ndarray, "k 2"]
    heading: Float[np.ndarray, "k"]
    walls_m: Float[np.ndarray, "k n 4"]
    camera_height_m: Float[np.ndarray, "k"]
    ceiling_height_m: Float[np.ndarray, "k"]
    optimise_heading: bool
    log_profile: Float[np.ndarray, "k w"] | None = None
    precision: Float[np.ndarray, "k w"] | None = None
    latent_weight: float = 0.0
    height_offset: Float[np.ndarray, "k"] | None = None
    height_stiffness: float = 0.0
    height_bounds: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, eq=False)
class RefinementResult:
    """Refined poses, inside the rooms of their starts.

    Attributes:
        heading: (k,) headings (radians) in the frame.
        cost: (k,) minimised cost: the walls' term of the matching cost, or the distance of the embeddings.
        latent_distance: (k,) distance of the embeddings; None if it is no part of the cost.
        information: (k, p, p) curvature of the cost by position and heading, the camera height integrated out.
        height_offset: (k,) log of true over stated camera height; None if it was not solved for.
    """

    position_m: Float[np.ndarray, "k 2"]
    heading: Float[np.ndarray, "k"]
    cost: Float[np.ndarray, "k"]
    latent_distance: Float[np.ndarray, "k"] | None
    information: Float[np.ndarray, "k p p"]
    height_offset: Float[np.ndarray, "k"] | None = None


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

    cost: Float[Array, "k"]
    slope: Float[Array, "k p"]
    information: Float[Array, "k p p"]
    distance: Float[Array, "k"]
    gradient: Float[Array, "k p"]

    def rows(self, index: Int[Array, "m"]) -> Evaluation:
        """Return the evaluation of some of the poses."""
        return Evaluation(*(value[index] for value in vars(self).values()))

    def take_over(self, index: Int[Array, "m"], other: Evaluation) -> None:
        """Replace these rows by those of `other`."""
        for name, value in vars(self).items():
            value[index] = getattr(other, name)


class Problem:
    """Residuals of one job as a function of the unknowns: x, y, then heading and height offset if they are refined.

    The arrays are of `like`'s library and on its device. Positions are relative to each starting pose, to keep
    millimetres in single precision in large plans.
    """

    def __init__(self, columns: int, norm: Norm, job: RefinementJob, like: Array) -> None:
        """Set up the problem; `columns` and `norm` are as in `PoseOptimiser`."""
        xp = array_namespace(like)

        def array(values: np.ndarray) -> Array:
            return xp.asarray(np.asarray(values, dtype=np.float32), device=device(like))

        self._columns = columns
        self.norm: Norm = norm
        self.origin = job.position_m
        self._walls_m = array(job.walls_m - np.tile(job.position_m, 2)[:, None, :])
        self._heading = array(job.heading)
        self._targets = array(job.targets)
        self._precision = None if job.precision is None else array(job.precision)
        # Number of unknowns that move the layout; the camera height follows them.
        self._moving = 3 if job.optimise_heading else 2
        self._height_bounds = job.height_bounds
        start, stiffness = np.zeros((len(job.targets), self._moving)), [0.0] * self._moving
        if job.height_offset is not None:
            start = np.concatenate([start, job.height_offset[:, None]], axis=1)
            stiffness.append(job.height_stiffness)
        self.start = array(start)
        self._stiffness = array(np.square(stiffness))

    def unpack(
        self, pose: Float[Array, "k p"]
    ) -> tuple[Float[Array, "k 2"], Float[Array, "k"], Float[Array, "k"] | None]:
        """Return position (m, relative to the start), heading (radians), and height offset if it is solved for."""
        turned = self._heading + pose[:, 2] if self._moving == 3 else self._heading
        return pose[:, :2], turned, pose[:, self._moving] if pose.shape[1] > self._moving else None

    def rows(self, index: Int[Array, "m"]) -> Problem:
        """Return the problem of some of the poses."""
        part = object.__new__(type(self))
        part.__dict__.update(self.__dict__)
        for name in self.pose_arrays:
            value = getattr(self, name)
            setattr(part, name, None if value is None else value[index])
        part.origin = self.origin[_numpy(index)]
        return part

    @property
    def pose_arrays(self) -> tuple[str, ...]:
        """Names of the arrays with a row for each pose."""
        return ("_walls_m", "_heading", "_targets", "_precision", "start")

    def evaluate(self, pose: Float[Array, "k p"]) -> Evaluation:
        """Return the costs at these poses with their derivatives, from the residuals r and the Jacobian J."""
        xp = array_namespace(pose)
        position_m, heading, height_offset = self.unpack(pose)
        layout = log_profile_gradient(position_m, heading, self._walls_m, self._columns)
        value, jacobian = self.embedded(layout)
        residual = value - self._targets
        if height_offset is not None:
            # The offset adds to the target, equally at all azimuths, so its column of J is -1.
            residual = residual - height_offset[:, None]
            jacobian = xp.concat([jacobian, xp.full_like(residual, -1.0)[:, None]], axis=1)
        if self._precision is not None:
            residual, jacobian = residual * self._precision, jacobian * self._precision[:, None]
        return self._evaluation(pose, residual, jacobian)

    def embedded(self, layout: ProfileJacobian) -> tuple[Float[Array, "k d"], Float[Array, "k m d"]]:
        """Return Φ of the layouts, here their log profile, and its derivatives by the m unknowns that move them."""
        return layout.log_m, layout.by_pose[:, : self._moving]

    def _evaluation(
        self, pose: Float[Array, "k p"], residual: Float[Array, "k d"], jacobian: Float[Array, "k p d"]
    ) -> Evaluation:
        """Return C, C', H, D and its gradient, from r and J; `self._stiffness` is s²."""
        xp = array_namespace(pose)
        prior_slope = pose * self._stiffness
        prior = 0.5 * xp.sum(pose * prior_slope, axis=1)
        if self.norm == "cauchy":
            factor = 1.0 + xp.square(residual)
            total, weight = xp.sum(xp.log(factor), axis=1), 1.0 / factor
            slope = _by_unknown(jacobian, residual * weight)
            distance, gradient = total / residual.shape[1], 2.0 * slope / residual.shape[1]
            information = (jacobian * weight[:, None]) @ xp.matrix_transpose(jacobian)
        else:
            total = xp.sum(xp.square(residual), axis=1)
            slope, information = _by_unknown(jacobian, residual), jacobian @ xp.matrix_transpose(jacobian)
            if self.norm == "l1":
                distance = xp.mean(xp.abs(residual), axis=1)
                gradient = _by_unknown(jacobian, xp.sign(residual)) / residual.shape[1]
            else:
                distance = xp.sqrt(total)
                gradient = slope / xp.maximum(distance, 1e-9)[:, None]
        information = information + diagonal(self._stiffness)
        return Evaluation(0.5 * total + prior, slope + prior_slope, information, distance, gradient)

    def stay_inside(
        self, pose: Float[Array, "k p"], step: Float[Array, "k p"], config: LpoConfig
    ) -> Float[Array, "k p"]:
        """Return the steps, shortened so that poses keep the margin to walls and all limits of the settings."""
        xp = array_namespace(pose)
        length = xp.linalg.vector_norm(step[:, :2], axis=1)
        allowed = free_travel_m(pose[:, :2], step[:, :2], self._walls_m, config.margin_m)
        allowed = xp.minimum(allowed, config.max_step_m)
        scale = xp.where(length > allowed, allowed / xp.maximum(length, 1e-9), xp.ones_like(length))
        turn = clipped(step[:, 2 : self._moving], -config.max_turn, config.max_turn)
        height, (low, high) = pose[:, self._moving :], self._height_bounds
        raised = clipped(height + step[:, self._moving :], low, high) - height
        return xp.concat([step[:, :2] * scale[:, None], turn, raised], axis=1)

    def result(self, pose: Float[Array, "k p"], found: Evaluation) -> RefinementResult:
        """Return the result of a descent that ended at these poses; both of its costs are the distance D."""
        position, heading, height_offset = self.unpack(pose)
        information = found.information if height_offset is None else _without_last(found.information)
        distance = _numpy(found.distance)
        return RefinementResult(
            position_m=_numpy(position).astype(np.float64) + self.origin,
            heading=_numpy(heading).astype(np.float64),
            cost=distance,
            latent_distance=distance,
            information=_numpy(information),
            height_offset=None if height_offset is None else _numpy(height_offset).astype(np.float64),
        )


def diagonal(values: Float[Array, "*k p"]) -> Float[Array, "*k p p"]:
    """Return diagonal matrices."""
    xp = array_namespace(values)
    return values[..., None] * xp.eye(values.shape[-1], dtype=values.dtype, device=device(values))


def clipped(values: Float[Array, "*n"], low: float, high: float) -> Float[Array, "*n"]:
    """Return values within limits; several times as fast as the array API's `clip`."""
    xp = array_namespace(values)
    return xp.minimum(xp.maximum(values, low), high)


def _by_unknown(jacobian: Float[Array, "k p d"], values: Float[Array, "k d"]) -> Float[Array, "k p"]:
    """Return the product of the Jacobian and the values of each pose."""
    return (jacobian @ values[:, :, None])[:, :, 0]


def _without_last(information: Float[Array, "k p p"]) -> Float[Array, "k q q"]:
    """Return the information about all unknowns but the last, which is integrated out (Schur complement)."""
    xp = array_namespace(information)
    cross, last = information[:, :-1, -1], xp.maximum(information[:, -1, -1], 1e-9)
    return information[:, :-1, :-1] - cross[:, :, None] * cross[:, None, :] / last[:, None, None]


def _numpy(values: Array) -> np.ndarray:
    return np.asarray(to_device(values, "cpu"))
