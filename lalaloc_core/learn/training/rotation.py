"""Exact rotation and mirroring: spheres by whole pixels, layouts by the remaining heading."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Shaped

from lalaloc_core.conventions import TWO_PI, wrap_angle
from lalaloc_core.learn.training.config import Turns

_QUARTER = TWO_PI / 4.0


@dataclass(frozen=True, kw_only=True)
class Rotation:
    """Rotation and mirroring of a sphere.

    Attributes:
        shift: pixels by which its columns move to the right.
        heading: azimuth of the centre column after the shift, radians; layouts are cast at this heading.
    """

    shift: int
    heading: float
    mirrored: bool

    def picture(self, image: Shaped[np.ndarray, "h w 3"]) -> Shaped[np.ndarray, "h w 3"]:
        """Rotate and mirror a sphere."""
        turned = np.roll(image, self.shift, axis=1)
        return turned[:, ::-1] if self.mirrored else turned

    def profile(self, profile_m: Shaped[np.ndarray, "*n columns"]) -> Shaped[np.ndarray, "*n columns"]:
        """Mirror wall profiles, or other values by azimuth column, that were cast at `heading`."""
        return profile_m[..., ::-1] if self.mirrored else profile_m


def sample_rotation(turns: Turns, heading: float, width: int, rng: np.random.Generator) -> Rotation:
    """Draw the rotation of a sphere of `width` columns whose centre column looks along `heading` (radians)."""
    pixel = TWO_PI / width
    shift = int(rng.integers(width)) if turns == "any" else round((heading - _target(turns, rng)) / pixel)
    mirrored = turns != "none" and bool(rng.random() < 0.5)
    return Rotation(shift=shift, heading=float(wrap_angle(heading - shift * pixel)), mirrored=mirrored)


def sample_heading(turns: Turns, rng: np.random.Generator) -> float:
    """Draw the heading (radians) of a layout."""
    return float(rng.uniform(0.0, TWO_PI)) if turns == "any" else _target(turns, rng)


def _target(turns: Turns, rng: np.random.Generator) -> float:
    return 0.0 if turns == "none" else float(rng.integers(4)) * _QUARTER
