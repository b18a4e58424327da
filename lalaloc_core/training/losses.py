"""Training losses of both stages (paper, sections 3.1, 3.2 and A.1.5)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

# Keeps log and its gradient finite when two latents coincide.
_MIN_DISTANCE = 1e-4


def log_ratio(
    latent_distance: Float[Tensor, "a n"], reference: Float[Tensor, "a n"], positives: int, *, all_pairs: bool
) -> Tensor:
    """Log-ratio loss (equation 1), averaged over anchors and pairs of neighbours.

    `(log D_i / D_j - log R_i / R_j)²` for each anchor and pair (i, j) of its neighbours. Between layouts, D is their
    latents' distance and R their Chamfer distance. The panorama's variants (section A.1.5) measure D from the
    panorama's latent; R stays (log-ratio') or is the distance of the teacher's latents (knowledge distillation).

    Args:
        latent_distance: D of each neighbour to its anchor; the first `positives` columns are the positives.
        reference: R of the same pairs, in any unit.
        all_pairs: use every pair of neighbours, else each positive with each negative, as in the paper.
    """
    excess = _safe_log(latent_distance) - _safe_log(reference)
    if all_pairs:
        return (excess[:, :, None] - excess[:, None, :]).square().mean()
    return (excess[:, :positives, None] - excess[:, None, positives:]).square().mean()


def distance_scale(
    latent_distance: Float[Tensor, "a n"], chamfer: Float[Tensor, "a n"], latent_per_metre: float
) -> Tensor:
    """Fixes what the log-ratio leaves free: the mean ratio of latent to Chamfer distance."""
    excess = _safe_log(latent_distance) - _safe_log(chamfer)
    return (excess.mean() - torch.log(torch.tensor(latent_per_metre, device=excess.device))).square()


def decode(decoded: Float[Tensor, "b h w"], depth_m: Float[Tensor, "b h w"]) -> Tensor:
    """Decoding loss (equation 2): mean |L' - L| in metres."""
    return (decoded - depth_m).abs().mean()


def l2(image_latent: Float[Tensor, "b d"], layout_latent: Float[Tensor, "b d"]) -> Tensor:
    """Latent distance (equation 3), averaged: |f - g|₂."""
    return torch.linalg.vector_norm(image_latent - layout_latent, dim=1).mean()


def ring_distillation(student: Float[Tensor, "b c s"], teacher: Float[Tensor, "b c s"]) -> Tensor:
    """Mean |difference| of ring features in units of each channel's spread over the batch."""
    spread = teacher.std(dim=(0, 2), keepdim=True).clamp_min(1e-3)
    return ((student - teacher) / spread).abs().mean()


def laplace(
    log_profile: Float[Tensor, "b w"], log_scale: Float[Tensor, "b w"], profile_m: Float[Tensor, "b w"]
) -> Tensor:
    """DeferredBatch log likelihood of the true log wall profile under the predicted Laplace distributions."""
    error = (log_profile - torch.log(profile_m)).abs()
    return (error * torch.exp(-log_scale) + log_scale).mean()


def _safe_log(distance: Tensor) -> Tensor:
    return torch.log(distance.square() + _MIN_DISTANCE**2) / 2.0
