"""Training losses of both stages (paper, sections 3.1, 3.2 and A.1.5)."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from lalaloc_core.conventions import OPENING_CLASSES

# Keeps log and its gradient finite when two latents coincide.
_MIN_DISTANCE = 1e-4
# A class that is hardly ever seen does not get all the weight.
_MIN_SHARE = 1e-3
# Cameras touch no ceiling.
_MIN_ABOVE_M = 0.05


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
    """Negative log likelihood of the true log wall profile under the predicted Laplace distributions."""
    error = (log_profile - torch.log(profile_m)).abs()
    return (error * torch.exp(-log_scale) + log_scale).mean()


def followed_walls(
    log_profile: Float[Tensor, "b w"],
    log_scale: Float[Tensor, "b w"],
    log_distance: Float[Tensor, "b w"],
    opening_logits: Float[Tensor, "b w c"],
) -> Tensor:
    """`laplace` of a teacher's walls, whose log distances are nan where it sees none.

    Where the student sees a passage the teacher is not followed: it sees the wall of the room behind, and a room ends
    in the plane of its own wall.
    """
    passage = torch.softmax(opening_logits.detach(), dim=2)[..., OPENING_CLASSES.index("passage")]
    known = torch.isfinite(log_distance) & (passage < 0.5)
    error = (log_profile - log_distance.nan_to_num()).abs()
    each = error * torch.exp(-log_scale) + log_scale
    return (each * known).sum() / known.sum().clamp_min(1)


def opening(
    logits: Float[Tensor, "b w c"], kind: Int[Tensor, "b w"], share: Float[Tensor, "c"], balance: float
) -> Tensor:
    """Cross entropy of what is met at each azimuth; kinds below 0 are not known and do not count.

    Classes weigh `share ** -balance`. The distributions that are learnt so are those of a world in which the classes'
    shares are `opening_prior`.
    """
    weight = share.clamp_min(_MIN_SHARE) ** -balance
    return _weighted(logits.flatten(0, 1), kind.flatten(), weight)


def opening_prior(share: Float[Tensor, "c"], balance: float) -> Float[Tensor, "c"]:
    """The classes' shares in the world that `opening` pretends to be in."""
    weighted = share.clamp_min(_MIN_SHARE) ** (1.0 - balance)
    return weighted / weighted.sum()


def room_type(logits: Float[Tensor, "b c"], kind: Int[Tensor, "b"]) -> Tensor:
    """Cross entropy of the rooms' types; those below 0 are not known and do not count."""
    return _weighted(logits, kind, None)


def _weighted(logits: Float[Tensor, "n c"], kind: Int[Tensor, "n"], weight: Tensor | None) -> Tensor:
    if not bool((kind >= 0).any()):
        return 0.0 * logits.sum()
    return functional.cross_entropy(logits, kind.long(), weight, ignore_index=-1)


def ceiling(log_ceiling: Float[Tensor, "b"], log_scale: Float[Tensor, "b"], above_m: Float[Tensor, "b"]) -> Tensor:
    """Negative log likelihood of the ceiling's true height above the camera (m)."""
    error = (log_ceiling - torch.log(above_m.clamp_min(_MIN_ABOVE_M))).abs()
    return (error * torch.exp(-log_scale) + log_scale).mean()


def followed_maps(logits: Float[Tensor, "b w c"], taught: Float[Tensor, "b w 2"]) -> Tensor:
    """Cross entropy to a teacher's shares of (door, window) in each column.

    The teacher knows no passages: the rest may be wall or passage as the student likes.
    """
    log_probability = torch.log_softmax(logits, dim=2)
    door, window = (OPENING_CLASSES.index(kind) for kind in ("door", "window"))
    others = [code for code in range(len(OPENING_CLASSES)) if code not in (door, window)]
    rest = torch.logsumexp(log_probability[..., others], dim=2)
    left = (1.0 - taught.sum(dim=2)).clamp_min(0.0)
    seen = taught[..., 0] * log_probability[..., door] + taught[..., 1] * log_probability[..., window] + left * rest
    return -seen.mean()


def _safe_log(distance: Tensor) -> Tensor:
    return torch.log(distance.square() + _MIN_DISTANCE**2) / 2.0
