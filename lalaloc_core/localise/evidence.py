"""How badly a pose fits a panorama: by the latent of its layout, and by its wall profile.

The image encoder predicts a log wall profile and, for every azimuth, how sure it is of it. The cost of a pose is the
mean over the azimuths of a negative log likelihood, up to constants, with the heavy tails of a Cauchy distribution,
because a door that was looked through must cost no more than a door:

    mean_w log(1 + r_w²),   r_w = (log d_w(pose) - μ_w) / (κ s_w),   s_w² = b_w² + (reach / exp μ_w)²

with the predicted μ and b, the tail factor κ, and the `reach`: how far (m) the pose may lie from the camera even if it
is the best that is looked at, which on a coarse grid is the larger part of the error. A weighted latent distance may be
added. Models without a predicted profile are compared by latent distance alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from lalaloc_core.localise.poses import Query

# A prediction is never trusted beyond this: the scale of log distance of a centimetre at ten metres.
_SHARPEST = 1e-3


@dataclass(frozen=True, kw_only=True)
class EvidenceConfig:
    """What poses are compared by.

    Attributes:
        use_profile: compare wall profiles where the model predicts them; else latents alone.
        latent_weight: weight of the latent distance in the cost of a profile.
        tail: κ.
        grid_reach: reach on a grid, in units of its step; cameras are at most 0.7 of it from the nearest pose.
        fine_reach_m: reach of poses that were re-sampled or optimised.
    """

    use_profile: bool = True
    latent_weight: float = 0.0
    tail: float = 3.0
    grid_reach: float = 0.6
    fine_reach_m: float = 0.07

    def compares_profiles(self, query: Query) -> bool:
        """Whether this query's poses are compared by their wall profiles."""
        return self.use_profile and query.profile is not None


def targets(
    query: Query, hypothesis: Int[np.ndarray, "*k"], reach_m: float, config: EvidenceConfig
) -> tuple[Float[np.ndarray, "*k w"], Float[np.ndarray, "*k w"]]:
    """Predicted log profiles μ of hypotheses, and the precisions 1 / (κ s) that differences are multiplied with."""
    assert query.profile is not None
    centre = query.profile.log_m[hypothesis]
    scale = np.hypot(np.maximum(np.exp(query.profile.log_scale[hypothesis]), _SHARPEST), reach_m * np.exp(-centre))
    return centre, 1.0 / (config.tail * scale)


def profile_costs(
    log_profile: Float[np.ndarray, "n w"], centre: Float[np.ndarray, "w"], precision: Float[np.ndarray, "w"]
) -> Float[np.ndarray, "n"]:
    """Cost of each of some log wall profiles (m) for one prediction."""
    residual = (log_profile - centre) * precision
    np.square(residual, out=residual)
    return np.log1p(residual, out=residual).mean(axis=1)


def latent_distances(latents: Float[np.ndarray, "n d"], targets: Float[np.ndarray, "k d"]) -> Float[np.ndarray, "k n"]:
    """Euclidean distance of each target to each latent, both of unit length."""
    return np.sqrt(np.maximum(2.0 - 2.0 * (targets @ latents.T), 0.0))
