"""Image encoder of the architecture `ring`: a small 2-D ResNet whose feature map is flattened over height to a ring."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from lalaloc_core.nets.image_features import HorizonAttention, ImageFeatures, WallModes
from lalaloc_core.nets.layout_network import RingConfig, pad_around

IMAGE_MEAN = (0.5, 0.5, 0.5)
IMAGE_STD = (0.25, 0.25, 0.25)


class _RingConv2d(nn.Module):
    """2-D convolution, circular in azimuth and zero-padded in elevation, with batch normalisation."""

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: tuple[int, int] = (1, 1)) -> None:
        super().__init__()
        self.padding = kernel // 2
        self.conv = nn.Conv2d(inputs, outputs, kernel, stride=stride, padding=(self.padding, 0), bias=False)
        self.norm = nn.BatchNorm2d(outputs)

    def forward(self, x: Float[Tensor, "b i h w"]) -> Float[Tensor, "b o g v"]:
        return self.norm(self.conv(pad_around(x, self.padding)))


class _ImageBlock(nn.Module):
    def __init__(self, inputs: int, outputs: int, stride: tuple[int, int]) -> None:
        super().__init__()
        self.conv1 = _RingConv2d(inputs, outputs, 3, stride)
        self.conv2 = _RingConv2d(outputs, outputs, 3)
        same = inputs == outputs and stride == (1, 1)
        self.shortcut = nn.Identity() if same else _RingConv2d(inputs, outputs, 1, stride)

    def forward(self, x: Float[Tensor, "b i h w"]) -> Float[Tensor, "b o g v"]:
        return functional.relu(self.conv2(functional.relu(self.conv1(x))) + self.shortcut(x))


class RingImageEncoder(nn.Module):
    """Image encoder: sphere and camera height to a ring and a wall profile.

    The camera height gives the metric scale that a single sphere lacks.
    """

    def __init__(self, config: RingConfig) -> None:
        super().__init__()
        self.config = config
        self.stem = _RingConv2d(4, config.image_stem, 5, (2, 2))
        stages, inputs, height, width = [], config.image_stem, config.image_height // 2, config.image_width // 2
        for outputs, count in zip(config.image_widths, config.image_blocks, strict=True):
            stride = (2, 2 if width > config.sectors else 1)
            stages.append(_ImageBlock(inputs, outputs, stride))
            stages += [_ImageBlock(outputs, outputs, (1, 1)) for _ in range(count - 1)]
            inputs, height, width = outputs, height // 2, width // stride[1]
        if width != config.sectors:
            raise ValueError(
                f"the image encoder ends at {width} sectors instead of {config.sectors}; change image_width or sectors"
            )
        self.stages = nn.Sequential(*stages)
        self.squeeze = nn.Linear(inputs * height + 1, config.mixer_width)
        mixers = (
            HorizonAttention(config.mixer_width, config.mixer_heads, config.sectors) for _ in range(config.mixer_blocks)
        )
        self.mixer = nn.Sequential(*mixers)
        self.norm = nn.LayerNorm(config.mixer_width)
        self.to_ring = nn.Linear(config.mixer_width, config.channels)
        self.columns_per_sector = config.profile_columns // config.sectors
        self.to_profile = nn.Linear(config.mixer_width, 2 * self.columns_per_sector)
        elevation = 1.0 - (torch.arange(config.image_height) + 0.5) / (0.5 * config.image_height)
        self.register_buffer("elevation", elevation[None, None, :, None], persistent=False)
        self.register_buffer("mean", 255.0 * torch.tensor(IMAGE_MEAN)[None, :, None, None], persistent=False)
        self.register_buffer("std", 255.0 * torch.tensor(IMAGE_STD)[None, :, None, None], persistent=False)
        self.elevation: Tensor
        self.mean: Tensor
        self.std: Tensor

    def forward(self, image: Tensor, camera_height_m: Float[Tensor, "b"]) -> ImageFeatures:
        """Encode `image`, (b, h, w, 3), values 0 to 255 of any type."""
        pixels = (image.permute(0, 3, 1, 2).to(self.mean.dtype) - self.mean) / self.std
        batch, _, _, width = pixels.shape
        pixels = torch.cat([pixels, self.elevation.expand(batch, -1, -1, width)], dim=1)
        features = self.stages(functional.relu(self.stem(pixels)))
        columns = features.flatten(1, 2).transpose(1, 2)
        scale = torch.log(camera_height_m)[:, None, None]
        columns = torch.cat([columns, scale.expand(-1, columns.shape[1], -1)], dim=2)
        mixed = self.norm(self.mixer(self.squeeze(columns)))
        profile = self.to_profile(mixed).reshape(batch, -1, self.columns_per_sector, 2).flatten(1, 2)
        return ImageFeatures(
            ring=self.to_ring(mixed).transpose(1, 2),
            # The network predicts distances in units of the camera height.
            walls=WallModes(
                log_profile=(profile[..., 0] + scale[:, :, 0])[..., None],
                log_scale=profile[..., 1:].clamp(-6.0, 2.0),
                log_share=torch.zeros_like(profile[..., 1:]),
            ),
        )
