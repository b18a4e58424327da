"""Camera height with its uncertainty.

A picture shows the layout in units of the camera's height. An error of the stated height scales all distances in the
picture: it is one offset δ of log distances, with true height = stated height · exp δ. The search solves for δ and the
pose.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from lalaloc_core.errors import InvalidPoseError

# Range of unknown camera heights (m) over the floor, all equally likely.
UNKNOWN_RANGE_M = (0.8, 2.2)
DEFAULT_STD_M = 0.1
# Largest distance between the offsets that retrieval tries; half of it is small beside the error of a grid pose.
_SPACING = 0.1
# Range of these offsets, in standard deviations; refinement can exceed it.
_REACH_STDS = 1.5


@dataclass(frozen=True)
class CameraHeight:
    """A stated camera height (m), and the standard deviation (m) of its error.

    A deviation of 0 means that the height is exact, infinity that it is unknown: the height is then anywhere in
    `UNKNOWN_RANGE_M`, and predictions are made for `height_m`.
    """

    height_m: float
    std_m: float = DEFAULT_STD_M

    def __post_init__(self) -> None:
        if not self.height_m > 0.0 or not math.isfinite(self.height_m):
            raise InvalidPoseError(f"the camera height is {self.height_m:g} m; it must be positive and finite")
        if not self.std_m >= 0.0:
            raise InvalidPoseError(f"the camera height's deviation is {self.std_m:g} m; it must not be negative")

    def at(self, height_m: float) -> CameraHeight:
        """Return another stated height (m) with the same relative error; not for an unknown height."""
        return CameraHeight(height_m, self.std_m * height_m / self.height_m)

    @property
    def is_exact(self) -> bool:
        """True if the height is exact."""
        return self.std_m == 0.0

    @property
    def is_unknown(self) -> bool:
        """True if the height is unknown."""
        return math.isinf(self.std_m)

    @property
    def log_std(self) -> float:
        """Standard deviation of δ; infinite if the height is unknown."""
        # Rounded, so that heights with the same relative error have the same offsets.
        return round(self.std_m / self.height_m, 12)

    @cached_property
    def bounds(self) -> tuple[float, float]:
        """Smallest and largest possible δ."""
        if self.is_unknown:
            low, high = UNKNOWN_RANGE_M
            return math.log(low / self.height_m), math.log(high / self.height_m)
        return -4.0 * self.log_std, 4.0 * self.log_std

    @cached_property
    def offsets(self) -> Float[np.ndarray, "j"]:
        """The δ that retrieval tries."""
        if self.is_unknown:
            low, high = self.bounds
            return np.linspace(low, high, math.ceil((high - low) / _SPACING) + 1)
        reach = _REACH_STDS * self.log_std
        each_side = math.ceil(reach / _SPACING)
        return np.linspace(-reach, reach, 2 * each_side + 1) if each_side else np.zeros(1)

    def penalty(self, offset: Float[np.ndarray, "*j"]) -> Float[np.ndarray, "*j"]:
        """Return the negative log prior of δ, 0 at best."""
        if self.is_unknown or self.is_exact:
            return np.zeros_like(offset)
        return 0.5 * np.square(offset / self.log_std)
