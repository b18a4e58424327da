"""The height of the camera as something that is known more or less.

A picture shows the layout in units of the camera's height: an error of the stated height scales everything that is read
off the picture, and is one offset δ of its log distances, with true height = stated height · exp δ. The search solves
for δ beside the pose.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from lalaloc_core.errors import InvalidPoseError

# Where nothing is known, cameras are held or stand at these heights (m) over the floor, all alike likely.
UNKNOWN_RANGE_M = (0.8, 2.2)
DEFAULT_STD_M = 0.1
# Retrieval tries offsets this far apart at most: half of it is little beside what a grid pose may be off.
_SPACING = 0.1
# ... within so many standard deviations; optimisation may go farther.
_REACH_STDS = 1.5


@dataclass(frozen=True)
class CameraHeight:
    """A stated camera height (m), and the standard deviation (m) of its error.

    `std_m` 0 means that it is exact, infinity that nothing is known: `height_m` is then only what the picture is read
    at, and the height lies anywhere in `UNKNOWN_RANGE_M`.
    """

    height_m: float
    std_m: float = DEFAULT_STD_M

    def __post_init__(self) -> None:
        if not self.height_m > 0.0 or not math.isfinite(self.height_m):
            raise InvalidPoseError(f"the camera height is {self.height_m:g} m, it must be positive and finite")
        if not self.std_m >= 0.0:
            raise InvalidPoseError(f"the camera height's deviation is {self.std_m:g} m, it must not be negative")

    @property
    def is_exact(self) -> bool:
        """Whether there is nothing to solve for."""
        return self.std_m == 0.0

    @property
    def is_unknown(self) -> bool:
        """Whether nothing is known but `UNKNOWN_RANGE_M`."""
        return math.isinf(self.std_m)

    @property
    def log_std(self) -> float:
        """Standard deviation of δ; infinite where nothing is known."""
        return self.std_m / self.height_m

    @cached_property
    def bounds(self) -> tuple[float, float]:
        """The δ that are possible at all."""
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
        """Negative log prior of δ, 0 at best."""
        if self.is_unknown or self.is_exact:
            return np.zeros_like(offset)
        return 0.5 * np.square(offset / self.log_std)
