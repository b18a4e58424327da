"""Architecture `ring`: both branches meet in features around the horizon, one per azimuth sector.

Rolling a ring is turning the camera, so an unknown heading costs one forward of the image. The layout encoder
is a 1-D circular CNN on the wall profile; the image encoder a small 2-D ResNet whose map is squeezed over height
into the same ring. One shared head (flatten, fully connected, L2 norm) turns a ring into a latent.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.fusion import fuse_conv_bn_eval

from lalaloc_core.nets.horizon_attention import HorizonAttention

# Distances outside are clamped before they become features: no camera stands nearer, no room is larger.
_MIN_DISTANCE_M = 0.05
_MAX_DISTANCE_M = 50.0
IMAGE_MEAN = (0.5, 0.5, 0.5)
IMAGE_STD = (0.25, 0.25, 0.25)


@dataclass(frozen=True, kw_only=True)
class RingConfig:
    """Sizes of the `ring` architecture; see `RingLayoutEncoder` and `RingImageEncoder`."""

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
    """Pad the last axis, azimuth, with what lies on its other end: a panorama has no border there."""
    return torch.cat([x[..., -padding:], x, x[..., :padding]], dim=-1) if padding else x


class RingConv1d(nn.Module):
    """1-D convolution around the horizon, followed by batch normalisation."""

    def __init__(self, inputs: int, outputs: int, kernel: int, *, stride: int = 1, dilation: int = 1) -> None:
        super().__init__()
        self.padding = (kernel - 1) // 2 * dilation
        self.conv = nn.Conv1d(inputs, outputs, kernel, stride=stride, dilation=dilation, bias=False)
        self.norm: nn.BatchNorm1d | nn.Identity = nn.BatchNorm1d(outputs)

    def forward(self, x: Float[Tensor, "b i w"]) -> Float[Tensor, "b o v"]:
        return self.norm(self.conv(pad_around(x, self.padding)))

    def fuse(self) -> None:
        """Fold the normalisation into the convolution; for evaluation only."""
        if isinstance(self.norm, nn.BatchNorm1d):
            self.conv = fuse_conv_bn_eval(self.conv, self.norm)
            self.norm = nn.Identity()


class RingHead(nn.Module):
    """Ring to latent: flatten, one fully connected layer, L2 norm. Shared by both branches."""

    def __init__(self, config: RingConfig) -> None:
        super().__init__()
        self.fc = nn.Linear(config.channels * config.sectors, config.latent_size)

    def forward(self, ring: Float[Tensor, "b c s"]) -> Float[Tensor, "b d"]:
        return functional.normalize(self.fc(ring.flatten(1)), dim=1)


class _LayoutBlock(nn.Module):
    def __init__(self, width: int, dilation: int) -> None:
        super().__init__()
        self.conv1 = RingConv1d(width, width, 5, dilation=dilation)
        self.conv2 = RingConv1d(width, width, 5, dilation=dilation)

    def forward(self, x: Float[Tensor, "b c s"]) -> Float[Tensor, "b c s"]:
        # SiLU, not ReLU: pose optimisation differentiates this network and likes smooth derivatives.
        return functional.silu(x + self.conv2(functional.silu(self.conv1(x))))


class RingLayoutEncoder(nn.Module):
    """Wall profile and heights to a latent."""

    def __init__(self, config: RingConfig) -> None:
        super().__init__()
        if config.profile_columns % config.sectors:
            raise ValueError(f"{config.profile_columns} columns do not divide into {config.sectors} sectors")
        self.config = config
        stride = config.profile_columns // config.sectors
        self.stem = RingConv1d(4, config.layout_width, 7, stride=stride)
        self.blocks = nn.Sequential(*(_LayoutBlock(config.layout_width, d) for d in config.layout_dilations))
        self.project = nn.Conv1d(config.layout_width, config.channels, 1)
        self.head = RingHead(config)

    def ring(
        self,
        profile_m: Float[Tensor, "b w"],
        camera_height_m: Float[Tensor, "b"],
        ceiling_height_m: Float[Tensor, "b"],
    ) -> Float[Tensor, "b c s"]:
        """Features of the bare layout around the horizon."""
        distance = profile_m.clamp(_MIN_DISTANCE_M, _MAX_DISTANCE_M)
        foot = torch.atan(camera_height_m[:, None] / distance)
        top = torch.atan((ceiling_height_m - camera_height_m)[:, None] / distance)
        features = torch.stack([torch.log(distance), 1.0 / distance, foot, top], dim=1)
        return self.project(self.blocks(functional.silu(self.stem(features))))

    def forward(
        self,
        profile_m: Float[Tensor, "b w"],
        camera_height_m: Float[Tensor, "b"],
        ceiling_height_m: Float[Tensor, "b"],
    ) -> Float[Tensor, "b d"]:
        return self.head(self.ring(profile_m, camera_height_m, ceiling_height_m))

    def fused(self) -> RingLayoutEncoder:
        """A copy for evaluation with every normalisation folded away: the same function in half the time."""
        copied = copy.deepcopy(self).eval()
        for module in copied.modules():
            if isinstance(module, RingConv1d):
                module.fuse()
        return copied.requires_grad_(False)


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


@dataclass(frozen=True)
class StructureFeatures:
    """What an image encoder says of a panorama besides the distance of the walls.

    Attributes:
        opening_logits: (b, w, classes) of what is met at each azimuth, in the order of `conventions.OPENING_CLASSES`.
        log_ceiling: (b) log of the ceiling's height above the camera (m).
        log_ceiling_scale: (b) log of the scale of the Laplace distribution of `log_ceiling`'s error.
        room_type_logits: (b, types) in the order of `conventions.ROOM_TYPES`.
    """

    opening_logits: Tensor
    log_ceiling: Tensor
    log_ceiling_scale: Tensor
    room_type_logits: Tensor


@dataclass(frozen=True)
class ImageFeatures:
    """What the image encoder says of a panorama.

    Attributes:
        ring: (b, c, s) features to be compared with the layout encoder's.
        log_profile: (b, w) log of the predicted wall profile (m).
        log_scale: (b, w) log of the scale of the Laplace distribution of `log_profile`'s error.
        structure: what an encoder that tells openings, ceiling and type of the room says of them.
    """

    ring: Tensor
    log_profile: Tensor
    log_scale: Tensor
    structure: StructureFeatures | None = None


def first_of(seen: ImageFeatures, count: int) -> ImageFeatures:
    """What was said of the first `count` panoramas of a batch."""
    structure = seen.structure
    if structure is not None:
        structure = StructureFeatures(**{name: value[:count] for name, value in vars(structure).items()})
    return ImageFeatures(seen.ring[:count], seen.log_profile[:count], seen.log_scale[:count], structure)


class RingImageEncoder(nn.Module):
    """Panorama and camera height to a ring and a predicted wall profile.

    The camera height gives the metric scale that a single panorama lacks.
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
            raise ValueError(f"the image encoder ends at {width} sectors, {config.sectors} are wanted")
        self.stages = nn.Sequential(*stages)
        self.squeeze = nn.Linear(inputs * height + 1, config.mixer_width)
        mixers = (
            HorizonAttention(config.mixer_width, config.mixer_heads, config.sectors) for _ in range(config.mixer_blocks)
        )
        self.mixer = nn.Sequential(*mixers)
        self.norm = nn.LayerNorm(config.mixer_width)
        self.to_ring = nn.Linear(config.mixer_width, config.channels)
        self.per_sector = config.profile_columns // config.sectors
        self.to_profile = nn.Linear(config.mixer_width, 2 * self.per_sector)
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
        profile = self.to_profile(mixed).reshape(batch, -1, self.per_sector, 2).flatten(1, 2)
        return ImageFeatures(
            ring=self.to_ring(mixed).transpose(1, 2),
            # Distances come in units of the camera height, as the image shows them.
            log_profile=profile[..., 0] + scale[:, :, 0],
            log_scale=profile[..., 1].clamp(-6.0, 2.0),
        )
