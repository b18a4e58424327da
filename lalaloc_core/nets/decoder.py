"""Layout decoder: from a latent to layout depth, for training only (paper, section A.1.2)."""

from __future__ import annotations

from itertools import pairwise

from jaxtyping import Float
from torch import Tensor, nn

DECODED_HEIGHT = 32
DECODED_WIDTH = 64
_WIDTHS = (256, 128, 64, 32, 32)


class LayoutDecoder(nn.Module):
    """Decoder: latent to 2x4x256, four times (bilinear x2, 3x3 conv, ReLU, batch norm), 1x1 conv to 32x64 depth (m)."""

    def __init__(self, latent_size: int = 128) -> None:
        super().__init__()
        self.expand = nn.Linear(latent_size, 2 * 4 * _WIDTHS[0])
        blocks: list[nn.Module] = []
        for inputs, outputs in pairwise(_WIDTHS):
            blocks += [
                nn.Upsample(scale_factor=2, mode="bilinear", align_corners=False),
                nn.Conv2d(inputs, outputs, 3, padding=1),
                nn.ReLU(),
                nn.BatchNorm2d(outputs),
            ]
        self.blocks = nn.Sequential(*blocks)
        self.to_depth = nn.Conv2d(_WIDTHS[-1], 1, 1)

    def forward(self, latent: Float[Tensor, "b d"]) -> Float[Tensor, "b 32 64"]:
        """Decode latents to layout depth (m)."""
        features = self.expand(latent).reshape(-1, _WIDTHS[0], 2, 4)
        return self.to_depth(self.blocks(features))[:, 0]
