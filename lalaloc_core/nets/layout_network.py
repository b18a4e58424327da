"""Layout encoder of the architectures `ring` and `trunk`, and the decoder of latents.

The encoder makes a ring of features of a wall profile, one per azimuth sector.

Image encoders predict the same kind of ring. Rolling it rotates the camera, so an unknown heading needs only one
forward pass of the image. The layout encoder is a 1-D circular CNN on the wall profile; a head shared with the image
encoders (flatten, fully connected, L2 norm) converts a ring to a latent.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.fusion import fuse_conv_bn_eval

# Distances are clamped to the range of real rooms before they become features.
_MIN_DISTANCE_M = 0.05
_MAX_DISTANCE_M = 50.0


@dataclass(frozen=True, kw_only=True)
class RingConfig:
    """Sizes of the `ring` architecture; see `RingLayoutEncoder` and `ring_image_encoder.RingImageEncoder`."""

    sectors: int = 64
    channels: int = 32
    latent_size: int = 128
    profile_columns: int = 128
    layout_width: int = 64
    layout_dilations: tuple[int, ...] = (1, 1, 2, 4)
    image_height: int = 128
    image_width: int = 256
    image_stem: int = 24
    image_widths: tuple[int, ...] = (32, 56, 88, 112)
    image_blocks: tuple[int, ...] = (1, 2, 2, 2)
    mixer_width: int = 192
    mixer_blocks: int = 2
    mixer_heads: int = 4


def pad_around(x: Float[Tensor, "*batch w"], padding: int) -> Float[Tensor, "*batch w+2*{padding}"]:
    """Pad the last axis, azimuth, circularly."""
    return torch.cat([x[..., -padding:], x, x[..., :padding]], dim=-1) if padding else x


class RingConv1d(nn.Module):
    """1-D convolution around the horizon, followed by batch normalisation."""

    def __init__(self, inputs: int, outputs: int, kernel: int, *, stride: int = 1, dilation: int = 1) -> None:
        super().__init__()
        self.padding = (kernel - 1) // 2 * dilation
        self.conv = nn.Conv1d(inputs, outputs, kernel, stride=stride, dilation=dilation, bias=False)
        self.norm: nn.BatchNorm1d | nn.Identity = nn.BatchNorm1d(outputs)

    def forward(self, x: Float[Tensor, "b i w"]) -> Float[Tensor, "b o v"]:
        """Convolve and normalise."""
        return self.norm(self.conv(pad_around(x, self.padding)))

    def fuse(self) -> None:
        """Fold the normalisation into the convolution; for evaluation only."""
        if isinstance(self.norm, nn.BatchNorm1d):
            self.conv = fuse_conv_bn_eval(self.conv, self.norm)
            self.norm = nn.Identity()


class RingHead(nn.Module):
    """Head from ring to latent: flatten, one fully connected layer, L2 norm. Shared by both encoders."""

    def __init__(self, config: RingConfig) -> None:
        super().__init__()
        self.fc = nn.Linear(config.channels * config.sectors, config.latent_size)

    def forward(self, ring: Float[Tensor, "b c s"]) -> Float[Tensor, "b d"]:
        """Convert rings to latents."""
        return functional.normalize(self.fc(ring.flatten(1)), dim=1)


class _LayoutBlock(nn.Module):
    def __init__(self, width: int, dilation: int) -> None:
        super().__init__()
        self.conv1 = RingConv1d(width, width, 5, dilation=dilation)
        self.conv2 = RingConv1d(width, width, 5, dilation=dilation)

    def forward(self, x: Float[Tensor, "b c s"]) -> Float[Tensor, "b c s"]:
        # SiLU, not ReLU: pose refinement differentiates this network and needs smooth derivatives.
        return functional.silu(x + self.conv2(functional.silu(self.conv1(x))))


class RingLayoutEncoder(nn.Module):
    """Layout encoder: wall profile, camera height and ceiling height to a latent."""

    def __init__(self, config: RingConfig) -> None:
        super().__init__()
        if config.profile_columns % config.sectors:
            raise ValueError(
                f"profile_columns is {config.profile_columns}; it must be a multiple of sectors ({config.sectors})"
            )
        self.config = config
        stride = config.profile_columns // config.sectors
        self.stem = RingConv1d(4, config.layout_width, 7, stride=stride)
        self.blocks = nn.Sequential(*(_LayoutBlock(config.layout_width, d) for d in config.layout_dilations))
        self.project = nn.Conv1d(config.layout_width, config.channels, 1)
        self.head = RingHead(config)

    def ring(
        self, profile_m: Float[Tensor, "b w"], camera_height_m: Float[Tensor, "b"], ceiling_height_m: Float[Tensor, "b"]
    ) -> Float[Tensor, "b c s"]:
        """Return the ring of the bare layout."""
        distance = profile_m.clamp(_MIN_DISTANCE_M, _MAX_DISTANCE_M)
        foot = torch.atan(camera_height_m[:, None] / distance)
        top = torch.atan((ceiling_height_m - camera_height_m)[:, None] / distance)
        features = torch.stack([torch.log(distance), 1.0 / distance, foot, top], dim=1)
        return self.project(self.blocks(functional.silu(self.stem(features))))

    def forward(
        self, profile_m: Float[Tensor, "b w"], camera_height_m: Float[Tensor, "b"], ceiling_height_m: Float[Tensor, "b"]
    ) -> Float[Tensor, "b d"]:
        """Encode layouts as latents."""
        return self.head(self.ring(profile_m, camera_height_m, ceiling_height_m))

    def fused(self) -> RingLayoutEncoder:
        """Return a copy for evaluation with every normalisation folded into its convolution, in half the time."""
        copied = copy.deepcopy(self).eval()
        for module in copied.modules():
            if isinstance(module, RingConv1d):
                module.fuse()
        return copied.requires_grad_(False)


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
