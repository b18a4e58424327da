"""Architecture `trunk`: the image encoder of the shipped model, on a trunk pretrained on photographs.

Layout encoder and head are those of `ring`. The trunk's feature maps of four strides are flattened over height,
interpolated to the ring's sectors, and mixed around the horizon. An image shows lengths only relative to the camera
height, so profile, openings, ceiling and room type are predicted without it, and lengths are then multiplied by it. An
error of the stated height therefore shifts the whole log profile by one offset. Only the ring, which is compared with
layouts in metres, takes the height as an input.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from lalaloc_core.conventions import OPENING_CLASSES, ROOM_TYPES
from lalaloc_core.errors import ConfigError
from lalaloc_core.nets.horizon_attention import HorizonAttention
from lalaloc_core.nets.image_features import ImageFeatures, StructureFeatures
from lalaloc_core.nets.layout_encoder import RingConfig
from lalaloc_core.nets.trunk import IMAGE_MEAN, IMAGE_STD, TAP_STRIDES, StyleMixing, Trunk, TrunkConfig

# Smallest update rate of the running class shares.
_SHARE_RATE = 1e-3
_MIN_LOG_SCALE, _MAX_LOG_SCALE = -6.0, 2.0


@dataclass(frozen=True, kw_only=True)
class TrunkEncoderConfig:
    """Sizes of the image encoder; `RingConfig` holds sectors, channels, profile columns and latent size.

    Attributes:
        image_height, image_width: pixels; both must be multiples of the largest stride.
        trunk: sizes of the trunk.
        squeezed: features per sector from each feature map of the trunk.
        mixer_width, mixer_blocks, mixer_heads: sizes of the attention around the horizon.
    """

    image_height: int = 128
    image_width: int = 256
    trunk: TrunkConfig = field(default_factory=TrunkConfig)
    squeezed: tuple[int, ...] = (96, 96, 192, 192)
    mixer_width: int = 192
    mixer_blocks: int = 2
    mixer_heads: int = 4

    def __post_init__(self) -> None:
        """Check the sizes.

        Raises:
            ConfigError: a size is invalid.
        """
        for name in ("image_height", "image_width"):
            if getattr(self, name) % TAP_STRIDES[-1] or getattr(self, name) < TAP_STRIDES[-1]:
                raise ConfigError(f"trunk.{name} is {getattr(self, name)}; it must be a multiple of {TAP_STRIDES[-1]}")
        if len(self.squeezed) != len(TAP_STRIDES):
            raise ConfigError(f"trunk.squeezed has {len(self.squeezed)} values; it must have {len(TAP_STRIDES)}")


class TrunkImageEncoder(nn.Module):
    """Image encoder: panorama and camera height to ring, wall profile, openings, ceiling height and room type."""

    def __init__(self, config: TrunkEncoderConfig, ring: RingConfig) -> None:
        super().__init__()
        self.config = config
        self.trunk = Trunk(config.trunk)
        self.columns_per_sector = ring.profile_columns // ring.sectors
        width = config.mixer_width
        maps = list(zip(TAP_STRIDES, config.trunk.tap_channels, config.squeezed, strict=True))
        self.squeezes = nn.ModuleList(
            nn.Linear(channels * (config.image_height // stride), squeezed) for stride, channels, squeezed in maps
        )
        for number, stride in enumerate(TAP_STRIDES):
            weights = _interpolation(config.image_width, stride, ring.sectors)
            self.register_buffer(f"interpolation{number}", weights, persistent=False)
        self.join = nn.Linear(sum(config.squeezed), width)
        self.mixer = nn.Sequential(
            *(HorizonAttention(width, config.mixer_heads, ring.sectors) for _ in range(config.mixer_blocks))
        )
        self.norm = nn.LayerNorm(width)
        self.to_profile = nn.Linear(width, 2 * self.columns_per_sector)
        self.to_openings = nn.Linear(width, len(OPENING_CLASSES) * self.columns_per_sector)
        self.to_ceiling = nn.Sequential(nn.Linear(width, width), nn.GELU(), nn.Linear(width, 2))
        self.to_room_type = nn.Sequential(nn.Linear(2 * width, width), nn.GELU(), nn.Linear(width, len(ROOM_TYPES)))
        self.to_ring = nn.Sequential(nn.Linear(width + 1, width), nn.GELU(), nn.Linear(width, ring.channels))
        # Class shares of the training data: the prior by which predicted probabilities are divided.
        for name, classes in (("opening", OPENING_CLASSES), ("room_type", ROOM_TYPES)):
            self.register_buffer(f"{name}_share", torch.full((len(classes),), 1.0 / len(classes)))
        self.register_buffer("counted", torch.zeros((), dtype=torch.long))
        self.register_buffer("mean", 255.0 * torch.tensor(IMAGE_MEAN)[None, :, None, None], persistent=False)
        self.register_buffer("std", 255.0 * torch.tensor(IMAGE_STD)[None, :, None, None], persistent=False)
        self.opening_share: Tensor
        self.room_type_share: Tensor
        self.counted: Tensor
        self.mean: Tensor
        self.std: Tensor

    def forward(
        self, image: Tensor, camera_height_m: Float[Tensor, "b"], styles: StyleMixing | None = None
    ) -> ImageFeatures:
        """Encode panoramas.

        Pixels are 0 to 255 of any type, (b, h, w, 3); `styles` is for training only.
        """
        mixed = self._mixed(image, styles)
        log_height = torch.log(camera_height_m)
        height_input = log_height[:, None, None].expand(-1, mixed.shape[1], -1)
        profile = self.to_profile(mixed).unflatten(2, (self.columns_per_sector, 2)).flatten(1, 2)
        openings = self.to_openings(mixed).unflatten(2, (self.columns_per_sector, len(OPENING_CLASSES))).flatten(1, 2)
        ceiling = self.to_ceiling(mixed).mean(dim=1)
        overall = torch.cat([mixed.mean(dim=1), mixed.amax(dim=1)], dim=1)
        return ImageFeatures(
            ring=self.to_ring(torch.cat([mixed, height_input], dim=2)).transpose(1, 2),
            log_profile=profile[..., 0] + log_height[:, None],
            log_scale=profile[..., 1].clamp(_MIN_LOG_SCALE, _MAX_LOG_SCALE),
            structure=StructureFeatures(
                opening_logits=openings,
                log_ceiling=ceiling[:, 0] + log_height,
                log_ceiling_scale=ceiling[:, 1].clamp(_MIN_LOG_SCALE, _MAX_LOG_SCALE),
                room_type_logits=self.to_room_type(overall),
            ),
        )

    @torch.no_grad()
    def update_class_shares(self, opening_kind: Int[Tensor, "b w"], room_type: Int[Tensor, "b"]) -> None:
        """Update the class shares with the labels of a batch; codes below 0 are unknown."""
        self.counted += 1
        rate = max(1.0 / int(self.counted), _SHARE_RATE)
        for share, kind in ((self.opening_share, opening_kind), (self.room_type_share, room_type)):
            known = kind[kind >= 0]
            if len(known):
                share.lerp_(torch.bincount(known.long(), minlength=len(share)).to(share) / len(known), rate)

    def _mixed(self, image: Tensor, styles: StyleMixing | None) -> Float[Tensor, "b s c"]:
        """Return the sectors' features, which do not depend on the camera height."""
        pixels = (image.permute(0, 3, 1, 2).to(self.mean.dtype) - self.mean) / self.std
        squeezed = []
        for number, (tap, squeeze) in enumerate(zip(self.trunk(pixels, styles), self.squeezes, strict=True)):
            columns = squeeze(tap.flatten(1, 2).transpose(1, 2)).to(self.mean.dtype)
            squeezed.append(self.get_buffer(f"interpolation{number}") @ columns)
        return self.norm(self.mixer(self.join(torch.cat(squeezed, dim=2))))


def _interpolation(width: int, stride: int, sectors: int) -> Float[Tensor, "s v"]:
    """Return weights of linear interpolation from a map's columns to the sectors' centres, around the horizon.

    Column i of a map is centred on pixel `stride (i + 1) - 1`: "same" padding of an even picture is uneven, so each
    halving shifts by half a pixel to the right.
    """
    columns = width // stride
    weights = torch.zeros(sectors, columns)
    for sector in range(sectors):
        pixel = (sector + 0.5) * width / sectors - 0.5
        column = (pixel + 1.0) / stride - 1.0
        left = math.floor(column)
        weights[sector, left % columns] += 1.0 - (column - left)
        weights[sector, (left + 1) % columns] += column - left
    return weights
