"""Poses with covariances: prediction by odometry, comparison, and fusion with the pose by the photograph."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

from lalaloc_core.conventions import wrap_angle
from lalaloc_core.floorplan import FloorPlan
from lalaloc_core.localise.belief import photograph_heading, pose_uncertainty
from lalaloc_core.localise.encode.layout_encoder import LayoutEncoder
from lalaloc_core.localise.query import Candidate, Query
from lalaloc_core.localise.tracking.track_state import COMPONENTS, Component, TrackedPose
from lalaloc_core.localise.tracking.walk_motion import Odometry, axes

# Deviations (m, m, radians) that the residual of a motion has beside the stated ones, and the number of deviations from
# which it is contradicted.
_OWN_STD, _CONTRADICTED = np.array([0.15, 0.15, math.radians(4.0)]), 4.0
# Deviations of a pose whose uncertainty the model does not state.
_UNKNOWN_STD = np.array([0.25, 0.25, math.radians(5.0)])

# Pose (x, y, heading) in metres and radians, with its covariance.
Gaussian = tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]


def measured_pose(plan: FloorPlan, encoder: LayoutEncoder, query: Query, answer: Candidate) -> Gaussian:
    """Return pose and covariance by the photograph alone."""
    mean = np.array([answer.x_m, answer.y_m, photograph_heading(query, answer)])
    covariance = np.diag(np.square(_UNKNOWN_STD))
    model = encoder.manifest.confidence_for(view=query.is_view)
    if answer.information is not None and model is not None:
        uncertainty = pose_uncertainty(answer.information, plan.rooms[answer.room_index], model)
        if uncertainty is not None and uncertainty.heading_std is not None:
            covariance[:2, :2] = uncertainty.position_m2
            covariance[2, 2] = uncertainty.heading_std**2
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


def contradicted(
    pose: TrackedPose | None, odometry: Odometry | None, predicted: Gaussian | None, measured: Gaussian
) -> tuple[Component, ...]:
    """Return the components of a motion that two poses contradict."""
    if pose is None or odometry is None or predicted is None:
        return ()
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
