"""Image encoder of views: photographs that show a part of the horizon.

A view is a patch of a level equirectangular picture around the photograph, of fixed size and position relative to the
horizon, with an opacity that says which of its pixels the photograph shows. The wall at each azimuth is predicted as a
mixture of two Laplace distributions of its log distance, because an edge of the floor is often hidden, and a passage
shows two walls.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from lalaloc_core.conventions import ROOM_TYPES, TWO_PI
from lalaloc_core.errors import ConfigError
from lalaloc_core.nets.image_features import StructureFeatures, WallModes
from lalaloc_core.nets.layout_network import RingConfig
from lalaloc_core.nets.sphere_network import HorizonEncoder, TrunkEncoderConfig, TrunkImageEncoder
from lalaloc_core.nets.trunk import TAP_STRIDES, StyleMixing

# Least part of a patch, in cells of the last map, by which its features are divided.
_LEAST_SHOWN = 0.1


@dataclass(frozen=True, kw_only=True)
class ViewEncoderConfig(TrunkEncoderConfig):
    """Sizes of the encoder of views; `image_height` and `image_width` are those of the patch.

    Attributes:
        sectors: sectors that the patch covers, each as wide as the ring's.
        top_deg: elevation of the patch's upper border; pixels are as high as they are wide.
        objects: number of household objects that are predicted, besides the types of rooms; 0 predicts neither.
    """

    image_height: int = 192
    image_width: int = 256
    modes: int = 2
    sectors: int = 20
    top_deg: float = 39.375
    objects: int = 0

    def width_rad(self, ring: RingConfig) -> float:
        """Return the azimuths (radians) that the patch spans."""
        return TWO_PI * self.sectors / ring.sectors

    def directions(self, ring: RingConfig) -> tuple[Float[Tensor, "columns"], Float[Tensor, "rows"]]:
        """Return azimuths of columns, relative to the patch's centre, and elevations of rows (radians) at centres."""
        azimuths = ((np.arange(self.image_width) + 0.5) / self.image_width - 0.5) * self.width_rad(ring)
        pixel = self.width_rad(ring) / self.image_width
        elevations = np.radians(self.top_deg) - (np.arange(self.image_height) + 0.5) * pixel
        return torch.from_numpy(azimuths).float(), torch.from_numpy(elevations).float()


@dataclass(frozen=True)
class ViewFeatures:
    """Predictions for a batch of views.

    Attributes:
        seen: (b, w) share of each azimuth column that a photograph shows.
        objects: (b, n) logits of household objects, then of the types of rooms; None if they are not predicted.
    """

    walls: WallModes
    seen: Tensor
    structure: StructureFeatures
    objects: Tensor | None = None


class ViewNetwork(HorizonEncoder):
    """Image encoder of views: patch and camera height to walls, openings, ceiling height and room type."""

    def __init__(self, config: ViewEncoderConfig, ring: RingConfig) -> None:
        if not 0 < config.sectors <= ring.sectors:
            raise ConfigError(
                f"view.sectors is {config.sectors}; it must lie between 1 and ring.sectors, {ring.sectors}"
            )
        super().__init__(config, config.sectors, ring.profile_columns // ring.sectors, extra_inputs=1, circular=False)
        columns = config.sectors * self.columns_per_sector
        self.register_buffer("pooling", _pooling(config.image_width, columns), persistent=False)
        self.pooling: Tensor
        # Not a tensor, which an export would take for a constant of the network.
        self._elevations = config.directions(ring)[1].numpy()
        self.to_objects: nn.Module | None = None
        if config.objects:
            width, inputs = config.mixer_width, 2 * config.trunk.widths[-1]
            outputs = config.objects + len(ROOM_TYPES)
            self.to_objects = nn.Sequential(nn.Linear(inputs, width), nn.GELU(), nn.Linear(width, outputs))

    @torch.no_grad()
    def start_from(self, sphere: TrunkImageEncoder) -> None:
        """Take over the weights of an encoder of spheres; if it has one mode, both begin as that.

        Layers that flatten feature maps over height are resampled from the sphere's rows to the patch's.
        """
        own, theirs = self.state_dict(), sphere.state_dict()
        taken = {
            name: value
            for name, value in theirs.items()
            if name in own and (own[name].shape == value.shape or name.startswith("to_profile."))
        }
        taken["join.weight"] = torch.zeros_like(own["join.weight"])
        taken["join.weight"][:, : sphere.join.in_features] = theirs["join.weight"]
        elevations = torch.from_numpy(self._elevations)
        for number, stride in enumerate(TAP_STRIDES):
            weight = theirs[f"squeezes.{number}.weight"]
            rows, own_rows = sphere.config.image_height // stride, self.config.image_height // stride
            by_row = weight.unflatten(1, (-1, rows))
            place = (0.5 - elevations.view(own_rows, stride).mean(dim=1) / torch.pi) * rows - 0.5
            left = place.floor().clamp(0, rows - 2)
            share = (place - left).clamp(0.0, 1.0)
            resampled = torch.lerp(by_row[..., left.long()], by_row[..., left.long() + 1], share)
            # A row of the sphere is seen by several rows of the patch.
            per_row = abs(float(elevations[0] - elevations[stride])) * rows / torch.pi
            taken[f"squeezes.{number}.weight"] = (resampled * per_row).flatten(1)
        self.load_state_dict(own | taken)

    def forward(
        self, image: Tensor, camera_height_m: Float[Tensor, "b"], styles: StyleMixing | None = None
    ) -> ViewFeatures:
        """Encode patches (b, h, w, 4), RGB and opacity, 0 to 255; transparent pixels are unknown."""
        opacity = image[..., 3].to(self.mean.dtype) / 255.0
        pixels = self.normalised(image[..., :3]) * opacity[:, None]
        seen = opacity.mean(dim=1) @ self.pooling
        by_sector = seen.unflatten(1, (-1, self.columns_per_sector)).mean(dim=2)
        taps = self.trunk(pixels, styles)
        mixed = self.sector_features(taps, by_sector[..., None])
        log_height = torch.log(camera_height_m)
        return ViewFeatures(
            walls=self.walls(mixed, log_height),
            seen=seen,
            structure=self.structure(mixed, log_height),
            objects=None if self.to_objects is None else self.to_objects(_pooled(taps[-1].detach(), opacity)),
        )


def _pooled(features: Float[Tensor, "b c h w"], opacity: Float[Tensor, "b h2 w2"]) -> Float[Tensor, "b 2*c"]:
    """Return mean and maximum of features over the part that a photograph shows."""
    shown = functional.avg_pool2d(opacity[:, None], TAP_STRIDES[-1])
    mean = (features * shown).sum(dim=(2, 3)) / shown.sum(dim=(2, 3)).clamp_min(_LEAST_SHOWN)
    return torch.cat([mean, (features * shown).amax(dim=(2, 3))], dim=1)


def _pooling(width: int, columns: int) -> Float[Tensor, "w c"]:
    """Return weights that average pixels over azimuth columns, whose borders may cut pixels."""
    edge = torch.arange(columns + 1) * (width / columns)
    pixel = torch.arange(width)[:, None]
    overlap = torch.minimum(pixel + 1, edge[None, 1:]) - torch.maximum(pixel, edge[None, :-1])
    return overlap.clamp(min=0.0) * (columns / width)
