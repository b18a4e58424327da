"""Covariance of a refined answer, from the curvature of the cost at its pose.

Near its minimum the cost is a parabola, and the inverse of its curvature (`Candidate.information`) is the covariance
up to a factor, which is fitted on validation queries (`lalaloc_core.evaluate.calibrate`). If the heading was
searched, position and heading are each reported with the other integrated out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from lalaloc_core.bundle import ConfidenceModel
from lalaloc_core.floorplan import Room

# Curvatures are single precision; eigenvalues below this share of the largest are rounding errors.
_PRECISION = 1e-6
# Standard deviation (radians) of an unknown heading.
_ANY_HEADING_STD = math.pi / math.sqrt(3.0)


@dataclass(frozen=True, eq=False)
class PoseUncertainty:
    """Uncertainty of a pose.

    Attributes:
        position_m2: covariance of (x, y) in m², plan frame.
        heading_std: standard deviation of the heading (radians); None if the heading was given.
    """

    position_m2: Float[np.ndarray, "2 2"]
    heading_std: float | None


def pose_uncertainty(
    information: Float[np.ndarray, "p p"], room: Room, model: ConfidenceModel
) -> PoseUncertainty | None:
    """Return the uncertainty of a pose in a room; None if the model has no factors for it.

    Standard deviations are limited to those of a uniform distribution: over the room's longest extent (its length over
    √12), as along a corridor without visible ends, and over all headings (π/√3).
    """
    searched = len(information) == 3
    factor = model.position_factor_searched if searched else model.position_factor
    if factor is None or (searched and model.heading_factor is None):
        return None
    by_position, by_heading = marginal_information(information)
    widest_m = float(np.hypot(*np.ptp(room.polygon_m, axis=0))) / math.sqrt(12.0)
    curvature, axes = np.linalg.eigh(by_position)
    variance = factor / np.maximum(curvature, factor / widest_m**2) if factor > 0.0 else np.zeros(2)
    covariance = (axes * variance) @ axes.T
    heading_std = None
    if by_heading is not None and model.heading_factor is not None:
        heading_std = _ANY_HEADING_STD
        if by_heading > 0.0:
            heading_std = min(math.sqrt(model.heading_factor / by_heading), _ANY_HEADING_STD)
    return PoseUncertainty(0.5 * (covariance + covariance.T), heading_std)


def marginal_information(information: Float[np.ndarray, "p p"]) -> tuple[Float[np.ndarray, "2 2"], float | None]:
    """Return the information about the position with the heading integrated out, and about the heading likewise.

    Both are inverses of blocks of the inverse (Schur complements), and exist where that does not. The information is by
    x, y (m) and, if it was searched, the heading (radians).
    """
    full = np.asarray(information, dtype=np.float64)
    by_position = full[:2, :2]
    if len(full) == 2:
        return by_position, None
    cross, by_heading = full[:2, 2], full[2, 2]
    known_position = cross @ np.linalg.pinv(by_position, rcond=_PRECISION, hermitian=True) @ cross
    left = max(by_heading - known_position, 0.0)
    if by_heading > 0.0:
        by_position = by_position - np.outer(cross, cross) / by_heading
    return by_position, float(left)
