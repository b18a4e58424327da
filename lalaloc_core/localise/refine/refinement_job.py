"""Jobs and results of pose refinement, in plain numpy so that they can cross process borders."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int


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
    converged: Bool[np.ndarray, "k"]
    evaluations: Int[np.ndarray, "k"]
    height_offset: Float[np.ndarray, "k"] | None = None
