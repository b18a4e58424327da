"""What the stages of localisation hand to one another. Plain numpy, so that it crosses process borders."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from lalaloc_core.sampling import PoseSet


@dataclass(frozen=True, eq=False)
class LatentGrid:
    """Poses and latents of one plan for one model, one camera height and one grid step; heading 0."""

    poses: PoseSet
    latents: Float[np.ndarray, "n d"]
    step_m: float
    camera_height_m: float


@dataclass(frozen=True, eq=False)
class Query:
    """An encoded panorama: one latent per hypothesis of how it is turned.

    The layout encoder sees a panorama in its *frame*: rolled by whole pixels or ring sectors so that its centre
    column looks (almost) along azimuth 0. A hypothesis k assumes a panorama heading of
    `roll[k] + frame_heading`, and its latent is to be compared with layouts rendered at `frame_heading`.

    Attributes:
        latents: (k, d), L2-normalised.
        roll: (k,) radians, what was rolled away.
        frame_heading: radians; what whole-pixel rolling could not remove, 0 when the heading is unknown.
        heading_known: whether the heading was given; if not, it is searched over and refined.
    """

    latents: Float[np.ndarray, "k d"]
    roll: Float[np.ndarray, "k"]
    frame_heading: float
    heading_known: bool


@dataclass(frozen=True)
class Candidate:
    """One answer: a pose and how far the latent of its layout lies from the query's.

    Attributes:
        frame_heading: heading (radians) of the layout in the frame of `Query` hypothesis number `hypothesis`;
            the panorama's heading is `query.roll[hypothesis] + frame_heading`.
    """

    x_m: float
    y_m: float
    room_index: int
    frame_heading: float
    hypothesis: int
    latent_distance: float

    @property
    def position_m(self) -> Float[np.ndarray, "2"]:
        """(x, y) as an array."""
        return np.array([self.x_m, self.y_m])


@dataclass(frozen=True, eq=False)
class RefinementJob:
    """Starting poses for latent pose optimisation, each with its own target latent and room."""

    targets: Float[np.ndarray, "k d"]
    position_m: Float[np.ndarray, "k 2"]
    heading: Float[np.ndarray, "k"]
    walls_m: Float[np.ndarray, "k n 4"]
    camera_height_m: Float[np.ndarray, "k"]
    ceiling_height_m: Float[np.ndarray, "k"]
    optimise_heading: bool


@dataclass(frozen=True, eq=False)
class RefinementResult:
    """Where the optimisation ended: poses inside the same rooms, their latent distances, and what it took."""

    position_m: Float[np.ndarray, "k 2"]
    heading: Float[np.ndarray, "k"]
    latent_distance: Float[np.ndarray, "k"]
    converged: Bool[np.ndarray, "k"]
    evaluations: Int[np.ndarray, "k"]
