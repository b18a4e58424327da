"""States that a photograph was compared with, the modes of the belief among them, and the fusion of their poses.

Poses with covariances are predicted by odometry, compared, and fused with the pose by the photograph.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from lalaloc_core.conventions import TWO_PI, wrap_angle
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.belief import (
    HEADING_SEPARATION,
    Posterior,
    Support,
    distinct,
    photograph_heading,
    pose_uncertainty,
    suppress,
)
from lalaloc_core.localise.belief.posterior import WeightedPlaces
from lalaloc_core.localise.encode.layout_encoder import LayoutEncoder
from lalaloc_core.localise.match import PoseGrid, grid_candidate
from lalaloc_core.localise.query import Candidate, Query
from lalaloc_core.localise.tracking.track_state import COMPONENTS, Component, TrackedPose
from lalaloc_core.localise.tracking.walk_motion import Odometry, axes

# Modes that are refined while the belief is spread, and while one mode holds nearly all of it.
_MODES, _FEW_MODES, _SETTLED = 12, 3, 0.98
# Deviations (m, m, radians) that the residual of a motion has beside the stated ones, and the number of deviations from
# which it is contradicted.
_OWN_STD, _CONTRADICTED = np.array([0.15, 0.15, math.radians(4.0)]), 4.0
# Deviations of a pose whose uncertainty the model does not state.
_UNKNOWN_STD = np.array([0.25, 0.25, math.radians(5.0)])

# Pose (x, y, heading) in metres and radians, with its covariance.
Gaussian = tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]


def sector_of(query: Query, hypothesis: Int[np.ndarray, "m"]) -> Int[np.ndarray, "m"]:
    """Return the nearest sector of the belief to hypotheses of the query."""
    sectors = len(query.roll)
    return np.rint((query.roll + query.frame_heading) / (TWO_PI / sectors)).astype(int)[hypothesis] % sectors


def hypothesis_of(query: Query) -> Int[np.ndarray, "k"]:
    """Return the hypothesis of each sector."""
    found = np.empty(len(query.roll), int)
    found[sector_of(query, np.arange(len(query.roll)))] = np.arange(len(query.roll))
    return found


@dataclass(frozen=True, eq=False, kw_only=True)
class ComparedStates:
    """States that a photograph was compared with.

    Attributes:
        offset: (m,) height offsets.
        weight: (m,) probabilities.
        rest: probability of all other states.
        outlier: likelihood of an outlier, relative to the best pose.
        temperature: factor that turns costs into negative log likelihoods.
        separation_m: radius of a mode.
    """

    grid: PoseGrid
    query: Query
    pose: Int[np.ndarray, "m"]
    sector: Int[np.ndarray, "m"]
    cost: Float[np.ndarray, "m"]
    offset: Float[np.ndarray, "m"]
    weight: Float[np.ndarray, "m"]
    rest: float
    outlier: float
    temperature: float
    separation_m: float

    @cached_property
    def _hypothesis(self) -> Int[np.ndarray, "m"]:
        return hypothesis_of(self.query)[self.sector]

    @cached_property
    def _position_m(self) -> Float[np.ndarray, "m 2"]:
        return self.grid.poses.position_m[self.pose]

    @cached_property
    def _heading(self) -> Float[np.ndarray, "m"]:
        return self.query.roll[self._hypothesis] + self.query.frame_heading

    def only(self, kept: Bool[np.ndarray, "m"]) -> ComparedStates:
        """Return some of the states; the others join the rest."""
        parts = {name: getattr(self, name)[kept] for name in ("pose", "sector", "cost", "offset", "weight")}
        return replace(self, **parts, rest=self.rest + float(self.weight[~kept].sum()))

    def modes(self) -> list[Candidate]:
        """Return the modes of the belief, the most probable first."""
        kept = suppress(
            self._position_m,
            -np.log(np.maximum(self.weight, 1e-30)),
            separation_m=self.separation_m,
            limit=_MODES,
            heading=self.query.roll[self._hypothesis],
        )
        near = np.linalg.norm(self._position_m - self._position_m[kept[0]], axis=1)
        if self.weight[near < self.separation_m].sum() > _SETTLED:
            kept = kept[:_FEW_MODES]
        return [
            grid_candidate(
                self.grid,
                int(self.pose[index]),
                self.query,
                int(self._hypothesis[index]),
                cost=float(self.cost[index]),
                height_offset=float(self.offset[index]),
            )
            for index in kept
        ]

    def relative_likelihood(self, modes: list[Candidate]) -> Float[np.ndarray, "r"]:
        """Return the likelihood of the photograph at some modes, relative to the best of them."""
        cost = np.array([mode.cost for mode in modes])
        return np.exp(-self.temperature * (cost - cost.min())) + self.outlier

    def share_alone(self, mode: Candidate) -> float:
        """Return the probability of a mode by the photograph alone, without the photographs before it."""
        value = np.exp(-self.temperature * (self.cost - self.cost.min()))
        return float(value[self._of_mode(mode)].sum() / value.sum())

    def regained(self, starts: list[Candidate], ends: list[Candidate]) -> ComparedStates:
        """Return the states with the modes weighed by the gains of their refinement."""
        gains = self.relative_likelihood(ends) / self.relative_likelihood(starts)
        gains = gains / np.median(gains)
        factor, free = np.ones(len(self.pose)), np.ones(len(self.pose), bool)
        for start, gain in zip(starts, gains, strict=True):
            member = free & self._of_mode(start)
            factor[member] = gain
            free &= ~member
        weight = self.weight * factor
        total = float(weight.sum()) + self.rest
        return replace(self, weight=weight / total, rest=self.rest / total)

    def ranked(self, starts: list[Candidate], ends: list[Candidate], top_k: int) -> tuple[list[Candidate], Posterior]:
        """Return the refined modes by falling probability, and the posterior at their places."""
        position, heading = self._position_m.copy(), self._heading.copy()
        mass, free = np.zeros(len(starts)), np.ones(len(position), bool)
        for index, (start, end) in enumerate(zip(starts, ends, strict=True)):
            own = self._of_mode(start) & free
            free &= ~own
            mass[index] = self.weight[own].sum()
            position[own] += end.position_m - start.position_m
            # The refined heading is far more accurate than a sector.
            heading[own] = photograph_heading(self.query, end)
        order = np.argsort(-mass, kind="stable")
        candidates = distinct([ends[index] for index in order], self.query, self.separation_m, top_k)
        support = Support(self.pose, position, heading, self.weight)
        return candidates, WeightedPlaces(self.query, support, len(self.grid.poses)).posterior(candidates)

    def _of_mode(self, mode: Candidate) -> Bool[np.ndarray, "m"]:
        """Return which states belong to a mode."""
        near = np.linalg.norm(self._position_m - mode.position_m, axis=1) < self.separation_m
        turned = wrap_angle(self._heading - photograph_heading(self.query, mode))
        return near & (np.abs(turned) <= HEADING_SEPARATION)


def measured_pose(plan: FloorPlan, encoder: LayoutEncoder, query: Query, answer: Candidate) -> Gaussian:
    """Return pose and covariance by the photograph alone."""
    mean = np.array([answer.x_m, answer.y_m, photograph_heading(query, answer)])
    covariance = np.diag(np.square(_UNKNOWN_STD))
    model = encoder.manifest.confidence_for(view=query.is_view)
    if answer.information is not None and model is not None:
        uncertainty = pose_uncertainty(answer.information, plan.rooms[answer.room_index], model)
        if uncertainty is not None and uncertainty[1] is not None:
            covariance[:2, :2], covariance[2, 2] = uncertainty[0], uncertainty[1] ** 2
    return mean, covariance + np.diag([1e-6, 1e-6, 1e-8])


def carried_on(pose: TrackedPose, odometry: Odometry) -> Gaussian:
    """Return the pose and covariance that odometry predicts."""
    frame = axes(np.array(pose.heading))
    step = frame @ odometry.displacement_m
    mean = np.array([*(pose.position_m + step), pose.heading + odometry.turn])
    # A heading that is off turns the step clockwise: (dx, dy) becomes (dy, -dx) per radian.
    by_pose = np.array([[1.0, 0.0, step[1]], [0.0, 1.0, -step[0]], [0.0, 0.0, 1.0]])
    by_motion = np.eye(3)
    by_motion[:2, :2] = frame
    covariance = by_pose @ pose.covariance @ by_pose.T + by_motion @ odometry.covariance @ by_motion.T
    return mean, covariance


def _residual(predicted: Gaussian, measured: Gaussian) -> Float[np.ndarray, "3"]:
    off = measured[0] - predicted[0]
    off[2] = wrap_angle(off[2])
    return off


def contradicted(pose: TrackedPose, predicted: Gaussian, measured: Gaussian) -> tuple[Component, ...]:
    """Return the components of a motion from a pose that the pose after it contradicts."""
    # In the frame of the first pose, in which motions are stated.
    frame = np.eye(3)
    frame[:2, :2] = axes(np.array(pose.heading)).T
    off = frame @ _residual(predicted, measured)
    variance = np.diagonal(frame @ (predicted[1] + measured[1]) @ frame.T) + np.square(_OWN_STD)
    wrong = np.abs(off) > _CONTRADICTED * np.sqrt(variance)
    return tuple(name for name, is_wrong in zip(COMPONENTS, wrong, strict=True) if is_wrong)


def fused(predicted: Gaussian, measured: Gaussian) -> Gaussian:
    """Return the product of two Gaussians: the update of a Kalman filter."""
    gain = predicted[1] @ np.linalg.inv(predicted[1] + measured[1])
    mean = predicted[0] + gain @ _residual(predicted, measured)
    covariance = (np.eye(3) - gain) @ predicted[1]
    return mean, 0.5 * (covariance + covariance.T)
