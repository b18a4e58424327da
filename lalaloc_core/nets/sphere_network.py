"""Architecture `trunk`: the image encoder of the shipped model, on a trunk pretrained on photographs.

Layout encoder and head are those of `ring`. The trunk's feature maps of four strides are flattened over height,
interpolated to the ring's sectors, and mixed around the horizon. An image shows lengths only relative to the camera
height, so profile, openings, ceiling and room type are predicted without it, and lengths are then multiplied by it. An
error of the stated height therefore shifts the whole log profile by one offset. Only the ring, which is compared with
layouts in metres, takes the height as an input.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from lalaloc_core.conventions import OPENING_CLASSES, ROOM_TYPES
from lalaloc_core.errors import ConfigError
from lalaloc_core.nets.image_features import HorizonAttention, ImageFeatures, StructureFeatures, WallModes
from lalaloc_core.nets.layout_network import RingConfig
from lalaloc_core.nets.trunk import IMAGE_MEAN, IMAGE_STD, TAP_STRIDES, StyleMixing, Trunk, TrunkConfig

# Smallest update rate of the running class shares.
_SHARE_RATE = 1e-3
_MIN_LOG_SCALE, _MAX_LOG_SCALE = -6.0, 2.0
# Log distance, log scale and logit of the share of each mode when training begins, relative to the first one; if they
# were alike, both modes would learn the same.
_APART = ((0.0, 0.0, 0.0), (0.7, 0.0, -2.0))
_EDGE_VALUES = 5
_NEW_OUTPUTS = ("to_edges.", "to_objects.")


@dataclass(frozen=True, kw_only=True)
class TrunkEncoderConfig:
    """Sizes of the image encoder; `RingConfig` holds sectors, channels, profile columns and latent size.

    Attributes:
        squeezed: features per sector from each feature map of the trunk.
        modes: distributions whose mixture predicts the wall at an azimuth; with two, a passage and the wall behind it
            are no compromise.
    """

    image_height: int = 128
    image_width: int = 256
    trunk: TrunkConfig = field(default_factory=TrunkConfig)
    squeezed: tuple[int, ...] = (96, 96, 192, 192)
    mixer_width: int = 192
    mixer_blocks: int = 2
    mixer_heads: int = 4
    modes: int = 1

    def __post_init__(self) -> None:
        for name in ("image_height", "image_width"):
            if getattr(self, name) % TAP_STRIDES[-1] or getattr(self, name) < TAP_STRIDES[-1]:
                raise ConfigError(f"trunk.{name} is {getattr(self, name)}; it must be a multiple of {TAP_STRIDES[-1]}")
        if len(self.squeezed) != len(TAP_STRIDES):
            raise ConfigError(f"trunk.squeezed has {len(self.squeezed)} values; it must have {len(TAP_STRIDES)}")
        if not 1 <= self.modes <= len(_APART):
            raise ConfigError(f"trunk.modes is {self.modes}; it must lie between 1 and {len(_APART)}")


class HorizonEncoder(nn.Module):
    """Base of the image encoders on a pretrained trunk: pixels to features of the sectors around the horizon.

    Args:
        sectors: sectors that the picture covers.
        columns_per_sector: azimuth columns of a sector.
        extra_inputs: further features of each sector, given to `sector_features`.
        circular: the picture shows the full circle.
    """

    def __init__(
        self,
        config: TrunkEncoderConfig,
        sectors: int,
        columns_per_sector: int,
        *,
        extra_inputs: int = 0,
        circular: bool,
    ) -> None:
        super().__init__()
        self.config = config
        self.trunk = Trunk(config.trunk, circular=circular)
        self.columns_per_sector = columns_per_sector
        width = config.mixer_width
        maps = list(zip(TAP_STRIDES, config.trunk.tap_channels, config.squeezed, strict=True))
        self.squeezes = nn.ModuleList(
            nn.Linear(channels * (config.image_height // stride), squeezed) for stride, channels, squeezed in maps
        )
        for number, stride in enumerate(TAP_STRIDES):
            weights = _interpolation(config.image_width, stride, sectors, circular)
            self.register_buffer(f"interpolation{number}", weights, persistent=False)
        self.join = nn.Linear(sum(config.squeezed) + extra_inputs, width)
        self.mixer = nn.Sequential(
            *(
                HorizonAttention(width, config.mixer_heads, sectors, circular=circular)
                for _ in range(config.mixer_blocks)
            )
        )
        self.norm = nn.LayerNorm(width)
        self.to_profile = nn.Linear(width, columns_per_sector * config.modes * _values_per_mode(config.modes))
        if config.modes > 1:
            with torch.no_grad():
                self.to_profile.bias.unflatten(0, (columns_per_sector, config.modes, -1)).add_(torch.tensor(_APART))
        self.register_load_state_dict_pre_hook(_with_all_modes)
        self.register_load_state_dict_pre_hook(_with_new_outputs)
        self.to_openings = nn.Linear(width, len(OPENING_CLASSES) * columns_per_sector)
        # Elevations of both edges of an opening and their log scales, then the log odds that the wall is seen.
        self.to_edges = nn.Linear(width, _EDGE_VALUES * columns_per_sector)
        self.to_ceiling = nn.Sequential(nn.Linear(width, width), nn.GELU(), nn.Linear(width, 2))
        self.to_room_type = nn.Sequential(nn.Linear(2 * width, width), nn.GELU(), nn.Linear(width, len(ROOM_TYPES)))
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

    @torch.no_grad()
    def update_class_shares(self, opening_kind: Int[Tensor, "b w"], room_type: Int[Tensor, "b"]) -> None:
        """Update the class shares with the labels of a batch; codes below 0 are unknown."""
        self.counted += 1
        rate = max(1.0 / int(self.counted), _SHARE_RATE)
        for share, kind in ((self.opening_share, opening_kind), (self.room_type_share, room_type)):
            known = kind[kind >= 0]
            if len(known):
                share.lerp_(torch.bincount(known.long(), minlength=len(share)).to(share) / len(known), rate)

    def sector_features(
        self, taps: Sequence[Tensor], extra: Float[Tensor, "b s e"] | None = None
    ) -> Float[Tensor, "b s c"]:
        """Return the sectors' features by the maps of the trunk; they do not depend on the camera height."""
        squeezed = []
        for number, (tap, squeeze) in enumerate(zip(taps, self.squeezes, strict=True)):
            columns = squeeze(tap.flatten(1, 2).transpose(1, 2)).to(self.mean.dtype)
            squeezed.append(self.get_buffer(f"interpolation{number}") @ columns)
        if extra is not None:
            squeezed.append(extra)
        return self.norm(self.mixer(self.join(torch.cat(squeezed, dim=2))))

    def walls(self, mixed: Float[Tensor, "b s c"], log_height: Float[Tensor, "b"]) -> WallModes:
        """Return the distance of the wall at each azimuth column; `log_height` as for `structure`."""
        values = self.to_profile(mixed).unflatten(2, (self.columns_per_sector, self.config.modes, -1)).flatten(1, 2)
        share = values[..., 2] if self.config.modes > 1 else torch.zeros_like(values[..., 0])
        return WallModes(
            log_profile=values[..., 0] + log_height[:, None, None],
            log_scale=values[..., 1].clamp(_MIN_LOG_SCALE, _MAX_LOG_SCALE),
            log_share=torch.log_softmax(share, dim=2),
        )

    def structure(self, mixed: Float[Tensor, "b s c"], log_height: Float[Tensor, "b"]) -> StructureFeatures:
        """Return openings, ceiling height and room type; `log_height` is the log of the camera height (m)."""
        openings = self.to_openings(mixed).unflatten(2, (self.columns_per_sector, len(OPENING_CLASSES))).flatten(1, 2)
        edges = self.to_edges(mixed).unflatten(2, (self.columns_per_sector, _EDGE_VALUES)).flatten(1, 2)
        ceiling = self.to_ceiling(mixed).mean(dim=1)
        overall = torch.cat([mixed.mean(dim=1), mixed.amax(dim=1)], dim=1)
        return StructureFeatures(
            opening_logits=openings,
            log_ceiling=ceiling[:, 0] + log_height,
            log_ceiling_scale=ceiling[:, 1].clamp(_MIN_LOG_SCALE, _MAX_LOG_SCALE),
            room_type_logits=self.to_room_type(overall),
            edges=edges[..., :2],
            edges_log_scale=edges[..., 2:4].clamp(_MIN_LOG_SCALE, _MAX_LOG_SCALE),
            wall_seen_logit=edges[..., 4],
        )

    def normalised(self, image: Tensor) -> Float[Tensor, "b 3 h w"]:
        """Return (b, h, w, 3) pixels of 0 to 255 as the trunk's input."""
        return (image.permute(0, 3, 1, 2).to(self.mean.dtype) - self.mean) / self.std


class TrunkImageEncoder(HorizonEncoder):
    """Image encoder: sphere and camera height to ring, wall profile, openings, ceiling height and room type."""

    def __init__(self, config: TrunkEncoderConfig, ring: RingConfig) -> None:
        super().__init__(config, ring.sectors, ring.profile_columns // ring.sectors, circular=True)
        width = config.mixer_width
        self.to_ring = nn.Sequential(nn.Linear(width + 1, width), nn.GELU(), nn.Linear(width, ring.channels))

    def forward(
        self, image: Tensor, camera_height_m: Float[Tensor, "b"], styles: StyleMixing | None = None
    ) -> ImageFeatures:
        """Encode spheres (b, h, w, 3) of values from 0 to 255; `styles` is for training only."""
        mixed = self.sector_features(self.trunk(self.normalised(image), styles))
        log_height = torch.log(camera_height_m)
        height_input = log_height[:, None, None].expand(-1, mixed.shape[1], -1)
        return ImageFeatures(
            ring=self.to_ring(torch.cat([mixed, height_input], dim=2)).transpose(1, 2),
            walls=self.walls(mixed, log_height),
            structure=self.structure(mixed, log_height),
        )


def _with_new_outputs(encoder: HorizonEncoder, state: dict[str, Tensor], prefix: str, *_: object) -> None:
    """Let outputs that earlier weights lack begin untrained."""
    for name, own in encoder.named_parameters():
        if name.startswith(_NEW_OUTPUTS):
            state.setdefault(prefix + name, own.detach().clone())


def _values_per_mode(modes: int) -> int:
    """Return the number of values predicted of a mode: log distance, log scale, and among several its share's logit."""
    return 2 if modes == 1 else len(_APART[0])


def _with_all_modes(encoder: HorizonEncoder, state: dict[str, Tensor], prefix: str, *_: object) -> None:
    """Let all modes of an encoder begin as the only mode of the weights that it is about to load."""
    modes = encoder.config.modes
    for name, own in encoder.to_profile.named_parameters():
        key = f"{prefix}to_profile.{name}"
        if key not in state or len(state[key]) != encoder.columns_per_sector * _values_per_mode(1) or modes == 1:
            continue
        single = state[key].unflatten(0, (encoder.columns_per_sector, 1, -1))
        values = torch.zeros_like(own).unflatten(0, (encoder.columns_per_sector, modes, -1))
        values[:, :, : single.shape[2]] = single
        if name == "bias":
            values += torch.tensor(_APART).to(values)
        state[key] = values.flatten(0, 2)


def _interpolation(width: int, stride: int, sectors: int, circular: bool) -> Float[Tensor, "s v"]:
    """Return weights of linear interpolation from a map's columns to the sectors' centres.

    Column i of a map is centred on pixel `stride (i + 1) - 1`: "same" padding of an even picture is uneven, so each
    halving shifts by half a pixel to the right. Beyond the borders of a part of the circle, its outermost column is
    used.
    """
    columns = width // stride
    weights = torch.zeros(sectors, columns)

    def place(column: int) -> int:
        return column % columns if circular else min(max(column, 0), columns - 1)

    for sector in range(sectors):
        pixel = (sector + 0.5) * width / sectors - 0.5
        column = (pixel + 1.0) / stride - 1.0
        left = math.floor(column)
        weights[sector, place(left)] += 1.0 - (column - left)
        weights[sector, place(left + 1)] += column - left
    return weights
