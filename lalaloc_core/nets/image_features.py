"""Outputs of image encoders, and attention between the sectors around the horizon."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn


@dataclass(frozen=True)
class StructureFeatures:
    """Predictions besides the wall profile: openings, ceiling height and room type.

    Attributes:
        opening_logits: (b, w, classes) class of each azimuth, in the order of `conventions.OPENING_CLASSES`.
        log_ceiling: (b) log of the ceiling's height above the camera (m).
        log_ceiling_scale: (b) log of the scale of the Laplace distribution of `log_ceiling`'s error.
        room_type_logits: (b, types) in the order of `conventions.ROOM_TYPES`.
        edges: (b, w, 2) elevation (radians) of the lower and the upper edge of an opening at each azimuth.
        edges_log_scale: (b, w, 2) log scale of the Laplace distributions of their errors.
        wall_seen_logit: (b, w) log odds that the wall is seen at all, not hidden behind furniture.
    """

    opening_logits: Tensor
    log_ceiling: Tensor
    log_ceiling_scale: Tensor
    room_type_logits: Tensor
    edges: Tensor
    edges_log_scale: Tensor
    wall_seen_logit: Tensor

    def rows(self, rows: slice) -> StructureFeatures:
        """Return the predictions for some pictures of a batch."""
        return StructureFeatures(*(value[rows] for value in vars(self).values()))


@dataclass(frozen=True)
class WallModes:
    """Distance of the wall at each azimuth, as mixtures (b, w, m) of Laplace distributions of its log."""

    log_profile: Tensor
    log_scale: Tensor
    log_share: Tensor

    @property
    def likeliest(self) -> Float[Tensor, "b w"]:
        """Log distance (m) of the mode with the highest density."""
        best = (self.log_share - self.log_scale).argmax(dim=2, keepdim=True)
        return self.log_profile.gather(2, best)[..., 0]

    def rows(self, rows: slice) -> WallModes:
        """Return the predictions for some pictures of a batch."""
        return WallModes(*(value[rows] for value in vars(self).values()))


@dataclass(frozen=True)
class ImageFeatures:
    """Predictions of an image encoder for spheres; `ring` (b, c, s) is compared with the layout encoder's."""

    ring: Tensor
    walls: WallModes
    structure: StructureFeatures | None = None


def first_rows(features: ImageFeatures, count: int) -> ImageFeatures:
    """Return the predictions for the first `count` spheres of a batch."""
    rows = slice(count)
    structure = None if features.structure is None else features.structure.rows(rows)
    return ImageFeatures(features.ring[rows], features.walls.rows(rows), structure)


class HorizonAttention(nn.Module):
    """Attention over the sectors with a learnt bias by offset, and a feed-forward layer.

    The bias depends on offsets, not on positions, so rolling the sphere rolls the ring. The offsets of a full circle
    are circular; those of a part of it are not.
    """

    def __init__(self, width: int, heads: int, sectors: int, *, circular: bool = True) -> None:
        super().__init__()
        self.heads = heads
        self.norm1 = nn.LayerNorm(width)
        self.qkv = nn.Linear(width, 3 * width)
        self.bias = nn.Parameter(torch.zeros(heads, sectors if circular else 2 * sectors - 1))
        self.out = nn.Linear(width, width)
        self.norm2 = nn.LayerNorm(width)
        self.feed = nn.Sequential(nn.Linear(width, 2 * width), nn.GELU(), nn.Linear(2 * width, width))
        sector = torch.arange(sectors)
        offset = sector[None, :] - sector[:, None]
        self.register_buffer("offset", offset % sectors if circular else offset + sectors - 1, persistent=False)
        self.offset: Tensor

    def forward(self, x: Float[Tensor, "b s c"]) -> Float[Tensor, "b s c"]:
        """Mix the features of all sectors."""
        batch, sectors, width = x.shape
        qkv = self.qkv(self.norm1(x)).reshape(batch, sectors, 3, self.heads, width // self.heads)
        query, key, value = qkv.permute(2, 0, 3, 1, 4).unbind(0)
        scores = query @ key.transpose(-1, -2) * (width // self.heads) ** -0.5 + self.bias[:, self.offset]
        mixed = (scores.softmax(dim=-1) @ value).transpose(1, 2).reshape(batch, sectors, width)
        x = x + self.out(mixed)
        return x + self.feed(self.norm2(x))
