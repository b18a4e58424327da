"""Attention around the horizon: image encoders infer from it the walls that furniture hides."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn


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
