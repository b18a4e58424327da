"""Joint refinement of all poses of a path, by the predicted walls and the measured motions.

Levenberg-Marquardt lowers, for every path of a job,

    sum over pictures ½ sum over azimuths log(1 + r²)  +  ½ scale² (sum of the motions' squared residuals)
    +  ½ (stiffness δ)²

by all positions, the unknown headings, and one δ, the log of true over stated camera height. The height of a carried
camera differs from picture to picture by an ε each, which is solved for afterwards, and all poses once more with it.
The derivatives are in closed form (`render.gradient`), so numpy suffices. Poses stay inside their rooms.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from lalaloc_core.conventions import wrap_angle
from lalaloc_core.localise.sequence.measured_motion import Motion
from lalaloc_core.render.profile import free_travel_m, log_profile_gradient

_MARGIN_M, _MAX_STEP_M, _MAX_TURN = 0.03, 0.5, 0.2
_ITERATIONS, _OWN_ITERATIONS, _FIRST_DAMPING = 25, 8, 1e-2
# A path has converged if no pose moves farther, or the cost falls by less than this share.
_SHORT_M, _LITTLE = 1e-3, 1e-4
# Keeps systems with undetermined unknowns from being singular.
_HELD = 1e-6


@dataclass(frozen=True, eq=False)
class SequenceJob:
    """`m` paths to be refined, through `t` pictures.

    Attributes:
        heading: (m, t) headings (radians) in the frames, as in `query.Query`.
        roll: (m, t) angles (radians) to add for the photographs' headings.
        turnable: (t,) pictures whose heading is searched.
        walls_m, log_profile, precision: as in `refine.RefinementJob`.
        trusted: (m, t - 1) motions that each path follows.
        motion_scale: factor that scales the motions' residuals to those of azimuth columns.
        height_offset: (m,) start of δ.
        height_free: whether δ is solved for.
        height_stiffness, height_bounds: as in `refine.RefinementJob`.
        height_apart: standard deviation of ε; 0 if all pictures have the same relative error.
    """

    position_m: Float[np.ndarray, "m t 2"]
    heading: Float[np.ndarray, "m t"]
    roll: Float[np.ndarray, "m t"]
    turnable: Bool[np.ndarray, "t"]
    walls_m: Float[np.ndarray, "m t n 4"]
    log_profile: Float[np.ndarray, "m t w"]
    precision: Float[np.ndarray, "m t w"]
    motions: tuple[Motion, ...]
    trusted: Bool[np.ndarray, "m s"]
    motion_scale: float
    height_offset: Float[np.ndarray, "m"]
    height_free: bool
    height_stiffness: float
    height_bounds: tuple[float, float]
    height_apart: float = 0.0


@dataclass(frozen=True, eq=False)
class SequenceResult:
    """Refined paths.

    Attributes:
        height_offset: (m,) δ.
        height_own: (m, t) ε of every picture.
        information: for every picture the (m, p, p) information about its position and, if it was searched, heading,
            with all other unknowns integrated out.
    """

    position_m: Float[np.ndarray, "m t 2"]
    heading: Float[np.ndarray, "m t"]
    height_offset: Float[np.ndarray, "m"]
    height_own: Float[np.ndarray, "m t"]
    information: list[Float[np.ndarray, "m p p"]]


def refine_sequence(job: SequenceJob) -> SequenceResult:
    """Refine every path of a job."""
    result = _refined(job)
    if not job.height_free or job.height_apart == 0.0:
        return result
    own = _own_heights(job, result)
    shifted = replace(
        job,
        position_m=result.position_m,
        heading=result.heading,
        log_profile=job.log_profile + own[:, :, None],
        height_offset=result.height_offset,
    )
    return replace(_refined(shifted), height_own=own)


def _own_heights(job: SequenceJob, result: SequenceResult) -> Float[np.ndarray, "m t"]:
    """Return the ε that fit each picture at its refined pose, by iterated weighted least squares."""
    count, pictures, columns = job.log_profile.shape
    walls_m = job.walls_m.reshape(count * pictures, -1, 4)
    seen = log_profile_gradient(result.position_m.reshape(-1, 2), result.heading.reshape(-1), walls_m, columns)
    off = seen.log_m.reshape(count, pictures, columns) - job.log_profile - result.height_offset[:, None, None]
    own = np.zeros((count, pictures))
    for _ in range(_OWN_ITERATIONS):
        weight = np.square(job.precision) / (1.0 + np.square((off - own[..., None]) * job.precision))
        own = (weight * off).sum(axis=2) / (weight.sum(axis=2) + np.square(job.motion_scale / job.height_apart))
    low, high = job.height_bounds
    return np.clip(result.height_offset[:, None] + own, low, high) - result.height_offset[:, None]


def _refined(job: SequenceJob) -> SequenceResult:
    """Refine every path with one height for all pictures."""
    count, pictures = job.heading.shape
    unknowns = np.zeros((count, 3 * pictures + 1))
    unknowns[:, -1] = job.height_offset
    here = _evaluate(job, unknowns)
    damping, active = np.full(count, _FIRST_DAMPING), np.ones(count, bool)
    for _ in range(_ITERATIONS):
        if not active.any():
            break
        scaling = damping[:, None] * np.diagonal(here.curvature, axis1=1, axis2=2) + _HELD
        system = here.curvature + scaling[:, :, None] * np.eye(unknowns.shape[1])
        step = -np.linalg.solve(system, here.slope[:, :, None])[:, :, 0]
        step = _possible(job, unknowns, step) * active[:, None]
        there = _evaluate(job, unknowns + step)
        better = active & (there.cost < here.cost)
        longest_m = np.abs(step[:, :-1].reshape(count, pictures, 3)[:, :, :2]).max(axis=(1, 2))
        done = (longest_m < _SHORT_M) | (better & (here.cost - there.cost < _LITTLE * here.cost))
        unknowns[better] += step[better]
        here = here.replaced(there, better)
        damping = np.clip(damping * np.where(better, 0.2, 6.0), 1e-6, 1e8)
        active &= ~done
    by_pose = unknowns[:, :-1].reshape(count, pictures, 3)
    return SequenceResult(
        position_m=job.position_m + by_pose[:, :, :2],
        heading=job.heading + by_pose[:, :, 2],
        height_offset=unknowns[:, -1],
        height_own=np.zeros((count, pictures)),
        information=_information(job, here.curvature),
    )


@dataclass(frozen=True, eq=False)
class _Evaluation:
    """Costs of paths, with their derivatives and curvatures (after Gauss and Newton) by all unknowns."""

    cost: Float[np.ndarray, "m"]
    slope: Float[np.ndarray, "m u"]
    curvature: Float[np.ndarray, "m u u"]

    def replaced(self, other: _Evaluation, chosen: Bool[np.ndarray, "m"]) -> _Evaluation:
        """Return the evaluation with the chosen rows of another one."""
        return _Evaluation(
            np.where(chosen, other.cost, self.cost),
            np.where(chosen[:, None], other.slope, self.slope),
            np.where(chosen[:, None, None], other.curvature, self.curvature),
        )


def _evaluate(job: SequenceJob, unknowns: Float[np.ndarray, "m u"]) -> _Evaluation:
    """Evaluate paths; unknowns are the changes of x, y and heading of every picture, and δ."""
    count, pictures = job.heading.shape
    by_pose = unknowns[:, :-1].reshape(count, pictures, 3)
    position_m, heading = job.position_m + by_pose[:, :, :2], job.heading + by_pose[:, :, 2]
    curvature = np.zeros((count, unknowns.shape[1], unknowns.shape[1]))
    slope = np.zeros_like(unknowns)
    columns = job.log_profile.shape[2]
    seen = log_profile_gradient(
        position_m.reshape(-1, 2), heading.reshape(-1), job.walls_m.reshape(count * pictures, -1, 4), columns
    )
    residual = (seen.log_m.reshape(count, pictures, columns) - job.log_profile - unknowns[:, -1, None, None]) * (
        job.precision
    )
    jacobian = np.empty((count, pictures, 4, columns))
    jacobian[:, :, :3] = seen.by_pose.reshape(count, pictures, 3, columns)
    jacobian[:, :, 2] *= job.turnable[None, :, None]
    jacobian[:, :, 3] = -float(job.height_free)
    jacobian *= job.precision[:, :, None]
    cost = 0.5 * np.log1p(np.square(residual)).sum(axis=(1, 2))
    weighted = jacobian / (1.0 + np.square(residual))[:, :, None]
    blocks = weighted @ jacobian.swapaxes(2, 3)
    pulls = (weighted @ residual[..., None])[..., 0]
    for t in range(pictures):
        block = [3 * t, 3 * t + 1, 3 * t + 2, unknowns.shape[1] - 1]
        curvature[:, np.array(block)[:, None], block] += blocks[:, t]
        slope[:, block] += pulls[:, t]
    for s, motion in enumerate(job.motions):
        block = list(range(3 * s, 3 * s + 6))
        off, by_both = motion_residuals(motion, position_m[:, s : s + 2], (heading + job.roll)[:, s : s + 2])
        by_both[:, :, 2] *= job.turnable[s]
        by_both[:, :, 5] *= job.turnable[s + 1]
        scale = job.motion_scale * job.trusted[:, s, None]
        off, by_both = off * scale, by_both * scale[:, :, None]
        cost += 0.5 * np.square(off).sum(axis=1)
        curvature[:, np.array(block)[:, None], block] += by_both.swapaxes(1, 2) @ by_both
        slope[:, block] += (by_both.swapaxes(1, 2) @ off[:, :, None])[:, :, 0]
    held = job.height_stiffness**2
    cost += 0.5 * held * np.square(unknowns[:, -1])
    slope[:, -1] += held * unknowns[:, -1]
    curvature[:, -1, -1] += held
    return _Evaluation(cost, slope, curvature)


def motion_residuals(
    motion: Motion, position_m: Float[np.ndarray, "m 2 2"], heading: Float[np.ndarray, "m 2"]
) -> tuple[Float[np.ndarray, "m r"], Float[np.ndarray, "m r 6"]]:
    """Return the residuals of pairs of poses (in deviations), and their derivatives by both poses' x, y, heading."""
    off: list[np.ndarray] = []
    by_both: list[np.ndarray] = []
    moved = position_m[:, 1] - position_m[:, 0]
    if motion.distance_m is not None and motion.direction is None:
        length = np.maximum(np.hypot(moved[:, 0], moved[:, 1]), 1e-6)
        off.append((length - motion.distance_m) / motion.distance_std_m)
        along = moved / length[:, None] / motion.distance_std_m
        by_both.append(_by_displacement(along, np.zeros(len(along))))
    elif motion.distance_m is not None and motion.direction is not None:
        azimuth = heading[:, 0] + motion.direction
        ahead = np.stack([np.sin(azimuth), np.cos(azimuth)], axis=1)
        aside = np.stack([np.cos(azimuth), -np.sin(azimuth)], axis=1)
        along, across = (moved * ahead).sum(axis=1), (moved * aside).sum(axis=1)
        off.append((along - motion.distance_m) / motion.distance_std_m)
        by_both.append(_by_displacement(ahead / motion.distance_std_m, across / motion.distance_std_m))
        off.append(across / motion.across_std_m)
        by_both.append(_by_displacement(aside / motion.across_std_m, -along / motion.across_std_m))
    if motion.turn is not None:
        off.append(wrap_angle(heading[:, 1] - heading[:, 0] - motion.turn) / motion.turn_std)
        turned = np.zeros((len(moved), 6))
        turned[:, 2], turned[:, 5] = -1.0 / motion.turn_std, 1.0 / motion.turn_std
        by_both.append(turned)
    if not off:
        return np.zeros((len(moved), 0)), np.zeros((len(moved), 0, 6))
    return np.stack(off, axis=1), np.stack(by_both, axis=1)


def _by_displacement(by_moved: Float[np.ndarray, "m 2"], by_heading: Float[np.ndarray, "m"]) -> np.ndarray:
    """Return derivatives by both poses from those by the displacement and the first heading."""
    zero = np.zeros(len(by_moved))
    return np.stack([-by_moved[:, 0], -by_moved[:, 1], by_heading, by_moved[:, 0], by_moved[:, 1], zero], axis=1)


def _possible(
    job: SequenceJob, unknowns: Float[np.ndarray, "m u"], step: Float[np.ndarray, "m u"]
) -> Float[np.ndarray, "m u"]:
    """Shorten steps that move a pose too far or too close to a wall."""
    count, pictures = job.heading.shape
    poses = step[:, :-1].reshape(count * pictures, 3).copy()
    begin = (job.position_m + unknowns[:, :-1].reshape(count, pictures, 3)[:, :, :2]).reshape(-1, 2)
    length = np.hypot(poses[:, 0], poses[:, 1])
    free_m = free_travel_m(begin, poses[:, :2], job.walls_m.reshape(len(begin), -1, 4), _MARGIN_M)
    allowed = np.minimum(free_m, _MAX_STEP_M)
    poses[:, :2] *= np.minimum(1.0, allowed / np.maximum(length, 1e-9))[:, None]
    poses[:, 2] = np.clip(poses[:, 2], -_MAX_TURN, _MAX_TURN) * np.tile(job.turnable, count)
    height, (low, high) = unknowns[:, -1], job.height_bounds
    raised = np.clip(height + step[:, -1], low, high) - height if job.height_free else np.zeros(count)
    return np.concatenate([poses.reshape(count, -1), raised[:, None]], axis=1)


def _information(job: SequenceJob, curvature: Float[np.ndarray, "m u u"]) -> list[Float[np.ndarray, "m p p"]]:
    """Return the information about each pose, in units of the curvature."""
    spread = np.linalg.inv(curvature + _HELD * np.eye(curvature.shape[1]))
    found = []
    for t, turnable in enumerate(job.turnable):
        block = slice(3 * t, 3 * t + (3 if turnable else 2))
        found.append(np.linalg.inv(spread[:, block, block]))
    return found


def motion_costs(
    motions: Sequence[Motion], position_m: Float[np.ndarray, "m t 2"], heading: Float[np.ndarray, "m t"]
) -> Float[np.ndarray, "m s"]:
    """Return half the sum of the squared residuals of every motion and path, by the photographs' headings."""
    costs = [
        0.5 * np.square(motion_residuals(motion, position_m[:, s : s + 2], heading[:, s : s + 2])[0]).sum(axis=1)
        for s, motion in enumerate(motions)
    ]
    return np.stack(costs, axis=1) if costs else np.zeros((len(position_m), 0))
