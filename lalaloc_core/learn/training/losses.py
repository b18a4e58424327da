"""Training losses of both stages (paper, sections 3.1, 3.2 and A.1.5)."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from lalaloc_core.conventions import PASSAGE_CODE, WALL_CODE
from lalaloc_core.nets.image_features import StructureFeatures, WallModes

# Keeps log and its gradient finite when two latents coincide.
_MIN_DISTANCE = 1e-4
# Limits the weight of very rare classes.
_MIN_SHARE = 1e-3
# Rows of a wall from which it is seen in a column.
_MIN_WALL_ROWS = 3
# Lower bound of the ceiling's height above the camera (m).
_MIN_ABOVE_M = 0.05


def log_ratio(
    latent_distance: Float[Tensor, "a n"], reference: Float[Tensor, "a n"], positives: int, *, all_pairs: bool
) -> Tensor:
    """Return the log-ratio loss (equation 1), averaged over anchors and pairs of neighbours.

    `(log D_i / D_j - log R_i / R_j)²` for each anchor and pair (i, j) of its neighbours. Between layouts, D is the
    distance of latents and R the Chamfer distance. The variants for spheres (section A.1.5) measure D from the
    sphere's latent; R is the Chamfer distance (log-ratio') or the distance of the teacher's latents (knowledge
    distillation). The first `positives` columns are the positives; `all_pairs` uses every pair of neighbours instead of
    each positive with each negative (the paper).
    """
    excess = _safe_log(latent_distance) - _safe_log(reference)
    if all_pairs:
        return (excess[:, :, None] - excess[:, None, :]).square().mean()
    return (excess[:, :positives, None] - excess[:, None, positives:]).square().mean()


def distance_scale(
    latent_distance: Float[Tensor, "a n"], chamfer: Float[Tensor, "a n"], latent_per_metre: float
) -> Tensor:
    """Penalise the mean ratio of latent to Chamfer distance, which the log-ratio loss leaves free."""
    excess = _safe_log(latent_distance) - _safe_log(chamfer)
    return (excess.mean() - torch.log(torch.tensor(latent_per_metre, device=excess.device))).square()


def decode(decoded: Float[Tensor, "b h w"], depth_m: Float[Tensor, "b h w"]) -> Tensor:
    """Return the decoding loss (equation 2): mean |L' - L| in metres."""
    return (decoded - depth_m).abs().mean()


def l2(image_latent: Float[Tensor, "b d"], layout_latent: Float[Tensor, "b d"]) -> Tensor:
    """Return the mean latent distance (equation 3): |f - g|₂."""
    return torch.linalg.vector_norm(image_latent - layout_latent, dim=1).mean()


def ring_distillation(student: Float[Tensor, "b c s"], teacher: Float[Tensor, "b c s"]) -> Tensor:
    """Return the mean |difference| of ring features, in standard deviations of each channel over the batch."""
    spread = teacher.std(dim=(0, 2), keepdim=True).clamp_min(1e-3)
    return ((student - teacher) / spread).abs().mean()


def laplace_mixture(walls: WallModes, target: Float[Tensor, "b w"], known: Bool[Tensor, "b w"] | None = None) -> Tensor:
    """Return the negative log likelihood of true log distances under mixtures of Laplace distributions, where known."""
    error = (walls.log_profile - target[..., None]).abs()
    loss = -torch.logsumexp(walls.log_share - error * torch.exp(-walls.log_scale) - walls.log_scale, dim=2)
    return loss.mean() if known is None else _mean_of_pictures(loss, known)


def wall_shape(walls: WallModes, target: Float[Tensor, "b w"], known: Bool[Tensor, "b w"]) -> Tensor:
    """Return the mean absolute error of log distances where known, without each picture's median error, its scale."""
    mean = (walls.log_share.exp() * walls.log_profile).sum(dim=2)
    error = torch.where(known, mean - target, torch.nan)
    scale = error.detach().nanmedian(dim=1, keepdim=True).values
    return _mean_of_pictures(torch.where(known, (error - scale).abs(), 0.0), known)


def _mean_of_pictures(loss: Float[Tensor, "b w"], known: Bool[Tensor, "b w"]) -> Tensor:
    """Return the mean over pictures of their means where known: narrow views count as much as wide ones."""
    columns = known.sum(dim=1)
    return ((loss * known).sum(dim=1) / columns.clamp_min(1)).sum() / (columns > 0).sum().clamp_min(1)


def visible_walls(
    log_distance: Float[Tensor, "b w"], openings: Float[Tensor, "b w 3"], opening_logits: Float[Tensor, "b w c"]
) -> Bool[Tensor, "b w"]:
    """Return the azimuths whose wall a teacher sees.

    Where it cannot tell passages (their probability is NaN) and the student predicts one, the teacher sees the wall of
    the next room, but a room ends in the plane of its own wall.
    """
    is_passage = torch.softmax(opening_logits.detach(), dim=2)[..., PASSAGE_CODE] >= 0.5
    return torch.isfinite(log_distance) & ~(openings[..., 2].isnan() & is_passage)


def opening(
    logits: Float[Tensor, "b w c"], kind: Int[Tensor, "b w"], share: Float[Tensor, "c"], balance: float
) -> Tensor:
    """Return the cross entropy of the opening class at each azimuth; negative kinds are unknown and ignored.

    Classes are weighted by `share ** -balance`. The network therefore learns class shares of `opening_prior`.
    """
    weight = share.clamp_min(_MIN_SHARE) ** -balance
    return _cross_entropy(logits.flatten(0, 1), kind.flatten(), weight)


def opening_prior(share: Float[Tensor, "c"], balance: float) -> Float[Tensor, "c"]:
    """Return the class shares implied by the weights of `opening`."""
    weighted = share.clamp_min(_MIN_SHARE) ** (1.0 - balance)
    return weighted / weighted.sum()


def opening_edges(structure: StructureFeatures, edges: Float[Tensor, "b w 2"], seen: Bool[Tensor, "b w"]) -> Tensor:
    """Return the negative log likelihood of the elevations of openings' edges, where known (not NaN) and seen."""
    known = seen[..., None] & edges.isfinite()
    error = (structure.edges - edges.nan_to_num()).abs()
    loss = error * torch.exp(-structure.edges_log_scale) + structure.edges_log_scale
    return (loss * known).sum() / known.sum().clamp_min(1)


def wall_seen(logit: Float[Tensor, "b w"], walls: Float[Tensor, "b h v"], seen: Bool[Tensor, "b w"]) -> Tensor:
    """Return the cross entropy of seeing the wall at each azimuth that is seen; `walls` is 1 at pixels of walls."""
    is_seen = (walls.sum(dim=1) >= _MIN_WALL_ROWS).float()
    target = functional.adaptive_max_pool1d(is_seen, logit.shape[1])
    return functional.binary_cross_entropy_with_logits(logit[seen], target[seen])


def room_type(logits: Float[Tensor, "b c"], kind: Int[Tensor, "b"]) -> Tensor:
    """Return the cross entropy of room types; negative kinds are unknown and ignored."""
    return _cross_entropy(logits, kind, None)


def objects(logits: Float[Tensor, "b n"], taught: Float[Tensor, "b k"], kind: Int[Tensor, "b"]) -> Tensor:
    """Return the cross entropies of household objects, to a teacher's, and of the types of rooms after them."""
    count = taught.shape[1]
    return functional.binary_cross_entropy_with_logits(logits[:, :count], taught) + room_type(logits[:, count:], kind)


def _cross_entropy(logits: Float[Tensor, "n c"], kind: Int[Tensor, "n"], weight: Tensor | None) -> Tensor:
    if not bool((kind >= 0).any()):
        return 0.0 * logits.sum()
    return functional.cross_entropy(logits, kind.long(), weight, ignore_index=-1)


def ceiling(log_ceiling: Float[Tensor, "b"], log_scale: Float[Tensor, "b"], above_m: Float[Tensor, "b"]) -> Tensor:
    """Return the negative log likelihood of the ceiling's true height above the camera (m)."""
    error = (log_ceiling - torch.log(above_m.clamp_min(_MIN_ABOVE_M))).abs()
    return (error * torch.exp(-log_scale) + log_scale).mean()


def teacher_openings(
    logits: Float[Tensor, "b w c"], shares: Float[Tensor, "b w 3"], weight: Float[Tensor, "c"]
) -> Tensor:
    """Return the cross entropy to a teacher's shares by column; without that of passages, the rest is either.

    `weight` is that of each class. Weights `prior / share`, where `share` is a class's in the photographs, make the
    network learn probabilities of that prior, as `opening` does.
    """
    log_probability = torch.log_softmax(logits, dim=2)
    wall, passage = log_probability[..., WALL_CODE], log_probability[..., PASSAGE_CODE]
    log_other = torch.where(shares[..., 2].isnan(), torch.logaddexp(wall, passage), wall)
    known = shares.nan_to_num()
    other_share = (1.0 - known.sum(dim=2)).clamp_min(0.0)
    openings = (known * log_probability[..., WALL_CODE + 1 :]) @ weight[WALL_CODE + 1 :]
    return -(openings + weight[WALL_CODE] * other_share * log_other).mean()


def _safe_log(distance: Tensor) -> Tensor:
    return torch.log(distance.square() + _MIN_DISTANCE**2) / 2.0
